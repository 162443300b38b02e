"""Runs with a capture: the servicer without the target up to the grasp, then with the target.

Before and after the grasp there are two closed loops with one controller, each with its own nominal
model. At the grasp the states of sensors, actuators and forces are kept, the law resumes
(``ControlLaw.resume``), and the velocity of the servicer jumps. The gripper holds the target at the
pose at which it meets it, so the position error of the arm becomes part of the mass properties of
the payload.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence

from pydrake.geometry import Meshcat

from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.plugins.capture.closing import ClosingRun
from ffsm_drake.plugins.capture.first_tries import FirstTries
from ffsm_drake.plugins.capture.handover import Handover, grasped_at_start
from ffsm_drake.plugins.capture.phases import Captures
from ffsm_drake.plugins.capture.pictures import show_apart
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import Progress
from ffsm_drake.runs.rollout import Leg, Rollout
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.registry import Factory


class MissionRollout:
    """A ``Rollout`` of a scenario with a capture, or several with the same sample of the grasp."""

    def __init__(
        self,
        scenario: Scenario | Sequence[Scenario],
        *,
        blocks: Mapping[str, Factory] | None = None,
        meshcat: Meshcat | None = None,
    ) -> None:
        """Arguments and errors: see ``Rollout``."""
        self._blocks = blocks
        self._stop = Rollout(scenario, blocks=blocks, meshcat=meshcat)
        self._scenarios = _as_tuple(scenario)
        self._approach = None
        first = self._scenarios[0]
        if first.grasp_time > 0.0:
            show = None
            if meshcat is not None:
                show = functools.partial(show_apart, Handover(first).path[:, :7])
            self._approach = Rollout(
                [dataclasses.replace(each, holds=False) for each in self._scenarios],
                blocks=blocks,
                meshcat=meshcat,
                show=show,
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
        (log,) = self._through(None if scenario is None else [scenario], progress, leg)
        assert log is not None  # failures of a run alone are raised
        return log

    def run_all(self, scenarios: Sequence[Scenario] | None = None) -> list[RunLog | None]:
        """As ``Rollout.run_all``."""
        if self._approach is None:
            logs = self._stop.run_all(scenarios)
            return [None if log is None else grasped_at_start(log) for log in logs]
        return self._through(scenarios, None)

    def _through(
        self,
        given: Sequence[Scenario] | None,
        progress: Progress | None,
        leg: Leg | None = None,
    ) -> list[RunLog | None]:
        """Run scenarios, None: the built ones, through their phases."""
        scenarios = given or self._scenarios
        closes = ClosingRun if len(scenarios) == 1 else FirstTries
        kind = Captures if scenarios[0].closing is None else closes
        mission = kind(
            [Handover(each) for each in scenarios],
            progress,
            blocks=self._blocks,
            kept={True: self._stop, False: self._approach},
        )
        mission.last, end = (None, None) if leg is None else (leg.last, leg.end)
        logs = mission.run(mission.first())
        if end is not None and not mission.ended:
            end(mission.before, mission.context)
        return logs


def _as_tuple(scenario: Scenario | Sequence[Scenario]) -> tuple[Scenario, ...]:
    return (scenario,) if isinstance(scenario, Scenario) else tuple(scenario)
