"""Fault detection with two hands on one target: it reads the wrenches at the wrists."""

import os

import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_later import AWAY
from test_mechanics import consistent_states, scenario

from ffsm_drake import load_scenario, make_closed_loop, simulate, simulate_many
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.faults.wrists import Wrists
from ffsm_drake.systems.setup import BlockSetup

DRAWS = int(os.environ.get("FFSM_DRAWS", "1"))
LIMITS = "actuation.limit={joints: 20}"


def wrists_of(given) -> Wrists:
    mission = Mission(given)
    nominal = mission.craft.nominal()
    return Wrists(BlockSetup(name="", mission=mission, nominal=nominal, settings={}))


@pytest.mark.smoke
def test_a_measured_wrench_is_the_force_on_the_plant() -> None:
    given = scenario()
    flow, wrists = make_closed_loop(given).blocks["forces.contacts"].block, wrists_of(given)
    for q, v, force in consistent_states(5):
        inputs = {"state": np.r_[q, v], "other_force": force, "correction": np.zeros(6)}
        outputs, _ = flow.flow(inputs, {})
        found, sizes = wrists.along(q, outputs["measured_wrench"])
        assert_allclose(found, outputs["generalized_force"], rtol=0, atol=1e-10)
        assert (sizes >= np.abs(found) - 1e-12).all()


def test_noise_at_the_wrists_widens_the_bound_of_short_windows() -> None:
    noisy = wrists_of(scenario("contacts.right.force_noise=1", "contacts.right.moment_noise=0.1"))
    (q, *_), none = next(iter(consistent_states(1))), np.zeros(18)
    long, short = noisy.error(q, none, np.sqrt(1.0 / np.array([320.0, 20.0])))
    assert_allclose(short, 4.0 * long)
    assert short[6:].max() > 0.1
    assert not wrists_of(scenario()).error(q, none, np.array([0.2])).any()


def detected(*overrides, name="two_arms_capture", **event):
    faults = {"detection": {}, "events": {"it": event} if event else {}}
    given = load_scenario(name, ["duration=5", LIMITS, {"faults": faults}, *overrides])
    run = simulate(given, check_stability=False)
    return run, set(run.metrics["faults"]["noticed"] or ())


@pytest.mark.long
@pytest.mark.parametrize("joint", ["left_3", "right_2"])
def test_a_jam_is_named(joint: str) -> None:
    unit = f"joints.{joint}"
    _, found = detected(unit=unit, kind="jammed", time=[3.0])
    assert found == {f"{unit} jammed"}


@pytest.mark.long
def test_a_later_hand_and_wrong_masses_are_no_fault() -> None:
    late = [{"initial_posture": {"joints": AWAY}}, "contacts.right.closes=2.0"]
    run, found = detected(*late, "payload.truth.mass=180")
    assert run.outcome.status == "completed"
    assert found == set()


@pytest.mark.long
def test_a_frozen_encoder_presses_less_if_it_is_detected() -> None:
    event = {"unit": "sensing.left_2", "kind": "frozen", "time": [1.0], "duration": 0.2}
    run, found = detected("actuation.limit=null", **event)
    assert found == {"sensing.left_2 frozen"}
    assert 1.0 < run.metrics["contacts"]["force"] < 1000.0  # 4 kN without detection


@pytest.mark.long
@pytest.mark.parametrize("seed", range(DRAWS))
def test_detection_has_the_runs_of_drake(seed: int) -> None:
    random = np.random.default_rng(seed)
    given = []
    for unit in (None, "joints", "sensing"):
        faults = {"detection": {}, "seed": int(random.integers(1000))}
        if unit:
            faults["events"] = {"it": {"unit": unit, "time": [round(random.uniform(0.7, 0.9), 2)]}}
        given.append(
            load_scenario("two_arms_capture", ["duration=1.5", LIMITS, {"faults": faults}])
        )
    for run, other in zip(
        simulate_many(given, engine="compiled"), simulate_many(given), strict=True
    ):
        assert run.engine.startswith("compiled")
        assert run.outcome == other.outcome
        for name in ("position", "velocity", "contact_wrench", "fault_detected", "force_contacts"):
            own, expected = run.dataset[name].values, other.dataset[name].values
            assert_allclose(own, expected, rtol=0, atol=1e-7 * max(1.0, np.abs(expected).max()))
