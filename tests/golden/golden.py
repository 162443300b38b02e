"""The golden record: what must not move unless somebody means it. ``python tests/golden/golden.py``
rewrites it, ``--moves`` prints how far it has moved here. The plug-in of baselines is left out.

``runs/NAME.json`` holds, of 2 s of each shipped scenario with its own controller (and of some with
every law), the record's variables at every 20th sample, its metrics, names, dimensions and units,
the panels of its report and the rows of its table. ``interface.json`` holds the columns of
campaigns, ``schema.json`` what ``ffsm schema`` prints.
"""

import importlib
import json
import math
import sys
import warnings
from collections.abc import Iterator, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from click.testing import CliRunner

from ffsm_drake import FfsmError, RunRecord, load_scenario, simulate
from ffsm_drake.cli import main as ffsm
from ffsm_drake.scenario import scenario_to_dict, shipped_scenarios
from ffsm_drake.show.panels import Thinning
from ffsm_drake.show.results import results_of
from ffsm_drake.systems.registry import shipped_names

FOLDER = Path(__file__).parent
RUNS = FOLDER / "runs"
EVERY = 20  # control samples
# Of these scenarios every law runs.
WITH_EVERY_LAW = ("postcapture", "flight_sensors", "tumbling_capture", "free_floating")
BASELINES = {
    each.name
    for each in entry_points(group="ffsm_drake.controllers")
    if each.value.startswith("ffsm_drake.plugins.baselines.")
}
DURATION = "duration=2"
# A short approach, mild enough to be followed.
_SHORT_APPROACH = (
    "capture.approach.duration=1",
    "capture.approach.posture.joints={joint_1: 0.16, joint_2: 0.37, joint_3: 1.04, joint_4: "
    "0.58, joint_5: -0.69}",
)
_SHORTENED = dict.fromkeys(("tumbling_capture", "capture_on_thrusters"), _SHORT_APPROACH)
_SMALLEST_CAMPAIGN = {
    "controllers": ["tdc"],
    "cases": 1,
    "parameters": {"payload.truth.mass": {"distribution": "uniform", "low": 90, "high": 110}},
}
# Differences of what should be equal, N s and N m s: their scale is that of what is compared.
BALANCES = ("momentum_residual", "grasp")


class Moves(NamedTuple):
    """How far another processor's rounding may move the figures of a record, and what makes it so
    much. At least three times what was seen on five (``test_rounding_moves_nothing_further``).
    """

    relative: float = 1e-10  # of the largest number of a variable, or of a single figure
    scale: float = 1e-5  # the least that counts as this largest
    why: str = "errors of 1e-9 are differences of numbers of order one"


_INTEGRATED = Moves(1e-7, 1e-4, "SciPy's steps along the planned motion of an undriven base")
_TWO_HANDS = Moves(1e-8, why="the hands' force has no inertia that would smooth it")
_MOVES = {
    "ets_vii": _INTEGRATED,
    "free_floating": _INTEGRATED,
    "reaction_null": _INTEGRATED,
    "paper": Moves(1e-9, why="gains so high that the loop diverges"),
    "thrusters_only": Moves(1e-9, why="the errors at the end are what many pulses leave"),
    "tumbling_capture": Moves(1e-8, why="TVLQR's finite differences, whose step is 1e-6"),
    "two_arms_capture": _TWO_HANDS,
    "tohoku_arms": _TWO_HANDS,
    "planar_detumble": Moves(1e-9, why="the planned motion is where an optimizer stopped"),
}


def moves(name: str) -> Moves:
    """Of a part of the golden record, by name."""
    return _MOVES.get(name, Moves())


def names() -> list[str]:
    """The parts of the golden record: the shipped scenarios."""
    return list(shipped_scenarios())


def outline(record: RunRecord) -> dict[str, Any]:
    """What a record is made of, and what its report shows."""
    dataset = record.dataset
    return {
        "variables": {
            str(name): [list(map(str, variable.dims)), str(variable.dtype), dict(variable.attrs)]
            for name, variable in dataset.data_vars.items()
        },
        "coordinates": {
            str(name): [
                list(map(str, variable.dims)),
                None if name == "phase" else variable.values.tolist(),
            ]
            for name, variable in dataset.coords.items()
            if name != "time"
        },
        "report": report_outline(record),
    }


