"""The estimates of the lumped uncertainty: their gains, their limits, and what the loop makes of
them.
"""

import dataclasses
import math

import numpy as np
import pytest
from flight_settings import FLIGHT, NO_NOISE
from numpy.testing import assert_allclose
from refusals import assert_refused
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation

from ffsm_drake import load_scenario, make_nominal_plant
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.estimators.assumed_noise import sensed_axes
from ffsm_drake.plugins.estimators.coupled import CoupledEstimator
from ffsm_drake.plugins.estimators.filter_gains import (
    SensedAxis,
    kalman_gain,
    sensed_gains,
)
from ffsm_drake.plugins.estimators.kalman import KalmanEstimator, LateKalmanEstimator
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import ESTIMATOR_KINDS
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers import Sample, gain_vectors
from ffsm_drake.systems.controllers.estimation import (
    ESTIMATORS,
    OneSampleEstimator,
    make_estimator,
)
from ffsm_drake.systems.controllers.time_delay import time_delay_force
from ffsm_drake.systems.reference import make_motion

PERIOD = 0.01
SIZE = 11
PARTS = ("position", "velocity")
NAMES = (
    *(f"base_{part}_{axis}" for part in ("rotation", "position") for axis in "xyz"),
    *(f"joint_{i}" for i in range(1, 6)),
)
# Velocities exact, positions useless and the walk fast, each beside the others; with these the gain
# is within 1e-7.
LIMIT = {"position_noise": 10.0, "velocity_noise": 1e-4, "walk": 1e4, "sample_time": PERIOD}
# In units of acceleration all six entries are of order one.
SCALE = np.array([1.0, PERIOD, PERIOD**2])[:, None] / np.array([1.0, PERIOD])
FLIGHT_GAINS, FLIGHT_FILTER = FLIGHT[1:4], FLIGHT[4:8]


def smooth_motion(rng, count):
    """Random smooth measured and desired velocities, their error, applied forces: each (count,
    SIZE).
    """
    time = PERIOD * np.arange(count)[:, None, None]

    def smooth(size):
        phase, frequency = rng.uniform(0, 2 * np.pi, (4, SIZE)), rng.uniform(0.2, 5.0, (4, SIZE))
        return size * np.sin(frequency * time + phase).sum(axis=1)

    v_d, e_dot, force = smooth(0.05), smooth(0.02), smooth(5.0)
    e_dot -= e_dot[0]  # the filter starts from zero error
    e = np.vstack([np.zeros(SIZE), np.cumsum(0.5 * PERIOD * (e_dot[1:] + e_dot[:-1]), axis=0)])
    return v_d - e_dot, v_d, e, e_dot, force


def sampled(**given):
    """A sample of what is given, not the first."""
    return Sample(
        **dict.fromkeys(("q", "v", "q_d", "v_d", "a_d"), None) | {"is_first": False} | given
    )


def made(name, *overrides):
    """The estimator of a scenario."""
    scenario = load_scenario(name, overrides)
    return make_estimator(make_mission(scenario), make_nominal_plant(scenario).coordinates)


def by_coordinate(values):
    return dict(zip(NAMES, values.tolist(), strict=True))


def poles(gain, step):
    """Of the error of a filter of [e, e', d]."""
    transition = np.array([[1, step, step**2 / 2], [0, 1, step], [0, 0, 1]])
    return np.linalg.eigvals((np.eye(3) - gain @ np.eye(2, 3)) @ transition)


def random_spd(rng):
    root = rng.normal(size=(SIZE, SIZE))
    return 20.0 * (root @ root.T / SIZE + np.eye(SIZE))


@pytest.mark.parametrize("seed", range(2))
def test_one_sample_is_the_limit_of_kalman(seed):
    """The same N = q'' - Hhat^-1 tau and, for the same u, the same force: through the pure
    functions, every sample.
    """
    rng = np.random.default_rng(seed)
    mass_matrix = random_spd(rng)
    gain = np.tile(kalman_gain(**LIMIT), (SIZE, 1, 1))
    one_sample = OneSampleEstimator(sample_time=PERIOD, num_velocities=SIZE)
    kalman = KalmanEstimator(sample_time=PERIOD, gain=gain)
    v, v_d, e, e_dot, force = smooth_motion(rng, 300)
    states = [dict(estimator.initial_state()) for estimator in (one_sample, kalman)]
    n, tau = ([], []), ([], [])
    for k in range(v.shape[0]):
        before = force[k - 1] if k else np.zeros(SIZE)
        sample = sampled(
            v=v[k], v_d=v_d[k], e=e[k], e_dot=e_dot[k], applied_force=before, is_first=k == 0
        )
        u = 3.0 * e_dot[k] + 2.0 * e[k] + 0.1
        for i, estimator in enumerate((one_sample, kalman)):
            estimate, states[i] = estimator.step(sample, mass_matrix, states[i])
            n[i].append(
                estimate.base_acceleration - np.linalg.solve(mass_matrix, estimate.base_force)
            )
            tau[i].append(
                time_delay_force(
                    delayed_force=estimate.base_force,
                    nominal_mass_matrix=mass_matrix,
                    delayed_acceleration=estimate.base_acceleration,
                    u=u,
                )
            )
            assert estimate.e_dot == pytest.approx(e_dot[k], abs=1e-6 * np.abs(e_dot).max())
            assert estimate.e == pytest.approx(e[k], abs=1e-5 * np.abs(e).max())
    true_n = np.diff(v, axis=0) / PERIOD - np.linalg.solve(mass_matrix, force[:-1].T).T
    assert np.array(n[0][1:]) == pytest.approx(true_n, abs=1e-12 * np.abs(true_n).max())
    assert np.array(n[1]) == pytest.approx(np.array(n[0]), abs=1e-6 * np.abs(n[0]).max())
    assert np.array(tau[1]) == pytest.approx(np.array(tau[0]), abs=1e-6 * np.abs(tau[0]).max())


