"""A log of a spacecraft's motion as arrays, with the uncertainty of its digits and sampling."""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import TypeVar

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

Array = np.ndarray
RATES = ("angular", "linear", "rates")  # absent from a log of poses alone
_Samples = TypeVar("_Samples")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Log:
    """Samples of a spacecraft's motion in the axes and units of the log.

    An array that is not logged is zero. A missing rate is differentiated.
    """

    time: Array  # (n), s
    quaternion: Array  # (n, 4) of R_WB, w first
    position: Array  # (n, 3) p_WB, m
    angular: Array  # (n, 3) w_WB, rad/s
    linear: Array  # (n, 3) v_WB, m/s
    angles: Array  # (n, joints), rad or m
    rates: Array  # (n, joints)
    efforts: Array  # (n, joints) at the joints, N m or N
    torque: Array  # (n, 3) on the base, world axes, N m
    force: Array  # (n, 3) on the base at its origin, world axes, N
    disturbance: Array  # (n, 6 + joints) generalized force in addition to these
    chain: Array  # (n, joints) part of the disturbance, from the loops of a closed chain
    stated: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Axes that the log states, such as angular -> body axes."""
    missing: tuple[str, ...] = ()  # arrays that are not logged
    note: str = ""  # on the samples
    digits: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Step of the last digit of each array; 0 where it is that of double precision."""
    unsure: Mapping[str, Array] = dataclasses.field(default_factory=dict)
    """Change of interpolated or differentiated arrays if every second value is left out."""

    def replace(self, **changes: object) -> "Log":
        """A copy with other columns."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]

    @functools.cached_property
    def attitude(self) -> Rotation:
        """R_WB (n), of quaternions of any norm."""
        largest = np.abs(self.quaternion).max(axis=1, keepdims=True)
        return Rotation.from_quat(self.quaternion / largest, scalar_first=True)

    @functools.cached_property
    def resampled(self) -> "Log":
        """The log with arrays interpolated or differentiated from every second value."""
        changed = {what: getattr(self, what) + change for what, change in self.unsure.items()}
        return self.replace(**changed)

    def driven(self) -> "Log":
        """The log with the force of a rigid chain added to the efforts of the sample before.

        The force is logged before the efforts of its sample, and jumps with them. In a period it
        turns with the posture, by at most about its size times the change of the joints. Half of
        this change is the uncertainty of the efforts.
        """
        rest = self.disturbance.copy()
        rest[:, -self.chain.shape[1] :] -= self.chain
        held = np.concatenate([self.chain[1:], self.chain[-1:]])
        turned = np.gradient(self.angles, axis=0)
        sizes = np.linalg.norm(held, axis=1) * np.linalg.norm(turned, axis=1)
        unsure = {**self.unsure, "efforts": np.tile(0.5 * sizes[:, None], held.shape[1])}
        return self.replace(disturbance=rest, efforts=self.efforts + held, unsure=unsure)

    @functools.cached_property
    def shaken(self) -> "Log":
        """The log with half a last digit added or subtracted at random; equal values stay equal."""
        draw, changes = np.random.default_rng(0), {}
        for what, digit in self.digits.items():
            values = getattr(self, what)
            if digit:
                runs = np.cumsum(np.diff(values, axis=0, prepend=values[:1]) != 0.0, axis=0)
                sides = draw.choice([-0.5, 0.5], values.shape)
                changes[what] = values + digit * np.take_along_axis(sides, runs, 0)
        return self.replace(**changes)


def only(samples: _Samples, kept: Array | slice) -> _Samples:
    """Some samples of a dataclass of arrays. If all are kept, nothing is copied."""
    if isinstance(kept, np.ndarray) and kept.dtype == bool and kept.all():
        return samples
    changes: dict[str, object] = {}
    for field in dataclasses.fields(samples):  # type: ignore[arg-type]
        value = getattr(samples, field.name)
        if isinstance(value, np.ndarray):
            changes[field.name] = value[kept]
        elif field.name == "unsure":
            changes[field.name] = {what: change[kept] for what, change in value.items()}
    return dataclasses.replace(samples, **changes)  # type: ignore[type-var]


def thinned(samples: _Samples, step: int) -> _Samples:
    """Every ``step``-th sample of a dataclass of arrays with a time, in whole steps."""
    count = len(samples.time)  # type: ignore[attr-defined]
    return only(samples, slice(None, count - (count - 1) % step, step))


def every(count: int, *, most: int) -> Array:
    """Indices of at most ``most`` of ``count`` samples, evenly spread, with the first."""
    return np.arange(0, count, -(-count // most))


def resolution(values: Array) -> float | None:
    """Step of the last digit (decimal, or of single precision) of the columns (n, k) that vary;
    None if no column varies.
    """
    worst = None
    for column in values[:: -(-len(values) // 2000)].T:
        some = column[np.isfinite(column)]
        if not some.size or not np.ptp(some) or np.ptp(np.diff(some)) < 1e-9 * np.ptp(some):
            continue  # constant, or even as times are
        size, worst = float(np.abs(some).max()), worst or 0.0
        if (
            size < 1e38
            and (some == some.astype(np.float32)).all()
            and (some != np.round(some)).any()
        ):
            worst = max(worst, size * float(np.finfo(np.float32).eps))
        for step in 10.0 ** -np.arange(12.0):
            if (
                step <= size < 1e12 * step
                and (np.abs(some / step - np.round(some / step)) < 1e-4).all()
            ):
                worst = max(worst, float(step))
                break
    return worst


def with_rates(log: Log) -> Log:
    """The log with its missing rates, in world axes, from cubic splines through the poses. Times
    must increase.
    """
    turned = (log.quaternion[1:] * log.quaternion[:-1]).sum(axis=1) < 0.0
    q = log.quaternion * np.cumprod(np.where([False, *turned], -1.0, 1.0))[:, None]
    paths = {"angular": q, "linear": log.position, "rates": log.angles}

    def rates(step: int) -> dict[str, Array]:
        found = {
            what: CubicSpline(log.time[::step], path[::step])(log.time, 1)
            for what, path in paths.items()
        }
        dw, dv = found["angular"][:, :1], found["angular"][:, 1:]
        found["angular"] = 2.0 * (q[:, :1] * dv - dw * q[:, 1:] - np.cross(dv, q[:, 1:]))
        return {what: found[what] for what in log.missing if what in RATES}

    fine, coarse = rates(1), rates(2)
    unsure = {what: coarse[what] - fine[what] for what in fine}
    return log.replace(**fine, unsure={**log.unsure, **unsure})


def interpolated(
    time: Array, values: Array, wanted: Array, *, smooth: bool, step: int = 1
) -> Array:
    """Columns (n, k) with blank cells, interpolated to the times ``wanted`` (m, k).

    Every ``step``-th value is used. Smooth columns are interpolated by cubic splines, others
    linearly. Results outside a column's times are NaN.
    """
    found = np.full((len(wanted), values.shape[1]), math.nan)
    for i, column in enumerate(values.T):
        own, index = np.unique(time[np.isfinite(column)], return_index=True)
        given = column[np.isfinite(column)][index]
        inside = (wanted >= own[0]) & (wanted <= own[-1])
        picked = np.union1d(np.arange(0, own.size, step), [own.size - 1])
        times, given = own[picked], given[picked]
        if smooth and own.size > 2:
            found[inside, i] = CubicSpline(times, given)(wanted[inside])
        else:
            found[inside, i] = np.interp(wanted[inside], times, given)
    return found
