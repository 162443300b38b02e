# ruff: noqa: RUF001 (the texts use mathematical signs)
"""Table 2: ours beside the paper's."""

import math
from itertools import product

import numpy as np
import pandas as pd  # type: ignore[import-untyped]

from ffsm_drake.common.numbers import power_of_ten
from ffsm_drake.plugins.paper import paper
from ffsm_drake.plugins.paper.runs import CONTROLLERS, DISTURBANCES, SETTINGS, Results
from ffsm_drake.plugins.paper.wording import DISTURBANCE_NAMES, NAMES, scientific, span, times

METRICS = {"itae": "ITAE", "isv": "ISV"}


_CASE = ["setting", "disturbance", "controller"]


def make_table(results: Results) -> pd.DataFrame:
    """A row for each controller under each disturbance in each setting.

    The columns are ``setting``, ``disturbance``, ``controller``, ``runs``, ``diverged_runs``,
    ``diverged`` (such as "diverged at 5.2 to 5.4 s", or empty), and of each of METRICS, such as
    ``itae_mean``:
      mean: mean over the seeds; NaN if runs diverged.
      spread: sample standard deviation over the seeds; NaN for a single one.
      paper: the paper's value.
      ratio: mean / paper.
      rank, paper_rank: among the four controllers, 1 the smallest; diverged ones last.
      paper_correction: reason to correct the paper's value, or empty.
    """
    runs = pd.concat(
        {
            (setting, disturbance, name): results.runs_of(setting, name).loc[disturbance]
            for setting, disturbance, name in product(SETTINGS, DISTURBANCES, CONTROLLERS)
        },
        names=_CASE,
    )
    cases = runs.groupby(level=_CASE, sort=False)
    table = cases["diverged"].agg(runs="size", diverged_runs="count", diverged=_ended)
    for metric in METRICS:
        figures = cases[metric].agg(["mean", "std"]).set_axis(["mean", "spread"], axis=1)
        figures["paper"] = [paper.TABLE_2[metric][place][name] for _, place, name in table.index]
        ranks = figures[["mean", "paper"]].groupby(level=_CASE[:2]).rank(method="min").astype(int)
        figures["mean"] = figures["mean"].replace(np.inf, np.nan)
        figures["ratio"] = figures["mean"] / figures["paper"]
        figures[["rank", "paper_rank"]] = ranks
        table = table.join(figures.add_prefix(f"{metric}_"))
    for metric in METRICS:
        table[f"{metric}_paper_correction"] = [
            paper.CORRECTIONS.get((metric, *case[1:]), "") for case in table.index
        ]
    return table.reset_index()


def _ended(times: pd.Series) -> str:
    """Times of divergence of runs, s, in words."""
    ended = times.dropna()
    if ended.empty:
        return ""
    some = f" ({ended.size} of {times.size} runs)" if ended.size < times.size else ""
    return f"diverged at {span(ended, 2)} s{some}"


def table_csv(rows: pd.DataFrame) -> str:
    """The table as comma-separated values, eight digits; empty if runs diverged."""
    return rows.to_csv(index=False, float_format="%.8g", lineterminator="\n")


def shown(metric: str, value: float) -> str:
    """A metric's value as formatted in the tables."""
    return scientific(value, 4) if metric == "itae" else f"{value:.1f}"


def shown_ours(metric: str, mean: float, spread: float) -> str:
    """Mean over the seeds and, for several, the spread with the mean's exponent."""
    if math.isnan(spread):
        return f"{mean:.2f}" if metric == "isv" else scientific(mean, 4)
    if metric == "isv":
        return f"{mean:.2f} ± {spread:.2f}"
    mantissa, exponent = f"{mean:.3e}".split("e")
    return f"({mantissa} ± {spread / 10.0 ** int(exponent):.3f}){power_of_ten(int(exponent))}"


def markdown_rows(rows: pd.DataFrame) -> list[list[str]]:
    """Cell texts of one setting's table."""
    lines = []
    for row in rows.to_dict("records"):
        line = [DISTURBANCE_NAMES[row["disturbance"]], NAMES[row["controller"]]]
        for metric in METRICS:
            mark = " †" if row[f"{metric}_paper_correction"] else ""
            ratio = row[f"{metric}_ratio"]
            # The time is given once.
            ended = row["diverged"] and (row["diverged"] if metric == "itae" else "diverged")
            line += [
                shown(metric, row[f"{metric}_paper"]) + mark,
                ended or shown_ours(metric, row[f"{metric}_mean"], row[f"{metric}_spread"]),
                "–" if math.isnan(ratio) else times(ratio),
                f"{row[f'{metric}_rank']} ({row[f'{metric}_paper_rank']})",
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
