"""Hidden coordinates against closed forms and the laws of mechanics."""

import dataclasses
import math

import numpy as np
import pytest
from near_captures import approach
from numpy.testing import assert_allclose
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context

from ffsm_drake.common.errors import ModelError, ScenarioError
from ffsm_drake.plugins.analysis.balances import absolute_impulse, energy_residual
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.flexible.bodies import (
    add_flexible,
    cantilever_modes,
    modes_of,
    set_flexible,
)
from ffsm_drake.runs.metrics import momentum_residual
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.runs.simulate import simulate
from ffsm_drake.scenario import Flexible, Model, Scenario, load_scenario
from ffsm_drake.spacecraft.craft import Craft
from ffsm_drake.spacecraft.plant import configuration, split_of

HUB_MASS, HUB_INERTIA, ARM = 400.0, 266.0, 1.0  # kg, kg m^2 about x, hinges at y = +-ARM
MASS, LENGTH, FREQUENCY = 6.0, 3.0, 0.25


def panel(side: float, **changes) -> Flexible:
    changes = {"mass": MASS, "length": LENGTH, "frequency": FREQUENCY} | changes
    return Flexible(
        position=[0.0, side * ARM, 0.0], direction=[0.0, side, 0.0], body="hub::hub", **changes
    )


def panels(mass: float, frequency: float = 0.25) -> list[str]:
    """Overrides of a scenario: two panels on the servicer's base."""
    values = {"mass": mass, "frequency": frequency}
    return [
        f"model.flexible.{name}.{key}={value}"
        for name, side in (("port", 1.0), ("starboard", -1.0))
        for key, value in (
            values | {"position": [0.0, side, 0.0], "direction": [0.0, side, 0.0]}
        ).items()
    ]


def free_hub(
    mass: float = HUB_MASS, inertia: float = HUB_INERTIA, **parts: Flexible
) -> tuple[MultibodyPlant, Context]:
    """A rigid hub that carries parts, and its context; with them at rest it has the given mass and
    inertia.
    """
    plant = MultibodyPlant(time_step=0.0)
    instance = plant.AddModelInstance("hub")
    plant.AddRigidBody(
        "hub", instance, SpatialInertia.SolidSphereWithMass(mass, math.sqrt(2.5 * inertia / mass))
    )
    model = Model(flexible=parts)
    add_flexible(plant, model)
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    set_flexible(plant, context, model)
    return plant, context


def vibrations(plant: MultibodyPlant, context: Context):
    return modes_of(plant, context, split_of(plant))


def test_two_panels_on_a_free_hub_vibrate_as_the_closed_form_says():
    plant, context = free_hub(port=panel(1.0), starboard=panel(-1.0))
    hinge, arm = MASS * LENGTH**2 / 3.0, MASS * (LENGTH**2 / 3.0 + ARM * LENGTH / 2.0)
    k = (2.0 * math.pi * FREQUENCY) ** 2 * hinge
    # The hub moves along z against both, or turns against both; its mass and inertia are those of
    # all.
    along = math.sqrt(2.0 * k / (2.0 * hinge - (MASS * LENGTH) ** 2 / HUB_MASS)) / (2.0 * math.pi)
    about = math.sqrt(2.0 * k / (2.0 * hinge - (2.0 * arm) ** 2 / HUB_INERTIA)) / (2.0 * math.pi)
    found = vibrations(plant, context)
    assert_allclose([mode.frequency for mode in found], [along, about], rtol=1e-10)
    assert_allclose([mode.clamped_frequency for mode in found], FREQUENCY, rtol=1e-10)
    # What the hub's turning would be without what the springs hold: the mode carries that share of
    # its inertia.
    assert found[1].share[0] == pytest.approx(
        (2.0 * arm) ** 2 / (2.0 * hinge) / HUB_INERTIA, rel=1e-10
    )
    assert found[0].share[5] == pytest.approx(
        (MASS * LENGTH) ** 2 / (2.0 * hinge) / HUB_MASS, rel=1e-10
    )
    assert found[0].damping_ratio == pytest.approx(0.005 * along / FREQUENCY, rel=1e-9)


@pytest.mark.parametrize(
    "part",
    [
        panel(1.0, plates=3),
        panel(1.0, kind="beam", frequency=None, frequencies=[0.25, 1.6, 4.4]),
        panel(1.0, kind="pendulum", length=0.5),
        panel(1.0, kind="mass"),
    ],
    ids=["plates", "beam", "pendulum", "mass"],
)
@pytest.mark.smoke
def test_held_fast_the_lowest_frequency_is_the_given_one(part):
    plant, context = free_hub(1e9, 1e9, part=part)
    found = sorted(mode.frequency for mode in vibrations(plant, context))
    assert found[0] == pytest.approx(FREQUENCY, rel=1e-6)
    if part.kind == "beam":
        assert_allclose(found, part.frequencies, rtol=1e-6)
    # Locked it is the hub alone.
    bodies = [
        i
        for name in ("hub", "flexible")
        for i in plant.GetBodyIndices(plant.GetModelInstanceByName(name))
    ]
    M_BBo_B = plant.CalcSpatialInertia(context, plant.GetBodyByName("hub").body_frame(), bodies)
    assert M_BBo_B.get_mass() == pytest.approx(1e9, rel=1e-12)
    assert_allclose(M_BBo_B.get_com(), 0.0, atol=1e-12)


