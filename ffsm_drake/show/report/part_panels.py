"""The report's panels of parts: a view for each signal, a panel for each of its components."""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.numbers import number
from ffsm_drake.show.panels import Panel, Thinning, View, escape, time_panel
from ffsm_drake.show.report.results import Result
from ffsm_drake.show.report.time_panels import run_curve
from ffsm_drake.systems.part import TIMELINE, Drawing, PartRecord, pulses_of

_MOST_BOXES = 20_000  # of one run that are drawn one by one
_BOX = (-0.2, 0.2, 0.2, -0.2, -0.2)  # of a row's height


def part_sections(results: Sequence[Result]) -> dict[str, PartRecord]:
    """The sections of the report that parts of any run ask for; each with one of its parts."""
    return {
        part.section: part
        for result in results
        for part in result.record.parts
        if any(drawing.signal in result.record.dataset for drawing in part.drawings)
    }


def part_views(results: Sequence[Result], thin: Thinning, section: str) -> list[View]:
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
            panels=_timelines(results, drawn)
            if drawn[0][1].chart == TIMELINE
            else _curves(results, thin, drawn),
        )
        for (_, heading), drawn in having.items()
    ]


def part_text(results: Sequence[Result], section: str, about: str) -> str:
    """What a section is about, or the sentences of its parts."""
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
    """Of each run the tables of the parts of a section, as text, and what they go by."""
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


def _curves(
    results: Sequence[Result], thin: Thinning, drawn: Sequence[tuple[int, Drawing]]
) -> list[Panel]:
    """A panel for each component that is drawn."""
    units = {name: unit for _, drawing in drawn for name, unit in drawing.panels.items()}
    traces: dict[str, list[Any]] = {name: [] for name in units}
    for i, drawing in drawn:
        data = results[i].record.dataset
        values, time = data[drawing.signal].values, data["time"].values
        columns = dict.fromkeys(drawing.panels, values)
        if values.ndim == 2:
            names = data[data[drawing.signal].dims[1]].values.astype(str).tolist()
            columns = dict(zip(names, values.T, strict=True))
        for name in drawing.panels:
            curve = run_curve(results, i, thin(time, columns[name]), shape=drawing.chart)
            traces[name].append(curve)
    return [time_panel(name.replace("_", " "), units[name], traces[name]) for name in units]


def _timelines(results: Sequence[Result], drawn: Sequence[tuple[int, Drawing]]) -> list[Panel]:
    """A panel per run: a row for each component, a box for each time that it is on."""
    panels = []
    for i, drawing in drawn:
        data, period = results[i].record.dataset, results[i].record.scenario.sample_time
        time, values = (
            data["time"].values,
            data[drawing.signal].values.reshape(-1, len(drawing.panels)),
        )
        names = list(drawing.panels)
        boxes = functools.partial(_boxes, time, period, _MOST_BOXES // len(names))
        look = {
            "width": 1.0,
            "hovertemplate": "%{x:.2f} s",
            "connectgaps": False,
            "fill": "toself",
            "hoveron": "points",
        }
        traces = [
            run_curve(results, i, boxes(column, row), name=names[row], **look) | {"mode": "lines"}
            for row, column in enumerate(values.T)
        ]
        title = results[i].label if len(results) > 1 else drawing.title
        panel = time_panel(title, "", traces)
        panel.figure.update_layout(hovermode="closest")
        panel.figure.update_xaxes(range=[float(time[0]), float(time[-1]) + period])
        panel.figure.update_yaxes(
            tickvals=list(range(len(names))), ticktext=[escape(name) for name in names],
            range=[len(names) - 0.4, -0.6], showgrid=False, zeroline=False,
        )  # fmt: skip
        panels.append(
            Panel(title=panel.title, figure=panel.figure, kind="chart", height=90 + 20 * len(names))
        )
    return panels


def _boxes(
    time: np.ndarray, period: float, most: int, column: np.ndarray, row: int
) -> tuple[np.ndarray, np.ndarray]:
    """Outlines of the boxes of a row, which are seen where they are narrower than a pixel."""
    first, lengths = pulses_of(column, period)
    starts, ends = time[first], time[first] + lengths
    if starts.size > most:  # none is seen alone: those that are near become one
        gap = 2.0 * (time[-1] - time[0]) / most
        apart = np.flatnonzero(starts[1:] - ends[:-1] > gap)
        starts, ends = starts[np.r_[0, apart + 1]], ends[np.r_[apart, ends.size - 1]]
    x = np.stack([starts, starts, ends, ends, starts, np.full(starts.size, np.nan)], axis=1)
    return x.ravel().astype(np.float32), np.tile(row + np.array([*_BOX, np.nan]), starts.size)
