"""Faults that end, come again, or lose samples at random: before them nothing differs, and the
unit works after them.
"""

import dataclasses
import json

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from ffsm_drake import ScenarioError, load_scenario, simulate
from ffsm_drake.cli import main
from ffsm_drake.runs.exceeded_limits import run_remarks
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import Fault, scenario_to_yaml, thrusters_of
from ffsm_drake.spacecraft.coordinates import position_error
from ffsm_drake.spacecraft.craft import make_nominal_plant
from ffsm_drake.systems.faults import Occurrence, fault_kinds, hits, settle_faults

NAME, SENSORS, STEP = "thrusters_and_wheels", "flight_sensors", 0.01
seconds = st.floats(0.0, 2.0, allow_nan=False)


def scenario_with(name, *overrides, detects=False, **event):
    faults = {"events": {"it": event}} | ({"detection": {}} if detects else {})
    return load_scenario(name, [{"faults": faults}, *overrides])


def occurrence(scenario, part):
    settled = settle_faults(scenario, make_nominal_plant(scenario).coordinates)
    return hits(settled, part)[0].occurs


@settings(deadline=None)
@given(seconds, st.floats(0.001, 1.0), st.floats(0.02, 2.0))
def test_a_fault_begins_and_ends_at_control_samples(time, duration, longer):
    samples = np.arange(400)
    once = Occurrence.of(Fault(time=[time], duration=duration), STEP).at(samples)
    begins = time <= samples * STEP + 1e-9
    assert np.array_equal(Occurrence.of(Fault(time=[time]), STEP).at(samples), begins)
    length = round(np.ceil(duration / STEP - 1e-9))
    first = int(np.argmax(begins))
    assert np.array_equal(np.flatnonzero(once), np.arange(first, min(first + length, 400)))
    fault = Fault(time=[time], duration=duration, period=duration + longer)
    again = Occurrence.of(fault, STEP)
    there = again.at(samples)
    assert np.array_equal(there, [again.at(int(k)) for k in samples])
    begins_at = np.flatnonzero(np.diff(there.astype(int), prepend=0) == 1)
    assert np.all(np.diff(begins_at) == round(np.ceil(fault.period / STEP - 1e-9)))


@given(st.integers(0, 2**31 - 1), st.floats(0.01, 0.99))
@settings(max_examples=20, deadline=None)
def test_lost_samples_are_a_share_that_the_seed_draws(seed, share):
    event = {"unit": "sensing.joint_1", "kind": "dropout", "size": share}
    of_seed = [scenario_with(SENSORS, f"random_seed={each}", **event) for each in (seed, seed, 1)]
    lost = [occurrence(each, "sensing").at(np.arange(10_000)) for each in of_seed]
    assert np.array_equal(lost[0], lost[1])
    assert seed == 1 or not np.array_equal(lost[0], lost[2])
    assert lost[0].mean() == pytest.approx(share, abs=5.0 * np.sqrt(share * (1 - share) / 1e4))


EXCITED = {
    "wheels": ("actuation.wheels.units.wheel_1.initial_momentum=1.0",),
    "thrusters": (
        "actuation.wheels=null", "disturbance.amplitude_scale=5",
        *(f"actuation.thrusters.{name}_time=0" for name in ("rise", "fall")),
    ),
}  # fmt: skip


def drawn_span(random):
    """Settings of a fault within 0.5 s: one span, or two of them."""
    begin, duration = random.uniform(0.05, 0.15), random.uniform(0.03, 0.08)
    again = {"period": duration + random.uniform(0.05, 0.1)} if random.random() < 0.5 else {}
    return {"time": begin, "duration": duration, **again}


