"""Runs in phases. Each phase is a leg of a kernel, and lanes with the same code run together.

Between the legs, the kinds of phases plan and judge in Python.
"""

import dataclasses
import itertools
import re
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.plugins import service
from ffsm_drake.plugins.compiled.called import parts
from ffsm_drake.plugins.compiled.kernel import Kernel, LaneEnd, LaneState
from ffsm_drake.plugins.compiled.logs import laws_of, log_of, planned_signals
from ffsm_drake.plugins.compiled.noise import Noise
from ffsm_drake.plugins.compiled.plans import plans_of
from ffsm_drake.plugins.compiled.run import Case, Run, row_of
from ffsm_drake.runs.ending import COMPLETED, Outcome
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import Course, Phase
from ffsm_drake.runs.stage import Stage
from ffsm_drake.scenario import MassProperties, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import PlantModel, make_flexible_plant
from ffsm_drake.systems.sampled import Arrays

NUDGE = 1.0 + np.finfo(float).eps  # changes last bits
_OWN = re.compile(r"(sensing|forces)\..*|supervisor|reference")  # blocks of a phase


class LaneStage(Stage):
    """A ``Stage`` of a compiled run."""

    def __init__(self, run: Run, sample: int) -> None:
        """Args: the run of a phase, and the sample at which it begins."""
        self.run, self.begin = run, LaneState({}, sample, sample)
        self._measured = np.zeros(0)  # at its end
        own = run.case.reference
        # memory of the reference at the begin and at the end of the phase
        self.followed = self._followed_then = None if own is None else own.start()

    @property
    def coordinates(self) -> Coordinates:
        """See Stage."""
        return self.run.coordinates

    @property
    def blocks(self) -> Mapping[str, Any]:
        """See Stage."""
        return {f"forces.{name}": block for name, block in self.run.case.forces.items()}

    @property
    def state(self) -> np.ndarray:
        """See Stage."""
        return self.begin.cells["x"][: self._plant]

    @property
    def measured(self) -> np.ndarray:
        """See Stage."""
        return self._measured

    @property
    def _plant(self) -> int:
        return int(self.run.case.true.plant.num_multibody_states())

    def model(self) -> PlantModel:
        """See Stage."""
        return make_flexible_plant(self.run.scenario, self.run.case.nominal.grip)

    def block(self, name: str) -> Any:
        """See Stage."""
        return self.run.case.reference if name == "reference" else self.blocks[name]

    def memory(self, block: str) -> Arrays:
        """See Stage."""
        if block == "reference" and self.followed is not None:
            return self.followed
        touched = self.begin.cells["touched"]
        return {name: touched[place] for name, place in self._places(block).items()}

    def remember(self, block: str, memory: Arrays) -> None:
        """See Stage."""
        if block == "reference":
            self.followed = memory
            return
        touched = self.begin.cells["touched"].copy()
        for name, place in self._places(block).items():
            touched[place] = memory[name]
        touch = np.zeros_like(self.begin.cells["touch"])
        self._set({**self.begin.cells, "touched": touched, "touch": touch})

    def _places(self, block: str) -> dict[str, slice]:
        """The places of a block's memory among the numbers of its kind."""
        starts = {f"forces.{name}": each.start() for name, each in self.run.blocks.fast.items()}
        sizes = {
            (name, key): np.size(value)
            for name, start in starts.items()
            for key, value in start.items()
        }
        return {key: place for (name, key), place in parts(sizes).items() if name == block}

    def place(self, state: np.ndarray) -> None:
        """See Stage."""
        memory = row_of(self.run.law.initial_state())
        self._set(self.run.case.states_at(state) | {"memory": memory})

    def carry(self, payload: MassProperties) -> None:
        """See Stage."""
        self.run = self.run.carrying(payload)

    def resume(
        self,
        before: Any,
        reference: np.ndarray | None = None,
        *,
        afresh: Collection[str] = (),
    ) -> None:
        """See Stage."""
        own, plant = self.begin.cells, self._plant
        cells = dict(before.begin.cells)
        cells["x"] = np.concatenate([own["x"][:plant], cells["x"][plant:]])
        cells["touch"] = own["touch"]  # zero: the gripper of the phase before has no effect
        first_at = before.begin.first_at
        if "controller" in afresh:
            first_at, cells["memory"] = self.begin.sample, own["memory"]
        elif reference is not None:
            first_at = self.begin.sample
            like, values = self.run.law.initial_state(), cells["memory"]
            ends = np.cumsum([np.size(each) for each in like.values()])[:-1]
            parts = zip(like.items(), np.split(values, ends), strict=True)
            memory = {name: part.reshape(np.shape(each)) for (name, each), part in parts}
            law = before.run.law
            cells["memory"] = row_of(self.run.controller.resumed(memory, law, reference))
        if "reference" not in afresh and self.followed is not None:
            self.followed = before.followed or self.followed
        if (held := self.run.parameters["joint_force"]).size:  # the law reads what acts now
            cells["applied"] = np.concatenate([cells["applied"][: -held.size], held])
        if "supervisor" in afresh:
            cells["watched"] = np.zeros_like(cells["watched"])
        self.begin = LaneState(cells, self.begin.sample, first_at)

    def follow(self) -> None:
        """Compute the reference over the phase."""
        if self.followed is not None:
            self._followed_then = self.run.case.follow(self.followed)

    def leave(self, end: LaneEnd) -> None:
        """Put the stage where its phase ends."""
        self.begin, self._measured = end.state, end.measured
        self.followed = self._followed_then

    def _set(self, cells: Mapping[str, np.ndarray]) -> None:
        self.begin = self.begin._replace(cells=cells)


