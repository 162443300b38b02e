"""The approach, and the phases of the scenario before it."""

import dataclasses
from collections.abc import Mapping

from ffsm_drake.plugins.capture.grasping import Meeting
from ffsm_drake.plugins.capture.phases.chase import Chase, given_up, met
from ffsm_drake.runs.ending import MISSED
from ffsm_drake.runs.phases import Phase, PhaseKind, Situation
from ffsm_drake.runs.stage import Stage
from ffsm_drake.scenario import HELD
from ffsm_drake.systems.closed_chains import CLOSED_CHAINS
from ffsm_drake.systems.registry import Factory


@dataclasses.dataclass(frozen=True, kw_only=True)
class Approach(PhaseKind):
    """Phases up to the contact that share a loop."""

    names: tuple[tuple[str, int], ...]  # with the sample at which each ends
    blocks: Mapping[str, Factory]
    afresh: tuple[str, ...]
    then: str = ""  # outcome; "": whether the gripper meets the target

    def plan(self, now: Situation) -> tuple[Phase | None, Situation]:
        """See PhaseKind."""
        blocks = {**now.own.followed(None), **self.blocks}
        return Phase(names=self.names, blocks=blocks, afresh=self.afresh), now

    def enter(self, now: Situation, phase: Phase, stage: Stage) -> Situation:
        """Put the servicer at its start."""
        if now.sample == 0:
            stage.place(now.own.aim.start(stage.model()))
        return super().enter(now, phase, stage)

    def judge(self, now: Situation) -> tuple[str, Situation]:
        """Whether the gripper meets the target."""
        chase: Chase = now.own
        if self.then or chase.closing:
            return (self.then, now) if self.then else met(now)
        envelope = chase.capture.envelope
        message = given_up(now)
        beyond = Meeting.of(chase.scenario, chase.aim.target, now.stage).beyond(envelope)
        if not beyond and len(chase.scenario.contacts) > 1:  # hands that grasp with the gripper
            chains = CLOSED_CHAINS.only("contacts")
            beyond = chains.beyond(chase.mission, now.stage.state, HELD, envelope)
        if message or beyond:
            at = f"t = {chase.scenario.grasp_time:g} s"
            message = message or f"the target is missed at {at}: {beyond}"
            return MISSED, now.failing(MISSED, message)
        return "met", now