@pytest.mark.smoke
def test_limit_of_the_gain():
    """Exact velocities give e' and, differentiated, d; a position is no use to anything."""
    expected = np.array([[0.0, PERIOD / 2], [0.0, 1.0], [0.0, 1.0 / PERIOD]])
    assert kalman_gain(**LIMIT) * SCALE == pytest.approx(expected * SCALE, abs=2e-7)
    for half_way in ({"position_noise": 1e-4}, {"velocity_noise": 1e2}, {"walk": 1.0}):
        assert np.abs((kalman_gain(**LIMIT | half_way) - expected) * SCALE).max() > 1e-3, half_way


@pytest.mark.smoke
@pytest.mark.parametrize("step", [PERIOD, 0.04])
def test_gain_is_that_of_the_filter_for_any_sensors(step):
    """Noise sets of the flight scenario (three groups), of postcapture, and others; two solutions
    of the Riccati equation.
    """
    position = (1e-3, 5e-5, 1e-5, 1e-6, 1e-3, 2e-4)
    velocity = (1e-3, 1.5e-5, 1e-4, 1e-6, 1e-2, 1e-4)
    walk = (1e-3, 1e-3, 1e-2, 1e-2, 10.0, 0.3)
    for numbers in zip(position, velocity, walk, strict=True):
        noises = dict(zip(("position_noise", "velocity_noise", "walk"), numbers, strict=True))
        found = kalman_gain(**noises, sample_time=step)
        ((both_new,),) = gains_of([SensedAxis(**noises)], sample_time=step).gains
        assert found == pytest.approx(both_new[:3], rel=1e-7), noises
        assert np.abs(poles(found, step)).max() < 1.0


def test_every_kind_that_a_scenario_can_name_is_there():
    assert {*ESTIMATOR_KINDS} == {"one_sample", *ESTIMATORS.offers()}


def test_a_more_trusted_sensor_and_a_faster_walk_weigh_more():
    reference = {
        "position_noise": 1e-4,
        "velocity_noise": 1e-4,
        "walk": 1e-2,
        "sample_time": PERIOD,
    }
    gain = kalman_gain(**reference)
    assert kalman_gain(**reference | {"position_noise": 1e-5})[0, 0] > 2 * gain[0, 0]
    assert kalman_gain(**reference | {"velocity_noise": 1e-5})[1, 1] > 2 * gain[1, 1]
    assert kalman_gain(**reference | {"walk": 1.0})[2, 1] > 2 * gain[2, 1]


def test_each_coordinate_has_the_gain_of_its_own_noise():
    """That of the sensors unless another is given, which may differ by coordinate."""
    sensors = "sensing.position_noise={base_position: 1e-3, base_rotation: 5e-5, joints: 1e-5}"
    given = "estimator.velocity_noise={all: 1e-3, joint_2: 7e-4}"
    scenario = load_scenario(
        FLIGHT[0], [*FLIGHT[1:], sensors, "estimator.position_noise=null", given]
    )
    coordinates = make_nominal_plant(scenario).coordinates
    estimator = make_estimator(make_mission(scenario), coordinates)
    assert isinstance(estimator, KalmanEstimator)
    assert estimator.gain.shape == (11, 3, 2)
    for name, position, velocity, walk in (
        ("base_rotation_y", 5e-5, 1e-3, 1e-3),
        ("base_position_x", 1e-3, 1e-3, 1e-3),
        ("joint_2", 1e-5, 7e-4, 1e-2),
        ("joint_3", 1e-5, 1e-3, 1e-2),
    ):
        expected = kalman_gain(
            position_noise=position, velocity_noise=velocity, walk=walk, sample_time=PERIOD
        )
        assert np.array_equal(estimator.gain[coordinates.names.index(name)], expected), name


def late_sample(k, *, v_d, e, e_dot, force, delay):
    """What the controller reads at sample k when each coordinate's measurement is ``delay`` (SIZE)
    old.
    """
    position = np.vstack([np.zeros(SIZE), np.cumsum(0.5 * PERIOD * (v_d[1:] + v_d[:-1]), axis=0)])
    then, axis = np.maximum(k - delay, 0), np.arange(SIZE)
    return sampled(
        v_d=v_d[k],
        e=e[then, axis] + position[k] - position[then, axis],
        e_dot=e_dot[then, axis] + v_d[k] - v_d[then, axis],
        applied_force=force[k - 1] if k else np.zeros(SIZE),
        is_first=k == 0,
    )


