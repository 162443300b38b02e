"""Runs with a capture: the servicer alone up to the grasp, then with the target, with one
controller.

Each side of the grasp is a closed loop with its own nominal model. At the grasp the states of
sensors, actuators and forces are kept, the law resumes (``ControlLaw.resume``), and the servicer's
velocity jumps. The target is held where the gripper meets it: the position error of the arm becomes
part of the payload's mass properties.
"""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from pydrake.geometry import Meshcat

from ffsm_drake.common.errors import BlockError
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.runs.closing import ClosingRun, closing_of, given_up
from ffsm_drake.runs.ending import MISSED, Outcome
from ffsm_drake.runs.handover import Handover, Handovers, mismatch_of, stored_at_start
from ffsm_drake.runs.log import GraspLog, RunLog
from ffsm_drake.runs.rollout import Leg, Rollout
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.capture import planned_contact, target_path
from ffsm_drake.spacecraft.nominal import make_flexible_plant, make_nominal_plant
from ffsm_drake.systems.reference import without_target
from ffsm_drake.systems.registry import Factory


class CaptureRollout:
    """As ``Rollout``, for a scenario with a capture, or several that grasp at the same sample."""

    def __init__(
        self,
        scenario: Scenario | Sequence[Scenario],
        *,
        blocks: Mapping[str, Factory] | None = None,
        meshcat: Meshcat | None = None,
    ) -> None:
        """Args and errors as for ``Rollout``."""
        self._blocks = blocks
        self._stop = Rollout(scenario, blocks=blocks, meshcat=meshcat)
        self._scenarios = _as_tuple(scenario)
        self._approach = None
        first = self._scenarios[0]
        if first.grasp_time > 0.0:
            target = None
            if meshcat is not None:
                model = make_nominal_plant(first)
                target = target_path(first, model, planned_contact(first, model))[1][:, :7]
            self._approach = Rollout(
                [without_target(each) for each in self._scenarios],
                blocks=blocks,
                meshcat=meshcat,
                target=target,
            )

    @property
    def loop(self) -> ClosedLoop:
        """The closed loop with the target held."""
        return self._stop.loop

    def release(self) -> None:
        """As ``Rollout.release``."""
        for rollout in (self._stop, self._approach):
            if rollout is not None:
                rollout.release()

    def accepts(self, scenario: Scenario | Sequence[Scenario]) -> bool:
        """As ``Rollout.accepts``; the payload's true centre of mass must be the same too, since the
        target's motion depends on it.
        """
        centers, built = (
            [each.payload.truth.center_of_mass for each in scenarios]
            for scenarios in (_as_tuple(scenario), self._scenarios)
        )
        return self._stop.accepts(scenario) and centers == built

    def check(self) -> None:
        """As ``Rollout.check``."""
        for rollout in (self._approach, self._stop):
            if rollout is not None:
                rollout.check()

    def run(
        self,
        scenario: Scenario | None = None,
        *,
        progress: Callable[[float, float], None] | None = None,
    ) -> RunLog:
        """As ``Rollout.run``; at the sample of the grasp the log holds the velocity after it."""
        start = time.perf_counter()
        chosen = scenario or self._stop.loop.scenario
        if self._approach is None:
            return _grasped_at_start(self._stop.run(scenario, progress=progress))
        if closing_of(chosen) is not None:
            return self._run_closing(self._approach, chosen, scenario, progress, start)
        handovers = Handovers([Handover(chosen)])
        sample, (handover,) = handovers.sample, handovers.each
        try:
            approach = self._approach.run(
                None if scenario is None else without_target(scenario),
                progress=progress,
                leg=Leg(last=sample, begin=handovers.start, end=handovers.keep),
            )
        except BlockError as error:
            if error.log is not None:
                ungrasped = handover.ungrasped(error.log.time.size)
                error.log = dataclasses.replace(error.log, scenario=chosen, grasp=ungrasped)
            raise
        ungrasped = handover.ungrasped(approach.time.size)
        if not approach.outcome.completed:
            return dataclasses.replace(approach, scenario=chosen, grasp=ungrasped)
        if message := given_up(approach):
            missed = Outcome(status=MISSED, time=float(approach.time[-1]), message=message)
            return dataclasses.replace(approach, scenario=chosen, outcome=missed, grasp=ungrasped)
        handovers.meet(self._stop.loop)
        if beyond := handover.beyond_envelope():
            last = float(approach.time[-1])
            message = f"the target is missed at t = {chosen.grasp_time:g} s: {beyond}"
            missed = Outcome(status=MISSED, time=last, message=message)
            return dataclasses.replace(approach, scenario=chosen, outcome=missed, grasp=ungrasped)
        try:
            log = self._stop.run(
                scenario, progress=progress, leg=Leg(first=sample, begin=handovers.grasp)
            )
        except BlockError as error:
            if error.log is not None:
                error.log = handover.joined(approach, error.log, start)
            raise
        return handover.joined(approach, log, start)

    def _run_closing(
        self,
        approach: Rollout,
        chosen: Scenario,
        scenario: Scenario | None,
        progress: Callable[[float, float], None] | None,
        start: float,
    ) -> RunLog:
        """``run`` with a gripper that closes over a time."""
        handovers = Handovers([Handover(chosen)])
        legs = ClosingRun(chosen, handovers.each[0], blocks=self._blocks, progress=progress)
        try:
            captured = legs.run(approach, scenario, handovers.start)
        except BlockError as error:
            if error.log is not None:
                legs.logs.append(error.log)
                legs.sample += error.log.time.size
                error.log = legs.joined
            raise
        if not captured:
            return legs.joined
        held, handover = legs.held()
        handovers = Handovers([handover], afresh=True)
        handovers.keep(legs.loop, legs.context)
        stop = Rollout(held, blocks=legs.followed(legs.blocks, follows=False, sees=False))
        handovers.meet(stop.loop)
        log = stop.run(progress=progress, leg=Leg(first=legs.sample, begin=handovers.grasp))
        log = dataclasses.replace(log, scenario=chosen)
        return handover.joined(legs.joined, log, start)

    def run_all(self, scenarios: Sequence[Scenario] | None = None) -> list[RunLog | None]:
        """As ``Rollout.run_all``; None of one that misses its target, too."""
        start = time.perf_counter()
        if self._approach is None:
            logs = self._stop.run_all(scenarios)
            return [None if log is None else _grasped_at_start(log) for log in logs]
        chosen = self._scenarios if scenarios is None else scenarios
        handovers = Handovers([Handover(each) for each in chosen])
        sample = handovers.sample
        approaches = self._approach.run_all(
            None if scenarios is None else [without_target(each) for each in scenarios],
            leg=Leg(last=sample, begin=handovers.start, end=handovers.keep),
        )
        without = [log is None or not log.outcome.completed for log in approaches]
        stops: list[RunLog | None] = [None] * len(approaches)
        if not all(without):
            handovers.meet(self._stop.loop, without=without)
            stops = self._stop.run_all(
                scenarios,
                leg=Leg(first=sample, begin=handovers.grasp),
                without=handovers.ended,
            )
        found = list[RunLog | None]()
        for before, after, handover, each in zip(
            approaches, stops, handovers.each, chosen, strict=True
        ):
            if before is not None and not before.outcome.completed:
                grasp = handover.ungrasped(before.time.size)
                found.append(dataclasses.replace(before, scenario=each, grasp=grasp))
            elif before is None or after is None:
                found.append(None)
            else:
                found.append(handover.joined(before, after, start))
        return found


def _as_tuple(scenario: Scenario | Sequence[Scenario]) -> tuple[Scenario, ...]:
    return (scenario,) if isinstance(scenario, Scenario) else tuple(scenario)


def _grasped_at_start(log: RunLog) -> RunLog:
    """The log of a run that begins with the planned grasp."""
    model = make_flexible_plant(log.scenario)
    contact = planned_contact(log.scenario, model)
    mismatch = mismatch_of(
        log.scenario, model, contact.q, contact.velocity, contact.target_velocity
    )
    grasp = GraspLog(
        sample=0,
        contact=contact,
        payload=log.scenario.payload.truth,
        target=np.empty((0, 13)),
        mismatch=mismatch,
        stored=stored_at_start(log),
    )
    return dataclasses.replace(log, grasp=grasp)


def make_rollout(
    scenario: Scenario | Sequence[Scenario],
    *,
    blocks: Mapping[str, Factory] | None = None,
    meshcat: Meshcat | None = None,
) -> Rollout | CaptureRollout:
    """The rollout of a scenario, or of several; arguments and errors as for ``Rollout``."""
    kind = Rollout if _as_tuple(scenario)[0].capture is None else CaptureRollout
    return kind(scenario, blocks=blocks, meshcat=meshcat)
