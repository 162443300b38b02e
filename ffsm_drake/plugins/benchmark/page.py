"""The benchmark's results: a table, plain data, and a page that opens offline."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any

from ffsm_drake.common.numbers import number, rounded_up
from ffsm_drake.plugins.benchmark.boards import Board, Comparison, Reproduced, Standing
from ffsm_drake.plugins.benchmark.comparison import (
    LEGEND,
    board_rows,
    not_compiled,
    summary_rows,
)
from ffsm_drake.plugins.benchmark.paired import COMPARED, REFERENCE
from ffsm_drake.show.page import render
from ffsm_drake.show.table_files import Column
from ffsm_drake.show.tables import aligned

_COLUMNS = {
    "itae": "ITAE",
    "isv": "ISV",
    "settled_time": "settled after [s]",
    "propellant": "propellant [kg]",
    "propellant_over_least": "propellant / bound",
    "final_drift_rotation": "attitude drift [rad]",
    "spectral_radius": "spectral radius",
    "payload_factor": "payload factor",
    "delay_margin": "delay margin [s]",
    "error_over_lqg": "error / LQG error",
    "law_time": "time per sample [µs]",
}


_CUT = "cut"  # a figure beyond its time limit, or left out by an interruption


def _is_cut(value: float | None) -> bool:
    return value is not None and math.isnan(value)


def _figures(board: Board, standing: Standing) -> dict[str, float | None]:
    """The figures of a law by column, with its ratios to the mission's bounds."""
    used, least = standing.figures["propellant"], board.propellant
    ratio = None if used is None or least is None else used / least
    return {**standing.figures, "propellant_over_least": ratio}


def _leaderboard(board: Board, compared: Comparison) -> list[list[str]]:
    """The header and a row for each law; no column without a number."""
    rows = board_rows(board, compared)
    applied = [_figures(board, each) for each in board.standings]
    for name, heading in _COLUMNS.items():
        if name not in COMPARED and any(found[name] is not None for found in applied):
            rows[0].append(heading)
            for row, found in zip(rows[1:], applied, strict=True):
                row.append(_cell(name, found[name]))
    return rows


def board_columns(boards: Sequence[Board], compared: Comparison) -> list[Column]:
    """The leaderboards of missions as one table; no column without a number."""
    found = [
        (board.mission.name, each, _figures(board, each))
        for board in boards
        for each in board.standings
    ]
    columns = [
        Column(name="mission", cells=[mission for mission, _, _ in found]),
        Column(name="law", cells=[each.controller for _, each, _ in found]),
        Column(name="settled", cells=[each.settled for _, each, _ in found]),
        Column(name="runs", cells=[len(each.outcomes) for _, each, _ in found]),
    ]
    if any(each.ended for _, each, _ in found):
        columns.append(Column(name="not completed", cells=[each.ended for _, each, _ in found]))
    columns += _inferred(found, compared)
    for key, heading in _COLUMNS.items():
        scale = 1e6 if key == "law_time" else 1.0
        cells = [_CUT if _is_cut(x := figures[key]) else x and scale * x for _, _, figures in found]
        name, _, unit = heading.rstrip("]").partition(" [")
        if any(cell is not None for cell in cells):
            columns.append(Column(name=name, unit=unit, cells=cells))
    return columns


def _inferred(found: Sequence[tuple[str, Standing, Any]], compared: Comparison) -> list[Column]:
    """Intervals, ratios to the reference, and p-values with Holm's correction."""
    columns = []
    for name in COMPARED:
        spread = [each.intervals.get(name) for _, each, _ in found]
        for key, word in (("low", "from"), ("high", "to")):
            cells = [None if each is None else getattr(each, key) for each in spread]
            columns.append(Column(name=f"{name.upper()} {word}", cells=cells))
        ratios = [
            compared.get((mission, each.controller), {}).get(name) for mission, each, _ in found
        ]
        for key, word in (("value", ""), ("low", " from"), ("high", " to")):
            cells = [None if each is None else getattr(each.value, key) for each in ratios]
            columns.append(Column(name=f"{name.upper()} ratio{word}", cells=cells))
        cells = [None if each is None else each.adjusted for each in ratios]
        columns.append(Column(name=f"{name.upper()} p (Holm)", cells=cells))
    return columns


def _cell(name: str, value: float | None) -> str:
    if _is_cut(value):
        return _CUT
    if name == "law_time":
        return number(value and 1e6 * value, 2)
    if name == "delay_margin" and value == 0.0:
        return "none"
    return number(value, 3)


