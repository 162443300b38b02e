# ruff: noqa: RUF001 (the texts use mathematical signs)
"""Table 2: ours beside the paper's."""

import dataclasses
import math
from itertools import product

import numpy as np
import pandas as pd  # type: ignore[import-untyped]

from ffsm_drake.common.numbers import power_of_ten
from ffsm_drake.plugins.paper import paper
from ffsm_drake.plugins.paper.runs import CONTROLLERS, DISTURBANCES, SETTINGS, Results
from ffsm_drake.plugins.paper.wording import DISTURBANCE_NAMES, NAMES, scientific, span, times

METRICS = {"itae": "ITAE", "isv": "ISV"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cell:
    """A metric of a controller under a disturbance.

    Mean, spread and ratio are NaN if runs diverged.
    """

    mean: float  # over the seeds
    spread: float  # sample standard deviation over the seeds; NaN for a single one
    paper: float
    ratio: float  # mean / paper
    rank: int  # among the four controllers, 1 the smallest; diverged ones last
    paper_rank: int
    correction: str  # reason to correct the paper's value, or empty


@dataclasses.dataclass(frozen=True)
class Row:
    """One controller under one disturbance in one setting."""

    setting: str
    disturbance: str
    controller: str
    runs: int
    diverged_runs: int
    diverged: str  # such as "diverged at 5.2 to 5.4 s", or empty
    itae: Cell
    isv: Cell


def make_table(results: Results) -> list[Row]:
    """All rows: by setting, disturbance, controller."""
    rows = []
    for setting, disturbance in product(SETTINGS, DISTURBANCES):
        itae, isv = (_cells(results, metric, setting, disturbance) for metric in METRICS)
        for name in CONTROLLERS:
            runs = results.runs_of(setting, name, disturbance=disturbance).values()
            ended = [run for run in runs if not run.outcome.completed]
            text = ""
            if ended:
                times_ended = span((run.outcome.time for run in ended), 2)
                text = f"{ended[0].outcome.status} at {times_ended} s"
                if len(ended) < len(runs):
                    text += f" ({len(ended)} of {len(runs)} runs)"
            counts = len(runs), len(ended)
            rows.append(Row(setting, disturbance, name, *counts, text, itae[name], isv[name]))
    return rows


def _cells(results: Results, metric: str, setting: str, disturbance: str) -> dict[str, Cell]:
    values = results.by_controller(metric, setting).loc[disturbance]
    with np.errstate(invalid="ignore"):
        figures = pd.DataFrame({"mean": values.mean(), "spread": values.std()})
    figures["paper"] = pd.Series(paper.TABLE_2[metric][disturbance])
    ranks = figures[["mean", "paper"]].rank(method="min").astype(int)
    figures["mean"] = figures["mean"].replace(np.inf, np.nan)
    figures["ratio"] = figures["mean"] / figures["paper"]
    return {
        name: Cell(
            **figures.loc[name],
            rank=ranks["mean"][name],
            paper_rank=ranks["paper"][name],
            correction=paper.CORRECTIONS.get((metric, disturbance, name), ""),
        )
        for name in CONTROLLERS
    }


def table_csv(rows: list[Row]) -> str:
    """The table as comma-separated values, eight digits; empty if runs diverged."""
    frame = pd.json_normalize([dataclasses.asdict(row) for row in rows], sep="_")
    corrections = [f"{metric}_correction" for metric in METRICS]
    frame = frame[[*frame.columns.drop(corrections), *corrections]]
    frame = frame.rename(columns={name: name.replace("_", "_paper_") for name in corrections})
    text: str = frame.to_csv(index=False, float_format="%.8g", lineterminator="\n")
    return text


def shown(metric: str, value: float) -> str:
    """A metric's value as formatted in the tables."""
    return scientific(value, 4) if metric == "itae" else f"{value:.1f}"


def shown_ours(metric: str, cell: Cell) -> str:
    """Mean over the seeds and, for several, the spread with the mean's exponent."""
    if math.isnan(cell.spread):
        return f"{cell.mean:.2f}" if metric == "isv" else scientific(cell.mean, 4)
    if metric == "isv":
        return f"{cell.mean:.2f} ± {cell.spread:.2f}"
    mantissa, exponent = f"{cell.mean:.3e}".split("e")
    return f"({mantissa} ± {cell.spread / 10.0 ** int(exponent):.3f}){power_of_ten(int(exponent))}"


def shown_ratio(cell: Cell) -> str:
    return "–" if math.isnan(cell.ratio) else times(cell.ratio)


def markdown_rows(rows: list[Row]) -> list[list[str]]:
    """Cell texts of one setting's table."""
    lines = []
    for row in rows:
        line = [DISTURBANCE_NAMES[row.disturbance], NAMES[row.controller]]
        for metric in METRICS:
            cell: Cell = getattr(row, metric)
            mark = " †" if cell.correction else ""
            # The time is given once.
            ended = row.diverged and (row.diverged if metric == "itae" else "diverged")
            ours = ended or shown_ours(metric, cell)
            line += [
                shown(metric, cell.paper) + mark,
                ours,
                shown_ratio(cell),
                f"{cell.rank} ({cell.paper_rank})",
            ]
        lines.append(line)
    return lines


HEADER = [
    "disturbance",
    "controller",
    "ITAE, paper",
    "ITAE, ours",
    "ratio",
    "rank",
    "ISV, paper",
    "ISV, ours",
    "ratio",
    "rank",
]


def table_notes() -> list[str]:
    """Notes below the table."""
    return [
        "Ours: mean over the noise seeds, ± standard deviation if there are several. Ratio: ours "
        "over the paper's. Rank: ours among the four controllers, 1 for the smallest value, "
        "diverged runs last; in brackets the paper's.",
        *[
            f"† {METRICS[metric]}, {DISTURBANCE_NAMES[disturbance]}, {NAMES[controller]}: {why}."
            for (metric, disturbance, controller), why in paper.CORRECTIONS.items()
        ],
    ]