def test_a_beams_masses_are_those_of_a_cantilevers_modes():
    modes = cantilever_modes(5)
    assert_allclose([mode.mass for mode in modes[:3]], [0.6131, 0.1883, 0.0647], atol=5e-5)
    # All modes together are the beam: its mass, its first and its second moment about the root.
    x, root = np.linspace(0.0, 1.0, 200_001), 1.8751040687119611
    sigma = (math.sinh(root) - math.sin(root)) / (math.cosh(root) + math.cos(root))
    shape = np.cosh(root * x) - np.cos(root * x) - sigma * (np.sinh(root * x) - np.sin(root * x))
    whole, moment, square = (np.trapezoid(values, x) for values in (shape, x * shape, shape**2))
    assert modes[0].mass == pytest.approx(whole**2 / square, rel=1e-8)
    assert modes[0].distance == pytest.approx(moment / whole, rel=1e-8)
    assert sum(mode.mass * mode.distance**2 for mode in modes) == pytest.approx(1.0 / 3.0, abs=2e-4)


def test_a_released_panel_rings_down_as_an_oscillator():
    zeta, time = 0.02, 6.0
    plant, context = free_hub(1e12, 1e12, part=panel(1.0, damping_ratio=zeta))
    joint, w = plant.GetJointByName("flexible.part"), 2.0 * math.pi * FREQUENCY
    joint.set_angle(context, 0.01)
    simulator = Simulator(plant, context)
    config = SimulatorConfig(
        integration_scheme="runge_kutta3", max_step_size=2e-3, use_error_control=False
    )
    ApplySimulatorConfig(config, simulator)
    simulator.AdvanceTo(time)
    damped = w * math.sqrt(1.0 - zeta**2)
    angle = (
        0.01
        * math.exp(-zeta * w * time)
        * (math.cos(damped * time) + zeta * w / damped * math.sin(damped * time))
    )
    assert joint.get_angle(context) == pytest.approx(angle, rel=1e-6)


@pytest.fixture(scope="module")
def with_all() -> Scenario:
    """Every kind of part on the servicer."""
    data = [
        *panels(3.0),
        "model.flexible.boom={kind: beam, position: [0, 0, -1], direction: [0, 0, -1], mass: 2, "
        "frequencies: [0.5, 3]}",
        "model.flexible.fuel={kind: mass, position: [0, 0, -0.5], direction: [1, 0, 0], mass: 5, "
        "frequency: 0.3}",
        "model.flexible.tank={kind: pendulum, direction: [0, 0, -1], mass: 4, length: 0.3, "
        "frequency: 0.4}",
        "model.flexible.elbow={kind: gear, joint: joint_3, stiffness: 2.0e3}",
        "actuation.drives.rotor_inertia={joint_3: 20}",
    ]
    gains = [
        "controller=pd_plus",
        "controllers.pd_plus.k_d={all: 20}",
        "controllers.pd_plus.k_p={all: 20}",
    ]
    return load_scenario("postcapture", [*data, *gains, "duration=1", "sample_time=0.0025"])


def test_locked_it_is_the_spacecraft_that_the_controller_knows(with_all):
    whole, locked = Craft(with_all).flexible(), Craft(with_all).true()
    q = configuration(locked.coordinates, with_all.initial_posture, key="initial_posture")
    v = np.linspace(-0.3, 0.4, 11)
    known = whole.split.known
    assert sorted(whole.split.names) == [
        "boom_1",
        "boom_2",
        "elbow",
        "fuel",
        "port",
        "starboard",
        "tank",
    ]
    mass_matrix = whole.calc_mass_matrix(whole.split.whole_positions(q))
    assert_allclose(
        mass_matrix[np.ix_(known, known)], locked.calc_mass_matrix(q), rtol=1e-12, atol=1e-10
    )
    bias = whole.calc_bias(whole.split.whole_positions(q), whole.split.whole_velocities(v))
    assert_allclose(bias[known], locked.calc_bias(q, v), rtol=1e-10, atol=1e-10)
    # The apparent mass is that of no spring: a force on the known coordinates alone, the others
    # free.
    force = np.linspace(1.0, 2.0, 11)
    acceleration = np.linalg.solve(mass_matrix, whole.split.whole_velocities(force))
    assert_allclose(whole.calc_apparent_mass_matrix(q) @ acceleration[known], force, rtol=1e-10)
    assert_allclose(
        locked.calc_apparent_mass_matrix(q), locked.calc_mass_matrix(q), rtol=0.0, atol=0.0
    )


