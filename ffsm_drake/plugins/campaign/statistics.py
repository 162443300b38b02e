"""Statistics of a campaign: success, paired differences, sensitivities, quality of predictions."""

import contextlib
import dataclasses
import functools
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
from ffsm_drake.plugins.campaign.evaluate import (
    COMPLETED,
    DIVERGENCE,
    FIRST_LIMIT,
    LOAD,
    METRICS,
    NO_PREDICTION,
    PREDICTIONS,
    metrics_of,
    predictions_of,
    texts_of,
)
from ffsm_drake.plugins.campaign.prediction import StabilityMap, predict_map
from ffsm_drake.plugins.campaign.spec import Spec
from ffsm_drake.plugins.campaign.store import Store
from ffsm_drake.runs.ending import NOT_CAPTURED
from ffsm_drake.runs.record import software_versions

CONFIDENCE = 0.95
BINS = 10  # equally filled, for the share of variance that a value explains
_PERMUTATIONS = 500
FEWEST_PAIRS = 10  # fewest pairs for a confidence interval


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Runs:
    """The stored runs of one controller: arrays (n,) in the order of the cases; NaN: no value."""

    controller: str
    case: np.ndarray
    outcome: np.ndarray  # text
    # columns of ``metrics_of``, ``predictions_of``, outcome_time and wall_time
    metrics: Mapping[str, np.ndarray]
    first_limit: np.ndarray | None = None  # text, "" for none; of campaigns with a capture

    @functools.cached_property
    def settled(self) -> np.ndarray:
        return self.outcome == "settled"

    @functools.cached_property
    def predicted(self) -> np.ndarray:
        """The largest predictor; below 1: predicted to settle; NaN: no prediction."""
        found = [
            self.metrics[name] for name in (*PREDICTIONS, LOAD, DIVERGENCE) if name in self.metrics
        ]
        return np.asarray(np.fmax.reduce(found))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """A campaign's results in memory: some hundred bytes per run."""

    runs: Mapping[str, Runs]  # by controller
    # the sampled values that are numbers, by name, (number of cases,)
    values: Mapping[str, np.ndarray]


@step("reading the runs")
def read_table(store: Store) -> Table:
    """Read the results that a database holds so far."""
    spec = store.spec
    numbers = ("outcome_time", "wall_time", *metrics_of(spec), *predictions_of(spec))
    columns = ("controller", "case_index", "outcome", *texts_of(spec), *numbers)
    rows = store.query(f"SELECT {', '.join(columns)} FROM results ORDER BY case_index")
    frame = pd.DataFrame(rows, columns=columns).astype(dict.fromkeys(numbers, float))
    runs = {}
    for name in spec.controllers:
        own = frame[frame["controller"] == name]
        limits = own[FIRST_LIMIT].fillna("").to_numpy(str) if FIRST_LIMIT in own else None
        runs[name] = Runs(
            controller=name,
            case=own["case_index"].to_numpy(int),
            outcome=own["outcome"].to_numpy(str),
            metrics={each: own[each].to_numpy() for each in numbers},
            first_limit=limits,
        )
    sampled = {name: store.sampled(name) for name in spec.distributions}
    values = {
        name: np.array(column, dtype=float)
        for name, column in sampled.items()
        if all(isinstance(value, (int, float)) for value in column) and len(set(column)) > 1
    }
    return Table(runs=runs, values=values)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Interval:
    """An estimate with its confidence interval."""

    value: float
    low: float
    high: float


def success_rate(runs: Runs) -> Interval:
    """Share of settled runs, with the Clopper-Pearson interval. An error row counts as not
    settled.
    """
    if runs.case.size == 0:
        return Interval(value=math.nan, low=0.0, high=1.0)
    found = stats.binomtest(int(runs.settled.sum()), int(runs.case.size)).proportion_ci(
        CONFIDENCE, method="exact"
    )
    return Interval(value=float(runs.settled.mean()), low=float(found.low), high=float(found.high))


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
    return [
        _difference(first, second)
        for first, second in itertools.combinations(table.runs.values(), 2)
    ]


