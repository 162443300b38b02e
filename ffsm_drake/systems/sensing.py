"""Sensors: from the true state to what the controller reads.

Bias, white noise, noise with memory, quantisation, sampling and delay, in that order.
"""

import itertools
import math

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    InputPort,
    LeafSystem,
    OutputPort,
)
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    Gain,
    LinearSystem,
    MatrixGain,
    RandomSource,
)

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.common.so3 import turning_matrix
from ffsm_drake.scenario import schema
from ffsm_drake.spacecraft.coordinates import Coordinates


def quantize(values: np.ndarray, resolution: np.ndarray) -> np.ndarray:
    """Round to the nearest multiple of each entry's resolution; entries with resolution 0 pass
    unchanged.
    """
    steps = np.where(resolution > 0.0, resolution, 1.0)
    return np.where(resolution > 0.0, np.round(values / steps) * steps, values)


class Quantizer(LeafSystem):
    """Rounds its input ``u`` to multiples of a resolution, output ``y``; see quantize."""

    def __init__(self, resolution: np.ndarray) -> None:
        super().__init__()
        self._resolution = resolution
        self._input = self.DeclareVectorInputPort("u", resolution.size)
        # Depends on its input alone: while that is held, the integrator's stages read the cached
        # value.
        self.DeclareVectorOutputPort(
            "y",
            resolution.size,
            weak_callback(self._calc),
            {self.input_port_ticket(self._input.get_index())},
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(quantize(self._input.Eval(context), self._resolution))


class Sampling(LeafSystem):
    """Measurements that are made less often than the controller reads them, or that arrive late.

    At control sample k an entry of period p and delay d (control samples) shows the measurement of
    sample p floor((k - d) / p); it is new where k - d is a multiple of p. k follows from the
    context's time: nothing counts.

    Input: ``measurement`` (size).
    Outputs: ``sampled`` (size), and ``is_new`` (size), 1 where an entry shows a measurement for the
    first time, else 0. Discrete state, updated every control sample: for each pair (p, d) but (1,
    0), the measurements made last, newest first. The outputs are meant to be read at control
    samples, before the update.
    """

    def __init__(self, period: np.ndarray, delay: np.ndarray, *, sample_time: float) -> None:
        """Args: of each entry, whole control samples; the control period, s."""
        super().__init__()
        self._sample_time = sample_time
        self._input = self.DeclareVectorInputPort("measurement", period.size)
        # p, d, their entries, the state's index
        self._sensors: list[tuple[int, int, np.ndarray, int]] = []
        for p, d in sorted(set(zip(period.tolist(), delay.tolist(), strict=True)) - {(1, 0)}):
            entries = np.flatnonzero((period == p) & (delay == d))
            # measurements between the one that is shown and the present
            kept = -((1 - d) // p) + 1 if d else 1
            self._sensors.append(
                (p, d, entries, int(self.DeclareDiscreteState(entries.size * kept)))
            )
        self.DeclareVectorOutputPort("sampled", period.size, weak_callback(self._calc))
        self.DeclareVectorOutputPort(
            "is_new", period.size, weak_callback(self._calc_is_new), {self.time_ticket()}
        )
        self.DeclarePeriodicDiscreteUpdateEvent(sample_time, 0.0, weak_callback(self._update))
        untie(self)

    def set_initial_state(self, context: Context, state: np.ndarray) -> None:
        """Before the start, ``state`` (size) was measured."""
        for _, _, entries, index in self._sensors:
            kept = context.get_discrete_state(index).size() // entries.size
            context.SetDiscreteState(index, np.tile(state[entries], kept))

    @property
    def phase_period(self) -> int:
        """Control samples after which ``phase`` repeats."""
        return math.lcm(*(p for p, *_ in self._sensors))

    def phase(self, sample: int) -> tuple[tuple[bool, bool, int], ...]:
        """What happens at a control sample: of each sensor whether it measures, brings something
        new, and its age.
        """
        return tuple(
            (sample % p == 0, (sample - d) % p == 0, (sample - 1) // p - (sample - d) // p)
            for p, d, *_ in self._sensors
        )

    def _sample(self, context: Context) -> int:
        return round(context.get_time() / self._sample_time)

    def _calc(self, context: Context, output: BasicVector) -> None:
        sample, values = self._sample(context), self._input.Eval(context).copy()
        for p, d, entries, index in self._sensors:
            age = (sample - 1) // p - (sample - d) // p  # in measurements; -1: it is being made
            if age >= 0:
                kept = context.get_discrete_state(index).value()
                values[entries] = kept[age * entries.size : (age + 1) * entries.size]
        output.SetFromVector(values)

    def _calc_is_new(self, context: Context, output: BasicVector) -> None:
        sample, values = self._sample(context), np.ones(output.size())
        for p, d, entries, _ in self._sensors:
            values[entries] = (sample - d) % p == 0
        output.SetFromVector(values)

    def _update(self, context: Context, values: DiscreteValues) -> None:
        sample, measured = self._sample(context), self._input.Eval(context)
        for p, _, entries, index in self._sensors:
            if sample % p == 0:
                kept = context.get_discrete_state(index).value()
                values.set_value(index, np.concatenate([measured[entries], kept[: -entries.size]]))


class Sensing(Diagram):
    """The sensors, from ``state`` to ``estimated_state``; made by ``make_sensing``."""

    def set_initial_state(self, context: Context, state: np.ndarray) -> None:
        """Before the start, the spacecraft was where it is now, at ``state`` [q; v]."""
        if self.HasSubsystemNamed("sampling"):
            sampling = self.GetSubsystemByName("sampling")
            sampling.set_initial_state(self.GetMutableSubsystemContext(sampling, context), state)


def make_sensing(
    settings: schema.Sensing, coordinates: Coordinates, *, sample_time: float
) -> Diagram:
    """A diagram from ``state`` to ``estimated_state``, both [q; v] (nq + nv).

    With a sensor of a longer period than the controller's there is an output ``measurement_is_new``
    (nq + nv): 1 where this control sample brings a measurement that was not there before, 0 where
    it repeats one.

    White noise is one independent Gaussian sample per coordinate and control period, held in
    between. Rotation noise of standard deviation sigma is added to the quaternion of the base as
    sigma/2 per component: along the quaternion it changes only the norm, which no reader of the
    state looks at; across it, it is a rotation of sigma about each axis to first order. A rotation
    bias turns the measured attitude by a fixed rotation vector in the world frame. Correlated noise
    is a first-order Gauss-Markov process, stationary from the start; a bias' walk starts at zero.

    Raises:
      ScenarioError: a value is given for an unknown coordinate, or cannot be applied to the base's
        rotation.
    """
    groups = coordinates.groups
    values = {
        f"{part}_{kind}": coordinates.vector(
            getattr(settings, f"{part}_{kind}"), key=f"sensing.{part}_{kind}", default=0.0
        )
        for part in ("position", "velocity")
        for kind in ("noise", "correlated_noise", "bias", "quantization")
    }
    period, delay = measurement_times(settings, coordinates)
    rotation = groups["base_rotation"]
    for key in ("position_noise", "position_correlated_noise", "position_period", "position_delay"):
        given = coordinates.vector(getattr(settings, key), key=f"sensing.{key}", default=0.0)
        if len(set(given[rotation])) > 1:
            raise ScenarioError(
                f"sensing.{key}", "must be the same for the three base_rotation coordinates"
            )
    if values["position_quantization"][rotation].any():
        raise ScenarioError(
            "sensing.position_quantization", "base_rotation has no scale to quantise; leave it out"
        )

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
        add_sum(
            "biased", builder.AddNamedSystem("bias", ConstantVectorSource(bias)).get_output_port()
        )
    sigma = _deviations(values["position_noise"], values["velocity_noise"])
    white = builder.AddNamedSystem(
        "white", RandomSource(RandomDistribution.kGaussian, size, sample_time)
    )
    scale = builder.AddNamedSystem("standard_deviation", Gain(sigma))
    builder.Connect(white.get_output_port(), scale.get_input_port())
    add_sum("noisy", scale.get_output_port())
    walk = coordinates.vector(
        settings.velocity_bias_walk, key="sensing.velocity_bias_walk", default=0.0
    )
    time_constant = coordinates.vector(
        settings.correlation_time, key="sensing.correlation_time", default=1.0
    )
    drift = _make_drift(
        walk=np.concatenate([np.zeros(size - walk.size), walk]),
        correlated=_deviations(
            values["position_correlated_noise"], values["velocity_correlated_noise"]
        ),
        time_constant=np.concatenate(
            [np.full(4, time_constant[0]), time_constant[3:], time_constant]
        ),
        sample_time=sample_time,
    )
    if drift.num_inputs() > 0:
        # After the white noise, whose draws of a seed so stay what they are.
        builder.AddNamedSystem("drift", drift)
        source = RandomSource(RandomDistribution.kGaussian, drift.num_inputs(), sample_time)
        builder.Connect(
            builder.AddNamedSystem("drift_noise", source).get_output_port(), drift.get_input_port()
        )
        add_sum("drifting", drift.get_output_port())
    resolution = np.concatenate(
        [np.zeros(4), values["position_quantization"][3:], values["velocity_quantization"]]
    )
    if resolution.any():
        add("quantizer", Quantizer(resolution))
    if (period > 1).any() or delay.any():
        # the quaternion has four
        period, delay = (np.concatenate([of[:1], of]) for of in (period, delay))
        sampling = Sampling(period, delay, sample_time=sample_time)
        builder.AddNamedSystem("sampling", sampling)
        stages.append((sampling.get_input_port(), sampling.GetOutputPort("sampled")))
        if (period > 1).any():
            builder.ExportOutput(sampling.GetOutputPort("is_new"), "measurement_is_new")
    builder.ExportInput(stages[0][0], "state")
    for before, after in itertools.pairwise(stages):
        builder.Connect(before[1], after[0])
    signal = stages[-1][1]
    builder.ExportOutput(signal, "estimated_state")
    diagram = Sensing()
    builder.BuildInto(diagram)
    diagram.set_name("sensing")
    return diagram


def measurement_times(
    settings: schema.Sensing, coordinates: Coordinates
) -> tuple[np.ndarray, np.ndarray]:
    """Period and delay of the measurements of positions, then velocities (2 nv): whole control
    samples.

    Raises ScenarioError for an unknown coordinate.
    """

    def of(name: str, default: float) -> np.ndarray:
        both = [
            coordinates.vector(
                getattr(settings, f"{part}_{name}"), key=f"sensing.{part}_{name}", default=default
            )
            for part in ("position", "velocity")
        ]
        return np.concatenate(both).astype(int)

    return of("period", 1.0), settings.delay + of("delay", 0.0)


def _deviations(position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Standard deviations of [q; v] (nq + nv) from those of the coordinates (nv each); see
    make_sensing.
    """
    return np.concatenate([np.full(4, 0.5 * position[0]), position[3:], velocity])


def _make_drift(
    *, walk: np.ndarray, correlated: np.ndarray, time_constant: np.ndarray, sample_time: float
) -> LinearSystem:
    """Random walks and first-order Gauss-Markov processes, added to a vector (size), from unit
    white noise.

    Its input has one entry for each of those that are not zero: first the walks.
    """
    walks, noises = np.flatnonzero(walk), np.flatnonzero(correlated)
    kept = np.exp(-sample_time / time_constant[noises])  # of the deviation after one sample
    sigma = np.concatenate([np.zeros(walks.size), correlated[noises]])
    gain = [math.sqrt(sample_time) * walk[walks], correlated[noises] * np.sqrt(1.0 - kept**2)]
    shown = np.eye(walk.size)[:, np.concatenate([walks, noises])]
    system = LinearSystem(
        A=np.diag(np.concatenate([np.ones(walks.size), kept])),
        B=np.diag(np.concatenate(gain)),
        C=shown,
        D=np.zeros_like(shown),
        time_period=sample_time,
    )
    system.configure_random_state(np.diag(sigma**2))
    return system


def _rotate_attitude(rotation_vector: np.ndarray, size: int) -> np.ndarray:
    """The matrix (size, size) that turns the quaternion of [q; v] by a world-frame rotation
    vector.
    """
    matrix = np.eye(size)
    matrix[:4, :4] = turning_matrix(rotation_vector)
    return matrix
