"""The plant against MuJoCo and Pinocchio, whose models are built from the paper's numbers, and the
balances of its motion.
"""

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import mujoco_oracle as oracle
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem
from scipy.spatial.transform import Rotation

from ffsm_drake.loop.closed_loop import make_closed_loop
from ffsm_drake.scenario import MassProperties, Model, load_scenario
from ffsm_drake.spacecraft.craft import make_nominal_plant, make_true_plant
from ffsm_drake.spacecraft.mass_properties import set_payload
from ffsm_drake.spacecraft.plant import make_plant

DEBRIS = "debris::debris"
TOTAL_MASS = 400 + 3 + 10 + 10 + 1.5 + 1.5 + 100
OFF_CENTRE = oracle.Target(
    70.0, center_of_mass=(0.2, -0.3, 0.15), inertia=(12.0, 9.0, 7.0, 1.5, -0.8, 0.6)
)

State = tuple[np.ndarray, np.ndarray, np.ndarray]  # q, v and generalized force
# mass matrix, bias term, acceleration; all in Drake's order
Dynamics = tuple[np.ndarray, np.ndarray, np.ndarray]


def random_states(number: int) -> Iterator[State]:
    """Drake's q (12), v (11) and generalized forces (11)."""
    rng = np.random.default_rng(20240501)
    for _ in range(number):
        quaternion = rng.normal(size=4)
        joints = rng.uniform(-np.pi, np.pi, 5)
        q = np.concatenate([quaternion / np.linalg.norm(quaternion), rng.uniform(-2, 2, 3), joints])
        yield q, rng.normal(size=11), rng.normal(scale=20, size=11)


def set_target(plant: MultibodyPlant, context: Context, target: oracle.Target) -> None:
    properties = MassProperties(
        mass=target.mass, center_of_mass=list(target.center_of_mass), inertia=list(target.inertia)
    )
    set_payload(plant, context, body=DEBRIS, properties=properties)


@pytest.fixture(scope="module")
def plant() -> MultibodyPlant:
    return make_plant(Model())


@pytest.fixture
def context(plant: MultibodyPlant) -> Context:
    return plant.CreateDefaultContext()


@pytest.fixture(scope="module", params=["parsed", "truth", "nominal", "off_centre"])
def ours(request: pytest.FixtureRequest) -> tuple[MultibodyPlant, Context, oracle.Target]:
    """A plant and context of the package, with the target that it should hold."""
    scenario = load_scenario("postcapture")
    if request.param == "nominal":
        nominal = make_nominal_plant(scenario)
        return nominal.plant, nominal.context, oracle.BELIEVED_TARGET
    plant = make_plant(scenario.model)
    context = plant.CreateDefaultContext()
    if request.param == "truth":
        set_payload(plant, context, body=scenario.payload.body, properties=scenario.payload.truth)
    elif request.param == "off_centre":
        set_target(plant, context, OFF_CENTRE)
        return plant, context, OFF_CENTRE
    return plant, context, oracle.TRUE_TARGET


def drake_dynamics(plant: MultibodyPlant, context: Context, state: State) -> Dynamics:
    q, v, force = state
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    plant.get_applied_generalized_force_input_port().FixValue(context, force)
    acceleration = plant.get_generalized_acceleration_output_port().Eval(context)
    return plant.CalcMassMatrix(context), plant.CalcBiasTerm(context), acceleration


def mujoco_dynamics(
    target: oracle.Target, rotors: np.ndarray | float = 0.0
) -> Callable[[State], Dynamics]:
    """``rotors``: inertia of the joints' drives, seen at the joints (5), kg m^2."""
    spacecraft = oracle.MujocoSpacecraft(target)
    spacecraft.model.dof_armature[6:] = rotors
    order = oracle.V_TO_DRAKE

    def dynamics(state: State) -> Dynamics:
        configuration = state[0][oracle.Q_FROM_DRAKE]
        rates, force = (vector[oracle.V_FROM_DRAKE] for vector in state[1:])
        return (
            spacecraft.mass_matrix(configuration)[np.ix_(order, order)],
            spacecraft.bias(configuration, rates)[order],
            spacecraft.acceleration(configuration, rates, force)[order],
        )

    return dynamics


