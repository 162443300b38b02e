"""Sensors: from the true state to the controller's measurement.

Stages in series, like user-supplied ones: bias, white noise, correlated noise, quantisation,
sampling with delay, in that order.

The base's sensors are fixed to the base, so their errors are in its axes: with R the true attitude,
a gyro's error b changes w to w + R b in world axes. If the base has errors that depend on axes, the
state is transformed to its sensors' axes before them and back after them (``_Turning``); the star
tracker's attitude is there the rotation from the true base. Isotropic white noise is the same in
any axes, and is added in the world's. Joints have axes of their own.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    InputPort,
    LeafSystem,
    OutputPort,
    State,
    System,
)
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    Demultiplexer,
    Gain,
    LinearSystem,
    MatrixGain,
    Multiplexer,
    RandomSource,
)

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.common.so3 import matrix_of, product_matrix, turning_matrix
from ffsm_drake.scenario import Sensing as SensingSettings
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.systems.part import Part, state_signals
from ffsm_drake.systems.setup import BlockSetup, CompositeBlock
from ffsm_drake.systems.side_by_side import SideBySide

# Variables of the record.
SIGNALS = state_signals(
    "measurement", "measured_", "measured q, read by the controller",
    "measured v, read by the controller", "1",
)  # fmt: skip
_DRAWN = 256  # samples of noise at once, for several copies of the spacecraft


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


class Sensor(NamedTuple):
    """Entries of [q; v] that are measured with one period and delay, in whole control samples."""

    period: int
    delay: int
    entries: Any  # array of indices

    @property
    def kept(self) -> int:
        """Number of measurements between the one that is shown and the present."""
        return -((1 - self.delay) // self.period) + 1 if self.delay else 1

    def phase(self, sample: Any) -> tuple[Any, Any, Any]:
        """Of a control sample, or of many: whether it measures, whether it shows a new
        measurement, and the age of that in measurements; -1: it is being made.
        """
        p, d = self.period, self.delay
        return sample % p == 0, (sample - d) % p == 0, (sample - 1) // p - (sample - d) // p


def late_sensors(period: np.ndarray, delay: np.ndarray) -> list[Sensor]:
    """Return the sensors with a period longer than a control sample, or with a delay, from those of
    each entry.
    """
    pairs = sorted(set(zip(period.tolist(), delay.tolist(), strict=True)) - {(1, 0)})
    return [Sensor(p, d, np.flatnonzero((period == p) & (delay == d))) for p, d in pairs]


class Sampling(LeafSystem):
    """Measurements with a period longer than a control sample, or with a delay.

    At control sample k an entry of period p and delay d (control samples) shows the measurement of
    sample p floor((k - d) / p); it is new if k - d is a multiple of p. k is computed from the
    context time; there is no counter.

    Input: ``state`` (size).
    Outputs: ``estimated_state`` (size), and, with a period longer than a control sample,
    ``measurement_is_new`` (size), 1 for entries with a measurement shown for the first time, else
    0.
    Discrete state, updated every control sample: for each sensor, the measurements made last,
    newest first. Read the outputs at control samples, before the update.
    """

    def __init__(self, period: np.ndarray, delay: np.ndarray, *, sample_time: float) -> None:
        """Args: of each entry, whole control samples; the control period, s."""
        super().__init__()
        self._sample_time = sample_time
        self._input = self.DeclareVectorInputPort("state", period.size)
        self._sensors = [
            (each, int(self.DeclareDiscreteState(each.entries.size * each.kept)))
            for each in late_sensors(period, delay)
        ]
        self.DeclareVectorOutputPort("estimated_state", period.size, weak_callback(self._calc))
        if (period > 1).any():
            new = weak_callback(self._calc_is_new)
            self.DeclareVectorOutputPort(
                "measurement_is_new", period.size, new, {self.time_ticket()}
            )
        self.DeclarePeriodicDiscreteUpdateEvent(sample_time, 0.0, weak_callback(self._update))
        untie(self)

    def set_initial_state(self, context: Context, state: np.ndarray) -> None:
        """Before the start, ``state`` (size, or rows of that size) was measured."""
        state = state.ravel()
        for sensor, index in self._sensors:
            context.SetDiscreteState(index, np.tile(state[sensor.entries], sensor.kept))

    @property
    def phase_period(self) -> int:
        """Control samples after which ``phase`` repeats."""
        return math.lcm(*(sensor.period for sensor, _ in self._sensors))

    def phase(self, sample: int) -> tuple[tuple[bool, bool, int], ...]:
        """Phase of each sensor at a control sample."""
        return tuple(sensor.phase(sample) for sensor, _ in self._sensors)

    def _sample(self, context: Context) -> int:
        return round(context.get_time() / self._sample_time)

    def _calc(self, context: Context, output: BasicVector) -> None:
        sample, values = self._sample(context), self._input.Eval(context).copy()
        for sensor, index in self._sensors:
            *_, age = sensor.phase(sample)
            if age >= 0:
                kept, size = context.get_discrete_state(index).value(), sensor.entries.size
                values[sensor.entries] = kept[age * size : (age + 1) * size]
        output.SetFromVector(values)

    def _calc_is_new(self, context: Context, output: BasicVector) -> None:
        sample, values = self._sample(context), np.ones(output.size())
        for sensor, _ in self._sensors:
            values[sensor.entries] = sensor.phase(sample)[1]
        output.SetFromVector(values)

    def _update(self, context: Context, values: DiscreteValues) -> None:
        sample, measured = self._sample(context), self._input.Eval(context)
        for sensor, index in self._sensors:
            if sensor.phase(sample)[0]:
                kept, entries = context.get_discrete_state(index).value(), sensor.entries
                values.set_value(index, np.concatenate([measured[entries], kept[: -entries.size]]))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """The ports of stages of sensing that are wired in a row."""

    inputs: tuple[InputPort, ...]  # ports of the true state
    estimated_state: OutputPort
    measurement_is_new: OutputPort | None  # port of the last stage with one


def wire_stages(builder: DiagramBuilder, stages: Sequence[System]) -> Row:
    """Wire stages, which the builder holds, in a row: each reads the estimate of the one before."""
    for before, after in itertools.pairwise(stages):
        builder.Connect(before.GetOutputPort("estimated_state"), after.GetInputPort("state"))
    true, new = "true_state", "measurement_is_new"
    for before, after in itertools.pairwise(stages):
        if before.HasOutputPort(new) and after.HasInputPort(new):
            builder.Connect(before.GetOutputPort(new), after.GetInputPort(new))
    timed = [stage.GetOutputPort(new) for stage in stages if stage.HasOutputPort(new)]
    others = [stage.GetInputPort(true) for stage in stages if stage.HasInputPort(true)]
    return Row(
        inputs=(stages[0].GetInputPort("state"), *others),
        estimated_state=stages[-1].GetOutputPort("estimated_state"),
        measurement_is_new=timed[-1] if timed else None,
    )


class Sensing(CompositeBlock):
    """Stages in a row, from ``state`` to ``estimated_state``; made by ``make_sensing``."""

    def __init__(self, stages: Sequence[System]) -> None:
        super().__init__()
        builder = DiagramBuilder()
        for stage in stages:
            builder.AddSystem(stage)
        row = wire_stages(builder, stages)
        state = builder.ExportInput(row.inputs[0], "state")
        for port in row.inputs[1:]:
            builder.ConnectInput(state, port)
        builder.ExportOutput(row.estimated_state, "estimated_state")
        if row.measurement_is_new is not None:
            builder.ExportOutput(row.measurement_is_new, "measurement_is_new")
        builder.BuildInto(self)
        self.set_name("sensing")

    def set_random(self, context: Context, generators: Sequence[RandomGenerator]) -> None:
        """Draw the random state of each of several copies of the spacecraft."""
        for stage in self.GetSystems():
            if isinstance(stage, _NoiseStage):
                stage.set_random(self.GetMutableSubsystemContext(stage, context), generators)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sensors(Part):
    """The section ``sensing``."""

    def build(self, setup: BlockSetup) -> Sensing:
        """Return the sensors of a scenario."""
        settings = [setup.scenario.sensing]
        return make_sensing(settings, setup.coordinates, sample_time=setup.sample_time)

    def build_wide(self, setups: Sequence[BlockSetup]) -> Sensing | None:
        """Return the sensors of several copies of the spacecraft, see ``systems.side_by_side``;
        None if only some sensors are slow, or drift, or have errors in the base's axes.
        """
        settings, coordinates = [setup.scenario.sensing for setup in setups], setups[0].coordinates
        each = [SensorErrors(of, coordinates, setups[0].sample_time) for of in settings]
        kinds = [
            (
                *measurement_times(of.settings, coordinates),
                *(of.drift_gains() > 0.0),
                of.axes_matter(),
            )
            for of in each
        ]
        if any((np.concatenate(kind) != np.concatenate(kinds[0])).any() for kind in kinds):
            return None
        return make_sensing(settings, coordinates, sample_time=setups[0].sample_time)


def make_sensing(
    settings: Sequence[SensingSettings], coordinates: Coordinates, *, sample_time: float
) -> Sensing:
    """Return a diagram from ``state`` to ``estimated_state``, both [q; v] (nq + nv), of each of the
    settings.

    With a sensor of a longer period than the controller's there is an output ``measurement_is_new``
    (nq + nv): 1 where this control sample brings a measurement that was not there before, 0 where
    it repeats one.

    Raises:
      ScenarioError: a value is given for an unknown coordinate, or cannot be applied to the base's
        rotation.
    """
    errors = [SensorErrors(each, coordinates, sample_time) for each in settings]
    for each in errors:
        each.check_rotation()
    # The white noise comes before the drift, so that its draws of a seed do not depend on it.
    makers = [_make_bias, _make_white_noise, _make_drift, _make_quantizer]
    white, others = np.any([each.axes_matter() for each in errors], axis=0)
    if white or others:
        makers = [_to_sensors, *makers, _to_world]
    if others and not white:  # then its draws do not depend on the attitude either
        makers.remove(_make_white_noise)
        makers.insert(0, _make_white_noise)
    makers.append(_make_sampling)
    return Sensing([stage for make in makers if (stage := make(errors)) is not None])


@dataclasses.dataclass(frozen=True)
class SensorErrors:
    """The settings of the sensors, as vectors. Raises ScenarioError for an unknown coordinate."""

    settings: SensingSettings
    coordinates: Coordinates
    sample_time: float

    def of(self, key: str, default: float = 0.0) -> np.ndarray:
        """Return a setting by coordinate (nv)."""
        for further in (f"{key}_density", f"{key}_time"):
            if isinstance(given := getattr(self.settings, further, None), dict):
                self.coordinates.vector(given, key=f"sensing.{further}")
        values = getattr(self.settings, key)
        return self.coordinates.vector(values, key=f"sensing.{key}", default=default)

    def pair(self, name: str, default: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return values of positions and of velocities (nv each)."""
        return self.of(f"position_{name}", default), self.of(f"velocity_{name}", default)

    @property
    def turn(self) -> np.ndarray:
        """Matrix (4, 4) by which the constant error turns the attitude's quaternion."""
        return turning_matrix(self.pair("bias")[0][:3])

    @property
    def bias(self) -> np.ndarray:
        """Constant errors along [q; v] (nq + nv), besides the attitude's."""
        return _of_state(*self.pair("bias"))

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviations of white noise along [q; v] (nq + nv)."""
        return _deviations(*self.pair("noise"))

    @property
    def resolution(self) -> np.ndarray:
        """Quantisation along [q; v] (nq + nv); 0: none."""
        return _of_state(*self.pair("quantization"))

    def drift_gains(self) -> np.ndarray:
        """Along [q; v], the intensities of random walks and the standard deviations of correlated
        noise (2, nq + nv).
        """
        walk = self.of("velocity_bias_walk")
        return np.array(
            [_of_state(np.zeros_like(walk), walk), _deviations(*self.pair("correlated_noise"))]
        )

    def drift(self) -> "Drift":
        """Errors that drift."""
        walk, correlated = self.drift_gains()
        constant = self.of("correlation_time", 1.0)
        time_constant = _of_state(constant, constant, quaternion=constant[0])
        walks, noises = np.flatnonzero(walk), np.flatnonzero(correlated)
        # share of the deviation left after one sample
        kept = np.exp(-self.sample_time / time_constant[noises])
        added = correlated[noises] * np.sqrt(1.0 - kept**2)
        return Drift(
            entries=np.concatenate([walks, noises]),
            kept=np.concatenate([np.ones(walks.size), kept]),
            added=np.concatenate([math.sqrt(self.sample_time) * walk[walks], added]),
            start=np.concatenate([np.zeros(walks.size), correlated[noises]]),
        )

    def times(self) -> np.ndarray:
        """Period and delay along [q; v] (2, nq + nv), in whole control samples."""
        each = np.array(measurement_times(self.settings, self.coordinates))
        return np.hstack([each[:, :1], each])  # the quaternion has four

    def axes_matter(self) -> np.ndarray:
        """Whether the base's white noise, and its other errors, depend on the axes (2)."""
        base = slice(0, NUM_BASE_VELOCITIES)
        white = np.stack(self.pair("noise"))[:, base].reshape(-1, 3)
        pairs = (self.pair(name) for name in ("bias", "correlated_noise", "quantization"))
        others = [*itertools.chain(*pairs), self.of("velocity_bias_walk")]
        return np.array([
            (white != white[:, :1]).any(), any(each[base].any() for each in others)
        ])  # fmt: skip

    def check_alike(self, name: str, group: str) -> None:
        """Raise ScenarioError if a setting differs between a base's three coordinates."""
        if len(set(self.of(name, 1.0)[self.coordinates.groups[group]].tolist())) > 1:
            raise ScenarioError(
                f"sensing.{name}", f"must be the same for the three {group} coordinates"
            )

    def check_rotation(self) -> None:
        """Raise ScenarioError for what cannot be applied to the base's rotation, a quaternion."""
        for name in ("noise", "correlated_noise"):
            self.check_alike(f"position_{name}", "base_rotation")
        if self.of("position_quantization")[self.coordinates.groups["base_rotation"]].any():
            raise ScenarioError(
                "sensing.position_quantization",
                "base_rotation has no scale to quantise; leave it out",
            )


