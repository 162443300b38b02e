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

from ffsm_drake.coordinates import position_error
from ffsm_drake.plant import PlantModel

Arrays = tuple[np.ndarray, ...]

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
    return delayed_force + nominal_mass_matrix @ (u - delayed_acceleration)


class TimeDelayController(LeafSystem):
    """A sampled controller: time-delay estimation around given injected dynamics.

    Inputs:
      estimated_state: measured [q; v] (nq + nv).
      desired_state: [q_d; v_d] (nq + nv).
      desired_acceleration: (nv).
    Outputs, all read straight from the state so that no integrator stage runs Python:
      generalized_force: tau (nv), held over the period: base torque and force in world axes, joint torques.
      sliding_variable: s at the last update; reaching_gain, switching_gain: K_s and G for the next. Only where the law
        has them.
    Discrete state, updated every ``sample_time``:
      delayed_force (tau of the last sample), delayed_velocity (measured), has_previous (0 before the first update, when
      the acceleration is taken as zero), then the law's own.
    """

    OPTIONAL_OUTPUTS = ("sliding_variable", "reaching_gain", "switching_gain")

    def __init__(self, *, nominal: PlantModel, law: InjectedDynamics, sample_time: float) -> None:
        super().__init__()
        self._nominal = nominal
        self._law = law
        self._sample_time = sample_time
        num_velocities = len(nominal.coordinates.names)
        self._num_positions = num_velocities + 1
        num_states = self._num_positions + num_velocities
        self._estimated_state = self.DeclareVectorInputPort("estimated_state", num_states)
        self._desired_state = self.DeclareVectorInputPort("desired_state", num_states)
        self._desired_acceleration = self.DeclareVectorInputPort("desired_acceleration", num_velocities)
        zeros = np.zeros(num_velocities)
        groups = {"delayed_force": zeros, "delayed_velocity": zeros, "has_previous": np.zeros(1), **law.initial_state()}
        self._state_index = {name: self.DeclareDiscreteState(value) for name, value in groups.items()}
        self.DeclareStateOutputPort("generalized_force", self._state_index["delayed_force"])
        for name in self.OPTIONAL_OUTPUTS:
            if name in self._state_index:
                self.DeclareStateOutputPort(name, self._state_index[name])
        self.DeclarePeriodicDiscreteUpdateEvent(sample_time, 0.0, self._update)

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
        q, v = estimated[: self._num_positions], estimated[self._num_positions :]
        q_d, v_d = desired[: self._num_positions], desired[self._num_positions :]
        old = context.get_discrete_state()
        delayed_force, delayed_velocity, has_previous, *law_state = map(old.value, range(old.num_groups()))
        u, next_law_state = self._law.step(
            position_error(q_d, q), v_d - v, self._desired_acceleration.Eval(context), law_state
        )
        acceleration = (v - delayed_velocity) * (has_previous[0] / self._sample_time)
        force = time_delay_force(
            delayed_force=delayed_force,
            nominal_mass_matrix=self._nominal.calc_mass_matrix(q),
            delayed_acceleration=acceleration,
            u=u,
        )
        for index, value in enumerate((force, v, _ONE, *next_law_state)):
            discrete_values.set_value(index, value)
