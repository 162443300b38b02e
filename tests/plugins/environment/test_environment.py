"""The orbit's forces against closed forms, another program's figures, and momentum and energy."""

import dataclasses

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, JacobianWrtVariable, RotationalInertia, SpatialInertia
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from refusals import assert_refused

from ffsm_drake import load_scenario
from ffsm_drake.plugins.analysis.balances import energy_residual
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.environment.environment import EnvironmentForce, orbital_force
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.scenario import NOTHING, Approach, Environment, Scenario, SolarPressure
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.craft import Craft, make_true_plant
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.orbit import EARTH_GRAVITY, mean_motion
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.sampled import SampledSystem

# D-SPOSE 1.0.0 (github.com/McGill-AML/D-SPOSE), input/ and output/expected-output/: Envisat, TEME
# axes. kg m^2
ENVISAT = np.array(
    [[17023.3, 397.1, -2171.4], [397.1, 124825.7, 344.2], [-2171.4, 344.2, 129112.2]]
)
START = {
    "position": (-6.8513213592900028e06, -2.0360812531800000e06, 5.1209100002888590e01),  # m
    "velocity": (-3.0342360099999678e02, 1.0515137020000006e03, 7.3889006430000009e03),  # m/s
    "rate": (0.0, 0.0, 5.0614548307835558e-02),  # rad/s, body axes
    "quaternion": (
        6.3385515879563592e-01,
        3.4429412470306686e-01,
        5.5596281630038358e-01,
        -4.1303091924752378e-01,
    ),
}
AFTER_10_S = {
    "rate": (4.7707658898355507e-04, 5.5383522698853780e-04, 5.0624151370082866e-02),
    "quaternion": (
        7.1594026177812464e-01,
        4.7380278817532273e-01,
        4.5246184760099001e-01,
        -2.4128559001287089e-01,
    ),
}


UNIT = np.eye(3)


def free_plant(mass: float, inertia: np.ndarray) -> MultibodyPlant:
    """A single free body, about its centre of mass."""
    plant = MultibodyPlant(time_step=0.0)
    central = RotationalInertia(*inertia.diagonal(), inertia[0, 1], inertia[0, 2], inertia[1, 2])
    plant.AddRigidBody("body", SpatialInertia.MakeFromCentralInertia(mass, np.zeros(3), central))
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    plant.Finalize()
    return plant


def coast(
    settings: Environment, state, *, duration, mass=1.0, inertia=UNIT, sample_time=0.1, step=0.1
):
    """The state [q; v] of a free body after a time in the environment."""
    builder, own = DiagramBuilder(), free_plant(mass, inertia)
    plant = builder.AddSystem(free_plant(mass, inertia))
    model = PlantModel(
        plant=own, context=own.CreateDefaultContext(), coordinates=Coordinates((), ())
    )
    block = EnvironmentForce(force=orbital_force(settings, model), craft=Craft(Scenario()))
    system = builder.AddSystem(
        SampledSystem(block, name="environment", sample_time=sample_time, held=True)
    )
    builder.Connect(plant.get_state_output_port(), system.GetInputPort("state"))
    builder.Connect(
        system.GetOutputPort("generalized_force"), plant.get_applied_generalized_force_input_port()
    )
    simulator = Simulator(builder.Build())
    config = SimulatorConfig(
        integration_scheme="runge_kutta3",
        max_step_size=min(sample_time, step),
        use_error_control=False,
    )
    ApplySimulatorConfig(config, simulator)
    context = simulator.get_mutable_context()
    plant.SetPositionsAndVelocities(plant.GetMyMutableContextFromRoot(context), state)
    system.set_initial_state(system.GetMyMutableContextFromRoot(context), state)
    simulator.AdvanceTo(duration)
    return plant.GetPositionsAndVelocities(plant.GetMyContextFromRoot(context)).copy()


def hill_frame(radial, along) -> list[float]:
    """Roll, pitch, yaw of Hill's frame from directions away from the Earth and along the flight."""
    x = np.array(radial) / np.linalg.norm(radial)
    z = np.cross(radial, along)
    z /= np.linalg.norm(z)
    return RollPitchYaw(RotationMatrix(np.column_stack([x, np.cross(z, x), z]))).vector().tolist()