def _difference(first: Runs, second: Runs) -> Difference:
    _, i, j = np.intersect1d(first.case, second.case, assume_unique=True, return_indices=True)
    settled = first.settled[i].astype(int) - second.settled[j]
    both = first.settled[i] & second.settled[j]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = (first.metrics["itae"][i] / second.metrics["itae"][j])[both]
    ratios = ratios[np.isfinite(ratios)]
    return Difference(
        first=first.controller,
        second=second.controller,
        cases=int(i.size),
        success=_paired_proportions(
            int((settled > 0).sum()), int((settled < 0).sum()), int(i.size)
        ),
        itae_ratio=_median(ratios) if ratios.size >= FEWEST_PAIRS else None,
        both=int(both.sum()),
        ratios=ratios,
    )


def _paired_proportions(first: int, second: int, cases: int) -> Interval:
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sensitivity:
    """Effect of a value on the failure of runs."""

    name: str
    controller: str
    correlation: float  # Spearman's, with failure; positive: larger values fail more often
    share: float  # explained share of the variance of failure, by equally filled bins
    chance: float  # 95 % quantile of the share of a value without effect

    @property
    def matters(self) -> bool:
        return self.share > self.chance


@step("computing the influence of the values")
def sensitivities(table: Table, *, seed: int) -> list[Sensitivity]:
    """Every sampled value and controller; NaN if all runs have the same outcome."""
    return [
        _sensitivity(name, table.values[name][runs.case], runs, seed=seed)
        for runs in table.runs.values()
        for name in table.values
    ]


def _sensitivity(name: str, values: np.ndarray, runs: Runs, *, seed: int) -> Sensitivity:
    failed = (~runs.settled).astype(float)
    made = functools.partial(Sensitivity, name=name, controller=runs.controller)
    if failed.size < 2 * BINS or failed.min() == failed.max():
        return made(correlation=math.nan, share=math.nan, chance=math.nan)
    bins = np.minimum(((stats.rankdata(values) - 0.5) * BINS / values.size).astype(int), BINS - 1)
    generator = np.random.default_rng(seed)
    by_chance = [_explained(bins, generator.permutation(failed)) for _ in range(_PERMUTATIONS)]
    return made(
        correlation=float(stats.spearmanr(values, failed).statistic),
        share=_explained(bins, failed),
        chance=float(np.quantile(by_chance, CONFIDENCE)),
    )


def _explained(bins: np.ndarray, failed: np.ndarray) -> float:
    """Variance of the bins' means over the variance of all: the correlation ratio."""
    count = np.bincount(bins, minlength=BINS)
    mean = np.bincount(bins, weights=failed, minlength=BINS) / np.maximum(count, 1)
    return float(np.sum(count * (mean - failed.mean()) ** 2) / (failed.size * failed.var()))


def most_influential(found: list[Sensitivity]) -> list[str]:
    """Return the names by the share they explain, summed over the controllers, largest first."""
    names = list(dict.fromkeys(item.name for item in found))
    total = {name: np.nansum([item.share for item in found if item.name == name]) for name in names}
    return sorted(names, key=lambda name: -total[name])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Agreement:
    """Number of runs by prediction and outcome; unstable: predicted to fail for any reason."""

    controller: str
    stable_settled: int
    stable_failed: int
    unstable_settled: int
    unstable_failed: int

    @property
    def total(self) -> int:
        return sum(value for value in vars(self).values() if isinstance(value, int))

    @property
    def share(self) -> float:
        """Share of the runs with the predicted outcome."""
        return (self.stable_settled + self.unstable_failed) / self.total if self.total else math.nan


def agreement(runs: Runs) -> Agreement:
    """Count predictions and outcomes, without errors, refused runs and runs without prediction."""
    known = ~np.isin(runs.outcome, ("error", "refused")) & ~np.isnan(runs.predicted)
    stable = runs.predicted < 1.0
    counts = {
        f"{prediction}_{outcome}": int((known & foreseen & found).sum())
        for prediction, foreseen in (("stable", stable), ("unstable", ~stable))
        for outcome, found in (("settled", runs.settled), ("failed", ~runs.settled))
    }
    return Agreement(controller=runs.controller, **counts)


