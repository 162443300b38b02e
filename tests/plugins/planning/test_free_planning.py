"""Plans of what is driven alone: force, the base's turn, runs that go as planned."""

import numpy as np
import pytest
from pydrake.math import RotationMatrix
from scipy.spatial.transform import Rotation

from ffsm_drake import ScenarioError, load_scenario, make_nominal_plant, simulate
from ffsm_drake.plugins.planning.inverse_dynamics import (
    FreeDynamics,
    InverseDynamics,
    complex_step,
    turned,
)
from ffsm_drake.plugins.planning.planner import PlanningError, plan_motion
from ffsm_drake.spacecraft.free_floating import free_floating

JOINTS = ("actuation.driven=[joints]",)
ARM = (
    *JOINTS,
    "initial_velocity=0",
    "reference.goal=target_posture",
    "planning.end_rate=0",
    "planning.segments=6",
    "target_posture.joints={joint_1: -0.65, joint_2: 1.15, joint_3: 0.6}",
    "reference.duration=8",
)


def turn(positions):
    return 2.0 * np.arccos(np.clip(np.abs(positions[:, :4] @ positions[0, :4]), 0.0, 1.0)).max()


def base_turn(record):
    return turn(record.dataset.position.values)


@pytest.fixture(scope="module")
def arm():
    return plan_motion(load_scenario("planar_detumble", ARM))


@pytest.mark.parametrize("driven", [("joints",), ("base_rotation", "joints")])
def test_force_and_rates_are_those_of_the_reduced_dynamics(driven):
    model = make_nominal_plant(
        load_scenario("free_floating", [f"actuation.driven=[{', '.join(driven)}]"])
    )
    size, joints = model.coordinates.driven.size, len(model.coordinates.joints)
    mass = model.plant.CalcTotalMass(model.context)
    whole = InverseDynamics(model, RotationMatrix())
    dynamics = FreeDynamics(whole, model.coordinates.driven, 6 + joints, mass)
    motion = z, rate, acceleration = np.random.default_rng(0).normal(size=(3, size, 20))
    z[: size - joints] = 0.0
    found, by = complex_step(dynamics.calc, motion)
    q = np.zeros((20, 7 + joints))
    q[:, 0], q[:, 7:] = 1.0, z[size - joints :].T
    stack = free_floating(model, q, driven)
    v = stack.velocity(rate.T)
    a = np.zeros_like(v)
    a[:, stack.driven] = acceleration.T
    taken = found[:size].T, found[size : size + 3].T
    force = model.calc_tracking_force(q, v, np.zeros_like(v)) - model.calc_bias(q, v)  # damping
    force = force[:, stack.driven] + stack.reduced_bias(model.calc_bias(q, v))
    force += (stack.reduced_mass_matrix @ acceleration.T[..., None])[..., 0]
    assert taken[0] == pytest.approx(force, abs=1e-10)
    if driven == ("joints",):
        assert taken[1] == pytest.approx(v[:, :3], abs=1e-12)
    step = 1e-5
    sides = [
        dynamics.calc(z, rate + sign * step * np.eye(size)[:, [1]], acceleration)
        for sign in (1.0, -1.0)
    ]
    assert by[1, :, 1] == pytest.approx((sides[0] - sides[1]) / (2.0 * step), abs=1e-6)


@pytest.mark.smoke
def test_small_rotations_add_up_and_their_derivatives_are_exact():
    def rates(times, extra):
        w = np.array([0.3 * np.cos(times), 0.2 + extra * times, 0.4 * np.sin(2.0 * times)]).T
        alpha = np.array([-0.3 * np.sin(times), 0.0 * times + extra, 0.8 * np.cos(2.0 * times)]).T
        return w, alpha

    def last(count, extra):
        times = np.linspace(0.0, 2.0, count)
        by = np.zeros((count, 6, 1))
        by[:, 1, 0], by[:, 4, 0] = times, 1.0
        steps = np.diff(times)
        rotation, turning = turned(*rates(times, extra), by, steps, np.zeros((count - 1, 1)))
        return Rotation.from_matrix(rotation[-1]).as_rotvec(), rotation[-1], turning[-1, :, 0]

    finest = last(3201, 0.1)[0]
    errors = [np.linalg.norm(last(count, 0.1)[0] - finest) for count in (21, 41)]
    assert errors[0] < 2e-5
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.2)  # of fourth order
    step = 1e-6
    change = last(21, 0.1 + step)[1] @ last(21, 0.1 - step)[1].T
    assert last(21, 0.1)[2] == pytest.approx(
        Rotation.from_matrix(change).as_rotvec() / (2.0 * step), abs=1e-8
    )


