"""The external disturbance: a harmonic and a constant per coordinate (Table 1), in C++ systems."""

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import AffineSystem, Sine

from ffsm_drake.scenario import Disturbance
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.part import Part
from ffsm_drake.systems.setup import BlockSetup


class HarmonicDisturbance(Part):
    """The section ``disturbance`` of a scenario."""

    title = "Disturbance"

    def build(self, setup: BlockSetup) -> Diagram:
        """The force."""
        return make_disturbance(setup.scenario.disturbance, setup.coordinates)


def make_disturbance(settings: Disturbance, coordinates: Coordinates) -> Diagram:
    """A source with output ``generalized_force`` (nv): amplitude sin(frequency t + phase) + bias, N
    m and N.

    The scales multiply amplitudes and biases, and frequencies (phases stay), so that the paper's
    tau_d2 is ``frequency_scale: 3`` and tau_d3 is ``amplitude_scale: 3``.

    Raises:
      ScenarioError: a harmonic is given for an unknown coordinate.
    """
    amplitude, frequency, phase, bias = (
        coordinates.vector(
            {name: getattr(harmonic, field) for name, harmonic in settings.harmonics.items()},
            key="disturbance.harmonics",
            default=0.0,
        )
        for field in ("amplitude", "frequency", "phase", "bias")
    )
    builder = DiagramBuilder()
    harmonic = builder.AddNamedSystem(
        "harmonic",
        Sine(
            settings.amplitude_scale * amplitude,
            settings.frequency_scale * frequency,
            phase,
        ),
    )
    port = harmonic.get_output_port(0)
    if bias.any():
        gain = np.eye(bias.size)
        biased = builder.AddNamedSystem(
            "biased", AffineSystem(D=gain, y0=settings.amplitude_scale * bias)
        )
        builder.Connect(port, biased.get_input_port())
        port = biased.get_output_port()
    builder.ExportOutput(port, "generalized_force")
    diagram = builder.Build()
    diagram.set_name("disturbance")
    return diagram
