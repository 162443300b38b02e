"""The filter of a target: consistent over many runs, right about the motion, robust to outliers."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from ffsm_drake import load_scenario, make_nominal_plant
from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture.closing import Closing
from ffsm_drake.plugins.capture.contact import coast
from ffsm_drake.plugins.capture.free_body import (
    SIZE,
    Target,
    inverse_inertia,
    shape_spread,
)
from ffsm_drake.plugins.capture.target_filter import TargetFilter, observed
from ffsm_drake.scenario import (
    Environment,
    MassProperties,
    Scenario,
    TargetSensor,
    TargetTracker,
    inertia_matrix,
)
from ffsm_drake.scenario.capture import Compliance
from ffsm_drake.spacecraft.orbit import Orbit
from ffsm_drake.systems.sampled import Now
from ffsm_drake.systems.setup import BlockSetup

BODY = MassProperties(
    mass=100.0, center_of_mass=[0.1, -0.05, 0.3], inertia=[20.0, 14.0, 9.0, 1.0, -0.5, 0.8]
)
MOTION = np.array([0.9, 0.1, -0.3, 0.3, 1.0, 2.0, 3.0, 0.08, -0.05, 0.1, 0.01, 0.0, -0.02])
PLACE = np.array([0.0, -3.0, 1.0])
SAMPLE = 0.02
SETTINGS = TargetTracker()
DROPS = TargetSensor(dropouts=0.2)


def motion(rate):
    """MOTION, turning at a rate, rad/s."""
    turning = MOTION.copy()
    turning[7:10] *= rate / np.linalg.norm(MOTION[7:10])
    return turning


def drawn(random, runs, rate):
    """Targets and the one that they are drawn about, at the deviations of SETTINGS."""
    prior = Target.from_motion(motion(rate), BODY)
    attitude = random.normal(size=(runs, 4))

    def about(value, deviation):
        return value + deviation * random.normal(size=(runs, 3))

    unlike = random.normal(size=(runs, 6)) @ shape_spread(prior.shape).T
    target = Target(
        quaternion=attitude / np.linalg.norm(attitude, axis=1)[:, None],
        rate=about(prior.rate, SETTINGS.rate_deviation),
        center=about(prior.center, 0.0),
        velocity=about(prior.velocity, SETTINGS.velocity_deviation),
        arm=about(prior.arm, SETTINGS.center_deviation),
        shape=prior.shape + SETTINGS.inertia_deviation * unlike,
    )
    return target, prior


def followed(sensor, runs, images, seed, rate=0.14):
    """Estimates and targets when each image's pose arrives, a latency after it."""
    random = np.random.default_rng(seed)
    target, prior = drawn(random, runs, rate)
    tracker = TargetFilter(SETTINGS, prior)
    # the first pose is one that fits: no filter knows a wrong one from a right one
    first, _ = observed(dataclasses.replace(sensor, outliers=0.0), target, PLACE, random)
    estimate = tracker.first(0.0, first)
    for image in range(1, images + 1):
        time, arrives = (SAMPLE * (image * sensor.period + late) for late in (0, sensor.latency))
        target = tracker.moved(target, estimate.time, time)
        pose, given = observed(sensor, target, PLACE, random)
        estimate = tracker.updated(tracker.predicted(estimate, time), pose, given)
        yield tracker.predicted(estimate, arrives), tracker.moved(target, time, arrives)


def nees(estimate, truth):
    """Squared errors in units of their covariances (runs,)."""
    error = estimate.target.error(truth)
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(estimate.covariance), error)


def band(runs):
    """Where the mean of ``nees`` over runs lies, 95 % of the time."""
    low, high = chi2.ppf([0.025, 0.975], SIZE * runs) / runs
    return low, high


def means(sensor, images, seeds, runs=200):
    """Mean of ``nees`` over runs (seeds, images)."""
    return np.array(
        [[nees(*both).mean() for both in followed(sensor, runs, images, seed)] for seed in seeds]
    )


def test_consistent_at_first():
    low, high = band(60)
    assert low < means(DROPS, 8, [0], runs=60).mean() < high


@pytest.mark.long
def test_consistent():
    low, high = band(60)
    found = means(DROPS, 80, [26], runs=60)
    assert low < found.mean() < high


