"""A tumbling target caught by two arms at once."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ffsm_drake import load_scenario, make_true_plant, simulate
from ffsm_drake.plugins.capture.contact import contact_at, planned_contact
from ffsm_drake.plugins.two_arms.motion import closed_chain

TURN = np.deg2rad(3.0)


@pytest.mark.smoke
def test_both_hands_take_the_momentum_at_once() -> None:
    """The motion after the grasp has the momentum before and no rate of the gap; the second hand's
    impulse does no work on the motions that it allows.
    """
    given = load_scenario("two_arms_capture")
    model = make_true_plant(given)
    contact = planned_contact(given, model)
    v, H = contact.grasp.velocity, model.calc_mass_matrix(contact.q)
    q, constraints = closed_chain(given, model.plant, model.context, contact.q)
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
        assert run.metrics["contacts"]["gap"] < 1e-8
