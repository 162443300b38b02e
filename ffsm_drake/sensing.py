"""Measurement: the true state plus seeded white noise, all in C++ systems."""

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, Gain, RandomSource

from ffsm_drake import scenario as schema
from ffsm_drake.coordinates import Coordinates
from ffsm_drake.errors import ScenarioError


def make_sensing(settings: schema.Sensing, coordinates: Coordinates, *, sample_time: float) -> Diagram:
    """A diagram from ``state`` to ``estimated_state``, both [q; v] (nq + nv), with ``noise`` (nq + nv) to log.

    One independent Gaussian sample per coordinate and control period, held in between. Rotation noise of standard
    deviation sigma is added to the quaternion of the base as sigma/2 per component: along the quaternion it changes
    only the norm, which no reader of the state looks at; across it, it is a rotation of sigma about each axis to first
    order.

    Raises:
      ScenarioError: noise is given for an unknown coordinate.
    """
    position, velocity = (
        coordinates.vector(getattr(settings, name), key=f"sensing.{name}", default=0.0)
        for name in ("position_noise", "velocity_noise")
    )
    rotation = coordinates.groups["base_rotation"]
    if len(set(position[rotation])) > 1:
        raise ScenarioError("sensing.position_noise", "must be the same for the three base_rotation coordinates")
    sigma = np.concatenate([np.full(4, 0.5 * position[0]), position[3:], velocity])
    builder = DiagramBuilder()
    white = builder.AddNamedSystem("white", RandomSource(RandomDistribution.kGaussian, sigma.size, sample_time))
    scale = builder.AddNamedSystem("standard_deviation", Gain(sigma))
    total = builder.AddNamedSystem("total", Adder(2, sigma.size))
    builder.Connect(white.get_output_port(), scale.get_input_port())
    builder.ExportInput(total.get_input_port(0), "state")
    builder.Connect(scale.get_output_port(), total.get_input_port(1))
    builder.ExportOutput(total.get_output_port(), "estimated_state")
    builder.ExportOutput(scale.get_output_port(), "noise")
    diagram = builder.Build()
    diagram.set_name("sensing")
    return diagram
