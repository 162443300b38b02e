"""Clearance: known distances, what is left out, and shapes that agree with the pictures."""

import dataclasses
import itertools
import os

import numpy as np
import pytest
from pydrake.geometry import Box, Cylinder, Ellipsoid, Role, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import DiagramBuilder

from ffsm_drake import load_scenario
from ffsm_drake.mission import Mission
from ffsm_drake.scenario import Model
from ffsm_drake.spacecraft.clearance import ApproachClearance, Clearance, shapes_of
from ffsm_drake.spacecraft.plant import (
    add_combined_plant,
    configuration,
    coordinates_of,
    models_dir,
)
from ffsm_drake.systems.reference import make_motion

DRAWS = int(os.environ.get("FFSM_DRAWS", "8"))
BEYOND = 0.012  # m; by which a picture may stand out of its shape


@pytest.fixture(scope="module")
def planar():
    return Clearance(load_scenario("planar_detumble").model)


def names(clearance):
    return {frozenset((first.name(), second.name())) for first, second in clearance.pairs}


def test_neighbours_and_what_is_grasped_are_left_out(planar):
    assert frozenset(("hand", "target")) not in names(planar)  # welded
    assert frozenset(("link_1", "link_2")) not in names(planar)  # a joint connects them
    assert {
        frozenset(pair) for pair in (("base", "target"), ("link_1", "hand"), ("base", "link_2"))
    } <= names(planar)


@pytest.mark.smoke
def test_distance_of_a_stretched_arm(planar):
    """The hand starts 0.7 + 0.3 - 0.01 m from the second joint; the tube of the second link ends
    after 0.7 m.
    """
    nearest = planar.nearest(np.r_[1.0, np.zeros(9)])
    assert {nearest.first, nearest.second} == {"hand", "link_2"}
    assert nearest.distance == pytest.approx(0.7 + 0.3 - 0.01 - 0.7, abs=1e-3)


@pytest.mark.parametrize("name", ["planar_detumble", "postcapture"])
def test_what_is_farther_than_asked_for_is_not_measured(name):
    clearance = Clearance(load_scenario(name).model)
    q = np.r_[1.0, np.zeros(clearance.plant.num_positions() - 1)]
    nearest = clearance.nearest(q)
    assert nearest.distance > 0.0
    assert clearance.nearest(q, below=nearest.distance + 1e-3) == nearest
    assert clearance.nearest(q, below=nearest.distance - 1e-3).distance == np.inf


def test_overlap_is_negative_and_where_it_is(planar):
    folded = configuration(
        coordinates_of(planar.plant), load_scenario("planar_detumble").initial_posture, key=""
    )
    folded[7:] = [2.6, 0.3, 0.0]  # down through the bus
    nearest = planar.nearest(folded)
    assert nearest.distance < 0.0
    assert "base" in (nearest.first, nearest.second)
    motion = np.array([np.r_[1.0, np.zeros(9)], folded, np.full(10, np.nan)])
    assert planar.along(motion).index == 1


BALLS = """<robot name="balls"><link name="base"><inertial><mass value="9"/><inertia ixx="1"
iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial><visual><geometry>{0}</geometry></visual></link>
<link name="rod"/><joint name="a" type="prismatic"><parent link="base"/><child link="rod"/><axis
xyz="1 0 0"/><limit lower="-1e3" upper="1e3" effort="1" velocity="1"/></joint>
<link name="hand"><inertial><mass value="9"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
iyz="0"/></inertial><visual><geometry>{1}</geometry></visual></link><joint name="b"
type="prismatic"><parent link="rod"/><child link="hand"/><axis xyz="1 0 0"/><limit lower="-1e3"
upper="1e3" effort="1" velocity="1"/></joint></robot>"""
POINT = """<robot name="point"><link name="debris"><inertial><mass value="1"/><inertia ixx="1"
iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><frame name="grasp" link="debris"/>
</robot>"""


