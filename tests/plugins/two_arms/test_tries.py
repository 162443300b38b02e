"""Further tries of a hand that closes later and misses its place, with a supervisor."""

import os

import numpy as np
import pytest

from ffsm_drake import RunRecord, Scenario, load_scenario, simulate
from ffsm_drake.plugins.capture.modes import Cause

DRAWS = int(os.environ.get("FFSM_DRAWS", "1"))
AWAY = {"right_1": 1.2, "right_2": 1.2, "right_3": -1.2, "right_4": 0.2, "right_6": -1.2}
NARROW = "capture.envelope.position=1e-12"  # any hand misses
LIMITS = "actuation.limit={joints: 40, base_position: 20, base_rotation: 20}"


def scenario(closes: float, *overrides: str) -> Scenario:
    """A tumbling target, whose second hand has some way to its place."""
    away = {"initial_posture": {"joints": AWAY}}
    given = [away, f"contacts.right.closes={closes}", "reference.duration=4", LIMITS]
    return load_scenario("two_arms_capture", [*given, *overrides])


def closed_at(run: RunRecord) -> int:
    """The sample at which the second hand closes."""
    return int(np.argmax(run.dataset["contact_closing"].values.any(axis=1)))


def test_a_hand_that_is_open_at_the_end_is_missed() -> None:
    given = "duration=3", "supervisor={}", NARROW
    run = simulate(scenario(2.0, *given), check_stability=False)
    assert run.outcome.status == "missed"
    assert "the hand of contacts.right is still open at t = 3 s" in run.outcome.message
    assert run.dataset.sizes["time"] == 300
    assert "contact_closing" not in run.dataset
    assert run.dataset["mode_cause"].values.max() == Cause.MISSED


@pytest.mark.slow
def test_the_tries_are_limited() -> None:
    given = "duration=10", "supervisor={tries: 2}", NARROW
    run = simulate(scenario(2.0, *given), check_stability=False)
    assert run.outcome.status == "missed"
    assert "contacts.right misses its place at t = " in run.outcome.message
    assert run.outcome.message.endswith(", in try 2")
    assert 7.0 <= run.outcome.time + 0.01 < 10.0


@pytest.mark.slow
@pytest.mark.parametrize("damps", [False, True])
@pytest.mark.parametrize("seed", range(DRAWS))
def test_a_hand_settles_after_a_jam(damps: bool, seed: int) -> None:
    """A drawn joint of its arm jams up to its closing. It closes later, softly."""
    random = np.random.default_rng(seed)
    jam = f"{{unit: joints.right_{random.integers(1, 4)}, kind: jammed, time: 0.5, duration: 1.6}}"
    supervisor = f"supervisor={{saturated_time: {0.3 if damps else 9}}}"
    given = "duration=16", f"faults.events={{one: {jam}}}", supervisor, "controller=tdc"
    run = simulate(scenario(2.0, *given), check_stability=False)
    assert run.ending.is_settled, run.ending.sentence
    cause = Cause.SATURATED if damps else Cause.MISSED
    assert run.dataset["mode_cause"].values.max() == cause
    assert run.metrics["supervisor"]["dampings"] == damps
    first = closed_at(run)
    assert 700 <= first < 1500
    assert not run.dataset["contact_wrench"].values[:first].any()
    assert run.metrics["contacts"]["closing"]["distance"] < 1e-3
    assert run.metrics["contacts"]["gap"] < 1e-9
    assert run.metrics["contacts"]["force"] < 5.0
