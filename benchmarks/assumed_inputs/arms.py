"""Write models with other mass properties of the arm, and a campaign over them for each mission.

    python benchmarks/assumed_inputs/arms.py out/arms
    ffsm campaign run out/arms/seven_joint.yaml

Each campaign runs equal numbers of cases with the assumed inertias at half, once and twice their
value. Plant and controller have the same model. docs/validation/parameters.md has the results.
"""

import argparse
import xml.etree.ElementTree as ElementTree
from fnmatch import fnmatchcase
from pathlib import Path

import yaml

from ffsm_drake.common.files import write_text

URDF = Path(__file__).parents[2] / "models" / "urdf"
FACTORS = {"half": 0.5, "once": 1.0, "twice": 2.0}
CLIENT = {"mass": 17.0, "inertia": [0.7083, 0.7083, 0.7083]}
ELSA_D = {"payload.body": "debris::client", "payload.truth": CLIENT}
# mission: scenario, URDFs of servicer and target, links, whether masses are scaled too, overrides
MISSIONS = {
    "postcapture": ("postcapture", "servicer", "debris", "link_*", False, {}),
    "seven_joint": ("seven_joint", "ssrms_servicer", "debris", "[!b]*", False, {}),
    "two_arms": ("two_arms", "two_arms", "two_arms_target", "*_link_?", False, {}),
    "elsa_d_arm": ("tumbling_capture", "elsa_d", "elsa_d_client", "link_*", True, ELSA_D),
    "elsa_d_base": ("tumbling_capture", "elsa_d", "elsa_d_client", "base", False, ELSA_D),
}


def scaled(urdf: Path, links: str, factor: float, *, masses: bool) -> str:
    """Return the text of a URDF with scaled inertias of the links that a pattern names."""
    tree = ElementTree.parse(urdf)
    for link in tree.getroot().iter("link"):
        inertial = link.find("inertial")
        if inertial is None or not fnmatchcase(link.get("name", ""), links):
            continue
        for item in [*inertial.iter("inertia"), *(inertial.iter("mass") if masses else ())]:
            for key, value in item.items():
                item.set(key, repr(factor * float(value)))
    return ElementTree.tostring(tree.getroot(), encoding="unicode")


def campaign(mission: str, folder: Path) -> dict[str, object]:
    """Write the models of a mission, and return its campaign."""
    scenario, servicer, target, links, masses, settings = MISSIONS[mission]
    models = {}
    for name, factor in FACTORS.items():
        path = folder / f"{servicer}_{mission}_{name}.urdf"
        write_text(path, scaled(URDF / f"{servicer}.urdf", links, factor, masses=masses))
        models[name] = str(path)
    debris = f"package://ffsm_drake/urdf/{target}.urdf"
    return {
        "description": f"Inertias of the arm at half, once and twice the assumed value: {mission}",
        "scenario": scenario,
        "overrides": {
            "model.directives": None,
            "model.servicer": models["once"],
            "model.debris": debris,
            **settings,
        },
        "controllers": ["tdc"],
        "cases": 36,
        "seed": 1,
        "predictions": False,
        "parameters": {"model.servicer": {"distribution": "list", "values": models}},
        "factors": {"nominal_error": {"distribution": "uniform", "low": -0.5, "high": 0.2}},
        "derive": {
            f"payload.nominal.{key}": {
                "rule": "relative",
                "of": f"payload.truth.{key}",
                "error": "nominal_error",
            }
            for key in ("mass", "inertia")
        },
    }


def main() -> None:
    """Write every model and campaign into a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    for mission in MISSIONS:
        write_text(folder / f"{mission}.yaml", yaml.safe_dump(campaign(mission, folder)))
        print(folder / f"{mission}.yaml")


if __name__ == "__main__":
    main()
