"""Is a log physics? Checks of another simulator's log of a free-flying spacecraft against a URDF:
frames and units of its velocities, then momentum and the joints' efforts with this package's plant.

Every check is a fit. Displacements must be the integrals of the logged rates, momenta those of the
logged forces. What is missed is compared with the tolerance, and with what the sampling and the
digits leave open; beyond these, the mistake is named with which nothing is missed.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ffsm_drake.analysis.foreign_log import ForeignLog, read_log, with_rates
from ffsm_drake.analysis.log_dynamics import MOST, Bodies, Dynamics, every, only, turns_of
from ffsm_drake.common.errors import RecordError
from ffsm_drake.common.so3 import in_body_axes
from ffsm_drake.scenario import Model
from ffsm_drake.spacecraft.coordinates import position_errors
from ffsm_drake.spacecraft.plant import base_body, make_plant

TOLERANCE = 1e-3  # share that a motion may miss of its rates, a momentum of what bodies exchange
_FITS = 0.1  # share of a motion within which axes and units of its rates are recognised
_NAMED = 0.15  # share of what is missed that may remain with the mistake that is named
_SURE = 0.03  # the same, where less could be the doubt of sampling, digits or noise
_CLEAR = 0.01  # the same, from which on fewer sizes are better than less that remains
_TRIMMED = 0.9  # share of the periods that a fit is about: jumps are found apart
_STILL = 1e-9  # rad or m in a period
_EVEN = 0.8  # share of equal periods from which on a log is sampled evenly
_FOLDS = 8  # parts of a log that are left out in turn, for standard errors
_GROUPS = 60  # places of the log at which momentum is compared, of four samples each
_PARTS = 4  # of a long log, in which the joints' efforts are checked
_DEGREE = math.pi / 180.0
_INVERSE = np.array([1.0, -1.0, -1.0, -1.0])  # of a quaternion


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """The result of one check."""

    name: str
    statement: str
    verdict: Literal["holds", "measured", "not tested", "cannot tell", "does not hold"] = "holds"
    cause: str = ""  # of what does not hold or cannot be told: one word for one mistake
    value: float | None = None  # of a rate: the factor by which the position changes more


@dataclasses.dataclass(frozen=True, kw_only=True)
class Audit:
    """The checks of one log, in their order."""

    checks: tuple[Check, ...]

    @property
    def verdict(self) -> Literal["yes", "no", "cannot tell"]:
        """Whether the log is physics."""
        return "no" if self.causes else "cannot tell" if self.doubts else "yes"

    @property
    def is_physics(self) -> bool:
        """True if the verdict is "yes"."""
        return self.verdict == "yes"

    @property
    def causes(self) -> tuple[str, ...]:
        """The mistakes that were named."""
        return self._causes("does not hold")

    @property
    def doubts(self) -> tuple[str, ...]:
        """What keeps checks from a verdict."""
        return self._causes("cannot tell")

    def _causes(self, verdict: str) -> tuple[str, ...]:
        return tuple(
            dict.fromkeys(check.cause for check in self.checks if check.verdict == verdict)
        )

    def as_data(self) -> dict[str, object]:
        """Plain data, for JSON."""
        return {
            "is_physics": self.is_physics,
            "verdict": self.verdict,
            "checks": [dataclasses.asdict(check) for check in self.checks],
        }

    def __str__(self) -> str:
        lines = [f"[{check.verdict}] {check.name}: {check.statement}" for check in self.checks]
        why = ", ".join(self.causes or self.doubts)
        return "\n".join([*lines, f"Is this log physics? {self.verdict}{': ' if why else ''}{why}"])


def audit(
    log: Path,
    urdf: Path,
    *,
    columns: dict[str, str] | None = None,
    tolerance: float = TOLERANCE,
) -> Audit:
    """Check a log (``read_log``) against a URDF with one free base, or model directives.

    Args:
      columns: other names of columns; see ``read_log``.
      tolerance: share that a displacement may miss of the integral of its rates, a momentum of
        what the bodies exchange, and a joint's momentum of that of its effort.

    Raises:
      ModelError, RecordError: a file cannot be used.
    """
    model = Model(directives=str(urdf), end_effector="WorldModelInstance::world")
    plant = make_plant(model, jointless=True)
    dynamics = Dynamics(plant)
    read = read_log(log, dynamics.names, base=base_body(plant).name(), columns=columns)
    checks: list[Check] = []
    try:
        with np.errstate(all="ignore"):
            for step in (_time, _quaternion, _time_unit, _differentiated):
                found, read = step(read)
                checks += found
            if checks[-1].cause != "half_turns":
                for check in (_attitude, _base_velocity, _joint_rates):
                    found, read = check(read, dynamics, tolerance)
                    checks += found
                checks, read = _time_scale(checks, read)
                checks = _jumps(checks, read)
                found = _dynamics(read, dynamics, tolerance)
                lost = {"dropped_samples", "repeated_samples"} & {check.cause for check in checks}
                checks += [check for check in found if check.name != "energy" or not lost]
    except (np.linalg.LinAlgError, ValueError, FloatingPointError) as error:
        said = "its numbers are too large or too small to be computed with"
        raise RecordError(f"{log}: {said}: {error}") from error
    return Audit(checks=tuple(checks))


_Checked = tuple[list[Check], ForeignLog]


def _fault(name: str, cause: str, statement: str) -> Check:
    return Check(name=name, statement=statement, verdict="does not hold", cause=cause)


def _open(name: str, cause: str, statement: str) -> Check:
    return Check(name=name, statement=statement, verdict="cannot tell", cause=cause)


def _time(log: ForeignLog) -> _Checked:
    """Samples in order, none missing; those out of order are left out from here on."""
    steps = np.diff(log.time)
    if (back := np.flatnonzero(steps <= 0.0)).size:
        kept = log.time > np.maximum.accumulate(np.concatenate([[-np.inf], log.time[:-1]]))
        said = (
            f"{np.sum(~kept)} samples are not later than all before them, first after "
            f"{log.time[back[0]]:g} s"
        )
        return [_fault("time", "time_order", said)], only(log, kept)
    period, size = float(np.median(steps)), log.time.size
    alike = 0.02 * period + log.digits.get("time", 0.0)
    if np.mean(np.abs(steps - period) <= alike) < _EVEN:
        said = f"{size} samples at steps of {steps.min():.4g} to {steps.max():.4g} s{log.note}"
        return [Check(name="time", statement=said)], log
    times = np.round(steps / period)
    gaps = np.flatnonzero((times > 1) & (np.abs(steps - times * period) <= alike * times))
    if gaps.size:
        said = (
            f"about {int(times[gaps].sum()) - gaps.size} samples are missing, in {gaps.size} gaps, "
            f"the first after {log.time[gaps[0]]:g} s"
        )
        return [_fault("time", "dropped_samples", said)], log
    said = f"{size} samples, period {period:.4g} s{log.note}"
    return [Check(name="time", statement=said)], log


_RATES = {
    "angular": "the base's angular velocity",
    "linear": "the base's velocity",
    "rates": "the joints' rates",
}


def _differentiated(log: ForeignLog) -> _Checked:
    """Rates from the positions, where none are logged; none between attitudes too far apart."""
    turn = float(np.linalg.norm(_turned(log), axis=1).max())
    if turn > 0.5 and "angular" not in log.missing:
        speed = np.linalg.norm(log.angular, axis=1)[:, None]
        turn = max(turn, float((_means(speed)[:, 0] * np.diff(log.time)).max()))
    if turn > _FARTHEST:
        said = f"the base turns by {turn:.2g} rad between two samples: log more of them"
        return [_open("attitude", "half_turns", said)], log
    if not log.missing:
        return [], log
    said = f"{', '.join(_RATES[what] for what in log.missing)}: not logged, differentiated"
    return [Check(name="rates", statement=said, verdict="measured")], with_rates(log)


_FARTHEST = 2.8  # rad between samples, nearly half a turn


_TIME_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}


def _time_unit(log: ForeignLog) -> _Checked:
    """A unit of time in which joints and base go as far as their rates say; s if there is none."""
    paths = (log.angles, log.rates), (log.position, log.linear)
    ratios = []
    for position, rate in paths:
        moved = np.linalg.norm(np.diff(position, axis=0), axis=1).sum()
        expected = _integral(log.time, np.linalg.norm(rate, axis=1)[:, None])[-1, 0]
        if moved > _STILL and expected > 0.0:
            ratios.append(moved / expected)
    for unit, factor in _TIME_UNITS.items():
        if ratios and all(abs(ratio / factor - 1.0) < 0.2 for ratio in ratios):
            said = f"it is in {unit}, or every rate is {1.0 / factor:.0e} times too large"
            return [_fault("time", "time_unit", said)], log.replace(time=log.time * factor)
    return [], log


def _quaternion(log: ForeignLog) -> _Checked:
    largest = np.abs(log.quaternion).max(axis=1, keepdims=True)
    norm = np.linalg.norm(log.quaternion / largest, axis=1) * largest[:, 0]
    worst = float(np.abs(norm - 1.0).max())
    whole = log.replace(quaternion=log.quaternion / largest)
    whole = whole.replace(
        quaternion=whole.quaternion / np.linalg.norm(whole.quaternion, axis=1, keepdims=True)
    )
    allowed = 1e-4 + 2.0 * log.digits.get("quaternion", 0.0) + 1.5 * _noise(norm[:, None])
    if worst <= allowed:
        return [Check(name="quaternion", statement=f"its norm is 1 within {worst:.2g}")], whole
    said = f"its norm is {norm.min():.6g} to {norm.max():.6g}, not 1"
    return [_fault("quaternion", "quaternion_norm", said)], whole


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Fit:
    """How well rates explain a motion: displacement = factor * rate * period."""

    factor: float
    missed: float  # share of the displacements, by their root mean square
    still: bool  # nothing moves


def _fit(log: ForeignLog, moved: np.ndarray, rates: np.ndarray) -> _Fit:
    """Compare displacements (n - 1, k) with rates (n, k), but for the periods with jumps."""
    expected = 0.5 * (rates[1:] + rates[:-1]) * np.diff(log.time)[:, None]
    if max(np.abs(moved).max(), np.abs(expected).max()) < _STILL:
        return _Fit(factor=1.0, missed=0.0, still=True)
    kept = np.ones(len(moved), dtype=bool)
    for _ in range(2):
        square = float((expected[kept] ** 2).sum())
        factor = float((moved[kept] * expected[kept]).sum()) / square if square > 0.0 else 0.0
        misses = np.linalg.norm(moved - factor * expected, axis=1)
        kept = misses <= np.quantile(misses, _TRIMMED)
    size = math.sqrt(float((moved[kept] ** 2).sum()))
    missed = math.sqrt(float((misses[kept] ** 2).sum())) / size if size > 0.0 else math.inf
    return _Fit(factor=factor, missed=missed, still=False)


def _rate(log: ForeignLog, path: np.ndarray) -> np.ndarray:
    """Rate (n, k) of a path (n, k), in place of a logged one that cannot be used."""
    rate: np.ndarray = np.gradient(path, log.time, axis=0, edge_order=2)
    return rate


def _turned(log: ForeignLog) -> np.ndarray:
    """Rotation vectors between samples (n - 1, 3), world axes, rad."""
    q = log.quaternion
    return position_errors(q[1:], q[:-1])[:, :3]


def in_world_axes(quaternions: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors in body axes (n, 3) in those of the world, for attitudes (w, x, y, z) (n, 4)."""
    return in_body_axes(quaternions * _INVERSE, vectors)


