"""The grasp of a moving target: conservation laws, MuJoCo's weld, and figures from an independent
prototype.
"""

import mujoco
import mujoco_oracle as oracle
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.math import RigidTransform
from pydrake.multibody.tree import JacobianWrtVariable, RigidBody
from scipy.spatial.transform import Rotation

from ffsm_drake.common.errors import ModelError, ScenarioError
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.capture.compliant import compliant_grasp
from ffsm_drake.plugins.capture.contact import contact_at, planned_contact, target_twist
from ffsm_drake.plugins.capture.plastic import plastic_grasp
from ffsm_drake.scenario import MassProperties, Scenario, inertia_matrix, load_scenario
from ffsm_drake.spacecraft.craft import make_true_plant
from ffsm_drake.spacecraft.mass_properties import set_payload, spatial_inertia
from ffsm_drake.spacecraft.nominal import PlantModel

AXIS = np.array([0.6, 0.48, 0.64])


def tumbling(degrees: float, *overrides: str) -> Scenario:
    """The shipped posture, the target at rest at its centre, the joints following its grasp
    frame.
    """
    rate = (np.radians(degrees) * AXIS).tolist()
    own = [
        "reference.base_rotation=eigenaxis",
        f"capture.rate={rate}",
        "capture.servicer=track_joints",
    ]
    return load_scenario("postcapture", [*own, "capture.tracking_length=0.3", *overrides])


@pytest.fixture(scope="module")
def model() -> PlantModel:
    return make_true_plant(Scenario())


def random_target(rng: np.random.Generator) -> MassProperties:
    """20 to 3000 kg, of a box with its centre of mass up to 0.5 m off, its axes anyhow."""
    mass, size = 10 ** rng.uniform(1.3, 3.5), rng.uniform(0.3, 2.0, 3)
    turn = Rotation.random(random_state=rng).as_matrix()
    inertia = turn @ np.diag(mass / 12 * (size @ size - size**2)) @ turn.T
    i, j = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
    return MassProperties(
        mass=mass, center_of_mass=rng.uniform(-0.5, 0.5, 3).tolist(), inertia=inertia[i, j].tolist()
    )


def momentum_and_energy(
    target: MassProperties, X_WP: RigidTransform, V: np.ndarray, *, about: np.ndarray
) -> tuple[np.ndarray, float]:
    """Of the target alone, from its mass properties: (6; angular about a point (3) of the world,
    linear), and J.
    """
    R = X_WP.rotation().matrix()
    arm, inertia = R @ target.center_of_mass, R @ inertia_matrix(target) @ R.T
    velocity = V[3:] + np.cross(V[:3], arm)
    linear = target.mass * velocity
    angular = inertia @ V[:3] + np.cross(X_WP.translation() + arm - about, linear)
    return np.concatenate([angular, linear]), 0.5 * float(
        V[:3] @ inertia @ V[:3] + linear @ velocity
    )


@pytest.mark.smoke
def test_momentum_is_kept_and_energy_never_rises_in_random_grasps(model: PlantModel) -> None:
    rng, plant, context = np.random.default_rng(14), model.plant, model.context
    servicer = [plant.GetModelInstanceByName("servicer")]
    body, world, origin = plant.GetBodyByName("debris"), plant.world_frame(), np.zeros(3)
    spins = []
    for case in range(1000):
        target, braked = random_target(rng), range(6, 6 + case % 6)
        body.SetSpatialInertiaInBodyFrame(context, spatial_inertia(target))
        quaternion = rng.normal(size=4)
        q = np.concatenate(
            [quaternion / np.linalg.norm(quaternion), rng.uniform(-2, 2, 3), rng.uniform(-3, 3, 5)]
        )
        v, V = rng.normal(scale=0.1, size=11), rng.normal(scale=0.2, size=6)
        plant.SetPositionsAndVelocities(context, np.concatenate([q, v]))
        X_WP = body.EvalPoseInWorld(context)
        grasp = plastic_grasp(
            mass_matrix=plant.CalcMassMatrix(context),
            jacobian=plant.CalcJacobianSpatialVelocity(
                context, JacobianWrtVariable.kV, body.body_frame(), origin, world, world
            ),
            target_inertia=spatial_inertia(target).ReExpress(X_WP.rotation()).CopyToFullMatrix6(),
            velocity=v,
            target_velocity=V,
            braked=braked,
        )
        # Of the servicer alone by Drake, of the target from its mass properties; both about the
        # base.
        before = plant.CalcSpatialMomentumInWorldAboutPoint(context, servicer, q[4:7]).get_coeffs()
        _, energy_of_held = momentum_and_energy(target, X_WP, twist_of(model, body), about=q[4:7])
        of_target, energy = momentum_and_energy(target, X_WP, V, about=q[4:7])
        before, energy = (
            before + of_target,
            plant.CalcKineticEnergy(context) - energy_of_held + energy,
        )
        plant.SetVelocities(context, grasp.velocity)
        after = plant.CalcSpatialMomentumInWorldAboutPoint(context, q[4:7]).get_coeffs()
        for part in (slice(0, 3), slice(3, 6)):
            size = np.linalg.norm(before[part])
            assert np.linalg.norm(after[part] - before[part]) <= 1e-12 * size
            assert np.linalg.norm(grasp.momentum_before[part] - before[part]) <= 1e-12 * size
            assert np.linalg.norm(grasp.momentum_after[part] - after[part]) <= 1e-12 * size
        assert abs(grasp.energy_before - energy) <= 1e-12 * energy
        assert abs(grasp.energy_after - plant.CalcKineticEnergy(context)) <= 1e-12 * energy
        assert grasp.energy_after <= grasp.energy_before
        assert not grasp.velocity[braked].any()
        assert np.count_nonzero(grasp.brake_impulse) == len(braked)
        spins.append(np.linalg.norm(before[:3]))
        if case % 10:
            continue
        # The target goes on with what it was given.
        given, _ = momentum_and_energy(
            target, X_WP, twist_of(model, body), about=X_WP.translation()
        )
        of_target, _ = momentum_and_energy(target, X_WP, V, about=X_WP.translation())
        assert np.linalg.norm(given - of_target - grasp.impulse) <= 1e-11 * np.linalg.norm(
            of_target
        )
    assert np.min(spins) > 1.0  # none of the grasps was of something at rest


