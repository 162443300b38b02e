"""Plans that end at the pose of a frame, with every base that a plan may have, and runs of them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from c_code import needs_llvm
from compared_runs import check
from entry_points import needs
from numpy.testing import assert_allclose

from ffsm_drake import (
    ModelError,
    Scenario,
    ScenarioError,
    load_scenario,
    make_nominal_plant,
    simulate,
)
from ffsm_drake.plugins.planning.curve import Curve
from ffsm_drake.plugins.planning.frame_end import END, FrameEnd
from ffsm_drake.plugins.planning.planned_report import PlannedMotionReport
from ffsm_drake.plugins.planning.planner import PlanningError, _Planner, plan_motion

NAME, FRAME = "planar_detumble", "servicer::end_effector"
REST = (
    "initial_velocity=0",
    "reference.kind=quintic",
    "reference.goal=target_posture",
    "reference.duration=8",
    "planning.end_rate=0",
    "planning.segments=4",
)
DRIVEN = ("all", "[base_rotation, joints]", "[joints]")
LAWS = ("tdc", "computed_torque", "task_computed_torque", "resolved_rate", "task_time_delay")


def drawn(seed: int, driven: str = "all", *overrides: str) -> Scenario:
    """A mission that moves the hand in the plane of its arm."""
    generator = np.random.default_rng(seed)
    x, z = generator.uniform([0.1, 2.25], [0.35, 2.45])
    joints = "{joint_1: -0.6, joint_2: 1.0, joint_3: 0.6}"
    goal = f"{{task: position, position: [{x}, 0.0, {z}]}}"
    base = [] if driven == "all" else [f"actuation.driven={driven}"]
    given = [*base, f"reference.frame={goal}", f"target_posture.joints={joints}", *overrides]
    return load_scenario(NAME, [*REST, *given])


def still(driven: str) -> dict[str, Any]:
    """Overrides of a base that actuators move, only turn, or do not move."""
    if driven == "all":
        return {}
    place = {"base_rpy": [0, 0, 0], "base_position": [0, 0, 0]}
    names = driven.strip("[]").split(", ")
    return {"actuation": {"driven": names}, "initial_posture": place, "target_posture": place}


def flown(scenario: Scenario, file: Path, law: str) -> Scenario:
    plan = {"kind": "optimal", "plan": str(file)}
    gains = {"task_time_delay": {"k_p_position": 9.0, "k_d_position": 6.0}}
    return scenario.replace(reference=plan, controller=law, controllers=gains, duration=10.0)


def end_of(scenario: Scenario) -> tuple[FrameEnd, Curve, np.ndarray]:
    """The end of a plan, its curve, and where that starts."""
    planner = _Planner(scenario, lambda line: None, np.inf)
    program = planner._problem()
    assert planner._ends.frame is not None
    return planner._ends.frame, program.curve, planner._ends.start


@pytest.mark.parametrize("driven", DRIVEN)
@pytest.mark.parametrize(("arms", "seed"), [(1, 0), (1, 1), (2, 0)])
def test_the_distance_of_the_frame_has_exact_derivatives(driven: str, arms: int, seed: int) -> None:
    """Of drawn curves that move, with a drift of the centre of mass."""
    if arms == 2:
        pose = "{frame: 'debris::debris', position: [0.2, 0.7, 1.9], rpy: [0.1, 0.2, 0.0]}"
        given = ["planning.segments=4", f"reference.frame={pose}", still(driven)]
        scenario = load_scenario("two_arms", given)
    else:
        drift = "initial_velocity={base_position: 0.01}"
        scenario = drawn(seed, driven, drift, "reference.frame={rpy: [0.1, 0.8, 0.2]}")
    (end, curve, first), generator = end_of(scenario), np.random.default_rng(seed)
    start = np.tile(first, (curve.count, 1))
    x = np.r_[(start + generator.normal(0.0, 0.05, start.shape)).ravel(), 6.0, np.zeros(4)]
    q, slope = end._end(curve, x)
    way, step = generator.normal(size=x.size) * 0.1, 1e-5
    ends = [end._end(curve, x + sign * step * way)[0] for sign in (1.0, -1.0)]
    _, by = end.distance(curve, x)
    sides = [end.distance(curve, x + sign * step * way)[0] for sign in (1.0, -1.0)]
    assert_allclose(by @ way, (sides[0] - sides[1]) / (2.0 * step), rtol=1e-6, atol=1e-7)
    assert np.abs(by @ way).max() > 1e-3
    assert_allclose((slope @ way)[3:], ((ends[0] - ends[1]) / (2.0 * step))[4:], atol=1e-7)
    end.learn(curve, x, exact := q + np.r_[np.zeros(4), generator.normal(0.0, 0.01, q.size - 4)])
    off = end.off(exact)
    assert_allclose(np.linalg.norm(end.distance(curve, x)[0][3:]), np.linalg.norm(off[3:]))


@pytest.fixture(scope="module", params=DRIVEN)
def planned(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Scenario, PlannedMotionReport, list[Scenario]]:
    """A drawn mission, its plan, and missions along it with a law on joints or on the frame."""
    seed, file = DRIVEN.index(request.param), tmp_path_factory.mktemp("plans") / "plan.yaml"
    scenario = drawn(seed, request.param)
    found = plan_motion(scenario)
    found.plan.save(file, title="of a frame")
    return scenario, found, [flown(scenario, file, law) for law in (LAWS[seed % 2], LAWS[2 + seed])]


@pytest.mark.slow
def test_a_plan_brings_a_frame_to_its_pose_and_laws_hold_it_there(
    planned: tuple[Scenario, PlannedMotionReport, list[Scenario]],
) -> None:
    scenario, found, missions = planned
    assert not found.exceeded
    assert found.plan.duration < 8.0
    assert scenario.reference.frame is not None
    pose = make_nominal_plant(scenario).calc_frame_pose(found.rows[-1, :10], FRAME)
    assert_allclose(pose[4:], scenario.reference.frame.position, atol=END)
    for mission in missions:
        run = simulate(mission, check_stability=False)
        assert run.ending.is_settled
        assert run.metrics["frame"]["final"]["position"] < 1e-4
        assert run.dataset.frame_prescribed.values.tolist() == [False] * 3 + [True] * 3


@needs("compiled")
@needs_llvm
@pytest.mark.slow
def test_both_engines_fly_the_plan_of_a_frame(
    planned: tuple[Scenario, PlannedMotionReport, list[Scenario]],
) -> None:
    check(planned[2])


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["reference.frame.joints=target_posture"], r"reference\.frame\.joints: has no effect"),
        (["actuation.driven=[joints]", "reference.frame.hold=[base_rotation]"],
         r"reference\.frame\.hold: has no effect"),
        (["reference.frame.frame=servicer::nothing"], r"no frame 'servicer::nothing'"),
        pytest.param(
            ["reference.frame.position=[9, 0, 9]"],
            r"active limit: servicer::end_effector: end position", marks=pytest.mark.slow,
        ),
    ],
)  # fmt: skip
def test_what_a_plan_of_a_frame_cannot_do_is_named(overrides: list[str], words: str) -> None:
    with pytest.raises((ScenarioError, ModelError, PlanningError), match=words):
        plan_motion(drawn(0, "all", *overrides), time_limit=2.0)


def test_a_goal_without_a_pose_leaves_the_end_to_the_posture_or_to_the_cost() -> None:
    for overrides, is_posture in (
        (["reference.goal=stop"], False),
        (["reference.frame.task=none"], True),
    ):
        planner = _Planner(
            drawn(0, "all", "reference.frame.position=null", *overrides), lambda line: None, np.inf
        )
        assert planner._ends.frame is None
        assert (planner._ends.posture is not None) == is_posture
