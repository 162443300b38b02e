"""Stability where only the joints are driven: predicted by the wired loop, and run."""

import dataclasses

import numpy as np
import pytest

from ffsm_drake import load_scenario, make_nominal_plant, simulate, stability
from ffsm_drake.plugins.design.stability.boundaries import with_gains
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.moving import MotionStability
from ffsm_drake.plugins.design.stability.prediction import predict
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.systems.controllers import complete_gains

FREE = [
    "actuation.driven=[joints]",
    "disturbance.harmonics={}",
    *(
        f"{posture}_posture.base_{part}=[0,0,0]"
        for posture in ("initial", "target")
        for part in ("position", "rpy")
    ),
]
# Factor on all gains from which the loop is unstable.
EDGE = {
    "tdc": 2.301,
    "asmc": 1.258,
    "aismc": 1.279,
    "tde_aismc": 1.439,
    "computed_torque": 21.32,
    "pd_plus": 8.93,
}


def free(controller, *overrides):
    """Gains are held: adaptation and the sign term are predicted apart from the loop."""
    held = {"aismc": ["controllers.aismc.alpha=0"], "tde_aismc": ["controllers.tde_aismc.alpha=0"]}
    return load_scenario(
        "postcapture", [*FREE, f"controller={controller}", *held.get(controller, []), *overrides]
    )


# One of every structure on each change: without and with an estimate.
@pytest.mark.parametrize(
    "controller",
    [
        pytest.param(
            law, marks=pytest.mark.slow if law in ("computed_torque", "tdc") else pytest.mark.long
        )
        for law in EDGE
    ],
)
def test_the_edge_of_stability_from_both_sides(controller):
    length = 19 if controller == "pd_plus" else 7  # which grows slowly
    scenario = complete_gains(
        free(controller, f"duration={length + 1}", f"reference.duration={length}")
    )
    time = stability(scenario, postures=5).edge_time
    runs = []
    for share in (0.97, 1.03):
        changed = with_gains(scenario, share * EDGE[controller])
        with Linearizer(changed) as linearizer:
            assert (linearizer.at(time).spectral_radius < 1.0) is (share < 1.0)
        runs.append(simulate(changed, check_stability=False))
    inside, outside = runs
    assert inside.outcome.completed
    assert np.abs(inside.dataset["error"].values[-50:, 6:]).max() < 1e-2
    assert (
        outside.outcome.status == "diverged" or outside.metrics["isv"] > 1e3 * inside.metrics["isv"]
    )


@pytest.mark.smoke
def test_poles_are_those_of_the_reduced_plant():
    """Computed torque with the true payload: at rest each joint's loop is e'' + K_d e' + K_p e = 0,
    sampled.
    """
    gains = [
        "controllers.computed_torque={k_p: 4, k_d: 4}",
        "payload.nominal={mass: 100, inertia: [16.7, 16.7, 16.7]}",
    ]
    with Linearizer(free("computed_torque", *gains, "sensing.velocity_noise=0")) as linearizer:
        loop = linearizer.at(linearizer.motion.end)
    step, k_p, k_d = 0.01, 4.0, 4.0
    held = np.array([[1.0, step], [0.0, 1.0]]) - np.outer([0.5 * step**2, step], [k_p, k_d])
    expected = np.sort(np.abs(np.linalg.eigvals(held)))
    poles = np.sort(np.abs(loop.poles[np.abs(loop.poles) > 1e-6]))
    assert poles == pytest.approx(np.repeat(expected, 5), abs=2e-5)


def test_eta_is_that_of_the_driven_coordinates():
    scenario = free("tdc")
    margins = stability(scenario, postures=3)
    assert margins.eta.shape == (3, 5)
    nominal = driven_model(make_nominal_plant(scenario))
    assert np.array_equal(nominal.calc_mass_matrix(np.eye(12)[0])[:6, :6], np.eye(6))
    assert margins.is_stable


@pytest.mark.slow
def test_noise_and_drift_are_predicted():
    scenario = free("tdc", "duration=8", "sensing.velocity_noise=1e-5")
    predicted = predict(scenario, settled_after=4.0)
    found = []
    for seed in range(2):
        record = simulate(dataclasses.replace(scenario, random_seed=seed), check_stability=False)
        found.append(record.dataset["error"].values[400:, 6:])
    rms = np.sqrt(np.mean(np.concatenate(found) ** 2, axis=0))
    assert predicted.rms_error[6:] == pytest.approx(rms, rel=0.25)
    assert set(predicted.by_group()) == {"joints"}
    assert not predicted.peak_effort[:6].any()


@pytest.mark.long
def test_what_a_frame_in_motion_adds_up_to():
    """Five joints for a pose: stable where the frame rests, and slowly unstable on the way."""
    margins = stability(load_scenario("free_floating"), postures=3)
    radii = np.array([loop.spectral_radius for loop in margins.loops])
    assert radii[[0, -1]].max() < 0.995
    assert radii.max() > 1.001
    with Linearizer(load_scenario("free_floating")) as linearizer:
        fine = MotionStability(loops=linearizer.along(np.linspace(0.0, 1.0, 61)))
    assert margins.growth == pytest.approx(fine.growth, rel=0.1)
    assert fine.growth < margins.motion.growth_bound < 2.0 * margins.growth
    assert margins.is_stable
    assert f"grow {margins.growth:.2g} times (cautious estimate " in margins.verdict
    assert stability(free("tdc"), postures=3).growth == 1.0
