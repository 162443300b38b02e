"""Away from a target that was not captured, and to it again (``capture.retreat``)."""

import dataclasses
import math
from typing import ClassVar

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw

from ffsm_drake.common.numbers import number
from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture.approach import (
    approach_posture,
    gentle_duration,
    is_gentle,
    outwards,
)
from ffsm_drake.plugins.capture.contact import payload_body
from ffsm_drake.plugins.capture.grasping import Aim
from ffsm_drake.plugins.capture.phases.chase import Chase, Move, met, phase_of, replaced
from ffsm_drake.plugins.capture.postures import posture_of
from ffsm_drake.plugins.capture.target_filter import Path
from ffsm_drake.runs.ending import MISSED
from ffsm_drake.runs.exceeded_limits import closest_of
from ffsm_drake.runs.phases import Phase, PhaseKind, Situation
from ffsm_drake.runs.stage import Stage
from ffsm_drake.scenario import EMPTY, Posture
from ffsm_drake.scenario.capture import Retreat as Settings
from ffsm_drake.spacecraft.plant import base_body, base_rpy, configuration
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_motion

_EVERY = 0.5  # s; between the instants at which a further try may meet the target
_LENGTH = 2.0  # m; a turn of the base by 1 rad counts as this way
_CANDIDATES = 30  # meetings looked at, those with the shortest ways
_INSTANTS = 15  # at which the clearance of each is looked at
_AGAIN = ("controller", "supervisor")  # they begin anew


@dataclasses.dataclass(frozen=True)
class Again(PhaseKind):
    """To the target again, which has been looked at since the last try."""

    settings: Settings
    touched: ClassVar[bool] = False  # whether the gripper has touched the target since it was seen

    def plan(self, now: Situation) -> tuple[Phase | None, Situation]:
        """See PhaseKind."""
        now = replaced(now, known=_seen(now))
        phase, found = self._to_next_try(now, now.own.moves[0], now.sample)
        return phase, found if phase else _apart(found)

    def enter(self, now: Situation, phase: Phase, stage: Stage) -> Situation:
        """The reference forgets what it displaced and, after a touch, how the target moved."""
        now = super().enter(now, phase, stage)
        chase: Chase = now.own
        if chase.expected is not None:
            assert chase.why is not None
            touched = self.touched and chase.why.status != MISSED
            memory, time = stage.memory("reference"), now.sample * chase.scenario.sample_time
            renewed = stage.block("reference").renewed(memory, time, touched=touched)
            stage.remember("reference", renewed)
        return now

    def judge(self, now: Situation) -> tuple[str, Situation]:
        """Whether the gripper meets the target."""
        return met(now)

    def _to_next_try(self, now: Situation, away: Move, end: int) -> tuple[Phase | None, Situation]:
        """The way to the next try, from the end of a retreat; None: there is none."""
        chase: Chase = now.own
        found = next_try(now, away.goal, end) if chase.tries < self.settings.tries else None
        if found is None:
            return None, now
        aim, across = found
        begin, name = aim.sample - chase.approach, chase.numbered("retreat")
        now = replaced(
            now,
            aim=aim,
            tries=chase.tries + 1,
            moves=(away, across),
            again=begin * chase.scenario.sample_time,
        )
        names = (name, begin), (now.own.numbered("approach"), aim.sample - chase.closing)
        return phase_of(now, *names, afresh=_AGAIN), now


class Retreat(Again):
    """Away from the target, and to it again; a measured target is looked at in between."""

    touched: ClassVar[bool] = True

    def plan(self, now: Situation) -> tuple[Phase | None, Situation]:
        """See PhaseKind."""
        failed, now = now, replaced(now, known=_seen(now), why=now.failed)
        chase: Chase = now.own
        away = _away(now, self.settings)
        end = now.sample + round(away.duration / chase.scenario.sample_time)
        if end > chase.scenario.num_control_periods:
            return None, failed
        now = dataclasses.replace(now, failed=None)  # unless the retreat comes to its end
        if chase.expected is None:
            phase, now = self._to_next_try(now, away, end)
            if phase is not None:
                return phase, now
        now = replaced(now, moves=(away,), again=None)
        if now.sample == end:
            return None, _apart(now)
        names = (chase.numbered("retreat"), end)
        return phase_of(now, names, follows=False, afresh=_AGAIN), now

    def judge(self, now: Situation) -> tuple[str, Situation]:
        """Whether the gripper meets the target, or the servicer is away from it."""
        chase: Chase = now.own
        if chase.again is not None:
            return met(now)
        if chase.expected is not None and chase.tries < self.settings.tries:
            return "seen", now
        return "apart", _apart(now)