@pytest.mark.exhaustive
def test_consistent_over_200_runs():
    # the means of a set's images go together: it is their mean over time that is held
    low, high = band(200)
    found = means(DROPS, 150, range(21, 24)).mean(axis=1)
    assert np.all((low < found) & (found < high))


@given(
    wide=st.floats(-2.0, 1.5),
    tight=st.floats(-2.0, 1.0),
    rate=st.floats(0.0, 1.5),
    dropouts=st.floats(0.0, 0.95),
    outliers=st.floats(0.0, 0.5),
    seed=st.integers(0, 1000),
)
@settings(max_examples=5)
def test_stays_sound(wide, tight, rate, dropouts, outliers, seed):
    """Whatever is known at first, seen and lost: numbers, and covariances that are."""
    random = np.random.default_rng(seed)
    names = ("rate_deviation", "velocity_deviation", "center_deviation", "inertia_deviation")
    prior = {name: getattr(SETTINGS, name) * 10.0**wide for name in names}
    noise = {name: getattr(DROPS, name) * 10.0**tight for name in ("position_noise", "angle_noise")}
    sensor = dataclasses.replace(DROPS, dropouts=dropouts, outliers=outliers, **noise)
    target = Target.from_motion(motion(rate), BODY)
    tracker = TargetFilter(dataclasses.replace(SETTINGS, **prior), target)
    estimate = tracker.first(0.0, observed(sensor, target, PLACE, random)[0])
    for time in np.cumsum(random.uniform(0.2, 1.0, size=4)):
        target = tracker.moved(target, estimate.time, time)
        pose, seen = observed(sensor, target, PLACE, random)
        estimate = tracker.updated(tracker.predicted(estimate, time), pose, seen)
        size = estimate.deviation
        assert np.all(np.isfinite(estimate.target.as_row()))
        assert np.linalg.eigvalsh(estimate.covariance / np.outer(size, size)).min() > 0.0
        assert np.linalg.eigvalsh(inverse_inertia(estimate.target.shape)).min() > 0.0


def coasted(target, environment=None, samples=101, time=0.0, onward=True, step=0.1):
    payload = dataclasses.replace(Scenario().payload, truth=BODY)
    scenario = dataclasses.replace(
        Scenario(), payload=payload, sample_time=step, environment=environment
    )
    return coast(scenario, target.motion, time=time, samples=samples, onward=onward)


def integrated(start, environment, begin, end):
    """The motion (13) of BODY at a time from that at another, by its angular momentum in the world
    and SciPy: nothing of the package's.
    """
    inertia, arm = inertia_matrix(BODY), np.array(BODY.center_of_mass)
    n = 0.0 if environment is None else environment.mean_motion
    hill = np.zeros(3) if environment is None else environment.hill_rpy
    hill = Rotation.from_euler("xyz", hill).as_matrix()

    def turn_and_rate(row):
        R = Rotation.from_quat(row[:4], scalar_first=True).as_matrix()
        return R, R @ np.linalg.solve(inertia, R.T @ row[4:7])

    def slope(time, row):
        R, w = turn_and_rate(row)
        up = hill @ [np.cos(n * time), np.sin(n * time), 0.0]
        turning = 0.5 * np.concatenate([[-w @ row[1:4]], row[0] * w + np.cross(w, row[1:4])])
        torque = 3.0 * n**2 * np.cross(up, R @ inertia @ R.T @ up)
        pull = n**2 * (3.0 * up * (up @ row[7:10]) - row[7:10])
        return np.concatenate([turning, torque, row[10:], pull])

    R = Rotation.from_quat(start[:4], scalar_first=True).as_matrix()
    w, p_PC = start[7:10], R @ arm
    momentum = R @ inertia @ R.T @ w
    first = [start[:4], momentum, start[4:7] + p_PC, start[10:] + np.cross(w, p_PC)]
    tight = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
    row = solve_ivp(slope, (begin, end), np.concatenate(first), **tight).y[:, -1]
    R, w = turn_and_rate(row)
    return np.concatenate([row[:4], row[7:10] - R @ arm, w, row[10:] - np.cross(w, R @ arm)])


