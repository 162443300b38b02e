"""The gripper closes on the target (``capture.closing``)."""

import dataclasses
import math

import numpy as np

from ffsm_drake.common.numbers import number
from ffsm_drake.loop.blocks import GRIPPER
from ffsm_drake.plugins.capture.contact import coast
from ffsm_drake.plugins.capture.gripper import MOTION, Gripper, Met
from ffsm_drake.plugins.capture.phases.chase import Chase, failed, phase_of, replaced
from ffsm_drake.runs.ending import BOUNCED, SLIPPED
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import Phase, PhaseKind, Situation
from ffsm_drake.runs.stage import Stage
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.capture import Closing, Compliance
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES

_LATELY = 20  # samples before the contact, over which the joints' force is averaged


@dataclasses.dataclass(frozen=True)
class Close(PhaseKind):
    """The gripper closes; limp joints keep their last force."""

    settings: Closing

    def plan(self, now: Situation) -> tuple[Phase | None, Situation]:
        """See PhaseKind."""
        chase: Chase = now.own
        part = Gripper(chase.capture.compliance or Compliance())
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
        met: Met = stage.block(GRIPPER).met(stage.memory(GRIPPER), now.sample * period, stage.state)
        onward = free_motion(chase.scenario, met.motion, now.sample)
        motions = now.logs[-1].series[MOTION]
        first = now.sample - len(motions)
        now = replaced(now, path=np.vstack([chase.path[:first], motions, onward]))
        turning, moving = np.linalg.norm(met.rate.reshape(2, 3), axis=1).tolist()
        if math.isinf(met.left) and max(turning, moving) <= self.settings.rest:
            return "held", now
        away = float(np.linalg.norm(met.offset[3:]))
        status = SLIPPED
        if met.left < first * period + self.settings.time:
            status = BOUNCED
        how = "bounces off the gripper" if status == BOUNCED else "slips out of the gripper"
        motion = f"{number(moving)} m/s and {number(turning)} rad/s"
        return failed(now, status, f"{how}: {number(away)} m away, moving at {motion} from it")


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
