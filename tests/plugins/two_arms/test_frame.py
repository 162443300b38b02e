"""Two arms that bring a frame of their target to a pose."""

import numpy as np
import pytest
from compared_runs import check
from numpy.testing import assert_allclose
from test_free_base import AWAY, CALM, STILL

from ffsm_drake import (
    Scenario,
    ScenarioError,
    free_floating,
    load_scenario,
    make_nominal_plant,
    override_scenario,
    simulate,
    simulate_many,
)
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture.supervisor import SupervisorPart
from ffsm_drake.plugins.two_arms.chain import ClosedChain
from ffsm_drake.scenario import HELD, WHOLE, Grip
from ffsm_drake.scenario.contacts import ALL_HANDS
from ffsm_drake.spacecraft.coordinates import position_error
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.reference import make_frame_motion, make_motion
from ffsm_drake.systems.setup import BlockSetup

FRAMES = ("debris::debris", "servicer::left_hand")
TASKS = ("pose", "position", "attitude")
DRIVEN = (["base_rotation", "base_position", "joints"], ["joints"], ["base_rotation", "joints"])
LAWS = ("task_time_delay", "tdc", "resolved_rate", "task_computed_torque")
TRUTH = {"mass": 100.0, "inertia": [16.7, 16.7, 16.7]}


def drawn(seed: int, **changes: object) -> Scenario:
    """A frame, task, base and law; every fourth with a hand that closes later."""
    generator = np.random.default_rng(seed)
    is_late, task = seed % 4 == 3, TASKS[seed % 3]
    way, turn = generator.uniform(-0.05, 0.05, 3), generator.uniform(-0.05, 0.05, 3)
    start = make_nominal_plant(load_scenario("two_arms"))
    frame, q = FRAMES[seed % 2], np.zeros(start.plant.num_positions())
    joints = load_scenario("two_arms").initial_posture.joints
    q[0], q[7:] = 1.0, [joints[name] for name in start.coordinates.joints]
    start.plant.SetPositions(start.context, q)
    pose = start.plant.GetFrameByName(frame.partition("::")[2]).CalcPoseInWorld(start.context)
    goal: dict[str, object] = {"frame": frame, "task": task}
    if task != "attitude":
        goal["position"] = (pose.translation() + way).tolist()
    if task != "position":
        goal["rpy"] = (pose.rotation().ToRollPitchYaw().vector() + turn).tolist()
    given = {
        "actuation": {"driven": DRIVEN[0 if is_late else seed % 3]},
        "controller": LAWS[seed % len(LAWS)],
        "initial_posture": {**STILL, "joints": AWAY if is_late else {}},
        "target_posture": STILL,
        "reference": {"duration": 2.5, "frame": goal},
        "contacts": {"right": {"closes": 1.0 * is_late}},
        "disturbance": {"amplitude_scale": 0.0},
        "payload": {"nominal": TRUTH},
        "duration": 3.5,
        "random_seed": seed,
    }
    return load_scenario("two_arms", [given]).replace(**changes)


@pytest.mark.parametrize("seed", range(4))
def test_the_frame_arrives_and_the_chain_stays_closed(seed: int) -> None:
    run = simulate(drawn(seed), check_stability=False)
    assert run.outcome.status == "completed"
    assert max(run.metrics["frame"]["final"].values()) < 1e-3
    assert run.metrics["contacts"]["gap"] < 1e-9


@pytest.mark.parametrize("seed", range(6))
def test_the_motion_is_that_of_the_frame_and_of_a_closed_chain(seed: int) -> None:
    """The frame is on its path, velocities are derivatives, and no force acts on a free base."""
    scenario = drawn(seed)
    mission = Mission(scenario)
    motion, model = make_motion(mission), mission.craft.nominal()
    assert motion.remarks() == []
    path = make_frame_motion(mission, model, motion)
    assert path is not None
    frame, h = scenario.reference.frame.frame, 1e-4
    rows = {"pose": slice(7), "position": slice(4, 7), "attitude": slice(4)}[TASKS[seed % 3]]
    undriven = ~model.coordinates.is_driven
    for time in np.random.default_rng(seed).uniform(0.1, 2.4, 5):
        q, v, a = motion.evaluate(np.array([time - h, time, time + h]))
        wanted = path.rows(np.array([time]))[0, rows]
        actual = model.calc_frame_pose(q[1], frame)[rows]
        assert min(np.abs(actual - wanted).max(), np.abs(actual + wanted).max()) < 1e-6
        assert np.abs((q[2] - q[0])[4:] / (2 * h) - v[1, 3:]).max() < 1e-6
        assert np.abs((v[2] - v[0]) / (2 * h) - a[1]).max() < 1e-5
        assert np.abs(model.calc_inverse_dynamics(q[1], v[1], a[1])[undriven]).max(initial=0) < 1e-6


