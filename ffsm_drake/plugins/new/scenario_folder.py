"""The folder of a new scenario: its file with comments, its models and their meshes."""

import copy
import dataclasses
import re
import tempfile
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from ffsm_drake.common.errors import FfsmError, ModelError, ScenarioError
from ffsm_drake.common.files import write_text
from ffsm_drake.common.steps import step
from ffsm_drake.plugins.design.rounding import rounded
from ffsm_drake.plugins.new.asked import Asked
from ffsm_drake.plugins.new.first_mission import FirstMission
from ffsm_drake.plugins.new.flow_text import WIDTH, flow_text
from ffsm_drake.plugins.new.result import NewScenario, limits_text
from ffsm_drake.plugins.new.urdf.servicer import Servicer
from ffsm_drake.plugins.new.urdf.target import SECOND, Target, cube
from ffsm_drake.plugins.new.urdf.writing import write_urdf
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.plant import check_pictures

_TEMPLATE = Path(__file__).with_name("first_scenario.yaml")
_TARGET = "target"  # folder of a user's
_PAYLOAD_SHARE = 0.25  # share of the base's mass
_TRIES = 3  # draws of postures
_HALVED = 3  # times that the side of a target may be, until it touches nothing
_WRITTEN = ("model", "mass", "inertia", "controller", "duration")  # keys, also with a default
_NOMINAL_SHARE = 0.8  # share of the payload's true mass and inertia


def write_folder(
    servicer: Servicer,
    folder: Path,
    asked: Asked,
    target: Target | None,
    *,
    packages: Mapping[str, Path],
    mass: float | None,
    side: float | None,
    strict: bool,
) -> NewScenario:
    """Write everything into a temporary folder.

    Args:
      target: the target; None: a cube of a mass (kg) and side (m).
      strict: raise ScenarioError if no drawn posture has a plan without faults.
    """
    file, template = folder / f"{folder.name}.yaml", _TEMPLATE.read_text(encoding="utf-8")
    making = _Making(_data(yaml.safe_load(template), servicer, asked), servicer, asked, packages)
    given = target or making.cube(mass, side)
    try:
        left_out, draft = making.placed(given, folder)
        check_pictures(draft.scenario.model)
        if draft.touching and given.side and (smaller := making.clear(given, folder.name)):
            if side is None:
                remark = f"the target is made smaller: {draft.touching}"
                left_out, draft = making.placed(smaller, folder)
                given, draft.remarks = smaller, [remark, *draft.remarks]
            else:
                draft.touching += f"; --target {smaller.mass:g}kg,{smaller.side:g}m keeps clear"
        if not draft.is_held:
            raise ScenarioError("--tips", f"{draft.touching}{_what_may_help(given, asked)}")
        draft.pace()
        draft = making.redrawn(draft, given, folder)
        if strict and draft.faults:
            raise ScenarioError("mission", draft.faults[0])
        draft.fill()
        scenario, forces = draft.scenario, draft.motion_forces()
    except FfsmError as error:
        # Line numbers in Drake's messages refer to the copy, not to the user's file.
        told = re.sub(r"([^/ ]+\.urdf):\d+: ", r"\1: ", str(error).replace(f"{folder}/", ""))
        raise ModelError(told) from error
    data = draft.written
    if "drives" in data["actuation"]:
        left_out = [each for each in left_out if "--friction" not in each]
    write_text(file, _filled(template, data, servicer))
    return NewScenario(
        servicer=servicer,
        scenario_file=file,
        scenario=scenario,
        peak_force=draft.coordinates.by_name(forces),
        margins=draft.margins,
        side=given.side,
        remarks=(*servicer.remarks, *left_out, *draft.remarks),
    )


def _data(data: dict[str, Any], servicer: Servicer, asked: Asked) -> dict[str, Any]:
    """Fill the data of the template with what does not depend on the target."""
    mission = "Post-capture stabilization" if asked.capture is None else "Capture, to rest,"
    data["description"] = f"{mission} with {servicer.source.stem}"
    if asked.is_paper:
        data["controller"] = Scenario.controller
    efforts = {joint.name: joint.effort for joint in servicer.joints if joint.effort < 1e20}
    if len(efforts) == len(servicer.joints) and len({*efforts.values()}) == 1:
        efforts = {"joints": servicer.joints[0].effort}
    data["actuation"] = {"limit": efforts} if efforts else {}
    if asked.friction and (drives := servicer.drives):
        data["actuation"]["drives"] = drives
    asked.fill(data)
    return data


def _sides(target: Target) -> list[float]:
    """Half the side of a cube, a quarter, ..., m."""
    return [rounded((target.side or 0.0) * 0.5**k) for k in range(1, _HALVED + 1)]


def _what_may_help(target: Target, asked: Asked) -> str:
    """The end of the message that no posture holds a target."""
    tried, other = "", f"another place of '{SECOND}'"
    if target.side:
        sides = ", ".join(f"{each:g}" for each in _sides(target))
        tried, other = f"; nor one of {sides} m", "another --target KG,M"
    may_help = "wider limits of the joints, longer arms, other hands"
    if asked.has_approach:
        may_help = f"a slower --capture, {may_help}"
    return f"{tried}; what may help: {may_help}, or {other}"