def test_a_contact_is_told_about_the_points_that_it_names(model: PlantModel) -> None:
    scenario = tumbling(
        5.0, "capture.joints=braked", "payload.truth.center_of_mass=[0.1, 0.2, -0.1]"
    )
    model, origin = make_true_plant(scenario), np.zeros(3)
    contact = planned_contact(make_mission(scenario), model)
    plant, context = model.plant, model.context
    assert not contact.grasp.velocity[6:].any()
    plant.SetPositionsAndVelocities(context, np.concatenate([contact.q, contact.grasp.velocity]))
    after = plant.CalcSpatialMomentumInWorldAboutPoint(context, origin).get_coeffs()
    assert_allclose(contact.momentum_after, after, rtol=1e-12)
    assert_allclose(contact.momentum_before, after, rtol=1e-12)
    centre = plant.CalcCenterOfMassPositionInWorld(context)
    spin = plant.CalcSpatialMomentumInWorldAboutPoint(context, centre).rotational()
    assert_allclose(contact.spin_after, spin, rtol=1e-12)
    assert_allclose(contact.spin_before, spin, rtol=1e-12)
    # The impulse on the target, about the world's origin, is what its momentum gains.
    body, end_effector = plant.GetBodyByName("debris"), plant.GetFrameByName("end_effector")
    X_WP, held = body.EvalPoseInWorld(context), twist_of(model, body)
    gained, lost = (
        momentum_and_energy(scenario.payload.truth, X_WP, V, about=origin)[0]
        for V in (held, contact.target_velocity)
    )
    arm = end_effector.CalcPoseInWorld(context).translation()
    impulse = contact.impulse + np.concatenate([np.cross(arm, contact.impulse[3:]), origin])
    assert_allclose(gained - lost, impulse, atol=1e-12 * np.linalg.norm(lost))


def twist_of(model: PlantModel, body: RigidBody) -> np.ndarray:
    return body.EvalSpatialVelocityInWorld(model.context).get_coeffs()


def test_a_target_that_moves_with_the_arm_is_grasped_without_impulse(model: PlantModel) -> None:
    scenario = tumbling(0.0)
    q, rng = (
        np.concatenate([[1.0, 0, 0, 0], np.zeros(3), [0.3, 0.2, 0.9, 0.6, -0.7]]),
        np.random.default_rng(2),
    )
    v = rng.normal(size=11)
    set_payload(
        model.plant, model.context, body="debris::debris", properties=scenario.payload.truth
    )
    model.plant.SetPositions(model.context, q)
    model.plant.SetVelocities(model.context, v)
    twist = twist_of(model, model.plant.GetBodyByName("debris"))
    contact = contact_at(scenario, model, q=q, velocity=v, target_velocity=twist)
    assert_allclose(contact.grasp.velocity, v, atol=1e-14)
    assert_allclose(contact.impulse, 0.0, atol=1e-12)


# Largest joint rate before, deg/s; impulse, N s and, about the target's centre, N m s; energy
# before and after, J.
PROTOTYPE = {
    2: (3.0, 0.08, 0.17, 0.011, 0.010),
    5: (7.5, 0.21, 0.42, 0.069, 0.063),
    10: (15.0, 0.41, 0.85, 0.277, 0.253),
}


