"""Two arms that hold a target on a base that no actuator moves, or only turns."""

from collections.abc import Sequence

import numpy as np
import pytest
from compared_runs import check

from ffsm_drake import RunRecord, Scenario, free_floating, load_scenario, make_true_plant, simulate

LAWS = ("tde_aismc", "tdc", "computed_torque", "aismc")
DRIVEN = (("joints",), ("base_rotation", "joints"))
AWAY = {"right_1": 1.5, "right_2": 1.6, "right_3": -1.45, "right_4": 0.05, "right_5": -1.65}
STILL = {"base_rpy": [0, 0, 0], "base_position": [0, 0, 0]}
# no disturbance on the base, which would change the momentum
CALM = {f"base_{kind}_{axis}": None for kind in ("rotation", "position") for axis in "xyz"}


def drawn(seed: int) -> Scenario:
    """A base, a law and a start: at rest, a grasp by both hands, or by one after the other."""
    generator = np.random.default_rng(seed)
    starts = seed % 3
    given = {
        "actuation": {"driven": list(DRIVEN[seed % 2])},
        "controller": LAWS[seed % len(LAWS)],
        "initial_posture": {**STILL, "joints": AWAY if starts == 2 else {}},
        "target_posture": STILL,
        "reference": {"duration": 2.0},
        "duration": 3.0,
        "random_seed": seed,
        "disturbance": {"harmonics": CALM},
    }
    if not starts:
        given["target_posture"] = {
            **STILL, "joints": {"left_2": 1.55, "left_3": -1.65, "left_4": 0.05}
        }  # fmt: skip
        return load_scenario("two_arms", [given])
    given["capture"] = {"rate": generator.uniform(-0.03, 0.03, 3).tolist()}
    given["contacts"] = {"right": {"closes": 1.0 * (starts == 2)}}
    return load_scenario("two_arms_capture", [given])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_compiled_runs_of_a_free_base_are_those_of_drake(seed: int) -> None:
    check([drawn(seed).replace(duration=1.5), drawn(seed + 6).replace(duration=1.5)])


def momenta(run: RunRecord, driven: Sequence[str]) -> np.ndarray:
    """The components (n, 3 or 6) of the momentum that are constant."""
    data = run.dataset
    q, v = data["position"].values, data["velocity"].values
    model = make_true_plant(run.scenario)
    found = free_floating(model, q, driven).momentum(v)
    return found[:, 3:] if "base_rotation" in driven else found


@pytest.mark.parametrize("seed", range(4))
def test_the_chain_moves_its_base_by_conservation_of_momentum(seed: int) -> None:
    scenario = drawn(seed)
    run = simulate(scenario, check_stability=False)
    assert run.outcome.status == "completed"
    kept = momenta(run, scenario.actuation.driven)
    assert np.ptp(kept, axis=0).max() < 1e-6
    assert run.metrics["contacts"]["gap"] < 1e-9
    assert run.metrics["final_error"]["joints"] < 1e-3
