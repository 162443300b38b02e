"""The scenario seven_joint: its model against the published figures in MuJoCo, its four
controllers, its picture.
"""

import mujoco
import mujoco_oracle as oracle
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.geometry import Box, GeometryInstance, ProximityProperties, Role
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

import ffsm_drake
from ffsm_drake import load_scenario
from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.scenario import MassProperties
from ffsm_drake.spacecraft.craft import make_nominal_plant, make_true_plant
from ffsm_drake.spacecraft.mass_properties import set_payload
from ffsm_drake.spacecraft.plant import add_combined_plant, configuration, coordinates_of
from ffsm_drake.systems.controllers import PAPER_LAWS
from ffsm_drake.systems.reference import make_motion

JOINTS = (
    "shoulder_roll",
    "shoulder_yaw",
    "shoulder_pitch",
    "elbow_pitch",
    "wrist_pitch",
    "wrist_yaw",
    "wrist_roll",
)
SCALE = 0.25
BOOM_RADIUS = 0.175  # m, full size

# Full size, as published, in the published axes (roll x, yaw z, pitch y at the zero posture): name,
# mass in kg, the long side (centre of mass at its middle) and where the next joint is, m, and that
# joint's axis.
PUBLISHED = (
    ("mount", 243.66, (1.3589, 0, 0), (1.3589, 0, 0), "x"),
    ("shoulder_roll_link", 105.98, (0, 0, 0.7026), (0, 0, 0.7026), "z"),
    ("shoulder_yaw_link", 105.98, (0, -0.5692, 0), (0, -0.5692, 0), "y"),
    ("upper_boom", 314.88, (7.11, 0, 0), (7.11, -0.475, 0), "y"),
    ("lower_boom", 279.2, (7.11, 0, 0), (7.11, 0, 0), "y"),
    ("wrist_pitch_link", 105.98, (0, -0.5692, 0), (0, -0.5692, 0), "z"),
    ("wrist_yaw_link", 105.98, (0, 0, -0.7026), (0, 0, -0.7026), "x"),
    ("hand", 243.66, (1.3589, 0, 0), (1.3589, 0, 0), None),
)
# The published x axis is the base's z: a turn of -90 degrees about y, which the arm's foot makes.
FOOT = Rotation.from_euler("y", -np.pi / 2)
OFF_CENTRE = MassProperties(
    mass=70.0, center_of_mass=[0.2, -0.3, 0.15], inertia=[12.0, 9.0, 7.0, 1.5, -0.8, 0.6]
)


def text(numbers) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def wxyz(rotation: Rotation) -> str:
    x, y, z, w = rotation.as_quat()
    return text((w, x, y, z))


