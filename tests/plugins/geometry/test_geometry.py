"""The true geometry of the arm, against products of exponentials and changed model files."""

import os
import shutil
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from c_code import needs_llvm
from compared_runs import check, of_seeds
from entry_points import needs
from near_captures import SHORT
from refusals import assert_refused
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from ffsm_drake import load_scenario, make_nominal_plant, make_true_plant, simulate
from ffsm_drake.plugins.equations import comparison, frames
from ffsm_drake.plugins.equations.tree import Reader
from ffsm_drake.spacecraft.plant import models_dir

URDFS = {"postcapture": "servicer.urdf", "seven_joint": "ssrms_servicer.urdf"}
STRETCH, OFFSET = 0.02, 0.05


def pose(rotation, place):
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = rotation, place
    return made


def origin(given):
    xyz, rpy = ([float(x) for x in given.get(k, "0 0 0").split()] for k in ("xyz", "rpy"))
    return pose(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)


def chain_of(name):
    """The joints of a URDF from its base to the hand: (name, fixed transform, axis), the hand last
    with no axis.
    """
    root = ET.parse(models_dir() / "urdf" / URDFS[name]).getroot()
    above = {joint.find("child").get("link"): joint for joint in root.iter("joint")}
    (hand,) = (each for each in root.iter("frame") if each.get("name") == "end_effector")
    link, joints = hand.get("link"), []
    while link in above:
        joints.insert(0, above[link])
        link = above[link].find("parent").get("link")
    fixed, made = np.eye(4), []
    for joint in joints:
        found = joint.find("origin")
        fixed = fixed @ origin({} if found is None else found.attrib)
        if joint.get("type") == "fixed":
            continue
        axis = [float(x) for x in joint.find("axis").get("xyz").split()]
        made.append((joint.get("name"), fixed, np.array(axis)))
        fixed = np.eye(4)
    return [*made, ("hand", fixed @ origin(hand.attrib), None)]


def drawn(name, seed):
    """Errors by name, from a class: all kinds at once."""
    draw, joints = np.random.default_rng(seed), [each for each, _, _ in chain_of(name)[:-1]]
    return {
        "stretch": dict(zip(joints, draw.uniform(-STRETCH, STRETCH, len(joints)), strict=True)),
        "hand_stretch": draw.uniform(-STRETCH, STRETCH),
        "joint_offset": dict(zip(joints, draw.uniform(-OFFSET, OFFSET, len(joints)), strict=True)),
        "mount_position": draw.uniform(-0.02, 0.02, 3).tolist(),
        "mount_rotation": draw.uniform(-OFFSET, OFFSET, 3).tolist(),
    }


def by_exponentials(name, q, errors, warm=0.0):
    """The hand's pose (4, 4) by a product of exponentials of screws in the base frame."""
    home, product = np.eye(4), np.eye(4)
    for at, (joint, fixed, axis) in enumerate(chain_of(name)):
        is_hand = axis is None
        stretch = errors["hand_stretch"] if is_hand else errors["stretch"][joint]
        rotation, place = fixed[:3, :3], (1.0 + stretch + warm) * fixed[:3, 3]
        if at == 0:
            rotation = Rotation.from_rotvec(errors["mount_rotation"]).as_matrix() @ rotation
            place = place + errors["mount_position"]
        home = home @ pose(rotation, place)
        if is_hand:
            continue
        w = home[:3, :3] @ axis
        twist = np.zeros((4, 4))
        twist[:3, :3] = np.cross(np.eye(3), w)
        twist[:3, 3] = -np.cross(w, home[:3, 3])
        product = product @ expm(twist * (q[7 + at] + errors["joint_offset"][joint]))
    base = pose(Rotation.from_quat(q[:4], scalar_first=True).as_matrix(), q[4:7])
    return base @ product @ home


def exact(name):
    joints = [each for each, _, _ in chain_of(name)[:-1]]
    zero = dict.fromkeys(joints, 0.0)
    return {"stretch": zero, "hand_stretch": 0.0, "joint_offset": zero,
            "mount_position": np.zeros(3), "mount_rotation": np.zeros(3)}  # fmt: skip


def configuration(draw, count):
    turn = Rotation.random(random_state=int(draw.integers(2**31))).as_quat(scalar_first=True)
    return np.concatenate([turn, draw.uniform(-1, 1, 3), draw.uniform(-2, 2, count)])


