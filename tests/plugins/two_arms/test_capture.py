"""A tumbling target caught by two arms at once."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ffsm_drake import ScenarioError, load_scenario, make_nominal_plant, make_true_plant, simulate
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.capture.approach import planned_approach
from ffsm_drake.plugins.capture.contact import contact_at, planned_contact
from ffsm_drake.plugins.capture.plastic import plastic_grasp
from ffsm_drake.plugins.two_arms.motion import closed_chain
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.spacecraft.plant import find_body, find_frame

TURN = np.deg2rad(3.0)


@pytest.mark.smoke
def test_both_hands_take_the_momentum_at_once() -> None:
    """The motion after the grasp has the momentum before and no rate of the gap; the second hand's
    impulse does no work on the motions that it allows.
    """
    given = load_scenario("two_arms_capture")
    model = make_true_plant(given)
    contact = planned_contact(make_mission(given), model)
    v, H = contact.grasp.velocity, model.calc_mass_matrix(contact.q)
    q, constraints = closed_chain(given, model, contact.q)
    assert_allclose(q, contact.q, atol=1e-12)
    assert_allclose(constraints @ v, 0.0, atol=1e-12)
    assert_allclose(contact.momentum_after, contact.momentum_before, atol=1e-10)
    assert np.abs(contact.momentum_before[:3]).min() > 0.3
    one = contact_at(
        dataclasses.replace(given, contacts={}),
        model,
        q=contact.q,
        velocity=contact.velocity,
        target_velocity=contact.target_velocity,
    )
    allowed = np.linalg.svd(constraints)[2][6:].T
    assert_allclose(allowed.T @ H @ (v - one.grasp.velocity), 0.0, atol=1e-10)
    assert np.abs(v - one.grasp.velocity).max() > 1e-3
    assert contact.grasp.energy_after < one.grasp.energy_after < one.grasp.energy_before


@pytest.mark.slow
def test_a_tumbling_target_is_stopped() -> None:
    run = simulate(load_scenario("two_arms_capture"), check_stability=False)
    assert run.outcome.status == "completed"
    assert run.metrics["contacts"]["gap"] < 1e-9
    assert max(run.metrics["final_error"].values()) < 1e-6
    assert np.abs(run.dataset["velocity"].values[-1]).max() < 1e-4


@pytest.mark.long
def test_no_drawn_capture_is_lost() -> None:
    generator = np.random.default_rng(0)
    for _ in range(60):
        mass = generator.uniform(80.0, 125.0)
        given = load_scenario(
            "two_arms_capture",
            [
                f"capture.rate={(TURN * generator.uniform(-1, 1, 3)).tolist()}",
                f"capture.velocity={(0.01 * generator.uniform(-1, 1, 3)).tolist()}",
                f"payload.truth={{mass: {mass}, inertia: {[mass / 6] * 3}}}",
                f"random_seed={generator.integers(1000)}",
            ],
        )
        run = simulate(given, check_stability=False)
        assert run.outcome.status == "completed"
        assert max(run.metrics["final_error"].values()) < 1e-3
        assert run.metrics["contacts"]["gap"] < 1e-9


APPROACH = (
    "capture.approach={duration: 3}",
    "reference.duration=4",
    "duration=8",
    {
        "capture": {
            "servicer": "track_all",
            "approach": {
                "posture": {
                    "base_position": [0.02, -0.02, -0.05],
                    "joints": {"left_1": 1.5, "left_2": 1.55, "left_3": -1.7, "left_4": 0.05}
                    | {"left_5": 1.6, "left_6": 1.5, "right_1": 1.45, "right_2": 1.55}
                    | {"right_3": -1.4, "right_4": 0.05, "right_5": -1.6, "right_6": -1.45},
                }
            },
        }
    },
)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("servicer", ["track_all", "track_joints", "detumble"])
def test_an_approach_ends_with_both_hands_moving_with_the_target(seed: int, servicer: str) -> None:
    generator = np.random.default_rng(seed)
    given = load_scenario(
        "two_arms_capture",
        [
            *APPROACH,
            f"capture.rate={(TURN * generator.uniform(-1, 1, 3)).tolist()}",
            f"capture.velocity={(0.01 * generator.uniform(-1, 1, 3)).tolist()}",
            f"capture.servicer={servicer}",
        ],
    )
    model = make_nominal_plant(given)
    contact = planned_contact(make_mission(given), model)
    q, v, _ = planned_approach(make_mission(given)).evaluate(given.grasp_time)
    assert_allclose(q, contact.q, atol=1e-12)
    plant, context = model.plant, model.context
    plant.SetPositionsAndVelocities(context, np.concatenate([q, v]))
    p_WP = (
        find_body(plant, "debris::debris", key="payload.body")
        .EvalPoseInWorld(context)
        .translation()
    )
    w, v_P = np.split(contact.target_velocity, 2)
    for side in ("left", "right"):
        hand = find_frame(plant, f"servicer::{side}_hand", key="hand")
        grasp = find_frame(plant, f"debris::{side}_grasp", key="grasp")
        X = grasp.CalcPose(context, hand)
        assert_allclose(X.GetAsMatrix4(), np.eye(4), atol=1e-10)
        arm = hand.CalcPoseInWorld(context).translation() - p_WP
        moving = hand.CalcSpatialVelocityInWorld(context)
        assert_allclose(moving.rotational(), w, atol=1e-9)
        assert_allclose(moving.translational(), v_P + np.cross(w, arm), atol=1e-9)
    assert_allclose(contact.grasp.velocity, v, atol=1e-8)  # no impact


@pytest.mark.slow
@pytest.mark.parametrize("closes", [0, 1.5])
def test_an_approach_to_a_tumbling_target(closes: float) -> None:
    run = simulate(
        load_scenario("two_arms_capture", [*APPROACH, f"contacts.right.closes={closes}"]),
        check_stability=False,
    )
    assert run.ending.is_settled
    assert run.grasp is not None
    sides = [run.grasp[side] for side in ("before", "after")]
    for name in ("linear_momentum", "angular_momentum"):
        assert_allclose(sides[0][name], sides[1][name], atol=1e-12)
    assert max(run.grasp["miss"].values()) < 1e-3
    assert run.metrics["contacts"]["gap"] < 1e-9
    begins = round((run.scenario.grasp_time + closes) / run.scenario.sample_time)
    wrench = run.dataset["contact_wrench"].values
    assert not np.nan_to_num(wrench[:begins]).any()
    assert np.isfinite(wrench[begins:]).all()
    assert run.dataset["phase"].values.tolist().count("approach") == 300


@pytest.mark.long
def test_an_approach_in_a_kept_rollout_gives_the_same_bits_again() -> None:
    given = [load_scenario("two_arms_capture", [*APPROACH, f"random_seed={k}"]) for k in (1, 2)]
    kept = make_rollout(given[0])
    logs = [kept.run(each).series for each in (given[0], given[1], given[0])]
    for name, values in logs[0].items():
        assert np.array_equal(logs[2][name], values, equal_nan=True)
    assert not np.array_equal(logs[1]["state"], logs[0]["state"])


@pytest.mark.long
@pytest.mark.parametrize("seed", range(8))
def test_no_drawn_approach_is_lost(seed: int) -> None:
    generator = np.random.default_rng(seed)
    closes = round(generator.uniform(0.5, 2.0), 2) * (seed % 2)
    given = load_scenario(
        "two_arms_capture",
        [
            *APPROACH,
            f"capture.rate={(TURN * generator.uniform(-1, 1, 3)).tolist()}",
            f"capture.velocity={(0.01 * generator.uniform(-1, 1, 3)).tolist()}",
            f"capture.servicer={('rest', 'track_joints', 'track_all', 'detumble')[seed % 4]}",
            f"contacts.right.closes={closes}",
            f"random_seed={seed}",
        ],
    )
    run = simulate(given, check_stability=False)
    assert run.outcome.status == "completed"
    assert max(run.metrics["final_error"].values()) < 1e-3
    assert run.metrics["contacts"]["gap"] < 1e-9


def test_the_second_hand_may_miss() -> None:
    given = load_scenario(
        "two_arms_capture", [*APPROACH, "sensing.position_bias={right_1: 0.1}", "duration=8"]
    )
    run = simulate(given, check_stability=False)
    assert run.outcome.status == "missed"
    assert "missed at t = 3 s: angle 0.1 rad" in run.outcome.message


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("contacts.right.position_error=[1e-3, 0, 0]", "has no effect on a hand that grasps"),
        ("capture.closing={time: 5}", "capture.closing: needs a capture.approach that lasts"),
    ],
)
def test_refusals_of_an_approach_are_one_line(override: str, words: str) -> None:
    with pytest.raises(ScenarioError, match=words) as caught:
        simulate(load_scenario("two_arms_capture", [*APPROACH, override]), check_stability=False)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("seed", range(5))
def test_brakes_and_both_hands_act_in_one_impact(seed: int) -> None:
    """Any joints with brakes, any loops, against the equations of all impulses at once."""
    generator = np.random.default_rng(seed)
    root = generator.normal(size=(14, 14))
    mass, loops = root @ root.T + np.eye(14), generator.normal(size=(6, 14))
    loops[:, :6] = 0.0
    some = sorted(generator.choice(np.arange(6, 14), size=seed + 3, replace=False).tolist())
    arm, body = generator.normal(size=(6, 14)), generator.normal(size=(6, 6))
    target = body @ body.T + np.eye(6)
    mass = mass + arm.T @ target @ arm
    v, moving = generator.normal(size=14), generator.normal(size=6)
    grasp = plastic_grasp(
        mass_matrix=mass, jacobian=arm, target_inertia=target, velocity=v,
        target_velocity=moving, braked=some, constraints=loops,
    )  # fmt: skip
    momentum = mass @ v + arm.T @ target @ (moving - arm @ v)
    rows = np.vstack([np.eye(14)[some], loops])
    size = len(rows)
    whole = np.block([[mass, -rows.T], [rows, np.zeros((size, size))]])
    expected = np.linalg.lstsq(whole, np.append(momentum, np.zeros(size)), rcond=1e-12)[0][:14]
    assert_allclose(grasp.velocity, expected, atol=1e-8)
    assert_allclose(rows @ grasp.velocity, 0.0, atol=1e-8)
    assert_allclose((mass @ grasp.velocity)[:6], momentum[:6], atol=1e-8)
    others = np.setdiff1d(np.arange(14), some)
    assert not grasp.brake_impulse[others].any()


@pytest.mark.slow
@pytest.mark.parametrize("closes", [0, 1.5])
def test_braked_joints_are_at_rest_after_the_grasp(closes: float) -> None:
    given = [*APPROACH, "capture.servicer=rest", "capture.joints=braked"]
    run = simulate(
        load_scenario("two_arms_capture", [*given, f"contacts.right.closes={closes}"]),
        check_stability=False,
    )
    assert run.ending.is_settled
    k = round(run.scenario.grasp_time / run.scenario.sample_time)
    after = run.dataset["velocity"].values[k]
    assert np.abs(after[6:]).max() < 1e-12
    assert np.abs(after[:6]).max() > 1e-3
    momentum = run.grasp["after"]["angular_momentum"]
    assert_allclose(momentum, run.grasp["before"]["angular_momentum"], atol=1e-12)
    assert run.metrics["contacts"]["gap"] < 1e-9
