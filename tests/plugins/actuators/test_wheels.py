"""Reaction wheels: against rotors on real joints, the momentum of the stack, limits and
unloading.
"""

import flight_settings
import numpy as np
import pytest
from balances import assert_momentum_follows
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.common.eigen_geometry import Quaternion
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from refusals import assert_refused
from rigid_bus import stepped

from ffsm_drake import ScenarioError, load_scenario
from ffsm_drake.common.numbers import number
from ffsm_drake.plugins.actuators.row import make_base_actuators
from ffsm_drake.plugins.actuators.wheel_set import WheelSet
from ffsm_drake.plugins.design.remarks import uneven_remarks
from ffsm_drake.plugins.report.part_panels import part_tables
from ffsm_drake.scenario import Wheel, Wheels
from ffsm_drake.show.results import results_of
from ffsm_drake.spacecraft.craft import make_nominal_plant
from ffsm_drake.spacecraft.mass_properties import set_payload
from ffsm_drake.spacecraft.plant import models_dir

SHORT = (*flight_settings.FLIGHT, *flight_settings.NO_NOISE, "duration=2")
INERTIA, PERIOD = 0.08, 0.01
AXES = {"a": [1, 1, 1], "b": [-1, 1, 1], "c": [-1, -1, 1], "d": [1, -1, 1]}
UNIT_AXES = np.array([*AXES.values()]) / np.sqrt(3.0)


def wheels(momentum=(20, -15, 10, 5), **values):
    """An override: a pyramid of wheels with initial momenta (N m s)."""
    settings = {"inertia": INERTIA, "torque_limit": 10.0, **values}
    units = {
        name: {"axis": axis, "initial_momentum": h, **settings}
        for (name, axis), h in zip(AXES.items(), momentum, strict=True)
    }
    return f"actuation.wheels={{units: {units}}}"


def pyramid(*, alone, **values):
    """The same wheels with other limits, at rest."""
    units = {
        name: Wheel(axis=[*map(float, axis)], inertia=0.1, torque_limit=0.5, speed_limit=100.0)
        for name, axis in AXES.items()
    }
    return WheelSet(Wheels(units=units, **values), sample_time=PERIOD, alone=alone)


@pytest.fixture(scope="module")
def turning(run):
    """Wheels that spin in a base that turns: without disturbance and thrusters."""
    return run(
        *SHORT,
        wheels(coulomb_friction=0.02, viscous_friction=1e-3),
        "disturbance.amplitude_scale=0",
    )


def plant_with_rotors(record):
    """The shipped spacecraft with each wheel as a body of its own on a revolute joint."""
    plant = MultibodyPlant(time_step=0.0)
    parser = Parser(plant)
    parser.package_map().Add("ffsm_drake", str(models_dir()))
    parser.AddModels(url="package://ffsm_drake/postcapture.dmd.yaml")
    base = plant.GetBodyByName("base")
    whole = base.default_spatial_inertia()
    mass, inertia = whole.get_mass(), whole.CalcRotationalInertia().CopyToFullMatrix3()
    rotor_mass, across = 2.0, 0.05
    joints = []
    for name, axis in AXES.items():
        direction = np.array(axis) / np.linalg.norm(axis)
        rotor = UnitInertia.AxiallySymmetric(INERTIA / rotor_mass, across / rotor_mass, direction)
        body = plant.AddRigidBody(
            f"rotor_{name}", base.model_instance(), SpatialInertia(rotor_mass, np.zeros(3), rotor)
        )
        joint = RevoluteJoint(f"spin_{name}", base.body_frame(), body.body_frame(), direction)
        joints.append(plant.AddJoint(joint))
        mass -= rotor_mass
        inertia -= across * np.eye(3) + (INERTIA - across) * np.outer(direction, direction)
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    moments = np.diag(inertia) / mass
    products = np.array([inertia[0, 1], inertia[0, 2], inertia[1, 2]]) / mass
    base.SetSpatialInertiaInBodyFrame(
        context, SpatialInertia(mass, np.zeros(3), UnitInertia(*moments, *products))
    )
    set_payload(plant, context, body="debris::debris", properties=record.scenario.payload.truth)
    return plant, context, joints