@pytest.mark.parametrize(
    ("unit", "kind"),
    [
        (f"{part}.{unit}", kind)
        for part, unit in (
            ("thrusters", "a_x"),
            ("wheels", "wheel_1"),
            ("joints", "joint_2"),
            ("sensing", "joint_2"),
            ("sensing", "base_rotation"),
            ("sensing", "base_position_velocity"),
        )
        for kind in fault_kinds()[part]
    ],
)
def test_a_unit_works_before_and_after_a_fault(unit, kind):
    """Each kind that a part declares, a new one too."""
    part = unit.partition(".")[0]
    seed = sum(map(ord, unit + kind))
    span = drawn_span(np.random.default_rng(seed))
    overrides = ("duration=0.5", f"random_seed={seed}", *EXCITED.get(part, ()))
    scenario = scenario_with(NAME, *overrides, unit=unit, kind=kind, **span)
    log = make_rollout(scenario).run()
    whole = make_rollout(dataclasses.replace(scenario, faults=None)).run()
    broken = occurrence(scenario, part).at(np.arange(log.time.size))
    first = int(np.argmax(broken))
    for name in ("state", "measurement", "generalized_force"):
        assert np.array_equal(log.series[name][:first], whole.series[name][:first]), name
    assert not np.array_equal(log.series["state"], whole.series["state"])
    works = ~broken
    if part == "sensing":  # the same noise as without the fault
        nq = len(log.coordinates.position_names)
        measured, state = log.series["measurement"][works], log.series["state"][works]
        errors, noise = (
            np.array([position_error(*pair) for pair in zip(of[:, :nq], at[:, :nq], strict=True)])
            for of, at in (
                (measured, state),
                (whole.series["measurement"][works], whole.series["state"][works]),
            )
        )
        assert errors == pytest.approx(noise, abs=1e-6)
        rates = measured[:, nq:] - state[:, nq:]
        expected = whole.series["measurement"][:, nq:] - whole.series["state"][:, nq:]
        assert rates == pytest.approx(expected[works], abs=1e-6)
    elif part == "thrusters":
        at = list(thrusters_of(scenario.actuation.thrusters)).index("a_x")
        largest = thrusters_of(scenario.actuation.thrusters)["a_x"].force
        opened, force = (log.series[f"thruster_{name}"][:, at] for name in ("open", "force"))
        assert force[works] == pytest.approx(opened[works] * largest, abs=1e-8)
        assert opened[broken].max() > 0.0
        assert not np.array_equal(force[broken], opened[broken] * largest)
    elif part == "wheels":
        assert np.all(log.series["wheel_torque"][broken, 0] == 0.0)
        assert np.all(log.series["wheel_torque"][works, 0] != 0.0)
    else:
        column = len(log.coordinates.position_names) + log.coordinates.names.index("joint_2")
        rate = np.abs(log.series["state"][:, column])
        (ends,) = np.nonzero(np.diff(works.astype(int)) == 1)
        assert np.all(rate[ends[:1] + 3] > 2.0 * rate[ends[:1] + 1])  # it leaves its rest


@pytest.mark.slow
def test_a_jam_that_ends_conserves_momentum():
    jam = {"unit": "joints.joint_2", "kind": "jammed", "time": 0.3, "duration": 0.2}
    still = "disturbance.amplitude_scale=0"
    record = simulate(scenario_with("postcapture", still, "duration=0.8", **jam))
    data = record.dataset
    force = data["applied_force"].values[:-1, 3:6]
    momentum = data["linear_momentum"].values
    assert np.diff(momentum, axis=0) == pytest.approx(STEP * force, abs=1e-6)
    assert "joints.joint_2: jammed from 0.30 s to 0.50 s" in run_remarks(record)


def run(kind, unit, *overrides, **event):
    given_ = {"time": 0.8, "duration": 0.3, **event}
    scenario = scenario_with(SENSORS, *overrides, detects=True, unit=unit, kind=kind, **given_)
    record = simulate(scenario, check_stability=False)
    return record, {name: found or {} for name, found in record.metrics["faults"].items()}


@pytest.mark.parametrize(
    ("unit", "kind"),
    [
        ("base_rotation", "frozen"),
        ("joint_2", "silent"),
        ("joint_2_velocity", "silent"),
        ("joint_1_velocity", "frozen"),
        ("base_position", "biased"),
        ("base_rotation", "biased"),
    ],
)
def test_a_sensor_that_works_again_is_read_again(unit, kind):
    record, found = run(kind, f"sensing.{unit}", "duration=1.6")
    name = f"sensing.{unit} {kind}"
    assert set(found["noticed"]) == {name}
    assert found["ended"][name] == pytest.approx(1.1, abs=0.05)
    assert not record.dataset["fault_detected"].values[-1].any()
    assert f"sensing.{unit}: {kind} from 0.80 s to 1.10 s, detected at" in run_remarks(record)[0]


@pytest.mark.slow
def test_a_velocity_that_is_biased_no_more_is_read_again():
    _, found = run("biased", "sensing.joint_2_velocity", "duration=9", time=4.0, duration=2.0)
    assert set(found["noticed"]) == {"sensing.joint_2_velocity biased"}
    assert found["ended"]["sensing.joint_2_velocity biased"] == pytest.approx(6.3, abs=0.6)


@pytest.mark.parametrize("unit", ["joint_2", "base_rotation", "joint_2_velocity"])
@pytest.mark.parametrize("share", [0.2, 0.6])
def test_lost_samples_are_replaced_and_no_other_fault_is_detected(unit, share):
    record, found = run("dropout", f"sensing.{unit}", "duration=2", size=share, duration=1.0)
    assert set(found["noticed"]) <= {f"sensing.{unit} silent"}
    assert set(found["ended"]) == set(found["noticed"])
    data = record.dataset
    error = data["measured_position"].values - data["position"].values
    assert np.abs(error).max() < 6e-3


