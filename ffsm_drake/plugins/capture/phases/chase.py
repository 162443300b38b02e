"""What passes from phase to phase of a capture, and what its phases have in common."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ffsm_drake.loop.blocks import GRIPPER
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture.free_body import Target
from ffsm_drake.plugins.capture.grasping import Aim, Meeting, target_at
from ffsm_drake.plugins.capture.modes import Mode
from ffsm_drake.plugins.capture.supervisor import SupervisorPart
from ffsm_drake.plugins.capture.target_filter import Path
from ffsm_drake.plugins.capture.tracked_target import Approached, TrackedTarget
from ffsm_drake.runs.ending import MISSED, Outcome
from ffsm_drake.runs.phases import Phase, Situation
from ffsm_drake.scenario import EMPTY, Capture, Grip, Posture, Scenario
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.planned_motion import InTurn, PlannedMotion
from ffsm_drake.systems.polynomial_motion import PolynomialMotion
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.registry import Factory


@dataclasses.dataclass(frozen=True, kw_only=True)
class Move:
    """A motion from one posture to rest in another, that begins at a time of the run."""

    begin: float  # s
    duration: float  # s
    start: Posture
    goal: Posture
    velocity: np.ndarray | None = None  # (nv) at the start

    def motion(self, mission: Mission) -> PolynomialMotion:
        """As a function of the time since its begin."""
        return PolynomialMotion(
            coordinates=mission.craft.coordinates,
            start=self.start,
            target=self.goal,
            blend=Blend(mission.scenario.reference, self.duration),
            base_rotation="eigenaxis",
            sample_time=mission.scenario.sample_time,
            velocity=self.velocity,
        )


def along(
    moves: Sequence[Move],
    mission: Mission,
    grip: Grip,
    *,
    again: float | None,
) -> PlannedMotion:
    """Along moves, and from the time ``again`` (s) on, if it is given, along a mission's plan."""
    motions: list[tuple[float, PlannedMotion]] = [
        (move.begin, move.motion(mission)) for move in moves
    ]
    begin = end = moves[-1].begin + moves[-1].duration
    if again is not None:
        own = make_motion(mission, grip)
        motions.append((again, own))
        begin, end = again + own.begin, again + own.end
    return InTurn(motions, begin=begin, end=end, sample_time=mission.scenario.sample_time)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Chase:
    """What passes from phase to phase of a capture."""

    mission: Mission
    aim: Aim  # of the last try
    path: np.ndarray  # (n, 13) motion of the target at the samples, as far as is known
    known: Path | None = None  # as the servicer knows it
    expected: Target | None = None  # a measured target at the start
    tries: int = 1
    moves: tuple[Move, ...] = ()  # of the last retreat
    again: float | None = None  # s; begin of the approach after it
    why: Outcome | None = None  # of it
    reach: float = 0.0  # m; from the base to the centre of mass of the target at the grasp

    @property
    def scenario(self) -> Scenario:
        """The scenario of the mission."""
        return self.mission.scenario

    @property
    def capture(self) -> Capture:
        """The settings of the capture."""
        assert self.scenario.capture is not None
        return self.scenario.capture

    @property
    def closing(self) -> int:
        """How many samples the closing lasts."""
        closing = self.scenario.closing
        return 0 if closing is None else round(closing.duration / self.scenario.sample_time)

    @property
    def approach(self) -> int:
        """How many samples an approach lasts."""
        assert self.scenario.approach is not None
        return round(self.scenario.approach.duration / self.scenario.sample_time)

    @property
    def arm(self) -> np.ndarray:
        """p_PC (3) of the true target, in P's axes."""
        return np.array(self.scenario.payload.truth.center_of_mass)

    def capture_of(self, w: np.ndarray, v_P: np.ndarray, arm: np.ndarray, **more: Any) -> Capture:
        """The capture of a target in a motion [w_WP; v_P] with its centre of mass at p_PC, world
        axes, with further changes.
        """
        rate, velocity = w.tolist(), (v_P + np.cross(w, arm)).tolist()
        return dataclasses.replace(self.capture, axes="world", rate=rate, velocity=velocity, **more)

    def numbered(self, name: str) -> str:
        """The name of a phase of the last try."""
        return name if self.tries == 1 else f"{name}_{self.tries}"

    def supervised(self, **how: Any) -> dict[str, Factory]:
        """The block of the supervisor, made by ``SupervisorPart``; None: there is none."""
        return {} if self.scenario.supervisor is None else {"supervisor": SupervisorPart(**how)}

    def followed(
        self, motion: PlannedMotion | None, *, follows: bool = True, sees: bool = True
    ) -> dict[str, Factory]:
        """The reference that follows the estimate of a measured target from a motion, or only
        estimates it; ``sees``: whether there are images. Empty: the target is not measured.
        """
        measured, meets = self.scenario.measured, self.aim.sample
        if measured is None or self.expected is None:
            return {}
        period = self.scenario.sample_time
        approached = Approached(
            begin=(meets - self.approach) * period,
            contact=(meets - self.closing) * period,
            meets=meets * period,
            motion=self.aim.expected,
        )
        part = TrackedTarget(
            scenario=self.scenario,
            grasp=self.capture,
            measured=measured,
            path=self.path,
            expected=self.expected,
            motion=motion,
            approached=approached if follows else None,
            sees=sees,
        )
        return {"reference": part}


