"""Free floating: J*, H*, momentum and reaction null space against Pinocchio, MuJoCo and free motion
of the plant.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.math import RigidTransform
from pydrake.multibody.tree import RotationalInertia, SpatialInertia
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from ffsm_drake import ModelError, ScenarioError, load_scenario, make_true_plant
from ffsm_drake.scenario import MassProperties
from ffsm_drake.spacecraft.craft import Craft
from ffsm_drake.spacecraft.free_floating import free_floating
from ffsm_drake.spacecraft.mass_properties import set_payload
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import base_body

SCENARIOS = ("postcapture", "seven_joint", "planar_detumble")
OFF_CENTRE = MassProperties(
    mass=70.0, center_of_mass=[0.2, -0.3, 0.15], inertia=[12.0, 9.0, 7.0, 1.5, -0.8, 0.6]
)
BASE_CENTRE = np.array([0.21, -0.13, 0.17])  # m, of mass, from the base's frame
STATES = 334  # of each spacecraft: 1,000 in all


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """A spacecraft with base and payload off their centres of mass."""

    model: PlantModel
    payload: str  # scoped name of the body


def make_case(scenario: str) -> Case:
    loaded = load_scenario(scenario)
    model = make_true_plant(loaded)
    set_payload(model.plant, model.context, body=loaded.payload.body, properties=OFF_CENTRE)
    base = base_body(model.plant)
    mass = base.default_mass()
    inertia = RotationalInertia(
        Ixx=0.5 * mass,
        Iyy=0.6 * mass,
        Izz=0.4 * mass,
        Ixy=0.03 * mass,
        Ixz=-0.02 * mass,
        Iyz=0.01 * mass,
    )
    moved = SpatialInertia.MakeFromCentralInertia(mass=mass, p_PScm_E=BASE_CENTRE, I_SScm_E=inertia)
    base.SetSpatialInertiaInBodyFrame(model.context, moved)
    return Case(model=model, payload=loaded.payload.body)


@pytest.fixture(scope="module", params=SCENARIOS)
def case(request: pytest.FixtureRequest) -> Case:
    return make_case(request.param)


@pytest.fixture(scope="module")
def planar() -> PlantModel:
    return make_true_plant(load_scenario("planar_detumble"))


def random_states(model: PlantModel, count: int) -> tuple[np.ndarray, np.ndarray]:
    """q (count, nq) and v (count, nv)."""
    rng = np.random.default_rng(17)
    joints = len(model.coordinates.joints)
    attitudes = Rotation.random(count, random_state=17).as_quat()[:, [3, 0, 1, 2]]
    q = np.hstack(
        [attitudes, rng.uniform(-3, 3, (count, 3)), rng.uniform(-np.pi, np.pi, (count, joints))]
    )
    return q, rng.normal(size=(count, 6 + joints))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Link:
    """What moves as one body, in the frame of its joint; the base first."""

    parent: int
    place: RigidTransform  # in the parent, at zero
    axis: np.ndarray
    mass: float
    center: np.ndarray
    inertia: np.ndarray  # (3, 3), about the centre of mass


def links_of(case: Case) -> tuple[list[Link], RigidTransform]:
    """The tree as numbers, and the payload's frame in its last link."""
    plant, context = case.model.plant, case.model.context
    joints = [
        joint
        for joint in map(plant.get_joint, plant.GetJointIndices())
        if joint.num_velocities() == 1
    ]
    joints.sort(key=lambda joint: joint.velocity_start())
    bodies = [base_body(plant), *(joint.child_body() for joint in joints)]
    plant.SetPositions(context, np.r_[1.0, np.zeros(plant.num_positions() - 1)])
    link_of = {
        each.index(): i for i, body in enumerate(bodies) for each in plant.GetBodiesWeldedTo(body)
    }
    links = []
    for i, body in enumerate(bodies):
        parts = [index for index, link in link_of.items() if link == i]
        inertia = plant.CalcSpatialInertia(context, body.body_frame(), parts)
        parent = link_of[joints[i - 1].parent_body().index()] if i else -1
        frame = bodies[parent].body_frame() if i else plant.world_frame()
        links.append(Link(
            parent=parent,
            place=plant.CalcRelativeTransform(context, frame, body.body_frame()),
            axis=joints[i - 1].revolute_axis() if i else np.zeros(3),
            mass=inertia.get_mass(),
            center=inertia.get_com(),
            inertia=inertia.Shift(inertia.get_com()).CalcRotationalInertia().CopyToFullMatrix3(),
        ))  # fmt: skip
    payload = plant.GetBodyByName(case.payload.rpartition("::")[2])
    assert link_of[payload.index()] == len(links) - 1
    return links, plant.CalcRelativeTransform(
        context, bodies[-1].body_frame(), payload.body_frame()
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Found:
    """What another library says of a state; base velocities in its own order and axes, joints
    last.
    """

    jacobian: np.ndarray  # (6, nv) of the payload's frame, [w; v] in world axes
    base_to_drake: np.ndarray  # (6, 6): [w_WB; v_WB] of its own base velocities
    inverse_mass_matrix: np.ndarray
    free_acceleration: np.ndarray  # without forces
    coupling: np.ndarray  # (6, nj): its base velocities per joint rate at zero momentum
    momentum: np.ndarray  # (6) angular about the world's origin, linear


def pinocchio_states(case: Case, q: np.ndarray, v: np.ndarray) -> Iterator[Found]:
    """Base velocities (v_B, w_B), in the base's axes; the coupling is from the centroidal momentum
    matrix.
    """
    pin = pytest.importorskip("pinocchio", reason="needs the extra 'oracles'")
    links, place = links_of(case)

    def se3(X: RigidTransform) -> Any:
        return pin.SE3(X.rotation().matrix(), X.translation())

    model = pin.Model()
    model.gravity = pin.Motion.Zero()
    joints: list[int] = []
    for i, link in enumerate(links):
        kind = pin.JointModelRevoluteUnaligned(link.axis) if i else pin.JointModelFreeFlyer()
        parent = joints[link.parent] if i else 0
        joints.append(model.addJoint(parent, kind, se3(link.place), f"j{i}"))
        model.appendBodyToJoint(
            joints[-1], pin.Inertia(link.mass, link.center, link.inertia), pin.SE3.Identity()
        )
    frame = model.addFrame(pin.Frame("payload", joints[-1], 0, se3(place), pin.FrameType.OP_FRAME))
    data = model.createData()
    for q_i, v_i in zip(q, v, strict=True):
        R = Rotation.from_quat(q_i[[1, 2, 3, 0]]).as_matrix()
        qp = np.r_[q_i[4:7], q_i[[1, 2, 3, 0]], q_i[7:]]
        vp = np.r_[R.T @ v_i[3:6], R.T @ v_i[:3], v_i[6:]]
        acceleration = pin.aba(model, data, qp, vp, np.zeros(model.nv)).copy()
        inverse = np.array(pin.computeMinverse(model, data, qp))
        inverse = np.triu(inverse) + np.triu(inverse, 1).T
        jacobian = pin.computeFrameJacobian(model, data, qp, frame, pin.LOCAL_WORLD_ALIGNED)[
            [3, 4, 5, 0, 1, 2]
        ]
        central = np.array(pin.computeCentroidalMap(model, data, qp))
        h = np.array(pin.computeCentroidalMomentum(model, data, qp, vp))
        yield Found(
            jacobian=jacobian,
            base_to_drake=np.block([[np.zeros((3, 3)), R], [R, np.zeros((3, 3))]]),
            inverse_mass_matrix=inverse,
            free_acceleration=acceleration,
            coupling=-np.linalg.solve(central[:, :6], central[:, 6:]),
            momentum=np.r_[h[3:] + np.cross(data.com[0], h[:3]), h[:3]],
        )


def mujoco_states(case: Case, q: np.ndarray, v: np.ndarray) -> Iterator[Found]:
    """Base velocities (v_W, w_B); the coupling is from the mass matrix."""
    links, place = links_of(case)

    def text(numbers: Any) -> str:
        return " ".join(repr(float(number)) for number in numbers)

    def pose(X: RigidTransform) -> str:
        return f'pos="{text(X.translation())}" quat="{text(X.rotation().ToQuaternion().wxyz())}"'

    inside = {len(links) - 1: f'<site name="payload" {pose(place)}/>'}
    for i in reversed(range(len(links))):
        link = links[i]
        moments, axes = np.linalg.eigh(link.inertia)
        turn = Rotation.from_matrix(axes * np.sign(np.linalg.det(axes))).as_quat()[[3, 0, 1, 2]]
        joint = f'<joint type="hinge" axis="{text(link.axis)}"/>' if i else "<freejoint/>"
        inside[link.parent] = inside.get(link.parent, "") + (
            f'<body name="b{i}" {pose(link.place)}>{joint}<inertial pos="{text(link.center)}" '
            f'quat="{text(turn)}" '
            f'mass="{link.mass!r}" diaginertia="{text(moments)}"/>{inside.get(i, "")}</body>'
        )
    spec = f'<mujoco><option gravity="0 0 0"/><worldbody>{inside[-1]}</worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(spec)
    data = mujoco.MjData(model)
    size = model.nv
    base, site = model.body("b0").id, model.site("payload").id
    for q_i, v_i in zip(q, v, strict=True):
        R = Rotation.from_quat(q_i[[1, 2, 3, 0]]).as_matrix()
        data.qpos[:] = np.r_[q_i[4:7], q_i[:4], q_i[7:]]
        data.qvel[:] = np.r_[v_i[3:6], R.T @ v_i[:3], v_i[6:]]
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        inverse, mass_matrix = np.zeros((size, size)), np.zeros((size, size))
        mujoco.mj_solveM(model, data, inverse, np.eye(size))
        for unit, column in zip(np.eye(size), mass_matrix, strict=True):
            mujoco.mj_mulM(model, data, column, unit)
        linear, angular = np.zeros((3, size)), np.zeros((3, size))
        mujoco.mj_jacSite(model, data, linear, angular, site)
        p = data.subtree_linvel[base] * model.body_subtreemass[base]
        zero = np.zeros((3, 3))
        yield Found(
            jacobian=np.vstack([angular, linear]),
            base_to_drake=np.block([[zero, R], [np.eye(3), zero]]),
            inverse_mass_matrix=inverse,
            free_acceleration=data.qacc.copy(),
            coupling=-np.linalg.solve(mass_matrix[:6, :6], mass_matrix[:6, 6:]),
            momentum=np.r_[data.subtree_angmom[base] + np.cross(data.subtree_com[base], p), p],
        )


Library = Callable[[Case, np.ndarray, np.ndarray], Iterator[Found]]
of_each_library = pytest.mark.parametrize(
    "library", [pinocchio_states, mujoco_states], ids=["pinocchio", "mujoco"]
)


def stacked(library: Library, case: Case, q: np.ndarray, v: np.ndarray) -> Found:
    found = list(library(case, q, v))
    names = [field.name for field in dataclasses.fields(Found)]
    return Found(**{name: np.array([getattr(each, name) for each in found]) for name in names})


def assert_near(mine: np.ndarray, theirs: np.ndarray, *, vectors: bool = False) -> None:
    """Of each state (n, ...) to 1e-10 of its largest element; twists (n, 6, ...) part by part."""
    if vectors:
        assert_near(mine[:, :3], theirs[:, :3])
        return assert_near(mine[:, 3:6], theirs[:, 3:6])
    assert mine.shape == theirs.shape
    axes = tuple(range(1, theirs.ndim))
    assert (
        np.abs(mine - theirs).max(axis=axes) / np.maximum(np.abs(theirs).max(axis=axes), 1e-3)
    ).max() < 1e-10
    return None


def applied(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return (matrices @ vectors[..., None])[..., 0]


@of_each_library
@pytest.mark.smoke
def test_generalized_jacobian_reduced_dynamics_and_projectors(case: Case, library: Library) -> None:
    model = case.model
    q, v = random_states(model, STATES)
    theirs = stacked(library, case, q, v)
    ours = free_floating(model, q)
    jacobian = model.calc_jacobian(q, case.payload)
    generalized = ours.generalized_jacobian(jacobian)
    expected = theirs.jacobian[..., 6:] + theirs.jacobian[..., :6] @ theirs.coupling
    assert_near(generalized, expected, vectors=True)
    # the joints' accelerations under their torques
    reduced = np.linalg.inv(theirs.inverse_mass_matrix[:, 6:, 6:])
    assert_near(ours.reduced_mass_matrix, reduced)
    bias = ours.reduced_bias(model.calc_bias(q, v))
    assert_near(bias, -applied(reduced, theirs.free_acceleration[:, 6:]))
    # The momentum that they find leaves the base the velocity that it has, and the frame the twist.
    assert_near(ours.momentum(v), theirs.momentum)
    assert_near(ours.velocity(v[:, 6:], theirs.momentum), v, vectors=True)
    twist = applied(generalized, v[:, 6:]) + ours.drift(jacobian, theirs.momentum)
    base = applied(theirs.base_to_drake.transpose(0, 2, 1), v[:, :6])
    their_twist = applied(theirs.jacobian, np.hstack([base, v[:, 6:]]))
    assert_near(twist, their_twist, vectors=True)
    coupling = theirs.base_to_drake @ theirs.coupling
    for held, rows in (
        (("base_rotation",), coupling[:, :3]),
        (("base_rotation", "base_position"), coupling),
    ):
        projector = np.eye(v.shape[1] - 6) - np.linalg.pinv(rows, rcond=1e-9) @ rows
        assert np.abs(ours.reaction_null_space(held) - projector).max() < 1e-10


@of_each_library
def test_with_driven_attitude_the_position_follows(case: Case, library: Library) -> None:
    model = case.model
    q, v = random_states(model, 50)
    theirs = stacked(library, case, q, v)
    ours = free_floating(model, q, ("base_rotation", "joints"))
    jacobian = model.calc_jacobian(q, case.payload)
    driven = np.r_[0:3, 6 : v.shape[1]]
    turn = np.tile(np.eye(v.shape[1]), (len(q), 1, 1))
    turn[:, :6, :6] = theirs.base_to_drake
    inverse = turn @ theirs.inverse_mass_matrix @ turn.transpose(0, 2, 1)
    reduced = np.linalg.inv(inverse[:, driven[:, None], driven])
    assert_near(ours.reduced_mass_matrix, reduced)
    # Under forces on driven coordinates alone, accelerations from rest are in the proportion of the
    # velocities.
    following = inverse[:, 3:6, driven] @ reduced
    their_jacobian = theirs.jacobian @ turn.transpose(0, 2, 1)
    expected = their_jacobian[..., driven] + their_jacobian[..., 3:6] @ following
    assert_near(ours.generalized_jacobian(jacobian), expected, vectors=True)
    # dw/dt in world axes is R times that in the base's: no further term for the rows that are
    # driven.
    accelerations = applied(turn, theirs.free_acceleration)[:, driven]
    assert_near(ours.reduced_bias(model.calc_bias(q, v)), -applied(reduced, accelerations))
    assert_near(ours.velocity(v[:, driven], theirs.momentum), v)


def test_angular_momentum_about_the_centre_of_mass(case: Case) -> None:
    q, v = random_states(case.model, 50)
    stack = free_floating(case.model, q)
    plant, context = case.model.plant, case.model.context
    for each, state in enumerate(np.hstack([q, v])):
        plant.SetPositionsAndVelocities(context, state)
        center = plant.CalcCenterOfMassPositionInWorld(context)
        assert_allclose(q[each, 4:7] + stack.center_of_mass[each], center, atol=1e-12)
        spin = plant.CalcSpatialMomentumInWorldAboutPoint(context, center).rotational()
        assert_allclose(stack.spin_map[each] @ v[each], spin, rtol=1e-11, atol=1e-9)


def test_a_free_plant_moves_as_momentum_says(case: Case) -> None:
    """Torques on the joints alone: the frame's velocity, by differences of its pose, is J* q' +
    drift.
    """
    model, plant, context = case.model, case.model.plant, case.model.context.Clone()
    q, v = (each[0] for each in random_states(model, 1))
    v = 0.3 * v
    momentum = free_floating(model, q).momentum(v)
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    torques = np.r_[np.zeros(6), np.linspace(1.0, -1.5, v.size - 6)]
    plant.get_applied_generalized_force_input_port().FixValue(context, torques)
    simulator = Simulator(plant, context)
    config = SimulatorConfig(
        integration_scheme="runge_kutta5",
        max_step_size=0.05,
        accuracy=1e-13,
        use_error_control=True,
    )
    ApplySimulatorConfig(config, simulator)
    step, states, poses = 2e-3, [], []
    frame = plant.GetBodyByName(case.payload.rpartition("::")[2]).body_frame()
    for k in range(5):  # at 1 s, and two steps to either side
        simulator.AdvanceTo(1.0 + (k - 2) * step)
        states.append((plant.GetPositions(context), plant.GetVelocities(context)))
        poses.append(frame.CalcPoseInWorld(context))
    q, v = states[2]
    spacecraft, jacobian = free_floating(model, q), model.calc_jacobian(q, case.payload)
    twist = spacecraft.generalized_jacobian(jacobian) @ v[6:] + spacecraft.drift(jacobian, momentum)
    places = [X.translation() for X in poses]
    turns = [
        Rotation.from_matrix((X.rotation() @ poses[2].rotation().inverse()).matrix()).as_rotvec()
        for X in poses
    ]
    for part, values in ((twist[:3], turns), (twist[3:], places)):
        measured = (8 * (values[3] - values[1]) - (values[4] - values[0])) / (12 * step)
        assert np.linalg.norm(measured) > 0.05
        assert_allclose(part, measured, rtol=0, atol=1e-8)
    assert np.linalg.norm(spacecraft.drift(jacobian, momentum)) > 0.05
    assert_allclose(spacecraft.velocity(v[6:], momentum), v, rtol=0, atol=1e-10)


def test_a_circle_of_the_joints_turns_the_base(planar: PlantModel) -> None:
    """A closed path of the joints at zero momentum; the sum over a period is exact to rounding."""
    s = np.arange(200) / 200
    turn = 2 * np.pi * s
    joints = np.stack(
        [-0.72 + 0.5 * np.sin(turn), 1.2 + 0.5 * (1 - np.cos(turn)), np.full_like(s, 0.72)], axis=1
    )
    rates = np.pi * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(s)], axis=1)
    q = np.hstack([np.tile(np.r_[1.0, np.zeros(6)], (s.size, 1)), joints])
    v = free_floating(planar, q).velocity(rates)
    # The base turns about y alone, so that the sum of its rates is its angle, wherever it points.
    assert_allclose(v[:, [0, 2]], 0.0, rtol=0, atol=1e-12)
    assert v[:, 1].mean() == pytest.approx(-0.0551902, abs=5e-8)


