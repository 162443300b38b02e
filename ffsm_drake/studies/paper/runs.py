"""The runs of the reproduction: which there are, and what is kept of each."""

import dataclasses
import math
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.runs.record import Outcome, RunRecord
from ffsm_drake.runs.simulate import simulate
from ffsm_drake.scenario import Scenario, load_scenario

PROPOSED = "tde_aismc"
CONTROLLERS = (PROPOSED, "aismc", "asmc", "tdc")  # the columns of Table 2
INTEGRAL_SURFACE = (PROPOSED, "aismc")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setting:
    """A way to read the paper's simulation."""

    title: str
    description: str
    scenario: str
    overrides: tuple[str, ...] = ()


SETTINGS = {
    "euler": Setting(
        title="Explicit Euler, published gains",
        description="The paper's simulation as far as it can be told: explicit Euler at the control period, 10 ms.",
        scenario="paper",
    ),
    "exact": Setting(
        title="Exact integration, published gains",
        description="The same scenario with the plant integrated by a third-order Runge-Kutta method between the "
        "samples of a zero-order hold.",
        scenario="paper",
        overrides=("simulator_config.integration_scheme=runge_kutta3",),
    ),
    "bounded": Setting(
        title="Exact integration, K_s bounded",
        description="As before, but the proposed controller's K_s starts lower and is bounded, so that it reaches the "
        "end. The other three keep their gains: their runs are those of the setting before.",
        scenario="postcapture",
    ),
}

DISTURBANCES: dict[str, tuple[str, ...]] = {
    "tau_d1": (),
    "tau_d2": ("disturbance.frequency_scale=3",),
    "tau_d3": ("disturbance.amplitude_scale=3",),
}

_NO_NOISE = ("sensing.velocity_noise=0", "sensing.position_noise=0")
_NO_SWITCHING = (
    "controllers.tde_aismc.g_initial=0",
    "controllers.tde_aismc.phi=0",
    "controllers.asmc.g_initial=0",
    "controllers.asmc.a=0",
)


def _nominal(fraction: float) -> tuple[str, ...]:
    """The payload believed to be a fraction of Table 1's target (100 kg, 16.7 kg m^2)."""
    return (
        f"payload.nominal.mass={100.0 * fraction}",
        f"payload.nominal.inertia=[{', '.join([str(16.7 * fraction)] * 3)}]",
    )


NOMINALS = {f"nominal {round(100 * fraction)} kg": fraction for fraction in (0.3, 0.5, 1.0, 1.1, 1.25)}

