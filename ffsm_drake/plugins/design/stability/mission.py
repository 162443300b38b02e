"""The linear part of the verdict on a mission: the wired loop along every leg of the plan, without
limits and noise.

The approach of a capture has only the servicer, and the stop has the target in the gripper. A
spectral radius above 1 at a posture during the motion is no alarm if errors grow little. At rest it
is an alarm. If adaptation can raise K_s, the loop is evaluated with the initial K_s and with K_s at
its bounds. If it is unstable at the bounds, it is evaluated with the largest expected K_s.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

from ffsm_drake.common.steps import step
from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.plugins.design.stability.adaptation import adapts, reached_gains
from ffsm_drake.plugins.design.stability.linear_loop import (
    WARM_UP,
    LinearLoop,
    NotLinear,
    radius_digits,
)
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.moving import (
    GROWN,
    LARGE_GROWTH,
    MotionStability,
    motion_stability,
)
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.contacts import closing_contacts, closing_times
from ffsm_drake.systems.closed_chains import CLOSED_CHAINS
from ffsm_drake.systems.controllers.checked import has_user_code, reaching_gain_of

Leg = Literal["approach", "stop", "motion"]
Status = Literal["stable", "errors grow", "cannot say", "unstable"]
_STATUSES: tuple[Status, ...] = ("stable", "errors grow", "cannot say", "unstable")  # worst last


def _scope(linearizer: Linearizer, leg: Leg) -> str:
    """The scope of a leg's linear loop, and its omissions."""
    scenario, left = linearizer.given, ["limits", "noise", *_held_changes(linearizer.law)]
    if scenario.supervisor is not None:
        left.append("the supervisor")
    if scenario.faults is not None:
        left.append("the faults")
    if leg == "approach" and scenario.closing is not None:
        left.append("the gripper's closing")
        if scenario.measured is not None:
            left.append("the target's estimate")
    alone = ", the servicer alone" if leg == "approach" else ""
    return f"moving as planned, without {', '.join(left[:-1])} and {left[-1]}{alone}"


def _held_changes(law: Any) -> Iterator[str]:
    """The states that a user-supplied law changes, and that are held at their start."""
    held: Mapping[str, float | None] = {}
    if has_user_code(law):
        held = getattr(law, "held", dict)()
    for name, value in held.items():
        is_analysed = name == "reaching_gain" and reaching_gain_of(law) is not None
        if value is None and not is_analysed:
            yield f"changes of {name}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class LegVerdict:
    """The linear loop along one leg of a mission; NaN if it cannot be linearised."""

    leg: Leg  # "motion" without a capture
    radius: float  # largest spectral radius
    time: float  # time of the run, s
    growth: float  # growth of small errors along the worst stretch of the leg
    instants: int  # at which the loop was linearised
    rests_stable: bool  # radius below 1 where the leg begins or ends at rest
    status: Status
    sentence: str  # one line, with its scope


@dataclasses.dataclass(frozen=True, kw_only=True)
class LinearVerdict:
    """The linear loop along every leg of a mission."""

    legs: tuple[LegVerdict, ...]

    @property
    def status(self) -> Status:
        """The worst of the legs'."""
        return max((leg.status for leg in self.legs), key=_STATUSES.index)

    @property
    def sentence(self) -> str:
        """The legs' lines as one."""
        return "; ".join(leg.sentence for leg in self.legs)

    @property
    def is_alarm(self) -> bool:
        """Whether the mission is unstable."""
        return self.status == "unstable"


@step("checking the linear loop")
def linear_verdict(
    scenario: Scenario | Mission, linearizer: Linearizer | None = None
) -> LinearVerdict:
    """The linear verdict on all legs of a mission; a fraction of a second to a second.

    Args: the scenario, or its mission; the linearizer from the grasp on, default: a new one.

    Raises:
      ModelError, ScenarioError: the scenario's model or a value in it cannot be used.
      BlockError: a user-supplied block cannot be loaded, built or wired.
    """
    mission = make_mission(scenario)
    given = mission.scenario
    leg: Leg = "stop" if given.grasps else "motion"
    approach = (_leg(mission, "approach", None),) if given.grasp_time > 0.0 else ()
    open_ = []
    for time, end in itertools.pairwise(closing_times(given)):
        found = _leg(mission, leg, None, closed=time)
        told = f"{found.sentence}, up to the closing at {end:g} s"
        open_.append(dataclasses.replace(found, sentence=told))
    return LinearVerdict(legs=(*approach, *open_, _leg(mission, leg, linearizer)))