def rotation(quaternion) -> np.ndarray:
    return RotationMatrix(Quaternion(np.array(quaternion) / np.linalg.norm(quaternion))).matrix()


def envisat_after(duration, *, faster=1.0, gravity_gradient=True, **values):
    """The state of D-SPOSE's Envisat after a time; its quaternion turns by its transpose, which is
    R_WB here.
    """
    motion = float(np.sqrt(EARTH_GRAVITY / np.linalg.norm(START["position"]) ** 3))
    frame = hill_frame(START["position"], START["velocity"])
    settings = Environment(
        altitude=None, mean_motion=motion, hill_rpy=frame, gravity_gradient=gravity_gradient
    )
    rate = faster * rotation(START["quaternion"]) @ START["rate"]
    state = np.concatenate([START["quaternion"], np.zeros(3), rate, np.zeros(3)])
    return coast(settings, state, duration=duration, mass=7827.867, inertia=ENVISAT, **values)


@pytest.mark.smoke
def test_envisat_turns_as_in_d_spose():
    after = envisat_after(10.0)
    rate = rotation(after[:4]).T @ after[7:10]
    np.testing.assert_allclose(rate, AFTER_10_S["rate"], rtol=0, atol=5e-8)
    np.testing.assert_allclose(after[:4], AFTER_10_S["quaternion"], rtol=0, atol=1e-7)
    free = envisat_after(10.0, gravity_gradient=False)
    without = rotation(free[:4]).T @ free[7:10]
    assert np.abs(without - AFTER_10_S["rate"]).max() > 5e-6  # what the gravity gradient is for


def clohessy_wiltshire(n: float, start: np.ndarray, time: float) -> np.ndarray:
    """Position and velocity (6) in Hill's frame."""
    x, y, z, u, v, w = start
    c, s = np.cos(n * time), np.sin(n * time)
    return np.array(
        [
            (4 - 3 * c) * x + s / n * u + 2 / n * (1 - c) * v,
            6 * (s - n * time) * x + y - 2 / n * (1 - c) * u + (4 * s - 3 * n * time) / n * v,
            c * z + s / n * w,
            3 * n * s * x + c * u + 2 * s * v,
            -6 * n * (1 - c) * x - 2 * s * u + (4 * c - 3) * v,
            -n * s * z + c * w,
        ]
    )


def drift(settings: Environment, start, time: float, **values) -> np.ndarray:
    """Where a free body comes to in Hill's frame (6) from a position and velocity there."""
    n, frame = mean_motion(settings), RollPitchYaw(settings.hill_rpy).ToRotationMatrix().matrix()
    turn = RotationMatrix(RollPitchYaw([0, 0, n * time])).matrix()
    position, velocity = np.split(np.array(start, dtype=float), 2)
    rate = np.array([0.0, 0.0, n])
    state = np.concatenate(
        [[1, 0, 0, 0], frame @ position, np.zeros(3), frame @ (velocity + np.cross(rate, position))]
    )
    after = coast(settings, state, duration=time, **values)
    in_hill = (frame @ turn).T
    return np.concatenate(
        [in_hill @ after[4:7], in_hill @ after[10:] - np.cross(rate, in_hill @ after[4:7])]
    )


def test_motion_about_the_orbit_is_clohessy_and_wiltshires():
    settings = Environment(hill_rpy=[0.3, -0.4, 1.0])
    start = np.array([10.0, -20.0, 5.0, 0.01, -0.02, 0.005])
    expected = clohessy_wiltshire(mean_motion(settings), start, 1400.0)  # a quarter of an orbit
    after = drift(settings, start, 1400.0, sample_time=1.0)
    for found, of in zip(np.split(after, 2), np.split(expected, 2), strict=True):
        np.testing.assert_allclose(found, of, rtol=0, atol=1e-5 * np.linalg.norm(of))


