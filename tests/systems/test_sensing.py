"""What the sensors make of the true state: each stage alone, their order, and what is refused."""

import numpy as np
import pytest
from flight_settings import FLIGHT, NO_NOISE
from pydrake.common.eigen_geometry import AngleAxis, Quaternion
from pydrake.math import RotationMatrix

from ffsm_drake import ScenarioError, load_scenario, make_closed_loop
from ffsm_drake.spacecraft.coordinates import position_error
from ffsm_drake.systems.sensing import quantize

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
    assert {system.get_name() for system in sensing.GetSystems()} == {"white", "standard_deviation", "noisy"}
    every = ["position_bias=1e-3", "velocity_quantization=1e-3", "delay=1"]
    sensing = make_closed_loop(load_scenario(name, [f"sensing.{one}" for one in every])).blocks["sensing"]
    added = {system.get_name() for system in sensing.GetSystems()} - {"white", "standard_deviation", "noisy"}
    assert added == {"attitude_bias", "bias", "biased", "quantizer", "delay"}


def test_without_noise_the_measurement_is_the_state(run):
    q, v, q_m, v_m = values(run(*SHORT, *NO_NOISE), "position", "velocity", "measured_position", "measured_velocity")
    assert np.array_equal(q_m, q)
    assert np.array_equal(v_m, v)


def test_bias_is_added_to_positions_and_velocities(run):
    bias = ("sensing.position_bias={base_position: 1e-3, joint_2: -2e-3}",
            "sensing.velocity_bias={base_rotation: 1e-4, base_position_z: 3e-4, joints: 2e-4}")  # fmt: skip
    record = run(*SHORT, *NO_NOISE, *bias)
    q, v, q_m, v_m = values(record, "position", "velocity", "measured_position", "measured_velocity")
    offset = np.array([0, 0, 0, 0, 1e-3, 1e-3, 1e-3, 0, -2e-3, 0, 0, 0])
    assert q_m - q == pytest.approx(np.tile(offset, (len(q), 1)), abs=1e-14)
    offset = np.array([1e-4] * 3 + [0, 0, 3e-4] + [2e-4] * 5)
    assert v_m - v == pytest.approx(np.tile(offset, (len(v), 1)), abs=1e-14)


def test_attitude_bias_is_a_rotation_vector_in_the_world(run):
    """R_measured = exp(bias) R, exactly; on the body's side it would differ by a tenth of the bias here."""
    bias = np.array([0.02, -0.01, 0.03])
    record = run(*SHORT, *NO_NOISE, f"sensing.position_bias={dict(zip(ROTATIONS, bias.tolist(), strict=True))}")
    q, q_m, v, v_m = values(record, "position", "measured_position", "velocity", "measured_velocity")
    angle = float(np.linalg.norm(bias))
    turn = RotationMatrix(AngleAxis(angle, bias / angle)).matrix()
    for true, measured in zip(q, q_m, strict=True):
        assert rotation(measured[:4]) == pytest.approx(turn @ rotation(true[:4]), abs=1e-13)
        assert position_error(measured, true)[:3] == pytest.approx(bias, abs=1e-13)
    assert np.linalg.norm(q_m[:, :4], axis=1) == pytest.approx(np.ones(len(q)), abs=1e-9)
    body = rotation(q[0, :4]) @ turn
    assert np.abs(rotation(q_m[0, :4]) - body).max() > 1e-3
    assert np.array_equal(q_m[:, 4:], q[:, 4:])
    assert np.array_equal(v_m, v)


def test_the_spacecraft_goes_where_its_biased_sensors_are_content(run):
    """The true error settles at the bias, which so enters the loop with the right sign."""
    bias = "sensing.position_bias={base_position: 1e-3, base_rotation_x: 2e-3, joint_3: -4e-3}"
    record = run(*FLIGHT, "reference.duration=5", "duration=20", "disturbance.frequency_scale=0", *NO_NOISE, bias)
    expected = [2e-3, 0, 0, 1e-3, 1e-3, 1e-3, 0, 0, -4e-3, 0, 0]
    assert record.dataset["error"].values[-1] == pytest.approx(expected, abs=1e-5)


def test_quantization(run):
    """Multiples of the step, and what is rounded away is uniform."""
    steps = ("sensing.position_quantization={base_position: 2e-5, joints: 1e-5}",
             "sensing.velocity_quantization={base_position: 3e-6, base_rotation: 1e-6, joints: 5e-6}")  # fmt: skip
    record = run(*FLIGHT, *NO_NOISE, *steps, "reference.duration=10", "duration=10")
    q, v, q_m, v_m = values(record, "position", "velocity", "measured_position", "measured_velocity")
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
    assert np.array_equal(q_m[:, :4], q[:, :4])


