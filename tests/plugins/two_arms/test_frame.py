"""Two arms that bring a frame of their target to a pose."""

import numpy as np
import pytest
from compared_runs import check
from test_free_base import AWAY, STILL

from ffsm_drake import Scenario, ScenarioError, load_scenario, make_nominal_plant, simulate
from ffsm_drake.mission import Mission
from ffsm_drake.systems.reference import make_frame_motion, make_motion

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


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["reference.frame.frame=servicer::right_hand"], "is on the arm of contacts.right"),
        (["contacts.right.closes=1", "actuation.driven=[joints]"], "right.closes: with reference"),
    ],
)
def test_refusals_are_one_line(overrides: list[str], words: str) -> None:
    still = {"initial_posture": STILL, "target_posture": STILL}
    given = load_scenario("two_arms", [still, "reference.frame={task: pose}", *overrides])
    with pytest.raises(ScenarioError, match=words) as caught:
        make_motion(Mission(given))
    assert "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_compiled_runs_are_those_of_drake(seed: int) -> None:
    check([drawn(seed, duration=1.5), drawn(seed + 12, duration=1.5)])