def _leg(
    mission: Mission, leg: Leg, linearizer: Linearizer | None, closed: float | None = None
) -> LegVerdict:
    start = mission.scenario.grasp_time if leg == "stop" else 0.0
    try:
        if linearizer is not None:
            return _verdict(linearizer, leg, start)
        with Linearizer(mission, approach=leg == "approach", closed=closed) as own:
            return _verdict(own, leg, start)
    except NotLinear as error:
        return LegVerdict(
            leg=leg,
            radius=math.nan,
            time=math.nan,
            growth=math.nan,
            instants=0,
            rests_stable=False,
            status="cannot say",
            sentence=f"{leg}: cannot say; {error}",
        )


def _verdict(linearizer: Linearizer, leg: Leg, start: float) -> LegVerdict:
    found, gains = motion_stability(linearizer), ""
    if _status(found, leg) != "unstable":
        found, gains = _at_larger_gains(linearizer, leg, found)
    worst, status = found.worst, _status(found, leg)
    for loop in _resting(found, leg):
        linearizer.refuse_marginal(loop)
    growing = chain_growth(linearizer)
    if growing:
        status = "unstable"
    return LegVerdict(
        leg=leg,
        radius=worst.spectral_radius,
        time=start + worst.time,
        growth=found.growth,
        instants=len(found.loops),
        rests_stable=_resting_radius(found, leg) < 1.0,
        status=status,
        sentence=f"{leg}: {growing or _told(found, leg, status, start)}{gains} "
        f"({len(found.loops)} instants, {_scope(linearizer, leg)})",
    )


def chain_growth(linearizer: Linearizer) -> str:
    """How the internal force of a closed chain grows at the end of the motion; "" if it does not,
    or there is no chain.
    """
    grip, loop = linearizer.grip, linearizer.at(linearizer.end)
    is_chain = closing_contacts(linearizer.given, grip)
    if not is_chain or linearizer.law is None or not loop.unit_poles:
        return ""
    end = linearizer.motion.evaluate(linearizer.end)[0]
    return CLOSED_CHAINS.only("contacts").growth(
        linearizer.mission, linearizer.law, end, grip, loop.unit_poles
    )


def _at_larger_gains(
    linearizer: Linearizer, leg: Leg, starting: MotionStability
) -> tuple[MotionStability, str]:
    """The worse of the loop with K_s as it starts and as adaptation may raise it, and in words
    which.

    At the bounds of K_s; where it is unstable there, at the largest K_s expected, if there is a
    forecast. Raises NotLinear without bounds and forecast.
    """
    found, gains = None, ""
    for held, told in reached_gains(linearizer, starting.loops[0]):
        found, gains = motion_stability(linearizer, held=held), told
        if _status(found, leg) != "unstable":
            break
    if found is None:
        if adapts(linearizer):
            problem = "the adaptation of K_s has no bound and no forecast; set k_s_max"
            raise NotLinear(linearizer.own_adaptation.uncovered or problem)
        return starting, ""
    if _status(found, leg) == _status(starting, leg) and (
        found.worst.spectral_radius <= starting.worst.spectral_radius
    ):
        return starting, ""
    return found, gains


def _resting(found: MotionStability, leg: Leg) -> Sequence[LinearLoop]:
    """The loops where a leg begins or ends at rest."""
    ends = {"approach": found.loops[:1], "stop": found.loops[-1:]}
    return ends.get(leg, (found.loops[0], found.loops[-1]))


def _resting_radius(found: MotionStability, leg: Leg) -> float:
    """The largest spectral radius where a leg begins or ends at rest."""
    return max(loop.spectral_radius for loop in _resting(found, leg))


def _status(found: MotionStability, leg: Leg) -> Status:
    if found.growth > LARGE_GROWTH or _resting_radius(found, leg) >= 1.0:
        return "unstable"
    return "errors grow" if found.growth > GROWN else "stable"


def _told(found: MotionStability, leg: Leg, status: Status, start: float) -> str:
    worst = found.worst
    modes = worst.modes(1)
    where = f", mostly {next(iter(modes[0].coordinates))}" if modes else ""
    at, rest = f"t = {start + worst.time:.2f} s", _resting_radius(found, leg) >= 1.0
    if not math.isfinite(worst.spectral_radius):
        at_rest = " at rest" if rest else ""
        return (
            f"unstable{at_rest}: at {at} the loop diverges from the plan within {WARM_UP} samples"
        )
    radius = f"spectral radius {radius_digits(worst.spectral_radius)} at {at}"
    if status == "stable":
        return f"stable for small errors, {radius}"
    if rest:
        return f"unstable at rest, {radius}{where}"
    if not math.isfinite(found.growth):
        return f"unstable, {radius}"
    grow = f"small errors {found.growing}, {radius}{where}"
    return f"unstable, {grow}" if status == "unstable" else grow
