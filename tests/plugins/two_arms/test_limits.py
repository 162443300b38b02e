"""The torques and wrenches that limits bound, before a run: those of the chain as its law acts."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import null_space

from ffsm_drake import Scenario, load_scenario, make_nominal_plant, simulate
from ffsm_drake.common.errors import LimitError, ScenarioError
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.design.remarks import plan_limits
from ffsm_drake.plugins.design.verdict import verdict
from ffsm_drake.plugins.two_arms.chain import ClosedChain
from ffsm_drake.runs.exceeded_limits import broken_limits
from ffsm_drake.spacecraft.limits import FORCE
from ffsm_drake.systems.mission_limits import joint_limits
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_motion, timed

WEAK = {"left_2": 3.0, "left_3": 1.0, "right_1": 2.0, "joints": 6.0}
KNOWN = {"payload": {"nominal": {"mass": 100.0}}}
AWAY = {"right_1": 1.2, "right_2": 1.2, "right_3": -1.2, "right_4": 0.2, "right_6": -1.2}
FAST = {"duration": 7.0, "reference": {"duration": 6.0}, "chain": {"force": {"gain": 20.0}}}
QUIET = ("sensing.velocity_noise=0", "disturbance.amplitude_scale=0")


def limited(*overrides: str, **changes: Any) -> Scenario:
    scenario = load_scenario("two_arms", [{"actuation": {"limit": WEAK}}, FAST, *overrides])
    return scenario.replace(**changes)


def demanded(scenario: Scenario, times: np.ndarray) -> tuple[PlannedMotion, dict[str, np.ndarray]]:
    mission = Mission(scenario)
    motion = make_motion(mission)
    return motion, motion.demand(mission.craft.nominal(), times)


@pytest.mark.parametrize("force", ["{share: null}", "null"])
def test_joints_share_the_least_force_relative_to_their_limits(force: str) -> None:
    """The torque is the least of all that move the chain alike, found without multipliers."""
    scenario, times = limited(f"chain.force={force}"), np.linspace(0.5, 5.5, 5)
    motion, found = demanded(scenario, times)
    model = make_nominal_plant(scenario)
    chain = ClosedChain(model, scenario, true=False)
    limit = model.coordinates.vector(WEAK, key="", default=1.0)
    for q, v, a, force_, wrench in zip(
        *motion.evaluate(times), found[FORCE], found["contact_wrench"], strict=True
    ):
        moves = null_space(chain.jacobian(q))
        needed = moves.T @ model.calc_inverse_dynamics(q, v, a)
        least = limit * np.linalg.lstsq(moves.T * limit, needed, rcond=None)[0]
        assert_allclose(force_, least, rtol=1e-7, atol=1e-7)
        tree = model.calc_inverse_dynamics(q, v, a)
        assert_allclose(force_, tree + chain.jacobian(q).T @ wrench, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "force", ["{share: null}", "{share: 0.3}", "{share: 0, preload: [0, 0, 1, 0, 0, 5]}"]
)
def test_a_run_has_the_planned_torques_and_wrenches(force: str) -> None:
    given = limited(f"chain.force={force}", "chain.force.gain=50", "controller=tdc", *QUIET)
    strong = {name: 10.0 * limit for name, limit in WEAK.items()}  # the same shares
    given = given.replace(actuation={"limit": strong}, **KNOWN)
    data = simulate(given, check_stability=False).dataset
    later = slice(150, 500)
    _, found = demanded(given, data["time"].values[later])
    wrench = data["contact_wrench"].values[later]
    assert_allclose(wrench, found["contact_wrench"], atol=0.02 + 0.03 * np.abs(wrench).max())
    applied = data["applied_force"].values[later]
    assert_allclose(applied, found[FORCE], atol=0.03 * np.abs(applied).max())


def test_without_limits_of_joints_the_first_hand_carries_the_target() -> None:
    plain = load_scenario("two_arms", [FAST])
    times = np.linspace(0.5, 5.5, 5)
    motion, found = demanded(plain, times)
    tree = make_nominal_plant(plain).calc_tracking_force(*motion.evaluate(times))
    assert_allclose(found[FORCE], tree, atol=1e-12)
    assert not found["contact_wrench"].any()


def test_a_late_hand_carries_from_its_grasp_on() -> None:
    late = limited("contacts.right.closes=2").replace(initial_posture={"joints": AWAY})
    times = np.array([1.0, 1.99, 2.0, 4.0])
    wrench = demanded(late, times)[1]["contact_wrench"]
    assert not wrench[:2].any()
    assert np.abs(wrench[2:]).max(axis=1).min() > 0.01


@pytest.mark.parametrize("seed", range(4))
def test_a_preload_beyond_the_limits_of_joints_is_refused(seed: int) -> None:
    """The torque that all times of a motion need is found without limits."""
    random, times = np.random.default_rng(seed), np.linspace(0.0, 6.0, 7)
    preload = (random.normal(size=6) * np.repeat([3.0, 10.0], 3)).tolist()
    free = load_scenario("two_arms", [FAST, {"chain": {"force": {"preload": preload}}}])
    motion, _ = demanded(free, times)
    model = make_nominal_plant(free)
    chain, names = ClosedChain(model, free, true=False), model.coordinates.names[6:]
    torques = [np.abs(preload @ chain.jacobian(q))[6:] for q in motion.evaluate(times)[0]]
    needed = dict(zip(names, np.min(torques, axis=0).tolist(), strict=True))
    joint = str(random.choice([name for name, each in needed.items() if each > 0.05]))
    for share in (0.99, 1.01):
        given = free.replace(actuation={"limit": {joint: share * needed[joint]}})
        if share > 1.0:
            demanded(given, times)
            continue
        with pytest.raises(ScenarioError, match=rf"preload: needs at least .* of {joint} at all"):
            demanded(given, times)


@pytest.mark.parametrize("seed", range(6))
def test_a_hand_that_closes_later_changes_no_limit_of_the_mission(seed: int) -> None:
    """Drawn limits and friction, of which each part of a mission must be judged."""
    random = np.random.default_rng(seed)
    kinds = {"force_limit": 5.0, "moment_limit": 2.0, "friction": {"coefficient": 0.4}}
    hands: dict[str, dict[str, Any]] = {
        name: {key: kinds[key] for key in kinds if random.random() < 0.5}
        for name in ("left", "right")
    }
    hands["right"].setdefault("force_limit", 3.0)

    def limits(closes: float) -> set[tuple[str, str]]:
        late = {**hands, "right": {**hands["right"], "closes": closes}}
        mission = Mission(load_scenario("two_arms", [{"contacts": late}]))
        return {(each.quantity, each.source) for each in joint_limits(mission)}

    at_once = limits(0.0)
    assert any(source.startswith("contacts.") for _, source in at_once)
    assert limits(float(random.integers(1, 5))) == at_once


@pytest.mark.parametrize("hand", ["left", "right"])
def test_a_mission_with_a_later_hand_is_judged_by_the_limits_of_its_hands(hand: str) -> None:
    given = load_scenario(
        "two_arms",
        [
            {"contacts": {"right": {"closes": 1.0}, hand: {"force_limit": 0.05}}},
            {"initial_posture": {"joints": AWAY}},
            "duration=4",
            "reference.duration=3",
            "chain.force.share=0.5",
        ],
    )
    told = f"exceeds contacts.{hand}.force_limit: "
    assert any(told in line for line in plan_limits(Mission(given)))
    run = simulate(given, check_stability=False)
    assert any(told in line for line in broken_limits(run.mission, run.dataset))
    found = verdict(given, advises=False)
    assert found.is_alarm
    assert any(told in line for line in found.run.broken)


@pytest.mark.slow
def test_auto_keeps_the_limits_of_joints_and_contacts() -> None:
    free = timed(Mission(limited("reference.duration=null"))).scenario.reference.duration
    assert free is not None
    bound = limited("reference.duration=null", "contacts.right.force_limit=1.5")
    mission = timed(Mission(bound))
    longer = mission.scenario.reference.duration
    assert longer is not None
    assert longer > 1.2 * free
    usable = 1.0 - bound.reference.reserve
    for duration, keeps in ((longer, True), (longer - 0.05, False)):
        given = bound.replace(reference={"duration": duration})
        motion, found = demanded(given, np.linspace(0.0, duration, 201))
        force = np.abs(found["contact_wrench"][:, 3:]).max()
        assert bool(force <= 1.001 * usable * 1.5) is keeps
        assert motion.end == duration
    with pytest.raises(LimitError, match=r"contact_wrench of right_force_\w takes"):
        timed(Mission(bound.replace(contacts={"right": {"force_limit": 1e-7}})))


@pytest.mark.long
def test_auto_with_a_late_hand_settles() -> None:
    away = {"initial_posture": {"joints": AWAY}}
    with pytest.raises(LimitError, match="the force on right_1 takes"):
        timed(Mission(limited("reference.duration=null", "contacts.right.closes=1", **away)))
    given = limited("reference.duration=null", "contacts.right.closes=4", duration=25.0, **away)
    run = simulate(given, check_stability=False)
    assert run.ending.is_settled
    assert run.metrics["contacts"]["gap"] < 1e-6
    assert 4.0 < run.mission.scenario.reference.duration < 20.0


@pytest.mark.long
def test_a_contact_limit_is_refused_before_the_run() -> None:
    given = limited("contacts.right.force_limit=0.05")
    (line,) = plan_limits(Mission(given))
    assert line.startswith("the planned motion exceeds contacts.right.force_limit: right_force_x ")
    assert not plan_limits(Mission(limited("contacts.right.force_limit=50")))
    found = verdict(given, rehearsal=False)
    assert found.is_alarm
    assert line in found.planned
