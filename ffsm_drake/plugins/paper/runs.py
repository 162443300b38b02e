"""The runs of the reproduction and their results."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd  # type: ignore[import-untyped]

from ffsm_drake.plugins.workers.pool import map_tasks
from ffsm_drake.runs.ending import Outcome
from ffsm_drake.runs.record import RunRecord, software_versions
from ffsm_drake.runs.simulate import simulate
from ffsm_drake.scenario import Scenario, load_scenario, read_yaml
from ffsm_drake.systems.controllers import complete_gains

if TYPE_CHECKING:
    import xarray as xr

PROPOSED = "tde_aismc"
CONTROLLERS = (PROPOSED, "aismc", "asmc", "tdc")  # the columns of Table 2
INTEGRAL_SURFACE = (PROPOSED, "aismc")
Side = str | tuple[str, str]  # a controller, or a controller and a variant of its runs


STUDY = read_yaml(Path(__file__).with_name("study.yaml").read_text(encoding="utf-8"))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setting:
    """An interpretation of the paper's simulation."""

    title: str
    description: str
    scenario: str
    overrides: Sequence[str] = ()


SETTINGS = {name: Setting(**entry) for name, entry in STUDY["settings"].items()}
# name -> overrides of the scenario
DISTURBANCES: dict[str, list[str]] = STUDY["disturbances"]
VARIANTS: dict[str, list[str]] = STUDY["variants"]
NOMINALS = tuple(name for name in VARIANTS if name.startswith("nominal"))


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudyCase:
    """One run, by name."""

    setting: str
    controller: str
    disturbance: str = "tau_d1"
    seed: int = 0
    variant: str = ""

    @property
    def canonical(self) -> "StudyCase":
        """The case whose run is used: bounding K_s changes only the proposed controller."""
        shared = self.setting == "bounded" and self.controller != PROPOSED
        return dataclasses.replace(self, setting="exact") if shared else self

    def __str__(self) -> str:
        parts = (self.setting, self.controller, self.disturbance, f"seed {self.seed}", self.variant)
        return ", ".join(part for part in parts if part)

    def scenario(self, overrides: Sequence[str] = ()) -> Scenario:
        """The scenario; ``overrides`` take precedence over the case."""
        setting = SETTINGS[self.setting]
        own = f"controller={self.controller}", f"random_seed={self.seed}"
        case = *setting.overrides, *own, *DISTURBANCES[self.disturbance], *VARIANTS[self.variant]
        return load_scenario(setting.scenario, [*case, *overrides])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """Results of a run."""

    case: StudyCase
    outcome: Outcome
    metrics: dict[str, Any]
    # Rms change of the force from one sample to the next, by whole seconds and coordinate (n, nv),
    # N m and N.
    ripple: np.ndarray
    # Sum over the coordinates of |mean error| over the last five seconds, rad and m.
    resting_error: float
    dataset: "xr.Dataset | None"  # the time series, if the case ``keeps_record``

    @property
    def itae(self) -> float:
        """ITAE; infinite if the run did not complete."""
        return float(self.metrics["itae"]) if self.outcome.completed else math.inf

    @property
    def isv(self) -> float:
        """ISV; infinite if the run did not complete."""
        return float(self.metrics["isv"]) if self.outcome.completed else math.inf

    @property
    def mean_ripple(self) -> float:
        """Rms sample-to-sample change of the force over run and coordinates, or infinite."""
        return float(np.sqrt(np.mean(self.ripple**2))) if self.outcome.completed else math.inf


@dataclasses.dataclass(frozen=True, kw_only=True)
class Results:
    """All runs, by case."""

    runs: dict[StudyCase, Run]
    num_seeds: int
    overrides: tuple[str, ...] = ()  # applied to every run; empty for the reproduction proper

    def run(self, setting: str, controller: str, *, seed: int = 0, variant: str = "") -> Run:
        """The run of a case under tau_d1, possibly shared with another case."""
        case = StudyCase(setting=setting, controller=controller, seed=seed, variant=variant)
        return self.runs[case.canonical]

    def runs_of(self, setting: str, side: Side) -> pd.DataFrame:
        """A controller's runs, by disturbance and seed.

        The columns are ``run``, ``itae`` and ``isv`` as in ``Run``, and ``diverged``, the time of
        divergence, s; NaN if the run completed.
        """
        name, variant = (side, "") if isinstance(side, str) else side
        one = StudyCase(setting=setting, controller=name, variant=variant).canonical
        return self._sides.get_group((one.setting, name, variant))

    @functools.cached_property
    def _sides(self) -> Any:
        rows = [
            {
                **vars(case),
                "run": run,
                "itae": run.itae,
                "isv": run.isv,
                "diverged": math.nan if run.outcome.completed else run.outcome.time,
            }
            for case, run in self.runs.items()
        ]
        table = pd.DataFrame(rows).set_index(["disturbance", "seed"])
        return table.groupby(["setting", "controller", "variant"])

    def record(self, setting: str, controller: str, *, variant: str = "") -> RunRecord:
        """The full record of a case that ``keeps_record``."""
        case = StudyCase(setting=setting, controller=controller, variant=variant)
        return self._records[case.canonical]

    @property
    def comparisons(self) -> list[tuple[str, int]]:
        """All (disturbance, seed) of the table."""
        return list(product(DISTURBANCES, range(self.num_seeds)))

    def rankings(self, metric: str, setting: str) -> list[list[str]]:
        """The controllers of every comparison, from the smallest value to the largest."""
        values = [self.runs_of(setting, name)[metric] for name in CONTROLLERS]
        order = np.argsort(values, axis=0, kind="stable").T
        return np.array(CONTROLLERS)[order].tolist()

    def ratios(self, metric: str, setting: str, over: Side, under: Side) -> list[float]:
        """A metric of one controller over another's, for every (disturbance, seed) run of both.

        Infinite where the first diverged, NaN where the second did.
        """
        first, second = (self.runs_of(setting, side)[metric] for side in (over, under))
        first, second = first.align(second.replace(np.inf, np.nan), join="inner")
        return (first / second).tolist()

    def divergence_times(self, setting: str, side: Side) -> list[float]:
        """Times of divergence of a controller's runs, s."""
        return self.runs_of(setting, side)["diverged"].dropna().tolist()

    @functools.cached_property
    def _records(self) -> dict[StudyCase, RunRecord]:
        versions = software_versions()
        return {
            case: RunRecord(
                scenario=complete_gains(case.scenario(self.overrides)),
                outcome=run.outcome,
                dataset=run.dataset,
                wall_time={},
                software=versions,
            )
            for case, run in self.runs.items()
            if run.dataset is not None
        }


