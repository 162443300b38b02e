"""The quintic reference: closed-form figures, exact rates, and holding the target."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ffsm_drake import load_scenario, make_closed_loop
from ffsm_drake.systems.reference import make_motion, quintic_blend

DURATION = 20.0


@pytest.fixture(scope="module")
def loop():
    return make_closed_loop(load_scenario("postcapture"))


@pytest.fixture(scope="module")
def motion(loop):
    return make_motion(loop.scenario, loop.coordinates)


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
    assert Rotation.from_quat(q[:4], scalar_first=True).as_euler("xyz") == pytest.approx(posture.base_rpy, abs=1e-14)
    assert q[4:7] == pytest.approx(posture.base_position, abs=1e-15)
    assert q[7:] == pytest.approx(list(posture.joints.values()), abs=1e-15)


def test_peak_speed_of_a_joint_and_of_the_base(motion):
    _, v, _ = motion.evaluate(DURATION / 2)
    change = np.deg2rad([-35, 45, -10, 30, 15])
    assert v[6:] == pytest.approx(1.875 * change / DURATION)
    assert v[3:6] == pytest.approx(1.875 * np.array([-0.1, -0.3, 0.2]) / DURATION)


@pytest.mark.parametrize("time", [2.0, 7.3, 11.0, 18.5])
def test_rates_are_the_derivatives_of_the_motion(motion, time):
    h = 1e-4

    def rotation(t):
        return Rotation.from_quat(motion.evaluate(t)[0][:4], scalar_first=True)

    _, v, a = motion.evaluate(time)
    before, after = motion.evaluate(time - h), motion.evaluate(time + h)
    omega = (rotation(time + h) * rotation(time - h).inv()).as_rotvec() / (2 * h)
    assert v[:3] == pytest.approx(omega, abs=1e-9)
    assert v[3:] == pytest.approx((after[0][4:] - before[0][4:]) / (2 * h), abs=1e-9)
    assert a == pytest.approx((after[1] - before[1]) / (2 * h), abs=1e-9)


def test_attitude_follows_the_planned_angles(loop, motion):
    scenario = loop.scenario
    for time in (3.0, 9.0, 16.0):
        s, _, _ = quintic_blend(time, DURATION)
        q, _, _ = motion.evaluate(time)
        angles = Rotation.from_quat(q[:4], scalar_first=True).as_euler("xyz")  # fixed axes: roll, pitch, yaw
        assert angles == pytest.approx((1 - s) * np.array(scenario.initial_posture.base_rpy), abs=1e-13)


def test_ports_give_the_same_motion(loop, motion):
    """At control samples and between them, forwards and backwards, within the plan and beyond."""
    reference = loop.blocks["reference"]
    context = reference.CreateDefaultContext()
    for time in (4.2, 4.21, 0.0, 4.213, 4.22, 19.99, 20.0, 35.0, 2.56, 2.55):
        context.SetTime(time)
        q, v, a = motion.evaluate(time)
        assert reference.GetOutputPort("desired_state").Eval(context).tolist() == [*q, *v], time
        assert reference.GetOutputPort("desired_acceleration").Eval(context).tolist() == a.tolist(), time


def test_translation_alone_needs_the_known_effort(loop, motion):
    """Moving 526 kg along the planned path: ISV 83.0."""
    times = np.arange(0, DURATION, 0.01)
    acceleration = np.array([motion.evaluate(t)[2][3:6] for t in times])
    mass = loop.plant.CalcTotalMass(loop.plant.CreateDefaultContext())
    assert mass == pytest.approx(526.0)
    assert np.sum((mass * acceleration) ** 2) * 0.01 == pytest.approx(83.0, abs=0.05)