def test_late_measurements_are_filtered_at_their_time_and_predicted():
    """The filter runs at t - d, then predicts d samples with the force that acted."""
    rng = np.random.default_rng(0)
    delay = np.array([1, 1, 1, 3, 3, 3, 5, 5, 0, 8, 2])
    mass_matrix = np.diag(rng.uniform(5.0, 50.0, SIZE))
    noise = {"position_noise": 1e-3, "velocity_noise": 1e-3, "walk": 1e-1}
    plain = KalmanEstimator(
        sample_time=PERIOD, gain=np.tile(kalman_gain(**noise, sample_time=PERIOD), (SIZE, 1, 1))
    )
    prediction = KalmanEstimator(sample_time=PERIOD, gain=np.zeros((SIZE, 3, 2)))
    settings = [f"estimator.{name}={value}" for name, value in noise.items()]
    settings += [f"sensing.{part}_delay={by_coordinate(delay)}" for part in PARTS]
    late = made("postcapture", "estimator.kind=kalman", *settings)
    assert isinstance(late, LateKalmanEstimator)
    _, v_d, e, e_dot, force = smooth_motion(rng, 120)
    at_its_time, given = (
        [dict(plain.initial_state())],
        {"v_d": v_d, "e": e, "e_dot": e_dot, "force": force},
    )
    none = np.zeros(SIZE, dtype=int)
    for k in range(120):
        at_its_time.append(
            plain.step(late_sample(k, **given, delay=none), mass_matrix, at_its_time[-1])[1]
        )
    alone = dict(late.initial_state())
    for k in range(120):
        _, alone = late.step(late_sample(k, **given, delay=delay), mass_matrix, alone)
        if k < delay.max():
            continue
        for d in set(delay.tolist()):
            state = at_its_time[k - d + 1]
            for later in range(k - d + 1, k + 1):
                _, state = prediction.step(
                    late_sample(later, **given, delay=none), mass_matrix, state
                )
            axes = delay == d
            for name in ("estimated_error", "estimated_error_rate", "estimated_negative_n"):
                scale = np.abs(state[name]).max()
                assert alone[name][axes] == pytest.approx(state[name][axes], abs=1e-9 * scale), (
                    k,
                    d,
                    name,
                )


def gains_of(axes, *, responses=None, **given):
    """``sensed_gains``; without responses, of coordinates that nothing couples."""
    responses = np.eye(len(axes))[None] if responses is None else responses
    return sensed_gains(axes, responses=responses, **given)


@pytest.mark.parametrize(
    ("period", "delay"),
    [((1, 1), (0, 0)), ((1, 1), (5, 2)), ((4, 4), (3, 3)), ((1, 6), (0, 4)), ((3, 2), (1, 5))],
)
@pytest.mark.parametrize("others", [(), (((1, 2), (2, 0)),)], ids=["alone", "coupled"])
def test_gains_are_those_of_the_whole_filter(period, delay, others):
    """Of the time-varying filter for [e, e', d, b] and everything that was, in SI; the mean by what
    is new. Another coordinate, with sensors of its own, is disturbed together with it.
    """
    times = [(period, delay), *others]
    n = len(times)
    axes = [
        SensedAxis(
            position_noise=1e-3 * (k + 1), velocity_noise=2e-3, walk=0.3 * (k + 1),
            bias_walk=0.1 * (k == 0), period=each, delay=late,
        )
        for k, (each, late) in enumerate(times)
    ]  # fmt: skip
    response = np.array([[1.0, -0.4], [-0.4, 0.7]])[:n, :n]
    lags, periods = (np.array([of[k] for of in times]).T.ravel() for k in (1, 0))
    size, one = 4 * n + lags.sum(), np.eye(n)
    transition, output = np.zeros((size, size)), np.zeros((2 * n, size))
    transition[: 4 * n, : 4 * n] = np.eye(4 * n)
    transition[:n, n : 2 * n] = PERIOD * one
    transition[:n, 2 * n : 3 * n] = PERIOD**2 / 2 * response
    transition[n : 2 * n, 2 * n : 3 * n] = PERIOD * response
    first = 4 * n
    for entry, lag in enumerate(lags):
        for j in range(lag):
            transition[first + j, entry if j == 0 else first + j - 1] = 1.0
        output[entry, first + lag - 1 if lag else entry] = 1.0
        first += lag
    output[n, 3 * n] = -1.0
    walks = [of.walk for of in axes] + [of.bias_walk for of in axes]
    process = np.zeros((size, size))
    process[2 * n : 4 * n, 2 * n : 4 * n] = np.diag(np.square(walks)) * PERIOD
    noise = np.square([of.position_noise for of in axes] + [of.velocity_noise for of in axes])
    covariance, found = np.zeros((size, size)), {}
    covariance[: 3 * n + 1, : 3 * n + 1] = 1e-3 * np.eye(3 * n + 1)
    for k in range(1800):
        new = (k - lags) % periods == 0
        of, gain = output[new], np.zeros((size, 2 * n))
        gain[:, new] = np.linalg.solve(
            of @ covariance @ of.T + np.diag(noise[new]), of @ covariance
        ).T
        covariance = covariance - gain[:, new] @ of @ covariance
        covariance = transition @ covariance @ transition.T + process
        covariance = 0.5 * (covariance + covariance.T)  # rounding would grow
        if k >= 1800 - np.lcm.reduce(periods):
            found.setdefault(tuple(new.tolist()), []).append(gain)
    kinds, (gains,) = gains_of(axes, responses=response[None], sample_time=PERIOD)
    assert sorted(map(tuple, kinds.tolist())) == sorted(found)
    for kind, gain in zip(kinds.tolist(), gains, strict=True):
        expected = np.mean(found[tuple(kind)], axis=0)
        scale = np.abs(expected).max()
        assert gain == pytest.approx(expected, abs=1e-6 * scale, rel=1e-5), kind
        assert not gain[:, ~np.array(kind)].any()


