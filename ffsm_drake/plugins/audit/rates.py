"""Checks of the logged rates against the attitude, the position and the joints.

They find the axes, unit, reference point and mistakes of the rates.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from ffsm_drake.common.numbers import counted
from ffsm_drake.plugins.audit.checks import Check, fault
from ffsm_drake.plugins.audit.dynamics import Dynamics
from ffsm_drake.plugins.audit.log import Array, Log
from ffsm_drake.plugins.audit.misfit import (
    STILL,
    Followed,
    common_factor,
    means,
    since_start,
    swing,
)
from ffsm_drake.plugins.audit.motions import (
    ANGULAR,
    LINEAR,
    Kind,
    mended,
    of_joint,
    turned,
)

_FITS = 0.1  # share of a motion within which axes and units of its rates are recognised
_DEGREES = 180.0 / math.pi
_INVERSE = np.array([1.0, -1.0, -1.0, -1.0])  # inverts a quaternion
_FACTORS = (
    (1.0 / _DEGREES, "degrees", "the rates are in degrees per second"),
    (_DEGREES, "degrees", "the positions are in degrees, the rates in radians per second"),
    (-1.0, "sign", "the rates have the other sign"),
)
_ATTITUDES: dict[tuple[str, ...], Callable[[Array], Array]] = {
    ("quaternion_order",): lambda q: q[:, [3, 0, 1, 2]],
    ("quaternion_inverse",): lambda q: q * _INVERSE,
    ("quaternion_order", "quaternion_inverse"): lambda q: q[:, [3, 0, 1, 2]] * _INVERSE,
}
_SAID = {
    "quaternion_order": "the scalar of the quaternion is last (x, y, z, w)",
    "quaternion_inverse": (
        "the attitude turns from world to base axes (R_BW, not R_WB; MRPs sigma_NB, not sigma_BN)"
    ),
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Reading:
    """A log with one interpretation of its rates, and the faults that it implies."""

    kind: Kind
    said: str
    log: Log
    faults: Sequence[Check] = ()

    def followed(self) -> Followed:
        """The motion. It is not cached, because a long log needs much memory."""
        return Followed(log=self.log, motion=self.kind.motion)

    @functools.cached_property
    def fit(self) -> tuple[float, float]:
        """Ratio of the path's changes to the integrated rates, and the unexplained share of the
        path with this ratio.
        """
        found = self.followed()
        if found.scale < STILL:
            return 1.0, 0.0
        factor, size = found.factor(), swing(found.path(found.parts.moved))
        return 1.0 + float(factor.sizes[0]), factor.left / size if size else math.inf

    @property
    def factor(self) -> float:
        return self.fit[0]

    @property
    def missed(self) -> float:
        return self.fit[1]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Outcome:
    """Result for one motion."""

    checks: Sequence[Check]
    log: Log  # mended
    missed: float = 0.0  # residual as a share of the motion, with the mistake mended
    is_explained: bool = True
    factor: float | None = None  # ratio of motion to integrated rate; None: unknown
    jumps: Array | None = None  # periods (n - 1)


def _read(usual: Sequence[_Reading], others: Sequence[_Reading], tolerance: float) -> _Outcome:
    """Find the reading of the rates that agrees with the motion, and the remaining mistake.

    Args:
      usual: correct readings; the first two are in world and in body axes.
      others: mistaken readings, the likelier ones first.
    """
    kind, read = usual[0].kind, sorted(usual, key=lambda each: each.missed)
    best, forward = read[0], min((x.missed for x in read if x.factor > 0.0), default=math.inf)
    odd = [x for x in others if abs(x.factor - 1.0) < _FITS] if forward > _FITS else []
    least = max(3.0 * min((x.missed for x in odd), default=0.0), 1e-6)
    for each in odd:
        if each.missed < min(_FITS, 0.2 * forward, 3.0 * best.missed, least):
            outcome = _followed(each, tolerance)
            if outcome.is_explained and not _faults(outcome.checks):
                return dataclasses.replace(outcome, checks=each.faults)
    for factor, cause, meaning in _FACTORS if best.missed < _FITS else ():
        if abs(best.factor / factor - 1.0) < _FITS:
            what = kind.path if factor > 1.0 else kind.rate
            values = getattr(best.log, what) * min(factor, 1.0 / factor, key=abs)
            log = best.log.replace(**{what: values})
            return _Outcome(checks=[fault(kind.name, cause, meaning)], log=log)
    least = min(max(3.0 * best.missed, 1e-6), _FITS)
    alike = [each.said for each in read if each.missed < least] or [best.said]
    untold = ", which it cannot distinguish" if len(alike) > 1 else ""
    tried = [dataclasses.replace(best, said=" or ".join(alike) + untold)]
    tried += [x for x in read[1:] if x in usual[:2] and (best.missed > _FITS or x.missed < _FITS)]
    outcomes: list[_Outcome] = []
    for each in tried:
        if not outcomes or _faults(outcomes[-1].checks):
            outcomes.append(_followed(each, tolerance))
    outcome = min(outcomes, key=lambda each: (not each.is_explained, each.missed))
    stated = best.log.stated.get(kind.rate)
    if stated and f"in {stated}" not in alike:
        wrong = fault(kind.name, "axes", f"{best.said}, but the log states {stated}")
        return dataclasses.replace(outcome, checks=[wrong, *_faults(outcome.checks)])
    return outcome


def _faults(checks: Iterable[Check]) -> list[Check]:
    return [check for check in checks if check.cause]


def _followed(reading: _Reading, tolerance: float) -> _Outcome:
    """Compare a motion since the start with its rates, without jumps."""
    log, found, kind = reading.log, reading.followed(), reading.kind
    if found.scale < STILL:
        check = Check(name=kind.name, statement=f"{reading.said}; still")
        return _Outcome(checks=[check], log=log)
    said = f"{reading.said}; agrees within {100.0 * found.share:.2g} %"
    fine = _Outcome(
        checks=[Check(name=kind.name, statement=said, verdict="measured")], log=log,
        missed=found.share, factor=1.0,
        jumps=found.jumps if found.jumped > tolerance * found.scale else None,
    )  # fmt: skip
    if found.share <= tolerance:
        return fine
    check, named = found.judged(kind.name, f"{reading.said};", kind.mistakes(log), tolerance)
    if named:
        return dataclasses.replace(
            fine, checks=[check], log=mended(log, kind.rate, named),
            factor=1.0 + float(named.sizes[0]) if check.cause == "rate_scale" else None,
            missed=named.left / found.scale,
        )  # fmt: skip
    if check.verdict == "cannot tell":
        turn = swing(since_start(turned(log)))
        matters = 0.1 * tolerance * max([turn, *np.ptp(log.angles, axis=0)])
        return fine if found.left <= matters else dataclasses.replace(fine, checks=[check])
    rate = np.gradient(since_start(found.parts.moved), log.time, axis=0, edge_order=2)
    return dataclasses.replace(
        fine, checks=[check], log=log.replace(**{kind.rate: rate}), factor=None, is_explained=False
    )


def _attitude(log: Log, tolerance: float) -> _Outcome:
    """Direction of the quaternion, axes of the angular velocity, and its mistakes."""

    def both(log: Log, faults: Sequence[Check] = ()) -> list[_Reading]:
        body = log.replace(angular=log.attitude.apply(log.angular))
        return [
            _Reading(kind=ANGULAR, said=f"in {axes} axes", log=each, faults=faults)
            for axes, each in {"world": log, "body": body}.items()
        ]

    usual = both(log)
    others = [
        reading
        for causes, change in _ATTITUDES.items()
        for reading in both(
            log.replace(quaternion=change(log.quaternion)),
            [fault("attitude", cause, _SAID[cause]) for cause in causes],
        )
    ]
    said = "{0} axes were taken for {1} axes and turned to {0} axes once more"
    twice = log.attitude.apply(usual[1].log.angular)
    wrong = {said.format("body", "world"): twice,
             said.format("world", "body"): log.attitude.inv().apply(log.angular)}  # fmt: skip
    others += [
        _Reading(kind=ANGULAR, said="", log=log.replace(angular=omega),
                 faults=[fault(ANGULAR.name, "axes", words)])
        for words, omega in wrong.items()
    ]  # fmt: skip
    return _read(usual, others, tolerance)


def _base_velocity(log: Log, dynamics: Dynamics, tolerance: float) -> _Outcome:
    """Axes and reference point of the base's velocity, and its mistakes."""
    axes = {
        "in world axes": log.linear,
        "in body axes": log.attitude.apply(log.linear),
    }
    named = dict(axes)
    for point, (arm, swung) in dynamics.points(log).items():
        if np.abs(arm).max() > 1e-6:
            named |= {f"{each}, of {point}": speed - swung for each, speed in axes.items()}
    usual = [
        _Reading(kind=LINEAR, said=said, log=log.replace(linear=v)) for said, v in named.items()
    ]
    return _read(usual, [], tolerance)