@pytest.mark.parametrize("degrees", PROTOTYPE)
def test_figures_are_those_of_a_prototype(degrees: int) -> None:
    scenario = tumbling(degrees)
    contact = planned_contact(make_mission(scenario), make_true_plant(scenario))
    joints, linear, angular, before, after = PROTOTYPE[degrees]
    assert np.degrees(np.abs(contact.velocity[6:]).max()) == pytest.approx(joints, abs=0.05)
    assert np.linalg.norm(contact.grasp.impulse[3:]) == pytest.approx(linear, abs=0.005)
    assert np.linalg.norm(contact.grasp.impulse[:3]) == pytest.approx(angular, abs=0.005)
    assert contact.grasp.energy_before == pytest.approx(before, abs=5e-4)
    assert contact.grasp.energy_after == pytest.approx(after, abs=5e-4)


def test_base_and_joints_together_follow_the_grasp_frame_exactly(model: PlantModel) -> None:
    scenario = tumbling(5.0, "capture.servicer=track_all", "capture.velocity=[0.01, 0.02, -0.03]")
    contact = planned_contact(make_mission(scenario), make_true_plant(scenario))
    assert_allclose(contact.impulse, 0.0, atol=1e-11)
    assert contact.grasp.energy_after == pytest.approx(contact.grasp.energy_before, rel=1e-12)
    dear = tumbling(
        5.0,
        "capture.servicer=track_all",
        "capture.tracking_cost={base_rotation: 100, base_position: 100}",
    )
    moves = planned_contact(make_mission(dear), make_true_plant(dear))
    assert_allclose(moves.impulse, 0.0, atol=1e-10)  # as exactly, with less of the base
    assert np.abs(moves.velocity[:3]).max() < 0.5 * np.abs(contact.velocity[:3]).max()


def test_rate_and_velocity_are_in_the_axes_that_are_named(model: PlantModel) -> None:
    q = np.concatenate([[0.5, 0.5, -0.5, 0.5], [1.0, 2.0, 3.0], [0.3, 0.2, 0.9, 0.6, -0.7]])
    off_centre = ["payload.truth.center_of_mass=[0.1, 0, 0.2]", "capture.velocity=[0.01, 0, 0.03]"]
    model.plant.SetPositions(model.context, q)
    R = model.plant.GetBodyByName("debris").EvalPoseInWorld(model.context).rotation().matrix()
    for axes, turn in (("target", R), ("world", np.eye(3))):
        scenario = tumbling(3.0, *off_centre, f"capture.axes={axes}")
        V = target_twist(scenario, scenario.capture, model, q)
        assert_allclose(V[:3], turn @ AXIS * np.radians(3.0), atol=1e-15)
        centre = V[3:] + np.cross(V[:3], R @ [0.1, 0.0, 0.2])
        assert_allclose(centre, turn @ [0.01, 0.0, 0.03], atol=1e-15)


def test_a_target_of_several_bodies_is_refused() -> None:
    scenario = tumbling(1.0, "payload.body=servicer::base")
    with pytest.raises(
        ModelError,
        match=r"payload\.body: 'servicer::base' is a body of the "
        r"servicer; a capture needs",
    ):
        planned_contact(make_mission(scenario), make_true_plant(tumbling(1.0)))
    unknown = tumbling(1.0, "capture.tracking_cost.joint_9=2")
    with pytest.raises(ScenarioError, match=r"capture\.tracking_cost\.joint_9: unknown coordinate"):
        planned_contact(make_mission(unknown), make_true_plant(unknown))


def test_the_base_has_no_brakes() -> None:
    with pytest.raises(ValueError, match="have the indices 6 to 6, not \\[5\\]"):
        plastic_grasp(
            mass_matrix=np.eye(7),
            jacobian=np.zeros((6, 7)),
            target_inertia=np.eye(6),
            velocity=np.zeros(7),
            target_velocity=np.zeros(6),
            braked=[5],
        )


@pytest.mark.parametrize("joints", ["free", "braked"])
def test_a_stiff_gripper_gives_the_impulse_of_the_plastic_grasp(joints: str) -> None:
    scenario = tumbling(
        5.0, "capture.compliance.stiffness=5e4", f"capture.joints={joints}", "capture.servicer=rest"
    )
    contact = planned_contact(make_mission(scenario), make_true_plant(scenario))
    assert contact.compliant is not None
    # The brakes act on joints that are at rest already.
    assert_allclose(contact.compliant.impulse, contact.impulse, rtol=1e-9, atol=1e-12)
    stiffer = tumbling(
        5.0,
        f"capture.joints={joints}",
        "capture.servicer=rest",
        "capture.compliance={stiffness: 2e5, damping: 2e3, rotational_stiffness: 4e4, "
        "rotational_damping: 1000}",
    )
    other = planned_contact(make_mission(stiffer), make_true_plant(stiffer)).compliant
    assert other is not None
    # Four times as stiff, twice as damped: everything happens twice as fast, with twice the force.
    assert other.time == pytest.approx(0.5 * contact.compliant.time, rel=0.02)
    assert other.peak_force == pytest.approx(2.0 * contact.compliant.peak_force, rel=1e-3)
    assert other.peak_torque == pytest.approx(2.0 * contact.compliant.peak_torque, rel=1e-3)
    assert other.peak_stretch == pytest.approx(0.5 * contact.compliant.peak_stretch, rel=1e-3)


