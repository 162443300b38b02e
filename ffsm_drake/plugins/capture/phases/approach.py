"""The approach, and the phases of the scenario before it."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from pydrake.systems.framework import Context

from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.plugins.capture.grasping import Meeting
from ffsm_drake.plugins.capture.phases.chase import Chase, given_up, met
from ffsm_drake.runs.ending import MISSED
from ffsm_drake.runs.phases import Phase, PhaseKind, Situation
from ffsm_drake.systems.registry import Factory

CONTACTS = "forces.contacts"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Approach(PhaseKind):
    """Phases up to the contact that share a loop."""

    names: tuple[tuple[str, int], ...]  # with the sample at which each ends
    blocks: Mapping[str, Factory]
    afresh: tuple[str, ...]
    then: str = ""  # outcome; "": whether the gripper meets the target
    held: ClosedLoop  # with the hands on the target

    def plan(self, now: Situation) -> tuple[Phase | None, Situation]:
        """See PhaseKind."""
        blocks = {**now.own.followed(None), **self.blocks}
        return Phase(names=self.names, blocks=blocks, afresh=self.afresh), now

    def enter(
        self, now: Situation, phase: Phase, loop: ClosedLoop, root_context: Context
    ) -> Situation:
        """Put the servicer at its start."""
        if now.sample == 0:
            loop.set_whole_state(root_context, now.own.aim.start(loop))
        return super().enter(now, phase, loop, root_context)

    def judge(self, now: Situation) -> tuple[str, Situation]:
        """Whether the gripper meets the target."""
        chase: Chase = now.own
        if self.then or chase.closing:
            return (self.then, now) if self.then else met(now)
        envelope = chase.capture.envelope
        message = given_up(now)
        beyond = Meeting.of(chase.scenario, chase.aim.target, now.loop, now.state).beyond(envelope)
        if not beyond and CONTACTS in self.held.blocks:  # further hands
            hands: Any = self.held.blocks[CONTACTS]
            beyond = hands.beyond(now.state, envelope)
        if message or beyond:
            at = f"t = {chase.scenario.grasp_time:g} s"
            message = message or f"the target is missed at {at}: {beyond}"
            return MISSED, now.failing(MISSED, message)
        return "met", now
