"""Phases of a mission as data, and the runner that goes through them with one log.

A phase begins where wiring, contacts or the plant change. Its kind has three functions: ``plan``
returns how the loop differs from the loop of the mission, ``enter`` sets the state in which the
phase begins, and ``judge`` returns an outcome, which leads to the next phase. A ``Situation`` is
all that passes from phase to phase.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, DiagramBuilder

from ffsm_drake.common.errors import BlockError
from ffsm_drake.common.registrations import Registry
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.runs.ending import Outcome
from ffsm_drake.runs.log import GraspLog, RunLog
from ffsm_drake.runs.rollout import Leg, Rollout, has_phases
from ffsm_drake.runs.stage import Stage
from ffsm_drake.scenario import EMPTY, HELD, Grip, Scenario
from ffsm_drake.scenario.contacts import closing_times
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import AlongMotion, make_frame_motion
from ffsm_drake.systems.registry import Factory
from ffsm_drake.systems.setup import BlockSetup

Progress = Callable[[float, float], None]
Show = Callable[[DiagramBuilder, ClosedLoop], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Phase:
    """A phase of a mission, which runs in one closed loop.

    A factory in ``blocks.phases`` returns a phase with a ``motion`` that starts with the phase, and
    optionally with ``blocks``.

    Example:
      >>> from ffsm_drake import Phase
      >>> Phase(names=(("stop", None),)).grip.holds
      False
    """

    # names of its samples in the record, one after another, with the sample at which each ends,
    # excluded; None: the end of the run
    names: tuple[tuple[str, int | None], ...] = ()
    grip: Grip = EMPTY  # what holds the target
    plan: Mission | None = None  # that it flies; None: the mission of the run
    motion: PlannedMotion | None = None  # desired, over the run's time; None: from the plan
    # True: the approach begins where ``motion`` ends, not at ``capture.approach.posture``
    joins: bool = False
    # block -> factory that replaces a block of the mission
    blocks: Mapping[str, Factory] = dataclasses.field(default_factory=dict)
    joint_force: np.ndarray | None = None  # see ``add_closed_loop``
    afresh: tuple[str, ...] = ()  # blocks that start anew in this phase


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Situation:
    """What passes from phase to phase."""

    sample: int = 0  # the first of the next phase
    stage: Any = None  # Stage of the last phase, at its end
    phase: Phase = Phase()  # the last one
    logs: tuple[RunLog, ...] = ()  # of the phases
    names: tuple[tuple[str, int], ...] = ()  # phases with an end, and the sample after it
    failed: Outcome | None = None  # outcome of a run that failed between two phases
    made: GraspLog | None = None  # the grasp
    own: Any = None  # what the kinds of a mission keep

    def failing(self, status: str, message: str) -> "Situation":
        """The situation of a run that ends so, unless another phase follows."""
        return dataclasses.replace(self, failed=Outcome(status=status, time=0.0, message=message))

    def legs(self, samples: int) -> tuple[tuple[str, int], ...]:
        """Name and number of samples of the phases before a number of samples."""
        legs, first = list[tuple[str, int]](), 0
        for name, last in self.names:
            if (count := min(last, samples) - first) > 0:
                legs.append((name, count))
                first += count
        return tuple(legs)


class PhaseKind:
    """A kind of phase."""

    def plan(self, now: Situation) -> tuple[Phase | None, Situation]:
        """Return the phase that begins now; None: the run ends."""
        raise NotImplementedError

    def enter(self, now: Situation, phase: Phase, stage: Stage) -> Situation:
        """Set the state in which a phase begins. By default, the last phase ended in this state."""
        if now.sample > 0:
            stage.place(now.stage.state)
            stage.resume(now.stage, afresh=phase.afresh)
        return now

    def judge(self, now: Situation) -> tuple[str, Situation]:
        """Return the outcome of a phase that came to its end."""
        return "", now


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stop(PhaseKind):
    """The motion with the target held."""

    until: int | None = None  # samples after the grasp; None: the end of the run
    then: str = ""  # outcome there

    def plan(self, now: Situation) -> tuple[Phase | None, Situation]:
        """See PhaseKind."""
        return Phase(names=(("stop", self.until),), grip=HELD), now

    def judge(self, now: Situation) -> tuple[str, Situation]:
        """See PhaseKind."""
        return self.then, now


@dataclasses.dataclass(frozen=True, kw_only=True)
class Phases:
    """The phases of a run, and what follows each."""

    kinds: Mapping[str, PhaseKind]  # by the outcome that leads to it; "": the first
    own: Any = None  # what the kinds keep at the start
    # adds to the log of all phases what the kinds know
    finish: Callable[[RunLog, Situation], RunLog] = lambda log, now: log
    # adds series to the logs of the phases before they are joined
    complete: Callable[[tuple[RunLog, ...]], tuple[RunLog, ...]] = lambda logs: logs


class PhasesOf(Protocol):
    """Returns the phases of a mission, given those before a plug-in adds its own. Raises the errors
    of a plan.
    """

    def __call__(self, mission: Mission, before: Phases) -> Phases: ...


# "capture" and "later_hands", in this order.
MISSION_PHASES = Registry[PhasesOf]("mission_phases")
# How the loop of a mission with an empty gripper is shown.
TARGET_VIEWS = Registry[Callable[[Mission], Show]]("target_views")


def phases_of_mission(mission: Mission) -> Phases:
    """Return the phases of a mission. Raises the errors of a plan."""
    phases = Phases(kinds={"": Stop()})
    if mission.scenario.grasps:
        phases = MISSION_PHASES.load("capture", "capture")(mission, phases)
    if len(closing_times(mission.scenario)) > 1:
        phases = MISSION_PHASES.load("later_hands", "contacts.closes")(mission, phases)
    return phases


class PhasedRollout:
    """A ``Rollout`` of a scenario with phases."""

    phases = staticmethod(phases_of_mission)

    def __init__(
        self,
        mission: Mission,
        *,
        blocks: Mapping[str, Factory] | None = None,
        meshcat: Meshcat | None = None,
    ) -> None:
        """Arguments and errors: see ``Rollout``."""
        self._blocks, self._mission = blocks, mission
        self._loops = dict[Grip, Rollout]()  # of phases that differ in nothing else
        how: Any = {"blocks": blocks, "meshcat": meshcat}
        for closed in closing_times(mission.scenario):
            grip = Grip(closed=closed)
            self._loops[grip] = Rollout(mission, grip=grip, **how)
            if grip == HELD and mission.scenario.grasp_time > 0.0:
                view = None if meshcat is None else TARGET_VIEWS.first()
                show = None if view is None else view(mission)
                self._loops[EMPTY] = Rollout(mission, grip=EMPTY, show=show, **how)

    @property
    def loop(self) -> ClosedLoop:
        """The closed loop with all hands on the target."""
        return self._loops[Grip(closed=closing_times(self._mission.scenario)[-1])].loop

    def release(self) -> None:
        """As ``Rollout.release``."""
        for rollout in self._loops.values():
            rollout.release()

    def accepts(self, scenario: Scenario) -> bool:
        """As ``Rollout.accepts``."""
        return self._loops[HELD].accepts(scenario)

    def check(self) -> None:
        """As ``Rollout.check``."""
        for grip in sorted(self._loops, key=lambda grip: (grip.holds, grip.closed)):
            self._loops[grip].check()

    def run(
        self, scenario: Scenario | Mission | None = None, *, progress: Progress | None = None
    ) -> RunLog:
        """As ``Rollout.run``. At a sample of a grasp, the log has the velocity after it."""
        start, mission = time.perf_counter(), self._mission
        if scenario is not None:
            mission = scenario if isinstance(scenario, Mission) else mission.of(scenario)
        course, alone = Course(self.phases(mission), mission), list[Rollout]()

        def joined() -> RunLog:
            return course.joined(time.perf_counter() - start)

        try:
            while (phase := course.plan()) is not None:
                plan = phase.plan or mission
                rollout = self._loop_of(phase, plan)
                if rollout not in self._loops.values():
                    alone.append(rollout)
                try:
                    log = rollout.run(plan, progress=progress, leg=_leg(course, phase))
                except BlockError as error:
                    if error.log is not None:
                        course.note(phase, error.log)
                        error.log = joined()
                    raise
                course.note(phase, log)
        finally:
            for rollout in alone:
                rollout.release()
        return joined()

    def _loop_of(self, phase: Phase, plan: Mission) -> Rollout:
        """The loop of a phase: one that is kept, or a new one."""
        own = dict(phase.blocks)
        if phase.motion is not None:
            own = {"reference": functools.partial(_along, phase.motion), **own}
        if not own and phase.plan is None:
            return self._loops[phase.grip]
        own = {**(self._blocks or {}), **own}
        return Rollout(plan, blocks=own, joint_force=phase.joint_force, grip=phase.grip)


def _leg(course: "Course", phase: Phase) -> Leg:
    """The leg of a phase on Drake."""

    def begin(loop: ClosedLoop, root_context: Context) -> None:
        course.enter(phase, Stage(loop, root_context))

    def end(loop: ClosedLoop, root_context: Context) -> None:
        course.leave(Stage(loop, root_context))

    return Leg(first=course.sample, last=phase.names[-1][1], begin=begin, end=end)


class Course:
    """The course of a run through the phases of a mission. Call ``plan``, ``enter``, ``leave`` and
    ``note`` for each phase, and ``joined`` at the end.
    """

    def __init__(self, phases: Phases, mission: Mission) -> None:
        """Args: the phases of a mission."""
        self._phases, self._mission = phases, mission
        self._now = Situation(own=phases.own)
        self.kind = phases.kinds.get("")  # of the next phase

    @property
    def sample(self) -> int:
        """The first sample of the next phase."""
        return self._now.sample

    def plan(self) -> Phase | None:
        """Return the next phase; None: the run ends."""
        if self.kind is None:
            return None
        phase, self._now = self.kind.plan(self._now)
        return phase

    def enter(self, phase: Phase, stage: Stage) -> None:
        """Set the state in which a phase begins. Args: the phase, and its loop at its start."""
        assert self.kind is not None
        self._now = self.kind.enter(self._now, phase, stage)

    def leave(self, stage: Stage) -> None:
        """Keep the loop of a phase at its end."""
        self._now = dataclasses.replace(self._now, stage=stage)

    def note(self, phase: Phase, log: RunLog) -> None:
        """Keep the log of a phase that is left, and find the kind of the next one."""
        ends = tuple((name, last) for name, last in phase.names if last is not None)
        now = dataclasses.replace(
            self._now,
            sample=ends[-1][1] if ends else self._now.sample,
            phase=phase,
            logs=(*self._now.logs, log),
            names=(*self._now.names, *ends),
        )
        kind, self.kind = self.kind, None
        if kind is not None and log.outcome.completed and phase.names[-1][1] is not None:
            outcome, now = kind.judge(now)
            self.kind = self._phases.kinds.get(outcome) if outcome else None
        self._now = now

    def joined(self, total: float) -> RunLog:
        """Return the log of all phases; NaN in the phases without a series. Args: wall time, s."""
        logs = self._phases.complete(self._now.logs)
        last, time_of = logs[-1], np.concatenate([log.time for log in logs])
        empty = {
            name: np.full_like(values[:1], np.nan)
            for log in logs[::-1]
            for name, values in log.series.items()
        }
        spent = {key: sum(log.wall_time[key] for log in logs) for key in last.wall_time}
        outcome = self._now.failed or last.outcome
        log = dataclasses.replace(
            last,
            mission=self._mission,
            outcome=dataclasses.replace(outcome, time=float(time_of[-1])),
            time=time_of,
            series={
                name: np.concatenate(
                    [log.series.get(name, gap.repeat(log.time.size, axis=0)) for log in logs]
                )
                for name, gap in empty.items()
            },
            parts={name: part for log in logs for name, part in log.parts.items()},
            wall_time={**spent, "total": total},
        )
        return self._phases.finish(log, self._now)


def _along(motion: PlannedMotion, setup: BlockSetup) -> AlongMotion:
    """Return the reference of a motion."""
    frame = make_frame_motion(setup.mission, setup.nominal, motion)
    return AlongMotion(motion=motion, frame=frame)


def make_rollout(
    scenario: Scenario | Mission,
    *,
    blocks: Mapping[str, Factory] | None = None,
    meshcat: Meshcat | None = None,
) -> Any:
    """Return the rollout of a scenario: a ``Rollout``, or with a capture or later hands one with
    the same methods.

    Arguments and errors: see ``Rollout``.

    Example:
      >>> from ffsm_drake import load_scenario, make_rollout
      >>> kinds = map(make_rollout, map(load_scenario, ("postcapture", "tumbling_capture")))
      >>> [type(kind).__name__ for kind in kinds]
      ['Rollout', 'PhasedRollout']
    """
    mission = make_mission(scenario)
    kind = PhasedRollout if has_phases(mission.scenario) else Rollout
    return kind(mission, blocks=blocks, meshcat=meshcat)