def released(start, environment, begin, end):
    """The motion (13) of BODY, out of the reach of a gripper that closes on it."""
    payload = dataclasses.replace(Scenario().payload, truth=BODY)
    scenario = load_scenario("tumbling_capture", ["capture.closing={}"])
    scenario = dataclasses.replace(scenario, environment=environment)
    nominal = make_nominal_plant(scenario)
    setup = BlockSetup(name="", mission=Mission(scenario), nominal=nominal, settings={})
    block = Closing.of(setup, Compliance())
    state = np.zeros(2 * len(nominal.coordinates.names) + 1)
    state[0] = 1.0
    memory = block.begun(time=begin, payload=payload.truth, target=start, state=state)
    period = scenario.sample_time / block.per_sample
    for step in range(round((end - begin) / period)):
        outputs, memory = block.step({"state": state}, memory, Now(begin + step * period))
        assert not outputs["contact_force"].any()
    (met,) = block.met(memory, end, state).values()
    return met.motion


def off(found, expected):
    """The largest difference of two motions (13)."""
    sign = np.sign(found[:4] @ expected[:4])
    return max(np.abs(sign * found[:4] - expected[:4]).max(), np.abs(found - expected)[4:].max())


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_approach_filter_and_gripper_move_it_alike(seed):
    """A drawn tumble far from the origin of a fast orbit, or in none."""
    random = np.random.default_rng(seed)
    attitude = Rotation.random(random_state=seed).as_quat(scalar_first=True)
    rate = random.uniform(0.05, 0.4) * random.normal(size=3)
    place, velocity = 20.0 * random.normal(size=3), 0.05 * random.normal(size=3)
    start = np.concatenate([attitude, place, rate, velocity])
    hill = random.normal(size=3).tolist()
    fast = Environment(mean_motion=5e-3, altitude=None, hill_rpy=hill)
    environment = None if seed == 2 else fast
    target, orbit = Target.from_motion(start, BODY), environment and Orbit.of(environment)
    for lasts, most in ((0.5, 1e-9), (20.0, 1e-7)):
        end = 5.0 + lasts
        expected = integrated(start, environment, 5.0, end)
        samples = round(lasts / 0.01)
        onward = coasted(target, environment, samples=samples + 1, time=5.0, step=0.01)
        assert off(onward[-1], expected) < most
        last = Target.from_motion(expected, BODY)
        back = coasted(last, environment, samples=samples, time=end, onward=False, step=0.01)
        assert off(back[0], start) < most
        tracker = TargetFilter(SETTINGS, target, orbit)
        assert off(tracker.moved(target, 5.0, end).motion, expected) < 2e-5
    expected, free = (integrated(start, each, 5.0, 5.5) for each in (environment, None))
    assert off(released(start, environment, 5.0, 5.5), expected) < 1e-9
    assert environment is None or off(free, expected) > 1e-5  # what an orbit is for


@pytest.mark.slow
@pytest.mark.parametrize("period", [0.01, 0.07, 1.5])
@pytest.mark.parametrize("environment", [None, Environment(hill_rpy=[0.3, -0.2, 1.0])])
def test_goes_on_at_each_sample(environment, period):
    target = Target.from_motion(motion(0.3), BODY)
    orbit = environment and Orbit.of(environment)
    tracker = TargetFilter(SETTINGS, target, orbit)
    path = tracker.path(None, 5.0, period, 101)
    assert path.motion.shape == (101, 13)
    begun = tracker.moved(target, 0.0, 5.0)
    for sample in (0, 1, 37, 100):
        there = tracker.moved(begun, 5.0, 5.0 + sample * period)
        np.testing.assert_allclose(path.motion[sample], there.motion, atol=3e-6)
        np.testing.assert_allclose(path.center(sample), there.center, atol=3e-6)


ORBIT = Environment(mean_motion=2e-3, altitude=None, hill_rpy=[0.3, -0.2, 1.0])


@pytest.mark.slow
def test_drifts_as_hill_s_equations_say():
    """Clohessy and Wiltshire's closed form, in axes that turn with the orbit."""
    n, time = 2e-3, 300.0
    target = Target.from_motion(motion(0.0), BODY)
    rows = Orbit.of(ORBIT).axes(0.0)
    x, y, z = rows @ target.center
    turning = np.array([0.0, 0.0, n])
    u, v, w = rows @ target.velocity - np.cross(turning, [x, y, z])
    s, c = np.sin(n * time), np.cos(n * time)
    expected = [
        (4.0 - 3.0 * c) * x + s / n * u + 2.0 / n * (1.0 - c) * v,
        6.0 * (s - n * time) * x + y - 2.0 / n * (1.0 - c) * u + (4.0 * s / n - 3.0 * time) * v,
        c * z + s / n * w,
    ]
    path = coasted(target, ORBIT, samples=3001)
    last = Target.from_motion(path[-1], BODY)
    np.testing.assert_allclose(Orbit.of(ORBIT).axes(time) @ last.center, expected, atol=1e-9)