@pytest.mark.smoke
@pytest.mark.parametrize("name", URDFS)
@pytest.mark.parametrize("seed", range(int(os.environ.get("GEOMETRY_DRAWS", "3"))))
def test_the_hand_is_that_of_a_product_of_exponentials(name, seed):
    errors, thermal = drawn(name, seed), {"mean": 20.0, "amplitude": 50.0, "time": 700.0 * seed}
    given = {**errors, "thermal": thermal}
    scenario = load_scenario(name, [{"effects": {"geometry": given}}])
    true, nominal = make_true_plant(scenario), make_nominal_plant(scenario)
    warm = 2.3e-5 * (20.0 + 50.0 * np.sin(2.0 * np.pi * 700.0 * seed / 5560.0))
    draw = np.random.default_rng(seed)
    for _ in range(4):
        q = configuration(draw, len(true.coordinates.joints))
        for model, own, by in ((true, errors, warm), (nominal, exact(name), 0.0)):
            found = model.calc_frame_pose(q, scenario.model.end_effector)
            expected = by_exponentials(name, q, own, by)
            assert found[4:] == pytest.approx(expected[:3, 3], abs=1e-12)
            rotation = Rotation.from_quat(found[:4], scalar_first=True).as_matrix()
            assert rotation == pytest.approx(expected[:3, :3], abs=1e-12)
    hands = [each.calc_frame_pose(q, "servicer::end_effector")[4:] for each in (true, nominal)]
    assert np.linalg.norm(hands[0] - hands[1]) > 1e-3


