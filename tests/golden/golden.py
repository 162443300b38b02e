"""The golden record: what must not move unless somebody means it.

``python tests/golden/golden.py [NAME...]`` rewrites what has changed by more than rounding; with
``--moves [FOLDER]`` it prints how far each part is from the one in another ``tests/golden``, and
exits with 1 if one has moved. Laws from the literature are left out.

``runs/NAME.json`` holds, of 2 s of each shipped scenario with its own controller (and of some with
every law), the record's variables at every 20th sample, its metrics, names, dimensions and units,
the panels of its report and the rows of its table. ``interface.json`` holds the columns of
campaigns, ``schema.json`` what ``ffsm schema`` prints.

``sensitivity/NAME.json`` holds how far rounding moves each of these numbers, by
``python tests/golden/sensitivity.py [NAME...]``. A number may move a hundred times as far. What
may then move by more than a ten-thousandth of its variable is not compared: long and diverging
runs are compared by their early samples and by those of their metrics that rounding leaves alone.
"""

import dataclasses
import importlib
import json
import math
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from click.testing import CliRunner
from last_bits import with_other_last_bits

from ffsm_drake import FfsmError, RunRecord, load_scenario, simulate
from ffsm_drake.cli import main as ffsm
from ffsm_drake.common.registrations import plugin_of
from ffsm_drake.scenario import scenario_to_dict, shipped_scenarios
from ffsm_drake.show.results import results_of
from ffsm_drake.systems.registry import FACTORIES, shipped_names