@pytest.mark.parametrize("kind", ["sphere", "box", "capsule"])
def test_rounding_is_neither_an_overlap_nor_a_gap(kind, tmp_path):
    """Within a micrometre parts touch, and a distance keeps its limit."""
    rng = np.random.default_rng(3)
    (tmp_path / "point.urdf").write_text(POINT)
    for _ in range(DRAWS):
        sizes = rng.uniform(0.02, 2.0, 2)
        shapes = {
            "sphere": [f'<sphere radius="{size!r}"/>' for size in sizes.tolist()],
            "capsule": [f'<capsule radius="{r!r}" length="1"/>' for r in sizes.tolist()],
            "box": [f'<box size="{2.0 * size!r} 1 1"/>' for size in sizes.tolist()],
        }[kind]
        (tmp_path / "balls.urdf").write_text(BALLS.format(*shapes))
        model = Model(
            servicer=str(tmp_path / "balls.urdf"), debris=str(tmp_path / "point.urdf"),
            end_effector="servicer::hand", grasp="debris::grasp",
        )  # fmt: skip
        clearance, far = Clearance(model), rng.uniform(-50.0, 50.0)
        for small in (0.0, *rng.uniform(-5e-7, 5e-7, 5)):
            q = np.r_[1.0, np.zeros(6), far, sizes.sum() + small - far]
            nearest = clearance.nearest(q)
            assert nearest.distance == 0.0
            assert str(nearest) == "base and hand touch"
            assert nearest.keeps(0.0)
            q[-1] += 0.01
            assert clearance.nearest(q).keeps(0.01)
        for large in (2e-6, 10.0 ** rng.uniform(-5.0, -2.0)):
            found = [clearance.nearest(q + np.r_[np.zeros(8), x - 0.01 - small])
                     for x in (large, -large)]  # fmt: skip
            assert [str(each) for each in found] == [
                f"base and hand {found[0].distance:.3g} m apart",
                f"base and hand overlap by {-found[1].distance:.3g} m",
            ]
            assert [each.distance for each in found] == pytest.approx([large, -large], abs=5e-7)
            assert [each.keeps(0.0) for each in found] == [True, False]
            assert not found[0].keeps(large + 2e-6)


def points_on(shape):
    """Points of a shape's surface in its own frame."""
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    if isinstance(shape, Box):
        return np.array(list(itertools.product(*[(-s / 2, s / 2) for s in shape.size()])))
    if isinstance(shape, Cylinder):
        ring = shape.radius() * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        return np.vstack(
            [np.c_[ring, np.full(24, z)] for z in (-shape.length() / 2, shape.length() / 2)]
        )
    axes = (
        np.array([shape.radius()] * 3)
        if isinstance(shape, Sphere)
        else np.array([shape.a(), shape.b(), shape.c()])
    )
    assert isinstance(shape, (Sphere, Ellipsoid))
    rings = [
        np.c_[np.sin(u) * np.cos(turn), np.sin(u) * np.sin(turn), 0 * turn + np.cos(u)]
        for u in np.linspace(0, np.pi, 9)
    ]
    return axes * np.vstack(rings)


@pytest.mark.parametrize(
    "scenario",
    ["postcapture", pytest.param("seven_joint", marks=pytest.mark.slow), "planar_detumble"],
)
def test_shapes_hold_the_pictures(scenario):
    """Every point of a picture lies in one of its body's shapes, or within a finger's breadth of
    it.
    """
    builder = DiagramBuilder()
    plant = add_combined_plant(builder, load_scenario(scenario).model)
    diagram = builder.Build()
    whole = diagram.CreateDefaultContext()
    context = plant.GetMyContextFromRoot(whole)
    query = plant.get_geometry_query_input_port().Eval(context)
    inspector = query.inspector()
    for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
        body = plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
        own = set(inspector.GetGeometries(inspector.GetFrameId(geometry), Role.kProximity))
        X_WG = plant.EvalBodyPoseInWorld(context, body) @ inspector.GetPoseInFrame(geometry)
        assert isinstance(X_WG, RigidTransform)
        for point in points_on(inspector.GetShape(geometry)):
            found = query.ComputeSignedDistanceToPoint(X_WG @ point)
            nearest = min(item.distance for item in found if item.id_G in own)
            assert nearest < BEYOND, f"{body.name()}: {inspector.GetName(geometry)} {point}"


@pytest.mark.parametrize(("scenario", "distance"), [("postcapture", 0.074), ("seven_joint", 0.208)])
def test_the_shipped_targets_fold_in_without_touching(scenario, distance):
    loaded = load_scenario(scenario)
    clearance = Clearance(loaded.model)
    nearest = clearance.nearest(
        configuration(coordinates_of(clearance.plant), loaded.target_posture, key="")
    )
    assert {nearest.first, nearest.second} == {"base", "debris"}
    assert nearest.distance == pytest.approx(distance, abs=2e-3)


def test_a_target_apart_is_measured_where_it_is():
    """Held where the gripper holds it, its distances are those of the stack; elsewhere the gripper
    counts, too.
    """
    scenario = load_scenario("tumbling_capture")
    held, apart = Clearance(scenario.model), ApproachClearance(scenario.model, "debris::debris")
    q = configuration(coordinates_of(held.plant), scenario.initial_posture, key="")
    held.plant.SetPositions(held.plant_context, q)
    X_WP = held.plant.GetBodyByName("debris").EvalPoseInWorld(held.plant_context)

    def pose(shift):
        return np.r_[q, X_WP.rotation().ToQuaternion().wxyz(), X_WP @ np.array(shift)]

    # without link_4, which no motion of the wrist takes from the target, 5 cm away
    assert apart.nearest(pose([0.0, 0.0, 0.0])) == held.nearest(q)
    away = apart.nearest(pose([0.0, 0.0, 0.2]))
    assert {away.first, away.second} == {"debris", "link_5"}
    # at the grasp the fingers reach 45 mm around the ring
    assert away.distance == pytest.approx(0.2 - 0.045, abs=0.01)
    assert apart.nearest(pose([0.0, 0.0, -0.15])).distance < -0.05


