"""The stop with the target in the gripper."""

import dataclasses
from typing import Any

import numpy as np

from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture.approach import given_approach
from ffsm_drake.plugins.capture.contact import payload_body
from ffsm_drake.plugins.capture.grasping import Aim, Meeting, target_at
from ffsm_drake.plugins.capture.phases.chase import Chase, phase_of, replaced
from ffsm_drake.plugins.capture.postures import posture_of
from ffsm_drake.runs.exceeded_limits import closest_of
from ffsm_drake.runs.phases import Phase, Situation, Stop
from ffsm_drake.runs.stage import Stage
from ffsm_drake.scenario import HELD
from ffsm_drake.spacecraft.coordinates import halves
from ffsm_drake.spacecraft.limits import FORCE
from ffsm_drake.systems.mission_limits import actuation_limit
from ffsm_drake.systems.reference import make_motion

_CONTACTS = "forces.contacts"
_PACES = (1.0, 0.87, 1.15, 0.76, 1.32, 0.66, 1.52, 0.57, 0.5)  # tried, times a stop's
_INSTANTS = 30  # of a stop, at which clearance and force are looked at


class Held(Stop):
    """The target is grasped, and stopped."""

    def plan(self, now: Situation) -> tuple[Phase | None, Situation]:
        """After a gripper that closes in time the stop is planned from the measured state."""
        end = None if self.until is None else now.sample + self.until
        if now.own is None or not now.own.closing:
            return Phase(names=(("stop", end),), grip=HELD), now
        if end is not None:  # a later try leaves less time
            end = min(end, now.own.scenario.num_control_periods)
        now = replaced(now, aim=Aim(_at_rest_in_gripper(now), sample=now.sample))
        how: Any = {"follows": False, "sees": False, "afresh": ("controller",)}
        return phase_of(now, ("stop", end), grip=HELD, **how), now

    def enter(self, now: Situation, phase: Phase, stage: Stage) -> Situation:
        """Grasp the target; the run continues from the state after the grasp."""
        if now.sample == 0:
            return now
        chase: Chase = now.own
        target = target_at(chase.path[now.sample]) if chase.closing else chase.aim.target
        meeting = Meeting.of(chase.scenario, target, now.stage)
        made = meeting.grasp(chase.aim.mission.scenario, stage.model(), chase.path[: now.sample])
        assert made.contact is not None
        state = np.concatenate([meeting.q, made.contact.grasp.velocity])
        if _CONTACTS in stage.blocks:
            stage.exchange(_CONTACTS, stage.block(_CONTACTS).met(state))
        stage.place(state)
        stage.resume(now.stage, chase.aim.reference, afresh=phase.afresh)
        # to the blocks, which resume with nothing in the gripper
        stage.carry(made.payload)
        return dataclasses.replace(now, made=made)


def _at_rest_in_gripper(now: Situation) -> Mission:
    """The mission of a stop with the target at rest in the gripper, in the measured state."""
    chase: Chase = now.own
    mission = chase.aim.mission
    scenario, model = mission.scenario, mission.craft.nominal()
    q, v = halves(now.stage.measured)
    body = payload_body(scenario, model)
    w, v_P = np.split(model.calc_jacobian(q, body.body_frame()) @ v, 2)
    arm = body.EvalPoseInWorld(model.context).rotation() @ chase.arm
    capture = chase.capture_of(
        w,
        v_P,
        arm,
        servicer="given",
        servicer_velocity=model.coordinates.by_name(v),
        approach=given_approach(mission),
    )
    posture = posture_of(q, model.coordinates)
    return _with_clear_stop(mission.flown_by(initial_posture=posture, capture=capture))


def _with_clear_stop(mission: Mission) -> Mission:
    """The mission with a stop that keeps clear (a slow stop of a tumbling target swings far).

    Its duration is the nearest to ``reference.duration`` with a plan within clearance and limits of
    force; the mission's own without one.
    """
    scenario, coordinates = mission.scenario, mission.craft.coordinates
    duration = scenario.reference.duration
    if duration is None or scenario.reference.kind == "optimal":
        return mission
    model = mission.craft.nominal()
    limit = actuation_limit(scenario, coordinates, helped=True).upper
    for factor in _PACES:
        reference = dataclasses.replace(scenario.reference, duration=factor * duration)
        paced = mission.flown_by(reference=reference)
        motion = make_motion(paced)
        if motion.end > scenario.duration:
            continue
        times = np.linspace(motion.begin, motion.end, _INSTANTS)
        force, (q, _, _) = motion.demand(model, times)[FORCE], motion.evaluate(times)
        if (np.abs(force) <= limit).all() and all(
            each.keeps(scenario.clearance) for each in closest_of(scenario, times, q)
        ):
            return paced
    return mission
