"""The benchmark's results: a table, plain data, and a page that opens offline."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

from ffsm_drake.campaign.benchmark import Board, Reproduced, Standing
from ffsm_drake.common.numbers import NONE, number
from ffsm_drake.show.page import render
from ffsm_drake.show.tables import aligned

_COLUMNS = {
    "itae": "ITAE",
    "isv": "effort (ISV)",
    "settled_time": "settled after [s]",
    "propellant": "propellant [kg]",
    "final_drift_rotation": "base turned [rad]",
    "predicted_radius_expected": "spectral radius",
}
HEADER = ("law", "settled", *_COLUMNS.values(), "run, µs a sample")


def _cells(standing: Standing) -> list[str]:
    runs = len(standing.outcomes)
    cells = [standing.controller, f"{standing.settled} of {runs}" if runs else "does not apply"]
    cells += [number(standing.figures[column], 3) for column in _COLUMNS]
    sample = standing.sample
    return [*cells, NONE if sample is None else f"{1e6 * sample:.0f}"]


def _bounds(board: Board) -> str:
    """The lower bounds of a mission in one line."""
    said = {"momentum": "by the momentum over the limits", "planner": "found by the planner"}
    parts = [f"{time:.3g} s {said[name]}" for name, time in board.bounds.items()]
    if math.isnan(board.motion):
        return "No motion within the limits."
    if board.ratio is None:
        return (
            f"Motion of {board.motion:.3g} s; no lower bound: no momentum to take out, or no limit."
        )
    return (
        f"Motion of {board.motion:.3g} s, {board.ratio:.3g} times the least that momentum allows. "
        f"Least time: {', '.join(parts)}."
    )


def board_text(board: Board) -> str:
    """The leaderboard of a mission as plain text."""
    applied = [standing for standing in board.standings if standing.outcomes]
    rows = [HEADER, *map(_cells, applied)]
    lines = [f"{board.mission.name}: {board.mission.scenario.description}", *aligned(rows)]
    lines.append(_bounds(board))
    if board.mission.assumed:
        lines.append(f"assumed: {'; '.join(board.mission.assumed)}")
    if left := [each.controller for each in board.standings if not each.outcomes]:
        lines.append(f"does not apply: {', '.join(left)}")
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


def benchmark_data(boards: Sequence[Board], checks: Sequence[Reproduced]) -> dict[str, Any]:
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
                "laws": {
                    each.controller: {
                        "outcomes": list(each.outcomes),
                        **each.figures,
                        "seconds_a_sample": each.sample,
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


def benchmark_page(boards: Sequence[Board], checks: Sequence[Reproduced]) -> str:
    """The page, whole."""
    return render(
        "benchmark.html.j2",
        {
            "title": "Benchmark of laws for free-flying manipulators",
            "header": HEADER,
            "boards": [
                {
                    "mission": board.mission,
                    "rows": [_cells(each) for each in board.standings if each.outcomes],
                    "notes": [each for each in board.standings if each.message],
                    "bounds": _bounds(board),
                }
                for board in boards
            ],
            "checks": checks_table(checks),
        },
    )
