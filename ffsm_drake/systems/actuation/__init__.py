"""Actuators: from the commanded to the applied force. Saturation, quantisation, delay, thrusters, in that order."""

import itertools

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder, InputPort, OutputPort, System
from pydrake.systems.primitives import Demultiplexer, DiscreteTimeDelay, Saturation

from ffsm_drake.scenario import schema
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.actuation.thrusters import ThrusterSet, ThrusterSystem
from ffsm_drake.systems.sensing import Quantizer

# Outputs of actuators with thrusters, beside the applied force: for each its mean force over a control sample (N) and
# the share of it for which it is open, and the part of the wanted wrench that the last allocation could give.
THRUSTER_OUTPUTS = ("thruster_force", "thruster_open", "thruster_given")


def make_actuation(settings: schema.Actuation, coordinates: Coordinates, *, sample_time: float) -> Diagram | None:
    """A diagram from ``commanded_force`` to ``applied_force``, both (nv): N m and N; None where they are the same.

    With thrusters it has the input ``state`` and the outputs THRUSTER_OUTPUTS too.

    Raises:
      ScenarioError: a value is given for an unknown coordinate; the thrusters cannot give every wrench.
    """
    size = len(coordinates.names)
    limit = coordinates.vector(settings.limit or {}, key="actuation.limit", default=np.inf)
    resolution = coordinates.vector(settings.quantization, key="actuation.quantization", default=0.0)
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
        # A delay block reads its input before the controller's update of the same instant: one sample late by itself.
        add("delay", DiscreteTimeDelay(sample_time, settings.delay - 1, size))
    if settings.thrusters is not None:
        thrusters = ThrusterSystem(ThrusterSet(settings.thrusters, sample_time=sample_time), coordinates)
        builder.AddNamedSystem("thrusters", thrusters)
        parts = builder.AddNamedSystem("sample", Demultiplexer(thrusters.sizes))
        builder.Connect(thrusters.GetOutputPort("sample"), parts.get_input_port())
        builder.ExportInput(thrusters.GetInputPort("state"), "state")
        for index, name in enumerate(THRUSTER_OUTPUTS, start=1):
            builder.ExportOutput(parts.get_output_port(index), name)
        chain.append((thrusters.GetInputPort("commanded_force"), parts.get_output_port(0)))
    if not chain:
        return None
    builder.ExportInput(chain[0][0], "commanded_force")
    for before, after in itertools.pairwise(chain):
        builder.Connect(before[1], after[0])
    builder.ExportOutput(chain[-1][1], "applied_force")
    diagram = builder.Build()
    diagram.set_name("actuation")
    return diagram