def test_holding_the_force_costs_the_square_of_the_sample():
    """In Envisat's tumble, ten times as fast; against a sample of 10 ms."""
    exact, coarse, fine = (
        envisat_after(4.0, faster=10.0, sample_time=period, step=0.01)[7:10]
        for period in (0.01, 0.2, 0.1)
    )
    errors = [np.linalg.norm(each - exact) for each in (coarse, fine)]
    assert errors[1] < 1e-8  # rad/s
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.2)


PANELS = (
    "model.flexible={left: {mass: 8, frequency: 0.25, position: [0, 1, 0]}, "
    "right: {mass: 8, frequency: 0.25, position: [0, -1, 0], direction: [0, -1, 0], axis: [-1, 0, "
    "0]}}"
)
SOLAR = SolarPressure(
    area=20.0, coefficient=1.5, sun=[0.0, 3.0, 4.0], center_of_pressure=[0.1, -0.2, 1.0]
)


def force_body_by_body(
    settings: Environment, model: PlantModel, q: np.ndarray, time: float
) -> np.ndarray:
    """The generalized force from each body's force and torque, by the transpose of its Jacobian."""
    plant, context = model.plant, model.context
    n, R_WH = mean_motion(settings), RollPitchYaw(settings.hill_rpy).ToRotationMatrix().matrix()
    radial = R_WH @ [np.cos(n * time), np.sin(n * time), 0.0]
    A = n**2 * (3.0 * np.outer(radial, radial) - np.eye(3))
    plant.SetPositions(context, q)
    together = plant.CalcCenterOfMassPositionInWorld(context)
    world, total = plant.world_frame(), np.zeros(plant.num_velocities())

    def jacobian(body, point):
        kind = JacobianWrtVariable.kV
        return plant.CalcJacobianSpatialVelocity(
            context, kind, body.body_frame(), point, world, world
        )

    for body in (plant.get_body(BodyIndex(index)) for index in range(1, plant.num_bodies())):
        M_BBo_B, X_WB = body.CalcSpatialInertiaInBodyFrame(context), body.EvalPoseInWorld(context)
        mass, center = M_BBo_B.get_mass(), X_WB @ M_BBo_B.get_com()
        inertia = M_BBo_B.Shift(M_BBo_B.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
        R_WB = X_WB.rotation().matrix()
        force, torque = np.zeros(3), np.zeros(3)
        if settings.gravity_gradient:
            force += mass * A @ (center - together)
            torque += 3.0 * n**2 * np.cross(radial, R_WB @ inertia @ R_WB.T @ radial)
        if settings.tidal:
            force += mass * A @ together
        total += jacobian(body, M_BBo_B.get_com()).T @ np.concatenate([torque, force])
        if settings.solar_pressure is not None and body.is_floating_base_body():
            solar = settings.solar_pressure
            sun = np.array(solar.sun) / np.linalg.norm(solar.sun)
            push = -solar.pressure * solar.coefficient * solar.area * sun
            total += jacobian(body, solar.center_of_pressure)[3:].T @ push
    return total


@pytest.mark.parametrize(
    "settings",
    [
        Environment(hill_rpy=[0.5, 0.2, -1.0]),
        Environment(altitude=None, mean_motion=5e-4, tidal=False),
        Environment(hill_rpy=[0.5, 0.2, -1.0], gravity_gradient=False),
        Environment(gravity_gradient=False, tidal=False, solar_pressure=SOLAR),
        Environment(solar_pressure=SOLAR),
    ],
)
@pytest.mark.parametrize(
    "scenario", [("postcapture",), ("planar_detumble",), ("postcapture", PANELS)]
)
def test_every_body_is_pulled_at(scenario, settings):
    model = Craft(load_scenario(scenario[0], scenario[1:])).flexible()
    rng = np.random.default_rng(1)
    q = rng.standard_normal(model.plant.num_positions())
    q[:4] /= np.linalg.norm(q[:4])
    expected = force_body_by_body(settings, model, q, 700.0)
    found = orbital_force(settings, model).calc(q, 700.0)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.smoke
def test_gravity_gradient_is_at_most_what_the_inertia_says():
    """Of the shipped stack, about its centre of mass, over all attitudes: 1.5 n^2 of the difference
    of inertias.
    """
    scenario = load_scenario("postcapture")
    model = make_true_plant(scenario)
    q = configuration(model.coordinates, scenario.initial_posture, key="initial_posture")
    H = model.calc_mass_matrix(q)
    # of the centre of mass, from H's coupling m [arm x]
    arm = np.array([H[2, 4], H[0, 5], H[1, 3]]) / H[3, 3]
    inertia = H[:3, :3] - H[3, 3] * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    moments, axes = np.linalg.eigh(inertia)
    radial = (axes[:, 0] + axes[:, 2]) / np.sqrt(2.0)
    settings = Environment(tidal=False, hill_rpy=hill_frame(radial, axes[:, 1]))
    force = orbital_force(settings, model).calc(q, 0.0)
    largest = 1.5 * mean_motion(settings) ** 2 * (moments[2] - moments[0])
    assert np.linalg.norm(force[:3]) == pytest.approx(largest, rel=1e-9)
    assert largest == pytest.approx(7.5e-4, rel=0.02)
    assert np.abs(force[3:6]).max() < 1e-15  # and no net force
    rng = np.random.default_rng(0)
    for _ in range(50):
        tilted = dataclasses.replace(settings, hill_rpy=rng.uniform(-3, 3, 3).tolist())
        assert np.linalg.norm(orbital_force(tilted, model).calc(q, 0.0)[:3]) <= largest * (1 + 1e-9)


QUIET = ("controller=tdc", "sensing.velocity_noise=0", "duration=2")
ORBIT = "environment={altitude: 500e3, hill_rpy: [0.1, 0.2, 0.3], solar_pressure: {area: 20}}"


def test_a_run_records_it_and_the_balances_close(run):
    data = run("postcapture", *QUIET, ORBIT).dataset
    scenario = load_scenario("postcapture", [*QUIET, ORBIT])
    force = orbital_force(scenario.environment, make_true_plant(scenario))
    for row in (0, 1, 77, 200):
        expected = force.calc(data["position"].values[row], float(data["time"][row]))
        found = data["force_environment"].values[row]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)
    total = data["force_environment"] + data["force_disturbance"]
    np.testing.assert_allclose(data["disturbance_force"], total, rtol=0, atol=1e-15)
    parts = energy_residual(data)
    assert np.abs(parts["residual"]).max() < 1e-9 * parts["absolute_work"][-1]
    without = run("postcapture", *QUIET).metrics["momentum_residual"]
    for name, size in run("postcapture", *QUIET, ORBIT).metrics["momentum_residual"].items():
        assert size < without[name] + 1e-9  # N s; the environment's impulse is 1e-3