def _apart(now: Situation) -> Situation:
    """The situation of a run that ends away from its target."""
    chase: Chase = now.own
    assert chase.why is not None
    path = Path(motion=chase.path, arm=chase.arm)
    far = number(float(np.linalg.norm(now.stage.state[4:7] - path.center(now.sample - 1))))
    message = f"{chase.why.message}; the servicer retreats to {far} m from it"
    return now.failing(chase.why.status, message)


def _seen(now: Situation) -> Path:
    """The path of the target as the servicer estimates it: from now, by the present estimate."""
    chase: Chase = now.own
    assert chase.known is not None
    if chase.expected is None:
        return dataclasses.replace(chase.known, motion=chase.path)
    block, memory = now.stage.block("reference"), now.stage.memory("reference")
    path: Path = block.known_path(memory, now.sample, len(chase.path) - now.sample)
    return dataclasses.replace(path, motion=np.vstack([chase.path[: now.sample], path.motion]))


def _away(now: Situation, retreat: Settings) -> Move:
    """Motion from the measured state to rest away from the target, within the limits and the time
    of the run: straight away from it, or in the nearest clear direction to a face, an edge or a
    corner of a cube.
    """
    chase: Chase = now.own
    scenario, coordinates = chase.scenario, now.stage.coordinates
    assert chase.known is not None
    q, v = np.split(now.stage.measured, [len(coordinates.position_names)])
    from_target = q[4:7] - chase.known.center(now.sample)
    apart = float(np.linalg.norm(from_target))
    # to ``distance`` beyond where the base is at the grasp
    far = max(0.0, chase.reach + retreat.distance - apart)
    straight, moves = from_target / np.linalg.norm(from_target), list[Move]()
    for direction in (straight, *(each for each in outwards(straight) if each @ straight > 0.5)):
        goal = dataclasses.replace(
            approach_posture(chase.mission),
            base_position=(q[4:7] + far * direction).tolist(),
            base_rpy=base_rpy(q).tolist(),
        )
        move = Move(
            begin=now.sample * scenario.sample_time,
            duration=retreat.duration,
            start=posture_of(q, coordinates),
            goal=goal,
            velocity=v,
        )
        moves.append(_paced(now, move))
        last = now.sample + round(moves[-1].duration / scenario.sample_time)
        samples = np.linspace(now.sample, min(last, len(chase.path) - 1), 2 * _INSTANTS)
        if _is_clear(now, moves[-1].motion(chase.mission), samples, now.sample):
            return moves[-1]
    return moves[0]


def _paced(now: Situation, move: Move) -> Move:
    """A retreat that lasts as long as the limits ask for and the run leaves."""
    mission, scenario = now.own.mission, now.own.scenario

    def motion_in(duration: float) -> PlannedMotion:
        return dataclasses.replace(move, duration=duration).motion(mission)

    left = (scenario.num_control_periods - now.sample) * scenario.sample_time
    duration = gentle_duration(mission, motion_in, move.duration)
    return dataclasses.replace(move, duration=max(min(duration, left), move.duration))


