"""The planned motion around a grasp: through the velocities before and after it, to rest, within
limits.
"""

import copy

import numpy as np
import pytest
from consistent_motions import assert_consistent
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from ffsm_drake import ScenarioError, load_scenario
from ffsm_drake.common.so3 import rotation_vector_motion
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.capture.contact import planned_contact
from ffsm_drake.scenario import EMPTY
from ffsm_drake.spacecraft.craft import make_nominal_plant
from ffsm_drake.spacecraft.plant import models_dir
from ffsm_drake.systems.reference import make_motion

NQ, NV = 12, 11
TUMBLE = [
    "capture.rate=[0.05, 0.04, 0.06]",
    "capture.servicer=track_all",
    "reference.base_rotation=eigenaxis",
]
LIMITS = "actuation.limit={base_position: 22, base_rotation: 10, joints: 5}"


def motion_of(*overrides):
    scenario = load_scenario("flight_sensors", [*TUMBLE, *overrides])
    nominal = make_nominal_plant(scenario)
    return (
        make_motion(make_mission(scenario)),
        planned_contact(make_mission(scenario), nominal),
        scenario,
    )


def parts(row):
    return row[..., :NQ], row[..., NQ : NQ + NV], row[..., NQ + NV :]


@pytest.mark.smoke
def test_angular_velocity_and_acceleration_of_a_rotation_vector():
    rng, h = np.random.default_rng(3), 1e-4
    first = np.array([0.5, -0.5, 0.5, 0.5])
    for size in (0.0, 1e-9, 1e-3, 0.3, 2.0, 6.2):
        direction, p1, p2 = rng.normal(size=(3, 3))
        p0 = size * direction / np.linalg.norm(direction)
        times = np.array([-h, 0.0, h])[:, None]
        q, w, alpha = rotation_vector_motion(
            first, p0 + times * p1 + times**2 / 2 * p2, p1 + times * p2, p2 + 0 * times
        )
        turns = Rotation.from_quat(q, scalar_first=True)
        assert_allclose((turns[2] * turns[0].inv()).as_rotvec() / (2 * h), w[1], atol=1e-7)
        assert_allclose((w[2] - w[0]) / (2 * h), alpha[1], atol=1e-7)
        made = Rotation.from_rotvec(p0) * Rotation.from_quat(first, scalar_first=True)
        assert (made * turns[1].inv()).magnitude() < 1e-14


@pytest.mark.parametrize("goal", ["target_posture", "stop"])
def test_it_goes_through_the_grasp_with_the_velocities_of_both_sides(goal):
    approach = (
        "capture.approach={duration: 12, posture: {base_rpy: [0.5, -0.3, 0.2], joints: "
        "{joint_2: -1}}}"
    )
    motion, contact, scenario = motion_of("duration=40", f"reference.goal={goal}", approach)
    assert (motion.begin, motion.end) == (12.0, 32.0)
    assert np.abs(contact.velocity[:6]).min() > 1e-5  # the base moves, too
    q, v, a = parts(motion.row(12.0))
    assert_allclose(q, contact.q, atol=1e-15)
    assert_allclose(v, contact.grasp.velocity, atol=1e-16)
    assert not a.any()
    q, v, a = parts(motion.rows(np.array([12.0 - 1e-6]))[0])
    assert_allclose(q, contact.q, atol=1e-6)
    assert_allclose(v, contact.velocity, atol=1e-10)
    assert_allclose(a, 0.0, atol=1e-6)
    assert_consistent(motion, [0.3, 4.1, 11.8, 12.3, 20.0, 31.0], h=1e-4, atol=1e-8)
    start, end = parts(motion.row(0.0)), parts(motion.row(35.0))
    for _, v, a in (start, end):
        assert_allclose(v, 0.0, atol=1e-17)
        assert_allclose(a, 0.0, atol=1e-17)
    stowed = Rotation.from_euler("xyz", scenario.capture.approach.posture.base_rpy)
    assert (Rotation.from_quat(start[0][:4], scalar_first=True) * stowed.inv()).magnitude() < 1e-14
    assert start[0][7:] == pytest.approx([0, -1, 0, 0, 0], abs=1e-15)
    if goal == "target_posture":
        assert end[0][7:] == pytest.approx(list(scenario.target_posture.joints.values()), abs=1e-15)


