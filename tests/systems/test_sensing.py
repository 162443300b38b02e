"""What the sensors make of the true state: each stage alone, their order, and what is refused."""

import numpy as np
import pytest
from flight_settings import FLIGHT, NO_NOISE
from pydrake.common import RandomGenerator
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.systems.analysis import Simulator
from scipy.spatial.transform import Rotation

from ffsm_drake import ScenarioError, load_scenario, make_closed_loop, make_nominal_plant
from ffsm_drake.spacecraft.coordinates import position_error
from ffsm_drake.systems.quantization import quantize
from ffsm_drake.systems.sensing.part import Sensing

# Of the shipped scenario.
NOISE = (
    "sensing.position_noise={base_position: 1e-3, base_rotation: 5e-5, joints: 1e-5}",
    "sensing.velocity_noise={base_position: 1e-3, base_rotation: 1.5e-5, joints: 1e-4}",
)
SHORT = (*FLIGHT, "duration=1.5")
ROTATIONS = ("base_rotation_x", "base_rotation_y", "base_rotation_z")


def values(record, *names):
    return [record.dataset[name].values for name in names]


def vector(record, **by_group):
    """(nv) in the record's order."""
    return np.array([by_group.get(group, 0.0) for group in record.dataset["group"].values.tolist()])


def rotation(quaternion):
    return RotationMatrix(Quaternion(quaternion / np.linalg.norm(quaternion))).matrix()


@pytest.mark.smoke
def test_quantize():
    step = np.array([0.1, 0.1, 0.1, 2.0, 0.0, 0.5])
    given = np.array([0.26, -0.26, 0.04, 3.1, 0.123456789, -0.76])
    result = quantize(given, step)
    assert result == pytest.approx([0.3, -0.3, 0.0, 4.0, 0.123456789, -1.0], abs=1e-15)
    assert result[4] == given[4]
    assert np.array_equal(quantize(result, step), result)
    assert given[0] == 0.26  # not in place
    many = np.random.default_rng(0).uniform(-3, 3, (1000, 6))
    distance = np.abs(quantize(many, step) - many)
    assert (distance <= step / 2 + 1e-15).all()
    assert (distance.max(axis=0)[:4] > 0.49 * step[:4]).all()
    assert np.array_equal(quantize(-many, step), -quantize(many, step))


@pytest.mark.parametrize("name", ["paper", "postcapture"])
def test_by_default_there_is_noise_and_nothing_else(name):
    sensing = make_closed_loop(load_scenario(name)).blocks["sensing"]
    assert [stage.get_name() for stage in sensing.GetSystems()] == ["white_noise", "noisy"]
    every = ["position_bias=1e-3", "velocity_quantization=1e-3", "delay=1"]
    sensing = make_closed_loop(load_scenario(name, [f"sensing.{one}" for one in every])).blocks[
        "sensing"
    ]
    stages = ["white_noise", "sensors"]
    assert [stage.get_name() for stage in sensing.GetSystems()] == stages


@pytest.mark.smoke
def test_without_noise_the_measurement_is_the_state(run):
    q, v, q_m, v_m = values(
        run(*SHORT, *NO_NOISE), "position", "velocity", "measured_position", "measured_velocity"
    )
    assert np.array_equal(q_m, q)
    assert np.array_equal(v_m, v)


def in_base(record, name):
    """A position (n, nq) or velocity (n, nv) with the base's vectors in the base's axes."""
    found = record.dataset[name].values.copy()
    turns = Rotation.from_quat(record.dataset["position"].values[:, [1, 2, 3, 0]]).inv()
    for start in (4,) if name.endswith("position") else (0, 3):
        found[:, start : start + 3] = turns.apply(found[:, start : start + 3])
    return found