@pytest.mark.long
def test_a_run_turns_the_base_as_planned(arm, tmp_path):
    assert all(margin.kept for margin in arm.margins)
    assert (
        max(
            abs(margin.value / margin.limit) for margin in arm.margins if margin.quantity == "force"
        )
        > 0.9
    )
    assert np.abs(arm.force[:, :6]).max() < 1e-9
    path = tmp_path / "plan.yaml"
    arm.plan.save(path, title="of joints")
    over = [
        *ARM,
        "reference.kind=optimal",
        f"reference.plan={path}",
        "controller=computed_torque",
        "duration=6",
    ]
    record = simulate(load_scenario("planar_detumble", over), check_stability=False)
    assert record.outcome.completed
    assert base_turn(record) == pytest.approx(turn(arm.rows), abs=1e-5)
    assert np.abs(record.dataset.generalized_force.values[:, 6:]).max() <= 0.5
    assert record.dataset.position.values[-1, 7:] == pytest.approx([-0.65, 1.15, 0.6], abs=1e-5)


@pytest.mark.long
def test_a_run_starts_where_the_plan_does(tmp_path):
    path = tmp_path / "plan.yaml"
    place = "initial_posture.base_position=[0.08, 0.2, -0.08]"
    over = [*ARM, place, "target_posture.base_position=[0.08, 0.2, -0.08]"]
    plan_motion(load_scenario("planar_detumble", over)).plan.save(path, title="from elsewhere")
    over += ["reference.kind=optimal", f"reference.plan={path}", "duration=1"]
    over += ["controller=computed_torque"]
    record = simulate(load_scenario("planar_detumble", over), check_stability=False)
    assert np.abs(record.dataset.error.values).max() < 1e-3


@pytest.mark.long
def test_the_solver_stops_when_it_gains_no_more():
    """Without, this one took 4303 evaluations."""
    found = plan_motion(
        load_scenario(
            "planar_detumble",
            [*ARM, "reference.duration=20", "planning.base_attitude_limit=0.0053"],
        )
    )
    assert found.evaluations < 1500
    assert not found.exceeded


@pytest.mark.long
def test_the_base_turns_no_further_than_it_may(arm):
    limit = 0.8 * turn(arm.rows)
    found = plan_motion(
        load_scenario("planar_detumble", [*ARM, f"planning.base_attitude_limit={limit}"])
    )
    assert all(margin.kept for margin in found.margins)
    assert 0.97 * limit < turn(found.rows) < 1.002 * limit
    assert found.plan.duration > arm.plan.duration


@pytest.mark.long
def test_wheels_take_a_tumble_out_while_the_position_drifts():
    over = [
        "actuation.driven=[base_rotation, joints]",
        "capture.approach=null",
        "capture.rate=[0.035, 0, 0]",
        "reference.goal=stop",
        "planning.segments=4",
    ]
    scenario = load_scenario("tumbling_capture", over)
    found = plan_motion(scenario)
    assert all(margin.kept for margin in found.margins)
    assert found.angular_momentum > 0.5
    assert found.momentum_left < 1e-12
    assert np.abs(found.force[:, 3:6]).max() < 1e-9
    q, v, _ = np.split(found.rows[[0, -1]], [12, 23], axis=1)
    first, last = free_floating(make_nominal_plant(scenario), q, scenario.driven).momentum(v)
    assert np.abs(first[3:]).max() > 0.1
    assert last[3:] == pytest.approx(first[3:], abs=1e-9)
    assert np.abs(np.delete(v[1], [3, 4, 5])).max() < 1e-12


@pytest.mark.parametrize(
    ("override", "said"),
    [
        (
            "planning.velocity_limit={base_rotation: 1}",
            "planning.velocity_limit.base_rotation: is undriven",
        ),
        (
            "planning.impulse_limit={base_rotation_y: 1}",
            "planning.impulse_limit.base_rotation_y: is undriven",
        ),
        ("initial_velocity.base_rotation_y=0.01", "actuation.driven: joints cannot remove"),
    ],
)
def test_what_cannot_be_planned_is_named(override, said):
    with pytest.raises((PlanningError, ScenarioError), match=said):
        plan_motion(load_scenario("planar_detumble", [*ARM, override]))