def test_hidden_coordinates_are_pulled_at_and_the_balances_close(run):
    """With a fast orbit, so that what it does to the panels shows."""
    fast = "environment={altitude: null, mean_motion: 0.01}"
    soft = ("controllers.tdc.k_d=10", "controllers.tdc.k_p=10")
    data, still = (
        run("postcapture", *QUIET, PANELS, *soft, *more).dataset for more in ((fast,), ())
    )
    scenario = load_scenario("postcapture", [*QUIET, PANELS, fast])
    model = Craft(scenario).flexible()
    known = np.concatenate([data["position"], data["velocity"]], axis=1)
    hidden = np.concatenate([data["hidden_position"], data["hidden_velocity"]], axis=1)
    row = 77
    q = model.split.whole(known, hidden)[row, : model.plant.num_positions()]
    expected = orbital_force(scenario.environment, model).calc(q, float(data["time"][row]))
    for name, part in (
        ("force_environment", model.split.known),
        ("hidden_force", model.split.hidden),
    ):
        found = data[name].values[row]
        np.testing.assert_allclose(found, expected[part], rtol=0, atol=1e-12)
    power = (data["hidden_force"] * data["hidden_velocity"]).sum("hidden_coordinate")
    work = 0.01 * power.cumsum("time")
    changed = energy_residual(data)["residual"] - energy_residual(still)["residual"]
    assert np.abs(changed).max() < 0.05 * np.abs(work).max()


