"""What the actuators make of the commanded force, what the plant gets of it, and that the estimate
knows.
"""

import dataclasses

import flight_settings
import numpy as np
import pytest
from balances import assert_momentum_follows
from pydrake.systems.framework import DiagramBuilder
from refusals import assert_refused

from ffsm_drake import make_closed_loop, make_nominal_plant, simulate
from ffsm_drake.mission import make_mission
from ffsm_drake.runs.metrics import momentum_residual
from ffsm_drake.spacecraft.coordinates import error_rate, position_error
from ffsm_drake.systems.controllers import Sample, SampledController, gain_vectors
from ffsm_drake.systems.controllers.estimation import make_estimator
from ffsm_drake.systems.controllers.laws.tdc import Tdc
from ffsm_drake.systems.quantization import quantize

FLIGHT = (
    *flight_settings.FLIGHT,
    "sensing.position_noise={base_position: 1e-3, base_rotation: 5e-5, joints: 1e-5}",
    "sensing.velocity_noise={base_position: 1e-3, base_rotation: 1.5e-5, joints: 1e-4}",
)
# What binds for a while on the way: the plan asks the base for up to 3.4 N.
TIGHT = "actuation.limit={base_position: 3, base_rotation: 10, joints: 50}"
SHORT = (*FLIGHT, "duration=4")
QUIET = ("sensing.velocity_noise=1e-6", "sensing.position_noise=0")


def forces(record):
    return record.dataset["generalized_force"].values, record.dataset["applied_force"].values


def limits(record):
    return make_nominal_plant(record.scenario).coordinates.vector(
        record.scenario.actuation.limit, key=""
    )


def assert_the_plant_got_the_applied_force(record):
    assert_momentum_follows(record.dataset, 1e-7)
    commanded = record.dataset.assign(applied_force=record.dataset["generalized_force"])
    assert np.linalg.norm(momentum_residual(commanded)["linear"], axis=1).max() > 1e-4


def test_by_default_the_applied_force_is_the_commanded(run):
    record = run("postcapture", "duration=1")
    commanded, applied = forces(record)
    assert np.array_equal(applied, commanded)
    assert "actuation" not in make_closed_loop(record.scenario).blocks


def test_saturation(run):
    record = run(*FLIGHT, *QUIET, TIGHT, "estimator.kind=kalman")
    commanded, applied = forces(record)
    limit = limits(record)
    assert np.array_equal(applied, np.clip(commanded, -limit, limit))
    beyond = np.abs(commanded[:, 3:6]) > 3
    assert beyond.sum() > 500
    assert (commanded[:, 3:6][beyond] > 0).any()
    assert (commanded[:, 3:6][beyond] < 0).any()
    assert_the_plant_got_the_applied_force(record)


def test_a_limit_on_some_coordinates_leaves_the_others(run):
    record = run("postcapture", "duration=4", "actuation.limit={base_position_y: 2}")
    commanded, applied = forces(record)
    assert np.array_equal(applied[:, 4], np.clip(commanded[:, 4], -2, 2))
    assert np.abs(commanded[:, 4]).max() > 2
    others = np.arange(11) != 4
    assert np.array_equal(applied[:, others], commanded[:, others])


def test_quantization(run):
    record = run(*SHORT, "actuation.quantization={base_position: 0.1, joints: 0.02}")
    commanded, applied = forces(record)
    step = np.array([0.1] * 3 + [0.02] * 5)
    assert applied[:, 3:] / step == pytest.approx(np.round(applied[:, 3:] / step), abs=1e-9)
    assert np.abs(applied[:, 3:] - commanded[:, 3:]).max() <= 0.05 + 1e-12
    assert (np.abs(applied[:, 3:] - commanded[:, 3:]).max(axis=0) > 0.4 * step).all()
    assert np.array_equal(applied[:, :3], commanded[:, :3])
    assert_the_plant_got_the_applied_force(record)


@pytest.mark.parametrize("delay", [1, 2])
def test_delay_is_whole_samples(run, delay):
    record = run(*SHORT, f"actuation.delay={delay}")
    commanded, applied = forces(record)
    assert np.array_equal(applied[delay:], commanded[:-delay])
    assert not applied[:delay].any()
    assert commanded[0].all()
    assert_the_plant_got_the_applied_force(record)


def test_saturation_then_quantization_then_delay(run):
    """3.04 N in steps of 0.1 N: clipped first it is 3.0 N; rounded first, 3.04 N would be left."""
    record = run(
        *FLIGHT,
        "actuation.limit={base_position: 3.04, base_rotation: 10, joints: 50}",
        "actuation.quantization=0.1",
        "actuation.delay=2",
        "duration=5",  # the plan asks for most at 4.2 s
    )
    commanded, applied = forces(record)
    limit = limits(record)
    expected = quantize(np.clip(commanded, -limit, limit), np.full(11, 0.1))
    assert np.array_equal(applied[2:], expected[:-2])
    assert not applied[:2].any()
    assert np.abs(applied[:, 3:6]).max() == pytest.approx(3.0, abs=1e-12)
    assert np.abs(commanded[:, 3:6]).max() > 3.1
    assert_the_plant_got_the_applied_force(record)