# What single claims need beyond the table: name -> overrides of the scenario.
VARIANTS: dict[str, tuple[str, ...]] = {
    "": (),
    "no noise": _NO_NOISE,
    "G = 0": _NO_SWITCHING,
    "G = 0, no noise": (*_NO_SWITCHING, *_NO_NOISE),
    "epsilon / 10": ("controllers.tde_aismc.epsilon=1e-5",),
    "epsilon x 10": ("controllers.tde_aismc.epsilon=1e-3",),
    # The motion ends at 20 s, the disturbance is constant: what is left at 30 s is a steady-state error.
    "at rest": ("duration=30", "disturbance.frequency_scale=0", *_NO_NOISE),
    # K_D + K_s and K_s K_D of ASMC as TDC's gains: the same law as ASMC without its switching term.
    "stiffness of ASMC": ("controllers.tdc.k_d=180", "controllers.tdc.k_p=8000"),
    **{name: _nominal(fraction) for name, fraction in NOMINALS.items()},
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One run, by name."""

    setting: str
    controller: str
    disturbance: str = "tau_d1"
    seed: int = 0
    variant: str = ""

    @property
    def canonical(self) -> "Case":
        """The case whose run serves this one: bounding the proposed controller's K_s changes no other controller."""
        shared = self.setting == "bounded" and self.controller != PROPOSED
        return dataclasses.replace(self, setting="exact") if shared else self

    def scenario(self, overrides: Sequence[str] = ()) -> Scenario:
        """The scenario; ``overrides`` win over everything that the case says."""
        setting = SETTINGS[self.setting]
        return load_scenario(
            setting.scenario,
            [
                *setting.overrides,
                f"controller={self.controller}",
                f"random_seed={self.seed}",
                *DISTURBANCES[self.disturbance],
                *VARIANTS[self.variant],
                *overrides,
            ],
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """What is kept of a run."""

    case: Case
    outcome: Outcome
    metrics: dict[str, Any]
    # Rms change of the force from one sample to the next, by whole seconds and coordinate (n, nv), N m and N.
    ripple: np.ndarray
    # Sum over the coordinates of |mean error| over the last five seconds, rad and m.
    resting_error: float
    record: RunRecord | None

    @property
    def itae(self) -> float:
        """Infinite when the run did not reach its end: worse than any that did."""
        return float(self.metrics["itae"]) if self.outcome.completed else math.inf

    @property
    def isv(self) -> float:
        """As ``itae``."""
        return float(self.metrics["isv"]) if self.outcome.completed else math.inf

    @property
    def mean_ripple(self) -> float:
        """Rms change of the force from one sample to the next over run and coordinates; infinite as ``itae``."""
        return float(np.sqrt(np.mean(self.ripple**2))) if self.outcome.completed else math.inf


@dataclasses.dataclass(frozen=True, kw_only=True)
class Results:
    """All runs, by case."""

    runs: dict[Case, Run]
    num_seeds: int
    overrides: tuple[str, ...] = ()  # applied to every run; empty for the reproduction proper

    def run(
        self, setting: str, controller: str, *, disturbance: str = "tau_d1", seed: int = 0, variant: str = ""
    ) -> Run:
        """The run of a case, also where another case's run serves it."""
        case = Case(setting=setting, controller=controller, disturbance=disturbance, seed=seed, variant=variant)
        return self.runs[case.canonical]

    def over_seeds(self, setting: str, controller: str, *, disturbance: str = "tau_d1", variant: str = "") -> list[Run]:
        """The runs of a case that differ in the noise only."""
        return [
            self.run(setting, controller, disturbance=disturbance, seed=seed, variant=variant)
            for seed in range(self.num_seeds)
        ]

    def record(self, setting: str, controller: str, *, variant: str = "") -> RunRecord:
        """The full record of a case that ``keeps_record``."""
        record = self.run(setting, controller, variant=variant).record
        if record is None:
            raise LookupError(f"no record is kept of {setting}, {controller}, {variant}")
        return record


def gain_of(scenario: Scenario, gain: str) -> float:
    """A gain of the proposed controller in a record's scenario, where it is the same for all coordinates."""
    return (scenario.controllers[PROPOSED][gain] or {})["all"]


def keeps_record(case: Case) -> bool:
    """Whether the full record of a run is kept: where a figure is drawn from it, or a claim judged."""
    noise_free = case.controller == PROPOSED and case.variant == "no noise"
    return case.disturbance == "tau_d1" and case.seed == 0 and (case.variant == "" or noise_free)


def table_cases(num_seeds: int) -> list[Case]:
    """The runs of Table 2 in all settings."""
    return _distinct(
        Case(setting=setting, controller=controller, disturbance=disturbance, seed=seed)
        for setting in SETTINGS
        for disturbance in DISTURBANCES
        for controller in CONTROLLERS
        for seed in range(num_seeds)
    )


def figure_cases() -> list[Case]:
    """The runs that the figures show."""
    return _distinct(Case(setting=setting, controller=controller) for setting in SETTINGS for controller in CONTROLLERS)


def claim_cases(num_seeds: int) -> list[Case]:
    """The runs that single claims need beyond Table 2."""
    cases = []
    for setting in ("euler", "bounded"):
        for variant in ("no noise", "at rest"):
            cases += [Case(setting=setting, controller=name, variant=variant) for name in CONTROLLERS]
        cases += [Case(setting=setting, controller=PROPOSED, seed=k, variant="G = 0") for k in range(num_seeds)]
        cases.append(Case(setting=setting, controller="asmc", variant="G = 0"))
        cases.append(Case(setting=setting, controller=PROPOSED, variant="G = 0, no noise"))
        cases += [
            Case(setting=setting, controller=PROPOSED, variant=f"epsilon {change}") for change in ("/ 10", "x 10")
        ]
        cases.append(Case(setting=setting, controller="tdc", variant="stiffness of ASMC"))
    cases += [Case(setting="exact", controller=PROPOSED, seed=k, variant="G = 0") for k in range(num_seeds)]
    for nominal in NOMINALS:
        cases += [Case(setting="bounded", controller=name, variant=nominal) for name in CONTROLLERS]
        cases.append(Case(setting="euler", controller=PROPOSED, variant=nominal))
    return _distinct(cases)


def all_cases(num_seeds: int) -> list[Case]:
    """Everything that the page shows or judges."""
    return _distinct([*table_cases(num_seeds), *claim_cases(num_seeds)])


def _distinct(cases: Iterable[Case]) -> list[Case]:
    return list(dict.fromkeys(case.canonical for case in cases))


def run_cases(
    cases: Sequence[Case],
    *,
    num_seeds: int,
    overrides: Sequence[str] = (),
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> Results:
    """Simulate the cases; the results do not depend on the number of workers.

    Args:
      overrides: ``key=value`` for every run, as for ``load_scenario``.
      workers: processes at work; beyond one they are spawned, so a script must call this under
        ``if __name__ == "__main__":``.
      progress: called with (runs done, runs in all, what is next or was last).

    Raises:
      KeyboardInterrupt: the user stopped the runs.
      FfsmError: an override that cannot be used.
    """
    runs: dict[Case, Run] = {}

    def tell(case: Case) -> None:
        if progress is not None:
            progress(len(runs), len(cases), describe(case))

    # Records do not pickle, and travel badly: runs that keep theirs stay in this process.
    apart = [case for case in cases if workers > 1 and not keeps_record(case)]
    with _pool(workers if apart else 0) as pool:
        pending = {case: pool.submit(_run_apart, case, tuple(overrides)) for case in apart} if pool else {}
        for case in cases:
            if case not in pending:
                tell(case)
                runs[case] = _run(case, overrides)
        for case, future in pending.items():
            tell(case)
            answer = future.result()
            if isinstance(answer, str):
                raise FfsmError(answer)
            runs[case] = answer
    return Results(runs={case: runs[case] for case in cases}, num_seeds=num_seeds, overrides=tuple(overrides))


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor | None]:
    """Spawned worker processes, or None for no workers; what has not begun when the block fails is dropped."""
    if workers == 0:
        yield None
        return
    # Drake's threads do not survive a fork.
    pool = ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_IGN)
    )
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _run_apart(case: Case, overrides: Sequence[str]) -> Run | str:
    """``_run`` in a worker; an error comes back as its line, because not all of them pickle."""
    try:
        return _run(case, overrides)
    except FfsmError as error:
        return str(error)


