"""The runs of the noise study made, what is kept of each, and what the linear loop predicts without
running them.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ffsm_drake.common.workers import map_tasks
from ffsm_drake.preflight.simulate import simulate
from ffsm_drake.spacecraft.coordinates import GROUPS
from ffsm_drake.studies.noise.cases import CONTROLLERS, GAINS_OF, SIGMAS, NoiseCase, study_cases


@dataclasses.dataclass(frozen=True, kw_only=True)
class NoiseRow(NoiseCase):
    """A case and what is kept of its run; the figures of a run that diverged are NaN."""

    outcome: str  # "completed", or when it diverged
    itae: float
    isv: float
    isv_predicted: float  # by the linear loop, without a simulation; infinite: unstable
    rms_error: dict[str, float]  # by group, rad or m
    peak_force: dict[str, float]  # by group, N m or N

    @property
    def diverged(self) -> bool:
        return self.outcome != "completed"


@dataclasses.dataclass(frozen=True, kw_only=True)
class NoiseStudy:
    """All runs, and what the linear loop says without them."""

    rows: tuple[NoiseRow, ...]
    ideal_isv: float  # perfect tracking without noise
    sample_time: float  # L, s
    # Rms commanded acceleration of one base attitude axis per unit of velocity noise with the
    # published estimate, 1/s.
    noise_gain: dict[str, float]

    @property
    def duration(self) -> float:
        """Of every run, s."""
        return self.rows[0].duration

    @property
    def sigmas(self) -> tuple[float, ...]:
        """The swept velocity noise, ascending, rad/s and m/s."""
        return tuple(sorted({row.sigma for row in self.rows if row.sigma is not None}))

    def select(
        self, controller: str, estimator: str, sigma: float | None, *, gains: str | None = None
    ) -> tuple[NoiseRow, ...]:
        """The runs of a point, one per seed; ``gains`` defaults to those that the estimator is
        swept with.
        """
        key = (controller, estimator, sigma, gains or GAINS_OF[estimator])
        return tuple(
            row for row in self.rows if (row.controller, row.estimator, row.sigma, row.gains) == key
        )

    def point(
        self, controller: str, estimator: str, sigma: float | None, *, gains: str | None = None
    ) -> NoiseRow:
        """The runs of a point as one: means over the seeds, the largest forces; NaN when any of
        them diverged.
        """
        rows = self.select(controller, estimator, sigma, gains=gains)
        ended = [row.outcome for row in rows if row.diverged]
        share = f" ({len(ended)} of {len(rows)} runs)" if ended and len(rows) > 1 else ""
        return dataclasses.replace(
            rows[0],
            outcome=f"{ended[0] if ended else 'completed'}{share}",
            itae=float(np.mean([row.itae for row in rows])),
            isv=float(np.mean([row.isv for row in rows])),
            rms_error={
                name: float(np.sqrt(np.mean([row.rms_error[name] ** 2 for row in rows])))
                for name in GROUPS
            },
            peak_force={
                name: float(np.max([row.peak_force[name] for row in rows])) for name in GROUPS
            },
        )

    def curves(self) -> Iterator[tuple[str, str, list[NoiseRow]]]:
        """(controller, estimator, its points by sigma, the sensor set last)."""
        for estimator in GAINS_OF:
            for controller in self.noise_gain:
                points = [
                    self.point(controller, estimator, sigma) for sigma in (*self.sigmas, None)
                ]
                yield controller, estimator, points


def study_noise(
    *,
    seeds: int = 1,
    sigmas: Sequence[float] = SIGMAS,
    duration: float = 20.0,
    controllers: Sequence[str] = CONTROLLERS,
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> NoiseStudy:
    """Run every controller with both estimators at every noise level, and with the sensors of
    ``flight_sensors``.

    Args:
      seeds: runs per point, with random seeds from 0 on.
      sigmas: velocity noise, one standard deviation for all coordinates, rad/s and m/s.
      duration: of each run, s.
      controllers: some of ``CONTROLLERS``.
      workers, progress: as for ``map_tasks``.

    Raises:
      ScenarioError: an argument cannot be used.
      KeyboardInterrupt: the user stopped the runs.
    """
    from ffsm_drake.control_design.stability.demand import make_demand  # SciPy is slow to import

    cases = study_cases(seeds=seeds, sigmas=sigmas, duration=duration, controllers=controllers)
    return NoiseStudy(
        rows=tuple(map_tasks(run_case, cases, workers=workers, progress=progress)),
        ideal_isv=make_demand(cases[0].scenario()).ideal_isv,
        sample_time=cases[0].scenario().sample_time,
        noise_gain={controller: _noise_gain(controller) for controller in controllers},
    )


def run_case(case: NoiseCase) -> NoiseRow:
    """Simulate one case. Raises KeyboardInterrupt when the user stopped it."""
    scenario = case.scenario()
    # the study shows which of these loops are unstable
    record = simulate(scenario, check_stability=False)
    if record.outcome.status == "interrupted":
        raise KeyboardInterrupt
    completed, metrics, data = record.outcome.completed, record.metrics, record.dataset
    counts = 1.0 if completed else math.nan
    error = data["error"].values[data["time"].values > settled_after(case.duration)]
    group = data["group"].values
    return NoiseRow(
        **vars(case),
        outcome="completed" if completed else f"diverged at {record.outcome.time:.2f} s",
        itae=counts * float(metrics["itae"]),
        isv=counts * float(metrics["isv"]),
        isv_predicted=_predicted_isv(dataclasses.replace(case, seed=0)),
        rms_error={
            name: float(np.sqrt(np.mean(error[:, group == name] ** 2))) if completed else math.nan
            for name in GROUPS
        },
        peak_force={name: counts * float(value) for name, value in metrics["peak_effort"].items()},
    )


def settled_after(duration: float) -> float:
    """s; the rms error counts from here on."""
    return min(5.0, 0.25 * duration)


@functools.cache  # expensive, and the same for every seed
def _predicted_isv(case: NoiseCase) -> float:
    from ffsm_drake.control_design.stability.prediction import predict  # SciPy is slow to import

    return predict(case.scenario(), settled_after=settled_after(case.duration)).isv


def _noise_gain(controller: str) -> float:
    """Rms of Hhat^-1 tau on a base attitude axis per unit of velocity noise, published gains, 1/s,
    for H = Hhat.
    """
    from ffsm_drake.control_design.stability.one_axis import axis_loop
    from ffsm_drake.spacecraft.nominal import make_nominal_plant
    from ffsm_drake.systems.controllers import make_law

    scenario = NoiseCase(
        controller=controller, estimator="one_sample", gains="published", sigma=1.0
    ).scenario()
    loop = axis_loop(make_law(scenario, make_nominal_plant(scenario)).by_axis)
    covariance = loop.covariance(position_noise=0.0, velocity_noise=1.0)
    force = loop.part("force")
    return float(np.sqrt(covariance[0, force, force]))
