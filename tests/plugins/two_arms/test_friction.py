"""Friction of hands: its cone, the least preload within it, and the wrench of the welded hand."""

import dataclasses
import os
from typing import Any

import numpy as np
import pytest
from c_code import needs_llvm
from entry_points import needs
from numpy.testing import assert_allclose

from ffsm_drake import Rollout, Scenario, load_scenario, simulate
from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.campaign.rows import Judged
from ffsm_drake.plugins.design.remarks import plan_limits
from ffsm_drake.plugins.two_arms.friction import Cone, Hand, least_preload
from ffsm_drake.runs.exceeded_limits import broken_limits
from ffsm_drake.scenario.contacts import Friction
from ffsm_drake.systems.reference import make_motion

DRAWS = int(os.environ.get("FFSM_DRAWS", "1"))
QUIET = ("sensing.velocity_noise=0", "disturbance.amplitude_scale=0")
KNOWN = "payload.nominal={mass: 100, inertia: [16.7, 16.7, 16.7]}"
PADS = {name: {"friction": {"coefficient": 0.5, "radius": 0.05}} for name in ("left", "right")}


def drawn_cone(random: np.random.Generator) -> Cone:
    return Cone.of(
        Friction(
            coefficient=random.uniform(0.1, 1.0),
            radius=random.uniform(0.01, 0.1),
            axis=random.normal(size=3).tolist(),
            squeeze=float(random.choice([0.0, 20.0])),
        )
    )


def held(*overrides: Any) -> Scenario:
    given = ("duration=4", "reference.duration=4", "controller=tdc", {"contacts": PADS})
    return load_scenario("two_arms", [*QUIET, KNOWN, *given, *overrides])


def demanded(scenario: Scenario, times: np.ndarray) -> dict[str, np.ndarray]:
    mission = Mission(scenario)
    return make_motion(mission).demand(mission.craft.nominal(), times)


@pytest.mark.parametrize("seed", range(4 * DRAWS))
def test_a_share_is_that_of_the_cones(seed: int) -> None:
    random = np.random.default_rng(seed)
    within = 0
    for _ in range(200):
        cone, share = drawn_cone(random), random.uniform(0.3, 1.0)
        normal = random.uniform(-5.0, 30.0) * cone.axes[0]
        wrench = random.normal(size=6) * np.repeat([0.1, 2.0], 3) + np.r_[0, 0, 0, normal]
        rows = [A @ wrench + b for A, b, _ in cone.cones(share)]
        keeps = all(row[0] >= np.hypot(*row[1:]) for row in rows)
        assert keeps is bool(cone.used(wrench) <= share)
        within += keeps
    assert 20 < within < 180


def test_a_pad_bears_the_forces_of_its_formula() -> None:
    pad = Cone.of(Friction(coefficient=0.5, radius=0.06, axis=[0, 0, 2]))
    gripper = dataclasses.replace(pad, squeeze=10.0)
    assert_allclose(pad.torsion, 0.02)
    # moments, forces, share of the pad and of the gripper
    for *wrench, one, two in (
        (0, 0, 0, 3, 4, 20, 0.5, 1000),
        (0, 0, 0, 3, 4, 0, 1000, 0.5),
        (0, 0, 0.2, 0, 0, 20, 0.5, 1000),
        (0.6, 0, 0, 0, 0, 20, 0.5, 1000),
        (0, 0, 0.1, 0, 2.5, 5, 2.0, 2.0 / 3.0),
        (0, 0, 0, 0, 0, -5, 1000, 0.5),
        (0, 0, 0, 0, 0, 12, 0.0, 1.2),
        (0, 0, 0, 0, 0, 0, 0.0, 0.0),  # nothing to hold
        (0, 0, 0, 0, 1e-14, 1e-18, 0.0, 0.0),
    ):
        assert_allclose(pad.used(np.array(wrench, dtype=float)), one, atol=1e-12)
        assert_allclose(gripper.used(np.array(wrench, dtype=float)), two, atol=1e-12)