def worst_runs(runs: Runs) -> np.ndarray:
    """Return positions of the five worst runs: errors, earliest divergences, largest final
    errors.
    """
    errors = [runs.metrics[name] for name in METRICS if name.startswith("final_error")]
    final = np.nanmax(np.vstack([np.zeros(runs.case.size), *errors]), axis=0)
    kinds = ("error", "diverged", *NOT_CAPTURED, "growing", "not_settled", "refused")
    order = np.select(
        [runs.outcome == kind for kind in kinds], range(len(kinds)), default=len(kinds)
    )
    time = np.where(runs.outcome == "diverged", runs.metrics["outcome_time"], 0.0)
    return np.lexsort((-final, time, order))[:5]


def quantiles(runs: Runs, metric: str) -> tuple[float, float, float]:
    """5 %, 50 % and 95 % quantile of a metric over the settled runs; NaN if there is none."""
    values = runs.metrics[metric][runs.settled]
    low, middle, high = np.quantile(values, (0.05, 0.5, 0.95)) if values.size else [math.nan] * 3
    return float(low), float(middle), float(high)


@dataclasses.dataclass(frozen=True, kw_only=True)
class GridPoint:
    """The runs of one controller at one combination of a grid's values."""

    levels: Mapping[str, str]  # the names of the values
    controller: str
    outcomes: Mapping[str, int]  # number of runs, of outcomes that there are
    means: Mapping[str, float]  # mean of every metric over the completed runs; NaN: none


def grid_points(spec: Spec, table: Table) -> list[GridPoint]:
    """Return every combination and controller that was run; none where the sampling is not a
    grid.
    """
    if spec.sampling != "grid":
        return []
    combinations = math.prod(len(item.levels) for item in spec.distributions.values())
    return [
        _grid_point(spec, runs, first, runs.case % combinations == first)
        for first in range(combinations)
        for runs in table.runs.values()
        if first in runs.case
    ]


def _grid_point(spec: Spec, runs: Runs, first: int, here: np.ndarray) -> GridPoint:
    ended = here & np.isin(runs.outcome, COMPLETED)
    names, counts = np.unique(runs.outcome[here], return_counts=True)
    return GridPoint(
        levels={name: spec.level(name, first) for name in spec.distributions},
        controller=runs.controller,
        outcomes=dict(zip(names.tolist(), counts.tolist(), strict=True)),
        means={
            name: float(values[ended].mean()) if ended.any() else math.nan
            for name, values in runs.metrics.items()
        },
    )


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Findings:
    """The evaluation of a campaign."""

    spec: Spec
    table: Table
    success: dict[str, Interval]  # by controller
    differences: list[Difference]
    sensitivities: list[Sensitivity]
    influential: list[str]  # sampled numbers, most influential first
    agreement: list[Agreement]
    unpredicted: list[str]  # runs whose loop cannot be linearised, and why; a line per controller
    map: StabilityMap | None  # None with fewer than two sampled numbers
    grid: list[GridPoint]  # empty if the sampling is not a grid

    @property
    def drivers(self) -> list[str]:
        """The ``influential`` values that explain failures of some controller beyond chance."""
        matter = {item.name for item in self.sensitivities if item.matters}
        return [name for name in self.influential if name in matter]

    @property
    def runs(self) -> int:
        return sum(runs.case.size for runs in self.table.runs.values())


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
    found = sensitivities(table, seed=spec.seed)
    influential = most_influential(found)
    if axes is None and len(influential) >= 2:
        axes = (influential[0], influential[1])
    return Findings(
        spec=spec,
        table=table,
        success={name: success_rate(runs) for name, runs in table.runs.items()},
        differences=paired_differences(table),
        sensitivities=found,
        influential=influential,
        agreement=[agreement(runs) for runs in table.runs.values()],
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
