"""Sensors: from the true state to what the controller reads. Bias, white noise, quantisation, delay, in that order."""

import itertools

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, InputPort, LeafSystem, OutputPort
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    DiscreteTimeDelay,
    Gain,
    MatrixGain,
    RandomSource,
)

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.lifetime import weak_callback
from ffsm_drake.scenario import schema
from ffsm_drake.spacecraft.coordinates import Coordinates


def quantize(values: np.ndarray, resolution: np.ndarray) -> np.ndarray:
    """Round to the nearest multiple of each entry's resolution; entries with resolution 0 pass unchanged."""
    steps = np.where(resolution > 0.0, resolution, 1.0)
    return np.where(resolution > 0.0, np.round(values / steps) * steps, values)


class Quantizer(LeafSystem):
    """Rounds its input ``u`` to multiples of a resolution, output ``y``; see quantize."""

    def __init__(self, resolution: np.ndarray) -> None:
        super().__init__()
        self._resolution = resolution
        self._input = self.DeclareVectorInputPort("u", resolution.size)
        # Depends on its input alone: while that is held, the integrator's stages read the cached value.
        self.DeclareVectorOutputPort(
            "y", resolution.size, weak_callback(self._calc), {self.input_port_ticket(self._input.get_index())}
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(quantize(self._input.Eval(context), self._resolution))


class Sensing(Diagram):
    """The sensors, from ``state`` to ``estimated_state``; made by ``make_sensing``."""

    def __init__(self, delay: int) -> None:
        """Args: the age of a measurement when it is read, in control samples."""
        super().__init__()
        self._delay = delay

    def set_initial_state(self, context: Context, state: np.ndarray) -> None:
        """Fill the delay: before the start, the spacecraft was where it is now, at ``state`` [q; v]."""
        if self._delay > 0:
            delay = self.GetSubsystemByName("delay")
            self.GetMutableSubsystemContext(delay, context).SetDiscreteState(np.tile(state, self._delay))


def make_sensing(settings: schema.Sensing, coordinates: Coordinates, *, sample_time: float) -> Diagram:
    """A diagram from ``state`` to ``estimated_state``, both [q; v] (nq + nv).

    Noise is one independent Gaussian sample per coordinate and control period, held in between. Rotation noise of
    standard deviation sigma is added to the quaternion of the base as sigma/2 per component: along the quaternion it
    changes only the norm, which no reader of the state looks at; across it, it is a rotation of sigma about each axis
    to first order. A rotation bias turns the measured attitude by a fixed rotation vector in the world frame.

    Raises:
      ScenarioError: a value is given for an unknown coordinate, or cannot be applied to the base's rotation.
    """
    groups = coordinates.groups
    values = {
        f"{part}_{kind}": coordinates.vector(
            getattr(settings, f"{part}_{kind}"), key=f"sensing.{part}_{kind}", default=0.0
        )
        for part in ("position", "velocity")
        for kind in ("noise", "bias", "quantization")
    }
    rotation = groups["base_rotation"]
    if len(set(values["position_noise"][rotation])) > 1:
        raise ScenarioError("sensing.position_noise", "must be the same for the three base_rotation coordinates")
    if values["position_quantization"][rotation].any():
        raise ScenarioError("sensing.position_quantization", "base_rotation has no scale to quantise; leave it out")

    builder = DiagramBuilder()
    size = 2 * len(coordinates.names) + 1
    # The stages in their order; each has one input from the stage before, or from outside.
    stages: list[tuple[InputPort, OutputPort]] = []

    def add_sum(name: str, other: OutputPort) -> None:
        total = builder.AddNamedSystem(name, Adder(2, size))
        builder.Connect(other, total.get_input_port(1))
        stages.append((total.get_input_port(0), total.get_output_port()))

    def add(name: str, system: LeafSystem) -> None:
        builder.AddNamedSystem(name, system)
        stages.append((system.get_input_port(), system.get_output_port()))

    if values["position_bias"][rotation].any():
        add("attitude_bias", MatrixGain(_rotate_attitude(values["position_bias"][rotation], size)))
    bias = np.concatenate([np.zeros(4), values["position_bias"][3:], values["velocity_bias"]])
    if bias.any():
        add_sum("biased", builder.AddNamedSystem("bias", ConstantVectorSource(bias)).get_output_port())
    sigma = np.concatenate(
        [np.full(4, 0.5 * values["position_noise"][0]), values["position_noise"][3:], values["velocity_noise"]]
    )
    white = builder.AddNamedSystem("white", RandomSource(RandomDistribution.kGaussian, size, sample_time))
    scale = builder.AddNamedSystem("standard_deviation", Gain(sigma))
    builder.Connect(white.get_output_port(), scale.get_input_port())
    add_sum("noisy", scale.get_output_port())
    resolution = np.concatenate([np.zeros(4), values["position_quantization"][3:], values["velocity_quantization"]])
    if resolution.any():
        add("quantizer", Quantizer(resolution))
    if settings.delay > 0:
        # A delay block updates at the controller's instant and is read before that: it is one sample late by itself.
        add("delay", DiscreteTimeDelay(sample_time, settings.delay - 1, size))
    builder.ExportInput(stages[0][0], "state")
    for before, after in itertools.pairwise(stages):
        builder.Connect(before[1], after[0])
    signal = stages[-1][1]
    builder.ExportOutput(signal, "estimated_state")
    diagram = Sensing(settings.delay)
    builder.BuildInto(diagram)
    diagram.set_name("sensing")
    return diagram


def _rotate_attitude(rotation_vector: np.ndarray, size: int) -> np.ndarray:
    """The matrix (size, size) that turns the quaternion of [q; v] by a world-frame rotation vector."""
    angle = float(np.linalg.norm(rotation_vector))
    half = 0.5 * angle
    w = np.cos(half)
    x, y, z = 0.5 * np.sinc(half / np.pi) * rotation_vector
    matrix = np.eye(size)
    matrix[:4, :4] = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return matrix
