"""Fault detection: what breaks is noticed and isolated, what works is not, and looking costs no
bit.
"""

import dataclasses

import numpy as np
import pytest

from ffsm_drake import load_scenario, simulate
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.actuators.base import LOST
from ffsm_drake.plugins.actuators.row import make_base_actuators
from ffsm_drake.plugins.faults.detection import KINDS, Detector
from ffsm_drake.plugins.faults.windows import slope_weights
from ffsm_drake.runs.exceeded_limits import run_remarks
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import Grip
from ffsm_drake.spacecraft.coordinates import position_error
from ffsm_drake.spacecraft.craft import make_nominal_plant
from ffsm_drake.systems.sampled import Now
from ffsm_drake.systems.setup import BlockSetup

NAME, SENSORS = "thrusters_and_wheels", "flight_sensors"


def run(name, unit=None, kind=None, *overrides, time=0.8, duration=1.0):
    events = {} if unit is None else {"it": {"unit": unit, "kind": kind, "time": [time]}}
    faults = {"faults": {"detection": {}, "events": events}}
    return make_rollout(load_scenario(name, [f"duration={duration}", faults, *overrides])).run()


def noticed(log):
    """Unit -> kind, at the end."""
    (part,) = (each for name, each in log.parts.items() if name == "sensing.detection")
    codes = log.series["fault_detected"][-1].astype(int)
    names = part.signals[0].components
    return {name: KINDS[code] for name, code in zip(names, codes, strict=True) if code}


def test_looking_changes_no_bit():
    plain = make_rollout(load_scenario(NAME, ["duration=0.4"])).run()
    looked = run(NAME, duration=0.4)
    for name, values in plain.series.items():
        assert np.array_equal(values, looked.series[name]), name
    assert noticed(looked) == {}


@pytest.mark.parametrize(
    ("sensor", "kind"),
    [("base_rotation", "frozen"), ("joint_2", "silent"), ("base_position", "biased")],
)
def test_lost_positions(sensor, kind):
    log = run(SENSORS, f"sensing.{sensor}", kind)
    assert noticed(log) == {f"sensing.{sensor}": kind}
    nq = len(log.coordinates.position_names)
    error = position_error(log.series["measurement"][-1][:nq], log.series["state"][-1][:nq])
    assert np.abs(error).max() < 6e-3  # of the bias itself one measurement tells, with its noise


@pytest.mark.parametrize("sensor", ["base_position", "base_rotation"])
def test_a_bias_that_is_taken_off_turns_with_the_base(sensor):
    """It is found before a slew; in the world's axes it would be off by its own size after it."""
    slew = ("reference.base_rotation=eigenaxis", "reference.duration=3", "actuation.limit={}",
            "target_posture.base_rpy=[-1.2, 0.7, 1.2]")  # fmt: skip
    log = run(SENSORS, f"sensing.{sensor}", "biased", *slew, duration=3.5)
    assert noticed(log) == {f"sensing.{sensor}": "biased"}
    nq = len(log.coordinates.position_names)
    measured, state = (log.series[name] for name in ("measurement", "state"))
    turn = position_error(state[-1, :nq], state[80, :nq])[:3]
    assert np.linalg.norm(turn) > 1.0
    error = position_error(measured[-1][:nq], state[-1][:nq])
    assert np.abs(error[3:6] if sensor == "base_position" else error[:3]).max() < 6e-3


@pytest.mark.parametrize("kind", ["frozen", "silent"])
def test_lost_velocities(kind):
    log = run(SENSORS, "sensing.joint_2_velocity", kind, duration=1.4)
    assert noticed(log) == {"sensing.joint_2_velocity": kind}
    column = len(log.coordinates.position_names) + log.coordinates.names.index("joint_2")
    error = log.series["measurement"][-20:, column] - log.series["state"][-20:, column]
    assert np.abs(error).max() < 1e-3


def test_a_stopped_wheel_gets_no_torque():
    turning = "actuation.wheels.units.wheel_1.initial_momentum=1.0"
    log = run(NAME, "wheels.wheel_1", "stops", turning, time=0.5)
    assert noticed(log) == {"wheels.wheel_1": "stops"}
    assert np.abs(log.series["wheel_torque"][-5:, 1:]).max() > 0.0