def _joint_rates(log: Log, names: Sequence[str], tolerance: float) -> tuple[list[_Outcome], Log]:
    """Check each joint's rate against its position; return the outcomes and the mended log."""
    outcomes = []
    for i, name in enumerate(names):
        kind = of_joint(name)
        columns = {what: getattr(log, what)[:, [i]] for what in ("angles", "rates")}
        unsure = {what: change[:, [i]] for what, change in log.unsure.items() if what in columns}
        one = log.replace(**columns, unsure=unsure)
        others = [
            _Reading(kind=kind, said="", log=one.replace(rates=log.rates[:, [j]]), faults=[fault(
                name, "joint_order",
                f"the rate called {name} belongs to another joint; the rate of {other} fits",
            )])
            for j, other in enumerate(names) if j != i
        ]  # fmt: skip
        expected = means(one.rates) * np.diff(log.time)[:, None]
        turns = np.round((expected - np.diff(one.angles, axis=0)) / (2.0 * np.pi))
        spun = one.replace(angles=one.angles + 2.0 * np.pi * since_start(turns))
        own, whole = (_Reading(kind=kind, said="its rate", log=each) for each in (one, spun))
        if not turns.any() or (own.missed < _FITS and not 0.5 < own.factor < 2.0):
            whole = own  # the rates are in another unit
        outcomes.append(_read([whole], others, tolerance))
    mended = {
        what: np.hstack([getattr(each.log, what) for each in outcomes])
        for what in ("angles", "rates")
    }
    return outcomes, log.replace(**mended)