def mjcf(target: MassProperties) -> str:
    """The spacecraft in MuJoCo, from the published figures rather than from our URDF."""
    ixx, iyy, izz, *products = target.inertia
    ixy, ixz, iyz = products or (0.0, 0.0, 0.0)
    moments, axes = np.linalg.eigh([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    principal = Rotation.from_matrix(axes * np.sign(np.linalg.det(axes)))
    tip = SCALE * np.array(PUBLISHED[-1][3])
    body = f"""<body pos="{text(tip)}" quat="{wxyz(FOOT.inv())}"><body pos="0 0 0.5">
        <inertial pos="{text(target.center_of_mass)}" quat="{wxyz(principal)}" mass="{target.mass}"
          diaginertia="{text(moments)}"/></body></body>"""
    for k in reversed(range(len(PUBLISHED))):
        name, mass, side, _, _ = PUBLISHED[k]
        mass, side, radius = mass * SCALE**3, SCALE * np.array(side), SCALE * BOOM_RADIUS
        across, along = mass * (3 * radius**2 + side @ side) / 12, mass * radius**2 / 2
        inertia = np.where(side != 0, along, across)
        before = PUBLISHED[k - 1] if k else None
        joint = ""
        if before:
            axis = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}[before[4]]
            joint = f'<joint name="{JOINTS[k - 1]}" type="hinge" axis="{axis}"/>'
        place = (
            f'pos="{text(SCALE * np.array(before[3]))}"'
            if before
            else (f'pos="0 0 1" quat="{wxyz(FOOT)}"')
        )
        body = f"""<body name="{name}" {place}>{joint}
          <inertial pos="{text(side / 2)}" mass="{mass!r}"
            diaginertia="{text(inertia)}"/>{body}</body>"""
    return f"""<mujoco><option gravity="0 0 0"/><worldbody><body name="base"><freejoint/>
      <inertial pos="0 0 0" mass="400" diaginertia="266 266 266"/>{body}</body>
      </worldbody></mujoco>"""


def random_states(number: int):
    """Drake's q (14), v (13) and generalized force (13)."""
    rng = np.random.default_rng(7)
    for _ in range(number):
        quaternion = rng.normal(size=4)
        q = np.concatenate(
            [quaternion / np.linalg.norm(quaternion), rng.uniform(-2, 2, 3), rng.uniform(-3, 3, 7)]
        )
        yield q, rng.normal(size=13), rng.normal(scale=20, size=13)


def test_names():
    coordinates = make_true_plant(load_scenario("seven_joint")).coordinates
    assert coordinates.joints == JOINTS
    assert len(coordinates.names) == 13
    assert set(coordinates.joint_units) == {"rad"}


@pytest.mark.parametrize("payload", ["truth", "nominal", "off_centre"])
def test_dynamics_agree_with_mujoco(payload):
    scenario = load_scenario("seven_joint")
    ours = make_nominal_plant(scenario) if payload == "nominal" else make_true_plant(scenario)
    target = OFF_CENTRE if payload == "off_centre" else getattr(scenario.payload, payload)
    if payload == "off_centre":
        set_payload(ours.plant, ours.context, body=scenario.payload.body, properties=target)
    model = mujoco.MjModel.from_xml_string(mjcf(target))
    data = mujoco.MjData(model)
    # position first, as the oracle has it; v: both ways
    swap_q, swap_v = np.r_[4:7, 0:4, 7:14], np.r_[3:6, 0:3, 6:13]
    for q, v, force in random_states(20):
        state = q[swap_q]
        data.qpos[:] = state
        data.qvel[:] = oracle.rates_to_qvel(state, v[swap_v])
        data.qfrc_applied[:] = oracle.rates_to_qvel(state, force[swap_v])
        mujoco.mj_forward(model, data)
        product, columns = np.zeros(13), []
        for unit in np.eye(13):
            mujoco.mj_mulM(model, data, product, oracle.rates_to_qvel(state, unit))
            columns.append(oracle.qvel_to_rates(state, product))
        theirs = np.array(columns).T[np.ix_(swap_v, swap_v)]
        mass_matrix, bias = ours.calc_mass_matrix(q), ours.calc_bias(q, v)
        assert np.linalg.eigvalsh(mass_matrix).min() > 1e-4
        assert_allclose(mass_matrix, theirs, rtol=0, atol=1e-9 * np.abs(theirs).max())
        their_bias = oracle.qvel_to_rates(state, data.qfrc_bias)[swap_v]
        assert_allclose(bias, their_bias, rtol=0, atol=1e-9 * np.abs(their_bias).max())
        acceleration = np.linalg.solve(mass_matrix, force - bias)
        their_acceleration = oracle.qvel_to_rates(state, data.qacc)[swap_v]
        assert_allclose(
            acceleration, their_acceleration, rtol=0, atol=1e-8 * np.abs(their_acceleration).max()
        )


@pytest.mark.parametrize("controller", PAPER_LAWS)
def test_sampled_loop_is_stable(controller):
    scenario = load_scenario("seven_joint", [f"controller={controller}"])
    assert ffsm_drake.stability(scenario).verdict == "stable for small errors"


@pytest.mark.parametrize(
    ("controller", "seed"), [*((name, 0) for name in PAPER_LAWS), ("tde_aismc", 1)]
)
def test_controllers_converge(run, controller, seed):
    quick = ("reference.duration=10", "duration=10")  # half of what is shipped, which asks for more
    record = run("seven_joint", f"controller={controller}", f"random_seed={seed}", *quick)
    assert record.outcome.completed
    bound = 1e-5 if controller == "tdc" else 1e-6  # TDC has no K_s: its stiffness is K_P alone
    for kind in ("peak_error", "final_error"):
        # What the loop finds in its first samples, before it knows the force, is the largest error
        # of the joints.
        slack = 10.0 if kind == "peak_error" else 1.0
        for group, error in record.metrics[kind].items():
            assert error < slack * bound, (kind, group)
    # The debris did move: folded in from where it was.
    path = record.dataset["end_effector_position"].values
    assert np.linalg.norm(path[-1] - path[0]) > 1.0
    if "reaching_gain" in record.dataset:
        assert float(record.dataset["reaching_gain"].max()) <= 70.0


def body_places(plant: MultibodyPlant, scenario):
    context = plant.CreateDefaultContext()
    for key in ("initial_posture", "target_posture"):
        plant.SetPositions(
            context, configuration(coordinates_of(plant), getattr(scenario, key), key=key)
        )
        for k in range(1, plant.num_bodies()):
            yield plant.get_body(BodyIndex(k)).EvalPoseInWorld(context).translation()


def test_clearances_are_those_of_the_documentation():
    """Bodies as drawn keep apart; cubes of the base's and the debris's inertias would overlap."""
    scenario = load_scenario("seven_joint")
    builder = DiagramBuilder()
    plant = add_combined_plant(builder, scenario.model)
    scene_graph = builder.GetSubsystemByName("scene_graph")
    inspector, source = scene_graph.model_inspector(), plant.get_source_id()
    drawn, cube = {}, {}
    for name, size in (("base", 2.0), ("debris", 1.0)):
        frame = plant.GetBodyFrameIdOrThrow(plant.GetBodyByName(name).index())
        drawn[name] = inspector.GetGeometries(frame, Role.kIllustration)
        for geometry in drawn[name]:
            scene_graph.AssignRole(source, geometry, ProximityProperties())
        instance = GeometryInstance(RigidTransform(), Box(size, size, size), f"cube of {name}")
        instance.set_proximity_properties(ProximityProperties())
        cube[name] = scene_graph.RegisterGeometry(source, frame, instance)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    motion = make_motion(make_mission(scenario))

    def query(time):
        plant.SetPositions(plant.GetMyMutableContextFromRoot(context), motion.evaluate(time)[0])
        return scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))

    def between_cubes(time):
        return (
            query(time)
            .ComputeSignedDistancePairClosestPoints(cube["base"], cube["debris"])
            .distance
        )

    assert between_cubes(14.7) > 0.0 > between_cubes(14.9)
    assert between_cubes(20.0) == pytest.approx(-0.41, abs=5e-3)
    at_end = query(20.0)
    distances = [
        at_end.ComputeSignedDistancePairClosestPoints(a, b).distance
        for a in drawn["base"]
        for b in drawn["debris"]
    ]
    assert min(distances) == pytest.approx(0.2525, abs=1e-4)
    upper, lower = (plant.GetFrameByName(name) for name in ("upper_boom", "lower_boom"))
    elbow = plant.CalcRelativeTransform(plant.GetMyContextFromRoot(context), upper, lower)
    # along the axis that the booms fold about
    assert abs(elbow.translation()[1]) == pytest.approx(0.119, abs=5e-4)
    assert elbow.rotation().col(1) == pytest.approx([0, 1, 0], abs=1e-12)


@pytest.mark.parametrize("name", ["seven_joint", "postcapture"])
def test_camera_looks_at_the_middle_of_the_spacecraft_and_sees_all_of_it(name):
    scenario = load_scenario(name)
    builder = DiagramBuilder()
    plant = add_combined_plant(builder, scenario.model)
    stage = pytest.importorskip("ffsm_drake.plugins.meshcat.stage")
    camera, center = stage.camera_pose(
        plant, Mission(scenario), builder.GetSubsystemByName("scene_graph").model_inspector()
    )
    ahead = (center - camera) / np.linalg.norm(center - camera)
    places = np.array(list(body_places(plant, scenario)))
    angles = [
        np.degrees(np.arccos((place - camera) @ ahead / np.linalg.norm(place - camera)))
        for place in places
    ]
    assert np.linalg.norm(places - camera, axis=1).min() > 2.0  # m: nothing fills the picture
    assert max(angles) < 37.5  # as far up and down as Meshcat shows
    assert (places.min(axis=0) <= center + 1e-9).all()
    assert (center <= places.max(axis=0) + 1e-9).all()
