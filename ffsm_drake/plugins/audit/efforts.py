"""Check that each joint's momentum follows the logged effort; name the mistake otherwise."""

import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence

import numpy as np

from ffsm_drake.plugins.audit.checks import AMBIGUOUS, UNEXPLAINED, Check, fault
from ffsm_drake.plugins.audit.dynamics import MOST, Dynamics
from ffsm_drake.plugins.audit.log import Array, Log, only, thinned
from ffsm_drake.plugins.audit.misfit import (
    NAMED,
    SURE,
    Estimate,
    Followed,
    Mistake,
    Motion,
    areas,
    common_factor,
    means,
    since_start,
    swing,
)  # fmt: skip
from ffsm_drake.plugins.audit.momentum import Momentum

_PARTS = 4  # number of stretches checked in a long log
_LEAST = 1e-2  # lower bound of a joint's momentum, as a share of the largest joint's
_ONE_WAY = 0.95  # least mean sign of the rate of a joint that moves in one direction
_WORST = ("does not hold", "cannot tell", "not tested", "holds", "measured")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Work:
    """Contributions to the momentum of one joint (n, 1)."""

    time: np.ndarray
    momentum: np.ndarray
    rate: np.ndarray  # dT/dq and the disturbance
    effort: np.ndarray

    def motion(self, step: int) -> Motion:
        """Change of momentum minus the contribution of the other bodies, and the effort, at every
        ``step``-th sample.
        """
        some = thinned(self, step)
        moved = np.diff(some.momentum, axis=0) - areas(some.time, some.rate)
        return Motion(time=some.time, rate=some.effort, moved=moved)

    @property
    def size(self) -> float:
        given = [since_start(areas(self.time, each)) for each in (self.rate, self.effort)]
        return sum(map(swing, (self.momentum, *given)))


def _works(log: Log, dynamics: Dynamics) -> list[_Work]:
    """The work at each joint."""
    momentum, rate = dynamics.joint_terms(log)
    rate = rate + log.disturbance[:, 6:]
    return [
        _Work(time=log.time, momentum=momentum[:, [j]], rate=rate[:, [j]],
              effort=log.efforts[:, [j]])
        for j in range(len(dynamics.names))
    ]  # fmt: skip


def check_efforts(log: Log, found: Momentum, tolerance: float) -> list[Check]:
    """Check the joints' efforts. A long log is checked in stretches with all of their samples.

    The loops of a closed chain are springs or rigid; the result that fits better counts.
    """
    if log.chain.any():
        rigid = log.driven().replace(chain=0.0 * log.chain)
        tried = [check_efforts(each, found, tolerance)
                 for each in (rigid, log.replace(chain=rigid.chain))]  # fmt: skip
        return max(tried, key=lambda checks: min(_WORST.index(each.verdict) for each in checks))
    count = 1 if len(log.time) <= MOST else _PARTS
    length = len(log.time) if count == 1 else MOST // _PARTS
    starts = np.linspace(0, len(log.time) - length, count).astype(int)
    parts = [_check(only(log, slice(i, i + length)), found, tolerance) for i in starts]
    told = min(parts, key=lambda checks: min(_WORST.index(each.verdict) for each in checks))
    added = f" ({count} stretches of {length} samples)" if count > 1 else ""
    return [dataclasses.replace(each, statement=each.statement + added) for each in told]


def _check(log: Log, found: Momentum, tolerance: float) -> list[Check]:
    """Check a stretch of a log."""
    name, dynamics, names = "energy", found.dynamics, found.dynamics.names
    works = functools.cache(lambda log: _works(log, dynamics))
    sizes = [work.size for work in works(log)]
    if not any(sizes):
        return [Check(name=name, statement="no joint moves", verdict="measured")]
    least = _LEAST * max(sizes)
    joints = [
        Followed(
            log=log, motion=lambda log, step, j=j: works(log)[j].motion(step),  # type: ignore[misc]
            size=max(size, least), drifts=lambda: found.excuses_efforts,
            sure=0.0 if "efforts" in log.unsure else SURE,
        )
        for j, size in enumerate(sizes)
    ]  # fmt: skip
    worst = max(joint.share for joint in joints)
    if "efforts" in log.missing:
        if worst <= tolerance:
            said = f"conserved within {worst:.2g}: nothing drives the joints"
            return [Check(name=name, statement=said)]
        said = "efforts drive the joints; log them (joint_1_effort, ...) to have it checked"
        return [Check(name=name, statement=said, verdict="not tested")]
    factors = [joint.factor() for joint in joints]
    wrong = [
        j for j, (joint, factor) in enumerate(zip(joints, factors, strict=True))
        if joint.share > tolerance or _is_odd(joint, factor, tolerance)
    ]  # fmt: skip
    if not wrong:
        said = f"follows the work of the efforts within {worst:.2g} of it"
        return [Check(name=name, statement=said)]
    checks = [
        joints[j].judged(name, names[j], _mistakes(log, joints, j, names), tolerance) for j in wrong
    ]
    faults = [check for check, _ in checks if check.verdict == "does not hold"]
    if not faults:
        return [max(zip(wrong, checks, strict=True), key=lambda each: joints[each[0]].share)[1][0]]
    causes = {each.cause for each in faults}
    if causes & {UNEXPLAINED, AMBIGUOUS} and not (log.chain.any() or found.excuses_efforts):
        explained = found.mistake  # of a change of momentum within the tolerance
        if explained and explained.left < SURE * swing(found.missed):
            said = (
                f"misses {100.0 * worst:.2g} %, and momentum changes by {found.share:.2g} of what "
                f"the bodies exchange, by {explained.left:.2g} if {explained}"
            )
            return [fault(name, explained.cause, said)]
    moving = [each for each, size in zip(factors, sizes, strict=True) if size > least]
    scale = _common_scale(moving, tolerance) if "effort_scale" in causes else None
    return faults if scale is None else [scale]


