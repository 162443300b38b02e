"""The law of Slotine and Li: its regressors against Drake, its Lyapunov function, what it finds."""

import dataclasses

import numpy as np
import own_loop
import pytest
from outside_urdfs import joint, link, robot
from own_loop import flown, swinging
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator

from ffsm_drake import load_scenario, make_nominal_plant, simulate
from ffsm_drake.loop.closed_loop import make_closed_loop
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.baselines.payload import Payload, force_of
from ffsm_drake.scenario import MassProperties
from ffsm_drake.spacecraft.free_floating import free_floating
from ffsm_drake.spacecraft.mass_properties import spatial_inertia
from ffsm_drake.systems.controllers import controller_setup

LIGHT = MassProperties(mass=80.0, center_of_mass=[0.0, 0.0, 0.0], inertia=[12.0, 12.0, 12.0])
HEAVY = MassProperties(
    mass=93.0, center_of_mass=[0.1, -0.2, 0.15], inertia=[14.0, 15.0, 16.0, 0.5, -0.4, 0.3]
)


def parameters_of(properties):
    """theta (10) of mass properties."""
    inertia = spatial_inertia(properties)
    mass, about_origin = inertia.get_mass(), inertia.CalcRotationalInertia()
    moments, products = about_origin.get_moments(), about_origin.get_products()
    return np.concatenate([[mass], mass * inertia.get_com(), moments, products])


def model_with(properties):
    scenario = load_scenario("postcapture")
    payload = dataclasses.replace(scenario.payload, nominal=properties)
    scenario = dataclasses.replace(scenario, payload=payload, controller="slotine_li")
    nominal = make_nominal_plant(scenario)
    return nominal, Payload.from_setup(controller_setup(make_mission(scenario), nominal))


def drawn(seed=0):
    random = np.random.default_rng(seed)
    q = random.normal(size=12)
    q[:4] /= np.linalg.norm(q[:4])
    return q, *random.normal(size=(3, 11))


@pytest.mark.smoke
def test_regressors_are_differences_of_drakes_plants():
    (light, payload), (heavy, _) = model_with(LIGHT), model_with(HEAVY)
    change = parameters_of(HEAVY) - parameters_of(LIGHT)
    for seed in range(5):
        q, v, v_r, a_r = drawn(seed)
        force = force_of(heavy, q, v, v_r, a_r) - force_of(light, q, v, v_r, a_r)
        found = payload.force_regressor(q, v, v_r, a_r) @ change
        np.testing.assert_allclose(found, force, atol=1e-11 * np.abs(force).max())
        momentum = [free_floating(model, q).momentum(v) for model in (light, heavy)]
        found = payload.momentum_regressor(q, v) @ change
        np.testing.assert_allclose(found, momentum[1] - momentum[0], atol=1e-11)
        added = heavy.calc_mass_matrix(q) - light.calc_mass_matrix(q)
        np.testing.assert_allclose(payload.added_mass_matrix(q, change), added, atol=1e-11)


@pytest.mark.smoke
def test_the_coriolis_matrix_is_passive():
    """v_s^T (dH/dt - 2 C) v_s = 0, and C(q, v) v is Drake's bias term."""
    model, _ = model_with(HEAVY)
    q, v, v_s, _ = drawn()
    rate, step = model.plant.MapVelocityToQDot(_at(model, q), v), 1e-5
    after, before = (model.calc_mass_matrix(q + by * rate) for by in (step, -step))
    change = (after - before) / (2.0 * step)
    own = force_of(model, q, v, v_s, np.zeros(11))
    power = v_s @ change @ v_s
    assert abs(power - 2.0 * v_s @ own) < 1e-6 * abs(power)
    np.testing.assert_allclose(force_of(model, q, v, v, np.zeros(11)), model.calc_bias(q, v))
    # the symmetric form alone, of PD+, is not
    half = 0.25 * (model.calc_bias(q, v + v_s) - model.calc_bias(q, v - v_s))
    assert abs(power - 2.0 * v_s @ half) > 1e-3 * abs(power)


def _at(model, q):
    model.plant.SetPositions(model.context, q)
    return model.context


@pytest.mark.slow
def test_its_lyapunov_function_falls():
    """s^T H s / 2 + (theta - true)^T Gamma^-1 (theta - true) / 2, without disturbance."""
    scenario = load_scenario("postcapture", ["controller=slotine_li", "sample_time=0.002"])
    start = np.concatenate([own_loop.FIRST, np.full(11, 0.02)])
    course = flown(scenario, own_loop.SWING, 4.0, start=start)
    law = course.law
    true = parameters_of(scenario.payload.truth) - parameters_of(scenario.payload.nominal)
    rates = np.repeat([law.mass_rate, law.moment_rate, law.inertia_rate], [1, 3, 6])
    truth, s = model_with(scenario.payload.truth)[0], course.memory["sliding_variable"][1:]
    off = course.memory["payload_change"][:-1] - true
    H = truth.calc_mass_matrix(course.state[:-1, :12])
    energy = 0.5 * np.einsum("ki,kij,kj->k", s, H, s) + 0.5 * (off**2 / rates).sum(axis=1)
    assert np.diff(energy).max() < 1e-6 * energy[0]
    assert energy[-1] < 0.3 * energy[0]


