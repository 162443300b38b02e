"""The system around every control law: sampled, held, all memory in the context."""

from collections.abc import Mapping

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from ffsm_drake.common.guard import calling
from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.common.returned import arrays, mapping
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers.checked import check_law, checked_step, memory_of
from ffsm_drake.systems.controllers.law import ControlLaw, State
from ffsm_drake.systems.controllers.law_block import REQUIRED, LawBlock
from ffsm_drake.systems.parts.signals import UNIT, Signal
from ffsm_drake.systems.sampled import Now

SMALLEST = "smallest_singular_value"
# Memory of a law that becomes an output and is recorded: (nv), or one number without a dimension.
LAW_SIGNALS = (
    Signal(
        name="sliding_variable", unit=ControlLaw.sliding_unit, dimension="coordinate",
        meaning="sliding variable s of this sample", heading="Sliding variable s [{unit}/s]",
    ),
    Signal(
        name="reaching_gain", unit="1/s", meaning="K_s used by this sample, 1/s",
        dimension="coordinate", held=False, heading="Gain Kₛ [1/s]",
    ),
    Signal(
        name="switching_gain", unit=f"{UNIT} per s^2", meaning="G used by this sample",
        dimension="coordinate", held=False, heading="Gain G [{unit}/s²]",
    ),
    Signal(
        name=SMALLEST, unit="1", heading="",
        meaning="smallest singular value of the joints' J*, rad counted as m",
    ),
)  # fmt: skip
OPTIONAL_OUTPUTS = tuple(each.name for each in LAW_SIGNALS if each.dimension)
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
      measurement_is_new: optional (nq + nv), 1 for entries with a new measurement at this sample;
        without the port all are new.
      desired_frame: optional (19), for a law tracking a frame; see ``Sample.desired_frame``.
      measured_wrench: optional (6 for each contact), for a law with ``contacts_read``.
      restart: optional (1), above 0.5 if the law restarts at this sample.
    Outputs, read from the state; no integrator stage runs Python:
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
        restarts: bool = False,
    ) -> None:
        """Args:
          law: a law for ``coordinates``.
          name: name of the system.
          coordinates: names of the generalized velocities.
          sample_time: the control period L, s.
          place: name of the law in errors; default: the system's name.
          restarts: whether there is a port ``restart``.

        Raises BlockError: a user-supplied law breaks its contract.
        """
        super().__init__()
        self.set_name(name)
        self.law, self._place = law, place or name
        self._block = LawBlock(law, coordinates, step=checked_step(law, self._place))
        self._restart = self.DeclareVectorInputPort("restart", 1) if restarts else None
        memory = memory_of(law, self._place)
        check_law(law, self._place, memory, len(coordinates.names))
        self._declare_inputs()
        self._declare_state(len(coordinates.names), memory)
        self.DeclareStateOutputPort("generalized_force", self._force)
        self.part = getattr(law, "part", None)  # describes further ones, ``logged``
        for key in (*(each.name for each in LAW_SIGNALS), *getattr(law, "logged", ())):
            if key in self._memory:
                self.DeclareStateOutputPort(key, self._memory[key])
        self.DeclarePeriodicDiscreteUpdateEvent(sample_time, 0.0, weak_callback(self._update))
        untie(self)

    def _declare_inputs(self) -> None:
        ports = {
            name: self.DeclareVectorInputPort(name, size)
            for name, size in self._block.inputs.items()
        }
        self._required = {name: ports.pop(name) for name in REQUIRED}
        self._optional = ports

    def _declare_state(self, num_velocities: int, memory: State) -> None:
        self._first = memory
        self._force = self.DeclareDiscreteState(np.zeros(num_velocities))
        self._has_previous = self.DeclareDiscreteState(np.zeros(1))
        self._memory = {
            key: self.DeclareDiscreteState(value.ravel()) for key, value in memory.items()
        }
        self._shapes = {key: value.shape for key, value in memory.items()}

    def state(self, context: Context, name: str) -> np.ndarray:
        """Return a copy of one piece of the discrete state, by its name in the class docstring."""
        index = {
            "generalized_force": self._force,
            "has_previous": self._has_previous,
            **self._memory,
        }[name]
        return np.array(context.get_discrete_state(index).value())

    def begin(self, context: Context, force: np.ndarray) -> None:
        """Let a force (nv) act, with the law at its start."""
        context.SetDiscreteState(self._force, force)

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
        self.begin(context, before.state(context_before, "generalized_force"))
        memory = {
            name: before.state(context_before, name).reshape(shape)
            for name, shape in before._shapes.items()
        }
        resumed = self.resumed(memory, before.law, reference)
        for name, index in self._memory.items():
            context.SetDiscreteState(index, np.ravel(resumed[name]))

    def resumed(self, memory: State, before: ControlLaw, reference: np.ndarray) -> State:
        """Return the law's memory as ``resume`` sets it, from the memory of another law."""
        alike = dict(self._first)  # afresh where the other has nothing alike
        for name, first in self._first.items():
            if name in memory and memory[name].shape == first.shape:
                alike[name] = memory[name]
        returned = calling(self._place, self.law.resume, alike, before, reference)
        return arrays(returned, f"{self._place}: resume", shapes=self._shapes)

    def memory_groups(self) -> Mapping[str, int]:
        """Return the discrete group of each piece of the law's memory, by name."""
        return {name: int(index) for name, index in self._memory.items()}

    def held_groups(self) -> Mapping[str, tuple[int, float | None]]:
        """Discrete groups that a linearisation holds, name -> (group, value), see
        ``ControlLaw.held``.
        """
        held = mapping(calling(self._place, self.law.held), f"{self._place}: held")
        groups = {name: (int(self._memory[name]), value) for name, value in held.items()}
        return {"has_previous": (int(self._has_previous), 1.0), **groups}

    def read(self, context: Context) -> tuple[State, State]:
        """Return the inputs of an update, by name: connected input ports, and the law's memory."""
        value = context.get_discrete_state().value
        inputs = {name: port.Eval(context) for name, port in self._required.items()}
        for name, port in self._optional.items():
            if port.HasValue(context):
                inputs[name] = port.Eval(context)
        inputs.setdefault("applied_force", value(self._force))
        memory = dict(zip(self._memory, map(value, self._memory.values()), strict=False))
        return inputs, memory

    def step(
        self, inputs: State, memory: State, *, is_first: bool = False, time: float = 0.0
    ) -> tuple[np.ndarray, State]:
        """Return the force, and the law's memory after it, from what ``read`` gives; ``time`` (s)
        is for errors.
        """
        outputs, memory = self._block.step(inputs, memory, Now(time, is_first=is_first))
        return outputs["generalized_force"], memory

    def _update(self, context: Context, discrete_values: DiscreteValues) -> None:
        inputs, before = self.read(context)
        is_first = not context.get_discrete_state().value(self._has_previous).item()
        if self._restart is not None and self._restart.Eval(context).item() > 0.5:
            is_first, before = True, self._first
        force, memory = self.step(inputs, before, is_first=is_first, time=context.get_time())
        if is_first:
            discrete_values.set_value(self._has_previous, _ONE)  # values that are not set stay
        discrete_values.set_value(self._force, force)
        for name, index in self._memory.items():
            discrete_values.set_value(index, memory[name])