def next_try(now: Situation, start: Posture, first: int) -> tuple[Aim, Move] | None:
    """The next try, from rest in a posture at a sample or later, and the move to its begin: the
    first try moved with the target to where the servicer has least to move, on a way that keeps
    clear. None: there is none.
    """
    chase: Chase = now.own
    chosen, period, approach = chase.scenario, chase.scenario.sample_time, chase.scenario.approach
    assert chase.known is not None
    assert approach is not None
    stop = chosen.reference.duration or approach.duration
    earliest = first + chase.approach + round(_EVERY / period)
    latest = chosen.num_control_periods - math.ceil(stop / period)
    X_BP = _target_from_base(chase.mission)
    X_BS = _base_pose(chosen.initial_posture).inverse() @ _base_pose(
        approach_posture(chase.mission)
    )
    X_W0 = _base_pose(start)
    candidates = []
    for sample in range(earliest, latest + 1, max(1, round(_EVERY / period))):
        motion = chase.known.motion[sample]
        X_WB = RigidTransform(Quaternion(motion[:4]), motion[4:7]) @ X_BP.inverse()
        X_0S = X_W0.inverse() @ X_WB @ X_BS
        way = np.linalg.norm(X_0S.translation())
        candidates.append((way + _LENGTH * X_0S.rotation().ToAngleAxis().angle(), sample, X_WB))
    for _, sample, X_WB in sorted(candidates, key=lambda each: each[0])[:_CANDIDATES]:
        mission = _try(chase, X_WB, X_WB @ X_BS, chase.known.motion[sample])
        begin = sample - chase.approach
        move = Move(
            begin=first * period,
            duration=(begin - first) * period,
            start=start,
            goal=approach_posture(mission),
        )
        motion, margin = move.motion(mission), approach.margin
        samples = np.linspace(first, begin, _INSTANTS)
        if (
            is_gentle(mission, motion)
            and _is_clear(now, motion, samples, first, margin=margin)
            and _is_clear(
                now,
                make_motion(mission, EMPTY),
                np.linspace(begin, sample - chase.closing, _INSTANTS),
                begin,
                margin=margin,
            )
        ):
            return Aim(mission, sample), move
    return None


def _is_clear(
    now: Situation, motion: PlannedMotion, samples: np.ndarray, first: int, *, margin: float = 0.0
) -> bool:
    """Whether a motion that begins at a sample keeps the scenario's clearance, and a margin (m)
    beyond it, at others.
    """
    chase: Chase = now.own
    assert chase.known is not None
    samples, scenario = samples.round().astype(int), chase.scenario
    times = (samples - first) * scenario.sample_time
    q, _, _ = motion.evaluate(times)
    nearest = closest_of(scenario, times, q, target=chase.known.motion[samples, :7])
    return all(each.keeps(scenario.clearance + margin) for each in nearest)


def _target_from_base(mission: Mission) -> RigidTransform:
    """X_BP of the target's frame in the base's, where the arm is to meet it."""
    scenario, model = mission.scenario, mission.craft.nominal()
    q = configuration(model.coordinates, scenario.initial_posture, key="initial_posture")
    model.plant.SetPositions(model.context, q)
    body = payload_body(scenario, model).body_frame()
    return RigidTransform(body.CalcPose(model.context, base_body(model.plant).body_frame()))


def _try(chase: Chase, X_WB: RigidTransform, X_WS: RigidTransform, motion: np.ndarray) -> Mission:
    """The mission of a further try, with the base at X_WS where its approach begins, at X_WB where
    it ends, and the target then in a motion (13).
    """
    chosen, approach = chase.scenario, chase.scenario.approach
    assert approach is not None
    w, v_P = np.split(motion[7:], 2)
    # ``capture.velocity`` refers to the true centre of mass; used only to recover v_P
    arm = matrix_of(motion[:4]) @ chase.arm
    posture = _placed(approach_posture(chase.mission), X_WS)
    approach = dataclasses.replace(approach, posture=posture, start="given")
    capture = chase.capture_of(w, v_P, arm, approach=approach)
    posture = _placed(chosen.initial_posture, X_WB)
    blocks = dataclasses.replace(chosen.blocks, phases={})
    return chase.mission.flown_by(
        initial_posture=posture, capture=capture, blocks=blocks, phases=[]
    )


def _base_pose(posture: Posture) -> RigidTransform:
    """X_WB of a posture."""
    return RigidTransform(RollPitchYaw(posture.base_rpy), posture.base_position)


def _placed(posture: Posture, X_WB: RigidTransform) -> Posture:
    """A posture with the base elsewhere."""
    rpy = RollPitchYaw(X_WB.rotation()).vector()
    return dataclasses.replace(
        posture, base_position=X_WB.translation().tolist(), base_rpy=rpy.tolist()
    )