def test_what_is_isolated_does_nothing():
    scenario = load_scenario(NAME)
    base = make_base_actuators(
        scenario.actuation, make_nominal_plant(scenario).coordinates, sample_time=0.01, detects=True
    )
    isolated = np.zeros(len(base.units))
    isolated[[2, 12]] = LOST  # a thruster, a wheel
    thrusters, wheels, gives_all = base.without(isolated)
    assert gives_all
    rng = np.random.default_rng(0)
    for wrench in rng.uniform(-1.0, 1.0, (20, 6)):
        wanted = thrusters.allocate(wrench, thrusters.initial_memory())["wanted"]
        assert wanted[2] == 0.0
        assert thrusters.wrenches @ wanted == pytest.approx(wrench, abs=1e-6)
        torques = wheels.give(0.5 * wrench[:3], np.zeros(4), np.zeros(3))
        assert abs(torques.motor[0]) < 1e-12
        assert torques.on_base == pytest.approx(0.5 * wrench[:3], abs=1e-9)
    assert not base.without(np.full(len(base.units), LOST))[2]


# the arm holds its posture
AT_REST = [{"initial_posture": dataclasses.asdict(load_scenario(SENSORS).target_posture)}]


def drawn_forces(rng):
    """Overrides: a disturbance and a payload within the bounds."""
    ratio = np.exp(rng.uniform(-np.log(2.0), np.log(2.0)))
    truth = {"mass": 80.0 * ratio, "inertia": [12.0 * ratio] * 3}
    return [
        f"disturbance.frequency_scale={np.exp(rng.uniform(np.log(0.3), np.log(5.0))):.3g}",
        f"disturbance.amplitude_scale={np.exp(rng.uniform(np.log(0.3), np.log(3.0))):.3g}",
        {"payload": {"truth": truth}, "random_seed": int(rng.integers(1000))},
    ]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("more", [AT_REST, ["reference.duration=10"]], ids=["at rest", "moving"])
def test_no_joint_that_works_is_jammed(more, seed):
    forces = drawn_forces(np.random.default_rng(seed))
    log = run(SENSORS, None, None, "controller=tdc", *more, *forces, duration=4.0)
    assert noticed(log) == {}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_no_thruster_that_works_is_weak(seed):
    forces = drawn_forces(np.random.default_rng(seed))
    assert noticed(run(NAME, None, None, *forces, duration=4.5)) == {}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_jam_of_a_joint_that_moves(seed):
    rng = np.random.default_rng(seed)
    unit = f"joints.joint_{rng.integers(1, 6)}"
    forces = drawn_forces(rng)
    moving = ("controller=tdc", "reference.duration=10", *forces)
    log = run(SENSORS, unit, "jammed", *moving, time=2.5, duration=4.0)
    assert noticed(log) == {unit: "jammed"}


@pytest.mark.slow
def test_a_joint_that_nothing_moves_is_not_jammed_but_known_once_the_bound_is_smaller():
    """What disturbances may do follows from the bound, given or the scenario's own."""
    still = ("controller=tdc", *AT_REST, "disturbance.harmonics.joint_1={bias: 2.0}")
    log = run(SENSORS, "joints.joint_1", "jammed", *still, time=2.0, duration=4.0)
    assert noticed(log) == {}
    bound = {"faults": {"detection": {"disturbance": {"all": 0.5}}}}
    log = run(SENSORS, "joints.joint_1", "jammed", *still, bound, time=2.0, duration=4.0)
    assert noticed(log) == {"joints.joint_1": "jammed"}


STEP, COUNT = 0.05, 32