class MissionLane:
    """A run on its way through its phases.

    ``result`` at the end: its log; NotCovered; or None, if it fails. Drake's run then shows how.
    """

    def __init__(self, scenario: Scenario, *, nudged: bool = False) -> None:
        """Args: the scenario; whether the last bits of its first state are changed. Raises the
        errors of a plan.
        """
        self.scenario, self._nudged, self._start = scenario, nudged, time.perf_counter()
        mission = service("capture_mission", "capture.approach")
        self._course = Course(mission(scenario), scenario)
        self.result: RunLog | NotCovered | None = None
        self.steps = list[Any]()  # what its code depends on, from phase to phase
        self._noise: Noise | None = None
        self._spent = {"build": 0.0, "advance_to": 0.0}

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
        self._spent["build"] = time.perf_counter() - start
        return True

    def _begin(self, phase: Phase) -> None:
        if others := [name for name in phase.blocks if not _OWN.fullmatch(name)]:
            raise NotCovered(f"the block {min(others)} of a phase")
        first, last = self._course.sample, phase.names[-1][1]
        plan = phase.scenario or self.scenario
        case = Case(
            plan,
            phase.grip,
            first=first,
            last=last,
            motion=phase.motion,
            blocks=phase.blocks,
            joint_force=phase.joint_force,
            noise=self._noise,
        )
        self._noise = case.noise
        run = Run(plan, case)
        run.given = dict(phase.blocks)
        self._phase, self._stage, self.kind = phase, LaneStage(run, first), self._course.kind
        self._course.enter(phase, self._stage)
        self._stage.follow()
        if self._nudged and first == 0:
            self._stage.place(self._stage.state * NUDGE)
        self.ends = last is None
        self.samples = (case.samples - 1 if last is None else last) - first

    @property
    def run(self) -> Run:
        """The run of the present phase."""
        return self._stage.run

    @property
    def begin(self) -> LaneState:
        """Where the present phase begins."""
        return self._stage.begin

    def note(self, kernel: Kernel, end: LaneEnd, seconds: float) -> None:
        """End the present phase. Args: the time spent in its kernel."""
        run, first, count = self.run, self.begin.sample, len(end.log["state"])
        rows = slice(first, first + count)
        time_of = run.case.times[rows].copy()
        planned = {name: values[rows].copy() for name, values in planned_signals(run.case).items()}
        until = float(time_of[-1])
        outcome = Outcome(status=COMPLETED, time=until, message=f"completed {until:g} s")
        log = log_of(run, {**planned, **end.log}, outcome, time_of, kernel.parts)
        spent = self._spent | {"advance_to": seconds}
        self.steps.append((type(self.kind), run.key))
        self._stage.leave(end)
        self._course.leave(self._stage)
        wall_time = spent | {"total": sum(spent.values())}
        self._course.note(self._phase, dataclasses.replace(log, wall_time=wall_time))

    @property
    def changes(self) -> set[Any]:
        """Pairs of successive phases, each of which is compared with Drake once."""
        return set(itertools.pairwise([None, *self.steps]))


def advance(lanes: Iterable[MissionLane], kernel_of: Callable[[Sequence[Run]], Kernel]) -> None:
    """Run lanes to their ends. Args: the lanes; what compiles the code of runs."""
    waiting = [lane for lane in lanes if lane.plan()]
    while waiting:
        groups: dict[Any, list[MissionLane]] = {}
        for lane in waiting:
            groups.setdefault((lane.run.key, lane.samples, lane.ends), []).append(lane)
        waiting = [
            lane for group in groups.values() for lane in _advanced(group, kernel_of) if lane.plan()
        ]


def _advanced(
    lanes: Sequence[MissionLane], kernel_of: Callable[[Sequence[Run]], Kernel]
) -> list[MissionLane]:
    """Run the present phase of lanes with the same code. Return those that reach its end."""
    found = list[MissionLane]()
    try:
        kernel = kernel_of([lane.run for lane in lanes])
    except NotCovered as error:
        for lane in lanes:
            lane.result = error
        return found
    for first in range(0, len(lanes), kernel.width):
        some, start = lanes[first : first + kernel.width], time.perf_counter()
        runs = [lane.run for lane in some]
        if why := kernel.blocks.called:
            runs = [run.with_called_law(why) for run in runs]
        ends = kernel.leg(
            [run.parameters for run in runs],
            [lane.begin for lane in some],
            [run.rows for run in runs],
            some[0].samples,
            laws=laws_of(kernel, runs),
            plans=plans_of(runs),
            ends=some[0].ends,
        )
        for lane, end in zip(some, ends, strict=True):
            if end.left is None:
                lane.note(kernel, end, time.perf_counter() - start)
                found.append(lane)
    return found
