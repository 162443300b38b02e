"""Actuators: from the commanded to the applied force. Saturation, quantisation, delay, in that order."""

import itertools

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import DiscreteTimeDelay, Saturation

from ffsm_drake.scenario import schema
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.sensing import Quantizer


def make_actuation(settings: schema.Actuation, coordinates: Coordinates, *, sample_time: float) -> Diagram | None:
    """A diagram from ``commanded_force`` to ``applied_force``, both (nv): N m and N; None where they are the same.

    Raises:
      ScenarioError: a value is given for an unknown coordinate.
    """
    size = len(coordinates.names)
    limit = coordinates.vector(settings.limit or {}, key="actuation.limit", default=np.inf)
    resolution = coordinates.vector(settings.quantization, key="actuation.quantization", default=0.0)
    builder = DiagramBuilder()
    chain = []
    if np.isfinite(limit).any():
        chain.append(builder.AddNamedSystem("saturation", Saturation(-limit, limit)))
    if resolution.any():
        chain.append(builder.AddNamedSystem("quantizer", Quantizer(resolution)))
    if settings.delay > 0:
        # A delay block reads its input before the controller's update of the same instant: one sample late by itself.
        chain.append(builder.AddNamedSystem("delay", DiscreteTimeDelay(sample_time, settings.delay - 1, size)))
    if not chain:
        return None
    builder.ExportInput(chain[0].get_input_port(), "commanded_force")
    for before, after in itertools.pairwise(chain):
        builder.Connect(before.get_output_port(), after.get_input_port())
    builder.ExportOutput(chain[-1].get_output_port(), "applied_force")
    diagram = builder.Build()
    diagram.set_name("actuation")
    return diagram
