"""A frame whose pose is prescribed, in missions with an approach, a measured target or a
supervisor: where its path begins, and runs that settle.
"""

import functools

import numpy as np
import pytest
from c_code import needs_llvm
from compared_runs import check
from entry_points import needs
from numpy.testing import assert_allclose
from pydrake.systems.framework import LeafSystem

from ffsm_drake import Scenario, load_scenario, make_rollout
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture.modes import Mode
from ffsm_drake.plugins.capture.supervisor import SupervisorPart
from ffsm_drake.scenario import EMPTY
from ffsm_drake.spacecraft.coordinates import position_error
from ffsm_drake.systems.frame_path import goal_frame
from ffsm_drake.systems.reference import make_frame_motion, make_motion
from ffsm_drake.systems.setup import BlockSetup

TASKS = {"position": slice(4, 7), "attitude": slice(4), "none": slice(0)}
LAWS = ("task_time_delay", "tdc", "task_time_delay", "tde_aismc", "asmc")
SERVICERS = ("rest", "track_joints", "track_all")


def drawn(seed: int, *overrides: object) -> Scenario:
    """A tumbling target that an arm approaches; every third is measured. The hand comes to rest,
    or to a place or an attitude nearby.
    """
    random = np.random.default_rng(seed)
    capture = {
        "rate": random.uniform(-0.04, 0.04, 3).tolist(),
        "servicer": SERVICERS[seed % 3],
        "approach": {
            "duration": random.integers(8, 14).item(),
            "posture": {"base_position": random.uniform(-0.15, 0.15, 3).tolist()},
        },
    }
    if seed % 3 == 2:
        capture |= {"closing": {}, "measured": {"last": 2.0}}
    goal = ("stop", "target_posture")[seed % 2]
    given = {
        "capture": capture,
        "controller": LAWS[seed % len(LAWS)],
        "reference": {
            "goal": goal,
            "duration": 10.0,
            "frame": {"task": ("position", "attitude")[seed // 2 % 2]},
        },
        "duration": capture["approach"]["duration"] + 14.0,
        "random_seed": seed,
    }
    return load_scenario("tumbling_capture", [given, *overrides])


def same(found: np.ndarray, wanted: np.ndarray, *, within: float) -> None:
    """Rows of a frame with equal poses and twists."""
    for one, other in zip(np.atleast_2d(found), np.atleast_2d(wanted), strict=True):
        assert_allclose(position_error(one[:7], other[:7]), 0.0, atol=within)
        assert_allclose(one[7:13], other[7:13], atol=within)


@pytest.mark.parametrize("seed", range(6))
def test_the_frame_goes_on_from_where_the_arm_has_brought_it(seed: int) -> None:
    """Before the grasp the coordinates move it. Its path begins there with their velocity."""
    mission = Mission(drawn(seed))
    scenario, model = mission.scenario, mission.craft.nominal()
    motion = make_motion(mission)
    path = make_frame_motion(mission, model, motion)
    assert path is not None
    frame, grasp = goal_frame(scenario, model.plant), scenario.grasp_time
    before = np.append(np.random.default_rng(seed).uniform(0.0, grasp, 5), grasp - 1e-7)
    same(path.rows(before), model.calc_frame_motion(*motion.evaluate(before), frame), within=1e-12)
    alone = make_motion(mission, EMPTY)
    own = make_frame_motion(mission, mission.craft.nominal(EMPTY), alone)
    same(path.rows(before), own.rows(before), within=1e-12)
    at_grasp = np.array([grasp])
    first = model.calc_frame_motion(*motion.evaluate(at_grasp), frame)
    same(path.rows(at_grasp), first, within=1e-9)
    assert_allclose(path.rows(before)[-1, :7], first[0, :7], atol=1e-6)
    last = path.rows(np.array([motion.end]))
    assert not last[0, 7:].any()
    if not motion.remarks():
        after = np.random.default_rng(seed).uniform(grasp, motion.end, 5)
        actual, wanted = model.calc_frame_motion(*motion.evaluate(after), frame), path.rows(after)
        rows = TASKS[scenario.reference.frame.task]
        for sign_of, rest in zip(actual[:, rows], wanted[:, rows], strict=True):
            assert min(np.abs(sign_of - rest).max(), np.abs(sign_of + rest).max()) < 1e-6


@pytest.mark.parametrize("seed", range(6))
def test_a_new_plan_takes_the_frame_from_its_measured_pose(seed: int) -> None:
    """After the grasp along a path to the goal; a retreat moves it with the coordinates."""
    random = np.random.default_rng(seed)
    place = {"reference": {"goal": "target_posture", "frame": {"position": [1.2, 0.3, 1.3]}}}
    is_placed = seed % 4 == 1
    given = drawn(seed, "supervisor={}", *([place] if is_placed else []))
    mission = Mission(given)
    model = mission.craft.nominal()
    setup = BlockSetup(name="", mission=mission, nominal=model, settings={})
    supervisor, frame = SupervisorPart().supervisor(setup), goal_frame(given, model.plant)
    q, v, _ = make_motion(mission).evaluate(given.grasp_time + 1.0)
    q[4:] += random.uniform(-0.02, 0.02, q.size - 4)
    v += random.uniform(-0.02, 0.02, v.size)
    duration = random.uniform(4.0, 12.0)
    for retreats in (0.0, 1.0):
        plan = np.concatenate([[given.grasp_time + 1.0, duration, retreats, 0.0], q, v])
        motion, path = supervisor.motions(plan)
        times = np.append([0.0], random.uniform(0.0, duration, 4))
        actual, wanted = model.calc_frame_motion(*motion.evaluate(times), frame), path.rows(times)
        same(wanted[0], model.calc_frame_motion(q, v, 0.0 * v, frame), within=1e-9)
        if retreats:
            same(wanted, actual, within=1e-12)
        elif not motion.remarks():
            rows = TASKS[given.reference.frame.task]
            assert_allclose(np.abs(actual[:, rows]), np.abs(wanted[:, rows]), atol=1e-6)
        last = path.rows(np.array([duration]))[0]
        assert not last[7:].any()
        if is_placed and not retreats:
            assert_allclose(last[4:7], given.reference.frame.position, atol=1e-12)


class Asking(LeafSystem):
    """A force of nothing that asks for an abort at a time."""

    def __init__(self, setup, begin):
        super().__init__()
        zeros = np.zeros(len(setup.coordinates.names))
        self.DeclareVectorOutputPort(
            "generalized_force", zeros.size, lambda context, output: output.SetFromVector(zeros)
        )
        self.DeclareVectorOutputPort(
            "abort_request",
            1,
            lambda context, output: output.SetAtIndex(0, float(context.get_time() > begin - 0.005)),
            {self.time_ticket()},
        )


def test_in_rate_damping_the_frame_is_held_and_then_goes_on() -> None:
    """Its reference is the measured pose, up to the new plan, which begins there."""
    given = {
        "capture": {"rate": [0.05, 0.04, 0.05], "servicer": "rest"},
        "controller": "task_time_delay",
        "reference": {"base_rotation": "eigenaxis", "frame": {"task": "position"}},
        "supervisor": {},
        "actuation": {"limit": {"joints": 20, "base_rotation": 30, "base_position": 30}},
        "duration": 3.0,
    }
    scenario = load_scenario("postcapture", [given])
    asking = {"forces.asking": functools.partial(Asking, begin=0.5)}
    log = make_rollout(scenario, blocks=asking).run()
    modes, desired = log.series["mode"].ravel(), log.series["desired_frame"]
    assert [*dict.fromkeys(modes)] == [Mode.STOP, Mode.RATE_DAMPING]
    anew = modes.size - 1 - int(np.argmax(modes[::-1] == Mode.RATE_DAMPING))
    model, damped = log.model, np.flatnonzero(modes == Mode.RATE_DAMPING)
    assert 20 < damped.size < modes.size - 60
    assert anew < modes.size - 60
    assert modes[anew + 1] == Mode.STOP
    q, v = np.split(log.series["measurement"], [len(log.coordinates.position_names)], axis=1)
    frame = goal_frame(scenario, model.plant)
    for k in damped[:-1]:
        wanted = model.calc_frame_motion(q[k], v[k], 0.0 * v[k], frame)
        same(desired[k + 1], wanted, within=1e-9)
    step = np.abs(np.diff(log.frame_error[anew - 1 :, 3:], axis=0)).max()
    assert step < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_drawn_missions_settle(seed: int) -> None:
    """On the way, the reference of the frame jumps only to a measured pose, at the grasp."""
    log = make_rollout(drawn(seed)).run()
    assert log.ending.is_settled, log.ending.sentence
    place, rate = log.series["desired_frame"][:, 4:7], log.series["desired_frame"][:, 10:13]
    ahead = 0.5 * log.scenario.sample_time * (rate[1:] + rate[:-1])
    jump = np.abs(np.diff(place, axis=0) - ahead).max(axis=1)
    assert log.grasp is not None
    assert np.delete(jump, log.grasp.sample - 1).max() < 1e-5
    assert jump.max() < (0.02 if log.scenario.measured else 1e-3)


@pytest.mark.slow
@needs("compiled")
@needs_llvm
@pytest.mark.parametrize("seed", range(4))
def test_compiled_runs_are_those_of_drake(seed: int) -> None:
    """Of an approach, a measured target and a supervisor that damps."""
    pytest.importorskip("ffsm_drake.plugins.compiled")
    fast = {"capture": {"rate": [0.2, 0.17, 0.22], "approach": None}, "duration": 5.0}
    if seed < 3:
        short = {"capture": {"approach": {"duration": 5.0}}, "duration": 7.0}
        check([drawn(seed, short)])
    else:
        check([drawn(3, fast, "supervisor={saturated_time: 0.2}")])
