"""The estimator of a time-delay law, and the paper's: the lumped uncertainty N in q'' = N + Hhat^-1
tau (equation (2)) is its value a sample ago.

An estimator gives, at a sample, the input of the law (error and its rate) and a pair (base force,
base acceleration), with which the law's acceleration u becomes the force tau = base force + Hhat (u
- base acceleration).
"""

import abc
import dataclasses
from typing import ClassVar, NamedTuple, Self

import numpy as np

from ffsm_drake.common.errors import ScenarioError, one_line
from ffsm_drake.common.registrations import Registry
from ffsm_drake.mission import Mission
from ffsm_drake.scenario import HELD, Grip
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers.law import Sample, State


class Estimate(NamedTuple):
    """The inputs of the law and of the force; arrays (..., nv)."""

    e: np.ndarray
    e_dot: np.ndarray
    base_force: np.ndarray
    base_acceleration: np.ndarray


class Estimator(abc.ABC):
    """An estimator as a pure function of arrays; a subclass is a frozen dataclass."""

    by_axis: ClassVar[bool] = False  # whether it treats every coordinate by itself, with no delay
    # keys of the scenario's ``estimator`` that are designed: intensities of random walks
    random_walks: ClassVar[tuple[str, ...]] = ()

    @classmethod
    @abc.abstractmethod
    def make(
        cls,
        mission: Mission,
        coordinates: Coordinates,
        jacobian: np.ndarray | None,
        grip: Grip,
    ) -> "Estimator":
        """Return the estimator of a mission; see ``make_estimator``. Raises LinAlgError without a
        stationary filter.
        """

    @abc.abstractmethod
    def initial_state(self) -> State:
        """Return name -> initial value of each piece of the estimator's memory."""

    @abc.abstractmethod
    def step(
        self, sample: Sample, nominal_mass_matrix: np.ndarray, state: State
    ) -> tuple[Estimate, State]:
        """One sample: the estimate, and the memory at the next.

        Args:
          sample: the measured and desired states, and the applied force.
          nominal_mass_matrix: Hhat (..., nv, nv) at this sample.
          state: the memory at this sample, by name; must not be changed in place.
        """

    def resume(self, state: State, ratio: np.ndarray, v_d: np.ndarray) -> State:
        """Changes of the memory at the grasp of a target, by name; the next sample counts as a
        first one. The force of the last sample and an estimated force continue unchanged.

        Args:
          state: the memory up to then.
          ratio: Hhat^-1 Hhat (nv, nv) of after and before: it maps accelerations under the same
            force and, by conservation of momentum, velocity errors to those after the grasp.
          v_d: (nv) the reference's velocity after the grasp.
        """
        names = ("estimated_error_rate", "estimated_negative_n")
        return {name: ratio @ state[name] for name in names if name in state}


@dataclasses.dataclass(frozen=True, kw_only=True)
class OneSampleEstimator(Estimator):
    """Time-delay estimation as published: N(t - L) for N(t), equation (5)."""

    by_axis: ClassVar[bool] = True
    sample_time: float
    num_velocities: int

    @classmethod
    def make(
        cls,
        mission: Mission,
        coordinates: Coordinates,
        jacobian: np.ndarray | None,
        grip: Grip,
    ) -> Self:
        size = len(coordinates.names if jacobian is None else jacobian)
        return cls(sample_time=mission.scenario.sample_time, num_velocities=size)

    def initial_state(self) -> State:
        return {"delayed_velocity": np.zeros(self.num_velocities)}

    def step(
        self, sample: Sample, nominal_mass_matrix: np.ndarray, state: State
    ) -> tuple[Estimate, State]:
        """One sample; see Estimator. Nothing is known of the acceleration at the very first: it
        counts as zero.
        """
        change = sample.v - state["delayed_velocity"]
        acceleration = (
            np.zeros_like(change) if sample.is_first else change * (1.0 / self.sample_time)
        )
        estimate = Estimate(
            sample.e, sample.e_dot, base_force=sample.applied_force, base_acceleration=acceleration
        )
        return estimate, {"delayed_velocity": sample.v}


# By the key ``estimator.kind``; for "one_sample" see above.
ESTIMATORS = Registry[type[Estimator]]("estimators")


def make_estimator(
    mission: Mission,
    coordinates: Coordinates,
    jacobian: np.ndarray | None = None,
    grip: Grip = HELD,
) -> Estimator:
    """Return the estimator of a mission, for the spacecraft's coordinates, or for m coordinates
    with velocities J v and the Jacobian J (m, nv).

    The noise and walk of a Kalman filter in such coordinates follow through J from the
    spacecraft's, taken as independent. An estimator without ``by_axis`` always uses the
    spacecraft's coordinates.

    Raises ScenarioError: unknown or missing coordinates, unsupported sensors, or no stationary
    filter.
    """
    try:
        kind: type[Estimator] = OneSampleEstimator
        if (name := mission.scenario.estimator.kind) != "one_sample":
            kind = ESTIMATORS.load(name, f"estimator.kind: {name}")
        return kind.make(mission, coordinates, jacobian, grip)
    except np.linalg.LinAlgError as error:
        remedy = (
            "bring walk and noises, or periods and delays, of position and velocity closer together"
        )
        raise ScenarioError(
            "estimator", f"has no stationary filter ({one_line(error)}); {remedy}"
        ) from error
