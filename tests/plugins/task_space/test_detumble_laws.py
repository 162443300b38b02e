"""The two published ways to detumble: TVLQR about the plan, torque against the angular momentum."""

import numpy as np
import pytest
from pydrake.systems.controllers import (
    FiniteHorizonLinearQuadraticRegulator,
    FiniteHorizonLinearQuadraticRegulatorOptions,
    LinearQuadraticRegulator,
)
from pydrake.systems.primitives import TrajectoryLinearSystem
from pydrake.trajectories import PiecewisePolynomial
from scipy.linalg import solve_discrete_are

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.planning.tvlqr import discretized, linearized, moved
from ffsm_drake.plugins.task_space.torque_against_momentum import angular_momentum
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.scenario import load_scenario
from ffsm_drake.spacecraft.coordinates import error_rate, position_error
from ffsm_drake.spacecraft.craft import make_nominal_plant, make_true_plant
from ffsm_drake.systems.controllers import make_controller, make_law
from ffsm_drake.systems.reference import make_motion

TUMBLING = ["capture.approach=null", "controller=tvlqr", "reference.duration=2"]


@pytest.fixture(scope="module")
def model():
    return make_nominal_plant(load_scenario("tumbling_capture"))


def state(generator, size=11):
    q = generator.normal(size=size + 1)
    q[:4] /= np.linalg.norm(q[:4])
    return q, 0.3 * generator.normal(size=size), 0.3 * generator.normal(size=size)


def test_the_errors_obey_the_linearised_equation(model):
    generator, h = np.random.default_rng(0), 1e-4
    q_d, v_d, a_d = state(generator)
    A, B = linearized(model, q_d, v_d, a_d)
    for _ in range(3):
        away, rate, u = 1e-4 * generator.normal(size=(3, 11)) * [[1.0], [1.0], [100.0]]
        q, v = moved(q_d, away), v_d + rate
        force = model.calc_inverse_dynamics(q_d, v_d, a_d) + u
        a = np.linalg.solve(model.calc_mass_matrix(q), force - model.calc_bias(q, v))

        def error(t, q=q, v=v, a=a):
            """[e; e'] of two motions of constant acceleration, a little later."""
            there, here = (
                moved(p, t * w + 0.5 * t * t * c) for p, w, c in ((q_d, v_d, a_d), (q, v, a))
            )
            e = position_error(there, here)
            return np.concatenate([e, error_rate(e, v_d + t * a_d, v + t * a)])

        found = (error(h) - error(-h)) / (2 * h)
        expected = A @ error(0.0) + B @ u
        assert found == pytest.approx(expected, abs=2e-3 * np.abs(expected).max())


@pytest.mark.smoke
def test_its_gains_are_those_of_the_riccati_equation():
    scenario = load_scenario("tumbling_capture", TUMBLING)
    law, model = (
        make_law(make_mission(scenario), make_nominal_plant(scenario)),
        make_nominal_plant(scenario),
    )
    end = make_motion(make_mission(scenario)).evaluate(2.0)
    a, b = discretized(*linearized(model, *end), 0.01)
    effort = np.diag(law.force_size**-2.0)
    cost = solve_discrete_are(
        a, b, np.diag(np.concatenate([law.error_size, law.rate_size]) ** -2.0), effort
    )
    expected = -np.linalg.solve(effort + b.T @ cost @ b, b.T @ cost @ a)
    assert law.gains.shape == (201, 11, 22)
    assert law.gains[-1] == pytest.approx(expected, rel=1e-4, abs=1e-4 * np.abs(expected).max())
    assert np.abs(law.gains[0] - law.gains[-1]).max() > 0.01 * np.abs(expected).max()  # they vary