@pytest.mark.parametrize("seed", range(6))
def test_gains_of_prompt_sensors_solve_the_riccati_equation(seed):
    """Of light and heavy parts together, whose walk is much larger than the noise."""
    rng, n = np.random.default_rng(seed), 12
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    response = turn @ np.diag(10.0 ** rng.uniform(-2, 2, n)) @ turn.T
    walk = 10.0 ** rng.uniform(-2, -1)
    axis = SensedAxis(position_noise=1e-6, velocity_noise=1e-6, walk=walk)
    _, ((gain,),) = gains_of([axis] * n, responses=response[None], sample_time=PERIOD)
    one, zero, output = np.eye(n), np.zeros((n, n)), np.eye(2 * n, 3 * n)
    units = np.repeat([PERIOD**2, PERIOD, 1.0], n)  # of accelerations
    transition = np.block([[one, one, response / 2], [zero, one, response], [zero, zero, one]])
    process = np.diag(np.repeat([0.0, 0.0, walk**2 * PERIOD], n))
    of_walk = np.linalg.norm(response * walk, axis=1) * math.sqrt(PERIOD)  # see ``_assumed``
    position = np.maximum(1e-6 / PERIOD**2, 0.1 * np.minimum(1e-6 / PERIOD, of_walk))
    noise = np.diag(np.concatenate([position, np.full(n, 1e-6 / PERIOD)]) ** 2)
    covariance = solve_discrete_are(transition.T, output.T, process, noise)
    innovation = output @ covariance @ output.T + noise
    expected = np.linalg.solve(innovation, output @ covariance).T * units[:, None] / units[: 2 * n]
    assert gain[: 3 * n] == pytest.approx(expected, abs=1e-6 * np.abs(expected).max())


def by_groups(rng, low, high):
    """Whole numbers (2, SIZE), the same for the base's three axes."""
    return np.repeat(rng.integers(low, high, (2, 7)), [3, 3, 1, 1, 1, 1, 1], axis=1)


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("bias_walk", [0.0, 1e-3])
def test_coupled_is_separate_where_nothing_couples(bias_walk, late):
    """With a diagonal mass matrix M, and a force's walk of M times that of N. Biases are in the
    axes of a base that stands anywhere. Measurements are late by drawn delays, and velocities new
    at every second sample.
    """
    rng = np.random.default_rng(0)
    mass, position, velocity, walk = (
        np.repeat(rng.uniform(1.0, 5.0, 7), [3, 3, 1, 1, 1, 1, 1]) * size
        for size in (10.0, 1e-5, 1e-4, 1e-2)
    )
    of_bias = np.where(np.isin(np.arange(SIZE), (6, 8)), 0.0, bias_walk)
    delay, period = by_groups(rng, 0, 5) * late, np.array([[1], [1 + late]]) + np.zeros(SIZE, int)
    settings = {"position_noise": position, "velocity_noise": velocity, "walk": walk}
    settings["velocity_bias_walk"] = of_bias
    given = [f"estimator.{key}={by_coordinate(of)}" for key, of in settings.items()]
    for part, lag, each in zip(PARTS, delay, period, strict=True):
        given += [f"sensing.{part}_delay={by_coordinate(lag)}"]
        given += [f"sensing.{part}_period={by_coordinate(each)}"]
    separate = made("postcapture", "estimator.kind=kalman", *given)
    assert isinstance(separate, LateKalmanEstimator if bias_walk or late else KalmanEstimator)
    axes = np.array([0, 1, 2, 6, 7, 8, 9, 10])
    assumed = [
        SensedAxis(
            position_noise=position[i], velocity_noise=velocity[i], walk=mass[i] * walk[i],
            bias_walk=of_bias[i], period=(1, 1 + late), delay=tuple(delay[:, i].tolist()),
        )
        for i in axes
    ]  # fmt: skip
    responses = np.diag(-1.0 / mass[axes])[None]
    kinds, (together,) = gains_of(assumed, responses=responses, sample_time=PERIOD)
    unbiased = 3 * axes.size + np.flatnonzero(of_bias[axes] == 0.0)
    together = np.delete(together, unbiased, axis=1)
    q_d = np.arange(1.0, 13.0)
    coupled = CoupledEstimator(
        separate=separate,
        axes=axes,
        biased=axes[of_bias[axes] > 0.0],
        kinds=kinds,
        postures=np.stack([q_d, -2.0 * q_d]),
        gain=np.stack([together, np.zeros_like(together)]),
    )
    states = [dict(separate.initial_state()), dict(coupled.initial_state())]
    _, v_d, e, e_dot, force = smooth_motion(rng, 60)
    for k in range(60):
        given = {"v_d": v_d[k], "e": e[k], "e_dot": e_dot[k], "applied_force": force[k]}
        given |= {"q": rng.normal(size=SIZE + 1), "q_d": q_d}
        given |= {"is_new": ((k - delay) % period == 0).ravel()} if late else {}
        sample = sampled(is_first=k == 0, **given)
        expected, states[0] = separate.step(sample, np.diag(mass), states[0])
        estimate, states[1] = coupled.step(sample, np.diag(mass), states[1])
        for name in ("e", "e_dot", "base_acceleration"):
            of, wanted = getattr(estimate, name), getattr(expected, name)
            assert of == pytest.approx(wanted, abs=1e-6 * np.abs(wanted).max()), (k, name)
    for name in ("past", "estimated_velocity_bias"):
        found, wanted = (state.get(name, np.zeros(0)) for state in states[1::-1])
        assert found == pytest.approx(wanted, abs=1e-6 * np.abs(wanted).max(initial=0.0))
    if bias_walk:
        assert (np.abs(found) > 0.0).tolist() == (of_bias > 0.0).tolist()
    jumps = [estimator.resume(state, np.eye(SIZE), v_d[0]) for estimator, state in
             zip((separate, coupled), states, strict=True)]  # fmt: skip
    assert jumps[0].keys() == jumps[1].keys()
    for name, wanted in jumps[0].items():
        assert jumps[1][name] == pytest.approx(wanted, abs=1e-6 * np.abs(wanted).max(initial=0.0))