def describe(case: Case) -> str:
    """One line that names a case."""
    parts = (case.setting, case.controller, case.disturbance, f"seed {case.seed}", case.variant)
    return ", ".join(part for part in parts if part)


def _run(case: Case, overrides: Sequence[str]) -> Run:
    # Some of these gains are known to be unstable: that is what is shown.
    record = simulate(case.scenario(overrides), check_stability=False)
    if record.outcome.status == "interrupted":
        raise KeyboardInterrupt
    period = record.scenario.sample_time
    return Run(
        case=case,
        outcome=record.outcome,
        metrics=record.metrics,
        ripple=_ripple(record.dataset["generalized_force"].values, round(1.0 / period)),
        resting_error=float(np.abs(record.dataset["error"].values[-round(5.0 / period) :].mean(axis=0)).sum()),
        record=record if keeps_record(case) else None,
    )


def _ripple(effort: np.ndarray, window: int) -> np.ndarray:
    steps = np.diff(effort[5:], axis=0)  # without the first samples, in which the loop finds the force from nothing
    if len(steps) == 0:
        return np.zeros((1, effort.shape[1]))
    parts = np.array_split(steps, max(len(steps) // window, 1))
    with np.errstate(over="ignore"):  # a diverged run's steps have squares beyond all bounds
        return np.array([np.sqrt(np.mean(part**2, axis=0)) for part in parts])