@pytest.mark.parametrize("seed", range(6 * DRAWS))
def test_the_least_preload_is_least(seed: int) -> None:
    """Drawn hands of an object: no smaller preload among many, and 0.1 % less violates."""
    random = np.random.default_rng(seed)
    opposite = np.diag([1.0, -1.0, -1.0])
    other = np.kron(np.eye(2), opposite)  # presses against the first
    load = random.normal(size=(2, 5, 6)) * np.repeat([0.1, 2.0], 3)
    cones = [dataclasses.replace(drawn_cone(random), axes=np.eye(3)[::-1], squeeze=0.0)] * 2
    hands = [
        Hand(name=str(k), load=own, map=along, cone=cone, limit=np.full(6, np.inf))
        for k, (own, along, cone) in enumerate(zip(load, (np.eye(6), -other), cones, strict=True))
    ]
    jacobians, torque = random.normal(size=(5, 6, 8)), np.zeros((5, 8))
    share = random.uniform(0.5, 1.0)

    def used(preload: np.ndarray) -> float:
        return max(float(hand.cone.used(hand.wrench(preload)).max()) for hand in hands)

    def least(limit: float) -> np.ndarray:
        return least_preload(hands, torque, jacobians, np.full(8, limit), share=share)

    found = least(np.inf)
    assert share * 0.999 < used(found) <= share
    assert used(0.999 * found) > share
    for _ in range(300):
        other_one = found + random.normal(size=6) * np.linalg.norm(found) * 0.1
        if used(other_one) <= share:
            assert np.linalg.norm(other_one) > 0.9999 * np.linalg.norm(found)
    # the limits of joints count; below them, the reserve is smaller
    most = np.abs(found @ jacobians).max()
    assert_allclose(np.linalg.norm(least(1.01 * most)), np.linalg.norm(found), rtol=1e-4)
    tight = least(0.6 * most)
    assert np.abs(tight @ jacobians).max() < 0.6001 * most
    assert used(tight) > share or np.linalg.norm(tight) > np.linalg.norm(found)


def test_without_a_load_there_is_no_least_preload() -> None:
    """A motion that has ended before the second hand closes."""
    still = held("duration=8", {"contacts": {"right": {"closes": 5.0}}}, "chain.force.preload=null")
    found = demanded(still, np.linspace(5.0, 8.0, 7))
    assert not found["preload"].any()
    assert not found["contact_friction"].any()


@pytest.mark.parametrize("seed", range(4 * DRAWS))
def test_large_numbers_do_not_change_the_least_preload_or_are_told(seed: int) -> None:
    """The solver is accurate with numbers of a like size only."""
    random = np.random.default_rng(seed)
    cone = dataclasses.replace(drawn_cone(random), axes=np.eye(3)[::-1], squeeze=0.0)
    load, turned = random.normal(size=(2, 5, 6)), np.kron(np.eye(2), np.diag([1.0, -1.0, -1.0]))
    jacobians, torque = random.normal(size=(5, 6, 8)), np.zeros((5, 8))

    def least(limit: float, scale: float = 1.0) -> np.ndarray:
        hands = [
            Hand(name=str(k), load=scale * own, map=along, cone=cone, limit=np.full(6, np.inf))
            for k, (own, along) in enumerate(zip(load, (np.eye(6), -turned), strict=True))
        ]
        return least_preload(hands, torque, jacobians, np.full(8, limit), share=0.7)

    unlimited = least(np.inf)
    for power in random.uniform(9.0, 300.0, 4):
        assert_allclose(least(10.0**power), unlimited, rtol=1e-4, atol=1e-6)
    sizes = np.linalg.norm([least(np.inf, 1e3), 1e3 * unlimited], axis=1)
    assert_allclose(sizes[0], sizes[1], rtol=1e-4)
    with pytest.raises(ScenarioError, match="preload: null: the search fails") as caught:
        least(np.inf, np.nan)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"chain": {"law": "plain", "force": {"preload": [0, 0, 0, 0, 0, 5]}}}, "has no effect"),
        ({"chain": {"law": "plain", "force": {"preload": None}}}, "has no effect"),
        ({"chain": {"force": {"preload": None}}, "contacts": {
            name: {"friction": None} for name in PADS}}, r"null needs contacts\.NAME\.friction"),
        ({"contacts": {"left": {"friction": {"coefficient": 1e12}}}}, "at most 100"),
        ({"contacts": {"left": {"friction": {"radius": 1e20}}}}, "at most 10"),
        ({"contacts": {"left": {"friction": {"squeeze": 1e20}}}}, "from 0 to 1000000 N"),
    ],
)  # fmt: skip
def test_a_preload_or_friction_without_sense_is_refused(given: dict[str, Any], words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        held(given)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2 * DRAWS))
def test_a_run_with_the_least_preload_does_not_slip(seed: int) -> None:
    """The wrench of the welded hand is that of the plan, too. Half the preload slips."""
    random = np.random.default_rng(seed)
    mass = random.uniform(30.0, 150.0)
    mine = {"mass": mass, "inertia": [mass / 6.0] * 3}
    given = held(
        {"payload": {"truth": mine, "nominal": mine}},
        f"reference.duration={random.uniform(3.0, 4.0):.2f}",
        f"chain.force={{share: {random.uniform(0.0, 1.0)}, preload: null, gain: 50}}",
    )
    times = np.arange(401) * 0.01
    found = demanded(given, times)
    assert found["contact_friction"].max() < 0.7 * 1.001
    run = simulate(given, check_stability=False)
    data = run.dataset
    assert not broken_limits(run.mission, data)
    assert not plan_limits(Mission(given))
    assert 0.6 < run.metrics["contacts"]["friction"] < 0.8
    for name in ("weld_wrench", "contact_wrench"):
        size = np.abs(found[name]).max()
        assert_allclose(data[name].values[20:], found[name][20:], atol=0.02 * size)
    preload = 0.5 * found["preload"][0]
    weak = given.replace(chain={"force": {"preload": preload.tolist()}})
    (line,) = plan_limits(Mission(weak))
    assert "slips: " in line
    run = simulate(weak, check_stability=False)
    assert any("so the hand slips: " in each for each in broken_limits(run.mission, run.dataset))


