"""Plans for two arms that hold one target, on a base that no actuator moves, or only turns."""

from pathlib import Path

import numpy as np
import pytest
from c_code import needs_llvm
from compared_runs import check
from entry_points import needs
from numpy.testing import assert_allclose

from ffsm_drake import (
    Scenario,
    ScenarioError,
    free_floating,
    load_scenario,
    make_nominal_plant,
    simulate,
)
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.planning.planner import _Planner, plan_motion
from ffsm_drake.plugins.two_arms.chain import ClosedChain
from ffsm_drake.scenario.contacts import ALL_HANDS
from ffsm_drake.spacecraft.limits import FORCE
from ffsm_drake.systems.reference import make_motion

STILL = {"base_rpy": [0, 0, 0], "base_position": [0, 0, 0]}
CALM = {f"base_{kind}_{axis}": None for kind in ("rotation", "position") for axis in "xyz"}
AWAY = {"right_1": 1.5, "right_2": 1.6, "right_3": -1.45, "right_4": 0.05, "right_5": -1.65}
TURNING = ["base_rotation", "joints"]
# driven, time of the second closing (s), whether the target tumbles
MISSIONS = ((["joints"], 0, 0), (["joints"], 1, 0), (TURNING, 1, 0), (TURNING, 0, 1),
            (TURNING, 1, 1))  # fmt: skip


def drawn(seed: int) -> Scenario:
    """A mission to a drawn posture, or to rest anywhere."""
    driven, closes, tumbles = MISSIONS[seed % len(MISSIONS)]
    generator = np.random.default_rng(seed)
    start = {"left_2": 1.663, "left_3": -1.849, "left_4": 0.0}
    goal = {name: angle + generator.uniform(-0.1, 0.1) for name, angle in start.items()}
    given = {
        "actuation": {"driven": driven, "limit": {"joints": 12.0}},
        "initial_posture": {**STILL, "joints": AWAY if closes else {}},
        "target_posture": {**STILL, "joints": goal},
        "reference": {"duration": 4.0},
        "planning": {"segments": 4, "time_weight": 0.0, "effort_weight": 1.0},
        "duration": 6.0,
        "random_seed": seed,
        "disturbance": {"harmonics": CALM},
        "contacts": {"right": {"closes": float(closes)}},
    }
    if tumbles:
        given["capture"] = {"rate": generator.uniform(-0.03, 0.03, 3).tolist()}
    return load_scenario("two_arms_capture" if tumbles else "two_arms", [given])


def along(scenario: Scenario, file: Path) -> Scenario:
    """The mission along the first guess of its plan, which the search would improve."""
    planner = _Planner(scenario, lambda line: None, 10.0)
    planner.check_momentum()
    guess = planner._first_guess(planner._problem(), 0.0)
    planner._plan_of(guess).save(file, title="")
    return scenario.replace(reference={"kind": "optimal", "plan": str(file)})


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(len(MISSIONS)))
def test_the_motion_along_a_plan_keeps_momentum_and_closes_the_loops(
    seed: int, tmp_path: Path
) -> None:
    scenario = along(drawn(seed), tmp_path / "plan.yaml")
    mission = Mission(scenario)
    motion, model = make_motion(mission), mission.craft.nominal()
    closes = scenario.contacts["right"].closes
    times = np.linspace(motion.begin, motion.end, 40)
    q, v, a = motion.evaluate(times)
    floating = free_floating(model, q, scenario.driven)
    kept = slice(3 if "base_rotation" in scenario.driven else 0, None)
    momentum = floating.momentum(v)[:, kept]
    parts = np.abs(floating.momentum_map[:, kept] * v[:, None]).max()
    assert np.ptp(momentum, axis=0).max() < 1e-9 * parts
    force = motion.demand(model, times)[FORCE]
    assert np.abs(force[:, ~model.coordinates.is_driven]).max() < 1e-9 * np.abs(force).max()
    chain = ClosedChain(model, scenario, ALL_HANDS, true=False)
    for time, *state in zip(times.tolist(), q, v, a, strict=True):
        if time >= closes:
            assert_allclose(chain.gap(state[0]), 0.0, atol=1e-9)
            assert_allclose(chain.jacobian(state[0]) @ state[1], 0.0, atol=1e-9)
    assert_allclose(v[-1][model.coordinates.driven], 0.0, atol=1e-9)


@pytest.mark.slow
@needs("compiled")
@needs_llvm
@pytest.mark.parametrize("seed", [1, 3])
def test_a_run_follows_its_plan_on_drake_and_compiled(seed: int, tmp_path: Path) -> None:
    scenario = along(drawn(seed), tmp_path / "plan.yaml")
    (run,) = check([scenario.replace(duration=2.0)])
    assert run.metrics["contacts"]["gap"] < 1e-9


@pytest.mark.long
@pytest.mark.parametrize("seed", range(len(MISSIONS)))
def test_a_plan_is_found_and_flown(seed: int, tmp_path: Path) -> None:
    scenario = drawn(seed)
    found = plan_motion(scenario, time_limit=60.0)
    assert not found.exceeded
    if not scenario.grasps:
        names = make_nominal_plant(scenario).coordinates.names[6:]
        goal = scenario.target_posture.joints
        left = [k for k, name in enumerate(names) if name.startswith("left")]
        end = found.last[7:]
        assert_allclose(end[left], [goal[names[k]] for k in left], atol=1e-9)
    found.plan.save(tmp_path / "plan.yaml", title="")
    plan = {"kind": "optimal", "plan": str(tmp_path / "plan.yaml")}
    run = simulate(scenario.replace(reference=plan), check_stability=False)
    assert run.ending.is_settled
    assert run.metrics["contacts"]["gap"] < 1e-9


def test_joints_alone_are_refused_to_stop_a_tumble() -> None:
    scenario = drawn(3).replace(actuation={"driven": ["joints"]})
    with pytest.raises(ScenarioError, match="joints cannot remove the angular momentum"):
        plan_motion(scenario)