def test_wheels_are_rotors_on_joints(turning):
    """The same torques on a plant whose wheels are bodies: same motion, same wheel speeds."""
    data = turning.dataset
    plant, context, joints = plant_with_rotors(turning)
    arm = [plant.GetJointByName(f"joint_{i}") for i in range(1, 6)]

    def body_rate(k):
        q, w = data["position"].values[k, :4], data["velocity"].values[k, :3]
        return Quaternion(q / np.linalg.norm(q)).rotation().T @ w

    def speeds(k):
        return data["wheel_momentum"].values[k] / INERTIA - UNIT_AXES @ body_rate(k)

    base = plant.GetBodyByName("base")
    q0, v0 = data["position"].values[0], data["velocity"].values[0]
    q, v = np.zeros(plant.num_positions()), np.zeros(plant.num_velocities())
    q[base.floating_positions_start() : base.floating_positions_start() + 7] = q0[:7]
    for joint, angle in zip(arm, q0[7:], strict=True):
        q[joint.position_start()] = angle
    assert not v0.any()
    for joint, speed in zip(joints, speeds(0), strict=True):
        v[joint.velocity_start()] = speed
    plant.SetPositionsAndVelocities(context, np.r_[q, v])
    simulator = Simulator(plant, context)
    simulator.get_mutable_integrator().set_maximum_step_size(0.005)
    simulator.get_mutable_integrator().set_target_accuracy(1e-12)
    start = base.floating_velocities_start_in_v()
    port = plant.get_applied_generalized_force_input_port()
    momentum = data["wheel_momentum"].values
    external = data["applied_force"].values.copy()
    external[:, :3] -= data["wheel_reaction"].values
    for k in range(100):
        force = np.zeros(plant.num_velocities())
        force[start : start + 6] = external[k, :6]
        for joint, torque in zip(arm, external[k, 6:], strict=True):
            force[joint.velocity_start()] = torque
        for joint, torque in zip(joints, (momentum[k + 1] - momentum[k]) / PERIOD, strict=True):
            force[joint.velocity_start()] = torque
        port.FixValue(context, force)
        simulator.AdvanceTo((k + 1) * PERIOD)
    reached = plant.GetVelocities(context)
    assert reached[start : start + 6] == pytest.approx(data["velocity"].values[100, :6], abs=1e-9)
    turned = [reached[joint.velocity_start()] for joint in joints]
    assert turned == pytest.approx(speeds(100), abs=1e-8)
    assert np.abs(turned - speeds(0)).max() > 0.5
    # Without the gyroscopic torque it would be elsewhere.
    gyroscopic = np.cross(data["velocity"].values[:, :3], data["stored_momentum"].values)
    assert np.abs(gyroscopic).max() > 0.01


@pytest.mark.smoke
def test_torque_on_the_base_is_what_the_wheels_take(turning):
    data = turning.dataset
    assert_momentum_follows(data, 1e-9)
    axes = UNIT_AXES.T
    for k in (0, 50, 200):
        q = data["position"].values[k, :4]
        rotation = Quaternion(q / np.linalg.norm(q)).rotation()
        stored = rotation @ axes @ data["wheel_momentum"].values[k]
        assert data["stored_momentum"].values[k] == pytest.approx(stored, abs=1e-8)
        rate = rotation.T @ data["velocity"].values[k, :3]
        speed = data["wheel_momentum"].values[k] / INERTIA - rate @ axes
        assert data["wheel_speed"].values[k] == pytest.approx(speed, abs=1e-9)
    commanded, applied = (data[name].values for name in ("generalized_force", "applied_force"))
    assert np.array_equal(commanded[:, 3:], applied[:, 3:])
    figures = turning.metrics["wheels"]
    assert figures["speed_used"] == pytest.approx(np.abs(data["wheel_speed"].values).max() / 628.0)
    assert figures["torque_used"] == pytest.approx(max(figures["peak_torque"].values()) / 10.0)
    assert figures["unloading"] == 0.0
    (found,) = part_tables(results_of([turning]), "Actuators")
    ((head, rows),) = found["tables"]  # no thrusters
    speed = np.abs(data["wheel_speed"].values).max(axis=0)
    assert head[0] == found["by"] == "wheel"
    assert [row[2:4] for row in rows] == [[number(each), number(628.0)] for each in speed]