@pytest.mark.smoke
def test_a_sample_unlike_all_others_has_the_gain_of_the_nearest_kind():
    """A reading can be lost: the others then count as at the most similar samples."""
    kinds = np.array([[0, 1, 0, 1], [1, 1, 0, 1], [1, 1, 1, 1]], dtype=bool)
    gain = np.random.default_rng(0).normal(size=(1, 3, 6, 4))
    estimator = CoupledEstimator(
        separate=None, axes=np.arange(2), biased=np.arange(0), kinds=kinds,
        postures=np.zeros((1, 8)), gain=gain,
    )  # fmt: skip
    seen = [*kinds, [0, 0, 0, 1], [0, 1, 1, 1]]
    found = [estimator.of_kind(gain[0], np.array(new, dtype=bool)) for new in seen]
    assert np.array_equal(found, gain[0][[0, 1, 2, 0, 2]])


@pytest.mark.parametrize("left_out", [(), ("right_1", "right_6"), ("left_2", "right_3")])
def test_the_coupled_filter_of_fewer_coordinates_has_their_inertia(left_out):
    """As in a closed chain, whose law has only the joints that move the others, in any order."""
    mission = make_mission(load_scenario("two_arms", ["estimator.kind=coupled"]))
    model = mission.craft.nominal()
    whole = model.coordinates
    kept = [i for i, name in enumerate(whole.joints) if name not in left_out]
    joints, units = ([of[i] for i in kept] for of in (whole.joints, whole.joint_units))
    fewer = Coordinates(tuple(joints), tuple(units), whole.undriven)
    own, all_of_them = (
        CoupledEstimator.make(mission, each, None, mission.craft.nominal().grip)
        for each in (fewer, whole)
    )
    for q, gains in zip(own.postures, own.gain, strict=True):
        inverse = np.linalg.inv(model.calc_mass_matrix(q))
        places = [whole.names.index(fewer.names[i]) for i in own.axes]
        sensed = np.array(sensed_axes(mission.scenario, fewer))[own.axes]
        walk = fewer.vector(mission.scenario.estimator.force_walk, key="")[own.axes]
        sensed = [dataclasses.replace(axis, walk=w) for axis, w in zip(sensed, walk, strict=True)]
        response = -inverse[np.ix_(places, places)]
        _, (expected,) = gains_of(sensed, responses=response[None], sample_time=0.01)
        rows = [*range(3 * own.axes.size)]
        assert_allclose(gains[:, rows], expected[:, rows], rtol=1e-9, atol=1e-9)
    assert own.axes.size == all_of_them.axes.size - len(left_out)


def test_the_gain_is_that_of_the_nearest_posture():
    """By joints and attitude, of which a quaternion's sign says nothing; of several runs, each as
    alone.
    """
    rng = np.random.default_rng(0)
    postures, gain = rng.normal(size=(5, 12)), rng.normal(size=(5, 1, 6, 4))
    postures[:, :4] /= np.linalg.norm(postures[:, :4], axis=1)[:, None]
    estimator = CoupledEstimator(
        separate=None, axes=np.arange(2), biased=np.arange(0), kinds=np.ones((1, 4), dtype=bool),
        postures=postures, gain=gain,
    )  # fmt: skip
    near = postures + 1e-3
    near[:, :4] *= -1.0
    near[:, 4:7] += 100.0
    assert np.array_equal(estimator.gain_at(near), gain)
    assert np.array_equal(estimator.gain_at(near[3]), gain[3])
    turned = postures[[0, 0]].copy()
    turned[1, :4] = postures[1, :4]
    apart = dataclasses.replace(estimator, postures=turned, gain=gain[:2])
    assert np.array_equal(apart.gain_at(turned), gain[:2])


def posture(joints):
    return {f"joint_{i}": angle for i, angle in enumerate(joints, 1)}


FAR = [
    "estimator.kind=coupled",
    "actuation.limit=null",
    f"initial_posture.joints={posture([-1.5, 0.1, 0.1, -2.1, 2.4])}",
    f"target_posture.joints={posture([0.4, -2.5, 1.4, 2.4, 0.4])}",
]


def filter_radius(estimator, inverse, gain):
    """Of the error of [e, e', f], frozen in a posture with Hhat^-1 (n, n)."""
    size = len(estimator.axes)
    transition, one = np.eye(3 * size), np.eye(size)
    transition[:size, size:] = np.hstack([PERIOD * one, -(PERIOD**2) / 2 * inverse])
    transition[size : 2 * size, 2 * size :] = -PERIOD * inverse
    corrected = np.eye(3 * size) - gain @ np.eye(2 * size, 3 * size)
    return np.abs(np.linalg.eigvals(transition @ corrected)).max()


def test_the_coupled_filter_is_stable_all_along_a_motion():
    """The gain of its start alone is not."""
    scenario = load_scenario("flight_sensors", FAR)
    model = make_nominal_plant(scenario)
    estimator = make_estimator(make_mission(scenario), model.coordinates)
    q_d = make_motion(make_mission(scenario)).rows(np.linspace(0.0, 20.0, 41))[:, :12]
    axes = estimator.axes
    inverses = np.linalg.inv(model.calc_mass_matrix(q_d))[:, axes[:, None], axes]
    along = [
        filter_radius(estimator, inverse, *estimator.gain_at(q))
        for q, inverse in zip(q_d, inverses, strict=True)
    ]
    at_start = [filter_radius(estimator, inverse, *estimator.gain[0]) for inverse in inverses]
    assert max(along) < 1.0
    assert max(at_start) > 1.2