def report_outline(record: RunRecord) -> dict[str, Any]:
    """The panels of a report (section, view, title, unit, number of curves) and the rows of its
    table.
    """
    comparison, parts, time = (
        importlib.import_module(f"ffsm_drake.plugins.report.{name}")
        for name in ("comparison", "part_panels", "time_panels")
    )
    shown, thin = results_of([record]), Thinning(1000)
    sections = {
        **time.run_views(shown, thin),
        **{
            title.lower().partition(" ")[0]: parts.part_views(shown, thin, title)
            for title in parts.part_sections(shown)
        },
    }
    panels = [
        f"{section} / {view.label} / {panel.title} [{panel.figure.layout.yaxis.title.text}]: "
        f"{len(panel.figure.data)}"
        for section, views in sections.items()
        for view in views
        for panel in view.panels
    ]
    rows = [f"{row.head} / {row.label} [{row.unit}]" for row in comparison.table(shown)]
    return {"panels": panels, "table": rows}


def schema() -> Any:
    """What ``ffsm schema`` prints, without the keys of Drake's own struct, which its releases
    change.
    """
    found = json.loads(CliRunner().invoke(ffsm, ["schema"], catch_exceptions=False).output)
    del found["properties"]["simulator_config"]["properties"]
    for name in BASELINES:
        del found["properties"]["controllers"]["properties"][name]
    return found