def late(seed: int) -> Scenario:
    """A hand that closes later, on a base that its arm moves; every other one tumbles."""
    generator = np.random.default_rng(seed)
    changes = {
        "actuation": {"driven": DRIVEN[1 + seed // 2 % 2]},
        "contacts": {"right": {"closes": round(generator.uniform(0.6, 2.0), 2)}},
        "controller": LAWS[seed % len(LAWS)],
        "disturbance": {"harmonics": CALM},
    }
    if seed % 2:
        changes["capture"] = {"rate": generator.uniform(-0.02, 0.02, 3).tolist()}
    return override_scenario(drawn(4 * seed + 3), [changes])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_an_open_hand_meets_its_place_on_a_base_that_its_arm_moves(seed: int) -> None:
    """Momentum is constant, the loop closes without a jump, and the frame is on its path."""
    scenario = late(seed)
    mission, closes = Mission(scenario), scenario.contacts["right"].closes
    motion, model = make_motion(mission), mission.craft.nominal()
    path = make_frame_motion(mission, model, motion)
    assert path is not None
    times = np.sort([*np.linspace(0.0, scenario.duration, 101), closes - 1e-9, closes])
    q, v, a = motion.evaluate(times)
    floating, arms = free_floating(model, q, scenario.actuation.driven), v.copy()
    arms[:, :6] = 0.0
    rows = slice(3 * ("base_rotation" in scenario.actuation.driven), 6)
    moved = np.abs(floating.momentum(arms)[:, rows]).max()
    assert np.ptp(floating.momentum(v)[:, rows], axis=0).max() < 1e-9 * moved
    undriven = ~model.coordinates.is_driven
    for one in zip(q, v, a, strict=True):
        assert np.abs(model.calc_inverse_dynamics(*one)[undriven]).max() < 1e-9
    chain, k = ClosedChain(model, scenario, ALL_HANDS, true=False), np.searchsorted(times, closes)
    assert max(np.abs(chain.gap(each)).max() for each in q[k:]) < 1e-9
    for each, within in ((q, 1e-8), (v, 1e-8), (a, 1e-6)):
        assert_allclose(each[k], each[k - 1], atol=within)
    frame, task = scenario.reference.frame.frame, TASKS[(4 * seed + 3) % 3]
    wanted = {"pose": slice(6), "position": slice(3, 6), "attitude": slice(3)}[task]
    for place, row in zip(q, path.rows(times), strict=True):
        off = position_error(model.calc_frame_pose(place, frame), row[:7])
        assert np.abs(off[wanted]).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_an_open_hand_closes_on_a_base_that_its_arm_moves(seed: int) -> None:
    """On Drake and compiled alike."""
    for run in check([late(seed)]):
        assert run.outcome.status == "completed"
        assert run.metrics["contacts"]["gap"] < 1e-9
        assert max(run.metrics["frame"]["final"].values()) < 1e-3


def test_a_frame_of_the_arm_that_follows_is_refused() -> None:
    still = {"initial_posture": STILL, "target_posture": STILL}
    goal = "reference.frame={task: pose, frame: servicer::right_hand}"
    with pytest.raises(ScenarioError, match=r"is on the arm of contacts\.right") as caught:
        make_motion(Mission(load_scenario("two_arms", [still, goal])))
    assert "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_compiled_runs_are_those_of_drake(seed: int) -> None:
    check([drawn(seed, duration=1.5), drawn(seed + 12, duration=1.5)])


OPEN = {"left_1": 1.5, "left_2": 1.5, "left_4": 0.1, "right_1": 1.4, "right_2": 1.5, "right_4": 0.1}


def caught(seed: int, *overrides: object) -> Scenario:
    """A drawn frame of a tumbling target, after an approach with both hands open."""
    generator = np.random.default_rng(seed)
    posture = {"base_position": generator.uniform(-0.1, 0.1, 3).tolist(), "joints": OPEN}
    given = {
        "capture": {
            "rate": generator.uniform(-0.03, 0.03, 3).tolist(),
            "servicer": ("rest", "track_all")[seed % 2],
            "approach": {"duration": 3.0, "posture": posture},
        },
        "actuation": {"driven": ["all"]},
        "reference": {"duration": 4.0},
        "duration": 9.0,
    }
    return override_scenario(drawn(seed), [given, *overrides])


SUPERVISED = (
    {"joints": 40, "base_position": 20, "base_rotation": 20},
    {"reference": {"duration": 4.0}, "supervisor": {}},
)


def same(found: np.ndarray, wanted: np.ndarray, *, within: float) -> None:
    """Rows of a frame with equal poses and twists."""
    assert_allclose(position_error(found[:7], wanted[:7]), 0.0, atol=within)
    assert_allclose(found[7:13], wanted[7:13], atol=within)


@pytest.mark.parametrize("seed", range(4))
def test_the_frame_goes_on_from_where_an_approach_has_brought_it(seed: int) -> None:
    """Both hands bring it there, and its path begins with their velocity after the grasp."""
    scenario = caught(seed)
    mission = Mission(scenario)
    motion, model = make_motion(mission), mission.craft.nominal()
    path = make_frame_motion(mission, model, motion)
    assert path is not None
    frame, grasp = scenario.reference.frame.frame, scenario.grasp_time
    for time in (0.0, 0.5 * grasp, grasp - 1e-7, grasp):
        actual = model.calc_frame_motion(*motion.evaluate(time), frame)
        same(path.rows(np.array([time]))[0], actual, within=1e-9)
    ends = path.rows(np.array([grasp - 1e-7, grasp]))
    assert_allclose(position_error(ends[0, :7], ends[1, :7]), 0.0, atol=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_a_new_plan_takes_the_frame_from_its_measured_pose(seed: int) -> None:
    """Both hands carry it, or the first one while the second comes to its place."""
    generator = np.random.default_rng(seed)
    limits, supervised = SUPERVISED
    base = drawn(seed)
    driven = {name: limits[name] for name in base.actuation.driven}
    scenario = override_scenario(base, [supervised, {"actuation": {"limit": driven}}])
    mission = Mission(scenario)
    model, is_late = mission.craft.nominal(), seed % 4 == 3
    setup = BlockSetup(name="", mission=mission, nominal=model, settings={})
    supervisor = SupervisorPart().supervisor(setup)
    whole = ClosedChain(model, scenario, ALL_HANDS, true=False)
    q = configuration(model.coordinates, scenario.initial_posture, key="initial_posture")
    q = q if is_late else whole.closed(q)
    q[7:] += generator.uniform(-5e-3, 5e-3, q.size - 7)
    v, duration = generator.uniform(-5e-3, 5e-3, q.size - 1), generator.uniform(3.0, 8.0)
    motion, path = supervisor.motions(np.concatenate([[0.5, duration, 0.0, 0.0], q, v]))
    frame, task = scenario.reference.frame.frame, TASKS[seed % 3]
    same(path.rows(np.zeros(1))[0], model.calc_frame_motion(q, v, 0 * v, frame), within=1e-9)
    rows = {"pose": slice(7), "position": slice(4, 7), "attitude": slice(4)}[task]
    for time in generator.uniform(0.1, duration, 4):
        place, rate, _ = motion.evaluate(np.array([time]))
        actual, wanted = model.calc_frame_pose(place[0], frame), path.rows(np.array([time]))[0]
        off = np.abs(np.abs(actual[rows]) - np.abs(wanted[rows])).max()
        assert off < 1e-6
        if not is_late:
            assert np.abs(whole.gap(place[0])).max() < 1e-9
            assert np.abs(whole.jacobian(place[0]) @ rate[0]).max() < 1e-6
    assert not path.rows(np.array([duration]))[0, 7:].any()


@pytest.mark.parametrize("closes", [1.0, 2.0])
def test_each_phase_of_a_later_hand_has_the_path_of_the_whole_motion(closes: float) -> None:
    scenario = override_scenario(drawn(3), [f"contacts.right.closes={closes}"])
    mission = Mission(scenario)
    times = np.linspace(0.0, scenario.reference.duration, 7)
    paths = []
    for grip in (WHOLE, HELD, Grip(closed=closes)):
        made = make_frame_motion(mission, mission.craft.nominal(grip), make_motion(mission, grip))
        assert made is not None
        paths.append(made.rows(times))
    assert_allclose(paths[1], paths[0], atol=1e-12)
    assert_allclose(paths[2], paths[0], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_captures_and_supervised_missions_settle(seed: int) -> None:
    """With an approach or with a supervisor that damps, on Drake and compiled alike. A new plan is
    integrated from a state that differs by rounding, with a tolerance of 1e-9.
    """
    supervised = {
        "supervisor": {"saturated_time": 0.05},
        "actuation": {"limit": {"joints": 40, "base_position": 8, "base_rotation": 8}},
        "capture": {"approach": None, "rate": [0.06, 0.05, 0.06]},
        "duration": 25.0,
    }
    scenario = caught(seed, *([supervised] if seed % 2 else []))
    runs = [*simulate_many([scenario], engine="compiled"), *simulate_many([scenario])]
    assert runs[0].engine == "compiled"
    for name in ("position", "desired_position", "frame_error"):
        found, wanted = (run.dataset[name].values for run in runs)
        assert_allclose(found, wanted, atol=1e-6 if seed % 2 else 1e-10)
    for run in runs:
        assert run.outcome.status == "completed"
        assert run.metrics["contacts"]["gap"] < 1e-8
        assert max(run.metrics["frame"]["final"].values()) < 2e-3
        if seed % 2:
            assert run.metrics["supervisor"]["dampings"] > 0