def test_gains_are_as_many_as_a_motion_takes():
    """Neighbours' inertias are within 15 % of each other; a mild motion takes few, the largest 41,
    none one.
    """
    counts = []
    for overrides in (FAR[:2], FAR, [*FAR, "reference.goal=stop"]):
        scenario = load_scenario("flight_sensors", overrides)
        model = make_nominal_plant(scenario)
        estimator = make_estimator(make_mission(scenario), model.coordinates)
        counts.append(len(estimator.gain))
        axes = estimator.axes
        inverses = np.linalg.inv(model.calc_mass_matrix(estimator.postures))
        inverses = inverses[:, axes[:, None], axes]
        ratios = np.linalg.eigvals(np.linalg.solve(inverses[1:], inverses[:-1])).real
        if counts[-1] < 41:
            assert np.abs(np.log(ratios)).max(initial=0.0) < np.log(1.16)
    assert 5 < counts[0] < 20
    assert counts[1:] == [41, 1]


@pytest.mark.long
def test_a_capture_whose_approach_changes_the_wrists_inertia_is_followed():
    """Its approach diverged at 13.0 s with the gain of the grasp's posture."""
    body = "{mass: 20, center_of_mass: [0, 0, 0], inertia: [3.3, 3.3, 3.3]}"
    overrides = [
        "capture.rate=[0.23, 0.133, -0.123]",
        f"payload={{truth: {body}, nominal: {body}}}",
        "capture.joints=braked",
        "reference.duration=40",
        "duration=65",
    ]
    log = make_rollout(load_scenario("tumbling_capture", overrides)).run()
    assert log.outcome.completed, log.outcome.message
    assert np.abs(log.error[-500:, :3]).max() < 2e-5
    assert np.abs(log.error[-500:, 6:]).max() < 2e-4


@pytest.mark.long
def test_no_random_motion_of_the_joints_makes_the_coupled_filter_diverge():
    """A third of such motions diverged with the gain of the initial posture."""
    rng = np.random.default_rng(0)
    for _ in range(10):
        start, end = (posture(rng.uniform(-2.5, 2.5, 5).tolist()) for _ in range(2))
        overrides = [f"initial_posture.joints={start}", f"target_posture.joints={end}"]
        log = make_rollout(load_scenario("flight_sensors", [*FAR[:2], *overrides])).run()
        assert log.outcome.completed, (start, end)


@pytest.mark.parametrize(
    "given",
    [
        ["slow_navigation"],
        ["slow_navigation", "estimator.kind=coupled"],
        ["postcapture", "estimator.kind=kalman"],
        ["postcapture", "estimator.kind=coupled"],
    ],
    ids=" ".join,
)
def test_what_is_not_new_is_not_looked_at(given):
    """With slow and with prompt sensors, whose readings a link can lose."""
    estimator = made(*given)
    rng = np.random.default_rng(0)
    state = {
        name: rng.normal(size=value.shape) for name, value in estimator.initial_state().items()
    }
    v_d, e, e_dot, force, wrong = rng.normal(size=(5, SIZE))
    is_new = np.ones(2 * SIZE, dtype=bool)
    is_new[[3, 4, 5, SIZE + 3, SIZE + 4, SIZE + 5]] = False
    position = np.isin(np.arange(SIZE), (3, 4, 5))
    rest = np.eye(1, SIZE + 1)[0]
    given = {"q": rest, "q_d": rest, "v_d": v_d, "applied_force": force}
    results = [
        estimator.step(
            sampled(**given, e=e + error, e_dot=e_dot + error, is_new=new), np.eye(SIZE), state
        )[0]
        for error, new in ((0.0, is_new), (wrong * position, is_new), (wrong * position, None))
    ]
    assert np.array_equal(results[0].e, results[1].e)
    assert np.array_equal(results[0].base_acceleration, results[1].base_acceleration)
    assert not np.allclose(results[0].e[position], results[2].e[position])


def turned(rotation, values):
    """Values (SIZE) with the base's vectors turned."""
    return np.concatenate([rotation.apply(values[:6].reshape(2, 3)).ravel(), values[6:]])


@pytest.mark.parametrize("seed", range(4))
def test_the_bases_filters_stand_in_its_axes(seed):
    """In a turned world the same happens, turned, to everything but the bias, which is in the
    base's axes; measurements late and slow, noises and walks drawn for each axis.
    """
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(1.0, 4.0, (4, SIZE)) * np.array([[1e-4], [1e-4], [1e-2], [1e-3]])
    keys = ("position_noise", "velocity_noise", "walk", "velocity_bias_walk")
    given = [f"estimator.{key}={by_coordinate(of)}" for key, of in zip(keys, drawn, strict=True)]
    given += ["sensing.position_delay={base_position: 4, joints: 1}",
              "sensing.velocity_period={base_rotation: 3}"]  # fmt: skip
    estimator = made("postcapture", "estimator.kind=kalman", *given)
    turn = Rotation.random(random_state=seed)
    attitude = Rotation.random(random_state=seed + 100)
    states = [dict(estimator.initial_state()) for _ in range(2)]
    mass = np.diag(np.repeat(rng.uniform(5.0, 50.0, SIZE - 4), [3, 3, 1, 1, 1, 1, 1]))
    for k in range(12):
        v_d, e, e_dot, force = rng.normal(size=(4, SIZE))
        new = np.concatenate([np.repeat(rng.random(7) < 0.7, [3, 3, *[1] * 5]) for _ in PARTS])
        found = []
        for i, by in enumerate((Rotation.identity(), turn)):
            q = np.zeros(SIZE + 1)
            q[[1, 2, 3, 0]] = (by * attitude).as_quat()
            sample = sampled(
                q=q, v_d=turned(by, v_d), e=turned(by, e), e_dot=turned(by, e_dot),
                applied_force=turned(by, force), is_first=k == 0, is_new=new,
            )  # fmt: skip
            estimate, states[i] = estimator.step(sample, mass, states[i])
            found.append(np.stack([estimate.e, estimate.e_dot, estimate.base_acceleration]))
        expected = np.stack([turned(turn, row) for row in found[0]])
        assert found[1] == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())
        bias = [state["estimated_velocity_bias"] for state in states]
        assert bias[1] == pytest.approx(bias[0], abs=1e-9 * (np.abs(bias[0]).max() + 1e-9))
    assert np.abs(bias[0][:6]).min() > 0.0