@pytest.mark.long
def test_its_gains_are_those_of_the_regulator_in_continuous_time():
    """Drake's finite-horizon regulator, with the published weights, whose base position takes a
    minute to settle. 1.0 % is left by sampling at 2 ms, 0.5 % at 1 ms.
    """
    published = {
        "error_size": {"base_rotation": 6.3245553e-3, "base_position": 3.1622777, "joints": 0.1},
        "rate_size": {"base_rotation": 4.472136e-3, "base_position": 1.0, "joints": 3.1622777e-2},
        "force_size": {"base_rotation": 3.1622777, "base_position": 1.0, "joints": 0.1},
    }
    scenario = load_scenario("planar_detumble", ["controller=tvlqr", "sample_time=0.002"])
    scenario = scenario.replace(controllers={"tvlqr": published})
    model = make_nominal_plant(scenario)
    law, motion = make_law(make_mission(scenario), model), make_motion(make_mission(scenario))
    times = np.linspace(0.0, motion.end, 101)
    a, b = zip(*(linearized(model, *motion.evaluate(time)) for time in times), strict=True)
    weight = np.diag(np.concatenate([law.error_size, law.rate_size]) ** -2.0)
    effort = np.diag(law.force_size**-2.0)
    system = TrajectoryLinearSystem(
        *(PiecewisePolynomial.FirstOrderHold(times, np.array(each)) for each in (a, b)),
        PiecewisePolynomial(np.eye(18)),
        PiecewisePolynomial(np.zeros((18, 9))),
    )
    options = FiniteHorizonLinearQuadraticRegulatorOptions()
    final = LinearQuadraticRegulator(a[-1], b[-1], weight, effort)[1]
    options.Qf = 0.5 * (final + final.T)
    options.x0, options.u0 = (PiecewisePolynomial(np.zeros((rows, 1))) for rows in (18, 9))
    regulator = FiniteHorizonLinearQuadraticRegulator(
        system, system.CreateDefaultContext(), 0.0, motion.end, weight, effort, options
    )
    for time in (0.0, 1.0, 2.0, 5.0):
        expected = -regulator.K.value(time)
        found = law.gains[round(time / 0.002)]
        for i, row in enumerate(expected):
            assert found[i] == pytest.approx(row, abs=0.015 * np.abs(row).max())


def test_tvlqr_follows_the_plan_to_rest():
    sets = ["controller=tvlqr", "duration=3.6"]
    log = Rollout(load_scenario("planar_detumble", sets)).run()
    assert np.abs(log.error).max() < 1e-4
    assert np.abs(log.series["state"][-1, 10:]).max() < 1e-3


def test_sizes_that_are_too_far_apart():
    sets = ["controller=tvlqr", "controllers.tvlqr={error_size: 1.0e-20}"]
    scenario = load_scenario("planar_detumble", sets)
    with pytest.raises(ScenarioError, match=r"controllers\.tvlqr: has no regulator in double"):
        make_controller(make_mission(scenario), make_nominal_plant(scenario))


def test_tvlqr_needs_the_plan():
    scenario = load_scenario("tumbling_capture", [*TUMBLING, "blocks.reference={system: 'a:b'}"])
    with pytest.raises(ScenarioError, match="tvlqr needs the planned motion"):
        make_controller(make_mission(scenario), make_nominal_plant(scenario))


def test_angular_momentum_is_that_about_the_centre_of_mass(model):
    plant, context = model.plant, model.context
    for seed in range(3):
        q, v, _ = state(np.random.default_rng(seed))
        found = angular_momentum(model.calc_mass_matrix(q), v)
        plant.SetPositionsAndVelocities(context, np.concatenate([q, v]))
        center = plant.CalcCenterOfMassPositionInWorld(context)
        drakes = plant.CalcSpatialMomentumInWorldAboutPoint(context, center).rotational()
        assert found == pytest.approx(drakes, rel=1e-10, abs=1e-10)


def test_torque_against_momentum_takes_the_least_time():
    gains = "controllers.torque_against_momentum={torque: 0.6, k_p: 0.05, k_d: 0.4, decay: 0.05}"
    sets = ["controller=torque_against_momentum", "duration=7", "sensing.velocity_noise=0", gains]
    scenario = load_scenario("planar_detumble", sets)
    log, true = Rollout(scenario).run(), make_true_plant(scenario)
    size = [
        np.linalg.norm(angular_momentum(true.calc_mass_matrix(row[:10]), row[10:]))
        for row in log.series["state"][::10]
    ]
    bound = size[0] / 0.6
    assert np.interp(0.5 * bound, log.time[::10], size) == pytest.approx(0.5 * size[0], rel=0.01)
    assert np.interp(bound, log.time[::10], size) < 0.02 * size[0]
    assert size[-1] < 1e-3 * size[0]
    assert np.abs(log.generalized_force[:, 3:6]).max() == 0.0