_ATTITUDES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "": lambda q: q,
    "quaternion_order": lambda q: q[:, [3, 0, 1, 2]],
    "quaternion_inverse": lambda q: q * _INVERSE,
    "quaternion_order, quaternion_inverse": lambda q: q[:, [3, 0, 1, 2]] * _INVERSE,
}
_SAID = {
    "quaternion_order": "the quaternion's scalar stands last (x, y, z, w)",
    "quaternion_inverse": (
        "the attitude turns from world to base axes (R_BW, not R_WB; MRPs sigma_NB, not sigma_BN)"
    ),
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Motion:
    """What each period (n - 1, k) brings of a motion."""

    moved: np.ndarray  # rad or m
    expected: np.ndarray  # the integral of the rates
    missed: np.ndarray  # what is moved beyond that
    slope: np.ndarray  # what the change of the rates' slopes makes of the integral
    lag: np.ndarray  # what is missed if the rates are those of one period later


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Mistake:
    """A mistake that may explain what is missed: its estimated sizes with standard errors."""

    cause: str
    columns: Sequence[np.ndarray]  # of what is missed, for a size of 1 each
    words: Callable[[np.ndarray, np.ndarray], str]
    mend: Callable[[np.ndarray], ForeignLog] | None = None
    usable: Callable[[np.ndarray], bool] = lambda _: True
    more: int = 0  # sizes beside those of the columns


def _other_effort(name: str, other: str, sizes: np.ndarray, errors: np.ndarray) -> str:
    return f"{name}'s effort is that called {other}"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Estimate:
    sizes: np.ndarray
    errors: np.ndarray  # standard errors: what the sizes change by if parts of the log are left out
    left: float  # the largest that is still missed

    @property
    def is_significant(self) -> bool:
        return bool((np.abs(self.sizes) > 3.0 * self.errors).any())


def _since_start(parts: np.ndarray) -> np.ndarray:
    """Sum since the start (n, k) of what each period gives (n - 1, k)."""
    return np.concatenate([np.zeros_like(parts[:1]), np.cumsum(parts, axis=0)])


def _means(values: np.ndarray) -> np.ndarray:
    """Means over each period (n - 1, k) by the trapezoidal rule."""
    found: np.ndarray = 0.5 * (values[1:] + values[:-1])
    return found


def _slopes(time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """What a smooth rate (n, k) makes of its integral over each period beside the trapezoids."""
    slope = np.gradient(rate, time, axis=0, edge_order=2)
    found: np.ndarray = -(np.diff(time)[:, None] ** 2) / 12.0 * np.diff(slope, axis=0)
    return found


def _areas(time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Integral (n - 1, k) of a smooth rate (n, k) over each period, to the fourth order."""
    return np.diff(time)[:, None] * _means(rate) + _slopes(time, rate)


def _swing(path: np.ndarray) -> float:
    """The farthest of a path (n, k) from its mean."""
    return float(np.linalg.norm(path - path.mean(axis=0), axis=1).max(initial=0.0))


def _estimate(missed: np.ndarray, columns: Sequence[np.ndarray], lag: np.ndarray) -> _Estimate:
    """Least squares for sizes of columns (n, k), and of a lag within half a period, which an
    integrator or a hold makes. Standard errors are a jackknife's: parts of the log are left out.
    """
    count = len(columns)
    table = np.stack([*columns, lag], axis=2)
    table = table - table.mean(axis=0)
    flat = missed - missed.mean(axis=0)
    norms = np.sqrt((table**2).sum(axis=(0, 1)))
    table = table / np.where(norms > 0.0, norms, 1.0)
    parts = np.array_split(np.arange(len(flat)), _FOLDS)
    squares = np.array([np.einsum("nki,nkj->ij", table[p], table[p]) for p in parts])
    sums = np.array([np.einsum("nki,nk->i", table[p], flat[p]) for p in parts])

    def solve(square: np.ndarray, right: np.ndarray) -> np.ndarray:
        found: np.ndarray = np.linalg.pinv(square, rcond=1e-12, hermitian=True) @ right
        if abs(found[count]) > 0.5 * norms[count]:
            found[count] = math.copysign(0.5 * norms[count], found[count])
            inner = np.linalg.pinv(square[:count, :count], rcond=1e-12, hermitian=True)
            found[:count] = inner @ (right[:count] - square[:count, count] * found[count])
        return found

    sizes = solve(squares.sum(axis=0), sums.sum(axis=0))
    others = np.array(
        [solve(squares.sum(axis=0) - a, sums.sum(axis=0) - b)
         for a, b in zip(squares, sums, strict=True)]
    )  # fmt: skip
    errors = np.sqrt((_FOLDS - 1) / _FOLDS * ((others - others.mean(axis=0)) ** 2).sum(axis=0))
    units = np.where(norms > 0.0, norms, np.inf)[:count]
    return _Estimate(
        sizes=sizes[:count] / units,
        errors=errors[:count] / units,
        left=_swing(flat - table @ sizes),
    )


def _named(
    missed: np.ndarray,
    lag: np.ndarray,
    mistakes: Sequence[_Mistake],
    doubt: float,
) -> tuple[_Mistake, _Estimate] | None:
    """The mistake with the fewest sizes that explains what is missed about as well as the best
    does, if any: most of it, and nearly all where it may be mere doubt.
    """
    before = _estimate(missed, [], lag).left
    tried = [(each, _estimate(missed, each.columns, lag)) for each in mistakes]
    tried = [(m, e) for m, e in tried if e.is_significant and m.usable(e.sizes)]
    best = min((estimate.left for _, estimate in tried), default=math.inf)
    if best > (max(_NAMED * before, doubt) if before > doubt else _SURE * before):
        return None
    enough = max(2.0 * best, 0.5 * doubt, _CLEAR * before)
    return min(
        ((m, e) for m, e in tried if e.left <= enough),
        key=lambda each: (len(each[0].columns) + each[0].more, each[1].left),
    )


def _noise(values: np.ndarray) -> float:
    """Bound of what jumps from sample to sample in values (..., 4 or more in a row, k)."""
    third = np.diff(values, n=3, axis=-2)
    rms = np.sqrt((third**2).mean(axis=tuple(range(third.ndim - 1))) / 20.0)
    return 4.0 * float(np.linalg.norm(rms))


def _shaken(log: ForeignLog) -> ForeignLog:
    """The log with half of a last digit more or less, anew wherever a number changes."""
    draw = np.random.default_rng(0)
    changes = {}
    for what, digit in log.digits.items():
        if digit and (values := getattr(log, what)) is not None:
            table = values.reshape(len(values), -1)
            runs = np.cumsum(np.diff(table, axis=0, prepend=table[:1]) != 0.0, axis=0)
            sides = draw.choice([-0.5, 0.5], table.shape)
            changes[what] = values + digit * np.take_along_axis(sides, runs, 0).reshape(
                values.shape
            )
    return log.replace(**changes)


def _open_by_steps(paths: Sequence[np.ndarray]) -> float:
    """Bound of the error of a path by quadrature, from those with each, every second and every
    fourth sample, by Richardson's extrapolation with what the steps were seen to gain.
    """
    first, second = (
        _swing(coarse - fine[::2][: len(coarse)]) for fine, coarse in itertools.pairwise(paths)
    )
    gain = min(first / second, 0.9) if second > 0.0 else 0.0
    return first * max(1.0, 2.0 * gain / (1.0 - gain))


def _doubt(
    log: ForeignLog, motion: Callable[[ForeignLog], _Motion], kept: np.ndarray
) -> tuple[float, str]:
    """How far an integral of rates can be off, and why: the steps, the digits, or noise. Only
    periods that are kept (n - 1) count.
    """

    def path(log: ForeignLog, step: int = 1, what: str = "missed") -> np.ndarray:
        whole = len(log.time) - (len(log.time) - 1) % step
        parts = getattr(motion(only(log, slice(None, whole, step))), what)
        whole_blocks = np.all(kept[: whole - 1].reshape(-1, step), axis=1, keepdims=True)
        return _since_start(parts * whole_blocks)

    paths = [path(log, step) for step in (1, 2, 4)]
    slopes = 0.5 * _swing(path(log, what="slope"))
    doubts = {
        "sampling": max(_open_by_steps(paths), slopes), "digits": 0.0, "noise": _noise(paths[0]),
    }  # fmt: skip
    if any(log.digits.values()):
        doubts["digits"] = 2.0 * _swing(path(_shaken(log)) - paths[0])
    why = max(doubts, key=lambda each: doubts[each])
    return doubts[why], why


_DOUBTS = {
    "sampling": "rates of every second sample tell as little: log more samples",
    "digits": "the last digits of the numbers change it as much: log more digits",
    "noise": "it jumps as much from sample to sample: log true values",
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Followed:
    """How a motion follows its rates."""

    checks: list[Check]
    log: ForeignLog  # without the mistake that was named
    missed: float  # share of the motion, with the mistake mended
    is_named: bool = True  # all that is missed is explained


def _follow(
    name: str,
    log: ForeignLog,
    motion: Callable[[ForeignLog], _Motion],
    mistakes: Callable[[ForeignLog, _Motion], Sequence[_Mistake]],
    tolerance: float,
    said: str,
) -> _Followed:
    """Compare a motion with its rates: the paths since the start, jumps apart."""
    parts = motion(log)
    size_of = np.linalg.norm(parts.missed, axis=1)
    most = np.maximum(np.linalg.norm(parts.moved, axis=1), np.linalg.norm(parts.expected, axis=1))
    jumps: np.ndarray = np.asarray(
        (size_of > 10.0 * np.quantile(size_of, _TRIMMED))
        & (size_of > 0.3 * most)
        & (size_of > np.linalg.norm(np.abs(parts.lag) + 3.0 * np.abs(parts.slope), axis=1))
    )
    rows, kept = every(log, most=2000), ~jumps[:, None]

    def path(each: np.ndarray) -> np.ndarray:
        return _since_start(each * kept)[rows]

    lag = path(parts.lag)
    missed = min(  # a smooth rate; one under efforts that are held, which is straight
        (path(parts.missed), path(parts.missed + parts.slope)),
        key=lambda each: _estimate(each, [], lag).left,
    )
    size = max(_swing(path(parts.moved)), _swing(path(parts.expected)))
    if size < _STILL:
        return _Followed(checks=[Check(name=name, statement=f"{said}; still")], log=log, missed=0.0)
    checks = []
    if _swing(_since_start(parts.missed * jumps[:, None])) > tolerance * size:
        first = log.time[int(np.flatnonzero(jumps)[0])]
        words = f"jumps in {jumps.sum()} periods beyond its rate, first after {first:g} s"
        checks.append(_fault(name, "jumps", words))
    left = _estimate(missed, [], lag).left
    share = left / size
    fine = Check(
        name=name, statement=f"{said}; agrees within {100.0 * share:.2g} %", verdict="measured",
        value=1.0,
    )  # fmt: skip
    if share <= tolerance:
        return _Followed(checks=[fine, *checks], log=log, missed=share)
    doubt, why = _doubt(log, motion, ~jumps)
    allowed = max(tolerance * size, doubt)
    tried = [
        dataclasses.replace(each, columns=[path(column) for column in each.columns])
        for each in mistakes(log, parts)
    ]
    if found := _named(missed, lag, tried, doubt):
        mistake, estimate = found
        fault = _fault(name, mistake.cause, mistake.words(estimate.sizes, estimate.errors))
        value = 1.0 + float(estimate.sizes[0]) if mistake.cause == "rate_scale" else None
        checks = [dataclasses.replace(fault, value=value), *checks]
        mended = log if mistake.mend is None else mistake.mend(estimate.sizes)
        return _Followed(checks=checks, log=mended, missed=estimate.left / size)
    if left > allowed:
        words = f"is not the rate of the position: {100.0 * share:.2g} % are missed"
        fault = _fault(name, "rates", f"{said}, {words}")
        return _Followed(checks=[fault, *checks], log=log, missed=share, is_named=False)
    if left <= 0.1 * tolerance * _reach(log):
        return _Followed(checks=[fine, *checks], log=log, missed=share)
    words = f"{said}; {100.0 * share:.2g} % are missed, but {_DOUBTS[why]}"
    return _Followed(checks=[_open(name, why, words), *checks], log=log, missed=share)


def _reach(log: ForeignLog) -> float:
    """The largest motion of the base's attitude and the joints, rad or m: less hardly matters."""
    turn = _swing(_since_start(_turned(log)))
    return max([turn, *np.ptp(log.angles, axis=0)])


def _straight(
    path: Callable[[ForeignLog], np.ndarray], rate: Callable[[ForeignLog], np.ndarray]
) -> Callable[[ForeignLog], _Motion]:
    """The motion along a path (n, k) with a rate (n, k); angles may begin anew after a turn."""

    def motion(log: ForeignLog) -> _Motion:
        moved, rates = np.diff(path(log), axis=0), rate(log)
        expected = _areas(log.time, rates)
        missed = moved - expected
        turns = 2.0 * np.pi * np.round(missed / (2.0 * np.pi))
        return _Motion(
            moved=moved - turns,
            expected=expected,
            missed=missed - turns,
            slope=_slopes(log.time, rates),
            lag=np.diff(log.time)[:, None] * np.diff(rates, axis=0),
        )

    return motion


def _turning(log: ForeignLog) -> _Motion:
    """The motion of the attitude with angular velocities in world axes, to the fourth order."""
    period, w = np.diff(log.time)[:, None], log.angular
    expected = _areas(log.time, w) + period**2 / 12.0 * np.cross(w[1:], w[:-1])
    attitude = Rotation.from_quat(log.quaternion, scalar_first=True)
    beyond = attitude[1:] * (Rotation.from_rotvec(expected) * attitude[:-1]).inv()
    missed = beyond.as_rotvec()
    lag = period * np.diff(w, axis=0)
    slope = _slopes(log.time, w)
    return _Motion(moved=_turned(log), expected=expected, missed=missed, slope=slope, lag=lag)


def _about(values: np.ndarray, errors: np.ndarray, unit: str) -> str:
    """Estimated vectors, with the largest standard error."""
    return f"[{', '.join(f'{x:.4g}' for x in values)}] ± {errors.max():.1g} {unit}"


def _scale_and_shift(log: ForeignLog, parts: _Motion, rate: str) -> tuple[_Mistake, _Mistake]:
    """The mistakes that every rate may have."""

    def scaled(sizes: np.ndarray, errors: np.ndarray) -> str:
        factor = f"{1.0 + sizes[0]:.4g} ± {errors[0]:.1g}"
        return f"the position changes by {factor} times what the rate says"

    def late(sizes: np.ndarray, errors: np.ndarray) -> str:
        word = "early" if sizes[0] < 0.0 else "late"
        return f"the rates are {abs(sizes[0]):.3g} ± {errors[0]:.1g} periods {word}"

    def shifted(sizes: np.ndarray) -> ForeignLog:
        values = getattr(log, rate)
        times = log.time + sizes[0] * np.median(np.diff(log.time))
        columns = [np.interp(times, log.time, column) for column in values.T]
        return log.replace(**{rate: np.stack(columns, axis=1)})

    return (
        _Mistake(
            cause="rate_scale", columns=[parts.expected], words=scaled,
            mend=lambda sizes: log.replace(**{rate: getattr(log, rate) * (1.0 + sizes[0])}),
        ),
        _Mistake(
            cause="time_shift", columns=[parts.lag], words=late, mend=shifted,
            usable=lambda sizes: abs(sizes[0]) > 0.5,
        ),
    )  # fmt: skip


def _of_angular(log: ForeignLog, parts: _Motion) -> list[_Mistake]:
    """Mistakes of a gyro: scale, offset, a turning frame, axes turned or scaled, delay."""
    turn, period = turns_of(log), np.diff(log.time)[:, None]
    axes = [_areas(log.time, turn[:, :, i]) for i in range(3)]
    local = in_body_axes(log.quaternion, log.angular)
    along = [_areas(log.time, turn[:, :, i] * local[:, i : i + 1]) for i in range(3)]
    across = [_areas(log.time, np.cross(log.angular, turn[:, :, i])) for i in range(3)]

    def offset(sizes: np.ndarray, errors: np.ndarray) -> str:
        degrees = _about(-sizes / _DEGREE, errors / _DEGREE, "deg/s")
        return (
            f"a constant rate offset of {_about(-sizes, errors, 'rad/s')} in base axes ({degrees})"
        )

    real = in_body_axes(log.quaternion[:-1], parts.moved)
    turned, _ = Rotation.align_vectors(real, in_body_axes(log.quaternion[:-1], parts.expected))
    other = in_world_axes(log.quaternion, turned.apply(local))
    far = _about(turned.as_rotvec() / _DEGREE, np.zeros(1), "deg").replace(" ± 0", "")
    scale, shift = _scale_and_shift(log, parts, "angular")
    return [
        scale,
        shift,
        _Mistake(
            cause="rate_offset", columns=axes, words=offset,
            mend=lambda sizes: log.replace(angular=log.angular + turn @ sizes),
        ),
        _Mistake(
            cause="frame_rate", columns=[period * axis for axis in np.eye(3)],
            words=lambda sizes, errors: "relative to a frame that turns at a constant rate of "
            f"{_about(sizes, errors, 'rad/s')} (world axes)",
            mend=lambda sizes: log.replace(angular=log.angular + sizes),
        ),
        _Mistake(
            cause="axes", columns=[_areas(log.time, other - log.angular)], more=2,
            words=lambda sizes, errors: f"its axes are those of the base turned by {far} (rotation "
            "vector)",
            mend=lambda sizes: log.replace(angular=other),
            usable=lambda sizes: abs(sizes[0] - 1.0) < 0.02,
        ),
        _Mistake(
            cause="axes", columns=across,
            words=lambda sizes, errors: "its axes are turned from the attitude's by "
            f"{_about(-sizes / _DEGREE, errors / _DEGREE, 'deg')} (rotation vector, base axes)",
            mend=lambda sizes: log.replace(
                angular=log.angular + np.cross(log.angular, turn @ sizes)
            ),
        ),
        _Mistake(
            cause="rate_scale", columns=along,
            words=lambda sizes, errors: "the attitude changes by "
            f"{_about(1.0 + sizes, errors, '')}times what the rate about each axis says",
            mend=lambda sizes: log.replace(
                angular=in_world_axes(log.quaternion, local * (1.0 + sizes))
            ),
        ),
    ]  # fmt: skip


def _of_linear(log: ForeignLog, parts: _Motion) -> list[_Mistake]:
    """Mistakes of a velocity: scale, delay, offset, a turning frame, axes turned."""
    turn, period = turns_of(log), np.diff(log.time)[:, None]
    axes = [_areas(log.time, turn[:, :, i]) for i in range(3)]
    around = [_areas(log.time, np.cross(axis, log.position)) for axis in np.eye(3)]
    across = [_areas(log.time, np.cross(axis, log.linear)) for axis in np.eye(3)]
    scale, shift = _scale_and_shift(log, parts, "linear")
    return [
        scale,
        shift,
        _Mistake(
            cause="rate_offset", columns=[period * axis for axis in np.eye(3)],
            words=lambda sizes, errors: "a constant offset of "
            f"{_about(-sizes, errors, 'm/s')} in world axes: another frame's motion",
            mend=lambda sizes: log.replace(linear=log.linear + sizes),
        ),
        _Mistake(
            cause="rate_offset", columns=axes,
            words=lambda sizes, errors: f"a constant offset of {_about(-sizes, errors, 'm/s')} in "
            "base axes",
            mend=lambda sizes: log.replace(linear=log.linear + turn @ sizes),
        ),
        _Mistake(
            cause="frame_rate", columns=around,
            words=lambda sizes, errors: "relative to a frame that turns at a constant rate of "
            f"{_about(sizes, errors, 'rad/s')} (world axes)",
            mend=lambda sizes: log.replace(linear=log.linear + np.cross(sizes, log.position)),
        ),
        _Mistake(
            cause="axes", columns=across,
            words=lambda sizes, errors: "its axes are turned from the position's by "
            f"{_about(sizes / _DEGREE, errors / _DEGREE, 'deg')} (rotation vector)",
            mend=lambda sizes: log.replace(linear=log.linear + np.cross(sizes, log.linear)),
        ),
    ]  # fmt: skip


def _integral(time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Integral (n, k) of a rate (n, k) since the start, by trapezoids."""
    return _since_start(_means(rate) * np.diff(time)[:, None])


def _attitude(log: ForeignLog, dynamics: Dynamics, tolerance: float) -> _Checked:
    """Which way the quaternion turns, the axes of the angular velocity, and its mistakes."""
    if "angular" in log.missing:
        return [], log
    name, tried = "angular velocity", {}
    for causes, change in _ATTITUDES.items():
        other = log.replace(quaternion=change(log.quaternion))
        for axes, omega in {
            "world": other.angular,
            "body": in_world_axes(other.quaternion, other.angular),
        }.items():
            fit = _fit(other, _turned(other), omega)
            tried[causes, axes] = fit, other.replace(angular=omega)
    right = {key: each for key, each in tried.items() if each[0].factor > 0.0 or each[0].still}
    usual = [key for key in right if not key[0] and right[key][0].missed < _FITS]
    allowed = {key: right[key] for key in usual} or right or tried
    (causes, axes), (fit, whole) = min(allowed.items(), key=lambda item: item[1][0].missed)
    if fit.still:
        return [Check(name="attitude", statement="the base does not turn")], log

    def followed(axes: str, whole: ForeignLog) -> _Followed:
        return _follow(name, whole, _turning, _of_angular, tolerance, f"in {axes}")

    if (causes and fit.missed > 1e-2) or fit.missed > _FITS:  # neither way round: other mistakes
        for said, omega in _other_axes(log):
            once = _fit(log, _turned(log), omega)
            if once.missed < min(_FITS, 0.2 * fit.missed) and abs(once.factor - 1.0) < _FITS:
                return [_fault(name, "axes", said)], log.replace(angular=omega)
        both = [followed(f"{axes} axes", tried["", axes][1]) for axes in ("world", "body")]
        if any(each.is_named for each in both):
            best = min((each for each in both if each.is_named), key=lambda each: each.missed)
            return best.checks, best.log
    if fit.missed > _FITS:
        said = "the angular velocity is not the quaternion's rate"
        check = _in_no_axes("attitude", "angular_velocity", said, fit)
        return [check], log.replace(angular=_rate(log, _since_start(_turned(log))))
    checks = [_fault("attitude", each, _SAID[each]) for each in causes.split(", ") if each]
    same = len(usual) == 2 and max(right[key][0].missed for key in usual) < 3.0 * fit.missed
    if not same and axes not in (stated := log.stated.get("angular", axes)):
        said = f"in {axes} axes, while the log says {stated}"
        checks.append(_fault(name, "axes", said))
    factor, unit = _unit(name, fit)
    if unit:
        return [*checks, unit], whole.replace(angular=whole.angular * factor)
    found = followed(f"{axes} axes", whole)
    if len(usual) == 2 and found.missed > tolerance:
        others = [followed(f"{key[1]} axes", right[key][1]) for key in usual]
        found = min(others, key=lambda each: (not each.is_named, each.missed))
    elif same:
        found = followed("world or body axes, which it does not tell apart", whole)
    return [*checks, *found.checks], found.log


def _other_axes(log: ForeignLog) -> Iterator[tuple[str, np.ndarray]]:
    """Angular velocities in world axes, if a needless change of axes is undone, or a rotation of
    the gyro's axes.
    """
    said = "{} axes were taken for {} axes and turned to {} axes once more"
    twice = in_world_axes(log.quaternion, in_world_axes(log.quaternion, log.angular))
    yield said.format("body", "world", "body"), twice
    yield said.format("world", "body", "world"), in_body_axes(log.quaternion, log.angular)
    moved, expected = _turned(log), _means(log.angular) * np.diff(log.time)[:, None]
    for frame, real in {
        "base": in_body_axes(log.quaternion[:-1], moved), "world": moved,
    }.items():  # fmt: skip
        turn, _ = Rotation.align_vectors(real, expected)
        vector = _about(turn.as_rotvec() / _DEGREE, np.zeros(1), "deg").replace(" ± 0", "")
        omega = turn.apply(log.angular)
        yield (
            f"its axes are those of the {frame} turned by {vector} (rotation vector)",
            in_world_axes(log.quaternion, omega) if frame == "base" else omega,
        )


def _in_no_axes(name: str, cause: str, said: str, fit: _Fit) -> Check:
    """The check of rates that agree with a motion in no axes."""
    missed = f"{100.0 * fit.missed:.0f} %"
    return _fault(name, cause, f"{said}, in world or in body axes; the nearest misses {missed}")


def _unit(name: str, fit: _Fit) -> tuple[float, Check | None]:
    """A factor that is a unit's or a sign's, and its fault."""
    for factor, cause, meaning in (
        (_DEGREE, "degrees", "the rates are in degrees per second"),
        (1.0 / _DEGREE, "degrees", "the positions are in degrees, the rates in radians per second"),
        (-1.0, "sign", "the rates have the other sign"),
    ):
        if abs(fit.factor / factor - 1.0) < _FITS:
            return factor, _fault(name, cause, meaning)
    if fit.factor == 0.0:
        said = "does not move while its rate is not zero, or the reverse"
        return 1.0, _fault(name, "constant", said)
    return 1.0, None


def _base_velocity(log: ForeignLog, dynamics: Dynamics, tolerance: float) -> _Checked:
    """Axes of the base's velocity, the point that it is of, and its mistakes."""
    if "linear" in log.missing:
        return [], log
    name, moved = "base velocity", np.diff(log.position, axis=0)
    turned = in_world_axes(log.quaternion, log.linear)
    candidates = {"in world axes": log.linear, "in body axes": turned}
    for point, (arm, swing) in dynamics.points(log).items():
        if np.abs(arm).max() > 1e-6:
            candidates |= {f"{axes}, of {point}": v - swing
                           for axes, v in list(candidates.items())[:2]}  # fmt: skip
    fits = {axes: _fit(log, moved, velocity) for axes, velocity in candidates.items()}
    axes = min(fits, key=lambda each: fits[each].missed)
    fit = fits[axes]
    if fit.still:
        return [Check(name=name, statement="the base does not move")], log
    motion = _straight(lambda log: log.position, lambda log: log.linear)

    def followed(axes: str, said: str) -> _Followed:
        changed = log.replace(linear=candidates[axes])
        return _follow(name, changed, motion, _of_linear, tolerance, said)

    if fit.missed > _FITS:
        tried = [followed(axes, axes) for axes in list(candidates)[:2]]
        if any(each.is_named for each in tried):
            best = min((each for each in tried if each.is_named), key=lambda each: each.missed)
            return best.checks, best.log
        said = "the velocity is not the position's rate"
        check = _in_no_axes(name, "base_velocity", said, fit)
        return [check], log.replace(linear=_rate(log, log.position))
    alike = [each for each in fits if fits[each].missed < max(3.0 * fit.missed, 1e-6)]
    said = " or ".join(alike) + (", which it does not tell apart" if len(alike) > 1 else "")
    factor, unit = _unit(name, fit)
    if unit:
        return [unit], log.replace(linear=candidates[axes] * factor)
    found = followed(axes, said)
    near = [each for each in list(fits)[:2] if fits[each].missed < _FITS and each != axes]
    if found.missed > tolerance and near:
        others = [followed(each, each) for each in (axes, *near)]
        found = min(others, key=lambda each: (not each.is_named, each.missed))
    if "linear" in log.stated and (stated := f"in {log.stated['linear']}") not in alike:
        said = f"{said}, while the log says {stated}, of the base's origin"
        return [_fault(name, "axes", said)], found.log
    return found.checks, found.log


def _joint_rates(log: ForeignLog, dynamics: Dynamics, tolerance: float) -> _Checked:
    """Whether each joint's rate is that of its own position."""
    if "rates" in log.missing or not dynamics.names:
        return [], log
    names = dynamics.names
    moved = np.diff(log.angles, axis=0)
    moved -= 2.0 * np.pi * np.round(moved / (2.0 * np.pi))
    checks, fine, rates, angles = [], [], log.rates.copy(), log.angles.copy()
    for i, name in enumerate(names):
        fit = _fit(log, moved[:, [i]], log.rates[:, [i]])
        factor, unit = _unit(name, fit) if fit.missed <= _FITS and not fit.still else (1.0, None)
        if unit:
            checks.append(unit)
            angles[:, i] *= 1.0 / factor if factor > 1.0 else 1.0
            rates[:, i] *= factor if factor < 1.0 else 1.0
            continue
        others = [_fit(log, moved[:, [i]], log.rates[:, [j]]) for j in range(len(names))]
        best = min(range(len(names)), key=lambda j: others[j].missed)
        if fit.missed > _FITS and others[best].missed <= min(_FITS, 0.3 * fit.missed):
            said = f"the rate called {name} is not its own: that of {names[best]} is"
            checks.append(_fault(name, "joint_order", said))
            rates[:, i] = others[best].factor * log.rates[:, best]
            continue
        one = log.replace(angles=log.angles[:, [i]], rates=log.rates[:, [i]])
        motion = _straight(lambda log: log.angles, lambda log: log.rates)
        found = _follow(name, one, motion, _of_joint, tolerance, "its rate")
        rates[:, i] = found.log.rates[:, 0]
        if found.is_named:
            faults = [check for check in found.checks if check.cause]
            checks += faults
            fine += [] if faults else found.checks
            continue
        said = f"its rate is not that of its position; misses {100 * found.missed:.2g} %"
        checks.append(_fault(name, "joint_rate", said))
        rates[:, i] = _rate(log, log.angles[:, i])
    if fine:
        word = "other rate" if checks else "rate"
        worst = max((check for check in fine), key=lambda check: check.value or 0.0)
        said = f"every {word} is that of its joint's position"
        checks.append(Check(name="joints", statement=said, value=worst.value))
    return checks, log.replace(rates=rates, angles=angles)


def _of_joint(log: ForeignLog, parts: _Motion) -> list[_Mistake]:
    """Mistakes of a joint's rate: scale, delay, offset."""
    return [
        *_scale_and_shift(log, parts, "rates"),
        _Mistake(
            cause="rate_offset", columns=[np.diff(log.time)[:, None]],
            words=lambda sizes, errors: "its rate has a constant offset of "
            f"{-sizes[0]:.4g} ± {errors[0]:.1g} rad/s or m/s",
            mend=lambda sizes: log.replace(rates=log.rates + sizes),
        ),
    ]  # fmt: skip


def _time_scale(checks: list[Check], log: ForeignLog) -> _Checked:
    """One mistake where every position changes by the same factor times what its rate says."""
    found = [check for check in checks if check.value is not None]
    factors = np.array([check.value for check in found], dtype=float)
    if len(found) < 2 or 1.0 in factors or np.ptp(factors) > 0.05 * np.abs(factors - 1.0).max():
        return checks, log
    factor = float(factors.mean())
    said = (
        f"every position changes by {factor:.4g} times what its rate says: the time is "
        f"{1.0 / factor:.4g} times the true one, or every rate is"
    )
    mended = log.replace(
        time=log.time * factor, angular=log.angular / factor, linear=log.linear / factor,
        rates=log.rates / factor,
    )  # fmt: skip
    others = [check for check in checks if check.value is None]
    return [*others, _fault("time", "time_scale", said)], mended


def _jumps(checks: list[Check], log: ForeignLog) -> list[Check]:
    """Periods in which much more or less happens than the rates say: samples lost or repeated."""
    period = np.diff(log.time)[:, None]
    angles = np.diff(log.angles, axis=0)
    angles -= 2.0 * np.pi * np.round(angles / (2.0 * np.pi))  # logs may begin anew after a turn
    moved = np.hstack([_turned(log), np.diff(log.position, axis=0), angles])
    expected = _means(np.hstack([log.angular, log.linear, log.rates])) * period
    square = (expected**2).sum(axis=1)
    moves = square > 1e-2 * square.max()
    ratio = np.divide((moved * expected).sum(axis=1), square, out=np.ones(len(square)), where=moves)
    usual = np.abs(ratio - 1.0) < 0.3
    if usual.mean() < 0.7 or usual.all() or np.quantile(np.abs(ratio[usual] - 1.0), 0.9) > 0.03:
        return checks
    beside = np.linalg.norm(moved - ratio[:, None] * expected, axis=1) < 0.3 * np.sqrt(square)
    lost, stale = np.flatnonzero((ratio > 1.3) & beside), np.flatnonzero(np.abs(ratio) < 0.3)
    if not lost.size and not stale.size:
        return checks
    checks = [check for check in checks if check.cause != "jumps"]
    if lost.size > 2 * stale.size:  # what follows a repeated sample jumps too
        missing = int(np.maximum(1, np.round(ratio[lost] - 1.0)).sum())
        said = (
            f"about {missing} samples were dropped and the time renumbered: the motion jumps in "
            f"{lost.size} periods, the first after {log.time[lost[0]]:g} s"
        )
        return [*checks, _fault("samples", "dropped_samples", said)]
    if not stale.size:
        return checks
    said = f"{stale.size} samples repeat the one before, first at {log.time[stale[0]]:g} s"
    return [*checks, _fault("samples", "repeated_samples", said)]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Balance:
    """How well momentum is conserved, at some samples."""

    log: ForeignLog  # these samples
    bodies: Bodies
    impulse: np.ndarray  # (n, 6) of the logged forces since the start, as the momenta
    of_mass: np.ndarray  # (n, bodies, 6)
    of_spin: np.ndarray
    scale: np.ndarray  # (6): what the bodies exchange, N m s and N s

    @property
    def total(self) -> np.ndarray:
        """Total momentum without the impulse of the logged forces (n, 6)."""
        found: np.ndarray = (self.of_mass + self.of_spin).sum(axis=1) - self.impulse
        return found

    def missed(self, total: np.ndarray) -> float:
        """Change of a total momentum as a share of what the bodies exchange."""
        return float((np.abs(total - total.mean(axis=0)) / self.scale).max())

    def without(self, effects: Sequence[np.ndarray]) -> tuple[float, np.ndarray]:
        """What is missed with the best multiples of some effects (n, 6) added, and these."""

        def column(change: np.ndarray) -> np.ndarray:
            flat: np.ndarray = ((change - change.mean(axis=0)) / self.scale).ravel()
            return flat

        columns = np.stack([column(effect) for effect in effects], axis=1)
        norms = np.linalg.norm(columns, axis=0)
        norms = np.where(norms > 0.0, norms, 1.0)
        times, *_ = np.linalg.lstsq(columns / norms, -column(self.total), rcond=1e-9)
        times = times / norms
        return self.missed(self.total + np.tensordot(times, np.array(effects), axes=1)), times

    def moved_as(
        self,
        turn: np.ndarray,
        position: np.ndarray,
        angular: np.ndarray,
        linear: np.ndarray,
    ) -> np.ndarray:
        """The total (n, 6) if the base moved so."""
        of_mass, of_spin = self.bodies.momenta(turn, position - position[0], angular, linear)
        found: np.ndarray = (of_mass + of_spin).sum(axis=1) - self.impulse
        return found


def _balance(some: ForeignLog, dynamics: Dynamics, impulse: np.ndarray) -> _Balance:
    bodies = dynamics.bodies_of(some)
    place = some.position - some.position[0]
    of_mass, of_spin = bodies.momenta(turns_of(some), place, some.angular, some.linear)
    momenta = of_mass + of_spin
    # what a body has beside its share of the whole's drift
    shares = dynamics.masses / dynamics.mass
    drift = momenta[..., 3:].sum(axis=1, keepdims=True) * shares[:, None]
    linear = np.abs(momenta[..., 3:] - drift).sum(axis=1).max()
    angular = np.abs(momenta[..., :3]).sum(axis=1).max()
    # one body exchanges nothing: what it has
    linear = max(linear, 1e-3 * float(np.abs(momenta[..., 3:]).sum(axis=1).max()))
    scale = np.repeat([angular, linear], 3)
    return _Balance(
        log=some, bodies=bodies, impulse=impulse, of_mass=of_mass, of_spin=of_spin,
        scale=np.where(scale > 1e-12, scale, 1.0),
    )  # fmt: skip


def _held(force: np.ndarray) -> tuple[np.ndarray, ...]:
    """Means of a force over each period (n - 1, k), as a log may mean it: that of its samples,
    held from each sample on, or held up to it.
    """
    return _means(force), force[:-1], force[1:]


def _impulses(log: ForeignLog) -> list[np.ndarray]:
    """Impulse (n, 6) of the external forces on the base since the start, as momenta: as
    ``_held``; a disturbance is smooth.
    """
    zero = np.zeros((len(log.time), 3))
    force = zero if log.force is None else log.force
    torque = zero if log.torque is None else log.torque
    arm, period = _means(log.position - log.position[0]), np.diff(log.time)[:, None]
    found = [
        _since_start(np.hstack([moment + np.cross(arm, push), push]) * period)
        for moment, push in zip(_held(torque), _held(force), strict=True)
    ]
    if log.disturbance is None:
        return found
    moment, push = log.disturbance[:, :3], log.disturbance[:, 3:6]
    moment = moment + np.cross(log.position - log.position[0], push)
    more = _since_start(_areas(log.time, np.hstack([moment, push])))
    return [each + more for each in found]


_Explanation = tuple[float, str, str]  # what is missed with it, cause, words


def _dynamics(log: ForeignLog, dynamics: Dynamics, tolerance: float) -> list[Check]:
    """Momentum, with the mistake without which it is conserved; the joints' efforts."""
    size = len(log.time)
    starts = np.unique(np.linspace(0, size - 4, min(_GROUPS, size // 4)).astype(int))
    kept = np.unique(starts[:, None] + np.arange(4))
    some, name = only(log, kept), "momentum"
    impulses = _impulses(log)
    balance = min(
        (_balance(some, dynamics, impulse[kept]) for impulse in impulses),
        key=lambda each: each.missed(each.total),
    )
    if not np.isfinite(balance.total).all():
        raise ValueError("momentum is not finite")
    missed = balance.missed(balance.total)
    said = f"changes by {missed:.2g} of what the bodies exchange"

    @functools.cache
    def drift() -> float:
        step, left = _integrator(log, balance, dynamics)
        unsure = 2.0 * doubts()[0]
        found = missed <= unsure or (step and left < max(0.2 * missed, unsure))
        return math.inf if found else 0.0

    @functools.cache
    def doubts() -> tuple[float, str]:
        return _doubt_of(balance, dynamics, log, kept, impulses)

    doubt, why, told = 0.0, "", ""
    if missed > tolerance or log.missing:
        doubt, why = doubts()
        told = f" (rates of every second sample change it by {doubt:.1g})" if log.missing else ""
    if missed <= tolerance:
        said = f"conserved within {missed:.2g} of what the bodies exchange{told}"
        return [Check(name=name, statement=said), *_energy(log, dynamics, tolerance, drift)]
    effects = _of_forces(balance, dynamics)
    explained = [*_of_masses(balance, dynamics), *effects, *_of_frames(balance)]
    for cause, words, changed in (*_of_points(some, dynamics), *_of_joints(some, dynamics.names)):
        other = _balance(changed, dynamics, balance.impulse)
        explained.append((other.missed(other.total), cause, words))
    left, cause, words = min(explained)
    share = (0.02 if missed < _FITS else 0.15) * missed
    if left < (max(2.0 * doubt, share) if missed > 2.0 * doubt else _SURE * missed):
        return [_fault(name, cause, f"{said}, by {left:.2g} if {words}")]
    if missed <= 2.0 * doubt:
        said = f"{said}, but {_UNTOLD[why]}"
        return [_open(name, why, said), *_energy(log, dynamics, tolerance, drift)]
    if drift():
        step, left = _integrator(log, balance, dynamics)
        words = (
            f"{said}, by {left:.2g} beside the drift of a first-order integrator whose steps are "
            f"{step:.2g} s: log a run with shorter ones"
        )
        return [_open(name, "integrator", words), *_energy(log, dynamics, tolerance, drift)]
    words = "no one mistake explains it: an external force that is not logged, or several at once"
    return [_fault(name, "external_force", f"{said}; {words}")]


_UNTOLD = {
    "sampling": "every second sample changes it as much: log more samples, and log the velocities",
    "digits": "the last digits of the numbers change it as much: log more digits",
    "noise": "it jumps as much from sample to sample: log true values",
}


def _doubt_of(
    balance: _Balance,
    dynamics: Dynamics,
    log: ForeignLog,
    kept: np.ndarray,
    impulses: Sequence[np.ndarray],
) -> tuple[float, str]:
    """How far a momentum can be off, as a share, and why."""
    shares, doubts = balance.total / balance.scale, {"sampling": 0.0, "digits": 0.0}
    groups = np.split(np.arange(len(kept)), np.flatnonzero(np.diff(kept) > 1) + 1)
    doubts["noise"] = max(_noise(shares[group]) for group in groups if len(group) > 3)
    if log.missing:
        rough = _balance(only(with_rates(log, every=2), kept), dynamics, balance.impulse)
        change = np.abs(rough.total - balance.total) / balance.scale
        doubts["sampling"] = max(float(change.max()), doubts.pop("noise"))
    if impulses[0].any():
        coarse = _impulses(only(log, slice(None, None, 2)))[0]
        change = np.abs(coarse - impulses[0][::2]).max(axis=0) / balance.scale
        doubts["sampling"] = max(doubts["sampling"], float(change.max()) / 3.0)
    if any(log.digits.values()):
        other = _balance(_shaken(balance.log), dynamics, balance.impulse)
        change = np.abs(other.total - balance.total) / balance.scale
        doubts["digits"] = 1.5 * float(change.max())
    why = max(doubts, key=lambda each: doubts[each])
    return doubts[why], why


def _integrator(log: ForeignLog, balance: _Balance, dynamics: Dynamics) -> tuple[float, float]:
    """The step of a first-order integrator whose drift explains a momentum best, s, and what is
    then missed: a step h changes momentum by h^2 times what a trial step does.
    """
    some, best, period = balance.log, (0.0, math.inf), np.diff(log.time)[:, None]
    near = every(log, most=1000)
    near = near[near < len(period)]
    middle = only(log, near)
    turn = Rotation.from_quat(middle.quaternion, scalar_first=True)
    turn = Rotation.from_rotvec(0.5 * _turned(log)[near]) * turn
    spins = {"base": in_body_axes(log.quaternion, log.angular), "world": log.angular}
    rates = {**spins, "linear": log.linear, "rates": log.rates}
    paths = {**rates, "position": log.position - some.position[0], "angles": log.angles}
    means = {name: _means(path)[near] for name, path in paths.items()}
    slope = {name: (np.diff(path, axis=0) / period)[near] for name, path in rates.items()}
    trial = 0.01 / max(float(np.abs(np.hstack([some.angular, some.rates])).max()), 1e-9)

    def total(axes: str, semi: float, step: float) -> np.ndarray:
        def after(name: str, share: float = 1.0) -> np.ndarray:
            found: np.ndarray = means[name] + share * step * slope[name]
            return found

        more = Rotation.from_rotvec(step * after(axes, semi))
        now = turn * more if axes == "base" else more * turn
        omega = after(axes)
        moved = middle.replace(
            quaternion=now.as_quat(scalar_first=True),
            position=means["position"] + step * after("linear", semi),
            angles=means["angles"] + step * after("rates", semi),
            angular=now.apply(omega) if axes == "base" else omega,
            linear=after("linear"),
            rates=after("rates"),
        )
        parts = dynamics.bodies_of(moved).momenta(
            now.as_matrix(), moved.position, moved.angular, moved.linear
        )
        found: np.ndarray = (parts[0] + parts[1]).sum(axis=1)
        return found

    times = _means(log.time)[near]
    for axes, semi in itertools.product(spins, (1.0, 0.0)):
        sides = total(axes, semi, trial) + total(axes, semi, -trial) - 2.0 * total(axes, semi, 0.0)
        path = _integral(times, sides / (2.0 * trial**2))
        drift = np.stack([np.interp(some.time, times, column) for column in path.T], axis=1)
        left, sizes = balance.without([drift])
        if 0.0 < -sizes[0] < 1.1 * period.max():
            best = min(best, (-float(sizes[0]), left), key=lambda each: each[1])
    return best


def _of_masses(balance: _Balance, dynamics: Dynamics) -> Iterator[_Explanation]:
    """One body with another mass and inertia: momentum is linear in both."""
    if len(dynamics.bodies) < 2:
        return
    for i, body in enumerate(dynamics.bodies):
        left, more = balance.without([balance.of_mass[:, i], balance.of_spin[:, i]])
        if more[0] > -1.0:
            words = f"{body.name()} has {1.0 + more[0]:.3g} times the mass of the URDF"
            if balance.of_spin[:, i].any():
                words += f" and {1.0 + more[1]:.3g} times the inertia"
            yield left, "mass", words


def _of_forces(balance: _Balance, dynamics: Dynamics) -> Iterator[_Explanation]:
    """Gravity; a constant force; drag of the base; momentum that decays."""
    some = balance.log
    at = some.position - some.position[0]
    turn = turns_of(some)
    shares = dynamics.masses / dynamics.mass
    center = at + np.einsum("nij,b,nbj->ni", turn, shares, balance.bodies.center)

    def impulse(force: np.ndarray, at: np.ndarray, torque: float | np.ndarray = 0.0) -> np.ndarray:
        rate = np.hstack([np.cross(at, force) + torque, force])
        return _since_start(_means(rate) * np.diff(some.time)[:, None])

    axes = [np.tile(axis, (len(some.time), 1)) for axis in np.eye(3)]
    left, pull = balance.without([impulse(axis, center) for axis in axes])
    pull = -pull / dynamics.mass
    words = f"gravity of {np.linalg.norm(pull):.3g} m/s^2 acts along {_direction(pull)}"
    yield left, "gravity", words
    still = np.zeros_like(some.linear)
    for frame, each in {"world": axes, "base": [turn[:, :, i] for i in range(3)]}.items():
        pushes = [impulse(axis, at) for axis in each] + [impulse(still, at, axis) for axis in each]
        left, sizes = balance.without(pushes)
        force = ", ".join(f"{-x:.3g}" for x in sizes[:3])
        torque = ", ".join(f"{-x:.3g}" for x in sizes[3:])
        words = f"the base is pushed by [{force}] N and [{torque}] N m in {frame} axes"
        yield 1.5 * left, "external_force", words  # of more sizes than others
    drag = [impulse(some.linear, at), impulse(still, at, some.angular)]
    left, sizes = balance.without(drag)
    if sizes.min() > -1e-9 * abs(sizes).max():
        words = f"the base is damped by {sizes[0]:.3g} N s/m and {sizes[1]:.3g} N m s"
        yield left, "damping", words
    decay = _since_start(_means(balance.total) * np.diff(some.time)[:, None])
    left, sizes = balance.without([decay * (np.arange(6) < 3), decay * (np.arange(6) >= 3)])
    if sizes.min() > -1e-9 * abs(sizes).max():
        words = f"it decays by {sizes[1]:.3g} per s, the angular part by {sizes[0]:.3g} per s"
        yield left, "damping", f"{words}: a simulator's damping"


def _direction(vector: np.ndarray) -> str:
    return (
        "[" + ", ".join(f"{round(x, 2) + 0.0:.2f}" for x in vector / np.linalg.norm(vector)) + "]"
    )


def _of_frames(balance: _Balance) -> Iterator[_Explanation]:
    """Constant rotations of the base's axes, or of the world in which its attitude is; a log in a
    frame that turns.
    """
    some = balance.log
    turn, since = turns_of(some), some.time - some.time[0]
    cube = Rotation.create_group("O").as_rotvec()

    def base(vector: np.ndarray) -> np.ndarray:
        rotation = Rotation.from_rotvec(vector).as_matrix()
        return balance.moved_as(turn @ rotation.T, some.position, some.angular, some.linear)

    def world(vector: np.ndarray) -> np.ndarray:
        back = Rotation.from_rotvec(vector).as_matrix().T
        return balance.moved_as(back @ turn, some.position, some.angular @ back.T, some.linear)

    def turning(rate: np.ndarray) -> np.ndarray:
        frame = Rotation.from_rotvec(since[:, None] * rate)
        speed = frame.apply(some.linear + np.cross(rate, some.position))
        return balance.moved_as(
            frame.as_matrix() @ turn, frame.apply(some.position),
            frame.apply(some.angular + rate), speed,
        )  # fmt: skip

    def shares(total: np.ndarray) -> np.ndarray:
        flat: np.ndarray = ((total - total.mean(axis=0)) / balance.scale).ravel()
        return flat

    def of_sizes(moved: Callable[[np.ndarray], np.ndarray], sizes: np.ndarray) -> np.ndarray:
        return shares(moved(sizes))

    for cause, moved, starts, words in (
        ("frame", base, cube, "the base's axes are turned from the URDF's by {} deg (rotation "
         "vector): another body frame, or a star tracker's"),
        ("frame", world, cube, "the attitude is in a world whose axes are turned from those of the "
         "positions by {} deg (rotation vector)"),
        ("frame_rate", turning, np.zeros((1, 3)), "the log is in a frame that turns at a constant "
         "rate of {} rad/s (its own axes)"),
    ):  # fmt: skip
        near = sorted(starts, key=lambda start: balance.missed(moved(start)))[:3]
        fits = [
            least_squares(
                functools.partial(of_sizes, moved), np.asarray(start), x_scale="jac", max_nfev=40
            )
            for start in near
        ]
        best = min(fits, key=lambda fit: fit.cost)
        value = best.x if cause == "frame_rate" else best.x / _DEGREE
        yield (
            balance.missed(moved(best.x)), cause,
            words.format(f"[{', '.join(f'{x:.4g}' for x in value)}]"),
        )  # fmt: skip


def _of_points(log: ForeignLog, dynamics: Dynamics) -> Iterator[tuple[str, str, ForeignLog]]:
    """Another point of the base logged: cause, words, the log without it."""
    for point, (arm, swing) in dynamics.points(log).items():
        words = f"the position and velocity are those of {point}, not of the base's origin"
        yield "point", words, log.replace(position=log.position - arm, linear=log.linear - swing)


def _of_joints(log: ForeignLog, names: Sequence[str]) -> Iterator[tuple[str, str, ForeignLog]]:
    """Joints exchanged, turned the other way, or in degrees: cause, words, the log without it."""
    count = len(names)
    orders = {pair: [*range(count)] for pair in itertools.combinations(range(count), 2)}
    for (i, j), order in orders.items():
        order[i], order[j] = j, i
        words = f"{names[i]} and {names[j]} are exchanged"
        yield "joint_order", words, _joints_as(log, order=order)
    if count > 2:
        words = "the joints stand in the reverse order"
        yield "joint_order", words, _joints_as(log, order=[*range(count)][::-1])
    each = {name: np.arange(count) == i for i, name in enumerate(names)}
    for name, mask in each.items():
        words = f"{name} turns the other way"
        yield "joint_sign", words, _joints_as(log, factor=np.where(mask, -1.0, 1.0))
    for name, mask in {"every joint": np.full(count, True), **each}.items():
        words = f"{name} is in degrees"
        yield "degrees", words, _joints_as(log, factor=np.where(mask, _DEGREE, 1.0))


def _joints_as(
    log: ForeignLog, *, order: Sequence[int] | None = None, factor: float | np.ndarray = 1.0
) -> ForeignLog:
    """The log with its joints in another order, or multiplied."""
    order = range(log.angles.shape[1]) if order is None else order
    return log.replace(angles=log.angles[:, order] * factor, rates=log.rates[:, order] * factor)


def _energy(
    log: ForeignLog, dynamics: Dynamics, tolerance: float, drift: Callable[[], float]
) -> list[Check]:
    """Each joint's momentum (M v)_i against its effort: what is missed since the start.

    Args:
      drift: the share that an integrator's drift may change.
    """
    name, names = "energy", dynamics.names
    if not names:
        return [Check(name=name, statement="no joint moves", verdict="measured")]
    if len(log.time) > MOST:  # at their own steps, in parts: rates of more would take long
        length, added = MOST // _PARTS, f" ({_PARTS} stretches of {MOST // _PARTS} samples)"
        starts = np.linspace(0, len(log.time) - length, _PARTS).astype(int)
        parts = [
            _energy(only(log, slice(start, start + length)), dynamics, tolerance, drift)
            for start in starts
        ]
        told = min(parts, key=lambda checks: min(_WORST.index(each.verdict) for each in checks))
        return [dataclasses.replace(each, statement=each.statement + added) for each in told]
    rows = every(log)
    some = only(log, rows)
    efforts = np.zeros_like(log.rates) if log.efforts is None else log.efforts
    work = _work(log, dynamics, rows, efforts)
    size = np.array([_swing(path) for path in (*work.momentum.T[:, :, None],)])
    size += [_swing(path) for path in (*work.exchanged.T[:, :, None],)]
    size += [_swing(path) for path in (*work.efforts[0].T[:, :, None],)]
    size = np.maximum(size, 1e-2 * size.max())
    if not size.max() > 0.0:
        return [Check(name=name, statement="nothing moves", verdict="measured")]
    fits = [
        [_estimate(work.missed(i)[:, [j]], [], work.lag[:, [j]]).left / size[j] for j in
         range(len(names))]
        for i in range(2)
    ]  # fmt: skip
    kind = int(np.argmin([max(each) for each in fits]))
    shares, worst = np.array(fits[kind]), max(fits[kind])
    plain, given = work.missed(kind), work.efforts[kind]
    if log.efforts is None:
        if worst <= tolerance:
            said = f"conserved within {worst:.2g}: nothing drives the joints"
            return [Check(name=name, statement=said)]
        said = "efforts drive the joints; log them (joint_1_effort, ...) to have it checked"
        return [Check(name=name, statement=said, verdict="not tested")]
    scales = [
        _estimate(plain[:, [j]], [given[:, [j]]], work.lag[:, [j]]) for j in range(len(names))
    ]
    odd = [  # a factor that differs from 1, of efforts that are small beside what moves the joint
        abs(fit.sizes[0]) > max(tolerance, 3.0 * fit.errors[0]) and fit.left < _NAMED * share * each
        for fit, share, each in zip(scales, shares, size, strict=True)
    ]
    if worst <= tolerance and not any(odd):
        said = f"follows the work of the efforts within {worst:.2g} of it"
        return [Check(name=name, statement=said)]
    doubts = {"integrator": np.full(len(names), drift())}
    paths = [plain]
    for step in (2, 4):
        coarse = only(log, slice(None, None, step))
        terms = work.momentum[::step], work.rate[::step]
        paths.append(
            _work(coarse, dynamics, rows[::step] // step, efforts[::step], terms).missed(kind)
        )
    doubts["sampling"] = np.array(
        [_open_by_steps([path[:, [j]] for path in paths]) / size[j] for j in range(len(names))]
    )
    doubts["noise"] = np.array([_noise(plain[:, [j]]) for j in range(len(names))]) / size
    if any(log.digits.values()):
        shaken = _work(_shaken(log), dynamics, rows, efforts).missed(kind) - plain
        doubts["digits"] = 2.0 * np.array([_swing(x) for x in shaken.T[:, :, None]]) / size
    doubt = np.max(list(doubts.values()), axis=0)
    wrong = np.flatnonzero((shares > tolerance) | odd)
    found = [
        _of_effort(
            some, work, kind, int(j), max(tolerance, doubt[j]) * size[j], doubt[j] * size[j], names
        )
        for j in wrong
    ]
    named = [each for each in found if each]
    if not named:
        j = int(np.argmax(shares))
        why = max(set(doubts) - {"integrator"}, key=lambda each: doubts[each][j])
        why = why if doubts[why][j] >= shares[j] else "integrator"
        said = f"{names[j]} misses its effort by {shares[j]:.2g}, but {_UNSURE[why]}"
        return [_open(name, why, said)]
    if len(names) > 1 and any(cause == "effort_scale" for cause, _ in named):
        moving = np.flatnonzero(size > 1.01e-2 * size.max())
        scaled = [scales[j] for j in moving]
        each, errors = (
            np.array([getattr(fit, k)[0] for fit in scaled]) for k in ("sizes", "errors")
        )
        factor = 1.0 + float(np.median(each))
        if (np.abs(each - factor + 1.0) <= 0.1 * abs(factor - 1.0) + 3.0 * errors).all():
            said = (
                f"is {factor:.4g} times the work of the efforts: all masses of the log are "
                f"{1.0 / factor:.4g} times those of the URDF, or the efforts have another unit"
            )
            return [_fault(name, "mass_or_effort_scale", said)]
    causes: dict[str, list[str]] = {}
    for cause, words in named:
        causes.setdefault(cause, []).append(words)
    return [_fault(name, cause, "; ".join(words)) for cause, words in causes.items()]


_WORST = ("does not hold", "cannot tell", "not tested", "holds", "measured")
_UNSURE = {
    "sampling": "efforts of every second sample tell as little: log more samples",
    "digits": "the last digits of the numbers change it as much: log more digits",
    "noise": "it jumps as much from sample to sample: log true values",
    "integrator": "an integrator's drift, or what momentum leaves open, explains as much",
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Work:
    """What changes the joints' momenta (n, joints) since the start, at some samples."""

    momentum: np.ndarray
    rate: np.ndarray  # dT/dq
    exchanged: np.ndarray  # its integral, with that of the disturbance
    efforts: tuple[np.ndarray, np.ndarray]  # integral: of the fourth order; by trapezoids
    lag: np.ndarray

    def missed(self, kind: int) -> np.ndarray:
        """Change of momentum beyond what the efforts give."""
        found: np.ndarray = self.momentum - self.momentum[0] - self.exchanged - self.efforts[kind]
        return found


def _work(
    log: ForeignLog,
    dynamics: Dynamics,
    rows: np.ndarray,
    efforts: np.ndarray,
    at: tuple[np.ndarray, np.ndarray] | None = None,
) -> _Work:
    period = np.diff(log.time)[:, None]
    momentum, rate = at or dynamics.joint_terms(only(log, rows))
    exchanged = _since_start(_areas(log.time[rows], rate))
    if log.disturbance is not None:
        exchanged = exchanged + _since_start(_areas(log.time, log.disturbance[:, 6:]))[rows]
    return _Work(
        momentum=momentum, rate=rate, exchanged=exchanged,
        efforts=(
            _since_start(_areas(log.time, efforts))[rows],
            _since_start(_means(efforts) * period)[rows],
        ),
        lag=_since_start(period * np.diff(efforts, axis=0))[rows],
    )  # fmt: skip


def _of_effort(
    log: ForeignLog,
    work: _Work,
    kind: int,
    joint: int,
    allowed: float,
    doubt: float,
    names: Sequence[str],
) -> tuple[str, str] | None:
    """The mistake of one joint's effort: cause and words; None: it cannot be told."""
    missed, lag = work.missed(kind)[:, [joint]], work.lag[:, [joint]]
    name, time = names[joint], (log.time - log.time[0])[:, None]
    moved, rate = log.angles[:, [joint]], log.rates[:, [joint]]
    against = -_since_start(_means(np.sign(rate)) * np.diff(log.time)[:, None])
    mistakes = [
        _Mistake(
            cause="effort_scale", columns=[work.efforts[kind][:, [joint]]],
            words=lambda sizes, errors: f"{name}'s momentum is {1.0 + sizes[0]:.4g} ± "
            f"{errors[0]:.1g} times that of its effort, which is {1.0 / (1.0 + sizes[0]):.4g} "
            "times the true one",
        ),
        _Mistake(
            cause="effort_shift", columns=[lag],
            words=lambda sizes, errors: f"{name}'s effort is {sizes[0]:.3g} ± {errors[0]:.1g} "
            "periods late",
            usable=lambda sizes: abs(sizes[0]) > 0.55,
        ),
        _Mistake(
            cause="effort_offset", columns=[time],
            words=lambda sizes, errors: f"{name}'s effort has a constant offset of "
            f"{-sizes[0]:.4g} ± {errors[0]:.1g} N m or N",
        ),
        _Mistake(
            cause="rotor_inertia", columns=[-(rate - rate[0])],
            words=lambda sizes, errors: f"a rotor inertia of {sizes[0]:.4g} ± {errors[0]:.1g} "
            f"kg m^2 (or kg) at {name} is not in the URDF",
        ),
        _Mistake(
            cause="friction", columns=[moved[0] - moved],
            words=lambda sizes, errors: f"{name} is damped by {sizes[0]:.4g} ± {errors[0]:.1g} "
            "N m s (or N s/m)",
            usable=lambda sizes: sizes[0] > 0.0,
        ),
        _Mistake(
            cause="friction", columns=[against],
            words=lambda sizes, errors: f"{name} has dry friction of {sizes[0]:.4g} ± "
            f"{errors[0]:.1g} N m (or N)",
            usable=lambda sizes: sizes[0] > 0.0,
        ),
        *(
            _Mistake(
                cause="joint_order",
                columns=[work.efforts[kind][:, [i]] - work.efforts[kind][:, [joint]]],
                words=functools.partial(_other_effort, name, other),
                usable=lambda sizes: abs(sizes[0] - 1.0) < 0.05,
            )
            for i, other in enumerate(names) if i != joint
        ),
        _Mistake(
            cause="friction", columns=[moved[0] - moved, against],
            words=lambda sizes, errors: f"{name} is damped by {sizes[0]:.4g} N m s and has dry "
            f"friction of {sizes[1]:.4g} N m",
            usable=lambda sizes: bool((sizes > 0.0).all()),
        ),
        _Mistake(
            cause="spring",
            columns=[-_since_start(_means(moved) * np.diff(log.time)[:, None]), time],
            words=lambda sizes, errors: f"{name} has a spring of {sizes[0]:.4g} ± {errors[0]:.1g} "
            "N m/rad (or N/m)",
            usable=lambda sizes: sizes[0] > 0.0,
        ),
    ]  # fmt: skip
    if found := _named(missed, lag, mistakes, doubt):
        mistake, estimate = found
        if mistake.cause == "effort_scale" and abs(estimate.sizes[0] + 2.0) < _FITS:
            return "effort_sign", f"{name}'s effort has the other sign"
        return mistake.cause, mistake.words(estimate.sizes, estimate.errors)
    left = _estimate(missed, [], lag).left
    if left <= allowed:
        return None
    said = (
        f"{name} misses its effort by {left:.2g} N m s: friction, contact, or efforts not applied"
    )
    return "effort", said