def test_momentum_and_energy_balance_with_every_kind_of_part(with_all):
    scenario = dataclasses.replace(
        with_all,
        simulator_config=SimulatorConfig(
            integration_scheme="runge_kutta3", max_step_size=6.25e-4, use_error_control=False
        ),
    )
    data = simulate(scenario, check_stability=False).dataset
    assert np.abs(data["hidden_position"].values).max(axis=0).min() > 1e-7  # all move
    assert float(data["damping_loss"][-1]) > 0.0
    impulse = absolute_impulse(data)
    for name, residual in momentum_residual(data).items():
        assert np.linalg.norm(residual, axis=1).max() < 1e-9 * impulse[name]
    parts = energy_residual(data)
    assert np.abs(parts["residual"]).max() < 1e-9 * parts["absolute_work"][-1]


@pytest.mark.parametrize(
    ("controller", "mass", "diverges"),
    # Times by an independent simulation, to its 0.05 s: the last before divergence; None: it
    # completes.
    [
        ("tdc", 2.0, None),
        ("tdc", 8.0, 0.25),
        ("asmc", 2.0, 0.70),
        ("aismc", 2.0, 0.40),
        ("tde_aismc", 8.0, 0.10),
    ],
)
def test_published_gains_diverge_with_panels_that_they_do_not_know(controller, mass, diverges):
    duration = "duration=1" if diverges is None else "duration=20"
    log = Rollout(
        load_scenario("postcapture", [*panels(mass), f"controller={controller}", duration])
    ).run()
    if diverges is None:
        assert log.outcome.completed
    else:
        assert log.outcome.status == "diverged"
        assert diverges <= log.outcome.time < diverges + 0.06


def test_the_radius_of_the_wired_loop_knows_the_panels():
    """Spectral radii and the boundary in mass by an independent linearisation."""
    quiet = ["sensing.velocity_noise=0", "disturbance.amplitude_scale=0"]
    for controller, mass, radius in (
        ("asmc", 2.0, 1.213),
        ("asmc", 4.0, 1.699),
        ("tde_aismc", 2.0, 0.9999),
        ("tde_aismc", 4.0, 1.418),
    ):
        with Linearizer(
            load_scenario("postcapture", [*panels(mass), *quiet, f"controller={controller}"])
        ) as loop:
            assert loop.at(0.0).spectral_radius == pytest.approx(radius, rel=1e-3)
    for mass, stable in ((5.37, True), (5.40, False)):
        with Linearizer(
            load_scenario("postcapture", [*panels(mass), *quiet, "controller=tdc"])
        ) as loop:
            assert (loop.at(0.0).spectral_radius < 1.0) is stable


@pytest.mark.slow
def test_the_kalman_loop_does_not_notice_the_panels(run):
    record = run("flight_sensors", *panels(8.0), "controller=tdc")
    assert record.outcome.completed
    assert record.metrics["isv"] == pytest.approx(391.2, rel=1e-3)
    assert float(np.abs(record.dataset["hidden_position"]).max()) == pytest.approx(2.3e-3, rel=0.05)


@pytest.mark.slow
def test_a_grasp_shakes_the_panels_and_keeps_momentum(run):
    record = run("tumbling_capture", *panels(4.0), approach(4), "duration=7")
    data, grasp = record.dataset, record.grasp
    assert grasp is not None
    at = int(np.argmax(data["phase"].values == "stop"))
    assert (
        np.abs(data["hidden_velocity"].values[at] - data["hidden_velocity"].values[at - 1]).max()
        > 5e-5
    )
    for part in ("linear_momentum", "angular_momentum"):
        assert_allclose(grasp["after"][part], grasp["before"][part], rtol=1e-9, atol=1e-9)
    assert record.metrics["peak_error"]["base_rotation"] < 0.1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (panels(300.0), "600 kg of the 400 kg of 'servicer::base' are on springs"),
        (
            ["model.flexible.x={body: servicer::bass, frequency: 1}"],
            "did you mean 'servicer::base'",
        ),
        (["model.flexible.x={kind: joint, joint: joint_9, stiffness: 1e4}"], "no revolute joint"),
    ],
)
def test_what_cannot_be_built_is_said_in_one_line(changes, message):
    with pytest.raises(ModelError, match=message):
        Craft(load_scenario("postcapture", changes)).flexible()


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ("{frequency: 1, stiffness: 2}", "model.flexible.x.frequency: give either"),
        ("{kind: sail, frequency: 1}", "model.flexible.x.kind: 'sail' is unknown"),
        ("{kind: beam, frequency: 1}", "model.flexible.x.frequency: has no effect on a beam"),
        (
            "{kind: gear, joint: joint_3, stiffness: 1e4}",
            "actuation.drives.rotor_inertia: must be > 0 kg m.2 for joint_3",
        ),
        ("{axis: [0, 1, 0], frequency: 1}", "model.flexible.x.axis: must be across direction"),
        ("{frequency: 1, damping_ratio: 1.5}", "model.flexible.x.damping_ratio"),
        ("{kind: joint, frequency: 1}", "model.flexible.x.joint: give the name of a joint"),
    ],
)
def test_settings_that_mean_nothing_are_refused(part, message):
    with pytest.raises(ScenarioError, match=message.replace("[", r"\[")):
        load_scenario("postcapture", [f"model.flexible.x={part}"])