def test_null_space_motion_leaves_the_bases_attitude_alone() -> None:
    """30 s of joint motion of the seven-joint arm; the same rates without the projector turn the
    base.
    """
    scenario = load_scenario("seven_joint")
    model = make_true_plant(scenario)
    wanted = np.array([0.1, -0.08, 0.06, 0.05, -0.07, 0.09, 0.04])  # rad/s
    start = np.r_[1.0, np.zeros(6), 0.4, 0.2, 0.3, 1.0, 0.3, -0.3, 0.5]

    def attitude_after(project: bool) -> tuple[float, float]:
        """Angle and way of the base."""

        def rate(time: float, q: np.ndarray) -> np.ndarray:
            q = np.r_[q[:4] / np.linalg.norm(q[:4]), q[4:]]
            spacecraft = free_floating(model, q)
            rates = wanted * np.cos(2 * np.pi * time / 40)
            v = spacecraft.velocity(spacecraft.reaction_null_space() @ rates if project else rates)
            return model.plant.MapVelocityToQDot(model.context, v)

        end = solve_ivp(rate, (0.0, 30.0), start, rtol=1e-7, atol=1e-9).y[:, -1]
        return Rotation.from_quat(end[[1, 2, 3, 0]]).magnitude(), float(np.linalg.norm(end[4:7]))

    turned, moved = attitude_after(project=True)
    assert turned < 1e-9
    assert moved > 0.01  # the arm did move
    assert attitude_after(project=False)[0] == pytest.approx(0.31, abs=5e-3)