def pinocchio_dynamics(
    pin: Any, target: oracle.Target, rotors: np.ndarray | float = 0.0
) -> Callable[[State], Dynamics]:
    """Pinocchio takes q = (p_WB, quaternion xyzw, joints) and v = (v_B, w_B, joint rates), both
    base vectors in B.
    """

    def at(z: float) -> Any:
        return pin.SE3(np.eye(3), np.array([0.0, 0.0, z]))

    model = pin.Model()
    model.gravity = pin.Motion.Zero()
    body = model.addJoint(0, pin.JointModelFreeFlyer(), at(0.0), "base")
    model.appendBodyToJoint(
        body, pin.Inertia(oracle.BASE_MASS, np.zeros(3), oracle.BASE_INERTIA * np.eye(3)), at(0.0)
    )
    mounts = (oracle.ARM_MOUNT, *oracle.LINK_LENGTHS[:-1])
    for i, (mass, length, axis) in enumerate(
        zip(oracle.LINK_MASSES, oracle.LINK_LENGTHS, oracle.JOINT_AXES, strict=True)
    ):
        joint = (pin.JointModelRX, pin.JointModelRY, pin.JointModelRZ)[axis.index(1)]()
        body = model.addJoint(body, joint, at(mounts[i]), f"joint_{i + 1}")
        central = np.diag(oracle.rod_inertia(mass, length))
        model.appendBodyToJoint(body, pin.Inertia(mass, np.zeros(3), central), at(length / 2))
    held = pin.Inertia(target.mass, np.array(target.center_of_mass), oracle.inertia_matrix(target))
    model.appendBodyToJoint(body, held, at(oracle.LINK_LENGTHS[-1] + oracle.TARGET_OFFSET))
    model.armature = np.r_[np.zeros(6), np.zeros(5) + rotors]
    data = model.createData()

    def dynamics(state: State) -> Dynamics:
        q, v, force = state
        rotation = Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix()
        # v_pin = to_pin v, and to_pin's rate times v is the rest of the acceleration: R^T (-w x v)
        # for the base.
        to_pin = np.zeros((11, 11))
        to_pin[0:3, 3:6] = to_pin[3:6, 0:3] = rotation.T
        to_pin[6:, 6:] = np.eye(5)
        rest = np.zeros(11)
        rest[0:3] = -rotation.T @ np.cross(v[0:3], v[3:6])
        q_pin = np.concatenate([q[4:7], q[[1, 2, 3, 0]], q[7:]])
        v_pin = to_pin @ v
        upper = np.triu(pin.crba(model, data, q_pin))
        mass_matrix = upper + np.triu(upper, 1).T
        bias = pin.rnea(model, data, q_pin, v_pin, np.zeros(11))
        acceleration = pin.aba(model, data, q_pin, v_pin, np.linalg.solve(to_pin.T, force))
        return (
            to_pin.T @ mass_matrix @ to_pin,
            to_pin.T @ (bias + mass_matrix @ rest),
            np.linalg.solve(to_pin, acceleration - rest),
        )

    return dynamics


def assert_same_dynamics(
    ours: tuple[MultibodyPlant, Context, oracle.Target], theirs: Callable[[State], Dynamics]
) -> None:
    """Each block by kind of coordinate agrees to 1e-10 of its own largest element, on 100
    states: masses, inertias, places and axes are those of the paper, and there is no gravity.
    """
    plant, context, _ = ours
    groups = (slice(0, 3), slice(3, 6), slice(6, 11))
    for state in random_states(100):
        (mass_matrix, *vectors), (their_mass_matrix, *their_vectors) = (
            drake_dynamics(plant, context, state),
            theirs(state),
        )
        pairs = [
            (mass_matrix[i, j], their_mass_matrix[i, j])
            for i, j in itertools.product(groups, groups)
        ]
        pairs += [(a[i], b[i]) for a, b in zip(vectors, their_vectors, strict=True) for i in groups]
        for mine, expected in pairs:
            assert_allclose(mine, expected, rtol=0, atol=1e-10 * np.abs(expected).max() + 1e-14)


