"""When and where a servicer meets a target again that it did not capture."""

import dataclasses
import math

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw

from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.plugins.capture.approach import approach_posture, is_gentle
from ffsm_drake.plugins.capture.contact import payload_body
from ffsm_drake.plugins.capture.grasping import Aim
from ffsm_drake.plugins.capture.phases.chase import Chase
from ffsm_drake.plugins.capture.phases.moves import Move
from ffsm_drake.runs.limits import closest_of
from ffsm_drake.runs.phases import Situation
from ffsm_drake.scenario import EMPTY, Posture, Scenario
from ffsm_drake.spacecraft.nominal import make_nominal_plant
from ffsm_drake.spacecraft.plant import base_body, configuration
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_motion

_EVERY = 0.5  # s; between the instants at which a further try may meet the target
_LENGTH = 2.0  # m; a turn of the base by 1 rad counts as this way
_CANDIDATES = 30  # meetings looked at, those with the shortest ways
INSTANTS = 15  # at which the clearance of each is looked at


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
    X_BP = _target_from_base(chosen)
    X_BS = _base_pose(chosen.initial_posture).inverse() @ _base_pose(approach_posture(chosen))
    X_W0 = _base_pose(start)
    candidates = []
    for sample in range(earliest, latest + 1, max(1, round(_EVERY / period))):
        motion = chase.known.motion[sample]
        X_WB = RigidTransform(Quaternion(motion[:4]), motion[4:7]) @ X_BP.inverse()
        X_0S = X_W0.inverse() @ X_WB @ X_BS
        way = np.linalg.norm(X_0S.translation())
        candidates.append((way + _LENGTH * X_0S.rotation().ToAngleAxis().angle(), sample, X_WB))
    coordinates = now.stage.coordinates
    for _, sample, X_WB in sorted(candidates, key=lambda each: each[0])[:_CANDIDATES]:
        scenario = _try(chase, X_WB, X_WB @ X_BS, chase.known.motion[sample])
        begin = sample - chase.approach
        move = Move(
            begin=first * period,
            duration=(begin - first) * period,
            start=start,
            goal=approach_posture(scenario),
        )
        motion, margin = move.motion(scenario, coordinates), approach.margin
        samples = np.linspace(first, begin, INSTANTS)
        if (
            is_gentle(scenario, motion)
            and is_clear(now, motion, samples, first, margin=margin)
            and is_clear(
                now,
                make_motion(scenario, coordinates, EMPTY),
                np.linspace(begin, sample - chase.closing, INSTANTS),
                begin,
                margin=margin,
            )
        ):
            return Aim(scenario, sample), move
    return None


def is_clear(
    now: Situation, motion: PlannedMotion, samples: np.ndarray, first: int, *, margin: float = 0.0
) -> bool:
    """Whether a motion that begins at a sample keeps the scenario's clearance, and a margin (m)
    beyond it, at others.
    """
    chase: Chase = now.own
    assert chase.known is not None
    samples, scenario = samples.round().astype(int), chase.scenario
    times = (samples - first) * scenario.sample_time
    q = motion.rows(times)[:, : len(now.stage.coordinates.position_names)]
    nearest = closest_of(scenario, times, q, target=chase.known.motion[samples, :7])
    return all(each.keeps(scenario.clearance + margin) for each in nearest)


def _target_from_base(scenario: Scenario) -> RigidTransform:
    """X_BP of the target's frame in the base's, where the arm is to meet it."""
    model = make_nominal_plant(scenario)
    q = configuration(model.plant, scenario.initial_posture, key="initial_posture")
    model.plant.SetPositions(model.context, q)
    body = payload_body(scenario, model).body_frame()
    return RigidTransform(body.CalcPose(model.context, base_body(model.plant).body_frame()))


def _try(chase: Chase, X_WB: RigidTransform, X_WS: RigidTransform, motion: np.ndarray) -> Scenario:
    """The scenario of a further try, with the base at X_WS where its approach begins, at X_WB where
    it ends, and the target then in a motion (13).
    """
    chosen, approach = chase.scenario, chase.scenario.approach
    assert approach is not None
    w, v_P = np.split(motion[7:], 2)
    # ``capture.velocity`` refers to the true centre of mass; used only to recover v_P
    arm = matrix_of(motion[:4]) @ chase.arm
    posture = _placed(approach_posture(chosen), X_WS)
    capture = dataclasses.replace(
        chase.capture,
        axes="world",
        rate=w.tolist(),
        velocity=(v_P + np.cross(w, arm)).tolist(),
        approach=dataclasses.replace(approach, posture=posture, start="given"),
    )
    posture = _placed(chosen.initial_posture, X_WB)
    blocks = dataclasses.replace(chosen.blocks, phases={})
    return dataclasses.replace(
        chosen, initial_posture=posture, capture=capture, blocks=blocks, phases=[]
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
