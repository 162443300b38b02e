"""The sensors of a spacecraft: what they make of the true state, at a control sample.

The order of their errors: bias, white noise, drifts, quantisation, then periods and delays.

The base's sensors are fixed to the base, so their errors are in its axes: with R the true attitude,
a gyro's error b changes w to w + R b in world axes. If the base has errors that depend on axes, the
state is transformed to its sensors' axes before them and back after them; the star tracker's
attitude is there the rotation from the true base. Isotropic white noise is the same in any axes. It
is then added first, in the world's, so that its draws do not depend on the attitude. Joints have
axes of their own.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ffsm_drake.common.so3 import matrix_of, product_matrix
from ffsm_drake.systems.quantization import quantize
from ffsm_drake.systems.sampled import Arrays, Now, Sampled
from ffsm_drake.systems.sensing.errors import SensorErrors

IS_NEW = "measurement_is_new"


class Sensor(NamedTuple):
    """Entries of [q; v] that are measured with one period and delay, in whole control samples.

    At control sample k it shows the measurement of sample p floor((k - d) / p), with its period p
    and delay d; it is new if k - d is a multiple of p.
    """

    period: int
    delay: int
    entries: tuple[int, ...]

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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measurement(Sampled):
    """From the true state to what the sensors show; all vectors are along [q; v] (nq + nv).

    Inputs: ``state``, the true one; ``white``, samples of white noise, if it is ``noisy``;
    ``drift``, errors of the entries ``drifting``.
    Outputs: ``estimated_state``, and, with a period longer than a control sample,
    ``measurement_is_new``: 1 for entries with a measurement shown for the first time, else 0.
    Memory: of each late sensor, the measurements made last, newest first.
    """

    size: int  # nq + nv
    bias: np.ndarray  # besides the attitude's
    turn: np.ndarray  # (4, 4) the attitude's bias
    resolution: np.ndarray
    turned: tuple[bool, bool]  # white noise, and other errors, are along the base's axes
    biased: bool
    noisy: bool
    rounded: bool
    drifting: tuple[int, ...]
    late: tuple[Sensor, ...]  # with a period or delay

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        sizes = {"state": self.size, "white": self.noisy * self.size, "drift": len(self.drifting)}
        return {name: size for name, size in sizes.items() if size}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        is_slow = any(sensor.period > 1 for sensor in self.late)
        return dict.fromkeys(("estimated_state", IS_NEW)[: 1 + is_slow], self.size)

    @property
    def is_plain(self) -> bool:
        """Whether there is white noise at most."""
        return not (self.biased or self.rounded or any(self.turned) or self.drifting or self.late)

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled; before the start the state was measured."""
        before = np.zeros(self.size) if state is None else state
        return {
            name: np.tile(before[list(sensor.entries)], sensor.kept)
            for name, sensor in self._by_name.items()
        }

    def phase(self, sample: Any) -> Sequence[Any]:
        """``Sensor.phase`` of each late sensor."""
        return [each for sensor in self.late for each in sensor.phase(sample)]

    @property
    def phase_period(self) -> int:
        """See Sampled."""
        return math.lcm(*(sensor.period for sensor in self.late))

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        true = values = inputs["state"]
        of_white, of_others = self.turned
        white_first = of_others and not of_white
        if self.noisy and white_first:
            values = values + inputs["white"]
        if any(self.turned):
            turn, R = product_matrix(_unit(true[:4])), matrix_of(true[:4])
            values = _turned(values, turn.T, R)
        if self.biased:
            attitude = (self.turn * values[:4]).sum(axis=-1)
            values = np.concatenate([attitude, values[4:]]) + self.bias
        if self.noisy and not white_first:
            values = values + inputs["white"]
        if self.drifting:
            values, entries = values.copy(), list(self.drifting)
            values[entries] = values[entries] + inputs["drift"]
        if self.rounded:
            values = quantize(values, self.resolution)
        if any(self.turned):
            values = _turned(values, turn, R.T)
        return self._shown(values, memory, now)

    def _shown(self, values: Any, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """The last stage: periods and delays."""
        shown, after = values.copy(), dict[str, Any]()
        is_new = values * 0.0 + 1.0
        for at, (name, sensor) in enumerate(self._by_name.items()):
            # without a period the phase is the same at each sample
            own = now.phase[3 * at : 3 * at + 3] if sensor.period > 1 else sensor.phase(0)
            measures, new, age = own
            entries = list(sensor.entries)
            kept = memory[name].reshape(sensor.kept, -1)
            for each in _ages(sensor.period, sensor.delay):
                shown[entries] = np.where(age == each, kept[each], shown[entries])
            is_new[entries] = new
            moved = np.concatenate([values[entries][None], kept[:-1]])
            after[name] = np.where(measures, moved, kept).ravel()
        outputs = {"estimated_state": shown, IS_NEW: is_new}
        return {name: outputs[name] for name in self.outputs}, after

    @functools.cached_property
    def _by_name(self) -> Mapping[str, Sensor]:
        return {f"late_{at}": sensor for at, sensor in enumerate(self.late)}


@functools.cache
def _ages(period: int, delay: int) -> list[int]:
    """Ages of kept measurements that a sensor shows."""
    sensor = Sensor(period, delay, ())
    return sorted({sensor.phase(sample)[2] for sample in range(period)} - {-1})


def _turned(values: Any, turn: Any, R: Any) -> Any:
    """A measurement in other axes: ``turn`` (4, 4) acts on its quaternion, and R (3, 3) from the
    right on its vectors, as rows.
    """
    values, vectors = values.copy(), _vectors(len(values))
    values[:4] = turn @ values[:4]
    values[vectors] = values[vectors] @ R
    return values


@functools.cache
def _vectors(size: int) -> np.ndarray:
    """Entries of p_WB, w_WB and v_WB in a state (3, 3)."""
    first = (size - 1) // 2 + 1
    return np.array([[4], [first], [first + 3]]) + np.arange(3)


def _unit(quaternion: Any) -> Any:
    is_traced = quaternion.dtype == object
    norm = np.sqrt(quaternion @ quaternion) if is_traced else math.hypot(*quaternion.tolist())
    return quaternion / norm


def measurement_of(errors: SensorErrors) -> Measurement:
    """Return the block of some settings."""
    turn, bias, times = errors.turn, errors.bias, errors.times()
    of_white, of_others = errors.axes_matter().tolist()
    return Measurement(
        size=bias.size,
        bias=bias,
        turn=turn,
        resolution=errors.resolution,
        turned=(of_white, of_others),
        biased=bool(bias.any() or (turn != np.eye(4)).any()),
        noisy=bool(errors.deviation.any()),
        rounded=bool(errors.resolution.any()),
        drifting=tuple(errors.drift().entries.tolist()),
        late=tuple(_late_sensors(*times)),
    )


def _late_sensors(period: np.ndarray, delay: np.ndarray) -> list[Sensor]:
    """The sensors with a period longer than a control sample, or with a delay, from those of each
    entry.
    """
    pairs = sorted(set(zip(period.tolist(), delay.tolist(), strict=True)) - {(1, 0)})
    return [
        Sensor(p, d, tuple(np.flatnonzero((period == p) & (delay == d)).tolist())) for p, d in pairs
    ]