def _bounds(board: Board) -> str:
    """The least times of a mission in one line."""
    said = {
        "momentum": "in any attitude and posture (bound)",
        "held": "in the initial attitude and posture",
        "planner": "by the plan",
    }
    parts = [f"{time:.3g} s {said[name]}" for name, time in board.bounds.items()]
    propellant = ""
    if board.propellant is not None:
        propellant = f" Least propellant: {number(1e3 * board.propellant, 3)} g."
    if math.isnan(board.motion):
        return "No motion within the limits."
    if board.ratio is None:
        least = f" Least time: {', '.join(parts)}." if parts else ""
        return (
            f"Motion of {board.motion:.3g} s. Without momentum or limits, there is no bound."
            f"{least}{propellant}"
        )
    return (
        f"Motion of {board.motion:.3g} s, at most {rounded_up(board.ratio, 3):.3g} times the least "
        f"possible. Least time: {', '.join(parts)}.{propellant}"
    )


def board_text(board: Board) -> str:
    """The leaderboard of a mission as plain text."""
    title = f"{board.mission.name}: {board.mission.scenario.description}"
    lines = [title, *aligned(_leaderboard(board, {}))]
    lines.append(_bounds(board))
    if board.mission.assumed:
        lines.append(f"assumed: {'; '.join(board.mission.assumed)}")
    return "\n".join(lines)


def checks_table(checks: Iterable[Reproduced]) -> list[list[str]]:
    """Published figures beside those found, with a header."""
    rows = [["mission", "figure", "published", "here", "tolerance", "reproduced", "source"]]
    for each in checks:
        wanted = each.published
        figure = " of ".join(filter(None, (wanted.figure.replace("_", " "), wanted.controller)))
        allowed = "at most" if wanted.at_most else f"{100.0 * wanted.within:g} %"
        rows.append([
            each.mission, figure, number(wanted.value), number(each.found), allowed,
            "yes" if each.holds else "no", wanted.source,
        ])  # fmt: skip
    return rows


def benchmark_data(
    boards: Sequence[Board], checks: Sequence[Reproduced], found: Comparison
) -> dict[str, Any]:
    """All results as plain data."""
    return {
        "missions": {
            board.mission.name: {
                "source": board.mission.source,
                "published": board.mission.published,
                "assumed": list(board.mission.assumed),
                "least_time": dict(board.bounds),
                "motion": None if math.isnan(board.motion) else board.motion,
                "motion_over_least_time": board.ratio,
                "least_propellant": board.propellant,
                "laws": {
                    each.controller: {
                        "outcomes": list(each.outcomes),
                        **_figures(board, each),
                        "figures_over": each.over,
                        "settled_share": each.share and dataclasses.asdict(each.share),
                        "intervals": {
                            name: dataclasses.asdict(inside)
                            for name, inside in each.intervals.items()
                        },
                        f"against_{REFERENCE}": {
                            name: dataclasses.asdict(value) | {"finding": value.finding}
                            for name, value in found.get(
                                (board.mission.name, each.controller), {}
                            ).items()
                        },
                        "engines": list(each.engines),
                        "cut": [name for name, value in each.figures.items() if _is_cut(value)],
                        "message": each.message,
                    }
                    for each in board.standings
                },
            }
            for board in boards
        },
        "published_figures": [
            {
                "mission": each.mission,
                "figure": each.published.figure,
                "controller": each.published.controller,
                "published": each.published.value,
                "found": each.found,
                "reproduced": each.holds,
            }
            for each in checks
        ],
    }


def benchmark_page(boards: Sequence[Board], checks: Sequence[Reproduced], found: Comparison) -> str:
    """The page, whole."""
    return render(
        "benchmark.html.j2",
        {
            "title": "Benchmark of laws for free-flying manipulators",
            "boards": [
                {
                    "mission": board.mission,
                    "table": _leaderboard(board, found),
                    "notes": [each for each in board.standings if each.message],
                    "bounds": _bounds(board),
                }
                for board in boards
            ],
            "checks": checks_table(checks),
            "summary": summary_rows(boards, found) if found else [],
            "legend": LEGEND,
            "engines": not_compiled(boards),
            "seeds": max(
                (len(law.outcomes) for each in boards for law in each.standings), default=0
            ),
        },
        package="ffsm_drake.plugins.benchmark",
    )