def test_a_target_turned_about_the_gripper_meets_it():
    """The gripper may touch the target where it holds it, but not run through it askew."""
    scenario = load_scenario("tumbling_capture")
    held, apart = Clearance(scenario.model), ApproachClearance(scenario.model, "debris::debris")
    q = configuration(coordinates_of(held.plant), scenario.initial_posture, key="")
    held.plant.SetPositions(held.plant_context, q)
    X_WP = held.plant.GetBodyByName("debris").EvalPoseInWorld(held.plant_context)
    X_WE = held.plant.GetFrameByName("end_effector").CalcPoseInWorld(held.plant_context)
    for angle, meets in ((0.1, False), (1.2, True)):
        turn = RigidTransform(RollPitchYaw(angle, 0.0, 0.0), [0.0, 0.0, 0.0])
        X = X_WE @ turn @ X_WE.inverse() @ X_WP
        pose = np.r_[q, X.rotation().ToQuaternion().wxyz(), X.translation()]
        assert (apart.nearest(pose).distance < 0.0) == meets


def test_what_is_fixed_to_a_target_moves_with_it(tmp_path):
    text = (models_dir() / "urdf" / "debris.urdf").read_text("utf-8")
    nozzle = (
        '<link name="nozzle"><collision><geometry><sphere radius="0.1"/></geometry></collision>'
        '</link><joint name="fixed" type="fixed"><parent link="debris"/><child link="nozzle"/>'
        '<origin xyz="0 0 0.4"/></joint></robot>'
    )
    (tmp_path / "debris.urdf").write_text(text.replace("</robot>", nozzle))
    model = dataclasses.replace(
        load_scenario("tumbling_capture").model,
        directives=None,
        servicer="package://ffsm_drake/urdf/servicer.urdf",
        debris=str(tmp_path / "debris.urdf"),
    )
    apart = ApproachClearance(model, "debris::debris")
    plant, context = apart.plant, apart.plant_context
    assert len(plant.GetFloatingBaseBodies()) == 2
    X_PN = plant.GetFrameByName("nozzle").CalcPose(context, plant.GetFrameByName("debris"))
    np.testing.assert_allclose(X_PN.translation(), [0.0, 0.0, 0.4])


def test_a_flexible_panel_counts_where_it_is_deflected():
    """A panel upright beside the arm: swung to the arm it meets it, swung away it leaves it; the
    body that carries it does not count.
    """
    panel = {"position": [0, 0.9, 1.0], "direction": [0, 0, 1], "axis": [1, 0, 0]}
    flexible = {"mast": {**panel, "mass": 4.0, "frequency": 0.5, "length": 2.0, "plates": 2}}
    scenario = load_scenario("postcapture", [{"model": {"flexible": flexible}}])
    clearance = Clearance(scenario.model, flexible=True)
    rigid = Clearance(scenario.model)
    pairs = {pair for pair in names(clearance) if pair & {"mast_1", "mast_2"}}
    assert pairs == names(clearance) - names(rigid)
    assert all("base" not in pair and pair != {"mast_1", "mast_2"} for pair in pairs)
    q = np.r_[1.0, np.zeros(11)]  # the arm straight up
    distance = {
        angle: clearance.nearest(np.r_[q, angle, 0.0]) for angle in (-0.5, -0.2, 0.0, 0.2, 0.5)
    }
    towards = min(distance, key=lambda angle: distance[angle].distance)
    assert distance[towards].distance < 0.0
    assert {distance[towards].first, distance[towards].second} & {"mast_1", "mast_2"}
    assert distance[-towards].distance > distance[towards].distance + 0.1
    assert clearance.nearest(q) == clearance.nearest(np.r_[q, 0.0, 0.0])  # at rest by default


@pytest.mark.parametrize("name", ["two_arms", "two_arms_capture", "two_arms_detumble"])
def test_a_target_in_two_hands_is_measured_against_both_arms(name):
    """Against all but the hands and the wrists near them, alike. The motions keep clear."""
    scenario = load_scenario(name)
    shapes, motion = shapes_of(scenario), make_motion(Mission(scenario))
    of_target = {
        (first if second.name() == "debris" else second).name()
        for first, second in shapes.pairs
        if "debris" in (first.name(), second.name())
    }
    arms = {f"{side}_link_{k}" for side in ("left", "right") for k in range(1, 5)}
    assert of_target == {"base", *arms}
    times = np.linspace(scenario.grasp_time, motion.end, 60)
    nearest = shapes.along(np.array([motion.evaluate(time)[0] for time in times])).nearest
    assert nearest.distance > max(scenario.clearance, 0.01)
