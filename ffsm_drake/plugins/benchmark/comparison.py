"""Laws against the reference law on the same seeds, as text, Markdown and figure."""

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ffsm_drake.common.numbers import NONE, number
from ffsm_drake.plugins.benchmark.boards import REFUSED, Board, Comparison, Standing
from ffsm_drake.plugins.benchmark.paired import COMPARED, REFERENCE, SETTLED, Compared
from ffsm_drake.plugins.campaign.statistics import Interval
from ffsm_drake.show.figures.axes import STYLE
from ffsm_drake.show.style import BLACK, BLUE, GREY, VERMILION
from ffsm_drake.show.tables import aligned

_COLORS = {"smaller": BLUE, "larger": VERMILION, "within noise": GREY}
_MARKERS = {"itae": "o", "isv": "s"}
_SIGNS = {"smaller": "↓", "larger": "↑", "within noise": "="}
LEGEND = (
    f"Ratios are to {REFERENCE} on the same seeds (Hodges-Lehmann, 95 % by signed ranks). "
    "↓, ↑: smaller or larger, = within noise, at 5 % after Holm's correction over the whole table."
)
_SMALLER, _NOISE, _LARGER = "smaller ITAE", "within noise", "larger ITAE"
_UNSETTLED, _NO_RATIO = "not settled in all runs", "settled, no ratio"
_NOT_RUN = "not run"
_ALWAYS = (_SMALLER, _NOISE, _LARGER, _UNSETTLED)  # others: if there is such a law


def between(interval: Interval | None, digits: int = 3) -> str:
    """An estimate with its interval, such as 0.95 [0.91, 0.99]."""
    if interval is None:
        return NONE
    value, low, high = (number(x, digits) for x in (interval.value, interval.low, interval.high))
    return value if NONE in (low, high) else f"{value} [{low}, {high}]"


def settled_text(standing: Standing) -> str:
    """Such as 18 of 20 [0.70, 0.97], and how others ended."""
    if standing.share is None:
        runs = f"{standing.settled} of {len(standing.outcomes)}" if standing.outcomes else ""
        return ", ".join(filter(None, (runs, standing.ended)))
    inside = f"[{standing.share.low:.2f}, {standing.share.high:.2f}]"
    share = f"{standing.settled} of {len(standing.outcomes)} {inside}"
    return ", ".join(filter(None, (share, standing.ended)))


def cells_of(found: Mapping[str, Compared]) -> dict[str, str]:
    """A cell of each quantity, a dash where nothing can be compared."""
    cells = {}
    for name in (SETTLED, *COMPARED):
        each = found.get(name)
        if each is None or (name == SETTLED and each.finding == "within noise"):
            cells[name] = NONE
        else:
            cells[name] = f"{between(each.value, 4)} {_SIGNS[each.finding]}"
    return cells


def board_rows(board: Board, found: Comparison) -> list[list[str]]:
    """Settled runs, ITAE and ISV of each law, with a header; if the mission is compared, also the
    ratios to REFERENCE.
    """
    is_compared = any(mission == board.mission.name for mission, _ in found)
    names = [name.upper() for name in COMPARED]
    rows = [["law", "settled", *names, *(f"{name} ratio" for name in names if is_compared)]]
    for standing in board.standings:
        law, share = standing.controller, settled_text(standing)
        cells = cells_of(found.get((board.mission.name, law), {}))
        if cells[SETTLED] != NONE:
            share += f" {cells[SETTLED][-1]}"
        if law == REFERENCE and standing.settled:
            cells |= dict.fromkeys(COMPARED, "1")
        ratios = [cells[name] for name in COMPARED if is_compared]
        rows.append([
            law, share, *(between(standing.intervals.get(name)) for name in COMPARED), *ratios
        ])  # fmt: skip
    return rows


def comparison_text(boards: Sequence[Board], found: Comparison) -> str:
    """The ratios of all missions in one table, and what they mean."""
    rows = [["mission", "law", "settled", "ITAE ratio", "ISV ratio", "pairs"]]
    for (mission, law), each in found.items():
        cells, pairs = cells_of(each), each.get("itae")
        (standing,) = (
            standing
            for board in boards
            for standing in board.standings
            if (board.mission.name, standing.controller) == (mission, law)
        )
        share = f"{standing.settled} of {len(standing.outcomes)}"
        if cells[SETTLED] != NONE:
            share += f" {cells[SETTLED][-1]}"
        ratios = (cells[name] for name in COMPARED)
        rows.append([mission, law, share, *ratios, str(pairs.pairs) if pairs else NONE])
    return "\n".join([*aligned(rows), LEGEND, *not_compiled(boards)])


def not_compiled(boards: Sequence[Board]) -> list[str]:
    """A line for each other way than compiled code in which laws were run, with the reason."""
    found = dict[str, dict[str, None]]()
    for board in boards:
        for standing in board.standings:
            for engine in standing.engines:
                if engine != "compiled":
                    found.setdefault(engine, {})[standing.controller] = None
    return [f"{engine}: {', '.join(laws)}" for engine, laws in found.items()]


def _column(standing: Standing, found: Mapping[str, Compared]) -> str:
    """The column of a law in ``summary_rows``."""
    if not standing.outcomes:
        return REFUSED
    if not standing.was_run:
        return _NOT_RUN
    if standing.settled < len(standing.outcomes):
        return _UNSETTLED
    if "itae" not in found:
        return _NO_RATIO
    return {"smaller": _SMALLER, "larger": _LARGER, "within noise": _NOISE}[found["itae"].finding]


