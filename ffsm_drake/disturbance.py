"""The external disturbance: one harmonic and one constant per coordinate (Table 1), all in C++ systems."""

from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, ConstantVectorSource, Sine

from ffsm_drake import scenario as schema
from ffsm_drake.coordinates import Coordinates


def make_disturbance(settings: schema.Disturbance, coordinates: Coordinates) -> Diagram:
    """A source with output ``generalized_force`` (nv): amplitude sin(frequency t + phase) + bias, N m and N.

    The scales multiply amplitudes and biases, and frequencies (phases stay), so that the paper's tau_d2 is
    ``frequency_scale: 3`` and tau_d3 is ``amplitude_scale: 3``.

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
    constant = builder.AddNamedSystem("bias", ConstantVectorSource(settings.amplitude_scale * bias))
    total = builder.AddNamedSystem("total", Adder(2, len(coordinates.names)))
    builder.Connect(harmonic.get_output_port(0), total.get_input_port(0))
    builder.Connect(constant.get_output_port(), total.get_input_port(1))
    builder.ExportOutput(total.get_output_port(), "generalized_force")
    diagram = builder.Build()
    diagram.set_name("disturbance")
    return diagram