def gain_of(scenario: Scenario, gain: str, controller: str = PROPOSED) -> float:
    """A gain of a scenario that is equal for all coordinates."""
    return (scenario.controllers[controller][gain] or {})["all"]


def keeps_record(case: StudyCase) -> bool:
    """True if a figure or claim needs the full record of the run."""
    noise_free = case.controller == PROPOSED and case.variant == "no noise"
    return case.disturbance == "tau_d1" and case.seed == 0 and (case.variant == "" or noise_free)


def table_cases(num_seeds: int) -> list[StudyCase]:
    """The runs of Table 2 in all settings."""
    return _cases(STUDY["runs"][:1], range(num_seeds))


def figure_cases(settings: Iterable[str], controllers: Iterable[str]) -> list[StudyCase]:
    """The runs in a figure of these controllers."""
    return _cases([{"settings": settings, "controllers": controllers}])


def all_cases(num_seeds: int) -> list[StudyCase]:
    """All cases that the page shows or evaluates."""
    return _cases(STUDY["runs"], range(num_seeds))


def _cases(groups: Iterable[Mapping[str, Any]], seeds: Sequence[int] = (0,)) -> list[StudyCase]:
    """The distinct runs of groups; each group has every combination of its values."""
    cases = [
        StudyCase(
            setting=setting, controller=name, disturbance=disturbance, seed=seed, variant=variant
        )
        for group in groups
        for setting, disturbance, name, seed, variant in product(
            group["settings"],
            group.get("disturbances", ("tau_d1",)),
            group["controllers"],
            seeds if group.get("every_seed") else (0,),
            group.get("variants", ("",)),
        )
    ]
    return list(dict.fromkeys(case.canonical for case in cases))


def run_cases(
    cases: Sequence[StudyCase],
    *,
    num_seeds: int,
    overrides: Sequence[str] = (),
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> Results:
    """Simulate the cases.

    Args:
      overrides: ``key=value`` for every run; see ``load_scenario``.
      workers, progress: see ``map_tasks``.

    Raises:
      FfsmError: an override that cannot be used.
      KeyboardInterrupt: the user stopped the runs.
    """
    run = functools.partial(_run, overrides=tuple(overrides))
    runs = map_tasks(run, cases, workers=workers, progress=progress)
    return Results(
        runs=dict(zip(cases, runs, strict=True)), num_seeds=num_seeds, overrides=tuple(overrides)
    )


def _run(case: StudyCase, overrides: Sequence[str]) -> Run:
    # some of these gains are known to be unstable
    record = simulate(case.scenario(overrides), check_stability=False)
    if record.outcome.status == "interrupted":
        raise KeyboardInterrupt
    period = record.scenario.sample_time
    return Run(
        case=case,
        outcome=record.outcome,
        metrics=record.metrics,
        ripple=_ripple(record.dataset["generalized_force"].values, round(1.0 / period)),
        resting_error=float(
            np.abs(record.dataset["error"].values[-round(5.0 / period) :].mean(axis=0)).sum()
        ),
        dataset=record.dataset if keeps_record(case) else None,
    )


def _ripple(effort: np.ndarray, window: int) -> np.ndarray:
    # without the first samples, in which the loop builds up the force from zero
    steps = np.diff(effort[5:], axis=0)
    if len(steps) == 0:
        return np.zeros((1, effort.shape[1]))
    parts = np.array_split(steps, max(len(steps) // window, 1))
    with np.errstate(over="ignore"):  # a diverged run's steps have squares beyond all bounds
        return np.array([np.sqrt(np.mean(part**2, axis=0)) for part in parts])