def without_feedback(setup):
    """TDC without the port for the applied force."""
    builder = DiagramBuilder()
    law = Tdc.from_setup(dataclasses.replace(setup, settings=setup.scenario.controllers["tdc"]))
    inner = builder.AddSystem(
        SampledController(
            law, name="tdc", coordinates=setup.coordinates, sample_time=setup.sample_time
        )
    )
    for name in ("estimated_state", "desired_state", "desired_acceleration"):
        builder.ExportInput(inner.GetInputPort(name), name)
    builder.ExportOutput(inner.GetOutputPort("generalized_force"), "generalized_force")
    return builder.Build()


def replay(record, *, applied):
    """N and the commands (n, nv), from the record's measurements and the force that the controller
    takes to have acted.

    By the scenario's estimator as a pure function, and TDC.
    """
    data, scenario = record.dataset, record.scenario
    nominal = make_nominal_plant(scenario)
    gains = gain_vectors(dataclasses.replace(scenario, controller="tdc"), nominal.coordinates)
    estimator = make_estimator(make_mission(scenario), nominal.coordinates)
    state = estimator.initial_state()
    names = (
        "measured_position",
        "measured_velocity",
        "desired_position",
        "desired_velocity",
        "desired_acceleration",
    )
    n, commands = [], []
    for k, (q, v, q_d, v_d, a_d) in enumerate(
        zip(*(data[name].values for name in names), strict=True)
    ):
        mass_matrix = nominal.calc_mass_matrix(q)
        e, before = position_error(q_d, q), applied[k - 1] if k else np.zeros(v.size)
        sample = Sample(q, v, q_d, v_d, a_d, e, error_rate(e, v_d, v), before, k == 0)
        estimate, state = estimator.step(sample, mass_matrix, state)
        n.append(estimate.base_acceleration - np.linalg.solve(mass_matrix, estimate.base_force))
        u = a_d + gains["k_d"] * estimate.e_dot + gains["k_p"] * estimate.e
        commands.append(mass_matrix @ (u - n[-1]))
    return np.array(n), np.array(commands)


@pytest.mark.parametrize("kind", ["kalman", pytest.param("one_sample", marks=pytest.mark.slow)])
def test_a_limit_that_binds_for_a_while_does_not_wind_up_the_estimate(run, kind):
    fed = run(*FLIGHT, *QUIET, TIGHT, f"estimator.kind={kind}")
    blind = simulate(fed.scenario, blocks={"controller": without_feedback}, check_stability=False)
    assert fed.outcome.completed
    assert fed.metrics["peak_error"]["base_position"] < 0.01
    assert fed.metrics["final_error"]["base_position"] < 2e-4
    assert (
        blind.metrics["peak_error"]["base_position"]
        > 5 * fed.metrics["peak_error"]["base_position"]
    )
    assert (
        blind.metrics["final_error"]["base_position"]
        > 100 * fed.metrics["final_error"]["base_position"]
    )
    # Blind, what the limit withheld is taken for an uncertainty.
    n_fed, _ = replay(fed, applied=forces(fed)[1])
    n_blind, commands = replay(blind, applied=forces(blind)[0])
    assert commands == pytest.approx(forces(blind)[0], rel=1e-6, abs=1e-6)  # so it ran blind
    assert np.abs(n_fed[:, 3:6]).max() < 0.01
    assert np.abs(n_blind[:, 3:6]).max() > 20 * np.abs(n_fed[:, 3:6]).max()


@pytest.mark.parametrize(
    ("kind", "override"),
    [
        ("kalman", TIGHT),
        ("kalman", "actuation.delay=2"),
        ("kalman", "actuation.quantization=0.1"),
        ("kalman", "actuation.thrusters.layout=16x22N"),
        ("one_sample", "actuation.delay=2"),
    ],
)
def test_the_estimate_is_fed_the_applied_force(run, kind, override):
    """With the applied force the pure functions give the recorded commands; with the commanded they
    do not.
    """
    record = run(*FLIGHT, *QUIET, "duration=5", f"estimator.kind={kind}", override)
    commanded, applied = forces(record)
    assert np.abs(commanded - applied).max() > 1e-3
    assert replay(record, applied=applied)[1] == pytest.approx(commanded, rel=1e-6, abs=1e-8)
    assert np.abs(replay(record, applied=commanded)[1] - commanded).max() > 1e-3


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("actuation.limit=0", "actuation.limit.all: must be > 0, not 0"),
        ("actuation.limit.joint_1=-2", "actuation.limit.joint_1: must be > 0, not -2"),
        ("actuation.limit.elbow=1", "actuation.limit.elbow: unknown coordinate; valid here: all"),
        (
            "actuation.quantization=-0.1",
            "actuation.quantization.all: must be >= 0, not -0.1",
        ),
        ("actuation.quantization.elbow=1", "actuation.quantization.elbow: unknown coordinate"),
        ("actuation.delay=-1", "actuation.delay: must be from 0 to 1000 control samples, not -1"),
    ],
)
@pytest.mark.smoke
def test_errors_are_one_clear_line(override, expected):
    assert_refused(expected, "postcapture", override)
