"""The motions of a log: attitude, position and joints, their rates and possible mistakes."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from ffsm_drake.plugins.audit.log import Array, Log, thinned
from ffsm_drake.plugins.audit.misfit import Estimate, Mistake, Motion, about, areas, means
from ffsm_drake.spacecraft.coordinates import position_errors

_DEGREES = 180.0 / math.pi


def turned(log: Log) -> Array:
    """Rotation vectors between samples (n - 1, 3), world axes, rad."""
    return position_errors(log.quaternion[1:], log.quaternion[:-1])[:, :3]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Kind:
    """A motion, and the possible mistakes of its rates."""

    name: str
    path: str  # name of the log's array of positions
    rate: str  # name of the log's array of rates
    mistakes: Callable[[Log], Iterator[Mistake]]

    def motion(self, log: Log, step: int) -> Motion:
        """The motion at every ``step``-th sample; the attitude's is in world axes."""
        log = thinned(log, step)
        rate, beside = getattr(log, self.rate), np.zeros(1)
        moved = (
            turned(log) if self.path == "quaternion" else np.diff(getattr(log, self.path), axis=0)
        )
        if self.path == "quaternion":
            beside = np.diff(log.time)[:, None] ** 2 / 12.0 * np.cross(rate[1:], rate[:-1])
        return Motion(time=log.time, rate=rate, moved=moved, beside=beside)


_Row = tuple[str, str, Sequence[Array], float, str]


def _mistakes(log: Log, rate: str, *table: _Row) -> Iterator[Mistake]:
    """Mistakes of a rate: a scale, a delay, and the rows of a table.

    A row has a cause, a text, changes of the rate (n, k) for sizes of 1, the factor of the sizes
    in the text, and their unit.
    """
    values = getattr(log, rate)
    yield Mistake(
        cause="rate_scale", text="the position changes by {0} the logged rate", unit="times",
        offset=1.0, columns=[areas(log.time, values)], changes=[values], floors=-1.0,
    )  # fmt: skip
    lag = [np.diff(log.time)[:, None] * np.diff(values, axis=0)]
    late = "the rates are {0} "
    for text, factor, least, most in (
        (late + "late", 1.0, 0.5, math.inf), (late + "early", -1.0, -math.inf, -0.5),
    ):  # fmt: skip
        yield Mistake(
            cause="time_shift", text=text, unit="periods", factor=factor, columns=lag, least=least,
            most=most,
        )  # fmt: skip
    for cause, text, changes, factor, unit in table:
        columns = [areas(log.time, each) for each in changes]
        yield Mistake(
            cause=cause, text=text, columns=columns, changes=changes, factor=factor, unit=unit
        )


def mended(log: Log, rate: str, found: Estimate) -> Log:
    """The log without a mistake of its rates."""
    values = getattr(log, rate)
    if found.mistake.cause == "time_shift":
        times = log.time + found.sizes[0] * np.median(np.diff(log.time))
        columns = [np.interp(times, log.time, column) for column in values.T]
        return log.replace(**{rate: np.stack(columns, axis=1)})
    changes = zip(found.sizes, found.mistake.changes, strict=True)
    return log.replace(**{rate: values + sum(size * change for size, change in changes)})


def constant(log: Log, axes: Array) -> list[Array]:
    """Vectors (k), repeated for each sample (n, k)."""
    return [np.broadcast_to(axis, (len(log.time), len(axis))) for axis in axes]


def fixed(log: Log) -> list[Array]:
    """The axes of the base (n, 3)."""
    return [log.attitude.apply(axis) for axis in np.eye(3)]


def _of_angular(log: Log) -> Iterator[Mistake]:
    """Mistakes of a gyro: turned or scaled axes, an offset, a turning frame."""
    w, attitude, axes = log.angular, log.attitude, fixed(log)
    local, moved = attitude.inv().apply(w), attitude[:-1].inv().apply(turned(log))
    turn, _ = Rotation.align_vectors(moved, means(local) * np.diff(log.time)[:, None])
    vector = about(turn.as_rotvec(degrees=True), None, "deg")
    change = (attitude * turn).apply(local) - w
    yield Mistake(
        cause="axes", text=f"its axes are the base axes turned by {vector} (rotation vector)",
        columns=[areas(log.time, change)], changes=[change], more=2, least=0.98, most=1.02,
    )  # fmt: skip
    along = [axis * (axis * w).sum(axis=1, keepdims=True) for axis in axes]
    yield from _mistakes(
        log, "angular",
        ("rate_offset", "a constant rate offset of {0} in base axes", axes, -_DEGREES, "deg/s"),
        ("frame_rate", "relative to a frame that turns at a constant rate of {0} (world axes)",
         constant(log, np.eye(3)), 1.0, "rad/s"),
        ("rate_scale", "the attitude changes by more than the rate about each axis: {0}", along,
         100.0, "%"),
    )  # fmt: skip


def _of_linear(log: Log) -> Iterator[Mistake]:
    """Mistakes of a velocity: an offset, a turning frame, turned axes."""
    still = np.eye(3)
    yield from _mistakes(
        log, "linear",
        ("rate_offset", "a constant offset of {0} in world axes: another frame's motion",
         constant(log, still), -1.0, "m/s"),
        ("rate_offset", "a constant offset of {0} in base axes", fixed(log),
         -1.0, "m/s"),
        ("frame_rate", "relative to a frame that turns at a constant rate of {0} (world axes)",
         [np.cross(axis, log.position) for axis in still], 1.0, "rad/s"),
        ("axes", "its axes are turned from the position's by {0} (rotation vector)",
         [np.cross(axis, log.linear) for axis in still], _DEGREES, "deg"),
    )  # fmt: skip


def _of_joint(log: Log) -> Iterator[Mistake]:
    """Mistakes of a joint's rate: an offset."""
    offset = "its rate has a constant offset of {0}"
    changes = constant(log, np.ones((1, 1)))
    return _mistakes(log, "rates", ("rate_offset", offset, changes, -1.0, "rad/s or m/s"))


ANGULAR = Kind(
    name="angular velocity", path="quaternion", rate="angular", mistakes=_of_angular,
)  # fmt: skip
LINEAR = Kind(
    name="base velocity", path="position", rate="linear", mistakes=_of_linear,
)  # fmt: skip


def of_joint(name: str) -> Kind:
    """The motion of one joint, in a log with only its column."""
    return Kind(name=name, path="angles", rate="rates", mistakes=_of_joint)