def test_slopes():
    rng = np.random.default_rng(2)
    lines = 0.3 * STEP * np.arange(COUNT)[:, None] + 0.01 * rng.standard_normal((COUNT, 2000))
    whole, half = slope_weights((COUNT, COUNT // 2), COUNT, STEP) @ lines
    for slope, count in ((whole, COUNT), (half, COUNT // 2)):
        deviation = 0.01 * np.sqrt(12.0 / (count * (count**2 - 1.0))) / STEP
        assert slope.mean() == pytest.approx(0.3, abs=3.0 * deviation / np.sqrt(2000))
        assert slope.std() == pytest.approx(deviation, rel=0.05)


@pytest.mark.parametrize(
    ("name", "unit", "kind"),
    [
        pytest.param(NAME, "thrusters.a_x", "stuck_on", marks=pytest.mark.long),
        pytest.param(NAME, "thrusters.a_x", "stuck_off", marks=pytest.mark.long),
        pytest.param(NAME, "wheels.wheel_2", "stops", marks=pytest.mark.long),
        pytest.param(SENSORS, "joints.joint_2", "jammed", marks=pytest.mark.long),
        pytest.param(SENSORS, "sensing.joint_3_velocity", "biased", marks=pytest.mark.long),
        pytest.param(NAME, None, None, marks=pytest.mark.long),
    ],
)
def test_faults_with_a_supervisor(name, unit, kind):
    events = {} if unit is None else {"it": {"unit": unit, "kind": kind, "time": [6.0]}}
    faults = {"faults": {"detection": {}, "events": events}, "supervisor": {}}
    record = simulate(load_scenario(name, ["duration=9", faults]))
    assert record.dataset["time"][-1] > 8.99
    found = record.metrics["faults"]["noticed"]
    remarks = [remark for remark in run_remarks(record) if "detected" in remark]
    if unit is None:
        assert (found, remarks) == (None, [])
        return
    assert list(found) == [f"{unit} {kind}"]
    (time,) = found.values()
    assert 6.0 < time < 8.0
    assert remarks == [f"{unit}: {kind} since 6.00 s, detected at {time:.2f} s"]


@pytest.mark.parametrize("kind", ["biased", "frozen", "silent"])
def test_a_slow_sensor_before_a_faulty_one_is_known_to_be_slow(kind):
    event = {"unit": "sensing.joint_1_velocity", "kind": kind, "time": [0.02]}
    faults = {"faults": {"detection": {}, "events": {"it": event}}}
    scenario = load_scenario("slow_navigation", ["duration=0.1", faults])
    assert make_rollout(scenario).run().outcome.completed


def test_a_step_depends_on_its_memory_alone():
    """Another detector goes on with the bits of the first, from any sample, with samples that wait
    and with ones that do not.
    """
    mission = Mission(load_scenario(NAME, [{"faults": {"detection": {}}}]))
    nominal, rng = mission.craft.nominal(Grip(holds=True)), np.random.default_rng(5)
    setup = BlockSetup(name="detection", mission=mission, nominal=nominal, settings={})
    first, other, state = Detector(setup), Detector(setup), np.concatenate([[1.0], np.zeros(22)])
    memory, waited = first.start(state), 0
    for sample in range(90):
        state = state + 1e-5 * rng.standard_normal(state.size)
        if sample in (41, 63):
            state[6] += 0.1  # a jump of a position
        inputs = {name: np.zeros(size) for name, size in first.inputs.items()} | {"state": state}
        for values in memory.values():
            values.flags.writeable = False
        other = Detector(setup) if sample % 30 == 0 else other
        found = [each.step(inputs, memory, Now(0.01 * sample)) for each in (first, other)]
        for mine, others in zip(*found, strict=True):
            assert all(np.array_equal(mine[name], others[name]) for name in mine)
        waited += found[0][1]["kept"] is memory["kept"]
        memory = found[0][1]
    assert 60 < waited < 90


@pytest.mark.parametrize("name", [NAME, "two_arms"])
def test_the_memory_is_used_before_and_after_a_grasp(name):
    mission = Mission(load_scenario(name, [{"faults": {"detection": {}}}]))
    memory, random = None, np.random.default_rng(2)
    for holds in (False, True):
        nominal = mission.craft.nominal(Grip(holds=holds))
        setup = BlockSetup(name="detection", mission=mission, nominal=nominal, settings={})
        detector = Detector(setup)
        inputs = {each: np.zeros(size) for each, size in detector.inputs.items()}
        for sample in range(45):
            state = np.r_[1.0, 1e-5 * random.normal(size=inputs["state"].size - 1)]
            memory = detector.start(state) if memory is None else memory
            _, memory = detector.step(inputs | {"state": state}, memory, Now(0.01 * sample))
        sizes = {each: values.size for each, values in memory.items()}
        assert sizes == {each: values.size for each, values in detector.start(state).items()}


@pytest.mark.long
@pytest.mark.parametrize("driven", ["[joints]", "[base_rotation, joints]"])
def test_an_undriven_base_has_no_force(driven):
    """No alarm, and a jam is named, in the whole model."""
    given = f"actuation.driven={driven}"
    assert noticed(run("free_floating", None, None, given, duration=2.0)) == {}
    log = run("free_floating", "joints.joint_2", "jammed", given, time=1.2, duration=2.5)
    assert noticed(log) == {"joints.joint_2": "jammed"}
