"""A frame along its path by the generalized Jacobian: followed, damped near singularities, the base
left alone.
"""

import numpy as np
import pytest
from consistent_motions import assert_consistent, parts_of
from numpy.testing import assert_allclose

from ffsm_drake import load_scenario, simulate
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.capture.contact import planned_contact
from ffsm_drake.plugins.design.remarks import plan_remarks
from ffsm_drake.plugins.task_space.following import resolved_motion
from ffsm_drake.plugins.task_space.resolved_motion import damped_inverse
from ffsm_drake.spacecraft.coordinates import position_errors
from ffsm_drake.spacecraft.craft import make_nominal_plant
from ffsm_drake.spacecraft.free_floating import free_floating
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_motion


class ShiftedMotion(PlannedMotion):
    """A motion with its last joint moved."""

    def __init__(self, motion, moved):
        self._motion, self._moved = motion, moved
        super().__init__(coordinates=motion.coordinates, sample_time=0.01, end=motion.end)

    def rows(self, times):
        rows = self._motion.rows(times)
        rows[:, self.coordinates.num_positions - 1] += self._moved
        return rows


ARM_ALONE = ["actuation.driven=[joints]"]
PLANAR = ["reference={kind: quintic, goal: target_posture, plan: null, duration: 20}"]
BERTH = "reference.frame={position: [0.4, 0, 2.3], rpy: [0, 1.0, 0]}"
BEYOND = "reference.frame={position: [-0.4, 0, 2.3], rpy: [0, 1.3, 0]}"
AT_ORIGIN = ["initial_posture.base_position=[0, 0, 0]", "initial_posture.base_rpy=[0, 0, 0]"]


def motion_of(name, *overrides):
    scenario = load_scenario(name, overrides)
    model = make_nominal_plant(scenario)
    return make_motion(make_mission(scenario)), model, scenario


@pytest.mark.smoke
def test_the_damped_inverse_is_smooth_and_bounded():
    damping, step = 0.05, 1e-7
    assert_allclose(
        damped_inverse(np.array([0.05, 0.2, 3.0]), damping), [20.0, 5.0, 1 / 3], rtol=1e-15
    )
    sizes = np.linspace(0.0, 0.2, 4001)
    assert_allclose(damped_inverse(sizes, damping).max(), np.sqrt(32 / 27) / damping, rtol=1e-6)
    slopes = [
        np.diff(damped_inverse(damping + step * np.array(sides), damping))[0]
        for sides in ((-1, 0), (0, 1))
    ]
    assert_allclose(slopes[0], slopes[1], rtol=1e-4)
    # Damped least squares: s / (s^2 + lambda^2).
    s = 0.02
    damped = (damping**2 - s**2) ** 2 / (2 * damping**2 - s**2)
    assert_allclose(damped_inverse(np.array([s]), damping), s / (s**2 + damped), rtol=1e-14)


@pytest.mark.slow
def test_the_arm_alone_takes_the_frame_along_its_path():
    motion, model, _ = motion_of("planar_detumble", *PLANAR, *ARM_ALONE, BERTH)
    found = motion.resolution()
    assert max(found.attitude_miss.max(), found.position_miss.max()) < 1e-9
    assert found.base_turn.max() > 0.5  # rad: nothing holds it
    times = np.array([1.0, 8.7, 16.0, 20.0, 25.0])
    q, v, a = parts_of(motion, times)
    assert np.abs(free_floating(model, q).momentum(v)).max() < 1e-13
    assert np.abs(model.calc_inverse_dynamics(q, v, a)[:, :6]).max() < 1e-12
    assert_consistent(motion, times[:3], h=1e-3, atol=1e-7)
    assert max(np.abs(v[3:]).max(), np.abs(a[3:]).max()) < 1e-7  # at rest
    assert motion.remarks() == []


def test_given_steps_have_errors_that_are_smooth_in_the_motion():
    """A small change of the motion changes them little, although they are 100 times larger."""
    overrides = [*PLANAR, "reference.duration=4", *ARM_ALONE, BERTH]
    mission = make_mission(load_scenario("planar_detumble", overrides))
    motion, model = make_motion(mission), mission.craft.nominal()
    times, change = np.linspace(0.0, 4.0, 11), 1e-9

    def ends(step, moved=0.0):
        changed = ShiftedMotion(motion, moved)
        return resolved_motion(changed, mission, model, step=step).evaluate(times)[0]

    exact, coarse, fine = ends(0.05), ends(0.8), ends(0.4)
    errors = [np.abs(each - exact).max() for each in (coarse, fine)]
    assert 0.0 < errors[1] < errors[0] / 2**6
    moved, wanted = ends(0.8, change) - coarse, ends(0.05, change) - exact
    assert errors[0] > 100 * change
    assert_allclose(moved, wanted, atol=1e-2 * change)