def check_rates(log: Log, dynamics: Dynamics, tolerance: float) -> tuple[list[Check], Log]:
    """Checks of all logged rates, and the log with mended rates in world axes."""
    outcomes = []
    if "angular" not in log.missing:
        outcomes.append(_attitude(log, tolerance))
        log = outcomes[-1].log
    if "linear" not in log.missing:
        outcomes.append(_base_velocity(log, dynamics, tolerance))
        log = outcomes[-1].log
    checks = [check for outcome in outcomes for check in outcome.checks]
    if "rates" not in log.missing and dynamics.names:
        joints, log = _joint_rates(log, dynamics.names, tolerance)
        outcomes += joints
        wrong = [check for outcome in joints for check in _faults(outcome.checks)]
        said = f"every {'other ' if wrong else ''}rate is the derivative of its joint's position"
        if not all(_faults(outcome.checks) for outcome in joints):
            wrong.append(Check(name="joints", statement=said))
        checks += wrong
    jumps = [outcome.jumps for outcome in outcomes if outcome.jumps is not None]
    checks, log = _time_scale(checks, log, outcomes)
    return [*checks, _jumps(log, np.any(jumps, axis=0))] if jumps else checks, log


def _time_scale(
    checks: list[Check], log: Log, outcomes: Sequence[_Outcome]
) -> tuple[list[Check], Log]:
    """Replace equal rate factors of all positions with one mistake, the scale of time."""
    found = [outcome for outcome in outcomes if outcome.factor is not None]
    factor = common_factor([outcome.factor or 1.0 for outcome in found], 0.0)
    if not factor:
        return checks, log
    said = (
        f"every position changes by {factor:.4g} times its rate; the time, or every rate, "
        f"is {1.0 / factor:.4g} times the true one"
    )
    mended = {what: getattr(log, what) / factor for what in ("angular", "linear", "rates")}
    same = [check for outcome in found for check in outcome.checks]
    others = [check for check in checks if check not in same and check.name != "joints"]
    mended |= {"time": log.time * factor}
    return [*others, fault("time", "time_scale", said)], log.replace(**mended)


def _jumps(log: Log, jumps: Array) -> Check:
    """Check of jumps, which are dropped samples, repeated samples or jumps of the motion itself."""
    paths = np.diff(np.hstack([log.position, log.angles]), axis=0)
    moved = np.hstack([turned(log), paths])
    expected = means(np.hstack([log.angular, log.linear, log.rates])) * np.diff(log.time)[:, None]
    moved, expected, when = moved[jumps], expected[jumps], log.time[:-1][jumps]
    ratio = (moved * expected).sum(axis=1) / np.maximum((expected**2).sum(axis=1), STILL**2)
    beside = np.linalg.norm(moved - ratio[:, None] * expected, axis=1)
    lost = (ratio > 1.3) & (beside < 0.3 * np.linalg.norm(expected, axis=1))
    stale = np.abs(ratio) < 0.3
    if lost.sum() > 2 * stale.sum():  # the period after a repeated sample jumps too
        missing = int(np.maximum(1, np.round(ratio[lost] - 1.0)).sum())
        said = (
            f"about {counted(missing, 'sample')} dropped and the time renumbered: the motion "
            f"jumps in {counted(int(lost.sum()), 'period')}, the first after {when[lost][0]:g} s"
        )
        return fault("samples", "dropped_samples", said)
    if stale.any():
        repeated = counted(int(stale.sum()), "sample")
        said = f"repeated values in {repeated}, first at {when[stale][0]:g} s"
        return fault("samples", "repeated_samples", said)
    periods = counted(len(when), "period")
    said = f"the motion jumps in {periods} beyond its rates, first after {when[0]:g} s"
    return fault("samples", "jumps", said)