def sentences_of(record):
    return [part.sentence for part in record.parts]


def test_a_fault_that_comes_again_is_counted_with_its_first_and_last_detection():
    unit, times = "sensing.joint_2", {"time": 0.5, "duration": 0.2, "period": 0.4}
    record, found = run("silent", unit, "duration=1.6", **times)
    name = f"{unit} silent"
    assert found["detections"] == {name: 3}
    assert found["noticed"][name] == pytest.approx(0.5, abs=0.05)
    assert found["noticed_last"][name] == pytest.approx(1.3, abs=0.05)
    (lost, detected) = sentences_of(record)
    assert lost == f"Faulty sensors: samples lost by {unit} 60"
    assert detected.startswith(f"Faults detected: {name} 3 times, first at 0.5")
    assert ", last at 1.3" in detected


@pytest.mark.parametrize("unit", ["sensing.joint_2", "sensing"])
def test_the_record_shows_which_samples_were_lost(unit):
    overrides = ("duration=0.6", "random_seed=3")
    event = {"unit": unit, "kind": "dropout", "size": 0.4, "time": 0.2, "duration": 0.2}
    record = simulate(scenario_with(SENSORS, *overrides, **event), check_stability=False)
    data = record.dataset
    (name,) = data["sample_lost_component"].values
    kind = "velocity" if name.endswith("_velocity") else "position"
    measured = data[f"measured_{kind}"].values
    repeats = (np.diff(measured, axis=0, prepend=np.nan) == 0.0).any(axis=1)
    assert repeats.any()
    assert np.array_equal(data["sample_lost"].values[:, 0], repeats)
    assert record.metrics["faults"] == {"samples_lost": {name: repeats.sum()}}
    assert f"Faulty sensors: samples lost by {name} {repeats.sum()}" in sentences_of(record)


@pytest.mark.slow
def test_validate_prints_the_faults_that_a_run_has(tmp_path):
    known = {"unit": "sensing.joint_2", "kind": "silent", "time": 0.02, "duration": 0.021}
    open_ = {"unit": "any", "kind": "any", "time": [0.02, 0.08]}
    faults = {"events": {"known": known, "open": open_}, "seed": 2}
    overrides = ("duration=0.1", "disturbance.amplitude_scale=0")
    scenario = load_scenario(NAME, [{"faults": faults}, *overrides])
    (tmp_path / "mine.yaml").write_text(scenario_to_yaml(scenario))
    arguments = ["validate", str(tmp_path / "mine.yaml"), "--no-rehearsal", "--json"]
    found = json.loads(CliRunner().invoke(main, arguments).stdout)
    first, second = run_remarks(simulate(scenario, check_stability=False))[:2]
    assert first == "sensing.joint_2: silent from 0.02 s to 0.05 s"
    told = [f"fault known: {first}", f"fault open: {second}, drawn with seed 2"]
    assert found[arguments[1]]["faults"] == told


@pytest.mark.parametrize(
    ("event", "said"),
    [
        ({"duration": 0.0}, "duration: must be > 0 s"),
        ({"period": 2.0}, "period: needs a duration"),
        ({"duration": 2.0, "period": 2.0}, "period: must exceed the duration, 2 s"),
        ({"kind": "stopped"}, "kind: 'stopped' is no fault of thrusters.a_x; choose one of"),
        ({"kind": "dropout"}, "kind: 'dropout' is no fault of thrusters.a_x"),
        ({"kind": "leaking", "size": 1.5}, "size: must be a share from 0 to 1, not 1.5"),
        ({"kind": "stuck_on", "size": 0.5}, "size: 'stuck_on' has no size"),
    ],
)
def test_refused(event, said):
    coordinates = make_nominal_plant(load_scenario(NAME)).coordinates
    events = {"it": {"unit": "thrusters.a_x", **event}}
    with pytest.raises(ScenarioError, match=f"faults.events.it.{said}"):
        settle_faults(load_scenario(NAME, [{"faults": {"events": events}}]), coordinates)


def test_a_drawn_beginning_keeps_the_duration():
    coordinates = make_nominal_plant(load_scenario(NAME)).coordinates
    found = []
    for seed in range(5):
        event = {"unit": "wheels", "time": [2.0, 4.0], "duration": 0.5}
        scenario = scenario_with(NAME, f"random_seed={seed}", **event)
        found.append(settle_faults(scenario, coordinates).faults.events["it"])
    assert {fault.duration for fault in found} == {0.5}
    times = [fault.time[0] for fault in found]
    assert len(set(times)) == 5
    assert min(times) >= 2.0
    assert max(times) <= 4.0