def test_a_run_without_enough_preload_is_told_and_refused() -> None:
    weak = held("chain.force.preload=[0, 0, 0, 0, 0, 1]", "duration=0.5")
    (line,) = plan_limits(Mission(weak.replace(duration=4.0)))
    assert line.startswith(
        "the planned motion exceeds contacts.left.friction or contacts.right.friction, so the hand "
        "slips: left "
    )
    limits = "contacts.right.force_limit=20"
    tight = held("chain.force.preload=null", limits)
    told = r"preload: null: \w+ slips with any .* times .* at t = "
    with pytest.raises(ScenarioError, match=told):
        simulate(tight, check_stability=False)


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_limits_of_the_welded_hand_count(share: float) -> None:
    given = held(f"chain.force.share={share}", {"contacts": {"left": {"friction": None}}})
    given = given.replace(contacts={"right": {"friction": None}, "left": {"force_limit": 1e4}})
    times = np.linspace(0.0, 4.0, 41)
    found = demanded(given, times)
    weld, right = (np.abs(found[name]).max() for name in ("weld_wrench", "contact_wrench"))
    # both bear all of the load
    assert_allclose(right / (weld + right), share, atol=0.1)
    for limit, count in ((1.1 * weld, 0), (0.9 * weld, 1)):
        lines = plan_limits(Mission(given.replace(contacts={"left": {"force_limit": limit}})))
        assert len(lines) == count
        assert all("exceeds contacts.left.force_limit: left_force_" in line for line in lines)


def test_a_campaign_counts_a_run_that_slips_as_no_success() -> None:
    for preload, failed in ((1.0, "left slips at t = "), (1e4, "")):
        given = held(f"chain.force.preload=[0, 0, 0, 0, 0, {preload}]", "duration=0.2")
        log = Rollout(given).run(given)
        assert Judged(None, log).failed.startswith(failed)  # type: ignore[arg-type]
        assert bool(Judged(None, log).failed) is bool(failed)  # type: ignore[arg-type]


@pytest.mark.slow
@needs("compiled")
@needs_llvm
def test_both_engines_judge_friction_alike() -> None:
    late = load_scenario(
        "two_arms_capture",
        [
            {"contacts": PADS | {"right": {**PADS["right"], "closes": 0.3}}},
            {"initial_posture": {"joints": {"right_1": 1.5, "right_2": 1.6, "right_3": -1.45}}},
            "duration=1",
            "reference.duration=1",
            "chain.force.preload=[0, 0, 0, 0, 0, 100]",
        ],
    )
    one, other = (simulate(late, check_stability=False, engine=each).dataset
                  for each in ("drake", "compiled"))  # fmt: skip
    for name in ("weld_wrench", "contact_friction", "contact_wrench"):
        assert_allclose(other[name].values, one[name].values, rtol=1e-6, atol=1e-6)
    used = one["contact_friction"].values
    # the first hand holds alone, then both; NaN just after each grasp
    assert np.isfinite(used[5:30, 0]).all()
    assert np.isnan(used[:30, 1]).all()
    assert np.isfinite(used[35:]).all()