def test_with_no_freedom_left_the_projector_is_zero(planar: PlantModel) -> None:
    q, _ = random_states(planar, 3)
    spacecraft = free_floating(planar, q)
    assert_allclose(
        spacecraft.reaction_null_space(("base_rotation", "base_position")), 0.0, rtol=0, atol=1e-9
    )
    # three joints, one angle
    assert_allclose(np.trace(spacecraft.reaction_null_space(), axis1=1, axis2=2), 2.0)
    everything = free_floating(planar, q, ("all",))
    assert_allclose(everything.reduced_mass_matrix, everything.mass_matrix, rtol=0, atol=0)
    assert_allclose(
        everything.generalized_jacobian(planar.calc_jacobian(q, "debris::target")),
        planar.calc_jacobian(q, "debris::target"),
        rtol=0,
        atol=0,
    )


def test_bad_input_is_said_in_one_line(planar: PlantModel) -> None:
    q = random_states(planar, 1)[0][0]
    with pytest.raises(ScenarioError, match="did you mean 'joint_1'"):
        free_floating(planar, q, ("joint1",))
    with pytest.raises(ModelError, match="frame: no frame 'debris::targett'"):
        planar.calc_jacobian(q, "debris::targett")
    part = free_floating(planar, q, ("base_rotation", "joint_1", "joint_2"))
    assert part.reduced_mass_matrix.shape == (5, 5)
    with pytest.raises(ValueError, match="whole base or its position"):
        part.velocity(np.zeros(5))
    with pytest.raises(ValueError, match="is driven"):
        free_floating(planar, q, ("base_rotation", "joints")).reaction_null_space()
    flexible = load_scenario("flexible_panels")
    with pytest.raises(ValueError, match="flexible parts"):
        free_floating(Craft(flexible).flexible(), np.zeros(14))