def _common_scale(factors: Sequence[Estimate], tolerance: float) -> Check | None:
    """The fault that all efforts have one factor; None: they have none."""
    sizes, errors = ([float(getattr(x, k)[0]) for x in factors] for k in ("sizes", "errors"))
    factor = common_factor([1.0 + size for size in sizes], errors)
    if not factor or abs(factor - 1.0) <= tolerance:
        return None
    said = (
        f"is {factor:.4g} times the work of the efforts: all masses of the log are "
        f"{1.0 / factor:.4g} times the URDF's, or the efforts have another unit"
    )
    return fault("energy", "mass_or_effort_scale", said)


def _is_odd(joint: Followed, factor: Estimate, tolerance: float) -> bool:
    """Whether an effort that is small beside other loads on the joint has another scale."""
    off = abs(factor.sizes[0]) > max(tolerance, 3.0 * factor.errors[0])
    return bool(off and factor.left < NAMED * joint.left)


def _mistakes(log: Log, joints: list[Followed], j: int, names: Sequence[str]) -> Iterator[Mistake]:
    """Mistakes of one joint's effort. The columns are changes of momentum in each period."""
    expected, period = joints[j].expected, np.diff(log.time)[:, None]
    moved, rate = np.diff(log.angles[:, [j]], axis=0), log.rates[:, [j]]
    from_start = log.angles[:, [j]] - log.angles[0, j]
    against = -means(np.sign(rate)) * period

    yield Mistake(
        cause="effort_scale", text="changes momentum by {0} the impulse of its effort",
        unit="times", offset=1.0, columns=[expected], floors=-1.0,
    )  # fmt: skip
    yield Mistake(
        cause="effort_shift", text="has an effort that is {0} late", columns=[joints[j].parts.lag],
        unit="periods", least=0.55,
    )  # fmt: skip
    yield Mistake(
        cause="effort_sign", text="has an effort of the other sign", columns=[expected],
        least=-2.1, most=-1.9,
    )  # fmt: skip
    yield from _offsets(float(np.sign(rate).mean()), period)
    for cause, text, columns, unit, floors in (
        ("rotor_inertia", "has a rotor inertia of {0} that is not in the URDF",
         [-np.diff(rate, axis=0)], "kg m^2 (or kg)", 0.0),
        ("friction", "is damped by {0}", [-moved], "N m s (or N s/m)", 0.0),
        ("friction", "has dry friction of {0}", [against], "N m (or N)", 0.0),
        ("friction", "is damped by {1:.4g} N m s and has dry friction of {2:.4g} N m",
         [-moved, against], "", 0.0),
        ("spring", "has a spring of {1:.4g} N m/rad (or N/m)",
         [-means(from_start) * period, period], "", [0.0, -math.inf]),
    ):  # fmt: skip
        yield Mistake(cause=cause, text=text, columns=columns, unit=unit, floors=floors)
    for i, other in enumerate(names):
        if i != j:
            yield Mistake(
                cause="joint_order", text=f"has the effort called {other}",
                columns=[joints[i].expected - expected], least=0.95, most=1.05,
            )  # fmt: skip


def _offsets(way: float, period: Array) -> Iterator[Mistake]:
    """A constant offset of an effort. Dry friction is one if the joint moves in one direction.

    Args: mean sign of its rate; lengths of the periods (n - 1, 1), s.
    """
    moves_one_way = abs(way) > _ONE_WAY
    for cause, more, against_it in (
        ("effort_offset", "", False),
        (
            "effort_offset or friction",
            ", or dry friction as large, because it moves in one direction",
            True,
        ),
    )[: 1 + moves_one_way]:
        is_positive = against_it != (way > 0.0)
        yield Mistake(
            cause=cause, text=f"has an effort with a constant offset of {{0}}{more}", factor=-1.0,
            columns=[period], unit="N m or N",
            least=0.0 if moves_one_way and is_positive else -math.inf,
            most=0.0 if moves_one_way and not is_positive else math.inf,
        )  # fmt: skip