@pytest.mark.parametrize("delay", [1, 3])
def test_delay_is_whole_samples(run, delay):
    """Measured at t_k is the state at t_(k-d); before the start the spacecraft was where it is at first."""
    record = run(*SHORT, *NO_NOISE, f"sensing.delay={delay}")
    for name in ("position", "velocity"):
        true, measured = values(record, name, f"measured_{name}")
        assert np.array_equal(measured[delay:], true[:-delay]), name
        assert np.array_equal(measured[:delay], np.tile(true[0], (delay, 1))), name
        assert not np.array_equal(measured[delay:], true[delay:])
    assert np.array_equal(record.dataset["measured_position"][0], record.dataset["position"][0])


def test_noise_by_group_as_in_flight(run):
    record = run(*FLIGHT, *NOISE, "duration=12")
    q, v, q_m, v_m = values(record, "position", "velocity", "measured_position", "measured_velocity")
    velocity = vector(record, base_position=1e-3, base_rotation=1.5e-5, joints=1e-4)
    assert (v_m - v).std(axis=0) == pytest.approx(velocity, rel=0.08)
    position = vector(record, base_position=1e-3, base_rotation=5e-5, joints=1e-5)
    errors = np.array([position_error(measured, true) for measured, true in zip(q_m, q, strict=True)])
    assert errors.std(axis=0) == pytest.approx(position, rel=0.08)
    assert (np.abs(errors.mean(axis=0)) < 4 * position / np.sqrt(len(q))).all()
    assert np.abs(np.corrcoef(errors.T) - np.eye(11)).max() < 0.12


def test_order_of_the_stages(run):
    """Bias and noise before the quantiser, which leaves multiples; the delay last, so that it delays the noise too."""
    quantization = ("sensing.velocity_quantization={base_position: 5e-4, joints: 5e-5}",
                    "sensing.position_quantization={base_position: 5e-4}")  # fmt: skip
    bias = ("sensing.velocity_bias={base_position: 2e-4, joints: -2e-5}", "sensing.position_bias.base_position=2e-4")
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
    q, v, q_m, v_m = values(record, "position", "velocity", "measured_position", "measured_velocity")
    # The same seed gives the same noise.
    before = v + vector(record, base_position=2e-4, joints=-2e-5) + noise[0]
    expected = quantize(before, vector(record, base_position=5e-4, joints=5e-5))
    assert v_m[2:] == pytest.approx(expected[:-2], abs=1e-12)
    before = q[:, 4:7] + 2e-4 + noise[1][:, 4:7]
    assert q_m[2:, 4:7] == pytest.approx(quantize(before, np.full(3, 5e-4))[:-2], abs=1e-12)
    for measured, step in ((v_m[:, 3:6], 5e-4), (v_m[:, 6:], 5e-5), (q_m[2:, 4:7], 5e-4)):
        assert measured / step == pytest.approx(np.round(measured / step), abs=1e-9)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("sensing.position_quantization=1e-6", "sensing.position_quantization: base_rotation has no scale"),
        (
            "sensing.position_quantization={base_rotation_y: 1e-6}",
            "sensing.position_quantization: base_rotation has no scale",
        ),
        ("sensing.velocity_quantization=-1", "sensing.velocity_quantization.all: must be >= 0 (0: none), not -1"),
        (
            "sensing.position_quantization.joints=-1e-6",
            "sensing.position_quantization.joints: must be >= 0 (0: none), not -1e-06",
        ),
        ("sensing.delay=-1", "sensing.delay: must be from 0 to 1000 control samples, not -1"),
        ("sensing.delay=1001", "sensing.delay: must be from 0 to 1000 control samples, not 1001"),
        ("sensing.delay=0.5", "sensing.delay: must be a whole number"),
        ("sensing.position_noise.base_rotation_x=1", "sensing.position_noise: must be the same for the three"),
        ("sensing.velocity_bias.elbow=1", "sensing.velocity_bias.elbow: unknown coordinate"),
    ],
)
def test_errors_are_one_clear_line(override, expected):
    with pytest.raises(ScenarioError) as error:
        make_closed_loop(load_scenario("postcapture", [override]))
    assert expected in str(error.value)
    assert "\n" not in str(error.value)
