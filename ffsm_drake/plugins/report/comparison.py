# ruff: noqa: RUF001 (the texts use mathematical signs)
"""The result table and the rankings of one run or several."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.common.numbers import NONE, number, percent
from ffsm_drake.runs.exceeded_limits import run_clearance, saturation
from ffsm_drake.runs.judge import JUDGES
from ffsm_drake.runs.metrics import METRICS, SIZES, drift_metrics, frame_figures, of_group
from ffsm_drake.runs.tracking import tracked_of
from ffsm_drake.show.results import Result, actuators_act, ranking
from ffsm_drake.show.style import EFFORT_UNITS, GROUP_TITLES
from ffsm_drake.show.tables import ranked_figures, size_of
from ffsm_drake.systems.parts.metrics import Figure, Metric

# Metric -> its row, the title of its ranking, and digits, where its label does not suffice.
_TITLES = {
    "itae": ("Accuracy, ITAE", "By accuracy (ITAE)", 4),
    "isv": ("Effort, ISV", "By effort (ISV)", 5),
}
_MAGNITUDES = {
    "peak_effort": "Peak commanded force or torque",
    "peak_applied": "Peak applied force or torque",
}
_PARTS = {"rotation": ("Attitude", "rad"), "position": ("Position", "m")}
_MOVED = {
    "error of the frame": frame_figures,
    "drift of the base from its start": drift_metrics,
}
_TIMES = {"advance_to": "Wall time, simulation", "total": "Total wall time"}


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
        Row(label, _compared(results, size, digits=digits), metric.shown_unit)
        if metric.ranked
        else _row(label, map(size, results), metric.shown_unit, digits=digits)
        for metric, size, (label, _, digits) in _metrics()
    ]
    if distances is not None:
        rows.append(_row("Error over the least possible", distances, digits=3))
    rows += _magnitude_rows(results)
    shares = [saturation(result.record) for result in results]
    head = "Samples at the limit of the actuators"
    for name in dict.fromkeys(name for share in shares for name in share):
        cells = [Cell(percent(share.get(name, 0.0))) for share in shares]
        rows.append(Row(name.replace("_", " "), cells, head=head))
    for what, figures_of in _MOVED.items():
        found = [figures_of(result.record.dataset) for result in results]
        for moment in ("largest", "final"):
            sizes = [figures.get(moment, {}) for figures in found]
            head = f"{moment.capitalize()} {what}"
            for key in dict.fromkeys(key for each in sizes for key in each):
                label, unit = _PARTS[key.removeprefix("base_")]
                rows.append(_row(label, [each.get(key) for each in sizes], unit, head=head))
    rows += _part_rows(results)
    times = [Cell(f"{result.record.outcome.time:g}") for result in results]
    rows.append(Row("Simulated time", times, unit="s", head="Computation"))
    for key, label in _TIMES.items():
        seconds = [result.record.wall_time.get(key) for result in results]
        rows.append(_row(label, seconds, "s", head="Computation", digits=3))
    return [
        dataclasses.replace(row, head="" if row.head == above.head else row.head)
        for above, row in itertools.pairwise([Row("", []), *rows])
    ]


def _metrics() -> Iterator[tuple[Metric, Callable[[Result], float], tuple[str, str, int]]]:
    """The metrics of every run with a row of their own, which are those with a key and a label: the
    metric, its value in a run in the unit that is shown, and its texts as in _TITLES.
    """
    for metric in METRICS:
        if metric.key and metric.label:
            label = metric.label[0].upper() + metric.label[1:]
            unit = f" ({metric.shown_unit})" if metric.shown_unit else ""
            texts = (label, f"By {metric.label}{unit}", 4)
            size = functools.partial(_size, metric)
            yield metric, size, _TITLES.get(metric.key, texts)


def _size(metric: Metric, result: Result) -> float:
    return metric.factor * result.figure(metric.of)


def _row(
    label: str, values: Iterable[float | None], unit: str = "", *, head: str = "", digits: int = 4
) -> Row:
    return Row(label, [Cell(number(value, digits)) for value in values], unit, head)


def _magnitude_rows(results: Sequence[Result]) -> list[Row]:
    """Largest and final sizes by group and unit."""
    kinds = list(dict.fromkeys(kind for result in results for kind in result.kinds))
    groups, rows = [group for group, _ in kinds], []
    untracked, act = _untracked(results), actuators_act(results)
    for field, (group, unit) in itertools.product(SIZES, kinds):
        if field == "peak_applied" and not act:
            continue
        head = _MAGNITUDES.get(field, field.replace("_", " ").capitalize())
        label, is_force = GROUP_TITLES.get(group, group), SIZES[field].endswith("force")
        if groups.count(group) > 1:
            label += f", {'revolute' if unit == 'rad' else 'prismatic'}"
        if group in untracked and not is_force:
            label += ", not tracked"
        size = functools.partial(of_group, field, group, unit=unit)
        sizes = (result.figure(size) for result in results)
        shown = EFFORT_UNITS.get(unit, unit) if is_force else unit
        rows.append(_row(label, sizes, shown, head=head))
    return rows


def _untracked(results: Sequence[Result]) -> set[str]:
    """Groups whose errors no run is judged by: nothing drives them, or a frame is tracked in their
    place.
    """
    groups = {group for result in results for group, _ in result.kinds}
    for data in (result.record.dataset for result in results):
        if "error" in data:
            tracked = np.isin(data["coordinate"].values, tracked_of(data).names)
            groups -= set(data["group"].values[tracked].astype(str).tolist())
    return groups


def _part_rows(results: Sequence[Result]) -> list[Row]:
    """The figures of the parts of any run: under the name of the part, those by name under their
    own.
    """
    found = [
        {(each.part, each.key, each.label, each.unit): each for each in result.record.figures}
        for result in results
    ]
    rows = []
    for place in dict.fromkeys(place for figures in found for place in figures if place[2]):
        of_runs = [figures.get(place) for figures in found]
        figure = next(each for each in of_runs if each is not None)
        names = dict.fromkeys(
            name
            for each in of_runs
            if each is not None and isinstance(each.value, Mapping)
            for name in each.value
        )
        for name in names or ("",):
            cells = [Cell(NONE if each is None else each.text(name)) for each in of_runs]
            if figure.ranked:
                cells = _compared(results, functools.partial(size_in, figure), digits=4)
            label = name.replace("_", " ") or figure.label
            head = figure.label if names else figure.part
            rows.append(Row(label, cells, figure.shown_unit, head))
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
    return [
        Cell(
            number(value := figure(one), digits),
            "partial" if not one.comparable else "best" if value == best else "",
        )
        for one in results
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
    sentences, judge = list[str](), JUDGES.first()
    for result in results:
        name = f"{result.label}: " if len(results) > 1 else ""
        try:
            if judge is not None:
                remarks = judge.remarks(result.record.mission)
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
    figures = [
        (title, size, digits) for metric, size, (_, title, digits) in _metrics() if metric.ranked
    ]
    for first in ranked_figures([result.record for result in results]):
        size = functools.partial(size_in, first)
        if any(math.isfinite(size(result)) for result in results):
            figures.append((f"By {first.label.lower()} ({first.shown_unit})", size, 4))
    return [
        {"title": title, "entries": list(_ranked(ranking(results, figure), figure, digits))}
        for title, figure, digits in figures
    ]


def _ranked(
    ranked: Sequence[Result], figure: Callable[[Result], float], digits: int
) -> Iterator[dict[str, Any]]:
    """The entries of a ranking."""
    best = figure(ranked[0])
    for place, result in enumerate(ranked, start=1):
        value, outcome = figure(result), result.record.outcome
        if _placed(result, figure):
            times = _times(value / best) if place > 1 and best > 0.0 else ""
            yield {"place": place, "result": result, "text": number(value, digits), "times": times}
        else:
            ended = f"{outcome.status} at {outcome.time:.2f} s"
            text = "not recorded" if result.comparable else ended
            yield {"place": "–", "result": result, "text": text, "times": ""}


def _times(ratio: float) -> str:
    return f"{ratio:.2f} ×" if ratio < 100.0 else f"{ratio:,.0f} ×"
