"""Predictive control: the regulator where nothing is limited, the optimum where something is."""

import numpy as np
import pytest
from own_loop import EXACT, FIRST, flown, resting
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.solvers import ClarabelSolver, MathematicalProgram
from scipy.linalg import solve_discrete_are
from scipy.optimize import lsq_linear

from ffsm_drake import load_scenario, make_nominal_plant, simulate
from ffsm_drake.mission import make_mission
from ffsm_drake.scenario import thrusters_of
from ffsm_drake.systems.controllers import Sample, make_law

T = 0.1  # s
A, B = np.array([[1.0, T], [0.0, 1.0]]), np.array([-0.5 * T * T, -T])


def law_of(*overrides):
    scenario = mpc(*overrides)
    return make_law(make_mission(scenario), make_nominal_plant(scenario))


def sample_of(error, rate):
    zeros = np.zeros(11)
    return Sample(FIRST, -rate, FIRST, zeros, zeros, error, rate, zeros, True)


def costs(law):
    """The weights of error, rate and acceleration (3, 11), and what is still to pay (11, 2, 2)."""
    sizes = np.array([law.error_size, law.rate_size, law.acceleration_size])
    weights = sizes**-2.0
    to_go = [solve_discrete_are(A, B[:, None], np.diag(w[:2]), w[2:, None]) for w in weights.T]
    return weights, to_go


def mpc(*overrides):
    return load_scenario("postcapture", [EXACT, "controller=mpc", *overrides])


def in_body_axes(states, wrenches):
    """Torques and forces (n, 2, 3) of the base."""
    turned = (RotationMatrix(Quaternion(q / np.linalg.norm(q))).matrix() for q in states[:, :4])
    return np.array([w[:6].reshape(2, 3) @ R for R, w in zip(turned, wrenches, strict=True)])


@pytest.mark.smoke
def test_without_limits_it_is_the_regulator():
    law, random = law_of(), np.random.default_rng(0)
    error, rate = 1e-2 * random.normal(size=(2, 11))
    force, memory = law.step(sample_of(error, rate), law.initial_state())
    accelerations = []
    (_, _, weights), to_go = costs(law)
    for *state, r, P in zip(error, rate, weights, to_go, strict=True):
        K = B @ P @ A / (r + B @ P @ B)
        accelerations.append(-K @ state)
    # at a first sample nothing is known of the bias
    expected = law.model.calc_mass_matrix(FIRST) @ np.array(accelerations)
    np.testing.assert_allclose(force, expected, rtol=1e-9, atol=1e-9)
    assert memory["programs"] == memory["fallbacks"] == 0


@pytest.mark.slow
def test_with_limits_it_is_the_optimum_of_the_program():
    """Against the program in states and accelerations, with costs summed as they are."""
    limits = "actuation.limit={base_rotation: 20, base_position: 8, joints: 15}"
    law, free = law_of(limits, "controllers.mpc.iterations=100"), law_of()
    random = np.random.default_rng(2)
    error, rate = 0.02 * random.normal(size=(2, 11))
    commanded, memory = law.step(sample_of(error, rate), law.initial_state())
    assert memory["programs"] == 1
    assert memory["fallbacks"] == 0
    H = law.model.calc_mass_matrix(FIRST)
    program, steps = MathematicalProgram(), 5
    u = program.NewContinuousVariables(steps, 11)
    x = program.NewContinuousVariables(steps + 1, 22)
    slack = program.NewContinuousVariables(1)
    (q, q_rate, r), to_go = costs(law)
    program.AddLinearEqualityConstraint(np.eye(22), np.concatenate([error, rate]), x[0])
    program.AddBoundingBoxConstraint(0.0, np.inf, slack)
    program.AddLinearCost(1e6 * slack[0])
    for k in range(steps):
        after = np.kron(A, np.eye(11)), np.kron(B[:, None], np.eye(11))
        program.AddLinearEqualityConstraint(
            np.hstack([*after, -np.eye(22)]), np.zeros(22), np.concatenate([x[k], u[k], x[k + 1]])
        )
        program.AddQuadraticCost(2.0 * np.diag([*q, *q_rate]), np.zeros(22), x[k])
        program.AddQuadraticCost(2.0 * np.diag(r), np.zeros(11), u[k])
        over = -law.limits.force[:, None] * (k > 0)
        endless, limit, variables = np.full(11, np.inf), law.limits.force, [*u[k], *slack]
        program.AddLinearConstraint(np.hstack([H, over]), -endless, limit, variables)
        program.AddLinearConstraint(np.hstack([-H, over]), -endless, limit, variables)
    for i, each in enumerate(to_go):
        program.AddQuadraticCost(2.0 * each, np.zeros(2), x[steps, [i, 11 + i]])
    found = ClarabelSolver().Solve(program)
    expected = H @ found.GetSolution(u[0])
    np.testing.assert_allclose(commanded, expected, atol=1e-3 * np.abs(expected).max())
    unlimited, _ = free.step(sample_of(error, rate), free.initial_state())
    clipped = np.clip(unlimited, -law.limits.force, law.limits.force)
    assert np.abs(commanded - clipped).max() > 0.1 * np.abs(expected).max()