def test_the_dynamics_are_those_of_a_changed_model_file(tmp_path):
    """Longer links by the option, or by the origins in the URDF: the same H and C."""
    folder = tmp_path / "models"
    shutil.copytree(models_dir(), folder)
    path = folder / "urdf" / "servicer.urdf"
    tree, stretch = ET.parse(path), {"joint_2": 0.03, "joint_3": -0.05, "joint_5": 0.1}
    for joint in tree.getroot().iter("joint"):
        if (by := stretch.get(joint.get("name"))) is not None:
            place = [float(x) * (1.0 + by) for x in joint.find("origin").get("xyz").split()]
            joint.find("origin").set("xyz", " ".join(map(repr, place)))
    tree.write(path)
    own = {"servicer": str(path), "directives": None,
           "debris": str(folder / "urdf" / "debris.urdf")}  # fmt: skip
    changed = make_true_plant(load_scenario("postcapture", [{"model": own}]))
    kept = {**own, "servicer": str(models_dir() / "urdf" / "servicer.urdf")}
    option = {"effects": {"geometry": {"stretch": stretch}}}
    true = make_true_plant(load_scenario("postcapture", [{"model": kept}, option]))
    draw = np.random.default_rng(0)
    for _ in range(3):
        q, v = configuration(draw, 5), draw.normal(size=11)
        mass = changed.calc_mass_matrix(q)
        assert true.calc_mass_matrix(q) == pytest.approx(mass, rel=1e-12, abs=1e-9)
        assert true.calc_bias(q, v) == pytest.approx(changed.calc_bias(q, v), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("name", URDFS)
def test_displaced_frames_are_parameters_of_the_equations(name):
    """Equations and frames on numbers, with all frames of the arm displaced, against Drake."""
    models = [
        make_true_plant(load_scenario(name, [{"effects": {"geometry": drawn(name, seed)}}]))
        for seed in range(2)
    ]
    plain = Reader(models[0].plant)
    assert plain.displaced_in(make_nominal_plant(load_scenario(name)).context) == ()
    readers = [Reader(each.plant, plain.displaced_in(each.context)) for each in models]
    trees = {reader.tree for reader in readers}
    assert len(trees) == 1  # the same code for both
    (tree,) = trees
    assert {link.frame for link in tree.links} < {*tree.displaced}
    assert max(comparison.differences(models[0].plant, tree.displaced).values()) < 1e-12
    draw = np.random.default_rng(1)
    for model, reader in zip(models, readers, strict=True):
        q, own = configuration(draw, len(tree.links)), reader.parameters(model.context)
        hand = model.plant.GetFrameByName("end_effector")
        place = tree.place_in(reader.place_of(hand), own)
        rotation, origin = frames.pose(tree.placed(own), place, q)
        expected = model.calc_frame_pose(q, hand)
        found = [*frames.quaternion_of(rotation), *origin]
        assert found == pytest.approx(expected, abs=1e-13)
        v, given = draw.normal(size=tree.num_velocities), (tree.placed(own), place, q)
        twist = model.calc_frame_twist(q, v, hand)
        assert frames.twist(*given, v) == pytest.approx(twist, abs=1e-12)


DRAWN = (
    "effects.geometry={stretch_deviation: 1e-3, offset_deviation: 2e-3, hand_stretch: 1e-3, "
    "mount_position_deviation: 1e-3, mount_rotation_deviation: 1e-3, thermal: {time: 1390}}"
)
COMPILED = {
    "held": ("postcapture", ["duration=0.3", "controller=tdc"]),
    "orbit": ("postcapture", ["duration=0.3", "environment={}"]),
    "panels": ("flexible_panels", ["duration=0.3"]),
    "seven joints": ("seven_joint", ["duration=0.3"]),
    "capture": ("tumbling_capture", ["duration=5.5", *SHORT]),
    "closing": ("tumbling_capture", ["duration=5.5", *SHORT, "capture.closing={}"]),
}


@needs("compiled")
@needs_llvm
@pytest.mark.long
@pytest.mark.parametrize(("name", "given"), COMPILED.values(), ids=COMPILED.keys())
def test_compiled_runs_are_those_of_drake(name, given):
    """Of cases with errors of their own, which share their code."""
    found = check(of_seeds(name, [*given, DRAWN], [[]] * 3))
    errors = [record.metrics["geometry"]["hand_position_error"] for record in found]
    assert np.ptp(errors) > 1e-4


@pytest.mark.slow
def test_a_gripper_meets_the_target_with_the_error_of_the_arm():
    """The target is where the nominal hand would meet it: the miss is the error of the hand, but
    for the tracking error.
    """
    exact, displaced = (
        simulate(
            load_scenario("tumbling_capture", ["duration=2.2", *SHORT, *own]),
            check_stability=False,
        )
        for own in ([], [DRAWN])
    )
    at_grasp = int(np.searchsorted(displaced.dataset["time"].values, displaced.grasp["time"]))
    for miss, of in (("position", "hand_position_error"), ("angle", "hand_rotation_error")):
        error = np.linalg.norm(displaced.dataset[of].values[at_grasp])
        assert error > 1e-3
        allowed = exact.grasp["miss"][miss] + 1e-4
        assert displaced.grasp["miss"][miss] == pytest.approx(error, abs=allowed)


def test_a_large_error_misses_the_target():
    given = ["duration=2.2", *SHORT, "effects.geometry.joint_offset={joint_1: 0.2}"]
    record = simulate(load_scenario("tumbling_capture", given), check_stability=False)
    assert record.outcome.status == "missed"


GIVEN = "effects.geometry={stretch_deviation: 1e-3, offset_deviation: 2e-3, hand_stretch: 1e-3}"


def test_a_run_records_the_error_of_the_hand():
    scenario = load_scenario("postcapture", ["duration=0.2", "controller=tdc", GIVEN])
    record = simulate(scenario, check_stability=False)
    data, true = record.dataset, make_true_plant(scenario)
    nominal, q = make_nominal_plant(scenario), data["position"].values
    at_end = [each.calc_frame_pose(q[-1], "servicer::end_effector") for each in (true, nominal)]
    error = data["hand_position_error"].values
    assert error[-1] == pytest.approx(at_end[0][4:] - at_end[1][4:], abs=1e-12)
    largest = record.metrics["geometry"]["hand_position_error"]
    assert largest == pytest.approx(np.linalg.norm(error, axis=1).max())
    assert largest > 1e-3


def test_errors_are_drawn_with_the_seed():
    """Two seeds differ, a seed of its own does not; the spread is that of the setting."""

    def hands(**given):
        settings = {"offset_deviation": 2e-3, **given}
        q, found = np.array([1.0, *np.zeros(11)]), []
        for seed in range(12):
            scenario = load_scenario(
                "postcapture", [f"random_seed={seed}", {"effects": {"geometry": settings}}]
            )
            found.append(make_true_plant(scenario).calc_frame_pose(q, "servicer::end_effector"))
        return np.array(found)

    spread = hands()
    assert np.ptp(spread[:, 1:4], axis=0).max() > 1e-3
    assert not np.ptp(hands(seed=4), axis=0).any()


REFUSED = {
    ("postcapture", "{stretch: {joint_9: 0.1}}"): "effects.geometry.stretch.joint_9",
    ("postcapture", "{stretch: 2}"): "effects.geometry.stretch.all: must be > -1, below 1, not 2",
    ("postcapture", "{mount_position: [1, 2]}"): "effects.geometry.mount_position: must hold 3",
    ("postcapture", "{length: 1}"): "effects.geometry.length: unknown key",
    ("postcapture", "{thermal: {period: 0}}"): "effects.geometry.thermal.period: must be > 0 s",
    ("two_arms", "{}"): "effects.geometry: needs a single hand; remove contacts",
}


@pytest.mark.parametrize(("given", "problem"), REFUSED.items())
def test_a_bad_geometry_is_refused(given, problem):
    name, settings = given
    assert_refused(problem, name, f"effects.geometry={settings}")
