"""The mission of two arms with an approach, two grasps, a stop, hardware and a fault."""

import numpy as np
import pytest
from c_code import needs_llvm

from ffsm_drake import load_scenario, simulate_many
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.campaign.spec import load_spec
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.load import predicted_load
from ffsm_drake.scenario import shipped_scenarios

NAME = "two_arms_detumble"


def test_its_file_is_short() -> None:
    assert len(shipped_scenarios()[NAME].read_text().splitlines()) < 60


def test_the_campaign_draws_a_fault_for_each_case() -> None:
    spec = load_spec(NAME)
    assert spec.cases >= 500
    assert spec.base_scenario.faults is not None
    assert spec.base_scenario.faults.seed is None


@pytest.mark.long
@needs_llvm
def test_captures_settle_and_are_soft() -> None:
    """Drawn noise, tumble and wheel that stops; within the forces that the hands may have."""
    rng = np.random.default_rng(0)
    given = [
        load_scenario(NAME, [
            f"random_seed={seed}",
            f"capture.rate={rng.uniform(-0.0873, 0.0873, 3).tolist()}",
            "faults.events.drawn={unit: wheels, kind: stops, time: [0, 30], duration: 2}",
        ])
        for seed in range(4)
    ]  # fmt: skip
    for record in simulate_many(given, engine="compiled"):
        assert record.engine.startswith("compiled")
        assert record.ending.is_settled, record.ending.sentence
        assert record.metrics["contacts"]["gap"] < 1e-9
        assert record.metrics["contacts"]["force"] < 5.0


@pytest.mark.long
def test_the_load_after_the_grasp_is_that_of_the_first_hand() -> None:
    """A loop in which the late hand, which is still open, held the target has no finite force."""
    with Linearizer(Mission(load_scenario(NAME))) as linearizer:
        load = predicted_load(linearizer)
    assert load is not None
    assert load < 0.5
