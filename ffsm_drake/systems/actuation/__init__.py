"""Actuators: from the commanded to the applied force. Saturation, quantisation, delay, drives,
wheels, thrusters.
"""

import itertools
from collections.abc import Callable

import numpy as np
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    InputPort,
    OutputPort,
    System,
)
from pydrake.systems.primitives import Demultiplexer, DiscreteTimeDelay, PassThrough, Saturation

from ffsm_drake.scenario import schema
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.actuation.base import BaseActuators, attitude_ahead
from ffsm_drake.systems.actuation.drives import (
    FRICTION_FORCE,
    FRICTION_WORK,
    DriveSet,
    JointDrives,
    JointFriction,
    RateLimit,
)
from ffsm_drake.systems.actuation.thrusters import FiredThrusters, ThrusterSet
from ffsm_drake.systems.actuation.wheels import Gyroscopic, ReactionWheels, WheelSet
from ffsm_drake.systems.part import Part
from ffsm_drake.systems.sensing import Quantizer

# What the sections of ``actuation`` bring to records and pages.
SECTIONS: dict[str, Callable[[schema.Scenario], Part | None]] = {
    "thrusters": FiredThrusters.of,
    "wheels": ReactionWheels.of,
    "drives": JointDrives.of,
}


class Actuators(Diagram):
    """The actuators, from ``commanded_force`` to ``applied_force``; made by ``make_actuation``."""

    wheels: WheelSet | None = None

    def set_initial_state(self, context: Context, state: np.ndarray) -> None:
        """The wheels have their initial momentum, in a base with the attitude of ``state`` [q;
        v].
        """
        if self.wheels is not None:
            stored = self.GetSubsystemByName("gyroscopic")
            rotation = attitude_ahead(state[:4], np.zeros(3), 0.0).reshape(3, 3)
            momentum = rotation.dot(self.wheels.axes.dot(self.wheels.initial_momentum))
            stored.set_momentum(self.GetMutableSubsystemContext(stored, context), momentum)


def make_actuation(
    settings: schema.Actuation,
    coordinates: Coordinates,
    *,
    sample_time: float,
    base: System | None = None,
) -> Actuators | None:
    """A diagram from ``commanded_force`` to ``applied_force``, both (nv): N m and N; None where
    they are the same.

    With thrusters, wheels or drives it has the input ``state`` and outputs for the signals of their
    parts; with wheels ``gyroscopic_force`` (nv), which acts on the plant too, and
    ``stored_momentum``; with friction of the drives ``friction_force`` (nv), which acts on the
    plant too, and ``friction_work`` (nv).

    Args:
      settings: of the actuators.
      coordinates: of the forces.
      sample_time: s.
      base: from force to force (nv), in place of thrusters and wheels.

    Raises:
      ScenarioError: a value is given for an unknown coordinate; thrusters or wheels cannot give
        every wrench.
    """
    size = len(coordinates.names)
    limit = coordinates.vector(settings.limit or {}, key="actuation.limit", default=np.inf)
    resolution = coordinates.vector(
        settings.quantization, key="actuation.quantization", default=0.0
    )
    builder = DiagramBuilder()
    chain: list[tuple[InputPort, OutputPort]] = []

    def add(name: str, system: System) -> None:
        builder.AddNamedSystem(name, system)
        chain.append((system.get_input_port(), system.get_output_port()))

    if np.isfinite(limit).any():
        add("saturation", Saturation(-limit, limit))
    if resolution.any():
        add("quantizer", Quantizer(resolution))
    if settings.delay > 0:
        # A delay block reads its input before the controller's update of the same instant: one
        # sample late by itself.
        add("delay", DiscreteTimeDelay(sample_time, settings.delay - 1, size))
    diagram = Actuators()
    needs_state: list[InputPort] = []
    if settings.drives is not None:
        drives = DriveSet(settings.drives, settings.limit, coordinates)
        if drives.has_rate_limit:
            limited = builder.AddNamedSystem(
                "rate_limit", RateLimit(drives, coordinates, sample_time=sample_time)
            )
            chain.append((limited.GetInputPort("force"), limited.get_output_port()))
            needs_state.append(limited.GetInputPort("state"))
        if drives.has_friction:
            friction = builder.AddNamedSystem("friction", JointFriction(drives, coordinates))
            needs_state.append(friction.GetInputPort("state"))
            for name in (FRICTION_FORCE, FRICTION_WORK):
                builder.ExportOutput(friction.GetOutputPort(name), name)
            if not chain:
                add("as_commanded", PassThrough(size))
    if base is not None:
        add("base", base)
    elif settings.thrusters is not None or settings.wheels is not None:
        chain.append(
            _add_base_actuators(
                builder, diagram, needs_state, settings, coordinates, sample_time=sample_time
            )
        )
    if not chain:
        return None
    builder.ExportInput(chain[0][0], "commanded_force")
    for before, after in itertools.pairwise(chain):
        builder.Connect(before[1], after[0])
    builder.ExportOutput(chain[-1][1], "applied_force")
    for port in needs_state[:1]:
        builder.ExportInput(port, "state")
    for port in needs_state[1:]:
        builder.ConnectInput("state", port)
    builder.BuildInto(diagram)
    diagram.set_name("actuation")
    return diagram


def make_base_actuators(
    settings: schema.Actuation, coordinates: Coordinates, *, sample_time: float
) -> tuple[BaseActuators, WheelSet | None]:
    """Thrusters and wheels as one system, and the wheels; errors as for ``make_actuation``."""
    thrusters, wheels = None, None
    if settings.thrusters is not None:
        thrusters = ThrusterSet(settings.thrusters, sample_time=sample_time)
    if settings.wheels is not None:
        wheels = WheelSet(settings.wheels, sample_time=sample_time, alone=thrusters is None)
    return BaseActuators(thrusters, wheels, coordinates, sample_time=sample_time), wheels


def _add_base_actuators(
    builder: DiagramBuilder,
    diagram: Actuators,
    needs_state: list[InputPort],
    settings: schema.Actuation,
    coordinates: Coordinates,
    *,
    sample_time: float,
) -> tuple[InputPort, OutputPort]:
    """Thrusters and wheels with their outputs; where the commanded force goes in, and where the
    applied comes out.

    Adds to ``needs_state`` the ports that the plant's state goes into.
    """
    base, wheels = make_base_actuators(settings, coordinates, sample_time=sample_time)
    builder.AddNamedSystem("base", base)
    parts = builder.AddNamedSystem("sample", Demultiplexer(list(base.sizes.values())))
    builder.Connect(base.GetOutputPort("sample"), parts.get_input_port())
    outputs = {name: parts.get_output_port(index) for index, name in enumerate(base.sizes)}
    for name, port in outputs.items():
        if name not in ("applied_force", "memory"):
            builder.ExportOutput(port, name)
    needs_state.append(base.GetInputPort("state"))
    if wheels is not None:
        diagram.wheels = wheels
        stored = builder.AddNamedSystem("gyroscopic", Gyroscopic(coordinates))
        needs_state.append(stored.GetInputPort("state"))
        builder.Connect(outputs["wheel_reaction"], stored.GetInputPort("reaction"))
        builder.Connect(
            stored.GetOutputPort("stored_momentum"), base.GetInputPort("stored_momentum")
        )
        for name in ("gyroscopic_force", "stored_momentum"):
            builder.ExportOutput(stored.GetOutputPort(name), name)
    return base.GetInputPort("commanded_force"), outputs["applied_force"]