FOLDER = Path(__file__).parent
RUNS = FOLDER / "runs"
EVERY = 20  # control samples
# Of these scenarios every law runs.
WITH_EVERY_LAW = ("postcapture", "flight_sensors", "tumbling_capture", "free_floating")
BASELINES = {
    name
    for name, offer in FACTORIES["controller"].offers().items()
    if plugin_of(offer.module) in ("baselines", "zero_reaction")
}
DURATION = "duration=2"
# A short approach, mild enough to be followed.
_SHORT_APPROACH = (
    "capture.approach.duration=1",
    "capture.approach.posture.joints={joint_1: 0.16, joint_2: 0.37, joint_3: 1.04, joint_4: "
    "0.58, joint_5: -0.69}",
)
SHORTENED = {
    "tumbling_capture": _SHORT_APPROACH,
    "capture_on_thrusters": _SHORT_APPROACH,
    "two_arms_detumble": (
        "capture.approach=null",
        "contacts.right.closes=1",
        "faults.events.drawn.time=[0, 1]",
    ),
}
_SMALLEST_CAMPAIGN = {
    "controllers": ["tdc"],
    "cases": 1,
    "parameters": {"payload.truth.mass": {"distribution": "uniform", "low": 90, "high": 110}},
}
# Differences of what should be equal, N s and N m s: their scale is that of what is compared.
BALANCES = ("momentum_residual", "grasp")
FACTOR = 100.0  # of what rounding was seen to move
DIGITS = 1e-12  # relative; to so many are numbers kept
COARSE = 1e-4  # of a variable's largest: a number that may move so far is not compared
ANY = "any"  # in place of a move: no bound was seen


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
    shown = results_of([record])
    sections = {
        **time.run_views(shown),
        **{
            title.lower().partition(" ")[0]: parts.part_views(shown, title)
            for title in parts.part_sections(shown)
        },
    }
    panels = [
        f"{section} / {view.label} / {chart.title} [{chart.label_y}]: {len(chart.curves)}"
        for section, views in sections.items()
        for view in views
        for chart in view.charts
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


def run(scenario: str, controller: str | None = None, *, seed: int | None = None) -> RunRecord:
    """A run of the golden record; with a seed, one whose last bits are changed."""
    overrides = [*SHORTENED.get(scenario, ()), DURATION]
    if controller is not None:
        overrides.append(f"controller={controller}")
    given = load_scenario(scenario, overrides)
    if seed is not None:
        given = with_other_last_bits(given, seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of unstable laws, which are part of it
        return simulate(given, check_stability=False)


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
    found = all_results(scenario, own)
    reference = found[own.scenario.controller]["samples"]
    for controller, of_law in found.items():
        if controller != own.scenario.controller and "samples" in of_law:
            of_law["samples"] = {
                name: "as above" if values == reference.get(name) else values
                for name, values in of_law["samples"].items()
            }
    return {"outline": outline(own), "runs": found}


def all_results(scenario: str, own: RunRecord, *, seed: int | None = None) -> dict[str, Any]:
    """The numbers of a scenario's runs, by controller; ``own`` is the run of its own."""
    found = {own.scenario.controller: results(own)}
    for controller in shipped_names("controller") if scenario in WITH_EVERY_LAW else ():
        if controller not in found and controller not in BASELINES:
            try:
                found[controller] = results(run(scenario, controller, seed=seed))
            except FfsmError as error:
                found[controller] = {"refused": str(error)}
    return found


def interface() -> dict[str, Any]:
    """The columns of the shipped campaigns, and of campaigns over the shipped scenarios."""
    spec, store = (
        importlib.import_module(f"ffsm_drake.plugins.campaign.{name}") for name in ("spec", "store")
    )
    specs = {f"campaign {name}": spec.load_spec(name) for name in spec.shipped_campaigns()}
    for name in names():
        base = scenario_to_dict(load_scenario(name))
        specs[f"scenario {name}"] = spec.spec_from_data({**_SMALLEST_CAMPAIGN, "base": base})
    compiled = {name: dataclasses.replace(each, engine="compiled") for name, each in specs.items()}
    return {name: list(store.result_columns(each)) for name, each in compiled.items()}


def differences(
    found: Any, expected: Any, moved: Any, place: str = "", *, scale: float = 0.0
) -> Iterator[str]:
    """Where two trees differ by more than rounding explains, one line each.

    Args:
      found, expected: what JSON can hold.
      moved: how far rounding moves their numbers: a tree as ``moves_between`` makes it.
      place: where in the tree they stand.
      scale: the largest number of the outermost list that holds them.
    """
    if moved == ANY:
        return
    if isinstance(found, dict) and isinstance(expected, dict):
        for key in [*expected, *(key for key in found if key not in expected)]:
            if key not in found or key not in expected:
                yield f"{place}.{key}: {'is new' if key in found else 'is gone'}"
            else:
                of_key = moved.get(key) if isinstance(moved, dict) else None
                least = max(scale, 1.0) if key in BALANCES else scale
                yield from differences(
                    found[key], expected[key], of_key, f"{place}.{key}", scale=least
                )
    elif _is_number(found) and _is_number(expected):
        allowed, scale = allowance(expected, moved, scale)
        if allowed <= COARSE * scale and not abs(found - expected) <= allowed:  # NaN too
            yield f"{place}: {found!r}, not {expected!r} within {allowed:.2g}"
    elif isinstance(found, list) and isinstance(expected, list) and len(found) == len(expected):
        scale = max([scale, *map(abs, numbers(expected))])
        for index, (one, other) in enumerate(zip(found, expected, strict=True)):
            of_one = moved[index] if isinstance(moved, list) else moved
            yield from differences(one, other, of_one, f"{place}[{index}]", scale=scale)
    elif found != expected:
        yield f"{place}: {found!r:.200}, not {expected!r:.200}"


def allowance(expected: float, moved: float | None, scale: float) -> tuple[float, float]:
    """How far a number may be from what is expected, and the scale that it belongs to."""
    scale = max(scale, abs(expected))
    return FACTOR * (moved or 0.0) + DIGITS * scale, scale


def moves_between(one: Any, other: Any) -> Any:
    """How far apart two trees are: numbers for numbers, and for a list of lists one number each.

    None: equal; ANY: they cannot be compared, such as lists of two lengths.
    """
    if one == other:
        return None
    if isinstance(one, dict) and isinstance(other, dict):
        keys = [*one, *(key for key in other if key not in one)]
        found = {key: moves_between(one.get(key), other.get(key)) for key in keys}
        return {key: move for key, move in found.items() if move is not None}
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        return [_largest(moves_between(*rows)) for rows in zip(one, other, strict=True)]
    if _is_number(one) and _is_number(other) and math.isfinite(one - other):
        return abs(one - other)
    return ANY


def further_moves(one: Any, other: Any) -> Any:
    """The larger of two moves of the same tree."""
    if one is None or other is None:
        return other if one is None else one
    if isinstance(one, dict) and isinstance(other, dict):
        keys = [*one, *(key for key in other if key not in one)]
        return {key: further_moves(one.get(key), other.get(key)) for key in keys}
    if isinstance(one, list) and isinstance(other, list):
        return [further_moves(*pair) for pair in zip(one, other, strict=True)]
    return ANY if ANY in (one, other) else max(one, other)


def _largest(move: Any) -> float | str | None:
    if isinstance(move, dict):
        move = list(move.values())
    if isinstance(move, list):
        known = [each for each in map(_largest, move) if each is not None]
        return ANY if ANY in known else max(known, default=None)
    return move


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def numbers(tree: Any) -> Iterator[float]:
    """All numbers of nested lists."""
    if isinstance(tree, list):
        for item in tree:
            yield from numbers(item)
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


def sensitivity_of(name: str) -> Path:
    """The file of how far rounding moves a part of the golden record."""
    return FOLDER / "sensitivity" / f"{name}.json"


def changes(path: Path, found: Any) -> list[str]:
    """Where a part of the golden record differs by more than rounding explains.

    Args: its file; what was computed, as JSON gives it back.
    """
    moved = sensitivity_of(path.stem)
    return list(differences(found, read(path), read(moved) if moved.is_file() else None))


def as_stored(found: Any, expected: Any, moved: Any, *, scale: float = 0.0) -> Any:
    """Return a computed tree, with the stored one wherever rounding explains the difference, in the
    order of the stored one. A rewritten file then shows only what is new.
    """
    if isinstance(found, dict) and isinstance(expected, dict):
        of_key = moved if isinstance(moved, dict) else {}
        return {
            key: as_stored(
                found[key],
                expected.get(key),
                of_key.get(key),
                scale=max(scale, 1.0) if key in BALANCES else scale,
            )
            for key in dict.fromkeys([*expected, *found])
            if key in found
        }
    if moved == ANY or any(differences(found, expected, moved, scale=scale)):
        return found
    return expected


def moves(folder: Path) -> int:
    """Print the largest difference of each part from the golden record in a folder; 0: equal."""
    has_moved = False
    for path, compute in files().items():
        before = folder / path.relative_to(FOLDER)
        known = read(before) if before.is_file() else None
        move = _largest(moves_between(plain(compute()), known))
        print(f"{path.stem}: {move or 0}", flush=True)
        has_moved |= bool(move)
    return int(has_moved)


def main(names_given: Sequence[str] = ()) -> None:
    wanted = {
        path: compute
        for path, compute in files().items()
        if not names_given or path.stem in names_given
    }
    if unknown := set(names_given) - {path.stem for path in wanted}:
        known = (*names(), "interface", "schema")
        sys.exit(f"unknown: {', '.join(sorted(unknown))}; one of {', '.join(known)}")
    RUNS.mkdir(exist_ok=True)
    if not names_given:
        for path in {*RUNS.glob("*.json")} - set(wanted):
            path.unlink()
    for path, compute in wanted.items():
        found, moved = plain(compute()), sensitivity_of(path.stem)
        if path.is_file():
            found = as_stored(found, read(path), read(moved) if moved.is_file() else None)
        path.write_text(text(found) + "\n", encoding="utf-8")
        print(f"{path.relative_to(FOLDER)}: {path.stat().st_size / 1000:.0f} kB", file=sys.stderr)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--moves"]:
        sys.exit(moves(Path(sys.argv[2]) if sys.argv[2:] else FOLDER))
    main(sys.argv[1:])