@pytest.mark.smoke
def test_dynamics_agree_with_mujoco(ours: tuple[MultibodyPlant, Context, oracle.Target]) -> None:
    assert_same_dynamics(ours, mujoco_dynamics(ours[2]))


def test_dynamics_agree_with_pinocchio(ours: tuple[MultibodyPlant, Context, oracle.Target]) -> None:
    pinocchio = pytest.importorskip("pinocchio", reason="needs the extra 'oracles'")
    assert_same_dynamics(ours, pinocchio_dynamics(pinocchio, ours[2]))


ROTORS = np.array([2.0, 0.5, 0.1, 3.0, 0.02])  # kg m^2, of a ratio of 100


@pytest.mark.parametrize("name", ["mujoco", "pinocchio"])
def test_rotors_of_drives_are_armature(name: str) -> None:
    """Mass matrix, bias and acceleration; the mass matrix to 1e-12 of its largest element by kind
    of coordinate.
    """
    rotors = {f"joint_{i + 1}": float(1e-4 * value) for i, value in enumerate(ROTORS)}
    scenario = load_scenario(
        "postcapture", [f"actuation.drives={{gear_ratio: 100, rotor_inertia: {rotors}}}"]
    )
    model = make_true_plant(scenario)
    ours = (model.plant, model.context, oracle.TRUE_TARGET)
    if name == "mujoco":
        theirs = mujoco_dynamics(oracle.TRUE_TARGET, ROTORS)
    else:
        theirs = pinocchio_dynamics(pytest.importorskip("pinocchio"), oracle.TRUE_TARGET, ROTORS)
    assert_same_dynamics(ours, theirs)
    groups = (slice(0, 3), slice(3, 6), slice(6, 11))
    for state in random_states(20):
        mine, expected = drake_dynamics(model.plant, model.context, state)[0], theirs(state)[0]
        for i, j in itertools.product(groups, groups):
            assert_allclose(
                mine[i, j],
                expected[i, j],
                rtol=0,
                atol=1e-12 * np.abs(expected[i, j]).max() + 1e-13,
            )


def simulate_tightly(system: Any, context: Context, duration: float) -> None:
    simulator = Simulator(system, context)
    config = SimulatorConfig(
        integration_scheme="runge_kutta5", max_step_size=0.1, accuracy=1e-14, use_error_control=True
    )
    ApplySimulatorConfig(config, simulator)
    simulator.Initialize()
    simulator.AdvanceTo(duration)


@pytest.mark.parametrize(
    "number", [0, *(pytest.param(number, marks=pytest.mark.slow) for number in (1, 2))]
)
def test_free_motion_conserves_momentum_and_energy(
    plant: MultibodyPlant, context: Context, number: int
) -> None:
    set_target(plant, context, OFF_CENTRE)

    def conserved() -> tuple[np.ndarray, np.ndarray, float]:
        momentum = plant.CalcSpatialMomentumInWorldAboutPoint(context, np.zeros(3))
        return momentum.translational(), momentum.rotational(), plant.CalcKineticEnergy(context)

    q, v, _ = list(random_states(3))[number]
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    # The same momenta from the mass matrix: its base rows are moments about the base's origin.
    generalized = plant.CalcMassMatrix(context) @ v
    before = conserved()
    about_origin = generalized[:3] + np.cross(q[4:7], generalized[3:6])
    for mine, theirs in zip((generalized[3:6], about_origin), before[:2], strict=True):
        assert_allclose(mine, theirs, rtol=0, atol=1e-12 * np.linalg.norm(theirs))
    simulate_tightly(plant, context, 2.0)
    assert np.abs(plant.GetPositions(context) - q).max() > 1  # it did move
    for start, end in zip(before, conserved(), strict=True):
        assert np.linalg.norm(end - start) < 1e-10 * np.linalg.norm(start)


