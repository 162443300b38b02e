# ruff: noqa: RUF001 (the texts use mathematical signs)
"""The result table and the rankings of one run or several."""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.common.numbers import NONE, number, percent
from ffsm_drake.common.plugins import SERVICES, optional
from ffsm_drake.runs.limits import run_clearance, saturation
from ffsm_drake.runs.metrics import drift_metrics, frame_figures
from ffsm_drake.runs.tracking import tracked_of
from ffsm_drake.show.results import Result, actuators_act, ranking
from ffsm_drake.show.style import EFFORT_UNITS, GROUP_TITLES
from ffsm_drake.show.tables import ranked_figures, size_of
from ffsm_drake.systems.part import Figure

_MAGNITUDES = {
    "peak_error": "Peak error",
    "final_error": "Final error",
    "peak_effort": "Peak commanded force or torque",
}
_APPLIED = {"peak_applied": "Peak applied force or torque"}


@dataclasses.dataclass(frozen=True)
class Cell:
    """One figure of the result table."""

    text: str
    kind: str = ""  # "best", "partial" or nothing


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of the result table, a cell for each run."""

    label: str
    cells: list[Cell]
    unit: str = ""
    head: str = ""  # a heading above the line


def table(results: Sequence[Result], distances: Sequence[float] | None = None) -> list[Row]:
    """The figures of merit, magnitudes and times, a column for each run; ``distances`` to the LQG
    limit, if known.
    """
    rows = [
        Row("Accuracy, ITAE", _compared(results, operator.attrgetter("itae"), digits=4)),
        Row("Effort, ISV", _compared(results, operator.attrgetter("isv"), digits=5)),
    ]
    if distances is not None:
        rows.append(
            Row(
                "Error over the least possible",
                [Cell(number(distance, 3)) for distance in distances],
            )
        )
    kinds = list(dict.fromkeys(kind for result in results for kind in result.magnitudes))
    groups = [group for group, _ in kinds]
    shares = [saturation(result.record) for result in results]
    untracked = _untracked(results)
    for field, head in (_MAGNITUDES | (_APPLIED if actuators_act(results) else {})).items():
        for k, (group, unit) in enumerate(kinds):
            kind = (
                f", {'revolute' if unit == 'rad' else 'prismatic'}"
                if groups.count(group) > 1
                else ""
            )
            found = [result.magnitudes.get((group, unit), {}) for result in results]
            cells = [Cell(number(each.get(field))) for each in found]
            is_force = field in ("peak_effort", "peak_applied")
            shown = EFFORT_UNITS.get(unit, unit) if is_force else unit
            kind += ", not tracked" if group in untracked and not is_force else ""
            rows.append(
                Row(
                    GROUP_TITLES.get(group, group) + kind, cells, unit=shown, head="" if k else head
                )
            )
    for k, name in enumerate(dict.fromkeys(name for share in shares for name in share)):
        cells = [Cell(percent(share.get(name, 0.0))) for share in shares]
        rows.append(
            Row(
                name.replace("_", " "),
                cells,
                head="" if k else "Samples at the limit of the actuators",
            )
        )
    rows += _of_frame(results)
    rows += _of_drift(results)
    rows += _part_rows(results)
    simulated = [Cell(f"{result.record.outcome.time:g}") for result in results]
    rows.append(Row("Simulated time", simulated, unit="s", head="Computation"))
    for label, key in (("Wall time, simulation", "advance_to"), ("Total wall time", "total")):
        cells = [Cell(number(result.record.wall_time.get(key), 3)) for result in results]
        rows.append(Row(label, cells, unit="s"))
    return rows


def _untracked(results: Sequence[Result]) -> set[str]:
    """Groups whose errors no run is judged by: nothing drives them, or a frame is tracked in their
    place.
    """
    groups = {group for result in results for group, _ in result.magnitudes}
    for data in (result.record.dataset for result in results):
        if "error" not in data:
            continue
        by_coordinate = dict(
            zip(
                data["coordinate"].values.astype(str), data["group"].values.astype(str), strict=True
            )
        )
        groups -= {by_coordinate[name] for name in tracked_of(data).names if name in by_coordinate}
    return groups


def _of_frame(results: Sequence[Result]) -> list[Row]:
    """Distance of the tracked frame from its reference; empty if no run tracks one."""
    found = [frame_figures(result.record.dataset) for result in results]
    return _by_moment(
        found, "error of the frame", (("rotation", "attitude", "rad"), ("position", "", "m"))
    )


def _of_drift(results: Sequence[Result]) -> list[Row]:
    """Drift of the undriven base."""
    parts = (("base_rotation", "attitude", "rad"), ("base_position", "", "m"))
    found = [drift_metrics(result.record.dataset) for result in results]
    return _by_moment(found, "drift of the base from its start", parts)


def _by_moment(
    found: Sequence[Mapping[str, Any]], what: str, parts: Sequence[tuple[str, str, str]]
) -> list[Row]:
    """Rows of ``largest`` and ``final`` sizes by part (key, name, unit), which not every run
    has.
    """
    rows = []
    for moment in ("largest", "final"):
        of_moment = [figures.get(moment, {}) for figures in found]
        kept = [part for part in parts if any(part[0] in each for each in of_moment)]
        for k, (key, name, unit) in enumerate(kept):
            cells = [Cell(number(each.get(key))) for each in of_moment]
            head = "" if k else f"{moment.capitalize()} {what}"
            rows.append(
                Row((name or key.rpartition("_")[2]).capitalize(), cells, unit=unit, head=head)
            )
    return rows


def _part_rows(results: Sequence[Result]) -> list[Row]:
    """The figures of the parts of any run: under the name of the part, those by name under their
    own.
    """
    found = [
        {(each.part, each.key, each.label, each.unit): each for each in result.record.figures}
        for result in results
    ]
    rows, above = [], ""
    for place in dict.fromkeys(place for figures in found for place in figures if place[2]):
        of_runs = [figures.get(place) for figures in found]
        figure = next(each for each in of_runs if each is not None)
        names = dict.fromkeys(
            name
            for each in of_runs
            if each is not None and isinstance(each.value, Mapping)
            for name in each.value
        )
        head = figure.label if names else figure.part
        for name in names or ("",):
            cells = [Cell(NONE if each is None else each.text(name)) for each in of_runs]
            if figure.ranked:
                cells = _compared(results, functools.partial(size_in, figure), digits=4)
            label = name.replace("_", " ") or figure.label
            shown = "" if head == above else head
            rows.append(Row(label, cells, unit=figure.shown_unit, head=shown))
            above = head
    return rows


def size_in(figure: Figure, result: Result) -> float:
    """A figure of any run in another; as ``size_of``."""
    return size_of(result.record, figure)


def _compared(
    results: Sequence[Result], figure: Callable[[Result], float], *, digits: int
) -> list[Cell]:
    """A sum over each run; the least of several completed ones is marked."""
    completed = [figure(result) for result in results if _placed(result, figure)]
    best = min(completed) if len(completed) > 1 else None
    kinds = [
        "partial" if not one.comparable else "best" if figure(one) == best else ""
        for one in results
    ]
    return [
        Cell(number(figure(result), digits), kind)
        for result, kind in zip(results, kinds, strict=True)
    ]


def _placed(result: Result, figure: Callable[[Result], float]) -> bool:
    return result.comparable and math.isfinite(figure(result))


def table_notes(results: Sequence[Result], distances: Sequence[float] | None = None) -> list[str]:
    """The meaning of the table's sums, and which of them cannot be compared."""
    notes = [
        *_limits_left(results),
        "ITAE is the sum of t |e|₁ L, ISV the sum of |τ|₂² L over the control samples, τ as "
        "commanded; less is better.",
    ]
    if distances is not None:
        notes.append(
            "Error over the least possible: the error divided by the error of the LQG controller, "
            "the best linear controller of the same effort under the same noise. The required "
            "force is modelled as a random walk. A dash: the loop is unstable or cannot be "
            "linearised, the controller tracks a frame, or a user-supplied block senses."
        )
    if not all(result.comparable for result in results):
        notes.append(
            "In italics: sums over a run that ended early, up to its end only. They do not "
            "compare with those of "
            "completed runs, however small."
        )
    if len({result.record.outcome.time for result in results if result.comparable}) > 1:
        notes.append("The completed runs differ in length, so their sums do not compare directly.")
    return notes