def test_without_control_it_moves_the_spacecraft(run):
    """The momentum is what the environment gives, to what integration makes of it."""
    free = "actuation.limit=1e-12", "disturbance.amplitude_scale=0"
    far = "initial_posture.base_position=[30, 0, 0]"
    data = run("postcapture", "controller=tdc", *free, "duration=2", ORBIT, far).dataset
    impulse = data["force_environment"].sel(coordinate="base_position_x").values[:-1].sum() * 0.01
    assert data["linear_momentum"].values[-1, 0] == pytest.approx(impulse, rel=1e-3)
    assert abs(impulse) > 1e-3


def test_another_payload_in_the_same_build():
    first = load_scenario("postcapture", [*QUIET, ORBIT, "duration=0.1"])
    other = load_scenario("postcapture", [*QUIET, ORBIT, "duration=0.1", "payload.truth.mass=300"])
    rollout = Rollout(first)
    before = rollout.run().series["force_environment"]
    changed = rollout.run(other).series["force_environment"]
    np.testing.assert_array_equal(changed, Rollout(other).run().series["force_environment"])
    np.testing.assert_array_equal(rollout.run().series["force_environment"], before)
    assert np.abs(changed - before).max() > 1e-5


def test_a_captured_target_is_pulled_at_from_the_grasp_on():
    shipped = load_scenario(
        "tumbling_capture",
        ["capture.approach.duration=0.1", "duration=0.2", "reference.duration=5", ORBIT],
    )
    capture = dataclasses.replace(
        shipped.capture, approach=Approach(duration=0.1, posture=shipped.initial_posture)
    )
    scenario = dataclasses.replace(shipped, capture=capture)
    log = make_rollout(scenario).run()
    whole = orbital_force(scenario.environment, make_true_plant(scenario))
    empty_handed = dataclasses.replace(scenario.payload, truth=NOTHING)
    alone = orbital_force(
        scenario.environment, make_true_plant(dataclasses.replace(scenario, payload=empty_handed))
    )
    for row, force in ((5, alone), (15, whole)):
        expected = force.calc(
            log.series["state"][row, : len(log.coordinates.names) + 1], log.time[row]
        )
        difference = log.series["force_environment"][row] - expected
        # the arm misses the target by a little
        assert np.abs(difference).max() < 0.02 * np.abs(expected).max()


def test_the_linear_loop_takes_it():
    """A slope of 1e-6 N/m per kg changes no pole that matters."""
    scenario = load_scenario("postcapture", [*QUIET, ORBIT])
    alone = dataclasses.replace(scenario, environment=None)
    with Linearizer(scenario) as whole, Linearizer(alone) as bare:
        loop, without = whole.at(0.0), bare.at(0.0)
    size, before = loop.a.shape[0], without.a.shape[0]
    # the force at the last sample, and in finite differences what is held
    assert size == before + (1 if whole.is_exact else 2) * len(loop.coordinates.names)
    assert loop.spectral_radius == pytest.approx(without.spectral_radius, abs=1e-7)
    slope = loop.samples[0].a[-11:, 3:6]  # of the force by the base's position
    n = mean_motion(scenario.environment)
    assert np.abs(slope).max() == pytest.approx(2.0 * n**2 * 526.0, rel=0.5)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ("altitude: null", "altitude: give a number of metres, or mean_motion"),
        ("altitude: -1", "altitude: must be > 0, at most 1000000000 m, not -1"),
        (
            "mean_motion: 1e-3",
            "altitude: has no effect with mean_motion; set altitude: null",
        ),
        (
            "mean_motion: 1, altitude: null",
            "mean_motion: must be > 0, at most 0.01 rad/s, not 1",
        ),
        ("hill_rpy: [1, 2]", "hill_rpy: must hold 3 values, not 2"),
        ("solar_pressure: {area: -1}", "solar_pressure.area: must be >= 0 m^2, not -1"),
        ("solar_pressure: {sun: [0, 0, 0]}", "solar_pressure.sun: must not be zero"),
        (
            "solar_pressure: {center_of_pressure: [0]}",
            "solar_pressure.center_of_pressure: must hold 3 values, not 1",
        ),
    ],
)
def test_errors_are_one_clear_line(settings, expected):
    assert_refused(f"environment.{expected}", "postcapture", f"environment={{{settings}}}")
