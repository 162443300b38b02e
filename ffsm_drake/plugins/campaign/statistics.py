"""Statistics of a campaign: success, paired differences, sensitivities, quality of predictions."""

import contextlib
import dataclasses
import itertools
import json
import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
from scipy import stats

from ffsm_drake.common.interrupts import interruptible
from ffsm_drake.common.numbers import counted
from ffsm_drake.common.steps import step
from ffsm_drake.plugins.campaign.interactions import interactions
from ffsm_drake.plugins.campaign.prediction import StabilityMap, predict_map
from ffsm_drake.plugins.campaign.rows import (
    COMPLETED,
    NO_PREDICTION,
    metrics_of,
    predictions_of,
    texts_of,
)
from ffsm_drake.plugins.campaign.spec import Spec
from ffsm_drake.plugins.campaign.store import Store
from ffsm_drake.runs.ending import NOT_CAPTURED
from ffsm_drake.runs.metrics import METRICS
from ffsm_drake.runs.record import software_versions

CONFIDENCE = 0.95
BINS = 10  # equally filled, for the share of variance that a value explains
_PERMUTATIONS = 500
FEWEST_PAIRS = 10  # fewest pairs for a confidence interval
_HEADINGS = {each.column_name: each.column_heading for each in METRICS}
GRID_METRICS = {
    name: _HEADINGS[name]
    for name in ("isv", "itae", "peak_effort_base_position", "peak_error_base_rotation")
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """A campaign's results in memory: some hundred bytes per run."""

    # Stored runs by controller, indexed by case: the columns of ``read_table``
    runs: Mapping[str, pd.DataFrame]
    values: pd.DataFrame  # sampled values that are numbers and vary, by name, indexed by case


@step("reading the runs")
def read_table(store: Store) -> Table:
    """Read the results that a database holds so far.

    The columns of runs are ``controller``, ``outcome`` (text), those of ``metrics_of`` and
    ``predictions_of``, ``outcome_time`` (s), ``wall_time`` (s), and with a capture ``first_limit``
    (text, "" for none); NaN: no value. Beside the stored ones there are ``is_settled`` and
    ``predicted``, the largest predictor; below 1: predicted to settle; NaN: no prediction.
    """
    spec = store.spec
    numbers = ("outcome_time", "wall_time", *metrics_of(spec), *predictions_of(spec))
    columns = ("controller", "case_index", "outcome", *texts_of(spec), *numbers)
    rows = store.query(f"SELECT {', '.join(columns)} FROM results ORDER BY case_index")
    frame = pd.DataFrame(rows, columns=columns).astype(dict.fromkeys(numbers, float))
    frame = frame.set_index("case_index").fillna(dict.fromkeys(texts_of(spec), ""))
    frame["is_settled"] = frame["outcome"] == "settled"
    frame["predicted"] = frame[[*predictions_of(spec)]].max(axis=1)
    values = pd.DataFrame({name: store.sampled(name) for name in spec.distributions})
    values = values.select_dtypes("number").astype(float)
    return Table(
        runs={name: frame[frame["controller"] == name] for name in spec.controllers},
        values=values.loc[:, values.nunique() > 1],
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Interval:
    """An estimate with its confidence interval."""

    value: float
    low: float
    high: float


def success_rate(runs: pd.DataFrame) -> Interval:
    """Share of settled runs, with the Clopper-Pearson interval. An error row counts as not
    settled.
    """
    if runs.empty:
        return Interval(value=math.nan, low=0.0, high=1.0)
    settled = runs["is_settled"]
    found = stats.binomtest(int(settled.sum()), settled.size).proportion_ci(
        CONFIDENCE, method="exact"
    )
    return Interval(value=float(settled.mean()), low=float(found.low), high=float(found.high))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Difference:
    """Two controllers on the same cases."""

    first: str
    second: str
    cases: int  # number of cases run by both
    success: Interval  # success rate of the first minus that of the second
    both: int  # cases that both settled
    itae_ratio: Interval | None  # median over those of ITAE, first over second; None with too few
    ratios: np.ndarray  # (both,)


def paired_differences(table: Table) -> list[Difference]:
    """Return every pair of controllers."""
    return [_difference(table, *pair) for pair in itertools.combinations(table.runs, 2)]


def _difference(table: Table, first: str, second: str) -> Difference:
    one, other = table.runs[first].align(table.runs[second], join="inner", axis=0)
    both = one["is_settled"] & other["is_settled"]
    ratios = (one["itae"] / other["itae"])[both].to_numpy()
    ratios = ratios[np.isfinite(ratios)]
    return Difference(
        first=first,
        second=second,
        cases=both.size,
        success=paired_proportions(
            int((one["is_settled"] & ~both).sum()),
            int((other["is_settled"] & ~both).sum()),
            both.size,
        ),
        itae_ratio=_median(ratios) if ratios.size >= FEWEST_PAIRS else None,
        both=int(both.sum()),
        ratios=ratios,
    )


def paired_proportions(first: int, second: int, cases: int) -> Interval:
    """Difference of two success rates on the same cases, ``first`` and ``second`` of which only one
    controller settled.

    The interval is Bonett and Price's (2012, "Adjusted Wald confidence interval for a difference of
    binomial proportions based on paired data"), Wald's after one more discordant case either way:
    it keeps its width where all cases agree.
    """
    if cases == 0:
        return Interval(value=math.nan, low=-1.0, high=1.0)
    p, q = (first + 1) / (cases + 2), (second + 1) / (cases + 2)
    half = float(stats.norm.ppf(0.5 + 0.5 * CONFIDENCE)) * math.sqrt(
        (p + q - (p - q) ** 2) / (cases + 2)
    )
    return Interval(
        value=(first - second) / cases, low=max(p - q - half, -1.0), high=min(p - q + half, 1.0)
    )


def _median(sample: np.ndarray) -> Interval:
    """Return the median, with the interval between order statistics, which no distribution is
    assumed for.
    """
    # typed wrongly in SciPy's stubs
    found: Any = stats.quantile_test(sample, p=0.5).confidence_interval(CONFIDENCE)
    return Interval(value=float(np.median(sample)), low=float(found.low), high=float(found.high))


@step("computing the influence of the values")
def sensitivities(table: Table, *, seed: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Effect of every sampled value (``name``) on the failure of the runs of each ``controller``,
    and of every pair of values together.

    The columns of the first table are NaN if all runs have the same outcome:
      correlation: Spearman's, with failure; positive: larger values fail more often.
      share: explained share of the variance of failure, by equally filled bins.
      chance: 95 % quantile of the share of a value without effect.
      matters: whether the share is beyond chance.
      total: the share, plus that of the interactions with this value, if they are beyond chance.
      interacts: whether they are.
    The second table has ``controller`` and the columns of ``Interactions.pairs``, of the pairs that
    explain more than chance.
    """
    alone, together = list[pd.DataFrame](), list[pd.DataFrame]()
    for controller, runs in table.runs.items():
        failed, values = (~runs["is_settled"]).to_numpy(float), table.values.loc[runs.index]
        varies = failed.size >= 2 * BINS and failed.min() < failed.max()
        empty = (math.nan, math.nan, math.nan)
        rows = [
            (
                name,
                controller,
                *(_sensitivity(values[name], failed, seed=seed) if varies else empty),
            )
            for name in values
        ]
        names = ["name", "controller", "correlation", "share", "chance"]
        own = pd.DataFrame(rows, columns=names).set_index("name")
        if varies:
            found = interactions(values, failed, seed=seed)
            both = found.together.reindex(own.index, fill_value=0.0)
            own["interacts"] = both > found.together_chance
            own["total"] = own["share"] + both.where(own["interacts"], 0.0)
            pairs = found.pairs[found.pairs["matters"]].assign(controller=controller)
            together += [pairs] if len(pairs) else []
        else:
            own = own.assign(interacts=False, total=math.nan)
        alone.append(own.reset_index())
    single = pd.concat(alone, ignore_index=True)
    pairs = pd.concat(together, ignore_index=True) if together else pd.DataFrame()
    return single.assign(matters=single["share"] > single["chance"]), pairs


def _sensitivity(values: pd.Series, failed: np.ndarray, *, seed: int) -> tuple[float, float, float]:
    """Return correlation, share and chance."""
    bins = np.minimum(((stats.rankdata(values) - 0.5) * BINS / values.size).astype(int), BINS - 1)
    generator = np.random.default_rng(seed)
    by_chance = [_explained(bins, generator.permutation(failed)) for _ in range(_PERMUTATIONS)]
    return (
        float(stats.spearmanr(values, failed).statistic),
        max(_explained(bins, failed), 0.0),
        float(np.quantile(by_chance, CONFIDENCE)),
    )


def _explained(bins: np.ndarray, failed: np.ndarray) -> float:
    """Variance of the bins' means over the variance of all, less its mean without an effect: the
    correlation ratio of Kelley (1935), an estimate of the first-order Sobol index.
    """
    count = np.bincount(bins, minlength=BINS)
    mean = np.bincount(bins, weights=failed, minlength=BINS) / np.maximum(count, 1)
    ratio = float(np.sum(count * (mean - failed.mean()) ** 2) / (failed.size * failed.var()))
    return 1.0 - (1.0 - ratio) * (failed.size - 1) / (failed.size - np.count_nonzero(count))


def most_influential(found: pd.DataFrame) -> list[str]:
    """Return the names by their total shares, summed over the controllers, largest first."""
    total = found.groupby("name", sort=False)["total"].sum()
    return list(total.sort_values(ascending=False, kind="stable").index)


def agreement(runs: pd.DataFrame) -> np.ndarray:
    """Count the runs (2, 2) that are predicted to settle or to fail, for any reason (rows), and
    that did settle or not (columns); without errors, refused runs and runs without prediction.
    """
    known = runs[runs["predicted"].notna() & ~runs["outcome"].isin(["error", "refused"])]
    stable, settled = known["predicted"] < 1.0, known["is_settled"]
    return np.array([
        [(foreseen & found).sum() for found in (settled, ~settled)]
        for foreseen in (stable, ~stable)
    ])  # fmt: skip


def agreed(counts: np.ndarray) -> float:
    """Return the share of the runs of an ``agreement`` with the predicted outcome; NaN: none."""
    return float(np.trace(counts) / counts.sum()) if counts.any() else math.nan


def worst_runs(runs: pd.DataFrame) -> list[int]:
    """Return the cases of the five worst runs: errors, earliest divergences, largest final
    errors.
    """
    kinds = ("error", "diverged", *NOT_CAPTURED, "growing", "not_settled", "refused", "settled")
    order = runs["outcome"].map(kinds.index)
    time = runs["outcome_time"].where(runs["outcome"] == "diverged", 0.0)
    final = runs.filter(regex="^final_error_").max(axis=1).fillna(0.0)
    return runs.index[np.lexsort((-final, time, order))[:5]].tolist()


def quantiles(runs: pd.DataFrame, metric: str) -> np.ndarray:
    """5 %, 50 % and 95 % quantile of a metric over the settled runs; NaN if there is none."""
    values = runs.loc[runs["is_settled"], metric]
    return np.quantile(values, (0.05, 0.5, 0.95)) if values.size else np.full(3, math.nan)


def grid_points(spec: Spec, table: Table) -> pd.DataFrame:
    """Return a row for every combination of a grid's values and every controller that was run; none
    where the sampling is not a grid.

    The columns are the names of the values, ``controller``, ``outcome`` (numbers of runs, in
    words), and the means of GRID_METRICS over the completed runs; NaN: none.
    """
    rows = []
    levels = [item.levels for item in spec.distributions.values()]
    combinations = math.prod(map(len, levels)) if spec.sampling == "grid" else 0
    for first, (name, runs) in itertools.product(range(combinations), table.runs.items()):
        here = runs[runs.index % combinations == first]
        if here.empty:
            continue
        counts = here["outcome"].value_counts().sort_index()
        outcomes = (f"{count} {kind.replace('_', ' ')}" for kind, count in counts.items())
        ended = here.loc[here["outcome"].isin(COMPLETED), [*GRID_METRICS]]
        rows.append({
            **{value: spec.level(value, first) for value in spec.distributions},
            "controller": name,
            "outcome": ", ".join(outcomes),
            **ended.mean(skipna=False),
        })  # fmt: skip
    return pd.DataFrame(rows)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Findings:
    """The evaluation of a campaign."""

    spec: Spec
    table: Table
    success: dict[str, Interval]  # by controller
    differences: list[Difference]
    sensitivities: pd.DataFrame
    pairs: pd.DataFrame  # of values that explain failures together beyond chance
    influential: list[str]  # sampled numbers, most influential first
    agreement: dict[str, np.ndarray]  # by controller
    unpredicted: list[str]  # runs whose loop cannot be linearised, and why; a line per controller
    map: StabilityMap | None  # None with fewer than two sampled numbers
    grid: pd.DataFrame  # empty if the sampling is not a grid

    @property
    def drivers(self) -> list[str]:
        """The ``influential`` values that explain failures of some controller beyond chance, alone
        or with others.
        """
        found = self.sensitivities
        matter = {*found["name"][found["matters"] | found["interacts"]]}
        for end in ("first", "second"):
            matter |= {*self.pairs.get(end, ())}
        return [name for name in self.influential if name in matter]

    @property
    def runs(self) -> int:
        return sum(map(len, self.table.runs.values()))


def find(
    store: Store,
    *,
    axes: tuple[str, str] | None = None,
    boundary: float = math.inf,
    progress: Callable[[int, int], None] | None = None,
) -> Findings:
    """Evaluate the results that a database holds so far.

    ``axes`` are the map's two values, None for the two most influential; ``boundary`` is the
    time for predictions on it, s, beyond those of earlier maps; ``progress`` is called with (done,
    total) controllers of the map. Raises CampaignError when an axis is not a sampled number.
    """
    spec, table = store.spec, read_table(store)
    found, pairs = sensitivities(table, seed=spec.seed)
    influential = most_influential(found)
    if axes is None and len(influential) >= 2:
        axes = (influential[0], influential[1])
    return Findings(
        spec=spec,
        table=table,
        success={name: success_rate(runs) for name, runs in table.runs.items()},
        differences=paired_differences(table),
        sensitivities=found,
        pairs=pairs,
        influential=influential,
        agreement={name: agreement(runs) for name, runs in table.runs.items()},
        unpredicted=_unpredicted(store),
        map=None if axes is None else _map(store, axes, table, boundary, progress),
        grid=grid_points(spec, table),
    )


@step("computing the stability map")
def _map(
    store: Store,
    axes: tuple[str, str],
    table: Table,
    boundary: float,
    progress: Callable[[int, int], None] | None,
) -> StabilityMap:
    """The map, kept in the database for the next report by the same software."""
    name = f"points {json.dumps(axes)} {json.dumps(software_versions())}"
    known = dict[str, np.ndarray]()
    with contextlib.suppress(ValueError, TypeError, AttributeError, RecursionError):
        kept = json.loads(store.note(name) or "{}")
        known = {controller: np.array(grid, dtype=float) for controller, grid in kept.items()}
    until = time.monotonic() + boundary if boundary else 0.0
    try:
        with interruptible():
            return predict_map(
                store.spec, axes, table.values, known=known, until=until, progress=progress
            )
    finally:
        if boundary:
            found = {controller: grid.tolist() for controller, grid in known.items()}
            store.keep(name, json.dumps(found))


def _unpredicted(store: Store) -> list[str]:
    select = "SELECT controller, count(*), min(message) FROM results WHERE instr(message, ?)"
    return [
        f"{controller}: {count} of {counted(store.spec.cases, 'run')} with {NO_PREDICTION}"
        f"{message.partition(NO_PREDICTION)[2]}"
        for controller, count, message in store.query(f"{select} GROUP BY 1", (NO_PREDICTION,))
    ]