@pytest.mark.parametrize("seed", range(3))
def test_errors_of_the_bases_sensors_turn_with_it(run, seed):
    """Through a drawn slew a bias stays in the axes of its sensor; joints have their own."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0.5, 2.5) * (axis := rng.normal(size=3)) / np.linalg.norm(axis)
    drawn = {"position": rng.normal(size=11), "velocity": rng.normal(size=11)}
    names = (
        *ROTATIONS,
        *(f"base_position_{axis}" for axis in "xyz"),
        *(f"joint_{i}" for i in range(1, 6)),
    )
    biases = [
        f"sensing.{part}_bias={dict(zip(names, (1e-3 * of).tolist(), strict=True))}"
        for part, of in drawn.items()
    ]
    rpy = Rotation.from_rotvec(turn).as_euler("xyz").tolist()
    record = run(*FLIGHT, *NO_NOISE, *biases, f"target_posture.base_rpy={rpy}",
                 "reference.base_rotation=eigenaxis", "reference.duration=4", "duration=4",
                 "actuation.limit={}")  # fmt: skip
    q, q_m = values(record, "position", "measured_position")
    slewed = Rotation.from_quat(q[[0, -1]][:, [1, 2, 3, 0]])
    assert (slewed[0].inv() * slewed[1]).magnitude() > 0.3
    off = in_base(record, "measured_velocity") - in_base(record, "velocity")
    assert off == pytest.approx(np.tile(1e-3 * drawn["velocity"], (len(q), 1)), abs=1e-13)
    off = in_base(record, "measured_position") - in_base(record, "position")
    assert off[:, 4:] == pytest.approx(
        np.tile(1e-3 * drawn["position"][3:], (len(q), 1)), abs=1e-13
    )
    true, measured = (Rotation.from_quat(each[:, [1, 2, 3, 0]]) for each in (q, q_m))
    tilt = (true.inv() * measured).as_rotvec()
    assert tilt == pytest.approx(np.tile(1e-3 * drawn["position"][:3], (len(q), 1)), abs=1e-12)


@pytest.mark.slow
def test_the_spacecraft_goes_where_its_biased_sensors_are_content(run):
    """The true error settles at the bias, which so enters the loop with the right sign."""
    bias = "sensing.position_bias={base_position: 1e-3, base_rotation_x: 2e-3, joint_3: -4e-3}"
    record = run(
        *FLIGHT,
        "reference.duration=5",
        "duration=20",
        "disturbance.frequency_scale=0",
        *NO_NOISE,
        bias,
    )
    expected = [2e-3, 0, 0, 1e-3, 1e-3, 1e-3, 0, 0, -4e-3, 0, 0]
    assert record.dataset["error"].values[-1] == pytest.approx(expected, abs=1e-5)


KINDS_IN_BASE = {
    "walk": ["velocity_bias_walk={all: 1e-2}"],
    "correlated": ["velocity_correlated_noise=1e-2", "position_correlated_noise=1e-2"],
    "quantised": ["velocity_quantization=0.3", "position_quantization.base_position=0.2"],
    "noise of one axis": ["velocity_noise={all: 0, base_rotation_z: 0.1, base_position_x: 0.1}"],
    "bias": ["velocity_bias=0.1", "position_bias={base_rotation_x: 0.2, base_position_y: 1}"],
    "all, late": ["velocity_bias_walk=1e-2", "velocity_quantization=0.01", "position_bias=0.1",
                  "velocity_noise.base_rotation_x=0.1", "velocity_delay=2"],
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS_IN_BASE)
def test_a_turned_spacecraft_measures_the_same_in_its_axes(kind):
    """Errors of its sensors turn with it, whatever their kind; the same seed has the same draws."""
    scenario = load_scenario(
        "postcapture", [*NO_NOISE, *(f"sensing.{o}" for o in KINDS_IN_BASE[kind])]
    )
    coordinates = make_nominal_plant(scenario).coordinates
    sensing = Sensing(scenario.sensing, coordinates, sample_time=0.01)
    rng, nv = np.random.default_rng(1), len(coordinates.names)
    vectors, joints = rng.normal(size=(3, 3)), rng.normal(size=(2, nv - 6))

    def measured(attitude):
        """In its axes, after three samples: rotation from the true base, then p, w, v."""
        p, w, v = attitude.apply(vectors)
        state = np.concatenate([attitude.as_quat()[[3, 0, 1, 2]], p, joints[0], w, v, joints[1]])
        context = sensing.CreateDefaultContext()
        sensing.SetRandomContext(context, RandomGenerator(3))
        for system in sensing.GetSystems():
            if hasattr(system, "set_initial_state"):
                system.set_initial_state(sensing.GetMutableSubsystemContext(system, context), state)
        sensing.GetInputPort("state").FixValue(context, state)
        simulator = Simulator(sensing, context)
        simulator.AdvanceTo(0.035)
        found = sensing.GetOutputPort("estimated_state").Eval(context)
        assert not np.allclose(found, state, atol=1e-5)
        turn = attitude.inv() * Rotation.from_quat(found[[1, 2, 3, 0]])
        places = np.array([[4], [nv + 1], [nv + 4]]) + np.arange(3)
        return np.vstack([turn.as_rotvec(), attitude.inv().apply(found[places])])

    expected = measured(Rotation.identity())
    for seed in range(3):
        assert measured(Rotation.random(random_state=seed)) == pytest.approx(expected, abs=1e-12)


@pytest.mark.slow
def test_quantization(run):
    """Multiples of the step, and what is rounded away is uniform."""
    steps = (
        "sensing.position_quantization={base_position: 2e-5, joints: 1e-5}",
        "sensing.velocity_quantization={base_position: 3e-6, base_rotation: 1e-6, joints: 5e-6}",
    )
    record = run(*FLIGHT, *NO_NOISE, *steps, "reference.duration=10", "duration=10")
    names = ("position", "velocity", "measured_position", "measured_velocity")
    q, v, q_m, v_m = (in_base(record, name) for name in names)
    for true, measured, step in (
        (q[:, 4:], q_m[:, 4:], vector(record, base_position=2e-5, joints=1e-5)[3:]),
        (v, v_m, vector(record, base_position=3e-6, base_rotation=1e-6, joints=5e-6)),
    ):
        assert measured / step == pytest.approx(np.round(measured / step), abs=1e-6)
        lost = (measured - true) / step
        assert np.abs(lost).max() <= 0.5 + 1e-9
        moving = lost[50:-150]  # near both ends it is slower than a step per sample
        assert moving.std(axis=0) == pytest.approx(np.full(step.size, 1 / np.sqrt(12)), rel=0.08)
        assert np.abs(moving.mean(axis=0)).max() < 0.05
    assert q_m[:, :4] == pytest.approx(q[:, :4], abs=1e-15)


# Of positions, then velocities: period and delay by group, control samples.
SLOW = {
    "position": {"base_rotation": (5, 5), "base_position": (7, 0), "joints": (4, 9)},
    "velocity": {"base_rotation": (1, 2), "base_position": (10, 3), "joints": (1, 0)},
}


def slow_sensors():
    return [
        f"sensing.{part}_{name}={{{', '.join(f'{group}: {of[group][i]}' for group in of)}}}"
        for part, of in SLOW.items()
        for i, name in enumerate(("period", "delay"))
    ]


def test_slow_and_late_sensors_by_group(run):
    """At t_k the measurement of p floor((k - d) / p) is read, with the delays of all and of the
    group in d; before the start the spacecraft was where it is first.
    """
    record = run(*SHORT, *NO_NOISE, *slow_sensors(), "sensing.delay=2")
    samples, groups = np.arange(record.dataset.sizes["time"]), record.dataset["group"].values
    for part, of in SLOW.items():
        true, measured = values(record, part, f"measured_{part}")
        if part == "position":
            attitude, true, measured = (true[:, :4], measured[:, :4]), true[:, 1:], measured[:, 1:]
        for group, (period, own) in of.items():
            shown = np.maximum(period * ((samples - own - 2) // period), 0)
            columns = groups == group
            assert np.array_equal(measured[:, columns], true[shown][:, columns]), (part, group)
            if part == "position" and group == "base_rotation":
                assert np.array_equal(attitude[1], attitude[0][shown])


def test_a_measurement_says_whether_it_is_new():
    """And the block has no such port where all are."""
    scenario = load_scenario("postcapture", slow_sensors())
    loop = make_closed_loop(scenario)
    sensing, context = loop.blocks["sensing"], loop.blocks["sensing"].CreateDefaultContext()
    sensing.GetInputPort("state").FixValue(context, np.eye(2 * len(loop.coordinates.names) + 1)[0])
    port, groups = sensing.GetOutputPort("measurement_is_new"), loop.coordinates.groups
    for sample in range(45):
        context.SetTime(sample * scenario.sample_time)
        is_new = port.Eval(context)[1:].reshape(2, -1)
        for of, new in zip(SLOW.values(), is_new, strict=True):
            for group, (period, delay) in of.items():
                assert (new[groups[group]] == ((sample - delay) % period == 0)).all(), (
                    sample,
                    group,
                )
    for plain in (["sensing.delay=3"], []):
        sensing = make_closed_loop(load_scenario("postcapture", plain)).blocks["sensing"]
        assert not sensing.HasOutputPort("measurement_is_new")


def noise_of(overrides, *, samples, seed=0):
    """What the sensors add to a state at rest, with no white noise: (samples, nq + nv)."""
    scenario = load_scenario("postcapture", [*NO_NOISE, *overrides])
    coordinates = make_nominal_plant(scenario).coordinates
    sensing = Sensing(scenario.sensing, coordinates, sample_time=0.01)
    context = sensing.CreateDefaultContext()
    sensing.SetRandomContext(context, RandomGenerator(seed))
    state = np.zeros(2 * len(coordinates.names) + 1)
    state[0] = 1.0
    sensing.GetInputPort("state").FixValue(context, state)
    simulator = Simulator(sensing, context)
    simulator.Initialize()
    found = []
    for sample in range(samples):
        if sample:
            simulator.AdvanceTo(0.01 * sample)
        found.append(sensing.GetOutputPort("estimated_state").Eval(context) - state)
    return np.array(found)


def test_noise_with_memory():
    """First-order Gauss-Markov noise of its deviation and time constant; the same seed gives the
    same bits.
    """
    given = ["sensing.velocity_correlated_noise={all: 2e-3, joints: 0}",
             "sensing.position_correlated_noise={base_rotation: 4e-3}",
             "sensing.correlation_time={all: 0.05, base_rotation: 0.1}"]  # fmt: skip
    noise = noise_of(given, samples=6000)
    assert np.array_equal(noise[:50], noise_of(given, samples=50))
    assert not np.array_equal(noise[:50], noise_of(given, samples=50, seed=1))
    for part, sigma, tau in (
        (slice(0, 4), 2e-3, 0.1),
        (slice(12, 15), 2e-3, 0.1),
        (slice(15, 18), 2e-3, 0.05),
    ):
        of = noise[:, part]
        assert of.std() == pytest.approx(sigma, rel=0.1)  # of the quaternion half the angle's
        for lag in (2, 5, 10):
            correlation = (of[lag:] * of[:-lag]).mean() / (of**2).mean()
            assert correlation == pytest.approx(np.exp(-lag * 0.01 / tau), abs=0.08), (part, lag)
    assert not noise[:, 4:12].any()
    assert not noise[:, 18:].any()
    first = np.array([noise_of(given, samples=1, seed=seed)[0, 12:18] for seed in range(20)])
    assert first.std() == pytest.approx(2e-3, rel=0.2)  # from the start


def test_a_bias_walks():
    noise = noise_of(
        ["sensing.velocity_bias_walk={base_rotation: 3e-3}", "sensing.velocity_bias.joints=1"],
        samples=4000,
    )
    steps = np.diff(noise[:, 12:15], axis=0)
    assert not noise[0, 12:15].any()
    assert steps.std() == pytest.approx(3e-3 * np.sqrt(0.01), rel=0.05)
    assert abs((steps[1:] * steps[:-1]).mean()) < 0.05 * steps.var()
    assert (noise[:, 18:] == 1.0).all()


def test_noise_with_memory_leaves_the_white_noise_as_it_is(run):
    """And its seed's bits: what is added is added."""
    drift = "sensing.velocity_bias_walk.base_rotation=1e-9"
    plain, drifting = (run(*SHORT, *NOISE, *more) for more in ((), (drift,)))
    noise = [values(record, "measured_velocity", "velocity") for record in (plain, drifting)]
    assert noise[0][0] - noise[0][1] == pytest.approx(noise[1][0] - noise[1][1], abs=1e-8)


