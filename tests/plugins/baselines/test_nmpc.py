"""Nonlinear predictive control: the optimum of the nonlinear program, and its way past a bound."""

import numpy as np
import pytest
from own_loop import EXACT, FIRST, flown, resting
from pydrake.common.eigen_geometry import AngleAxis, Quaternion
from pydrake.math import RotationMatrix
from scipy.optimize import minimize

from ffsm_drake import load_scenario, make_nominal_plant
from ffsm_drake.mission import make_mission
from ffsm_drake.systems.controllers import Sample, make_law

LIMITS = "actuation.limit={base_rotation: 40, base_position: 30, joints: 15}"
T, STEPS = 0.1, 5


def law_of(name, *overrides):
    scenario = load_scenario("postcapture", [EXACT, f"controller={name}", *overrides])
    return make_law(make_mission(scenario), make_nominal_plant(scenario))


def turned(q, change):
    """q after rotation vector, displacement and joint angles (11)."""
    angle = np.linalg.norm(change[:3])
    axis = change[:3] / angle if angle > 0.0 else np.array([1.0, 0.0, 0.0])
    turn = RotationMatrix(AngleAxis(angle, axis)) @ RotationMatrix(Quaternion(q[:4]))
    return np.concatenate([turn.ToQuaternion().wxyz(), q[4:] + change[3:]])


def sample_of(seed, size=4e-3):
    """Moving fast, so that forces change along the prediction; first after others."""
    random = np.random.default_rng(seed)
    error, rate = size * random.normal(size=(2, 11))
    v_d = np.concatenate([0.05 * random.normal(size=6), 0.8 * random.normal(size=5)])
    q_d = turned(FIRST, error)
    zeros = np.zeros(11)
    return Sample(FIRST, v_d - rate, q_d, v_d, zeros, error, rate, zeros, True)


@pytest.mark.smoke
def test_without_limits_it_is_the_regulator():
    own, other = law_of("nmpc"), law_of("mpc")
    for seed in range(5):
        sample = sample_of(seed, size=1e-2)
        force, memory = own.step(sample, own.initial_state())
        expected, _ = other.step(sample, other.initial_state())
        np.testing.assert_allclose(force, expected, rtol=1e-12, atol=1e-12)
        assert memory["programs"] == memory["fallbacks"] == 0


@pytest.mark.slow
def test_with_limits_it_is_the_optimum_of_the_nonlinear_program():
    """Against SLSQP on a prediction and costs written here."""
    law = law_of("nmpc", LIMITS, "controllers.nmpc.solutions=8", "controllers.nmpc.iterations=100")
    linear = law_of("mpc", LIMITS, "controllers.mpc.iterations=100")
    sample = sample_of(3)
    commanded, memory = law.step(sample, law.initial_state())
    assert memory["programs"] >= 2
    assert memory["fallbacks"] == 0
    found, weight, size = memory["planned"], law.regulator[:, 2], 11

    def forces(c):
        e, rate, rows = sample.e, sample.e_dot, []
        for k, own in enumerate(c.reshape(STEPS, size)):
            u = own - law.regulator[:, 0] * e - law.regulator[:, 1] * rate
            planned = turned(sample.q_d, T * k * sample.v_d)
            q = turned(planned, -e)
            rows.append(law.model.calc_inverse_dynamics(q, sample.v_d - rate, u))
            e, rate = e + T * rate - 0.5 * T * T * u, rate - T * u
        # at a first sample nothing is known of the bias: that of now is not in the force
        bias = law.model.calc_bias(turned(sample.q_d, -sample.e), sample.v_d - sample.e_dot)
        return np.array(rows) - bias

    bound = law.limits.force
    assert (np.abs(forces(found)) <= bound * (1.0 + 1e-4)).all()
    assert (np.abs(forces(found)) >= bound * (1.0 - 1e-4)).any()
    solved = minimize(
        lambda c: 1e3 * (c * c * np.tile(weight, STEPS)).sum() / weight.mean(),
        np.zeros(STEPS * size),
        jac=lambda c: 2e3 * c * np.tile(weight, STEPS) / weight.mean(),
        constraints={
            "type": "ineq",
            "fun": lambda c: np.concatenate(
                [(1.0 - forces(c) / bound).ravel(), (1.0 + forces(c) / bound).ravel()]
            ),
        },
        method="SLSQP",
        options={"maxiter": 60, "ftol": 1e-10},
    )
    assert solved.success
    largest = np.abs(solved.x).max()
    np.testing.assert_allclose(found, solved.x, atol=5e-3 * largest)
    # the forces of the nonlinear prediction matter
    other, _ = linear.step(sample, linear.initial_state())
    assert np.abs(commanded - other).max() > 0.02 * bound.min()


@pytest.mark.slow
def test_past_its_bound_it_goes_on_with_the_shifted_solution():
    law = law_of("nmpc", LIMITS)
    state = law.step(sample_of(3), law.initial_state())[1]
    assert state["fallbacks"] == 0
    c = state["planned"].reshape(STEPS, 11)
    assert c.any()
    stopped = law_of("nmpc", LIMITS, "controllers.nmpc.iterations=1")
    force, memory = stopped.step(sample_of(3), {**stopped.initial_state(), "planned": c.ravel()})
    assert memory["fallbacks"] == 1
    shifted = c + law.sample_time / T * (np.vstack([c[1:], np.zeros((1, 11))]) - c)
    np.testing.assert_allclose(memory["planned"], shifted.ravel())
    unlimited = law_of("nmpc")
    alone, _ = unlimited.step(sample_of(3), unlimited.initial_state())
    expected = alone + law.model.calc_mass_matrix(FIRST) @ shifted[0]
    np.testing.assert_allclose(force, np.clip(expected, -law.limits.force, law.limits.force))


@pytest.mark.long
def test_from_far_off_it_is_as_good_as_the_linear_program():
    """50 deg off in two joints; figures of docs/validation/control.md."""
    start, found = np.concatenate([FIRST, np.zeros(11)]), {}
    start[7:9] -= np.deg2rad(50.0)
    for name in ("mpc", "nmpc"):
        scenario = load_scenario("postcapture", [EXACT, f"controller={name}", LIMITS])
        course = flown(scenario, resting, 14.0, start=start)
        assert course.memory["fallbacks"][-1] == 0
        assert course.memory["programs"][-1] > 1000
        assert np.abs(course.error[-1]).max() < 3e-3
        time = 0.01 * np.arange(len(course.error))
        found[name] = 0.01 * (time[:, None] * np.abs(course.error)).sum()
    assert found["nmpc"] == pytest.approx(21.19, abs=0.02)
    assert found["mpc"] == pytest.approx(21.23, abs=0.02)
