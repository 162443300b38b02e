"""Runs of one or more phases, which are legs of a kernel. Lanes with the same code run together.

Between the legs, the kinds of phases plan and judge in Python.
"""

import dataclasses
import itertools
import re
import time
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence

import numpy as np

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.compiled.case import Case
from ffsm_drake.plugins.compiled.kernel import Kernel, LaneEnd, LaneState
from ffsm_drake.plugins.compiled.logs import laws_of, log_of, planned_signals
from ffsm_drake.plugins.compiled.noise import Noise
from ffsm_drake.plugins.compiled.plans import plans_of
from ffsm_drake.plugins.compiled.run import Run
from ffsm_drake.plugins.compiled.stage import LaneStage
from ffsm_drake.runs.ending import COMPLETED, Outcome
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import Course, Phase, phases_of_mission
from ffsm_drake.systems.faults import detects

NUDGE = 1.0 + np.finfo(float).eps  # changes last bits
_LEFT = "its fault detection isolates a unit, or it diverges"
_OWN = re.compile(r"(sensing|forces)\..*|supervisor|reference")  # blocks of a phase


class Lane:
    """A run on its way through its phases.

    ``result`` at the end: its log; NotCovered; or None, if it fails. Drake's run then shows how.
    """

    def __init__(
        self,
        mission: Mission,
        own: Run | None = None,
        signals: Collection[str] | None = None,
        *,
        nudge: float = 1.0,
    ) -> None:
        """Args:
          mission: the mission.
          own: the run, unless it has several phases.
          signals: those that its log needs; None: all.
          nudge: factor of its first state.

        Raises the errors of a plan.
        """
        self.mission, self.own, self.signals = mission, own, signals
        self._nudge, self._start = nudge, time.perf_counter()
        self._course = Course(phases_of_mission(mission), mission)
        # what a run that is lost has for its log
        self.lost = NotCovered(_LEFT) if detects(mission.scenario) else None
        self.result: RunLog | NotCovered | None = self.lost
        self.steps = list[Hashable]()  # what its code depends on, from phase to phase
        self._noise: Noise | None = None
        self._build_time = 0.0

    def nudged(self, nudge: float) -> "Lane":
        """The same with another first state."""
        return Lane(self.mission, self.own, nudge=nudge)

    def plan(self) -> bool:
        """Go to the begin of the next phase, if there is one."""
        start = time.perf_counter()
        try:
            if (phase := self._course.plan()) is None:
                self.result = self._course.joined(start - self._start)
                return False
            self._begin(phase)
        except NotCovered as error:
            self.result = error
            return False
        except FfsmError:  # Drake's run shows it
            return False
        self._build_time = time.perf_counter() - start
        return True

    def _begin(self, phase: Phase) -> None:
        if others := [name for name in phase.blocks if not _OWN.fullmatch(name)]:
            raise NotCovered(f"the block {min(others)} of a phase")
        first, last = self._course.sample, phase.names[-1][1]
        run = self.own or self._run_of(phase)
        is_held = first == 0 and phase.grip.holds  # else its phase places it
        begin = LaneState(run.states if is_held else {}, first, first)
        self._phase, self._stage, self.kind = phase, LaneStage(run, begin), self._course.kind
        self._course.enter(phase, self._stage)
        self._stage.follow()
        if self._nudge != 1.0 and first == 0:
            self._stage.place(self._stage.state * self._nudge)
        self.ends = last is None
        self.samples = (run.samples - 1 if last is None else last) - first

    def _run_of(self, phase: Phase) -> Run:
        plan = phase.plan or self.mission
        case = Case(
            plan,
            phase.grip,
            first=self._course.sample,
            last=phase.names[-1][1],
            motion=phase.motion,
            blocks=phase.blocks,
            joint_force=phase.joint_force,
            noise=self._noise,
        )
        self._noise = case.noise
        run = Run(plan, case)
        run.given = dict(phase.blocks)
        return run

    @property
    def stage(self) -> LaneStage:
        """The loop of the present phase."""
        return self._stage

    @property
    def run(self) -> Run:
        """The run of the present phase."""
        return self._stage.run

    @property
    def begin(self) -> LaneState:
        """Where the present phase begins."""
        return self._stage.begin

    def call_law(self, why: str) -> None:
        """Call the law, which is not traced for this reason."""
        self._stage.run = self.run.with_called_law(why)

    def note(self, end: LaneEnd, spent: Mapping[str, float]) -> None:
        """End the present phase. Args: the time spent to prepare and to run, s."""
        run, first, count = self.run, self.begin.sample, len(end.log["state"])
        rows = slice(first, first + count)
        time_of, planned = run.case.times[rows], planned_signals(run.case)
        needed = planned if self.signals is None else planned.keys() & {*self.signals}
        found = {name: planned[name][rows] for name in needed}
        until = float(time_of[-1])
        outcome = Outcome(status=COMPLETED, time=until, message=f"completed {until:g} s")
        log = log_of(run, {**found, **end.log}, outcome, time_of, run.case)
        spent = {**spent, "build": spent["build"] + self._build_time}
        self.steps.append((type(self.kind), run.key))
        self._stage.leave(end)
        self._course.leave(self._stage)
        wall_time = spent | {"total": sum(spent.values())}
        self._course.note(self._phase, dataclasses.replace(log, wall_time=wall_time))

    @property
    def changes(self) -> set[Hashable]:
        """A run of one phase, or pairs of successive phases: each is compared with Drake
        once.
        """
        if self.own is not None:
            return {self.own.key}
        return set(itertools.pairwise([None, *self.steps]))