@pytest.mark.long
def test_forces_and_joint_rates_keep_to_their_limits():
    limits = [
        "actuation.limit={base_rotation: 30, base_position: 20, joints: 20}",
        "actuation.drives={rate_limit: {all: 0.05}}",
    ]
    start = np.concatenate([FIRST, np.zeros(11)])
    start[7:12] += 0.3
    course = flown(mpc(*limits), resting, 12.0, start=start)
    assert np.abs(course.state[:, 18:]).max() < 0.0505
    assert (np.abs(course.force) <= course.law.limits.force * (1.0 + 1e-9)).all()
    assert course.memory["programs"][-1] > 100
    assert course.memory["fallbacks"][-1] == 0
    assert np.abs(course.error[-1]).max() < 2e-3
    assert np.abs(flown(mpc(limits[0]), resting, 12.0, start=start).state[:, 18:]).max() > 0.08


@pytest.mark.long
def test_wheels_keep_to_their_torque_and_momentum():
    """A turn of 0.2 rad, faster than the wheels allow without the program."""
    start = np.concatenate([FIRST, np.zeros(11)])
    start[:4] = [np.cos(0.1), 0.0, 0.0, np.sin(0.1)]
    unit = "torque_limit: 5.0, inertia: 0.08, speed_limit: 50.0"
    units = ", ".join(
        f"{name}: {{axis: {axis}, {unit}}}"
        for name, axis in (("x", [1, 0, 0]), ("y", [0, 1, 0]), ("z", [0, 0, 1]))
    )
    course = flown(mpc(f"actuation.wheels={{units: {{{units}}}}}"), resting, 20.0, start=start)
    torque = in_body_axes(course.state, course.force)[:, 0]
    assert np.abs(torque).max() == pytest.approx(5.0, rel=1e-4)
    assert 3.5 < np.abs(course.memory["wheel_momentum"]).max() < 4.1
    assert course.memory["fallbacks"][-1] == 0
    assert np.abs(course.error[-1, :3]).max() < 0.03


@pytest.mark.slow
def test_past_its_bound_it_cuts_the_regulators_force():
    limits = "actuation.limit={base_rotation: 20, base_position: 8, joints: 15}"
    law, free = law_of(limits, "controllers.mpc.iterations=1"), law_of()
    error, rate = 0.02 * np.random.default_rng(2).normal(size=(2, 11))
    force, memory = law.step(sample_of(error, rate), law.initial_state())
    assert memory["fallbacks"] == 1
    unlimited, _ = free.step(sample_of(error, rate), free.initial_state())
    bound = law.limits.force
    np.testing.assert_allclose(force, np.clip(unlimited, -bound, bound), rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("controller", "least", "most"), [("mpc", 0.0, 1e-6), ("computed_torque", 1e-3, 1.0)]
)
def test_a_constant_disturbance_leaves_no_error(controller, least, most):
    scenario = load_scenario("postcapture", [EXACT, f"controller={controller}"])
    course = flown(scenario, resting, 10.0, disturbance=lambda _: np.full(11, 0.5))
    assert least <= np.abs(course.error[-1]).max() < most


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits():
    scenario = load_scenario(
        "flight_sensors", ["controller=mpc", "duration=2", "actuation.limit.joints=2"]
    )
    one, other = (simulate(scenario, check_stability=False).dataset for _ in range(2))
    assert one.identical(other)
    assert np.abs(one["generalized_force"]).values[:, 6:].max() == pytest.approx(2.0)


@pytest.mark.long
def test_the_base_asks_no_more_than_its_thrusters_give():
    """Each commanded wrench against a linear program over the thrusters."""
    start = np.concatenate([FIRST, np.zeros(11)])
    start[:7] = [np.cos(0.05), 0.0, 0.0, np.sin(0.05), 0.1, -0.05, 0.0]
    scenario = mpc("actuation.thrusters={layout: 12x5N}")
    course = flown(scenario, resting, 6.0, start=start)
    units = thrusters_of(scenario.actuation.thrusters).values()
    force = np.array([np.multiply(unit.force, unit.direction) for unit in units]).T
    jets = np.vstack([np.cross([unit.position for unit in units], force.T).T, force])
    beyond = []
    for wrench in in_body_axes(course.state[::5], course.force[::5]).reshape(-1, 6):
        found = lsq_linear(jets, wrench, (0.0, 1.0))
        beyond.append(np.abs(jets @ found.x - wrench).max())
    assert max(beyond) < 1e-3
    assert course.memory["programs"][-1] > 10
    assert course.memory["fallbacks"][-1] == 0
    assert np.abs(course.error[-1]).max() < 0.02
    assert np.abs(flown(mpc(), resting, 0.02, start=start).force[0, 3:6]).max() > 2.0 * force.max()
