"""The path of a frame: where it starts and ends, and that rates belong to positions."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.math import RollPitchYaw
from scipy.spatial.transform import Rotation

from ffsm_drake import ModelError, ScenarioError, load_scenario
from ffsm_drake.mission import make_mission
from ffsm_drake.spacecraft.craft import make_nominal_plant
from ffsm_drake.spacecraft.plant import configuration, find_frame
from ffsm_drake.systems.grasping import GRASPINGS
from ffsm_drake.systems.reference import make_motion

CAPTURE = [
    "capture.rate=[0.05, 0.04, 0.06]",
    "capture.servicer=track_all",
    "reference.base_rotation=eigenaxis",
]


def path_of(*overrides, scenario="flight_sensors"):
    loaded = load_scenario(scenario, overrides)
    model = make_nominal_plant(loaded)
    return make_motion(make_mission(loaded)).path, loaded, model


def attitude(rows):
    return Rotation.from_quat(rows[..., :4], scalar_first=True)


def assert_consistent(path, times, *, h=1e-4):
    """Velocities are those of the poses, accelerations those of the velocities."""
    before, now, after = (path.rows(times + step) for step in (-h, 0.0, h))
    assert_allclose(
        (attitude(after) * attitude(before).inv()).as_rotvec() / (2 * h), now[:, 7:10], atol=1e-8
    )
    assert_allclose((after[:, 4:7] - before[:, 4:7]) / (2 * h), now[:, 10:13], atol=1e-8)
    assert_allclose((after[:, 7:13] - before[:, 7:13]) / (2 * h), now[:, 13:], atol=1e-8)


@pytest.mark.parametrize("shaper", ["null", "{frequencies: [0.4]}"])
def test_from_rest_along_a_line_and_about_the_eigenaxis_to_the_goal(shaper):
    goal = (
        "reference.frame={frame: 'debris::debris', position: [2, 0.3, -0.4], rpy: [0.3, -0.2, 0.9]}"
    )
    path, scenario, model = path_of(goal, f"reference.shaper={shaper}")
    q = configuration(model.coordinates, scenario.initial_posture, key="initial_posture")
    model.plant.SetPositions(model.context, q)
    pose = find_frame(model.plant, "debris::debris", key="").CalcPoseInWorld(model.context)
    first, middle, last, held = path.rows(np.array([0.0, 7.3, path.end, path.end + 5.0]))
    assert_allclose(first[4:7], pose.translation(), atol=1e-15)
    assert_allclose(attitude(first).as_matrix(), pose.rotation().matrix(), atol=1e-14)
    assert_allclose(last[4:7], [2, 0.3, -0.4], atol=1e-14)
    assert_allclose(
        attitude(last).as_matrix(),
        RollPitchYaw(0.3, -0.2, 0.9).ToRotationMatrix().matrix(),
        atol=1e-14,
    )
    assert_allclose(held, last, atol=1e-15)
    assert not last[7:].any()
    for part in (slice(4, 7), slice(10, 13), slice(16, 19)):  # all on one line
        assert_allclose(
            np.cross(
                middle[part] - (first[part] if part.start == 4 else 0), last[4:7] - first[4:7]
            ),
            0,
            atol=1e-14,
        )
    axis = (attitude(last) * attitude(first).inv()).as_rotvec()
    assert_allclose(np.cross(middle[7:10], axis), 0, atol=1e-14)
    assert_consistent(path, np.array([1.3, 7.3, 15.0]))


@pytest.mark.smoke
def test_where_nothing_is_asked_it_stays():
    path, _, _ = path_of("reference.frame={}")
    assert_allclose(
        path.rows(np.array([0.0, 9.0])),
        np.tile(np.r_[path.first, path.start[3:], np.zeros(12)], (2, 1)),
        atol=1e-15,
    )


@pytest.mark.parametrize("goal", ["target_posture", "stop"])
def test_after_a_capture_it_starts_as_the_grasp_leaves_the_frame(goal):
    path, scenario, model = path_of(*CAPTURE, f"reference.goal={goal}", "reference.frame={}")
    q = configuration(model.coordinates, scenario.initial_posture, key="initial_posture")
    jacobian = model.calc_jacobian(q, scenario.model.end_effector)
    rows = path.rows(np.array([0.0, path.end]))
    contact = GRASPINGS.only("capture").contact(make_mission(scenario), model)
    assert_allclose(rows[0, 7:13], jacobian @ contact.grasp.velocity, atol=1e-15)
    assert np.abs(rows[0, 7:13]).min() > 1e-4
    assert not rows[1, 7:].any()
    moved = (attitude(rows[1]) * attitude(rows[0]).inv()).magnitude()
    assert moved > 0.1 if goal == "stop" else moved < 1e-14
    assert_consistent(path, np.array([0.2, 7.3, 15.0]))


@pytest.mark.parametrize(
    ("frame", "key"),
    [
        ("{task: line}", "reference.frame.task"),
        ("{position: [1, 2]}", "reference.frame.position"),
        ("{task: attitude, position: [1, 2, 3]}", "reference.frame.position"),
        ("{hold: [base_rotation]}", "reference.frame.hold"),
        ("{damping: 0}", "reference.frame.damping"),
        ("{feedback: 1e3}", "reference.frame.feedback"),
        ("{priority: both}", "reference.frame.priority"),
        ("{joints: no}", "reference.frame.joints"),
    ],
)
def test_a_goal_that_makes_no_sense_is_named(frame, key):
    with pytest.raises(ScenarioError, match=key):
        load_scenario("postcapture", [f"reference.frame={frame}"])


def test_what_a_frame_does_not_go_with_is_named():
    with pytest.raises(ModelError, match=r"reference.frame.frame: no frame 'servicer::hand'"):
        path_of("reference.frame={frame: 'servicer::hand'}")
    with pytest.raises(ScenarioError, match=r"reference.frame.position: .*goal: stop"):
        load_scenario(
            "postcapture", ["reference.frame={position: [1, 2, 3]}", "reference.goal=stop"]
        )
