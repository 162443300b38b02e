"""Actuators: from the commanded to the applied force. Saturation, quantisation, delay, drives,
wheels, thrusters.
"""

import itertools
from collections.abc import Mapping

import numpy as np
from pydrake.systems.framework import DiagramBuilder, InputPort, System
from pydrake.systems.primitives import DiscreteTimeDelay, PassThrough, Saturation

from ffsm_drake.scenario import Actuation, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.actuation.base import BaseActuators, BaseBlock
from ffsm_drake.systems.actuation.drives import DriveSet, JointDrives, JointFriction, RateLimit
from ffsm_drake.systems.actuation.thrusters import FiredThrusters, ThrusterSet
from ffsm_drake.systems.actuation.wheels import ReactionWheels, WheelSet
from ffsm_drake.systems.part import Part
from ffsm_drake.systems.sensing import Quantizer
from ffsm_drake.systems.setup import CompositeBlock

# What the sections of ``actuation`` bring to records and pages.
SECTIONS: dict[str, type[Part]] = {
    "thrusters": FiredThrusters,
    "wheels": ReactionWheels,
    "drives": JointDrives,
}


def own_parts(scenario: Scenario) -> list[Part]:
    """Those of a scenario's own actuators; none where a block replaces them."""
    if scenario.blocks.actuation is not None:
        return []
    return [part for kind in SECTIONS.values() if (part := kind.of(scenario)) is not None]


class Actuators(CompositeBlock):
    """Systems in a row from ``commanded_force`` to ``applied_force``, and some beside them.

    The first ports of those in the row are forces; what else they and the others put out are
    outputs, by name, and all may read ``state``.
    """

    def __init__(self, row: Mapping[str, System], beside: Mapping[str, System]) -> None:
        super().__init__()
        builder, chain = DiagramBuilder(), list(row.values())
        readers = list[InputPort]()
        for name, system in (*row.items(), *beside.items()):
            builder.AddNamedSystem(name, system)
            for index in range(int(name in row), system.num_output_ports()):
                port = system.get_output_port(index)
                builder.ExportOutput(port, port.get_name())
            if system.HasInputPort("state"):
                readers.append(system.GetInputPort("state"))
        for before, after in itertools.pairwise(chain):
            builder.Connect(before.get_output_port(0), after.get_input_port(0))
        builder.ExportInput(chain[0].get_input_port(0), "commanded_force")
        builder.ExportOutput(chain[-1].get_output_port(0), "applied_force")
        for port in readers[:1]:
            builder.ExportInput(port, "state")
        for port in readers[1:]:
            builder.ConnectInput("state", port)
        builder.BuildInto(self)
        self.set_name("actuation")


def make_actuation(
    settings: Actuation,
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
    row, beside = _make_limits(settings, coordinates, sample_time=sample_time), dict[str, System]()
    if settings.drives is not None:
        drives = DriveSet(settings.drives, settings.limit, coordinates)
        if drives.has_rate_limit:
            row["rate_limit"] = RateLimit(drives, coordinates, sample_time=sample_time)
        if drives.has_friction:
            beside["friction"] = JointFriction(drives, coordinates)
    if base is not None:
        row["base"] = base
    elif settings.thrusters is not None or settings.wheels is not None:
        own = make_base_actuators(settings, coordinates, sample_time=sample_time)
        row["base"] = BaseBlock(own, coordinates)
    if beside and not row:
        row["as_commanded"] = PassThrough(len(coordinates.names))
    return Actuators(row, beside) if row else None


def _make_limits(
    settings: Actuation, coordinates: Coordinates, *, sample_time: float
) -> dict[str, System]:
    """Saturation, quantisation and delay, by name; those that there are."""
    limit = coordinates.vector(settings.limit or {}, key="actuation.limit", default=np.inf)
    resolution = coordinates.vector(
        settings.quantization, key="actuation.quantization", default=0.0
    )
    row: dict[str, System] = {}
    if np.isfinite(limit).any():
        row["saturation"] = Saturation(-limit, limit)
    if resolution.any():
        row["quantizer"] = Quantizer(resolution)
    if settings.delay > 0:
        # A delay block reads its input before the controller's update of the same instant: one
        # sample late by itself.
        row["delay"] = DiscreteTimeDelay(sample_time, settings.delay - 1, limit.size)
    return row


def make_base_actuators(
    settings: Actuation, coordinates: Coordinates, *, sample_time: float
) -> BaseActuators:
    """Thrusters and wheels as one system; errors as for ``make_actuation``."""
    thrusters, wheels = None, None
    if settings.thrusters is not None:
        thrusters = ThrusterSet(settings.thrusters, sample_time=sample_time)
    if settings.wheels is not None:
        wheels = WheelSet(settings.wheels, sample_time=sample_time, alone=thrusters is None)
    return BaseActuators(thrusters, wheels, coordinates, sample_time=sample_time)
