"""Runs with late hands, which grasp after the first one (``contacts.NAME.closes``).

The loop before a closing has no force of the contact, and the law works in the tree. The closing is
a plastic impact on the moving stack,

    A H^-1 A' lambda = -A v,    v+ = v + H^-1 A' lambda,

of all rigid hands on the target from then on; the new one holds where it is. The law goes on with
its memory, in the velocities of the chain.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context

from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.plugins.two_arms.contact import CLOSING, GAP, LOSS, WRENCHES
from ffsm_drake.runs.ending import MISSED
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import Mission, Phase, Progress
from ffsm_drake.runs.rollout import Rollout, make_rollout
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.capture import Envelope
from ffsm_drake.scenario.contacts import closing_contacts, closing_times
from ffsm_drake.systems.registry import Factory

_BLOCK, _FORCE, _OTHER = "forces.contacts", "force_contacts", "force_disturbance"


class LaterHandsRollout:
    """A ``Rollout`` of a scenario with late hands."""

    def __init__(
        self,
        scenario: Scenario,
        *,
        blocks: Mapping[str, Factory] | None = None,
        meshcat: Meshcat | None = None,
    ) -> None:
        """Arguments and errors: see ``Rollout``."""
        self._scenario = scenario
        how: Any = {"blocks": blocks, "meshcat": meshcat}
        self._rollouts: dict[float, Any] = {}
        for time in closing_times(scenario):
            kind = Rollout if self._rollouts else make_rollout
            self._rollouts[time] = kind(dataclasses.replace(scenario, closed=time), **how)

    @property
    def loop(self) -> ClosedLoop:
        """The closed loop with all hands on the target."""
        loop: ClosedLoop = list(self._rollouts.values())[-1].loop
        return loop

    def release(self) -> None:
        """As ``Rollout.release``."""
        for rollout in self._rollouts.values():
            rollout.release()

    def accepts(self, scenario: Scenario) -> bool:
        """As ``Rollout.accepts``."""
        return all(rollout.accepts(scenario) for rollout in self._rollouts.values())

    def check(self) -> None:
        """As ``Rollout.check``."""
        for rollout in self._rollouts.values():
            rollout.check()

    def run(self, scenario: Scenario | None = None, *, progress: Progress | None = None) -> RunLog:
        """As ``Rollout.run``; at the sample of a closing the log holds the velocity after it."""
        mission = _LaterHands(scenario or self._scenario, self._rollouts, progress)
        return mission.run(mission.after(0.0))


class _LaterHands(Mission):
    """One run, with a phase from each closing to the next."""

    def __init__(
        self, scenario: Scenario, rollouts: Mapping[float, Any], progress: Progress | None
    ) -> None:
        super().__init__(scenario, progress)
        self._rollouts = rollouts

    def after(self, time: float) -> Phase:
        """The phase from a closing on, by its time after the grasp (s)."""
        scenario = self._scenario
        nexts, last = [each for each in self._rollouts if each > time], None
        if nexts:
            last = round((scenario.grasp_time + nexts[0]) / scenario.sample_time)

        def next_() -> Phase | None:
            return self._met(nexts[0]) if nexts else None

        plan = dataclasses.replace(scenario, closed=time)
        return Phase(names=(("stop", last),), holds=True, scenario=plan, next=next_)

    def _met(self, time: float) -> Phase | None:
        """The next phase, unless a hand is too far from its place."""
        scenario = self._scenario
        state = self.before.whole_states(self.context)[0]
        envelope = Envelope() if scenario.capture is None else scenario.capture.envelope
        beyond = self._rollouts[time].loop.blocks[_BLOCK].beyond(state, envelope)
        if not beyond:
            return self.after(time)
        names = [name for name, each in scenario.contacts.items() if each.closes == time]
        at = f"t = {self.sample * scenario.sample_time:g} s"
        self._fail(MISSED, f"the hand of contacts.{names[0]} misses its place at {at}: {beyond}")
        return None

    def _loop_of(self, phase: Phase, scenario: Scenario) -> Any:
        return self._rollouts[scenario.closed or 0.0]

    def begin(self, phase: Phase, loop: ClosedLoop, root_context: Context) -> None:
        """Close the hands of a phase on the target."""
        if self.sample == 0:
            return
        log, block = self.logs[-1], loop.blocks[_BLOCK]
        if log.grasp is not None:
            loop.set_payload(root_context, log.grasp.payload)
        state = self.before.whole_states(self.context)[0]
        work = log.series[LOSS][-1].item() if LOSS in log.series else 0.0
        state = block.close(root_context, state, work=work)
        loop.set_whole_states(root_context, state[None])
        reference = loop.diagram.GetOutputPort("desired_state").Eval(root_context)
        loop.resume(root_context, self.before, self.context, reference[None], afresh=(_BLOCK,))

    def _of_all(self, values: np.ndarray | None, count: int) -> np.ndarray:
        """Values (count, 6 for each contact that closes a loop) of all, from those of the first."""
        closing = closing_contacts(dataclasses.replace(self._scenario, closed=math.inf))
        names, found = list(closing), np.zeros((count, len(closing), 6))
        if values is not None:
            first = sorted(names, key=lambda name: closing[name].closes)[: values.shape[1] // 6]
            found[:, sorted(map(names.index, first))] = values.reshape(count, -1, 6)
        return found.reshape(count, -1)

    def _joined(self) -> RunLog:
        last, first = self.logs[-1], self.logs[0]
        for k, log in enumerate(self.logs):  # zero for an open hand
            series = dict(log.series)
            for name in (WRENCHES, GAP):
                series[name] = self._of_all(series.get(name), log.time.size)
            for name in (CLOSING, LOSS, _FORCE):
                if name in last.series and name not in series:
                    series[name] = np.zeros((log.time.size, last.series[name].shape[1]))
            if _OTHER in last.series and _OTHER not in series:
                series[_OTHER] = series["disturbance_force"]
            self.logs[k] = dataclasses.replace(log, series=series)
        return dataclasses.replace(super()._joined(), grasp=first.grasp)