def test_a_gripper_between_two_masses_is_a_damped_oscillator() -> None:
    """One direction of a free base of 3 kg and a target of 6 kg, weakly damped: F = v sqrt(k m), m
    the reduced mass.
    """
    base, target, k = np.eye(7) * 3.0, np.eye(6) * 6.0, 50.0
    jacobian = np.eye(6, 7)
    grasp = compliant_grasp(
        mass_matrix=base + jacobian.T @ target @ jacobian,
        jacobian=jacobian,
        target_inertia=target,
        velocity=np.zeros(7),
        target_velocity=np.array([0.0, 0, 0, 0.7, 0, 0]),
        stiffness=np.full(6, k),
        damping=np.full(6, 1e-4),
    )
    reduced = 3.0 * 6.0 / 9.0
    assert grasp.peak_force == pytest.approx(0.7 * np.sqrt(k * reduced), rel=1e-3)
    assert grasp.peak_stretch == pytest.approx(0.7 * np.sqrt(reduced / k), rel=1e-3)
    assert grasp.peak_torque == 0.0
    # The energy falls as exp(-c t / m).
    assert grasp.time == pytest.approx(np.log(100) * reduced / 1e-4, rel=0.02)
    assert_allclose(grasp.impulse, [0, 0, 0, -0.7 * reduced, 0, 0], atol=1e-12)


def mujoco_weld(
    q: np.ndarray, v: np.ndarray, X_WP: RigidTransform, V: np.ndarray, *, time_constant: float
) -> np.ndarray:
    """Rates (11, Drake's order) of MuJoCo's own bodies, 12 time constants after its weld takes
    hold.
    """
    servicer, _, target = oracle.mjcf(oracle.TRUE_TARGET).partition('<body name="target"')
    held, end, rest = target.partition("</body>")
    free = '<body name="target"><freejoint/>' + held.partition(">")[2] + end
    x, y, z = X_WP.translation()
    reach = oracle.LINK_LENGTHS[-1] + oracle.TARGET_OFFSET
    text = servicer + rest.replace("</worldbody>", f"{free}</worldbody>" + f"""
      <equality><weld body1="link_5" body2="target" relpose="0 0 {reach} 1 0 0 0"
        solref="{time_constant} 1" solimp="0.9999 0.9999 1 0.5 2"/></equality>""")  # fmt: skip
    text = text.replace(
        'gravity="0 0 0"', f'gravity="0 0 0" timestep="{time_constant / 20}" tolerance="1e-15"'
    )
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    configuration, rates = q[oracle.Q_FROM_DRAKE], v[oracle.V_FROM_DRAKE]
    data.qpos[:12], data.qvel[:11] = configuration, oracle.rates_to_qvel(configuration, rates)
    data.qpos[12:15], data.qpos[15:] = (x, y, z), X_WP.rotation().ToQuaternion().wxyz()
    data.qvel[11:14], data.qvel[14:] = V[3:], X_WP.rotation().matrix().T @ V[:3]
    for _ in range(12 * 20):
        mujoco.mj_step(model, data)
    return oracle.qvel_to_rates(data.qpos[:12], data.qvel[:11])[oracle.V_TO_DRAKE]


def test_it_is_the_limit_of_mujocos_weld() -> None:
    scenario = tumbling(5.0)
    model = make_true_plant(scenario)
    contact = planned_contact(make_mission(scenario), model)
    model.plant.SetPositions(model.context, contact.q)
    X_WP = model.plant.GetBodyByName("debris").EvalPoseInWorld(model.context)
    jump = np.linalg.norm(contact.grasp.velocity - contact.velocity)
    first, second = (
        mujoco_weld(
            contact.q, contact.velocity, X_WP, contact.target_velocity, time_constant=constant
        )
        for constant in (2e-3, 1e-3)
    )
    errors = [np.linalg.norm(rates - contact.grasp.velocity) / jump for rates in (first, second)]
    # of first order in the time constant
    assert errors[0] == pytest.approx(2.0 * errors[1], rel=0.1)
    limit = 2.0 * second - first
    assert np.linalg.norm(limit - contact.grasp.velocity) / jump < 1e-3
