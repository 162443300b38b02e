"""Runs with a capture: the servicer without the target up to the grasp, then with the target.

Before and after the grasp there are two closed loops with one controller, each with its own nominal
model. At the grasp the states of sensors, actuators and forces are kept, the law resumes
(``ControlLaw.resume``), and the velocity of the servicer jumps. The gripper holds the target at the
pose at which it meets it, so the position error of the arm becomes part of the mass properties of
the payload.
"""

import dataclasses
import functools
from collections.abc import Mapping

from pydrake.geometry import Meshcat

from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.plugins.capture.closing import ClosingRun
from ffsm_drake.plugins.capture.handover import Handover, grasped_at_start
from ffsm_drake.plugins.capture.phases import Captures
from ffsm_drake.plugins.capture.pictures import show_apart
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import Progress
from ffsm_drake.runs.rollout import Leg, Rollout
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.registry import Factory


class MissionRollout:
    """A ``Rollout`` of a scenario with a capture."""

    def __init__(
        self,
        scenario: Scenario,
        *,
        blocks: Mapping[str, Factory] | None = None,
        meshcat: Meshcat | None = None,
    ) -> None:
        """Arguments and errors: see ``Rollout``."""
        self._blocks, self._scenario = blocks, scenario
        self._stop = Rollout(scenario, blocks=blocks, meshcat=meshcat)
        self._approach = None
        if scenario.grasp_time > 0.0:
            show = None
            if meshcat is not None:
                show = functools.partial(show_apart, Handover(scenario).path[:, :7])
            empty = dataclasses.replace(scenario, holds=False)
            self._approach = Rollout(empty, blocks=blocks, meshcat=meshcat, show=show)

    @property
    def loop(self) -> ClosedLoop:
        """The closed loop with the target held."""
        return self._stop.loop

    def release(self) -> None:
        """As ``Rollout.release``."""
        for rollout in (self._stop, self._approach):
            if rollout is not None:
                rollout.release()

    def accepts(self, scenario: Scenario) -> bool:
        """As ``Rollout.accepts``."""
        return self._stop.accepts(scenario)

    def check(self) -> None:
        """As ``Rollout.check``."""
        for rollout in (self._approach, self._stop):
            if rollout is not None:
                rollout.check()

    def run(
        self,
        scenario: Scenario | None = None,
        *,
        progress: Progress | None = None,
        leg: Leg | None = None,
    ) -> RunLog:
        """As ``Rollout.run``; at the sample of the grasp the log holds the velocity after it. A
        leg begins at the first sample.
        """
        if self._approach is None:
            return grasped_at_start(self._stop.run(scenario, progress=progress, leg=leg))
        scenario = scenario or self._scenario
        mission = (Captures if scenario.closing is None else ClosingRun)(
            Handover(scenario),
            progress,
            blocks=self._blocks,
            kept={True: self._stop, False: self._approach},
        )
        mission.last = None if leg is None else leg.last
        log = mission.run(mission.first())
        if leg is not None and leg.end is not None and not mission.ended:
            leg.end(mission.before, mission.context)
        return log
