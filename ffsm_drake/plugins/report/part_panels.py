"""The report's panels of parts: a view for each signal, a panel for each of its components."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.numbers import number
from ffsm_drake.show.chart import Chart, Curve, View
from ffsm_drake.show.results import Result
from ffsm_drake.show.run_charts import run_curve
from ffsm_drake.show.style import Style
from ffsm_drake.systems.parts.record import Drawing, PartRecord
from ffsm_drake.systems.parts.signals import STEPS, TIMELINE, pulses_of

_MOST_BOXES = 20_000  # largest number of boxes of one run drawn one by one
_BOX = (-0.2, 0.2, 0.2, -0.2, -0.2)  # corners, share of a row's height


def part_sections(results: Sequence[Result]) -> dict[str, PartRecord]:
    """The sections of the report that parts of any run ask for; each with one of its parts."""
    return {
        part.section: part
        for result in results
        for part in result.record.parts
        if any(drawing.signal in result.record.dataset for drawing in part.drawings)
    }


def part_views(results: Sequence[Result], section: str) -> list[View]:
    """Views of the signals of the parts of a section, the runs that have them overlaid."""
    having: dict[tuple[str, str], list[tuple[int, Drawing]]] = {}
    for i, result in enumerate(results):
        for part in result.record.parts:
            for drawing in part.drawings if part.section == section else ():
                if drawing.signal in result.record.dataset and drawing.panels:
                    having.setdefault((drawing.signal, drawing.heading), []).append((i, drawing))
    return [
        View(
            label=heading,
            charts=(_timelines if drawn[0][1].chart == TIMELINE else _curves)(results, drawn),
        )
        for (_, heading), drawn in having.items()
    ]


def part_text(results: Sequence[Result], section: str, about: str) -> str:
    """The text of a section, or the sentences of its parts."""
    if about:
        return about
    lines = []
    for result in results:
        name = f"{result.label}: " if len(results) > 1 else ""
        lines += [
            f"{name}{part.sentence[:1].upper()}{part.sentence[1:]}."
            for part in result.record.parts
            if part.section == section and part.sentence
        ]
    return " ".join(lines)


def part_tables(results: Sequence[Result], section: str) -> list[dict[str, Any]]:
    """The tables of a section's parts, as text, for each run, and the headings of their rows."""
    found = []
    for result in results:
        tables = [
            (
                head,
                [
                    [cell if isinstance(cell, str) else _figure(cell) for cell in row]
                    for row in rows
                ],
            )
            for head, *rows in (
                part.table for part in result.record.parts if part.section == section and part.table
            )
        ]
        if tables:
            by = " and ".join(str(head[0]) for head, _ in tables)
            found.append({"result": result, "by": by, "tables": tables})
    return found


def _figure(value: float | None) -> str:
    return str(value) if isinstance(value, int) else number(value)


def _curves(results: Sequence[Result], drawn: Sequence[tuple[int, Drawing]]) -> list[Chart]:
    """A chart for each component that is drawn."""
    units = {name: unit for _, drawing in drawn for name, unit in drawing.panels.items()}
    curves: dict[str, list[Curve]] = {name: [] for name in units}
    for i, drawing in drawn:
        steps = drawing.chart == STEPS
        for name in drawing.panels:
            values = _component(results[i], drawing.signal, name)
            curves[name].append(run_curve(results, i, values, steps=steps))
            curves[name] += _band(results, i, drawing, name)
    return [
        Chart(title=name.replace("_", " "), y=units[name], curves=curves[name]) for name in units
    ]


def _component(result: Result, signal: str, name: str) -> np.ndarray:
    values = result.record.dataset[signal]
    return (values if values.ndim == 1 else values.sel({values.dims[1]: name})).values


def _band(results: Sequence[Result], i: int, drawing: Drawing, name: str) -> list[Curve]:
    """Three standard deviations of a component, both ways, if the run has them: an ``<x>_error``
    has them in ``<x>_deviation``.
    """
    known = drawing.signal.replace("_error", "_deviation")
    if known == drawing.signal or known not in results[i].record.dataset:
        return []
    look: dict[str, Any] = {"width": 0.8, "steps": drawing.chart == STEPS, "opacity": 0.5}
    style, values = Style(results[i].style.color), _component(results[i], known, name)
    return [
        run_curve(results, i, sign * values, name="3 deviations", style=style, **look)
        for sign in (3.0, -3.0)
    ]


def _timelines(results: Sequence[Result], drawn: Sequence[tuple[int, Drawing]]) -> list[Chart]:
    """A chart per run: a row for each component, a box for each time that it is on."""
    shown = []
    for i, drawing in drawn:
        run, names, curves = results[i], list(drawing.panels), []
        period = run.record.scenario.sample_time
        values = run.record.dataset[drawing.signal].values.reshape(-1, len(names))
        for row, (name, column) in enumerate(zip(names, values.T, strict=True)):
            x, y = _boxes(run.time, period, _MOST_BOXES // len(names), column, row)
            label = f"{run.label}, {name}" if len(results) > 1 else name
            style = Style(run.style.color)
            curves.append(Curve(x, y, style, label, width=1.0, filled="toself", run=i))
        shown.append(
            Chart(
                title=run.label if len(results) > 1 else drawing.title, curves=curves,
                kind="chart", rows=names, height=90 + 20 * len(names),
                range_x=(float(run.time[0]), float(run.time[-1]) + period),
            )
        )  # fmt: skip
    return shown


def _boxes(
    time: np.ndarray, period: float, most: int, column: np.ndarray, row: int
) -> tuple[np.ndarray, np.ndarray]:
    """Outlines of the boxes of a row; they stay visible where narrower than a pixel."""
    first, lengths = pulses_of(column, period)
    starts, ends = time[first], time[first] + lengths
    if starts.size > most:  # none is seen alone: those that are near become one
        gap = 2.0 * (time[-1] - time[0]) / most
        apart = np.flatnonzero(starts[1:] - ends[:-1] > gap)
        starts, ends = starts[np.r_[0, apart + 1]], ends[np.r_[apart, ends.size - 1]]
    x = np.stack([starts, starts, ends, ends, starts, np.full(starts.size, np.nan)], axis=1)
    return x.ravel(), np.tile(row + np.array([*_BOX, np.nan]), starts.size)