def summary_rows(boards: Sequence[Board], found: Comparison, mark: str = "") -> list[list[str]]:
    """The laws of each mission by their ITAE against REFERENCE, best first, with a header. A law is
    in one column; REFERENCE only if it did not settle in all runs. Laws with a larger ITAE, and
    those that were not run, are counted.

    Args:
      mark: text around the name of a law or mission.
    """
    missions = []
    for board in boards:
        laws: dict[str, list[str]] = {}
        for standing in board.standings:
            law = standing.controller
            column = _column(standing, found.get((board.mission.name, law), {}))
            if law != REFERENCE or column in (_UNSETTLED, _NOT_RUN, REFUSED):
                some = f" ({standing.settled} of {len(standing.outcomes)})"
                shown = some if column == _UNSETTLED and standing.settled else ""
                laws.setdefault(column, []).append(f"{mark}{law}{mark}{shown}")
        missions.append(laws)
    columns = [*_ALWAYS]
    columns += [
        name for name in (_NO_RATIO, _NOT_RUN, REFUSED) if any(name in laws for laws in missions)
    ]
    rows = [["mission", *columns]]
    for board, laws in zip(boards, missions, strict=True):
        cells = {name: ", ".join(laws.get(name, ())) or NONE for name in columns}
        for name in {_LARGER, _NOT_RUN} & {*laws}:
            count = len(laws[name])
            cells[name] = f"{count} law{'s' if count > 1 else ''}"
        rows.append([f"{mark}{board.mission.name}{mark}", *cells.values()])
    return rows


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    head, *others = rows
    table = [head, ["---"] * len(head), *others]
    return "\n".join(f"| {' | '.join(row)} |" for row in table)


def comparison_markdown(boards: Sequence[Board], found: Comparison) -> str:
    """The summary of all missions and the table of each one in Markdown, for a document."""
    blocks = []
    if found:
        blocks += ["## Summary", _markdown(summary_rows(boards, found, "`")), LEGEND]
    if engines := not_compiled(boards):
        blocks += ["Laws that did not run compiled:", "\n".join(f"- {each}" for each in engines)]
    refused = [
        f"- `{board.mission.name}`, `{each.controller}`: {each.message}"
        for board in boards
        for each in board.standings
        if not each.outcomes
    ]
    if refused:
        blocks += ["Laws that a mission refuses:", "\n".join(refused)]
    blocks.append("## Results by mission")
    for board in boards:
        head, *rows = board_rows(board, found)
        table = [head, *([f"`{row[0]}`", *row[1:]] for row in rows)]
        blocks += [f"### `{board.mission.name}`", _markdown(table)]
    return "\n\n".join(blocks) + "\n"


def comparison_figure(boards: Sequence[Board], found: Comparison) -> Figure:
    """Draw the ratios with their intervals: a panel for each mission, a row for each law."""
    laws = list(dict.fromkeys(law for _, law in found))
    shown = [board for board in boards if any(board.mission.name == name for name, _ in found)]
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    with mpl.rc_context(STYLE):
        size = (2.0 + 3.3 * columns, rows * (1.1 + 0.19 * len(laws)) + 0.5)
        figure = Figure(figsize=size, layout="constrained")
        panels = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
        for axes, board in zip(panels, shown, strict=False):
            _draw_mission(axes, board, found, laws)
        for axes in panels[len(shown) :]:
            axes.set_axis_off()
        marks = [
            mpl.lines.Line2D([], [], marker=_MARKERS[name], color=BLACK, ls="", label=name.upper())
            for name in COMPARED
        ]
        marks += [
            mpl.lines.Line2D([], [], color=color, label=finding, linewidth=3)
            for finding, color in _COLORS.items()
        ]
        figure.legend(handles=marks, loc="outside lower center", ncols=len(marks))
    return figure


def _draw_mission(axes: Axes, board: Board, found: Comparison, laws: Sequence[str]) -> None:
    mission = board.mission.name
    standings = {each.controller: each for each in board.standings}
    axes.axvline(1.0, color=BLACK, linewidth=0.8)
    for row, law in enumerate(laws):
        each, standing = found.get((mission, law), {}), standings.get(law)
        for offset, name in zip((-0.16, 0.16), COMPARED, strict=True):
            if name in each:
                _draw_ratio(axes, each[name], row + offset, _MARKERS[name])
        has_ratio = any(name in each for name in COMPARED)
        if standing is not None and (standing.settled < len(standing.outcomes) or not has_ratio):
            runs = f"{standing.settled}/{len(standing.outcomes)}" if standing.was_run else "no runs"
            axes.text(
                0.99, row, runs, transform=axes.get_yaxis_transform(), fontsize=7,
                ha="right", va="center", color=VERMILION if standing.was_run else GREY,
            )  # fmt: skip
    axes.set_xscale("log")
    axes.margins(x=0.08)
    axes.set(title=mission, xlabel=f"ratio to {REFERENCE}", ylim=(len(laws) - 0.4, -0.6))
    axes.set_yticks(np.arange(len(laws)), laws)


def _draw_ratio(axes: Axes, each: Compared, row: float, marker: str) -> None:
    color, inside = _COLORS[each.finding], each.value
    axes.plot([inside.low, inside.high], [row, row], color=color, linewidth=1.8)
    axes.plot(inside.value, row, marker, color=color, markersize=4.5)
