"""Phases of a capture: the phases of the scenario, the approach, and the stop."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from ffsm_drake.loop.blocks import GRIPPER
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.plugins.capture.before import phases_before
from ffsm_drake.plugins.capture.handover import Handover, stored_at_start
from ffsm_drake.plugins.capture.supervisor import Mode
from ffsm_drake.runs.ending import MISSED
from ffsm_drake.runs.log import GraspLog, RunLog
from ffsm_drake.runs.phases import Mission, Phase, Progress
from ffsm_drake.systems.registry import Factory

CONTACTS = "forces.contacts"


class Captures(Mission):
    """A run through the phases of a capture with a gripper that closes at once."""

    last: int | None = None  # sample at which the stop ends; None: the end of the run

    def __init__(self, handover: Handover, progress: Progress | None = None, **how: Any) -> None:
        """Args: see ``Mission``."""
        super().__init__(handover.scenario, progress, **how)
        self.handover = handover

    def first(self) -> Phase:
        """The first phase."""
        return self.approach(self.handover.sample, self._hold)

    def approach(
        self,
        last: int,
        then: Callable[[], Phase | None],
        blocks: Mapping[str, Factory] | None = None,
    ) -> Phase:
        """The scenario's own phases and the approach, up to a sample, with some blocks: neighbours
        with the same blocks share a loop.
        """
        scenario, shared, end = self.handover.scenario, blocks or {}, 0.0
        phases, before = list[Phase](), dict[str, Factory]()
        for name, phase in {**phases_before(scenario), "approach": Phase()}.items():
            own = dict(phase.blocks)
            end += scenario.blocks.phases[name].duration if name in scenario.blocks.phases else 0.0
            part = name, last if name == "approach" else round(end / scenario.sample_time)
            if phases and own == before:
                phases[-1] = dataclasses.replace(phases[-1], names=(*phases[-1].names, part))
            else:
                afresh = tuple({**own, **before})
                phases.append(Phase(names=(part,), blocks={**shared, **own}, afresh=afresh))
            before = own
        for phase in reversed(phases):
            phase = dataclasses.replace(phase, next=then)
            then = functools.partial(_itself, phase)
        return phase

    def begin(self, phase: Phase, loop: ClosedLoop, root_context: Context) -> None:
        """Put the servicer at its start; where the last phase ended; or with its target."""
        if self.sample == 0:
            loop.set_whole_states(root_context, self.handover.start(loop)[None])
        elif phase.holds:
            self._grasp(phase, loop, root_context)
        else:
            super().begin(phase, loop, root_context)

    def meet(self) -> None:
        """Find how the gripper meets the target."""
        self.handover.meet(self.before, self.before.whole_states(self.context)[0])

    def _grasp(self, phase: Phase, loop: ClosedLoop, root_context: Context) -> None:
        """Grasp the target; the run continues from the state after the grasp."""
        handover = self.handover
        state = handover.grasp(loop)
        loop.set_whole_states(root_context, state[None])
        reference = handover.reference[None]
        loop.resume(root_context, self.before, self.context, reference, afresh=phase.afresh)
        # to the blocks, which resume with nothing in the gripper
        loop.set_payload(root_context, handover.payload)
        if CONTACTS in loop.blocks:
            hands: Any = loop.blocks[CONTACTS]
            hands.hold(state)

    def _hold(self) -> Phase | None:
        """The stop, if the gripper holds the target."""
        self.meet()
        message, beyond = given_up(self.logs[-1]), self.handover.beyond_envelope()
        beyond = beyond or self._others_beyond()
        at = f"t = {self._scenario.grasp_time:g} s"
        if message or beyond:
            self._fail(MISSED, message or f"the target is missed at {at}: {beyond}")
            self.ended = True
            return None
        return Phase(names=(("stop", self.last),), holds=True)

    def _others_beyond(self) -> str:
        """As ``Handover.beyond_envelope``, of further hands."""
        stop, capture = self._kept.get(True), self._scenario.capture
        if stop is None or capture is None or CONTACTS not in stop.loop.blocks:
            return ""
        hands: Any = stop.loop.blocks[CONTACTS]
        beyond: str = hands.beyond(self.before.whole_states(self.context)[0], capture.envelope)
        return beyond

    def _note(self, phase: Phase, log: RunLog) -> None:
        super()._note(phase, _without_contact(log))

    @property
    def path(self) -> np.ndarray:
        """Motion of the target (n, 13) before its grasp, at the samples from the start."""
        return self.handover.path

    def _joined(self) -> RunLog:
        log, made = super()._joined(), self.handover.log
        if made is None:
            truth = self._scenario.payload.truth
            target = self.path[: log.time.size]
            grasp = GraspLog(sample=log.time.size, payload=truth, target=target)
        else:
            grasp = dataclasses.replace(made, stored=stored_at_start(self.logs[-1]))
        return dataclasses.replace(
            log, grasp=dataclasses.replace(grasp, legs=self._legs(grasp.sample))
        )


def _itself(phase: Phase) -> Phase:
    return phase


def given_up(approach: RunLog) -> str:
    """Return how the supervisor abandoned an approach; empty: it did not."""
    modes = approach.series.get("mode", np.zeros(1)).ravel()
    if modes[-1] == Mode.APPROACH:
        return ""
    since = float(approach.time[np.flatnonzero(modes != Mode.APPROACH)[0]])
    return f"the supervisor abandoned the approach at t = {since:g} s"


def _without_contact(log: RunLog) -> RunLog:
    """A phase's log with the external force on servicer and target together."""
    series = dict(log.series)
    contact = series.pop(f"force_{GRIPPER.partition('.')[2]}", None)
    if contact is not None:
        series["disturbance_force"] = series["disturbance_force"] - contact
    return dataclasses.replace(log, series=series)