def test_momentum_of_the_stack_follows_what_fires(run):
    """Thrusters, wheels, friction, disturbance: 1e-9 of the impulse."""
    record = run(
        *SHORT, wheels(torque_limit=1.0, coulomb_friction=5e-4), "actuation.thrusters.layout=12x5N"
    )
    impulse = sum(record.metrics["thrusters"]["impulse"].values())
    assert impulse > 1.0
    assert_momentum_follows(record.dataset, 1e-9 * impulse)


def test_thrusters_unload_full_wheels(run):
    record = run(
        *SHORT,
        wheels((41, 40.8, 40.6, 40.4), torque_limit=1.0),
        "actuation.wheels.desaturation_time=1",
        "actuation.thrusters.layout=12x5N",
        "duration=5",
        "reference.duration=60",
        "disturbance.amplitude_scale=0",
    )
    data = record.dataset
    assert (data["wheel_unloads"].values == 1.0).all()
    stored = np.linalg.norm(data["stored_momentum"].values, axis=1)
    assert stored[-1] < stored[0] - 4.0
    assert np.abs(data["wheel_torque"].values).max() <= 1.0
    assert record.metrics["peak_error"]["base_rotation"] < 3e-4


@pytest.mark.smoke
def test_unloading_has_hysteresis():
    units = {"z": Wheel(inertia=0.1, speed_limit=100.0)}
    settings = Wheels(units=units, desaturate_above=0.8, desaturate_below=0.2)
    wheel_set = WheelSet(settings, sample_time=PERIOD, alone=False)
    at_rest = np.zeros(3)
    assert not wheel_set.unloads(False, np.array([7.9]), at_rest)
    assert wheel_set.unloads(False, np.array([-8.1]), at_rest)
    assert wheel_set.unloads(True, np.array([2.1]), at_rest)
    assert not wheel_set.unloads(True, np.array([1.9]), at_rest)
    assert wheel_set.unloading_torque(np.array([1.0])) == pytest.approx([0, 0, -1.0 / 20.0])
    assert wheel_set.unloading_torque(np.array([9.0])) == pytest.approx([0, 0, -0.1])


@pytest.mark.slow
@settings(max_examples=12)
@given(st.integers(4, 7), st.integers(0, 2**31), st.booleans())
def test_motors_take_out_what_wheels_hold_against_each_other(count, seed, speeding):
    """Drawn wheels, some of the momentum opposed: it ends, in bounded time, without a torque on the
    base beyond the wanted one, and thrusters are asked for nothing unless the rest is too much.
    """
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(count, 3))
    units = {
        str(i): Wheel(axis=axis.tolist(), inertia=0.1, torque_limit=2.0, speed_limit=100.0)
        for i, axis in enumerate(axes)
    }
    given = Wheels(units=units, desaturation_time=0.5)
    wheel_set = WheelSet(given, sample_time=0.01, alone=False)
    null = np.linalg.svd(wheel_set.axes)[2][3:]
    opposed = null.T @ rng.normal(size=count - 3)
    opposed *= 9.0 / np.abs(opposed).max()
    net = np.linalg.pinv(wheel_set.axes) @ rng.normal(size=3)
    net *= rng.uniform(0.0, 0.9) / np.abs(net).max()
    momentum, turning = opposed + net, 0.1 * rng.normal(size=3)
    first, was, samples = wheel_set.axes @ momentum, False, 0
    while (was := bool(wheel_set.rearranges(was, momentum, turning))) and samples < 3000:
        assert not wheel_set.unloads(False, momentum, turning)
        wanted = 0.01 * rng.normal(size=3) if speeding else np.zeros(3)
        alone = wheel_set.give(wanted, momentum, turning)
        more = wheel_set.rearranging_torque(momentum)
        torques = wheel_set.give(wanted, momentum, turning, rearranging=more)
        assert torques.on_base == pytest.approx(alone.on_base, abs=1e-13)
        assert np.abs(torques.motor).max() <= 2.0
        momentum, samples = momentum + 0.01 * torques.on_wheels, samples + 1
    assert 0 < samples < 3000
    speeds = np.abs(wheel_set.speed(momentum, turning))
    assert speeds.max() <= 80.0
    assert not wheel_set.rearranges(False, momentum, turning)
    assert speeding or wheel_set.axes @ momentum == pytest.approx(first, abs=1e-11)