def advance(lanes: Iterable[Lane], kernel_of: Callable[[Sequence[Run]], Kernel]) -> None:
    """Run lanes to their ends. Args: the lanes; what compiles the code of runs."""
    waiting = [lane for lane in lanes if lane.plan()]
    while waiting:
        groups: dict[Hashable, list[Lane]] = {}
        for lane in waiting:
            groups.setdefault((lane.run.key, lane.samples, lane.ends), []).append(lane)
        waiting = [
            lane for group in groups.values() for lane in _advanced(group, kernel_of) if lane.plan()
        ]


def _advanced(lanes: Sequence[Lane], kernel_of: Callable[[Sequence[Run]], Kernel]) -> list[Lane]:
    """Run the present phase of lanes with the same code. Return those that reach its end."""
    try:
        kernel = kernel_of([lane.run for lane in lanes])
    except FfsmError as error:  # Drake's run may refuse it
        for lane in lanes:
            lane.result = refusal(error)
        return []
    return [
        lane
        for first in range(0, len(lanes), kernel.width)
        for lane in _ended(kernel, lanes[first : first + kernel.width])
    ]


def refusal(error: FfsmError) -> NotCovered:
    """Return an error as the reason why runs are left to Drake."""
    return error if isinstance(error, NotCovered) else NotCovered(one_line(error))


def _ended(kernel: Kernel, lanes: Sequence[Lane]) -> list[Lane]:
    """Run as many lanes as a register holds, as ``_advanced``. An error leaves only its lane to
    Drake.
    """
    try:
        ends, spent = _leg(kernel, lanes)
    except FfsmError as error:
        if len(lanes) > 1:
            return [lane for each in lanes for lane in _ended(kernel, [each])]
        lanes[0].result = refusal(error)
        return []
    found = list[Lane]()
    for lane, end in zip(lanes, ends, strict=True):
        if end.left is not None:
            continue
        try:
            lane.note(end, spent)
            found.append(lane)
        except FfsmError as error:
            lane.result = refusal(error)
    return found


def _leg(kernel: Kernel, lanes: Sequence[Lane]) -> tuple[list[LaneEnd], dict[str, float]]:
    """Run the present phase of as many lanes as a register holds. Return their ends, and the time
    spent, s.
    """
    start = time.perf_counter()
    if why := kernel.blocks.called:
        for lane in lanes:
            lane.call_law(why)
    runs = [lane.run for lane in lanes]
    detectors = [each for lane in lanes for each in lane.stage.detectors]
    rows, laws = [run.rows for run in runs], laws_of(kernel, runs, detectors)
    began = time.perf_counter()
    ends = kernel.leg(
        [run.parameters for run in runs],
        [lane.begin for lane in lanes],
        rows,
        lanes[0].samples,
        signals=lanes[0].signals,
        laws=laws,
        plans=plans_of(runs),
        ends=lanes[0].ends,
    )
    if laws is not None:
        for lane, memory in zip(lanes, laws.remembered, strict=False):
            lane.stage.looked = memory
    return ends, {"build": began - start, "advance_to": time.perf_counter() - began}