def _limits_left(results: Sequence[Result]) -> list[str]:
    """The limits of the models exceeded by the plans, and the nearest parts, or the reason for a
    missing comparison; a sentence each.
    """
    sentences, plan_remarks = list[str](), optional(SERVICES, "plan_remarks")
    for result in results:
        name = f"{result.label}: " if len(results) > 1 else ""
        try:
            if plan_remarks is not None:
                remarks = plan_remarks(result.record.scenario)
                sentences += [f"Plan: {remark}." for remark in remarks]
            sentences += [
                f"{name}Nearest to each other: {closest}."
                for closest in run_clearance(result.record)
            ]
        except (FfsmError, KeyError) as error:
            # an unloadable model, a missing variable
            sentences.append(f"{name}Limits of the model not compared: {one_line(error)}.")
    return list(dict.fromkeys(sentences))


def rankings(results: Sequence[Result]) -> list[dict[str, Any]]:
    """The runs by accuracy and by effort: place, value, and how many times the best one's value
    that is.
    """
    made = []
    figures: list[tuple[str, Callable[[Result], float], int]] = [
        ("By accuracy (ITAE)", operator.attrgetter("itae"), 4),
        ("By effort (ISV)", operator.attrgetter("isv"), 5),
    ]
    for first in ranked_figures([result.record for result in results]):
        size = functools.partial(size_in, first)
        if any(math.isfinite(size(result)) for result in results):
            figures.append((f"By {first.label.lower()} ({first.shown_unit})", size, 4))
    for title, figure, digits in figures:
        ranked = ranking(results, figure)
        entries = []
        for place, result in enumerate(ranked, start=1):
            value, best = figure(result), figure(ranked[0])
            if _placed(result, figure):
                times = _times(value / best) if place > 1 and best > 0.0 else ""
                entries.append(
                    {
                        "place": place,
                        "result": result,
                        "text": number(value, digits),
                        "times": times,
                    }
                )
            else:
                outcome = result.record.outcome
                text = (
                    "not recorded"
                    if result.comparable
                    else (f"{outcome.status} at {outcome.time:.2f} s")
                )
                entries.append({"place": "–", "result": result, "text": text, "times": ""})
        made.append({"title": title, "entries": entries})
    return made


def _times(ratio: float) -> str:
    return f"{ratio:.2f} ×" if ratio < 100.0 else f"{ratio:,.0f} ×"
