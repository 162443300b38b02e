"""Numbers and tables as plain text, and the tables' figures as plain data."""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ffsm_drake.common.numbers import NONE
from ffsm_drake.runs.metrics import METRICS
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.show.table_files import Column
from ffsm_drake.systems.grasping import GRASPINGS
from ffsm_drake.systems.parts.metrics import Figure

_DIGITS = {"itae": 4, "isv": 5}


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table: the first column to the left, all others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]

    def line(first: str, *rest: str) -> str:
        cells = [
            first.ljust(widths[0]),
            *(cell.rjust(w) for cell, w in zip(rest, widths[1:], strict=True)),
        ]
        return "  ".join(cells).rstrip()

    return [line(*row) for row in rows]


def results_columns(
    records: Sequence[RunRecord], distances: Sequence[float] | None = None
) -> list[Column]:
    """Return the figures of merit, a row for each run; ``distances`` to the LQG limit, if known."""
    columns = [
        Column(name="controller", cells=[record.scenario.controller for record in records]),
        *(
            Column(
                name=metric.label,
                unit=metric.shown_unit,
                cells=[metric.of(record.dataset) for record in records],
                digits=_DIGITS.get(metric.key, 3),
            )
            for metric in METRICS
            if metric.label
        ),
    ]
    columns = [each for each in columns if set(each.cells) != {None}]  # no joints of this kind
    for first in ranked_figures(records):
        sizes = [size_of(record, first) for record in records]
        columns.append(
            Column(name=first.label.lower(), unit=first.shown_unit, cells=sizes, digits=4)
        )
    if distances is not None:
        columns.append(Column(name="over LQG", cells=distances))
    return columns


def results_table(records: Sequence[RunRecord], distances: Sequence[float] | None = None) -> str:
    """Return the table of ``results_columns`` as plain text, a line per run, and notes below it."""
    columns = results_columns(records, distances)
    cells = [
        [column.name, column.unit, *(_cell(cell, column.digits) for cell in column.cells)]
        for column in columns
    ]
    lines = aligned(list(zip(*cells, strict=True)))
    for k, record in enumerate(records, start=2):
        if not record.outcome.completed:
            lines[k] += f"  ({record.outcome.status} at {record.outcome.time:.2f} s)"
    return "\n".join(lines + list(_result_notes(records)))


def _cell(cell: str | float | None, digits: int) -> str:
    if isinstance(cell, str):
        return cell
    return NONE if cell is None or math.isnan(cell) else f"{cell:.{digits}g}"


def _result_notes(records: Sequence[RunRecord]) -> Iterator[str]:
    """The lines below the table of results."""
    if not all(
        record.dataset["generalized_force"].equals(record.dataset["applied_force"])
        for record in records
    ):
        yield "forces and ISV as commanded; the applied forces differ, see the report"
    names = [f"{record.scenario.controller}: " if len(records) > 1 else "" for record in records]
    if (grasping := GRASPINGS.first()) is not None:
        pairs = zip(names, (record.grasp for record in records), strict=True)
        yield from grasping.lines([(name, grasp) for name, grasp in pairs if grasp is not None])
    for name, record in zip(names, records, strict=True):
        sentences = (part.sentence for part in record.parts if part.sentence)
        for line in (*frame_lines(record), *drift_lines(record), *sentences):
            yield name + line


def ranked_figures(records: Sequence[RunRecord]) -> list[Figure]:
    """Return figures of parts for the ranking of runs, from the first run with each."""
    found = {
        (figure.part, figure.key): figure
        for record in reversed(records)
        for figure in record.figures
        if figure.ranked
    }
    return list(found.values())


def size_of(record: RunRecord, figure: Figure) -> float:
    """Return a figure of another run in this one, in the unit that it is shown in; NaN if there is
    none.
    """
    same = (each for each in record.figures if (each.part, each.key) == (figure.part, figure.key))
    return next((each.size for each in same), math.nan)


def frame_lines(record: RunRecord) -> list[str]:
    """Distance of the frame from its reference, and time near a singularity; a line each."""
    figures, goal = record.metrics.get("frame"), record.scenario.reference.frame
    if not figures:
        return []
    name = record.scenario.model.end_effector if goal is None or goal.frame is None else goal.frame
    final, largest = _final_and_largest(figures)
    lines = [f"the frame {name} ends {final} from its reference (at most {largest})"]
    gains = record.scenario.gains
    smallest, damping = (
        figures.get("smallest_singular_value"),
        (gains.get("damping") or {}).get("all", 0.0),
    )
    if smallest is not None and smallest < damping:
        near = record.dataset["smallest_singular_value"].values < damping
        lines.append(
            f"near a dynamic singularity for {near.sum() * record.scenario.sample_time:.3g} s: the "
            f"smallest singular value is {smallest:.2g}; below {damping:g} the frame lags its "
            "reference"
        )
    return lines


def drift_lines(record: RunRecord) -> list[str]:
    """Drift of the undriven base, in one line; none where everything is driven."""
    drift = record.metrics.get("drift")
    if not drift:
        return []
    final, largest = _final_and_largest(drift)
    return [f"undriven base: final drift {final} (at most {largest})"]


def _final_and_largest(figures: Mapping[str, Any]) -> Iterator[str]:
    """The final and the largest sizes (rad, m) of figures by part, in words."""
    for moment in ("final", "largest"):
        yield " and ".join(
            f"{180.0 / math.pi * size:.4g} deg" if "rotation" in part else f"{1e3 * size:.4g} mm"
            for part, size in sorted(figures[moment].items())
        )


def results_data(
    records: Sequence[RunRecord], distances: Sequence[float] | None = None
) -> list[dict[str, Any]]:
    """Return the results of the table above as plain data."""
    columns = (
        [{}] * len(records)
        if distances is None
        else [{"distance_to_lqg": distance} for distance in distances]
    )
    return [
        {
            "controller": record.scenario.controller,
            "status": record.outcome.status,
            "time": record.outcome.time,
            "message": record.outcome.message,
            "ending": dataclasses.asdict(record.ending),
            "metrics": record.metrics,
            **({} if record.grasp is None else {"grasp": record.grasp}),
            **distance,
        }
        for record, distance in zip(records, columns, strict=True)
    ]
