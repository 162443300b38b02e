"""The phases of a run with a capture.

In its phases the servicer is without the target up to the grasp, then with the target. At the grasp
the states of sensors, actuators and forces are kept, the law resumes (``ControlLaw.resume``), and
the velocity of the servicer jumps. The gripper holds the target at the pose at which it meets it,
so the position error of the arm becomes part of the mass properties of the payload.
"""

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np

from ffsm_drake.loop.blocks import GRIPPER
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture.closing import MOTION
from ffsm_drake.plugins.capture.grasping import Aim, MadeGrasp, grasped_at_start, with_grasp
from ffsm_drake.plugins.capture.phases.approach import Approach
from ffsm_drake.plugins.capture.phases.chase import Chase
from ffsm_drake.plugins.capture.phases.close import Close, free_motion
from ffsm_drake.plugins.capture.phases.held import Held
from ffsm_drake.plugins.capture.phases.own import phases_before
from ffsm_drake.plugins.capture.phases.retreat import Again, Retreat
from ffsm_drake.plugins.capture.pictures import show_apart
from ffsm_drake.plugins.capture.target_filter import Path
from ffsm_drake.plugins.capture.tracked_target import drawn_path
from ffsm_drake.runs.log import GraspLog, RunLog
from ffsm_drake.runs.phases import Phase, PhaseKind, Phases, Show, Situation
from ffsm_drake.systems.registry import Factory


def view_of_target(mission: Mission) -> Show:
    """Return what shows the spacecraft, and the target apart."""
    return functools.partial(show_apart, Aim(mission).path[:, :7])


def phases_of_capture(mission: Mission, before: Phases) -> Phases:
    """Return the phases of a capture, and what follows a target that was not captured."""
    scenario = mission.scenario
    if scenario.grasp_time == 0.0:
        return Phases(kinds={"": Held()}, finish=lambda log, now: grasped_at_start(log))
    chase = _chase(mission)
    kinds: dict[str, PhaseKind] = {**_up_to(chase.aim.sample - chase.closing, mission)}
    if scenario.closing is None:
        kinds["met"] = Held()
    else:
        kinds |= {"met": Close(scenario.closing), "held": Held()}
        if retreat := chase.capture.retreat:
            kinds |= dict.fromkeys(("missed", "bounced", "slipped"), Retreat(retreat))
            kinds["seen"] = Again(retreat)
    return Phases(kinds=kinds, own=chase, finish=_with_target)


def _up_to(contact: int, mission: Mission) -> Mapping[str, Approach]:
    """The scenario's own phases and the approach, up to the sample of the contact: neighbours
    with the same blocks share a loop.
    """
    scenario = mission.scenario
    found, before, end = list[Approach](), dict[str, Factory](), 0.0
    for name, phase in {**phases_before(mission), "approach": Phase()}.items():
        own = dict(phase.blocks)
        last = contact
        if name != "approach":
            end += scenario.blocks.phases[name].duration
            last = round(end / scenario.sample_time)
        if found and own == before:
            names = (*found[-1].names, (name, last))
            found[-1] = dataclasses.replace(found[-1], names=names)
        else:
            afresh = tuple({**own, **before})
            found.append(Approach(names=((name, last),), blocks=own, afresh=afresh))
        before = own
    return {
        str(index or ""): each
        if index == len(found) - 1
        else dataclasses.replace(each, then=str(index + 1))
        for index, each in enumerate(found)
    }


def _chase(mission: Mission) -> Chase:
    """What a capture with an approach begins with."""
    scenario, aim = mission.scenario, Aim(mission)
    if scenario.closing is None:
        return Chase(mission=mission, aim=aim, path=aim.path)
    last = aim.sample - 1
    path = np.vstack([aim.path[:last], free_motion(scenario, aim.path[last], last)])
    measured, expected = scenario.measured, None
    body = scenario.payload.nominal if measured else scenario.payload.truth
    known = Path(motion=path, arm=np.array(body.center_of_mass))
    place = np.array(scenario.initial_posture.base_position)  # at the grasp
    if measured:
        motion, expected = drawn_path(scenario, measured.filter, path[0])
        path = free_motion(scenario, motion, 0)
    return Chase(
        mission=mission,
        aim=aim,
        path=path,
        known=known,
        expected=expected,
        reach=float(np.linalg.norm(place - known.center(aim.sample))),
    )


def _with_target(log: RunLog, now: Situation) -> RunLog:
    """The log with the target, and the external force on servicer and target together."""
    series = dict(log.series)
    held_from = log.time.size if now.made is None else now.made.sample
    contact = series.pop(f"force_{GRIPPER.partition('.')[2]}", None)
    if contact is not None:
        # of a hand that closes later it is a force between parts of the stack
        between = np.where(np.arange(len(contact))[:, None] < held_from, 0.0, contact)
        series["disturbance_force"] = series["disturbance_force"] - contact + between
        if "force_contacts" in series:
            series["force_contacts"] = series["force_contacts"] + between
    target = now.own.path[: log.time.size]
    if (moved := series.pop(MOTION, None)) is not None:  # by the gripper
        target = np.where(np.isnan(moved), target, moved)
    log = dataclasses.replace(log, series=series)
    if isinstance(now.made, MadeGrasp):
        log = with_grasp(log, now.made)
    else:
        grasp = GraspLog(
            sample=log.time.size,
            payload=now.own.scenario.payload.truth,
            target=target,
        )
        log = dataclasses.replace(log, grasp=grasp)
    assert log.grasp is not None
    legs = now.legs(log.grasp.sample)
    return dataclasses.replace(log, grasp=dataclasses.replace(log.grasp, legs=legs))
