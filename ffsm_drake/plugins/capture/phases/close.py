"""The gripper closes on the target (``capture.closing``)."""

import dataclasses

import numpy as np

from ffsm_drake.loop.blocks import GRIPPER
from ffsm_drake.plugins.capture.closing import MOTION
from ffsm_drake.plugins.capture.contact import coast
from ffsm_drake.plugins.capture.contact_force import Met
from ffsm_drake.plugins.capture.gripper import Gripper
from ffsm_drake.plugins.capture.phases.chase import Chase, failed, phase_of, replaced
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import Phase, PhaseKind, Situation
from ffsm_drake.runs.stage import Stage
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.capture import Closing
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES

_LATELY = 20  # samples before the contact, over which the joints' force is averaged


@dataclasses.dataclass(frozen=True)
class Close(PhaseKind):
    """The gripper closes; limp joints keep their last force."""

    settings: Closing

    def plan(self, now: Situation) -> tuple[Phase | None, Situation]:
        """See PhaseKind."""
        chase: Chase = now.own
        part = Gripper.closing(chase.scenario, 0.0)
        phase = phase_of(
            now,
            (chase.numbered("closing"), now.sample + chase.closing),
            blocks={GRIPPER: part, **chase.supervised(waits=True)},
            joint_force=_lately(now.logs[-1]) if self.settings.joints == "limp" else None,
            sees=False,
        )
        return phase, now

    def enter(self, now: Situation, phase: Phase, stage: Stage) -> Situation:
        """Begin to close."""
        now = super().enter(now, phase, stage)
        chase: Chase = now.own
        memory = stage.block(GRIPPER).begun(
            time=now.sample * chase.scenario.sample_time,
            payload=chase.scenario.payload.truth,
            target=chase.path[now.sample],
            state=stage.state,
        )
        stage.remember(GRIPPER, memory)
        return now

    def judge(self, now: Situation) -> tuple[str, Situation]:
        """Whether the gripper holds the target."""
        chase: Chase = now.own
        stage, period = now.stage, chase.scenario.sample_time
        block = stage.block(GRIPPER)
        closed = stage.memory(GRIPPER), now.sample * period, stage.state
        met: Met = next(iter(block.met(*closed).values()))
        onward = free_motion(chase.scenario, met.motion, now.sample)
        motions = now.logs[-1].series[MOTION]
        first = now.sample - len(motions)
        now = replaced(now, path=np.vstack([chase.path[:first], motions, onward]))
        status, how = block.lost(*closed, self.settings)
        return failed(now, status, how) if status else ("held", now)


def free_motion(scenario: Scenario, motion: np.ndarray, sample: int) -> np.ndarray:
    """The free target's motion (n, 13) from a sample to the end of the run."""
    return coast(
        scenario,
        motion,
        time=sample * scenario.sample_time,
        samples=scenario.num_control_periods + 1 - sample,
        onward=True,
    )


def _lately(log: RunLog) -> np.ndarray:
    """The mean force (joints) of the joints' actuators over the last samples of a log."""
    applied = log.series["applied_force"][-_LATELY:, NUM_BASE_VELOCITIES:]
    found: np.ndarray = applied.mean(axis=0)
    return found