def test_noise_by_group_as_in_flight(run):
    record = run(*FLIGHT, *NOISE, "duration=12")
    q, v, q_m, v_m = values(
        record, "position", "velocity", "measured_position", "measured_velocity"
    )
    velocity = vector(record, base_position=1e-3, base_rotation=1.5e-5, joints=1e-4)
    assert (v_m - v).std(axis=0) == pytest.approx(velocity, rel=0.08)
    position = vector(record, base_position=1e-3, base_rotation=5e-5, joints=1e-5)
    errors = np.array(
        [position_error(measured, true) for measured, true in zip(q_m, q, strict=True)]
    )
    assert errors.std(axis=0) == pytest.approx(position, rel=0.08)
    assert (np.abs(errors.mean(axis=0)) < 4 * position / np.sqrt(len(q))).all()
    assert np.abs(np.corrcoef(errors.T) - np.eye(11)).max() < 0.12
    for each in (*errors.T, *(v_m - v).T):  # white
        assert abs(np.corrcoef(each[:-1], each[1:])[0, 1]) < 0.12


def test_order_of_the_stages(run):
    """Bias and noise before the quantiser, which leaves multiples; the delay last, so that it
    delays the noise too.
    """
    quantization = ("sensing.velocity_quantization={base_position: 5e-4, joints: 5e-5}",
                    "sensing.position_quantization={base_position: 5e-4}")  # fmt: skip
    bias = (
        "sensing.velocity_bias={base_position: 2e-4, joints: -2e-5}",
        "sensing.position_bias.base_position=2e-4",
    )
    plain = run(*SHORT, *NOISE)
    noise = [
        measured - true
        for measured, true in (
            values(plain, "measured_velocity", "velocity"),
            values(plain, "measured_position", "position"),
        )
    ]
    assert noise[0].std(axis=0)[3:6] == pytest.approx([1e-3] * 3, rel=0.3)
    record = run(*SHORT, *NOISE, *quantization, *bias, "sensing.delay=2")
    q, v, q_m, v_m = values(
        record, "position", "velocity", "measured_position", "measured_velocity"
    )
    to_world = Rotation.from_quat(q[:, [1, 2, 3, 0]])  # base's errors are in its axes
    # The same seed gives the same noise.
    for true, measured, off, columns in (
        (v + noise[0], v_m, (2e-4, 5e-4), slice(3, 6)),
        (q + noise[1], q_m, (2e-4, 5e-4), slice(4, 7)),
    ):
        before = to_world.inv().apply(true[:, columns]) + off[0]
        expected = quantize(before, np.full(3, off[1]))
        assert measured[2:, columns] == pytest.approx(to_world.apply(expected)[:-2], abs=1e-12)
    expected = quantize(v + vector(record, joints=-2e-5) + noise[0], vector(record, joints=5e-5))
    assert v_m[2:, 6:] == pytest.approx(expected[:-2, 6:], abs=1e-12)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        (
            "sensing.position_quantization=1e-6",
            "sensing.position_quantization: base_rotation has no scale",
        ),
        (
            "sensing.position_quantization={base_rotation_y: 1e-6}",
            "sensing.position_quantization: base_rotation has no scale",
        ),
        (
            "sensing.velocity_quantization=-1",
            "sensing.velocity_quantization.all: must be >= 0, not -1",
        ),
        (
            "sensing.position_quantization.joints=-1e-6",
            "sensing.position_quantization.joints: must be >= 0, not -1e-06",
        ),
        ("sensing.delay=-1", "sensing.delay: must be from 0 to 1000 control samples, not -1"),
        ("sensing.delay=1001", "sensing.delay: must be from 0 to 1000 control samples, not 1001"),
        ("sensing.delay=0.5", "sensing.delay: must be a whole number"),
        (
            "sensing.position_noise.base_rotation_x=1",
            "sensing.position_noise: must be the same for the three",
        ),
        ("sensing.velocity_bias.elbow=1", "sensing.velocity_bias.elbow: unknown coordinate"),
        (
            "sensing.velocity_period=0",
            "sensing.velocity_period.all: must be from 1 to 1000 control samples, not 0",
        ),
        (
            "sensing.position_delay.joints=2.5",
            "sensing.position_delay.joints: must be a whole number, not 2.5",
        ),
        (
            "sensing.position_period.base_rotation_x=2",
            "sensing.position_period: must be the same for the three base_rotation",
        ),
        (
            "sensing.velocity_delay={base_position_z: 2}",
            "sensing.velocity_delay: must be the same for the three base_position",
        ),
        ("sensing.position_delay.elbow=2", "sensing.position_delay.elbow: unknown coordinate"),
        ("tolerance.elbow=1", "tolerance.elbow: unknown coordinate"),
        ("sensing.correlation_time=0", "sensing.correlation_time.all: must be > 0 s, not 0"),
        (
            "sensing.velocity_correlated_noise=-1",
            "velocity_correlated_noise.all: must be >= 0",
        ),
        (
            "sensing.velocity_bias_walk.joints=-1",
            "velocity_bias_walk.joints: must be >= 0",
        ),
    ],
)
def test_errors_are_one_clear_line(override, expected):
    with pytest.raises(ScenarioError) as error:
        make_closed_loop(load_scenario("postcapture", [override]))
    assert expected in str(error.value)
    assert "\n" not in str(error.value)