def run(scenario: str, controller: str | None = None) -> RunRecord:
    """A run of the golden record."""
    overrides = [*_SHORTENED.get(scenario, ()), DURATION]
    if controller is not None:
        overrides.append(f"controller={controller}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of unstable laws, which are part of it
        return simulate(load_scenario(scenario, overrides), check_stability=False)


def results(record: RunRecord) -> dict[str, Any]:
    """The numbers of a run."""
    dataset = record.dataset.isel(time=slice(None, None, EVERY))
    numeric = {
        str(name): variable
        for name, variable in dataset.data_vars.items()
        if variable.dtype.kind in "fiub"
    }
    return {
        "outcome": record.outcome.message,
        "metrics": record.metrics,
        "grasp": record.grasp,
        "samples": {name: _rounded(variable.values) for name, variable in numeric.items()},
    }


def _rounded(values: np.ndarray) -> Any:
    """Nested lists of numbers with twelve digits."""
    if values.ndim:
        return [_rounded(value) for value in values]
    return float(f"{float(values):.12g}")


def runs(scenario: str) -> dict[str, Any]:
    """The runs of a scenario, by controller; of further laws only the variables that are not as
    with its own.
    """
    own = run(scenario)
    found = {own.scenario.controller: results(own)}
    reference = found[own.scenario.controller]["samples"]
    for controller in shipped_names("controller") if scenario in WITH_EVERY_LAW else ():
        if controller in found or controller in BASELINES:
            continue
        try:
            of_law = results(run(scenario, controller))
        except FfsmError as error:
            found[controller] = {"refused": str(error)}
            continue
        of_law["samples"] = {
            name: "as above" if values == reference.get(name) else values
            for name, values in of_law["samples"].items()
        }
        found[controller] = of_law
    return {"outline": outline(own), "runs": found}


def interface() -> dict[str, Any]:
    """The columns of the shipped campaigns, and of campaigns over the shipped scenarios."""
    spec, store = (
        importlib.import_module(f"ffsm_drake.plugins.campaign.{name}") for name in ("spec", "store")
    )
    specs = {f"campaign {name}": spec.load_spec(name) for name in spec.shipped_campaigns()}
    for name in names():
        base = scenario_to_dict(load_scenario(name))
        specs[f"scenario {name}"] = spec.spec_from_data({**_SMALLEST_CAMPAIGN, "base": base})
    return {name: list(store.result_columns(each)) for name, each in specs.items()}


def differences(
    found: Any,
    expected: Any,
    place: str = "",
    *,
    relative: float,
    scale: float,
) -> Iterator[str]:
    """Where two trees differ, one line each.

    Args:
      found, expected: what JSON can hold.
      place: where in the tree they stand.
      relative: how much numbers may differ, of the largest in the outermost list that holds them.
      scale: the least that counts as this largest.
    """
    further = {"relative": relative, "scale": scale}
    if isinstance(found, dict) and isinstance(expected, dict):
        for key in [*expected, *(key for key in found if key not in expected)]:
            if key not in found or key not in expected:
                yield f"{place}.{key}: {'is new' if key in found else 'is gone'}"
            else:
                if key in BALANCES:
                    further["scale"] = max(scale, 1.0)
                yield from differences(found[key], expected[key], f"{place}.{key}", **further)
    elif _is_number(found) and _is_number(expected):
        if not abs(found - expected) <= relative * max(scale, abs(expected)):  # NaN too
            yield f"{place}: {found!r}, not {expected!r}"
    elif isinstance(found, list) and isinstance(expected, list) and len(found) == len(expected):
        further["scale"] = max([scale, *map(abs, _numbers(expected))])
        for index, (one, other) in enumerate(zip(found, expected, strict=True)):
            yield from differences(one, other, f"{place}[{index}]", **further)
    elif found != expected:
        yield f"{place}: {found!r:.200}, not {expected!r:.200}"


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _numbers(tree: Any) -> Iterator[float]:
    if isinstance(tree, list):
        for item in tree:
            yield from _numbers(item)
    elif _is_number(tree):
        yield tree


def read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def plain(tree: Any) -> Any:
    """As JSON gives it back; numbers that are not finite as text."""
    if isinstance(tree, dict):
        return {str(key): plain(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [plain(value) for value in tree]
    if isinstance(tree, float) and not math.isfinite(tree):
        return str(tree)
    return tree


def text(tree: Any, indent: str = "") -> str:
    """JSON with one line for each row of numbers."""
    further = indent + " "
    if isinstance(tree, dict) and tree:
        rows = (
            f"{further}{json.dumps(key)}: {text(value, further)}" for key, value in tree.items()
        )
    elif isinstance(tree, list) and any(isinstance(item, (dict, list)) for item in tree):
        rows = (f"{further}{text(item, further)}" for item in tree)
    else:
        return json.dumps(tree, ensure_ascii=False, separators=(",", ":"))
    opening, closing = "{}" if isinstance(tree, dict) else "[]"
    return f"{opening}\n" + ",\n".join(rows) + f"\n{indent}{closing}"


def files() -> dict[Path, Any]:
    """Every file of the golden record and what computes it."""
    parts = {RUNS / f"{name}.json": (lambda name=name: runs(name)) for name in names()}
    return parts | {FOLDER / "interface.json": interface, FOLDER / "schema.json": schema}


def changes(path: Path, found: Any, *, share: float = 1.0) -> list[str]:
    """Where a part of the golden record differs by more than a share of what it may.

    Args: its file; what was computed, as JSON gives it back; the share.
    """
    allowed = moves(path.stem)
    return list(
        differences(found, read(path), relative=share * allowed.relative, scale=allowed.scale)
    )


def print_moves() -> None:
    """Within which of some shares of what it may each part of the golden record has moved here."""
    for path, compute in files().items():
        found, share = plain(compute()), 1e-6
        while share < 1e3 and changes(path, found, share=share):
            share *= 10.0**0.5
        print(f"{path.stem} {share:.1e}", flush=True)


def main(arguments: Sequence[str] = ()) -> None:
    if "--moves" in arguments:
        print_moves()
        return
    if arguments:
        sys.exit(f"unknown: {' '.join(arguments)}; without arguments the record is rewritten")
    RUNS.mkdir(exist_ok=True)
    wanted = files()
    for path in {*RUNS.glob("*.json")} - set(wanted):
        path.unlink()
    for path, compute in wanted.items():
        path.write_text(text(plain(compute())) + "\n", encoding="utf-8")
        print(f"{path.relative_to(FOLDER)}: {path.stat().st_size / 1000:.0f} kB", file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1:])
