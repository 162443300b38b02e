"""Time-delay estimation: what the four controllers share.

The plant is q'' = N + Hhat^-1 tau with everything unknown in N (equation (2)). One sample ago N was
q''(t-L) - Hhat^-1 tau(t-L) (equation (5)), and taking that for the present N gives

    tau_k = tau_{k-1} - Hhat q''_{k-1} + Hhat u_k,      q''_{k-1} = (qdot_k - qdot_{k-1}) / L,

in which the *injected dynamics* u is all that tells one controller from another (equations (6), (17), (18), (20)).
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from ffsm_drake.controllers.base import OPTIONAL_OUTPUTS
from ffsm_drake.controllers.estimators import Arrays, Estimator, Measurement
from ffsm_drake.coordinates import rotation_error
from ffsm_drake.plant import PlantModel

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
    Outputs, all functions of the state, and the first two it itself, so that no integrator stage and no logger runs
    Python:
      generalized_force: tau (nv), held over the period: base torque and force in world axes, joint torques.
      memory: all state but that; ``recorded_memory`` says where the following stand in it.
      sliding_variable: s at the last update; reaching_gain, switching_gain: K_s and G for the next. Only where the law
        has them.
    Discrete state, updated every ``sample_time``:
      delayed_force (tau of the last sample), then in one vector the estimator's own (delayed_velocity for the published
      one), the law's, and has_previous (0 before the first update, when the acceleration is taken as zero).
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
        memory = {**estimator.initial_state(), **law.initial_state()}
        self._shape = len(memory), num_velocities
        parts = {name: slice(i * num_velocities, (i + 1) * num_velocities) for i, name in enumerate(memory)}
        self._parts = parts | {"has_previous": slice(len(memory) * num_velocities, None)}
        self._force = self.DeclareDiscreteState(num_velocities)
        # All in one vector, which is sooner read, written and logged than seven.
        self._memory = self.DeclareDiscreteState(np.concatenate([*memory.values(), np.zeros(1)]))
        self.DeclareStateOutputPort("generalized_force", self._force)
        self.DeclareStateOutputPort("memory", self._memory)
        for name in self.recorded_memory:
            self.DeclareVectorOutputPort(
                name,
                num_velocities,
                functools.partial(self._calc_part, parts[name]),
                {self.discrete_state_ticket(self._memory)},
            )
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
        """A copy of one named piece of the discrete state; the names are those of the class docstring."""
        if name == "delayed_force":
            return np.array(context.get_discrete_state(self._force).value())
        return np.array(context.get_discrete_state(self._memory).value()[self._parts[name]])

    @property
    def recorded_memory(self) -> dict[str, slice]:
        """Of the optional outputs those that the law has, and where they stand in the output ``memory``."""
        return {name: self._parts[name] for name in OPTIONAL_OUTPUTS if name in self._parts}

    def _calc_part(self, part: slice, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._memory).value()[part])

    def _update(self, context: Context, discrete_values: DiscreteValues) -> None:
        estimated = self._estimated_state.Eval(context)
        desired = self._desired_state.Eval(context)
        split = self._num_positions
        mass_matrix = self._nominal.calc_mass_matrix(estimated[:split])  # which refuses what is not finite
        # As coordinates.position_error, with the rate in the same step: a difference of quaternions is none of rotations.
        difference = desired - estimated
        e, e_dot = difference[1:split], difference[split:]
        e[:3] = rotation_error(desired[:4], estimated[:4])
        old = context.get_discrete_state()
        delayed_force, memory = old.value(self._force), old.value(self._memory)
        state = [*memory[:-1].reshape(self._shape)]
        measured = Measurement(
            e,
            e_dot,
            estimated[split:],
            desired[split:],
            self._applied_force.Eval(context) if self._applied_force.HasValue(context) else delayed_force,
            mass_matrix,
            memory.item(-1),
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
        discrete_values.set_value(self._force, force)
        discrete_values.set_value(self._memory, np.concatenate((*next_estimator_state, *next_law_state, _ONE)))