def test_opposed_momentum_is_no_work_for_thrusters(run):
    """Four wheels at 0.9 of their speed whose momenta cancel."""
    settings = ("actuation.wheels.desaturation_time=0.5", "actuation.thrusters.layout=12x5N",
                "duration=3", "reference.duration=60")  # fmt: skip
    full, empty = (
        run(*SHORT, wheels((45, -45, 45, -45), torque_limit=60.0), *settings),
        run(*SHORT, wheels((0, 0, 0, 0), torque_limit=60.0), *settings),
    )
    speeds = np.abs(full.dataset["wheel_speed"].values)
    assert speeds[0].min() > 0.89 * 628.0
    assert speeds[-1].max() < 0.25 * 628.0
    for name in ("wheel_unloads", "stored_momentum", "thruster_force", "error"):
        values = [record.dataset[name].values for record in (full, empty)]
        assert values[0] == pytest.approx(values[1], abs=1e-9), name
    assert full.metrics["wheels"]["unloading"] == 0.0


def test_wheels_stay_within_their_limits():
    wheel_set = pyramid(alone=True)
    w = np.array([0.01, -0.02, 0.03])
    at_rest = wheel_set.give(np.array([0.2, 0.1, -0.3]), np.zeros(4), w)
    assert at_rest.on_base == pytest.approx([0.2, 0.1, -0.3])
    strong = wheel_set.give(np.array([0.0, 0.0, 50.0]), np.zeros(4), w)
    assert strong.motor == pytest.approx(-0.5 * np.ones(4))
    full = 0.1 * (100.0 + w @ wheel_set.axes)
    more = wheel_set.give(np.array([0.0, 0.0, -1.0]), full, w)
    assert more.motor == pytest.approx(np.zeros(4), abs=1e-12)
    less = wheel_set.give(np.array([0.0, 0.0, 1.0]), full, w)
    assert less.on_base == pytest.approx([0, 0, 1])


@pytest.mark.slow
@given(
    torque=st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=3, max_size=3),
    size=st.sampled_from([1e-9, 1.0, 1e-150, 1.0 / 3e7]),
)
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_any_torque_is_given_within_the_limits_or_is_none(torque, size):
    """From tiny to near the largest number, and infinite: nothing overflows."""
    scenario = load_scenario("thrusters_and_wheels", ["actuation.thrusters=null"])
    base = make_base_actuators(
        scenario.actuation, make_nominal_plant(scenario).coordinates, sample_time=0.01
    )
    commanded = np.zeros(11)
    commanded[:3] = size * np.array(torque) / 4.0
    parts, _ = stepped(base, commanded, base.start())
    limit = max(unit.torque_limit for unit in scenario.wheels.units.values())
    if (np.abs(commanded) < 1e300).all():
        assert np.abs(parts["wheel_torque"]).max() <= limit
    else:
        assert not np.isfinite(parts["applied_force"]).all()