class WorkMeter(LeafSystem):
    """Integrates the power of forces: inputs ``state`` (it ends in the velocities), ``force_0`` and
    ``force_1``.
    """

    def __init__(self) -> None:
        super().__init__()
        self._state = self.DeclareVectorInputPort("state", 23)
        self._forces = [self.DeclareVectorInputPort(f"force_{i}", 11) for i in range(2)]
        self.DeclareContinuousState(1)

    def DoCalcTimeDerivatives(self, context: Context, derivatives: Any) -> None:
        force = sum(port.Eval(context) for port in self._forces)
        derivatives.get_mutable_vector().SetFromVector([self._state.Eval(context)[-11:] @ force])


def test_work_of_control_and_disturbance_is_the_gain_of_kinetic_energy() -> None:
    """In the shipped closed loop, as integrated there: the work of control and disturbance,
    added.
    """
    loop = make_closed_loop(load_scenario("postcapture"))
    builder = DiagramBuilder()
    builder.AddSystem(loop.diagram)
    meter = builder.AddSystem(WorkMeter())
    for output, name in (
        ("state", "state"),
        ("generalized_force", "force_0"),
        ("disturbance_force", "force_1"),
    ):
        builder.Connect(loop.diagram.GetOutputPort(output), meter.GetInputPort(name))
    root = builder.Build()
    simulator = Simulator(root)
    ApplySimulatorConfig(loop.scenario.simulator_config, simulator)
    context = simulator.get_mutable_context()
    loop.initialize(root, context)
    simulator.Initialize()
    simulator.AdvanceTo(6.0)
    energy = loop.plant.CalcKineticEnergy(loop.plant.GetMyContextFromRoot(context))
    assert energy > 0.1
    (work,) = meter.GetMyContextFromRoot(context).get_continuous_state_vector().CopyToVector()
    assert work == pytest.approx(energy, rel=1e-7)


def test_arm_turns_about_its_axes_the_right_way_round(
    plant: MultibodyPlant, context: Context
) -> None:
    """The poses of hand and target at a bent posture, from a chain of elementary rotations."""
    angles = np.array([0.3, -0.5, 0.9, 1.1, -0.7])
    plant.SetPositions(context, [1, 0, 0, 0, 0, 0, 0, *angles])
    make = (
        RotationMatrix.MakeZRotation,
        RotationMatrix.MakeYRotation,
        RotationMatrix.MakeYRotation,
        RotationMatrix.MakeYRotation,
        RotationMatrix.MakeXRotation,
    )
    pose = RigidTransform()
    for turn, angle, mount in zip(make, angles, (1.0, 0.18, 0.62, 0.62, 0.09), strict=True):
        pose = pose @ RigidTransform(turn(angle), [0, 0, mount])
    pose = pose @ RigidTransform([0, 0, 0.09])
    hand = plant.GetFrameByName("end_effector").CalcPoseInWorld(context)
    assert hand.IsNearlyEqualTo(pose, 1e-12)
    pose = pose @ RigidTransform([0, 0, 0.5])
    assert plant.GetBodyByName("debris").EvalPoseInWorld(context).IsNearlyEqualTo(pose, 1e-12)


def test_payload_of_one_context_leaves_others_alone(
    plant: MultibodyPlant, context: Context
) -> None:
    q, _, _ = next(random_states(1))
    other = plant.CreateDefaultContext()
    for each in (context, other):
        plant.SetPositions(each, q)
    parsed = plant.CalcMassMatrix(other)
    set_target(plant, context, OFF_CENTRE)
    fresh = plant.CreateDefaultContext()
    plant.SetPositions(fresh, q)
    for untouched in (other, fresh):
        assert np.array_equal(plant.CalcMassMatrix(untouched), parsed)
        assert plant.CalcTotalMass(untouched) == pytest.approx(TOTAL_MASS)
    assert plant.CalcTotalMass(context) == pytest.approx(TOTAL_MASS - 30)
    assert np.abs(plant.CalcMassMatrix(context) - parsed).max() > 1