@dataclasses.dataclass(frozen=True)
class _Making:
    """Drafts of one scenario, with several targets and postures."""

    data: Mapping[str, Any]  # of the template, filled
    servicer: Servicer
    asked: Asked
    packages: Mapping[str, Path]

    def cube(self, mass: float | None, side: float | None) -> Target:
        """Return a cube as the target. See ``cube``."""
        return cube(mass, side, self.servicer, share=_PAYLOAD_SHARE)

    def placed(self, target: Target, folder: Path, seed: int = 0) -> tuple[list[str], FirstMission]:
        """Return remarks on omitted parts, and a draft with postures; a seed draws others."""
        own = copy.deepcopy(dict(self.data))
        left_out = _write_models(own, self.servicer, folder, target, packages=self.packages)
        source = str(folder / f"{folder.name}.yaml")
        draft = FirstMission(own, self.asked, self.servicer, source=source, seed=seed)
        draft.place(target)
        return left_out, draft

    def clear(self, target: Target, name: str) -> Target | None:
        """Return the largest cube, of half the side, a quarter, ..., that touches nothing."""
        with tempfile.TemporaryDirectory() as place:
            for side in _sides(target):
                smaller = self.cube(target.mass, side)
                with step(f"trying a target of {side:g} m"):
                    if not self.placed(smaller, Path(place) / name)[1].touching:
                        return smaller
        return None

    def redrawn(self, draft: FirstMission, target: Target, folder: Path) -> FirstMission:
        """Return a draft with faults, or one with other postures that has none."""
        has_postures = self.asked.capture is not None and self.asked.tips is None
        again = range(1, _TRIES if has_postures else 1)
        for seed in again if draft.faults else ():
            with step(f"trying other postures, {seed} of {len(again)}"):
                _, drawn = self.placed(target, folder, seed)
                drawn.pace()
            if not drawn.faults:
                drawn.remarks = draft.remarks
                return drawn
        return draft


@step("copying the model")
def _write_models(
    data: dict[str, Any],
    servicer: Servicer,
    folder: Path,
    target: Target,
    *,
    packages: Mapping[str, Path],
) -> list[str]:
    """Write the URDFs, and set models and payload in the data of a scenario.

    Returns: remarks on omitted parts.
    """
    copied, name = (f"{each.source.name.split('.')[0]}.urdf" for each in (servicer, target))
    left_out = [*write_urdf(servicer, folder, file_name=copied, packages=packages)]
    stripped = write_urdf(target, folder / _TARGET, file_name=name, packages=packages)
    left_out += [f"target: {remark}" for remark in (*target.remarks, *stripped)]
    payload, mass, inertia = data["payload"], target.mass, target.inertia
    data["model"] |= {
        "servicer": copied,
        "debris": f"{_TARGET}/{name}",
        "end_effector": f"servicer::{servicer.tip.frame}",
        "grasp": f"debris::{target.grasp}",
    }
    payload["body"] = f"debris::{target.body}"
    for name, share in (("truth", 1.0), ("nominal", _NOMINAL_SHARE)):
        payload[name] = {
            "mass": float(f"{share * mass:.15g}"),
            "center_of_mass": list(target.center_of_mass),
            "inertia": [float(f"{share * moment:.15g}") for moment in inertia],
        }
    return left_out


def _filled(template: str, data: Mapping[str, Any], servicer: Servicer) -> str:
    """Return the template with the data of a scenario, block by block.

    Empty sections and defaults are left out.
    """
    named: dict[str, list[str]] = {}
    for joint in servicer.joints:
        named.setdefault(limits_text(joint), []).append(joint.name)
    limits = "; ".join(f"{', '.join(names)} {text}" for text, names in named.items())
    if len(named) == 1:
        limits = f"all {next(iter(named))}"
    template = template.replace("LIMITS", limits)
    template = template.replace("CONTROLLERS", ", ".join(data["controllers"]))
    changed, parts = _unusual(data, Scenario()), list[str]()
    for block in template.split("\n\n"):
        part = ""
        for comment, keys in re.findall(r"((?:^#.*\n)*)((?:^[^#].*\n?)+)", block, re.MULTILINE):
            told = " ".join(re.findall("^# (.*)", comment, re.MULTILINE))
            kept = {key: changed[key] for key in yaml.safe_load(keys) if key in changed}
            if kept:
                part += "".join(f"# {line}\n" for line in textwrap.wrap(told, WIDTH - 2))
            part += "".join(flow_text(key, value) for key, value in kept.items())
        parts += [part] if part else []
    return "\n".join(parts)


def _unusual(data: Mapping[str, Any], usual: Any) -> dict[str, Any]:
    """Return the data of a section that differ from its settings, without empty sections.

    The keys that users change most are always there.
    """
    found = dict[str, Any]()
    for key, value in data.items():
        default = getattr(usual, key, None)
        if isinstance(value, Mapping) and key != "model" and not isinstance(default, dict | None):
            value = _unusual(value, default)
        if value not in ({}, default) or key in _WRITTEN:
            found[key] = value
    return found