@pytest.mark.parametrize("seed", range(3))
def test_a_turning_gyros_bias_is_found_in_its_axes(seed):
    """Over a drawn slew at 0.1 rad/s: in the world it would be off by its own size."""
    rng = np.random.default_rng(seed)
    given = [
        *("estimator.position_noise=1e-5", "estimator.velocity_noise=1e-5", "estimator.walk=1e-4"),
        "estimator.velocity_bias_walk={base_rotation: 1e-5}",
    ]
    estimator = made("postcapture", "estimator.kind=kalman", *given)
    bias, axis = 1e-4 * rng.normal(size=3), rng.normal(size=3)
    rate = 0.1 * axis / np.linalg.norm(axis)
    state, zeros = dict(estimator.initial_state()), np.zeros(SIZE)
    for k in range(3000):
        attitude = Rotation.from_rotvec(PERIOD * k * rate)
        q, e_dot = np.zeros(SIZE + 1), np.zeros(SIZE)
        q[[1, 2, 3, 0]] = attitude.as_quat()
        e_dot[:3] = -attitude.apply(bias)
        sample = sampled(q=q, v_d=zeros, e=zeros, e_dot=e_dot, applied_force=zeros, is_first=k == 0)
        state = estimator.step(sample, np.eye(SIZE), state)[1]
    off = state["estimated_velocity_bias"][:3] - bias
    assert np.linalg.norm(off) < 0.02 * np.linalg.norm(bias)


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param("kalman", marks=pytest.mark.slow),
        pytest.param("coupled", marks=pytest.mark.long),
    ],
)
def test_a_gyros_bias_is_found(run, kind):
    """Without a state of its own it becomes an error of attitude, or position."""
    bias = (
        "sensing.velocity_bias={base_rotation_x: 1e-4, base_position_z: 2e-3}",
        *NO_NOISE,
        f"estimator.kind={kind}",
        "duration=10",
    )
    walk = "estimator.velocity_bias_walk={base_rotation: 1e-4, base_position_z: 3e-3}"
    without, estimated = (run(*FLIGHT, *bias, *more) for more in ((), (walk,)))
    for name in ("base_rotation_x", "base_position_z"):
        before, after = (
            np.abs(record.dataset["error"].sel(coordinate=name).values[-1])
            for record in (without, estimated)
        )
        assert after < 0.05 * before, name


@pytest.mark.slow
def test_an_unknown_constant_disturbance_leaves_no_error(run):
    """At rest the force cancels tau_d, and what is left of the error is nothing beside that of the
    law alone.
    """
    record = run(
        *FLIGHT, "reference.duration=8", "duration=25", "disturbance.frequency_scale=0", *NO_NOISE
    )
    data, scenario = record.dataset, record.scenario
    disturbance = data["disturbance_force"].values
    assert np.ptp(disturbance, axis=0) == pytest.approx(np.zeros(11), abs=1e-15)
    assert np.abs(disturbance[0]).max() > 0.1
    nominal = make_nominal_plant(scenario)
    k_p = gain_vectors(scenario, nominal.coordinates)["k_p"]
    mass_matrix = nominal.calc_mass_matrix(data["position"].values[-1])
    without_estimate = np.abs(np.linalg.solve(mass_matrix, disturbance[-1]) / k_p)
    error = np.abs(data["error"].values[-1])
    for name, part in nominal.coordinates.groups.items():
        assert error[part].max() < 1e-4 * without_estimate[part].max(), name
    assert error.max() < 1e-9
    assert data["generalized_force"].values[-1] == pytest.approx(-disturbance[-1], abs=1e-6)


@pytest.mark.parametrize("name", ["paper", "postcapture"])
def test_the_published_estimate_is_the_default(name):
    """And it is equation (5): the last force, and the differentiated velocity, zero at the very
    first sample.
    """
    scenario = load_scenario(name)
    assert scenario.estimator.kind == "one_sample"
    estimator = make_estimator(make_mission(scenario), make_nominal_plant(scenario).coordinates)
    assert isinstance(estimator, OneSampleEstimator)
    assert list(estimator.initial_state()) == ["delayed_velocity"]
    rng = np.random.default_rng(0)
    e, e_dot, v, v_d, force, old = rng.normal(size=(6, 11))
    for is_first in (True, False):
        sample = sampled(v=v, v_d=v_d, e=e, e_dot=e_dot, applied_force=force, is_first=is_first)
        estimate, kept = estimator.step(sample, np.eye(11), {"delayed_velocity": old})
        assert estimate.e is e
        assert estimate.e_dot is e_dot
        assert np.array_equal(estimate.base_force, force)
        assert estimate.base_acceleration == pytest.approx(
            (0 if is_first else 1) * (v - old) / 0.01, rel=1e-14
        )
        assert np.array_equal(kept["delayed_velocity"], v)


