"""Healthy motions of any payload within its bounds, faster than windows, are no evidence."""

import os

import numpy as np
import pytest

from ffsm_drake import load_scenario
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.estimators.assumed_noise import assumed_noise
from ffsm_drake.plugins.faults.correction import moved
from ffsm_drake.plugins.faults.detection import Detector
from ffsm_drake.plugins.faults.payload_error import intervals
from ffsm_drake.plugins.faults.wrists import Wrists
from ffsm_drake.scenario import MassProperties
from ffsm_drake.systems.sampled import Now
from ffsm_drake.systems.setup import BlockSetup

DRAWS = int(os.environ.get("FFSM_DRAWS", "6"))
STEP, SAMPLES = 0.01, 250
FLIGHT = [
    "sensing.position_noise={base_position: 1.0e-3, base_rotation: 5.0e-5, joints: 1.0e-5}",
    "sensing.velocity_noise={base_position: 1.0e-3, base_rotation: 1.5e-5, joints: 1.0e-4}",
    "contacts.right.force_noise=0.3", "contacts.right.moment_noise=0.02",
    "actuation.thrusters.layout=12x5N", "faults.detection={}",
]  # fmt: skip


def drawn_payload(random: np.random.Generator, nominal: MassProperties) -> MassProperties:
    """Masses within the factor of two, and a centre within its bound."""
    ratio, way = random.uniform(0.5, 2.0), random.normal(size=3)
    reach = intervals(nominal, 2.0)[1][1] / (2.0 * nominal.mass)
    centre = nominal.center_of_mass + 0.9 * reach * way / np.linalg.norm(way)
    inertia = [float(ratio * each) for each in nominal.inertia]
    return MassProperties(
        mass=ratio * nominal.mass, center_of_mass=centre.tolist(), inertia=inertia
    )


def drawn_motion(random: np.random.Generator, q: np.ndarray, nv: int) -> tuple[np.ndarray, ...]:
    """Configurations and velocities (m, nq and nv) of oscillations with periods of 0.5 to 2 s."""
    largest = np.repeat([0.03, 0.05, 0.3], [3, 3, nv - 6]) * random.uniform(0.2, 1.0, nv)
    rate, phase = random.uniform(3.0, 12.0), random.uniform(0.0, 6.0, nv)
    v = largest * np.sin(rate * STEP * np.arange(SAMPLES)[:, None] + phase)
    path = [q]
    for step in 0.5 * STEP * (v[1:] + v[:-1]):
        path.append(moved(path[-1], step))
    return np.array(path), v


@pytest.mark.parametrize("seed", range(DRAWS))
def test_a_healthy_motion_is_no_evidence(seed: int) -> None:
    """The forces are those of the true masses; pulses of thrusters are few, and wrists noisy."""
    random = np.random.default_rng(seed)
    mission = Mission(load_scenario("two_arms", FLIGHT))
    nominal, given = mission.craft.nominal(), mission.scenario
    setup = BlockSetup(name="detection", mission=mission, nominal=nominal, settings={})
    truth = drawn_payload(random, given.payload.nominal)
    true = mission.craft.loaded(mission.craft.nominal(), truth)
    detector, wrists, nv = Detector(setup), Wrists(setup), len(setup.coordinates.names)
    start = np.r_[1.0, np.zeros(6), [given.target_posture.joints[n] for n in detector._joints]]
    path, v = drawn_motion(random, start, nv)
    wrench = np.cumsum(random.normal(size=(SAMPLES, 6)), axis=0) * np.repeat([0.1, 0.5], 3)
    noise = np.concatenate(assumed_noise(given, setup.coordinates))
    told = 5.0 * (random.random((SAMPLES, detector.inputs["told_units"])) < 0.01)
    deviations, memory, force = np.repeat([0.02, 0.3], 3), None, np.zeros(nv)
    for k, state in enumerate(np.hstack([path, v])):
        if k:
            between = 0.5 * (v[k] + v[k - 1])
            middle = moved(path[k - 1], 0.5 * STEP * between)
            force = true.calc_mass_matrix(middle) @ (v[k] - v[k - 1]) / STEP
            force += true.calc_bias(middle, between)
        error = noise * random.normal(size=2 * nv)
        seen = np.r_[moved(state[: nv + 1], error[:nv]), state[nv + 1 :] + error[nv:]]
        inputs = {
            "state": seen,
            "told_force": force - wrists.along(path[k], wrench[k])[0],
            "told_units": told[k],
            "measured_wrench": wrench[k] + deviations * random.normal(size=6),
        }
        memory = detector.start(seen) if memory is None else memory
        _, memory = detector.step(inputs, memory, Now(STEP * k))
        assert not memory["codes"].any()
        assert not detector.remembered(memory).tries  # no evidence at all