def test_thrusters_are_asked_for_what_is_far_beyond_the_wheels():
    helped, alone = (pyramid(alone=False, assist_above=above) for above in (2.0, None))
    most = 0.5 * 4.0 / np.sqrt(3.0) * np.array([0.0, 0.0, 1.0])  # that they give about z
    assert helped.most(most / np.linalg.norm(most)) == pytest.approx(np.linalg.norm(most))
    assert helped.assist_torque(1.9 * most) == pytest.approx(np.zeros(3))
    assert helped.assist_torque(-5.0 * most) == pytest.approx(-3.0 * most)
    assert alone.assist_torque(5.0 * most) == pytest.approx(np.zeros(3))


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ("units: {z: {}}, assist_above: 0.5", "assist_above: must be >= 1, not 0.5"),
        ("units: {}", "units: give wheels by name"),
        (
            "units: {z: {}}",
            "units: give no torque about the axis [-1, 0, 0] of the base; add wheels",
        ),
        ("units: {z: {axis: [0, 0, 0]}}", "units.z.axis: must not be zero"),
        ("units: {z: {inertia: 0}}", "units.z.inertia: must be > 0 kg m^2, not 0"),
        (
            "units: {z: {initial_momentum: 60}}",
            "units.z.initial_momentum: must be within inertia * speed_limit, 50.24 N m s, not 60",
        ),
        (
            "units: {z: {}}, desaturate_below: 0.9",
            "desaturate_below: must be from 0 to below desaturate_above (0.8), not 0.9",
        ),
    ],
)
def test_errors_are_one_clear_line(settings, expected):
    settings = f"actuation.wheels={{{settings}}}"
    assert_refused(f"actuation.wheels.{expected}", "postcapture", settings)


def test_rotors_that_are_heavier_than_the_base_are_refused():
    expected = "kg m^2 each) does not fit into the base's"
    assert_refused(
        expected, "postcapture", wheels(inertia=400.0), "actuation.thrusters.layout=12x5N"
    )


@settings(derandomize=True, database=None, deadline=None, max_examples=40)
@given(
    st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=5, unique_by=lambda each: round(each, 1)),
    st.integers(0, 2),
    st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3),
)
def test_wheels_in_a_plane_leave_the_rest_to_thrusters(angles, normal, torque):
    """Whatever the plane: with thrusters every torque is given by both, alone it is refused."""
    axes = [np.roll([0.0, np.cos(each), np.sin(each)], normal).tolist() for each in angles]
    wheels = Wheels(units={f"w{k}": Wheel(axis=axis) for k, axis in enumerate(axes)})
    with pytest.raises(ScenarioError, match=r"wheels.units: give no torque about the axis \["):
        WheelSet(wheels, sample_time=0.01, alone=True)
    both = WheelSet(wheels, sample_time=0.01, alone=False)
    wanted = 1e-3 * np.array(torque)
    given_by_wheels = both.give(wanted, np.zeros(len(angles)), np.zeros(3)).on_base
    np.testing.assert_allclose(given_by_wheels + both.assist_torque(wanted), wanted, atol=1e-12)
    assert both.most(np.roll([1.0, 0.0, 0.0], normal)) == np.inf
    assert both.capacity(np.roll([1.0, 0.0, 0.0], normal)) == both.least_capacity == 0.0


def test_nearly_coplanar_wheels_are_remarked_on():
    units = "{x: {axis: [1, 0, 0]}, y: {axis: [0, 1, 0]}, z: {axis: [1, 1, %s]}}"
    flat = f"actuation.wheels.units={units}"
    (remark,) = uneven_remarks(load_scenario("postcapture", [flat % 1e-4]))
    assert "wheels nearly degenerate: torque along [0, 0, -1]" in remark
    assert "is 1.41e-05 N m, elsewhere up to " in remark
    assert not list(uneven_remarks(load_scenario("postcapture", [flat % 1])))


@given(st.integers(0, 2**31))
@settings(max_examples=15)
def test_a_lost_wheel_takes_no_part_in_rearranging(seed):
    rng = np.random.default_rng(seed)
    units = {str(i): Wheel(axis=rng.normal(size=3).tolist()) for i in range(5)}
    wheel_set = WheelSet(Wheels(units=units), sample_time=0.01, alone=False, lost=["2"])
    momentum = rng.uniform(-40.0, 40.0, 5)
    motor = wheel_set.rearranging_torque(momentum)
    assert motor[2] == 0.0
    assert np.abs(motor).max() > 0.0
    assert wheel_set.axes @ motor == pytest.approx(np.zeros(3), abs=1e-12)
    assert motor @ momentum < 0.0  # it slows them