def replaced(now: Situation, **changes: Any) -> Situation:
    """The situation with another ``Chase``."""
    return dataclasses.replace(now, own=dataclasses.replace(now.own, **changes))


def phase_of(
    now: Situation,
    *names: tuple[str, int | None],
    follows: bool = True,
    sees: bool = True,
    grip: Grip = EMPTY,
    afresh: tuple[str, ...] = (),
    blocks: dict[str, Factory] | None = None,
    **how: Any,
) -> Phase:
    """A phase on the plan of the last try, after the moves of a retreat. Args: see
    ``Chase.followed``; fields.
    """
    chase: Chase = now.own
    plan, motion = chase.aim.mission, None
    own: dict[str, Factory] = {}
    if chase.moves:
        motion = along(chase.moves, plan, grip, again=chase.again)
        own = chase.supervised(begin=chase.moves[0].begin if chase.again is None else chase.again)
    own |= blocks or {}
    if chase.expected is not None:
        own |= chase.followed(motion, follows=follows, sees=sees)
        motion = None
    elif not grip.holds:
        afresh = (*afresh, "reference")
    return Phase(names=names, plan=plan, motion=motion, blocks=own, grip=grip, afresh=afresh, **how)


def given_up(now: Situation) -> str:
    """Return how the supervisor abandoned an approach; empty: it did not."""
    approach = now.logs[-1]
    modes = approach.series.get("mode", np.zeros(1)).ravel()
    if modes[-1] == Mode.APPROACH:
        return ""
    since = float(approach.time[np.flatnonzero(modes != Mode.APPROACH)[0]])
    return f"the supervisor abandoned the approach at t = {since:g} s"


def met(now: Situation) -> tuple[str, Situation]:
    """The outcome of an approach to the contact with a gripper that closes in time."""
    chase: Chase = now.own
    if since := given_up(now):
        return failed(now, MISSED, f"is not met: {since}")
    motion, stage, envelope = chase.path[now.sample], now.stage, chase.capture.envelope
    if beyond := Meeting.of(chase.scenario, target_at(motion), stage).beyond(envelope):
        return failed(now, MISSED, f"is missed: {beyond}")
    block = stage.block(GRIPPER)
    payload = chase.scenario.payload.truth
    memory = block.begun(time=0.0, payload=payload, state=stage.state, target=motion)
    for name, each in block.met(memory, 0.0, stage.state).items():
        if chase.scenario.contacts and (beyond := each.beyond(envelope)):
            return failed(now, MISSED, f"is missed by contacts.{name}: {beyond}")
    return "met", now


def failed(now: Situation, status: str, what: str) -> tuple[str, Situation]:
    """The outcome of a try that failed."""
    time = now.sample * now.own.scenario.sample_time
    return status, now.failing(status, f"at t = {time:g} s the target {what}")