def test_the_servicer_alone_moves_as_planned_with_the_target():
    approach = "capture.approach={duration: 12, posture: {joints: {joint_2: -1}}}"
    center = "payload.truth.center_of_mass=[0.1, 0.05, 0]"
    motion, _, scenario = motion_of("duration=40", approach, center)
    alone = make_motion(make_mission(scenario), EMPTY)
    times = np.array([0.0, 3.0, 11.99])
    assert_allclose(alone.rows(times), motion.rows(times), atol=1e-15)


def test_to_stop_elsewhere_takes_more():
    def effort(motion):
        times = np.linspace(0.0, 20.0, 2001)
        return float(np.trapezoid((parts(motion.rows(times))[2] ** 2).sum(axis=1), times))

    stop, *_ = motion_of("reference.goal=stop")
    q = parts(stop.row(20.0))[0]
    rpy = Rotation.from_quat(q[:4], scalar_first=True).as_euler("xyz")
    posture = {"base_rpy": rpy.tolist(), "base_position": q[4:7].tolist()}
    posture["joints"] = {f"joint_{i + 1}": float(q[7 + i]) for i in range(5)}
    there, *_ = motion_of(f"target_posture={posture}")
    assert effort(there) == pytest.approx(effort(stop), rel=1e-9)
    for place in ("base_position", "base_rpy", "joint_3"):
        for step in (-0.02, 0.02):
            other = copy.deepcopy(posture)
            if place in other:
                other[place][1] += step
            else:
                other["joints"][place] += step
            assert effort(motion_of(f"target_posture={other}")[0]) > effort(stop) + 1e-9


@pytest.mark.parametrize("goal", ["target_posture", "stop"])
def test_the_shortest_duration_reaches_a_limit_with_the_nominal_payload(goal):
    motion, _, scenario = motion_of("reference.duration=auto", LIMITS, f"reference.goal={goal}")
    model, limit = make_nominal_plant(scenario), np.repeat([10.0, 22.0, 5.0], [3, 3, 5])

    def share(duration):
        motion, *_ = motion_of(f"reference.duration={duration}", LIMITS, f"reference.goal={goal}")
        rows = parts(motion.rows(np.linspace(0.0, duration, 101)))
        return np.abs(model.calc_inverse_dynamics(*rows) / limit).max()

    assert share(motion.end) <= 0.7 < share(motion.end - 0.01)
    longer, *_ = motion_of(
        "reference.duration=auto", LIMITS, f"reference.goal={goal}", "reference.reserve=0.6"
    )
    assert longer.end > motion.end + 0.1


@pytest.mark.slow
def test_the_shortest_duration_keeps_the_positions(tmp_path):
    """joint_4 goes from 0.611 to 1.134 rad: an upper limit below that is named, one above changes
    nothing.
    """
    text = (models_dir() / "urdf" / "servicer.urdf").read_text()
    head, joint, tail = text.partition('<joint name="joint_4" type="continuous">')
    for upper, free in ((1.12, False), (1.2, True)):
        limit = f'<limit lower="-1" upper="{upper}" effort="0" velocity="0"/>'
        servicer = tmp_path / f"{upper}.urdf"
        servicer.write_text(head + joint.replace("continuous", "revolute") + limit + tail)
        model = (
            f"model.servicer={servicer}",
            "model.directives=null",
            "reference.duration=auto",
            LIMITS,
        )
        if free:
            assert motion_of(*model)[0].end == motion_of("reference.duration=auto", LIMITS)[0].end
        else:
            with pytest.raises(
                ScenarioError,
                match=r"nearest is [\d.]+ s, where the position "
                r"of joint_4 takes",
            ):
                motion_of(*model)


def test_a_duration_without_limits_is_refused():
    with pytest.raises(
        ScenarioError,
        match=r"reference\.duration: auto needs a limit of force or "
        r"velocity",
    ):
        motion_of("reference.duration=auto", "actuation.limit=null")


def test_where_no_duration_will_do_the_limit_is_named():
    feeble = "actuation.limit={base_position: 22, base_rotation: 10, joints: 50, joint_4: 1.0e-6}"
    with pytest.raises(
        ScenarioError,
        match=r"nearest is [\d.e+]+ s, where the force on "
        r"joint_4 takes",
    ) as refusal:
        motion_of("reference.duration=auto", feeble)
    assert refusal.value.key == "reference.duration"
