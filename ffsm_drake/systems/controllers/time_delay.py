"""Time-delay control: a control law made of a nominal model, an estimator and injected dynamics.

The plant is q'' = N + Hhat^-1 tau with everything unknown in N (equation (2)). One sample ago N was
q''(t-L) - Hhat^-1 tau(t-L) (equation (5)), and using that for the present N gives

    tau_k = tau_{k-1} - Hhat q''_{k-1} + Hhat u_k,      q''_{k-1} = (qdot_k - qdot_{k-1}) / L,

where only the *injected dynamics* u differs between controllers (equations (6), (17), (18),
(20)).
"""

import abc
import dataclasses
from collections.abc import Mapping
from operator import attrgetter
from typing import Any, ClassVar, Self

import numpy as np

from ffsm_drake.common.errors import BlockError
from ffsm_drake.spacecraft.coordinates import halves
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.estimation import Estimator, make_estimator
from ffsm_drake.systems.controllers.law import (
    ControlLaw,
    ReachingGain,
    Sample,
    State,
    field_values,
)
from ffsm_drake.systems.setup import BlockSetup


class InjectedDynamics(abc.ABC):
    """Base class of laws with time-delay estimation, which differ in the injected dynamics u.

    A law is a frozen dataclass with a method ``step``, which returns the acceleration u. The
    estimator of the scenario and the nominal model turn u into a force.

    Example:
      >>> from dataclasses import dataclass
      >>> from ffsm_drake import InjectedDynamics, gain, load_scenario, simulate
      >>> @dataclass(frozen=True, kw_only=True)
      ... class Pd(InjectedDynamics):
      ...     k_p: float = gain(25.0, "1/s^2")
      ...     k_d: float = gain(10.0, "1/s")
      ...     def step(self, e, e_dot, a_d, state):
      ...         return a_d + self.k_d * e_dot + self.k_p * e, state
      >>> scenario = load_scenario("postcapture", ["duration=0.1"])
      >>> simulate(scenario, blocks={"controller": Pd}, check_stability=False).outcome.status
      'completed'
    """

    # False: ``ffsm stability`` prints no limits by coordinate. Otherwise it tries whether the law
    # acts on each coordinate separately, and linearly while the states of ``held`` are constant.
    by_axis: ClassVar[bool] = True

    def initial_state(self) -> State:
        """Return the initial states of the law: name -> array. By default there are none."""
        return {}

    sliding_unit: ClassVar[str] = ControlLaw.sliding_unit

    def held(self) -> Mapping[str, float | None]:
        """See ControlLaw."""
        return {}

    @property
    def reaching_gain(self) -> ReachingGain | None:
        """See ControlLaw."""
        return None

    def with_reaching_gain(self, k_s: np.ndarray) -> Self:
        """Return the law with another initial K_s (..., nv). A law without K_s stays unchanged.

        Override this method if the ``start`` of ``reaching_gain`` is not itself a field of the law.

        Raises:
          BlockError: it is not, and the law does not override this method.
        """
        gain = self.reaching_gain
        if gain is None:
            return self
        for name, value in vars(self).items():
            if value is gain.start:
                return dataclasses.replace(self, **{name: k_s})  # type: ignore[type-var]
        raise BlockError(
            f"{type(self).__name__} defines reaching_gain; it also needs "
            "with_reaching_gain(k_s), which returns the law with that K_s"
        )

    @classmethod
    def gains_for(cls, omega: Any, k_s: Any) -> dict[str, Any]:
        """Return the gains that place the poles of an axis at the natural frequency ``omega``.

        Override this method so that ``ffsm design`` chooses the gains by pole placement. Without
        it, ``ffsm design`` varies the declared gains by group.

        Args:
          omega: natural frequency, rad/s; a number or an array.
          k_s: reaching gain K_s, 1/s, used if ``chooses_k_s`` is True; a number or an array.

        Returns: name of a gain -> value. Empty: the law has no such design.
        """
        return {}

    # True if ``gains_for`` has a separate choice of K_s; else its ``k_s`` is not used.
    chooses_k_s: ClassVar[bool] = False

    @classmethod
    def starting_gains(
        cls, omega: np.ndarray, mass_matrices: np.ndarray
    ) -> Mapping[str, np.ndarray | float]:
        """See ControlLaw."""
        return cls.gains_for(omega, omega)

    def resume(self, state: State, ratio: np.ndarray) -> State:
        """Return the states that change at the grasp of a target, by name.

        Override this method in a law with an integral or an adapted gain. By default no state
        changes.

        Args:
          state: the state before the grasp.
          ratio: Hhat^-1 after the grasp times Hhat before it (nv, nv), which converts an
            acceleration to the acceleration due to the same force.
        """
        return {}

    @abc.abstractmethod
    def step(
        self, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, state: State
    ) -> tuple[np.ndarray, State]:
        """One control sample; arrays (..., nv).

        Args:
          e, e_dot: tracking error q_d - q and its rate.
          a_d: desired acceleration.
          state: the memory at this sample, by name; must not be changed in place.

        Returns: the commanded acceleration u, and the memory at the next sample.
        """

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> "TimeDelayControl":
        """Time-delay control with these dynamics and the scenario's estimator. Raises the errors of
        ControlLaw.from_setup.
        """
        return TimeDelayControl(
            model=setup.nominal,
            estimator=make_estimator(setup.mission, setup.coordinates, grip=setup.grip),
            dynamics=cls(**field_values(cls, setup)),
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class TimeDelayControl(ControlLaw):
    """tau = base force + Hhat (u - base acceleration), u being the injected dynamics.

    The estimator gives base force and base acceleration.
    """

    model: PlantModel
    estimator: Estimator
    dynamics: InjectedDynamics
    held = property(attrgetter("dynamics.held"))
    reaching_gain = property(attrgetter("dynamics.reaching_gain"))
    sliding_unit = property(attrgetter("dynamics.sliding_unit"))
    random_walks = property(attrgetter("estimator.random_walks"))

    def initial_state(self) -> State:
        return {**self.estimator.initial_state(), **self.dynamics.initial_state()}

    @property
    def by_axis(self) -> Self | None:
        return self if self.dynamics.by_axis and self.estimator.by_axis else None

    def with_reaching_gain(self, k_s: np.ndarray) -> Self:
        """Return the law with another K_s (..., nv), 1/s, at the start."""
        return dataclasses.replace(self, dynamics=self.dynamics.with_reaching_gain(k_s))

    def resume(self, state: State, before: ControlLaw, reference: np.ndarray) -> State:
        """See ControlLaw: accelerations in the memory continue as the forces that they took."""
        if not isinstance(before, TimeDelayControl):
            return state
        ratio, v_d = after_grasp(self.model, before.model, reference)
        changed = self.estimator.resume(state, ratio, v_d)
        return {**state, **changed, **self.dynamics.resume(state, ratio)}

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        mass_matrix = self.model.calc_mass_matrix(sample.q)  # raises unless finite
        if mass_matrix.shape != (*sample.v.shape, sample.v.shape[-1]):
            raise BlockError(
                f"the model's mass matrix has the shape {mass_matrix.shape}; it must be "
                f"{(*sample.v.shape, sample.v.shape[-1])}"
            )
        estimate, estimator_state = self.estimator.step(sample, mass_matrix, state)
        u, dynamics_state = self.dynamics.step(estimate.e, estimate.e_dot, sample.a_d, state)
        force = time_delay_force(
            delayed_force=estimate.base_force,
            nominal_mass_matrix=mass_matrix,
            delayed_acceleration=estimate.base_acceleration,
            u=u,
        )
        return force, {**estimator_state, **dynamics_state}


def after_grasp(
    model: PlantModel, before: PlantModel, reference: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Hhat^-1 of after times Hhat of before a grasp (nv, nv), and v_d (nv), from [q_d; v_d]."""
    q, v_d = halves(reference)
    return np.linalg.solve(model.calc_mass_matrix(q), before.calc_mass_matrix(q)), v_d


def time_delay_force(
    *,
    delayed_force: np.ndarray,
    nominal_mass_matrix: np.ndarray,
    delayed_acceleration: np.ndarray,
    u: np.ndarray,
) -> np.ndarray:
    """Return the generalized force tau_k (..., nv) of equation (6): tau_{k-1} + Hhat (u_k -
    q''_{k-1}), N m and N.
    """
    return delayed_force + nominal_mass_matrix.dot(u - delayed_acceleration)
