"""Time-delay estimation: what the four controllers share.

The plant is q'' = N + Hhat^-1 tau with everything unknown in N (equation (2)). One sample ago N was
q''(t-L) - Hhat^-1 tau(t-L) (equation (5)), and taking that for the present N gives

    tau_k = tau_{k-1} - Hhat q''_{k-1} + Hhat u_k,      q''_{k-1} = (qdot_k - qdot_{k-1}) / L,

in which the *injected dynamics* u is all that tells one controller from another (equations (6), (17), (18), (20)).
"""

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.spacecraft.coordinates import rotation_error
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.estimators import Arrays, Estimator, Measurement
from ffsm_drake.systems.controllers.sampled import OPTIONAL_OUTPUTS

_ONE = np.ones(1)


class InjectedDynamics(Protocol):
    """The part of a controller that is its own: a pure function of arrays, all of them (nv)."""

    def initial_state(self) -> Mapping[str, np.ndarray]:
        """Name -> initial value of each piece of state, in the order that ``step`` takes and returns them."""
        ...

    def step(
        self, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, state: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, Arrays]:
        """One control sample.

        Args:
          e, e_dot: tracking error q_d - q and its rate.
          a_d: desired acceleration.
          state: the state at this sample; must not be changed in place.

        Returns: the commanded acceleration u, and the state at the next sample.
        """
        ...


def time_delay_force(
    *, delayed_force: np.ndarray, nominal_mass_matrix: np.ndarray, delayed_acceleration: np.ndarray, u: np.ndarray
) -> np.ndarray:
    """Generalized force tau_k (nv) of equation (6): tau_{k-1} + Hhat (u_k - q''_{k-1}), N m and N."""
    return delayed_force + nominal_mass_matrix.dot(u - delayed_acceleration)  # on so few numbers faster than @


class TimeDelayController(LeafSystem):
    """A sampled controller: an estimate of the lumped uncertainty, and injected dynamics on top of it.

    Inputs:
      estimated_state: measured [q; v] (nq + nv).
      desired_state: [q_d; v_d] (nq + nv).
      desired_acceleration: (nv).
      applied_force: optional (nv), the force that really acted over the last period (saturated, quantised); without it
        the commanded force is taken to have acted.
    Outputs, all read straight from the state so that no integrator stage runs Python:
      generalized_force: tau (nv), held over the period: base torque and force in world axes, joint torques.
      sliding_variable: s at the last update; reaching_gain, switching_gain: K_s and G for the next. Only where the law
        has them.
    Discrete state, updated every ``sample_time``:
      delayed_force (tau of the last sample), has_previous (0 before the first update, when the acceleration is taken
      as zero), then the estimator's own (delayed_velocity for the published one), then the law's.
    """

    def __init__(self, *, nominal: PlantModel, estimator: Estimator, law: InjectedDynamics, sample_time: float) -> None:
        super().__init__()
        self._nominal = nominal
        self._estimator = estimator
        self._law = law
        num_velocities = len(nominal.coordinates.names)
        self._num_positions = num_velocities + 1
        num_states = self._num_positions + num_velocities
        self._estimated_state = self.DeclareVectorInputPort("estimated_state", num_states)
        self._desired_state = self.DeclareVectorInputPort("desired_state", num_states)
        self._desired_acceleration = self.DeclareVectorInputPort("desired_acceleration", num_velocities)
        self._applied_force = self.DeclareVectorInputPort("applied_force", num_velocities)
        self._num_estimator_states = len(estimator.initial_state())
        groups = {
            "delayed_force": np.zeros(num_velocities),
            "has_previous": np.zeros(1),
            **estimator.initial_state(),
            **law.initial_state(),
        }
        self._state_index = {name: self.DeclareDiscreteState(value) for name, value in groups.items()}
        self._groups = range(len(groups))
        self.DeclareStateOutputPort("generalized_force", self._state_index["delayed_force"])
        for name in OPTIONAL_OUTPUTS:
            if name in self._state_index:
                self.DeclareStateOutputPort(name, self._state_index[name])
        self.DeclarePeriodicDiscreteUpdateEvent(sample_time, 0.0, weak_callback(self._update))
        untie(self)

    def get_estimated_state_input_port(self) -> InputPort:
        return self._estimated_state

    def get_desired_state_input_port(self) -> InputPort:
        return self._desired_state

    def get_desired_acceleration_input_port(self) -> InputPort:
        return self._desired_acceleration

    def get_generalized_force_output_port(self) -> OutputPort:
        return self.GetOutputPort("generalized_force")

    def state(self, context: Context, name: str) -> np.ndarray:
        """A copy of one named group of the discrete state; the names are those of the class docstring."""
        return np.array(context.get_discrete_state(self._state_index[name]).value())

    def _update(self, context: Context, discrete_values: DiscreteValues) -> None:
        estimated = self._estimated_state.Eval(context)
        desired = self._desired_state.Eval(context)
        split = self._num_positions
        mass_matrix = self._nominal.calc_mass_matrix(estimated[:split])  # which refuses what is not finite
        # As coordinates.position_error, and the rate in the same step.
        difference = desired - estimated
        e, e_dot = difference[1:split], difference[split:]
        e[:3] = rotation_error(desired[:4], estimated[:4])
        old = context.get_discrete_state()
        delayed_force, has_previous, *state = map(old.value, self._groups)
        measured = Measurement(
            e,
            e_dot,
            estimated[split:],
            desired[split:],
            self._applied_force.Eval(context) if self._applied_force.HasValue(context) else delayed_force,
            mass_matrix,
            has_previous.item(),
        )
        split = self._num_estimator_states
        estimate, next_estimator_state = self._estimator.step(measured, state[:split])
        u, next_law_state = self._law.step(
            estimate.e, estimate.e_dot, self._desired_acceleration.Eval(context), state[split:]
        )
        force = time_delay_force(
            delayed_force=estimate.base_force,
            nominal_mass_matrix=mass_matrix,
            delayed_acceleration=estimate.base_acceleration,
            u=u,
        )
        discrete_values.set_value(0, force)
        if not measured.has_previous:  # unset, a value stays what it was
            discrete_values.set_value(1, _ONE)
        for index, value in enumerate((*next_estimator_state, *next_law_state), start=2):
            discrete_values.set_value(index, value)
