"""The quintic reference: closed-form figures, exact rates, and holding the target."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ffsm_drake import ScenarioError, load_scenario, make_closed_loop, simulate_many
from ffsm_drake.mission import make_mission
from ffsm_drake.runs.judge import JUDGES
from ffsm_drake.scenario import Reference
from ffsm_drake.spacecraft.craft import make_true_plant
from ffsm_drake.systems.blend import quintic_blend
from ffsm_drake.systems.reference import make_motion

DURATION = 20.0


@pytest.fixture(scope="module")
def loop():
    return make_closed_loop(load_scenario("postcapture"))


@pytest.fixture(scope="module", params=["rpy", "eigenaxis"])
def motion(loop, request):
    reference = Reference(duration=DURATION, base_rotation=request.param)
    return make_motion(make_mission(dataclasses.replace(loop.scenario, reference=reference)))


def slew(loop, start, target, base_rotation):
    """The motion of ``postcapture`` with other attitudes, roll, pitch, yaw in rad."""
    scenario = dataclasses.replace(
        loop.scenario,
        initial_posture=dataclasses.replace(loop.scenario.initial_posture, base_rpy=start),
        target_posture=dataclasses.replace(loop.scenario.target_posture, base_rpy=target),
        reference=Reference(duration=DURATION, base_rotation=base_rotation),
    )
    return make_motion(make_mission(scenario))


@pytest.mark.smoke
def test_blend_has_the_quintic_peaks():
    times = np.linspace(0, DURATION, 200001)
    s, rate, acceleration = quintic_blend(times, DURATION)
    assert rate.max() == pytest.approx(1.875 / DURATION, rel=1e-9)
    assert acceleration.max() == pytest.approx(5.7735 / DURATION**2, rel=1e-5)
    assert np.trapezoid(acceleration**2, times) == pytest.approx(120 / 7 / DURATION**3, rel=1e-8)
    assert np.trapezoid(rate, times) == pytest.approx(1.0, rel=1e-9)
    assert (s[0], s[-1]) == (0.0, 1.0)


@pytest.mark.parametrize("time", [-1.0, 0.0, DURATION, DURATION + 5])
def test_rest_at_and_beyond_both_ends(loop, motion, time):
    q, v, a = motion.evaluate(time)
    assert np.abs(v).max() < 1e-15
    assert np.abs(a).max() < 1e-15
    posture = loop.scenario.initial_posture if time <= 0 else loop.scenario.target_posture
    assert Rotation.from_quat(q[:4], scalar_first=True).as_euler("xyz") == pytest.approx(
        posture.base_rpy, abs=1e-14
    )
    assert q[4:7] == pytest.approx(posture.base_position, abs=1e-15)
    assert q[7:] == pytest.approx(list(posture.joints.values()), abs=1e-15)


@pytest.mark.smoke
def test_peak_speed_of_a_joint_and_of_the_base(motion):
    _, v, _ = motion.evaluate(DURATION / 2)
    change = np.deg2rad([-35, 45, -10, 30, 15])
    assert v[6:] == pytest.approx(1.875 * change / DURATION)
    assert v[3:6] == pytest.approx(1.875 * np.array([-0.1, -0.3, 0.2]) / DURATION)


@pytest.mark.parametrize("time", [2.0, 7.3, 11.0, 18.5])
@pytest.mark.parametrize(
    "angles", [None, ([-0.5, 0.3, -0.4], [1.2, 2.0, 2.6]), ([0.1] * 3, [0.1] * 3)]
)
def test_rates_are_the_derivatives_of_the_motion(loop, motion, angles, time):
    h = 1e-4
    if angles:
        motion = slew(loop, *angles, "eigenaxis")

    def rotation(t):
        return Rotation.from_quat(motion.evaluate(t)[0][:4], scalar_first=True)

    _, v, a = motion.evaluate(time)
    before, after = motion.evaluate(time - h), motion.evaluate(time + h)
    omega = (rotation(time + h) * rotation(time - h).inv()).as_rotvec() / (2 * h)
    assert v[:3] == pytest.approx(omega, abs=1e-9)
    assert v[3:] == pytest.approx((after[0][4:] - before[0][4:]) / (2 * h), abs=1e-9)
    assert a == pytest.approx((after[1] - before[1]) / (2 * h), abs=1e-9)


def test_attitude_follows_the_planned_angles(loop):
    """As the scenario says, which follows the paper."""
    scenario, motion = loop.scenario, make_motion(make_mission(loop.scenario))
    for time in (3.0, 9.0, 16.0):
        s, _, _ = quintic_blend(time, DURATION)
        q, _, _ = motion.evaluate(time)
        # fixed axes: roll, pitch, yaw
        angles = Rotation.from_quat(q[:4], scalar_first=True).as_euler("xyz")
        assert angles == pytest.approx(
            (1 - s) * np.array(scenario.initial_posture.base_rpy), abs=1e-13
        )


@pytest.mark.parametrize("target", [[1.2, 2.0, 2.6], [np.pi - 0.5, 0.3, -0.4], [0.2, 0.0, 0.0]])
def test_attitude_turns_about_the_eigenaxis(loop, target):
    """The angle from the start follows the blend, up to half a turn, and angular velocity stays
    along one axis.
    """
    start = [-0.5, 0.3, -0.4]
    motion = slew(loop, start, target, "eigenaxis")
    first, last = (Rotation.from_euler("xyz", angles) for angles in (start, target))
    whole = (last * first.inv()).as_rotvec()
    for time in (0.0, 3.0, 10.0, 16.0, 20.0, 30.0):
        s, rate, acceleration = quintic_blend(time, DURATION)
        q, v, a = motion.evaluate(time)
        turned = (Rotation.from_quat(q[:4], scalar_first=True) * first.inv()).as_rotvec()
        assert np.linalg.norm(q[:4]) == pytest.approx(1.0, abs=1e-15)
        sign = (
            np.sign(turned @ whole) if abs(np.linalg.norm(whole) - np.pi) < 1e-9 and s > 0 else 1.0
        )  # either way round
        assert sign * turned == pytest.approx(s * whole, abs=1e-12)
        assert sign * v[:3] == pytest.approx(rate * whole, abs=1e-12)
        assert sign * a[:3] == pytest.approx(acceleration * whole, abs=1e-12)


@pytest.mark.parametrize(
    ("start", "target", "rpy", "eigenaxis", "peak"),
    [
        ([-0.5, 0.3, -0.4], [1.2, 2.0, 2.6], 19051, 2746, 13.2),
        ([0.0] * 3, [2.6] * 3, 55494, 2018, 10.7),
    ],
)
def test_effort_of_large_slews(loop, start, target, rpy, eigenaxis, peak):
    """Of perfect tracking: ISV of either motion, and the largest base torque about the eigenaxis, N
    m.
    """
    true = make_true_plant(loop.scenario)
    for kind, expected in (("rpy", rpy), ("eigenaxis", eigenaxis)):
        motion = slew(loop, start, target, kind)
        samples = map(motion.evaluate, np.arange(0.0, DURATION, 0.1))
        forces = np.array(
            [true.calc_mass_matrix(q) @ a + true.calc_bias(q, v) for q, v, a in samples]
        )
        assert np.sum(forces**2) * 0.1 == pytest.approx(expected, rel=2e-3)
    assert np.abs(forces[:, :3]).max() == pytest.approx(peak, abs=0.1)


def test_ports_give_the_same_motion(loop):
    """At control samples and between them, forwards and backwards, within the plan and beyond."""
    reference, motion = loop.blocks["reference"], make_motion(make_mission(loop.scenario))
    context = reference.CreateDefaultContext()
    for time in (4.2, 4.21, 0.0, 4.213, 4.22, 19.99, 20.0, 35.0, 2.56, 2.55):
        context.SetTime(time)
        q, v, a = motion.evaluate(time)
        assert reference.GetOutputPort("desired_state").Eval(context).tolist() == [*q, *v], time
        assert (
            reference.GetOutputPort("desired_acceleration").Eval(context).tolist() == a.tolist()
        ), time


def test_translation_alone_needs_the_known_effort(loop, motion):
    """Moving 526 kg along the planned path: ISV 83.0."""
    times = np.arange(0, DURATION, 0.01)
    acceleration = np.array([motion.evaluate(t)[2][3:6] for t in times])
    mass = loop.plant.CalcTotalMass(loop.plant.CreateDefaultContext())
    assert mass == pytest.approx(526.0)
    assert np.sum((mass * acceleration) ** 2) * 0.01 == pytest.approx(83.0, abs=0.05)


def stopping(velocity, *overrides):
    given = [f"initial_velocity={velocity}", "reference.goal=stop", "reference.duration=8"]
    given.append("reference.base_rotation=eigenaxis")
    return load_scenario("postcapture", [*given, *overrides])


DRAWN = np.random.default_rng(0).uniform(-0.02, 0.02, (2, 11)).tolist()


@pytest.mark.parametrize("drawn", DRAWN)
def test_a_stop_without_a_capture_takes_out_the_initial_velocity(loop, drawn):
    """It begins with it, and ends at rest half a duration further."""
    names = loop.coordinates.names
    motion = make_motion(make_mission(stopping(dict(zip(names, drawn, strict=True)))))
    (q, v, a), (q_end, v_end, a_end) = motion.evaluate(0.0), motion.evaluate(8.0)
    assert v == pytest.approx(drawn, abs=1e-15)
    assert np.abs(np.concatenate([a, v_end, a_end])).max() < 1e-14
    assert q_end[4:] - q[4:] == pytest.approx(np.array(drawn[3:]) * 4.0, abs=1e-14)
    turns = Rotation.from_quat([q[:4], q_end[:4]], scalar_first=True)
    turned = (turns[1] * turns[0].inv()).as_rotvec()
    assert turned == pytest.approx(np.array(drawn[:3]) * 4.0, abs=1e-12)


def test_runs_that_stop_from_different_velocities_share_no_reference(loop):
    """Nor a build: each follows its own from the first sample on."""
    names = loop.coordinates.names
    each = [stopping(dict(zip(names, of, strict=True)), "duration=0.5") for of in DRAWN]
    for record, drawn in zip(simulate_many(each), DRAWN, strict=True):
        assert record.dataset["desired_velocity"].values[0] == pytest.approx(drawn, abs=1e-15)
        assert np.abs(record.dataset["error"].values).max() < 1e-4


def test_roll_pitch_and_yaw_cannot_begin_with_a_velocity():
    with pytest.raises(ScenarioError, match=r"reference\.base_rotation: must be eigenaxis"):
        stopping({"base_rotation_x": 0.01}, "reference.base_rotation=rpy")
    assert stopping({"base_rotation_x": 0, "joints": 0.01}, "reference.base_rotation=rpy")


def test_a_stop_of_nothing_is_said():
    plan_remarks = JUDGES.only("the test").remarks
    (line,) = (of for of in plan_remarks(stopping({"joints": 0})) if of.startswith("reference"))
    assert "because nothing moves" in line
    assert not [of for of in plan_remarks(stopping({"joint_1": 1e-3})) if "to stop" in of]