def test_turns_as_the_tide_on_its_parts_says():
    """The torque of the tide on six points of mass that have the body's inertia."""
    orbit, R = Orbit.of(ORBIT), matrix_of(np.array([0.7, -0.3, 0.5, 0.4]))
    masses = dataclasses.replace(BODY, inertia=[5.0, 7.0, 8.0], center_of_mass=[0.0, 0.0, 0.0])
    I = np.diag(inertia_matrix(masses))  # noqa: E741
    squares = 0.5 * I.sum() - I  # of x, y, z, summed by mass
    torque = np.zeros(3)
    for axis, square in enumerate(squares):
        for sign in (1.0, -1.0):
            place = R @ (sign * np.sqrt(square / 2.0) * np.eye(3)[axis])
            torque += np.cross(place, orbit.tide(place, 50.0))
    found = R @ orbit.gradient(R, inertia_matrix(masses), 50.0)
    np.testing.assert_allclose(found, torque, atol=1e-15)


def test_goes_back_as_it_came():
    target = Target.from_motion(motion(0.14), BODY)
    path = coasted(target, ORBIT, samples=1001, time=40.0, step=0.01)
    last = Target.from_motion(path[-1], BODY)
    back = coasted(last, ORBIT, samples=1000, time=50.0, onward=False, step=0.01)
    np.testing.assert_allclose(back[0], path[0], atol=1e-9)


def test_transition_is_the_motion_s_derivative():
    target, step, small = Target.from_motion(motion(0.8), BODY), 0.05, 1e-6
    middle = target.after(0.5 * step)
    ends = middle.after(0.5 * step)
    columns = [
        ends.error(target.corrected(small * unit).after(step)) / small for unit in np.eye(SIZE)
    ]
    np.testing.assert_allclose(middle.transition(step), np.array(columns).T, atol=2e-4)


@pytest.mark.slow
def test_learns():
    *_, (estimate, truth) = followed(DROPS, 20, 60, 1)
    first = np.sqrt(np.diagonal(estimate.covariance, axis1=1, axis2=2)).mean(axis=0)
    error = np.abs(estimate.target.error(truth)).mean(axis=0)
    assert np.all(error < 1.5 * first)
    assert np.all(error[3:6] < 0.4 * SETTINGS.rate_deviation)
    assert np.all(error[9:12] < 0.3 * SETTINGS.velocity_deviation)


@pytest.mark.slow
def test_leaves_outliers_out():
    sensor = dataclasses.replace(DROPS, outliers=0.05)
    *_, (estimate, truth) = followed(sensor, 20, 40, 2)
    assert np.median(nees(estimate, truth)) < 1.3 * SIZE
    assert np.all(estimate.fitted > 0)


def test_begins_anew_where_nothing_fits():
    *_, (estimate, truth) = followed(DROPS, 1, 20, 3)
    tracker = TargetFilter(SETTINGS, Target.from_motion(motion(0.14), BODY))
    random = np.random.default_rng(4)
    aside = dataclasses.replace(truth, center=truth.center + 2.0)
    for _ in range(8):
        pose, _ = observed(DROPS, aside, PLACE, random)
        estimate = tracker.updated(estimate, pose, np.array([True]))
    assert np.linalg.norm(estimate.target.position - aside.position) < 0.1
    _, position = estimate.pose_deviation
    assert position < 0.1


def test_noise_grows_with_range():
    random = np.random.default_rng(5)
    target = Target.from_motion(MOTION, BODY)
    deviations = [
        np.sqrt(np.trace(observed(DROPS, target, target.position + far, random)[0].covariance))
        for far in (np.array([1.0, 0.0, 0.0]), np.array([0.0, 10.0, 0.0]))
    ]
    assert deviations[0] < deviations[1]