PLANAR = robot(
    link("base", mass=10.0, inertia=(0.1, 0.1, 0.1)),
    joint("shoulder", "base", "upper", axis="0 0 1", xyz="0.145 0 0"),
    link("upper", mass=1.0, inertia=(0.05, 0.05, 0.05), com=(0.15, 0.0, 0.0)),
    joint("elbow", "upper", "lower", axis="0 0 1", xyz="0.3 0 0"),
    link("lower", mass=1.0, inertia=(0.05, 0.05, 0.05), com=(0.15, 0.0, 0.0)),
    joint("grasp", "lower", "tip", kind="fixed", xyz="0.3 0 0"),
    link("tip", mass=1e-6, inertia=(1e-9, 1e-9, 1e-9)),
)


def planar(tmp_path, *overrides):
    """albee/free-flyer-adaptive-control (doi 10.2514/6.2021-2018): 8 kg that the model lacks."""
    (tmp_path / "planar.urdf").write_text(PLANAR)
    (tmp_path / "planar.dmd.yaml").write_text(
        f"directives:\n- add_model:\n    name: planar\n    file: file://{tmp_path}/planar.urdf\n"
    )
    settings = [
        f"model.directives={tmp_path}/planar.dmd.yaml", "model.end_effector=planar::tip",
        "payload={body: 'planar::tip', truth: {mass: 8.0, inertia: [1e-9, 1e-9, 1e-9]}, "
        "nominal: {mass: 1e-6, inertia: [1e-9, 1e-9, 1e-9]}}",
        "initial_posture.joints={shoulder: 0, elbow: 0}",
        "target_posture.joints={shoulder: 0, elbow: 0}",
        "disturbance.amplitude_scale=0", "sample_time=0.002",
    ]  # fmt: skip
    return load_scenario("postcapture", [*settings, *overrides])


FIRST = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.3, 0.8])
RICH = swinging(
    FIRST,
    np.array([0.0, 0.0, 0.2, 0.2, -0.15, 0.0, 0.3, -0.4]),
    np.array([0.0, 0.0, 0.7, 0.5, 0.9, 0.0, 1.3, 1.7]),
)


@pytest.mark.long
def test_the_unknown_8_kg_are_found(tmp_path):
    """Their gains: Lambda = 2, K_D = 5 I, gamma = 1000; one unknown, the mass."""
    given = "{slope: 2, k_d: 5, mass_rate: 1000, moment_rate: 0, inertia_rate: 0}"
    own = planar(tmp_path, "controller=slotine_li", f"controllers.slotine_li={given}")
    adaptive = flown(own, RICH, 20.0)
    mass = adaptive.memory["payload_change"][:, 0]
    assert mass[-1] == pytest.approx(8.0, abs=0.02)
    pd = "{k_p: {base_position: 30, base_rotation: 30, joints: 15}, k_d: 5}"
    rms = {"slotine_li": _rms(adaptive)}
    for name, gains in (("pd_plus", pd), ("computed_torque", "{k_p: 10, k_d: 5}")):
        scenario = planar(tmp_path, f"controller={name}", f"controllers.{name}={gains}")
        rms[name] = _rms(flown(scenario, RICH, 20.0))
    assert rms["slotine_li"] < 0.5 * min(rms["pd_plus"], rms["computed_torque"]), rms


def _rms(course):
    return np.sqrt(np.mean(course.error**2))


@pytest.mark.long
def test_momentum_tells_the_payload_where_identification_pays():
    """Joints that follow a plan of the identified payload bring it to its berth."""
    settings = [
        "reference.frame.task=position", "reference.frame.rpy=null",
        "disturbance.amplitude_scale=0",
    ]  # fmt: skip

    def miss(scenario):
        record = simulate(scenario, check_stability=False)
        error = record.dataset["frame_error"].values[:, 3:]
        return 1e3 * np.linalg.norm(error, axis=1)[-1]

    scenario = load_scenario("free_floating", [*settings, "controller=computed_torque"])
    nominal = miss(scenario)
    assert nominal == pytest.approx(57.7, abs=0.1)

    adaptive = load_scenario("free_floating", [*settings, "controller=slotine_li", "duration=10"])
    change = _change_at_the_end(adaptive)
    true = parameters_of(scenario.payload.truth)
    found = parameters_of(scenario.payload.nominal) + change
    assert found[0] == pytest.approx(true[0], rel=1e-3)
    mass, center = found[0], found[1:4] / found[0]
    x, y, z = center
    arms = [y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z]
    central = found[4:] - mass * np.array(arms)
    identified = MassProperties(
        mass=float(mass), center_of_mass=center.tolist(), inertia=central.tolist()
    )
    payload = dataclasses.replace(scenario.payload, nominal=identified)
    assert miss(dataclasses.replace(scenario, payload=payload)) < 0.01  # mm


def _change_at_the_end(scenario):
    loop = make_closed_loop(scenario)
    simulator = Simulator(loop.diagram)
    ApplySimulatorConfig(scenario.simulator_config, simulator)
    context = simulator.get_mutable_context()
    loop.initialize(loop.diagram, context)
    simulator.AdvanceTo(scenario.duration)
    controller = loop.blocks["controller"]
    return controller.state(controller.GetMyContextFromRoot(context), "payload_change")