class Drift(NamedTuple):
    """Random walks and correlated noise: x = kept x + added times a sample of deviation 1 (n)."""

    entries: np.ndarray  # entries of [q; v] that x is added to
    kept: np.ndarray
    added: np.ndarray
    start: np.ndarray  # standard deviation of x at the start


def _of_state(position: np.ndarray, velocity: np.ndarray, *, quaternion: float = 0.0) -> np.ndarray:
    """Return values along [q; v] (nq + nv) from those of the coordinates (nv each)."""
    return np.concatenate([np.full(4, quaternion), position[3:], velocity])


def _deviations(position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Standard deviations along [q; v] from those of the coordinates (nv each).

    Rotation noise of standard deviation sigma is added to the quaternion of the base as sigma/2 per
    component: along the quaternion it changes only the norm, which no reader of the state looks at;
    across it, it is a rotation of sigma about each axis to first order.
    """
    return _of_state(position, velocity, quaternion=0.5 * position[0])


def _build_stage(
    name: str, builder: DiagramBuilder, before: InputPort, after: OutputPort
) -> Diagram:
    """Return the diagram of a stage with one input and one output port for the state."""
    builder.ExportInput(before, "state")
    builder.ExportOutput(after, "estimated_state")
    stage = builder.Build()
    stage.set_name(name)
    return stage


def _make_stage(name: str, system: System) -> Diagram:
    """Return a system with one input and one output as a stage."""
    builder = DiagramBuilder()
    builder.AddNamedSystem(f"{name}_of_state", system)
    return _build_stage(name, builder, system.get_input_port(), system.get_output_port())


class _NoiseStage(Diagram):
    """A stage with additive Gaussian noise: its shaping system gets independent samples of
    deviation 1, one for each control period and input.
    """

    def __init__(self, name: str, shaped_by: System, *, copies: int, sample_time: float) -> None:
        super().__init__()
        builder, self._shaped_by = DiagramBuilder(), shaped_by
        builder.AddNamedSystem("shaped", shaped_by)
        size = shaped_by.get_input_port().size()
        self._samples = (
            RandomSource(RandomDistribution.kGaussian, size, sample_time)
            if copies == 1
            else _Samples(size // copies, copies=copies, sample_time=sample_time)
        )
        builder.AddNamedSystem("samples", self._samples)
        noisy = builder.AddNamedSystem("noisy", Adder(2, shaped_by.get_output_port().size()))
        builder.Connect(self._samples.get_output_port(), shaped_by.get_input_port())
        builder.Connect(shaped_by.get_output_port(), noisy.get_input_port(1))
        builder.ExportInput(noisy.get_input_port(0), "state")
        builder.ExportOutput(noisy.get_output_port(), "estimated_state")
        builder.BuildInto(self)
        self.set_name(name)

    def set_random(self, context: Context, generators: Sequence[RandomGenerator]) -> None:
        """See ``Sensing.set_random``."""
        if isinstance(self._shaped_by, SideBySide):
            own = self.GetMutableSubsystemContext(self._shaped_by, context)
            self._shaped_by.set_random(own, generators)
        if isinstance(self._samples, _Samples):
            self._samples.set_random(generators)


class _Samples(LeafSystem):
    """Gaussian samples of deviation 1 of several copies of the spacecraft, as a RandomSource gives
    each with its seed: drawn in advance, as an event for each source and sample takes longer.

    Output and discrete state: (copies * size), updated every ``sample_time``.
    """

    def __init__(self, size: int, *, copies: int, sample_time: float) -> None:
        super().__init__()
        builder = DiagramBuilder()
        # each of its updates draws _DRAWN samples
        self._sources = [
            builder.AddSystem(RandomSource(RandomDistribution.kGaussian, _DRAWN * size, 1.0))
            for _ in range(copies)
        ]
        self._simulator = Simulator(builder.Build())
        self._sample_time = sample_time
        self._rows, self._block = np.zeros((_DRAWN, copies * size)), 0
        self._value = self.DeclareDiscreteState(copies * size)
        self.DeclareStateOutputPort("samples", self._value)
        # Same order as in RandomSource: before the discrete updates of the same instant, its
        # readers.
        self.DeclarePeriodicUnrestrictedUpdateEvent(sample_time, 0.0, weak_callback(self._update))
        untie(self)

    def set_random(self, generators: Sequence[RandomGenerator]) -> None:
        """Begin a run: the copies draw their seeds."""
        diagram = self._simulator.get_system()
        context = diagram.CreateDefaultContext()
        for source, generator in zip(self._sources, generators, strict=True):
            source.SetRandomContext(source.GetMyMutableContextFromRoot(context), generator)
        self._simulator.reset_context(context)
        self._block = 0
        self._read()

    def _read(self) -> None:
        context = self._simulator.get_context()
        drawn = [
            source.get_output_port().Eval(source.GetMyContextFromRoot(context)).reshape(_DRAWN, -1)
            for source in self._sources
        ]
        self._rows = np.concatenate(drawn, axis=1)

    def _update(self, context: Context, state: State) -> None:
        # A RandomSource draws once before its first update.
        block, row = divmod(round(context.get_time() / self._sample_time) + 1, _DRAWN)
        while self._block < block:
            self._simulator.AdvanceTo(self._block)
            self._simulator.AdvancePendingEvents()
            self._block += 1
            self._read()
        state.get_mutable_discrete_state().set_value(self._value, self._rows[row])


class _Turning(LeafSystem):
    """A stage from world axes to those of the base's sensors, or ``back``; of several copies of the
    spacecraft each by itself.

    Inputs: ``state`` and ``true_state``. Output: ``estimated_state``, in which p_WB, w_WB and v_WB
    are turned, and the attitude's quaternion is relative to the true one (nq + nv each).
    """

    def __init__(self, coordinates: Coordinates, *, copies: int, back: bool) -> None:
        super().__init__()
        nv = len(coordinates.names)
        size, self._copies, self._back = copies * (2 * nv + 1), copies, back
        self._vectors = np.array([[4], [nv + 1], [nv + 4]]) + np.arange(3)
        self._inputs = [self.DeclareVectorInputPort(n, size) for n in ("state", "true_state")]
        read = {self.input_port_ticket(port.get_index()) for port in self._inputs}
        self.DeclareVectorOutputPort("estimated_state", size, weak_callback(self._calc), read)
        untie(self)

    def _calc(self, context: Context, output: BasicVector) -> None:
        state, true = (port.Eval(context).reshape(self._copies, -1) for port in self._inputs)
        state = state.copy()
        for row, quaternion in zip(state, true[:, :4], strict=True):
            turn = product_matrix(quaternion / math.hypot(*quaternion.tolist()))
            # rows of vectors: R v is v R', R' v is v R
            R = matrix_of(quaternion)
            row[:4] = (turn if self._back else turn.T) @ row[:4]
            row[self._vectors] = row[self._vectors] @ (R.T if self._back else R)
        output.SetFromVector(state.ravel())


def _to_sensors(errors: Sequence[SensorErrors]) -> _Turning:
    """Into the axes of the base's sensors."""
    stage = _Turning(errors[0].coordinates, copies=len(errors), back=False)
    stage.set_name("to_sensors")
    return stage


def _to_world(errors: Sequence[SensorErrors]) -> _Turning:
    """Out of them."""
    stage = _Turning(errors[0].coordinates, copies=len(errors), back=True)
    stage.set_name("to_world")
    return stage


def _make_bias(errors: Sequence[SensorErrors]) -> Diagram | None:
    """Constant errors; that of the attitude turns it by a rotation vector."""
    bias = np.concatenate([each.bias for each in errors])
    turns = [each.turn for each in errors]
    turned = any((turn != np.eye(4)).any() for turn in turns)
    if not (turned or bias.any()):
        return None
    builder = DiagramBuilder()
    biases = builder.AddNamedSystem("bias", ConstantVectorSource(bias))
    biased = builder.AddNamedSystem("biased", Adder(2, bias.size))
    before = biased.get_input_port(0)
    builder.Connect(biases.get_output_port(), biased.get_input_port(1))
    if turned:
        sizes = [4, bias.size // len(errors) - 4] * len(errors)
        parts = builder.AddNamedSystem("parts", Demultiplexer(sizes))
        whole = builder.AddNamedSystem("whole", Multiplexer(sizes))
        for i, matrix in enumerate(turns):
            turn = builder.AddNamedSystem(f"turn_{i}", MatrixGain(matrix))
            builder.Connect(parts.get_output_port(2 * i), turn.get_input_port())
            builder.Connect(turn.get_output_port(), whole.get_input_port(2 * i))
            builder.Connect(parts.get_output_port(2 * i + 1), whole.get_input_port(2 * i + 1))
        builder.Connect(whole.get_output_port(), before)
        before = parts.get_input_port()
    return _build_stage("bias", builder, before, biased.get_output_port())


def _make_white_noise(errors: Sequence[SensorErrors]) -> Diagram:
    """One independent Gaussian sample per coordinate and control period, held in between."""
    deviations = np.concatenate([each.deviation for each in errors])
    return _NoiseStage(
        "white_noise",
        Gain(deviations),
        copies=len(errors),
        sample_time=errors[0].sample_time,
    )


def _make_drift(errors: Sequence[SensorErrors]) -> Diagram | None:
    """Random walks of the velocities' bias, from zero, and correlated noise."""
    if not any(each.drift_gains().any() for each in errors):
        return None
    drifts = [_drift(each) for each in errors]
    port = drifts[0].get_input_port().get_name()
    return _NoiseStage(
        "drift",
        drifts[0] if len(drifts) == 1 else SideBySide(drifts, [port]),
        copies=len(errors),
        sample_time=errors[0].sample_time,
    )


def _drift(errors: SensorErrors) -> LinearSystem:
    """First-order Gauss-Markov processes, stationary from the start, from independent samples."""
    drift = errors.drift()
    shown = np.eye(2 * len(errors.coordinates.names) + 1)[:, drift.entries]
    system = LinearSystem(
        A=np.diag(drift.kept),
        B=np.diag(drift.added),
        C=shown,
        D=np.zeros_like(shown),
        time_period=errors.sample_time,
    )
    system.configure_random_state(np.diag(drift.start**2))
    return system


def _make_quantizer(errors: Sequence[SensorErrors]) -> Diagram | None:
    """Rounding of all but the base's rotation."""
    resolution = np.concatenate([each.resolution for each in errors])
    return _make_stage("quantizer", Quantizer(resolution)) if resolution.any() else None


def _make_sampling(errors: Sequence[SensorErrors]) -> Sampling | None:
    """Longer periods and delays."""
    period, delay = np.concatenate([each.times() for each in errors], axis=1)
    if not ((period > 1).any() or delay.any()):
        return None
    sampling = Sampling(period, delay, sample_time=errors[0].sample_time)
    sampling.set_name("sampling")
    return sampling


def measurement_times(
    settings: SensingSettings, coordinates: Coordinates
) -> tuple[np.ndarray, np.ndarray]:
    """Period and delay of the measurements of positions, then velocities (2 nv): whole control
    samples.

    Raises ScenarioError for an unknown coordinate, and where the base's sensors, each of which
    measures along three axes at once, do so at different times.
    """
    errors = SensorErrors(settings, coordinates, 0.0)
    for name, group in itertools.product(("period", "delay"), ("base_rotation", "base_position")):
        errors.check_alike(f"position_{name}", group)
        errors.check_alike(f"velocity_{name}", group)
    period, delay = (
        np.concatenate(errors.pair(name, default)).astype(int)
        for name, default in (("period", 1.0), ("delay", 0.0))
    )
    return period, settings.delay + delay
