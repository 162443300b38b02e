"""The system around every control law: sampled, held, all memory in the context."""

from collections.abc import Mapping

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from ffsm_drake.common.guard import calling
from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.common.so3 import rotation_error, rotation_error_rate
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers.checked import (
    check_law,
    checked_memory,
    checked_step,
    mapping,
    memory_of,
)
from ffsm_drake.systems.controllers.law import ControlLaw, Sample
from ffsm_drake.systems.frame_path import FRAME_SIZE

# Memory of a law that becomes an output and is recorded: (nv) each, and one number.
OPTIONAL_OUTPUTS = ("sliding_variable", "reaching_gain", "switching_gain")
SMALLEST = "smallest_singular_value"
_ONE = np.ones(1)


class SampledController(LeafSystem):
    """A control law, evaluated once per control period.

    The law sees no error of undriven coordinates, and commands no force on them.

    Inputs:
      estimated_state: measured [q; v] (nq + nv).
      desired_state: [q_d; v_d] (nq + nv).
      desired_acceleration: (nv).
      applied_force: optional (nv), the force over the last period (saturated, quantised); the
        default is the commanded force.
      measurement_is_new: optional (nq + nv), 1 where the sample brings a new measurement; without
        it all are new.
      desired_frame: optional (19), for a law that tracks a frame; see ``Sample.desired_frame``.
    Outputs, read from the state so that no integrator stage runs Python:
      generalized_force: tau (nv), held over the period: base torque and force in world axes, joint
        torques.
      sliding_variable, reaching_gain, switching_gain: (nv), if the law's memory has them.
      smallest_singular_value: (1), if the law's memory has it.
    Discrete state, updated every ``sample_time``:
      generalized_force (nv), has_previous (1; 0 before the first update), then the law's memory by
        name.
    """

    def __init__(
        self,
        law: ControlLaw,
        *,
        name: str,
        coordinates: Coordinates,
        sample_time: float,
        place: str = "",
    ) -> None:
        """Args: a law for ``coordinates``; the system's name; the control period L, s; what names
        the law in errors, by default the system's name.

        Raises BlockError: a user-supplied law breaks its contract.
        """
        super().__init__()
        self.set_name(name)
        self.law, self._place = law, place or name
        memory = memory_of(law, self._place)
        check_law(law, self._place, memory, len(coordinates.names))
        self._step = checked_step(law, self._place)
        num_velocities = len(coordinates.names)
        self._num_positions = len(coordinates.position_names)
        self._undriven = np.flatnonzero(~coordinates.is_driven) if coordinates.undriven else None
        num_states = self._num_positions + num_velocities
        self._estimated_state = self.DeclareVectorInputPort("estimated_state", num_states)
        self._desired_state = self.DeclareVectorInputPort("desired_state", num_states)
        self._desired_acceleration = self.DeclareVectorInputPort(
            "desired_acceleration", num_velocities
        )
        self._applied_force = self.DeclareVectorInputPort("applied_force", num_velocities)
        self._is_new = self.DeclareVectorInputPort("measurement_is_new", num_states)
        self._desired_frame = (
            self.DeclareVectorInputPort("desired_frame", FRAME_SIZE)
            if getattr(law, "tracks_frame", False)
            else None
        )
        self._force = self.DeclareDiscreteState(np.zeros(num_velocities))
        self._has_previous = self.DeclareDiscreteState(np.zeros(1))
        self._memory = {key: self.DeclareDiscreteState(value) for key, value in memory.items()}
        self._shapes = {key: value.shape for key, value in memory.items()}
        self.DeclareStateOutputPort("generalized_force", self._force)
        for key in (*OPTIONAL_OUTPUTS, SMALLEST):
            if key in self._memory:
                self.DeclareStateOutputPort(key, self._memory[key])
        self.DeclarePeriodicDiscreteUpdateEvent(sample_time, 0.0, weak_callback(self._update))
        untie(self)

    def state(self, context: Context, name: str) -> np.ndarray:
        """A copy of one piece of the discrete state, by its name in the class docstring."""
        index = {
            "generalized_force": self._force,
            "has_previous": self._has_previous,
            **self._memory,
        }[name]
        return np.array(context.get_discrete_state(index).value())

    def remember_velocity(self, context: Context, velocity: np.ndarray) -> None:
        """Set the memory of the previous sample's velocity (nv), desired or measured."""
        for name in ("delayed_desired_velocity", "delayed_velocity"):
            if name in self._memory:
                context.SetDiscreteState(self._memory[name], velocity)

    def resume(
        self,
        context: Context,
        before: "SampledController",
        context_before: Context,
        reference: np.ndarray,
    ) -> None:
        """Take over from another controller; the next sample is a first one, as velocities jump.

        Args:
          context: this controller's context.
          before: the other controller, with the same law for another payload.
          context_before: the other controller's context.
          reference: [q_d; v_d] (nq + nv) at that instant.
        """
        memory = {name: before.state(context_before, name) for name in self._memory}
        returned = calling(self._place, self.law.resume, memory, before.law, reference)
        memory = checked_memory(returned, f"{self._place}: resume", self._shapes)
        context.SetDiscreteState(self._force, before.state(context_before, "generalized_force"))
        for name, index in self._memory.items():
            context.SetDiscreteState(index, memory[name])

    def memory_groups(self) -> Mapping[str, int]:
        """The discrete group of each piece of the law's memory, by name."""
        return {name: int(index) for name, index in self._memory.items()}

    def held_groups(self) -> Mapping[str, tuple[int, float | None]]:
        """Discrete groups that a linearisation holds, name -> (group, value), see
        ``ControlLaw.held``.
        """
        held = mapping(calling(self._place, self.law.held), f"{self._place}: held")
        groups = {name: (int(self._memory[name]), value) for name, value in held.items()}
        return {"has_previous": (int(self._has_previous), 1.0), **groups}

    def _update(self, context: Context, discrete_values: DiscreteValues) -> None:
        estimated = self._estimated_state.Eval(context)
        desired = self._desired_state.Eval(context)
        split = self._num_positions
        # coordinates.position_error and error_rate, in one step.
        difference = desired - estimated
        e, e_dot = difference[1:split], difference[split:]
        e[:3] = rotation = rotation_error(desired[:4], estimated[:4])
        e_dot[:3] = rotation_error_rate(
            rotation, desired[split : split + 3], estimated[split : split + 3]
        )
        if self._undriven is not None:
            e[self._undriven] = e_dot[self._undriven] = 0.0
        value = context.get_discrete_state().value
        is_first = not value(self._has_previous).item()
        sample = Sample(
            estimated[:split],
            estimated[split:],
            desired[:split],
            desired[split:],
            self._desired_acceleration.Eval(context),
            e,
            e_dot,
            self._applied_force.Eval(context)
            if self._applied_force.HasValue(context)
            else value(self._force),
            is_first,
            # The quaternion has one entry more than the rotation vector.
            self._is_new.Eval(context)[1:] != 0.0 if self._is_new.HasValue(context) else None,
            None
            if self._desired_frame is None or not self._desired_frame.HasValue(context)
            else self._desired_frame.Eval(context),
        )
        state = dict(zip(self._memory, map(value, self._memory.values()), strict=False))
        force, memory = self._step(sample, state, context.get_time)
        if is_first:
            discrete_values.set_value(self._has_previous, _ONE)  # values that are not set stay
        if self._undriven is not None:
            force = np.array(force)
            force[self._undriven] = 0.0
        discrete_values.set_value(self._force, force)
        for name, index in self._memory.items():
            discrete_values.set_value(index, memory[name])