def test_settings_of_kalman_do_not_touch_the_published_run(run):
    plain = run("postcapture", "duration=1")
    other = run("postcapture", "duration=1", "estimator.walk=7", "estimator.position_noise=3")
    for name in ("position", "velocity", "generalized_force"):
        assert np.array_equal(plain.dataset[name], other.dataset[name]), name


def heavier(mass, inertia):
    return f"payload.nominal.mass={mass}", (
        f"payload.nominal.inertia=[{inertia}, {inertia}, {inertia}]"
    )


@pytest.mark.slow
@pytest.mark.parametrize("controller", ["tdc", "tde_aismc"])
def test_an_over_estimated_payload_is_flown_with_kalman_and_flight_gains(run, controller):
    published = run("postcapture", f"controller={controller}", *heavier(150, 25))
    assert published.outcome.status == "diverged"
    record = run(
        "postcapture", *heavier(150, 25), *FLIGHT_GAINS, "estimator.kind=kalman", FLIGHT[5]
    )
    assert record.outcome.completed
    assert max(record.metrics["peak_error"].values()) < 2e-5
    assert max(record.metrics["final_error"].values()) < 5e-6


def test_where_no_gain_helps_one_sample_a_slower_estimate_does(run):
    """Twice the inertia: eta > 2, and one sample alone is a growing oscillation."""
    setting = ("postcapture", *heavier(250, 42), *FLIGHT_GAINS)
    assert run(*setting).outcome.status == "diverged"
    record = run(*setting, *FLIGHT_FILTER, "duration=10")
    assert record.outcome.completed
    assert max(record.metrics["peak_error"].values()) < 3e-4
    assert max(record.metrics["peak_effort"].values()) < 10


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        (
            "estimator.kind=foo",
            "estimator.kind: 'foo' is unknown; choose one of one_sample, kalman",
        ),
        ("estimator.walk=0", "estimator.walk.all: must be > 0, not 0"),
        ("estimator.walk.joint_1=-1", "estimator.walk.joint_1: must be > 0, not -1"),
        (
            "estimator.walk={base_rotation: 1, joints: 1}",
            "estimator.walk: gives no value for base_position_x",
        ),
        ("estimator.walk.elbow=1", "estimator.walk.elbow: unknown coordinate; valid here: all"),
        (
            "estimator.velocity_noise={elbow: 1}",
            "estimator.velocity_noise.elbow: unknown coordinate",
        ),
        (
            "estimator.velocity_bias_walk.joint_1=-1",
            "velocity_bias_walk.joint_1: must be >= 0",
        ),
        (
            "estimator.velocity_bias_walk.elbow=1",
            "estimator.velocity_bias_walk.elbow: unknown coordinate",
        ),
        (
            "sensing.position_delay.joints=500",
            "estimator: has no stationary filter (a common period of 1 sample and 504",
        ),
        ("estimator.force_walk=0", "estimator.force_walk.all: must be > 0, not 0"),
        (
            "estimator={kind: coupled, velocity_noise: {base_rotation_x: 1, all: 2}}",
            "estimator.kind: coupled needs one noise and walk for the base's three axes",
        ),
        ("estimator.position_noise=-1", "--set estimator.position_noise.all: must be >= 0"),
        ("estimator.velocity_noise.joint_1=-1", "estimator.velocity_noise.joint_1: must be >= 0"),
        ("sensing.velocity_noise.foo=1", "sensing.velocity_noise.foo: unknown coordinate"),
        ("estimator.delay=-1", "estimator.delay: must be from 0 to 1000 control samples, not -1"),
    ],
)
def test_errors_are_one_clear_line(override, expected):
    assert_refused(expected, "flight_sensors", override)


@pytest.mark.parametrize(
    ("position", "velocity"), [(1e-3, 0.0), (0.0, 1e-3), (0.0, 0.0), (1e-3, 1e-12), (1.0, 1e-9)]
)
def test_gain_exists_for_exact_measurements(position, velocity):
    for walk in (1e-6, 1e-3, 1e2):
        gain = kalman_gain(
            position_noise=position, velocity_noise=velocity, walk=walk, sample_time=0.01
        )
        assert np.isfinite(gain).all()


@pytest.mark.parametrize("seed", range(20))
def test_no_filter_alternates_with_exact_positions(seed):
    """Held accelerations move sampled positions with a zero at -1, which is no pole of a filter."""
    rng = np.random.default_rng(seed)
    position, velocity, walk = 10.0 ** rng.uniform([-14, -9, -4], [-7, -2, 1])
    step = 10.0 ** rng.uniform(-3, -1)
    one = {"velocity_noise": velocity, "walk": walk, "sample_time": step}
    for given in (0.0, position):
        found = poles(kalman_gain(position_noise=given, **one), step)
        assert found.real.min() > -0.75
        assert np.abs(found).max() < 1.0


@pytest.mark.parametrize("kind", ["kalman", "coupled"])
def test_a_loop_with_exact_positions_is_stable(kind):
    """As the paper's, whose positions are exact; the nominal payload is lighter than the true."""
    scenario = load_scenario("postcapture", [f"estimator.kind={kind}"])
    assert not scenario.sensing.position_noise["all"]
    with Linearizer(scenario) as linearizer:
        assert max(each.spectral_radius for each in linearizer.along((0.0, 1.0))) < 0.995