@pytest.mark.slow
def test_out_of_reach_it_is_damped_and_says_so():
    motion, _, scenario = motion_of("planar_detumble", *PLANAR, *ARM_ALONE, BEYOND)
    found, damping = motion.resolution(), scenario.reference.frame.damping
    fastest = np.linalg.norm(motion._path.rows(found.times)[:, 7:13], axis=1)
    assert (found.joint_rate <= 1.09 / damping * (fastest + fastest.max())).all()
    assert found.smallest.min() < damping < found.smallest[0]
    assert 0.1 < found.position_miss[-1] < 0.2
    (line,) = [line for line in plan_remarks(scenario) if line.startswith("reference.frame")]
    assert "misses its path by up to 0.15 m" in line
    assert "near a dynamic singularity" in line
    assert "\n" not in line


@pytest.mark.parametrize(
    ("hold", "least", "most"),
    [("[base_rotation]", 0.0, 1e-12), pytest.param("[]", 0.45, 0.47, marks=pytest.mark.slow)],
)
def test_the_base_is_left_alone(hold, least, most):
    motion, _, _ = motion_of("reaction_null", f"reference.frame.hold={hold}")
    found = motion.resolution(np.linspace(0.0, motion.end, 51))
    assert found.position_miss.max() < 1e-9
    assert least <= found.base_turn.max() <= most


@pytest.mark.slow
def test_what_comes_first_is_done():
    """Pose and attitude of the base take four degrees of freedom in the plane, of three."""
    goal = (
        "reference.frame={position: [0.15, 0, 2.4], rpy: [0, 1.1, 0], hold: [base_rotation_y], "
        "priority: %s}"
    )
    hold, frame = (
        motion_of("planar_detumble", *PLANAR, *ARM_ALONE, goal % first)[0].resolution(
            np.linspace(0.0, 20.0, 31)
        )
        for first in ("hold", "frame")
    )
    assert hold.base_turn.max() < 1e-12
    assert hold.missed
    assert not frame.missed
    assert frame.base_turn.max() > 0.1


@pytest.mark.slow
def test_a_motion_of_the_joints_in_the_reaction_null_space():
    target = "target_posture.joints={all: 0.5}"
    motion, _, _ = motion_of(
        "reaction_null", target, "reference.frame={task: none, hold: [base_rotation]}"
    )
    assert motion.resolution(np.linspace(0.0, 30.0, 31)).base_turn.max() < 1e-12
    q, v, _ = parts_of(motion, [0.0, 10.0, 30.0, 33.0])
    left = np.linalg.norm(q[:, 7:] - 0.5, axis=1)
    assert left[2] < 0.9 * left[0]  # as far as that lets it
    assert np.linalg.norm(v[1, 3:6]) > 1e-4
    assert not v[[0, 2, 3]].any()


@pytest.mark.slow
def test_after_a_capture_it_goes_on_with_the_momentum_of_both():
    motion, model, scenario = motion_of(
        "postcapture",
        *AT_ORIGIN,
        *ARM_ALONE,
        "capture.rate=[0.01, 0.008, 0.012]",
        "reference.base_rotation=eigenaxis",
        "reference.goal=stop",
        "reference.frame={task: attitude}",
    )
    contact = planned_contact(make_mission(scenario), model)
    times = np.array([0.0, 4.0, 15.0, 24.0])
    q, v, _ = parts_of(motion, times)
    assert_allclose(v[0], contact.grasp.velocity, atol=1e-15)
    assert_allclose(
        free_floating(model, q).momentum(v), np.tile(contact.momentum_after, (4, 1)), atol=1e-12
    )
    assert motion.resolution(times).attitude_miss.max() < 1e-9
    assert np.abs(v[3]).max() > 1e-4  # the frame rests, the rest does not
    assert_consistent(motion, times[1:], h=1e-3, atol=1e-7)


@pytest.mark.slow
def test_with_the_base_driven_the_joints_do_it_and_the_base_keeps_its_motion():
    goal = "reference.frame={task: position, position: [0.74, 0.02, 1.6]}"
    motion, _, _ = motion_of("postcapture", goal)
    alone, _, _ = motion_of("postcapture")
    times = np.array([3.0, 11.0, 20.0])
    assert motion.resolution(times).position_miss.max() < 1e-9
    for mine, its in zip(parts_of(motion, times), parts_of(alone, times), strict=True):
        assert_allclose(mine[:, :6], its[:, :6], atol=1e-8)


@pytest.mark.long
def test_a_run_leaves_the_base_alone():
    """In the closed loop, with noise, the base turns by less than 1e-6 rad; with a wrong payload it
    says how much.
    """
    record = simulate(load_scenario("reaction_null"), check_stability=False)
    q = record.dataset["position"].values
    turned = np.linalg.norm(position_errors(q, np.tile(q[0], (len(q), 1)))[:, :3], axis=1)
    assert turned.max() < 1e-7
    assert np.linalg.norm(q[-1, 4:7] - q[0, 4:7]) > 0.1
    reached = record.dataset["end_effector_position"].values[-1]
    assert_allclose(reached, [2.1, 0.7, 2.5], atol=1e-6)
