"""``ffsm new`` with sensors, actuators, panels and a grasp: missions that settle when first run."""

import random
import re
import time
import types
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from outside_urdfs import OUTSIDE, simple_arm

from ffsm_drake import load_scenario
from ffsm_drake.common.errors import FfsmError, ScenarioError
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.design.remarks import plan_clearance
from ffsm_drake.plugins.new.asked import Asked, WheelData
from ffsm_drake.plugins.new.first_scenario import new_scenario
from ffsm_drake.plugins.new.postures import Arm
from ffsm_drake.plugins.new.urdf.servicer import read_urdf
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import thrusters_of
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.spacecraft.craft import make_true_plant
from ffsm_drake.systems.mission_limits import base_limits
from ffsm_drake.systems.reference import make_motion

ALL = {
    "sensors": "flight",
    "thrusters": "12x5N",
    "wheels": "4",
    "panels": "2x5kg",
    "capture": "3deg/s",
    "driven": "all",
}
CHOICES = {
    "sensors": [None, "flight", "slow", "paper"],
    "thrusters": [None, "12x5N", "16x22N"],
    "wheels": [None, "4", "3", "4x0.5Nm"],
    "panels": [None, "2x5kg", "1x3kg"],
    "capture": [None, "1deg/s", "3deg/s"],
    "driven": [None, "all", "base_rotation,joints", "joints"],
}
MODELS = Path(__file__).parents[3] / "models" / "urdf"


def make(folder, name, words):
    """A new scenario of an arm by name."""
    urdf = MODELS / f"{name}.urdf"
    if name in OUTSIDE:
        urdf = folder / f"{name}.urdf"
        urdf.write_text(OUTSIDE[name]())
    directory = folder / f"new_{len(list(folder.iterdir()))}"
    return new_scenario(urdf, directory, asked=Asked.parsed(**words))


def assert_settles(new):
    """The mission settles at its first run, and says so of its contact."""
    scenario = load_scenario(new.scenario_file)
    told = any("come within" in each or "overlap" in each for each in new.remarks)
    clear = [each.distance >= scenario.clearance for each in plan_clearance(make_mission(scenario))]
    assert all(clear) or told
    ending = make_rollout(scenario).run().ending
    assert ending.is_settled, ending.sentence


@pytest.mark.long
@pytest.mark.parametrize("mass", [40.0, 400.0])
def test_peak_forces_are_those_of_the_motion_that_was_written(tmp_path, mass):
    """A heavy target needs a longer motion than the one that was first planned."""
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(simple_arm())
    new = new_scenario(
        urdf, tmp_path / "new", payload_mass=mass, asked=Asked.parsed(thrusters="12x1N")
    )
    scenario = load_scenario(new.scenario_file)
    assert (scenario.reference.duration > 20.0) is (mass > 100.0)
    model = make_true_plant(scenario)
    motion = make_motion(make_mission(scenario))
    nq, nv = len(model.coordinates.position_names), len(model.coordinates.names)
    rows = motion.rows(np.linspace(0.0, motion.end, 101))
    force = model.calc_inverse_dynamics(*np.split(rows, [nq, nq + nv], axis=1))
    for name, peak in zip(model.coordinates.names, np.abs(force).max(axis=0), strict=True):
        assert new.peak_force[name] == pytest.approx(peak, rel=0.02)
    assert new.scenario.reference == scenario.reference


SIX = ["servicer", "six_joints", "seven_joints"]


@pytest.mark.long
@pytest.mark.parametrize(
    "name",
    SIX,
)
def test_everything_at_once_settles(tmp_path, name):
    begin = time.process_time()
    new = make(tmp_path, name, ALL)
    assert time.process_time() - begin < 30.0
    assert not [each for each in new.remarks if "no bandwidth" in each or "too weak" in each]
    assert_settles(new)
    scenario = load_scenario(new.scenario_file)
    assert scenario.capture.approach is not None
    assert len(scenario.model.flexible) == 2
    # Gains for the target held do not serve each law before the grasp.
    for law in ("computed_torque", "pd_plus"):
        short = [f"controller={law}", f"duration={scenario.capture.approach.duration + 1.0}"]
        log = make_rollout(load_scenario(new.scenario_file, short)).run()
        assert log.ending.status != "diverged"
    thrusters = scenario.actuation.thrusters
    assert (thrusters.box is None) is (name == "servicer")
    assert {each.force for each in thrusters_of(thrusters).values()} == {5.0}
    assert scenario.sensing == load_scenario("flight_sensors").sensing


@pytest.mark.parametrize(
    ("name", "count"),
    [
        *(pytest.param(name, 3, marks=pytest.mark.long) for name in ("servicer", "six_joints")),
        *(pytest.param(name, 20, marks=pytest.mark.exhaustive) for name in SIX),
    ],
)
def test_drawn_subsets_settle_or_say_why_not(tmp_path, name, count):
    draw = random.Random(name)
    for _ in range(count):
        words = {key: draw.choice(values) for key, values in CHOICES.items()}
        new = refusal = None
        try:
            new = make(tmp_path, name, words)
        except FfsmError as error:
            refusal = str(error)
        if new is not None:
            assert_settles(new)
        else:
            assert len(refusal.splitlines()) == 1


@pytest.mark.long
def test_flags_are_the_scenarios_settings(tmp_path):
    """Without a run: what is asked for stands in the file, with the shipped scenario's sensors."""
    new = make(tmp_path, "six_joints", {**ALL, "panels": None, "wheels": "3x4Nm"})
    scenario = load_scenario(new.scenario_file)
    text = new.scenario_file.read_text()
    assert scenario.sensing == load_scenario("flight_sensors").sensing
    assert scenario.estimator == load_scenario("tumbling_capture").estimator
    assert [each.torque_limit for each in scenario.actuation.wheels.units.values()] == [4.0] * 3
    assert np.linalg.norm(scenario.capture.rate) == pytest.approx(np.radians(3.0), rel=0.01)
    assert "# The grasp" in text
    data = yaml.safe_load(text)
    assert "frame" not in data["actuation"]["thrusters"]  # defaults are not copied
    assert "envelope" not in data["capture"]
    # The approach comes along the grasp axis: the base moves straight to where it grasps.
    approach = scenario.capture.approach.posture
    assert approach.joints == scenario.initial_posture.joints
    assert approach.base_rpy == scenario.initial_posture.base_rpy
    for each in plan_clearance(make_mission(scenario)):
        assert each.distance >= scenario.clearance
    # The motion takes at most two thirds of what the actuators give.
    limits = base_limits(scenario)
    for group, least in (("rotation", limits.torque.min()), ("position", limits.force.min())):
        names = [f"base_{group}_{axis}" for axis in "xyz"]
        assert max(new.peak_force[name] for name in names) < 0.7 * least


@pytest.mark.long
def test_undriven_base(tmp_path):
    """Nothing is commanded, and nothing acts, where no actuator moves the base."""
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(simple_arm(lower=-2, upper=2))
    asked = Asked.parsed(driven="joints,base_rotation", sensors="flight")
    scenario = load_scenario(new_scenario(urdf, tmp_path / "new", asked=asked).scenario_file)
    assert scenario.actuation.driven == ["base_rotation", "joints"]
    assert scenario.target_posture.base_position == scenario.initial_posture.base_position
    assert not any(name.startswith("base_position") for name in scenario.disturbance.harmonics)


@pytest.mark.long
def test_weak_wheels_are_named(tmp_path):
    words = {"thrusters": "12x5N", "wheels": "4x0.5Nm", "sensors": "flight"}
    new = make(tmp_path, "six_joints", words)
    told = [each for each in new.remarks if "too weak" in each]
    assert len(told) == 1
    enough = told[0].rpartition("--wheels ")[2]
    assert load_scenario(new.scenario_file).actuation.wheels.assist_above == 1.0
    again = make(tmp_path, "six_joints", {**words, "wheels": enough})
    assert not [each for each in again.remarks if "too weak" in each]


def test_wheels_at_right_angles_give_the_same_in_all_directions():
    axes = np.array([each["axis"] for each in WheelData(3).units(1.0, None).values()])
    unit = axes / np.linalg.norm(axes, axis=1)[:, None]
    assert unit @ unit.T == pytest.approx(np.eye(3), abs=0.01)


WRONG = {
    "sensors": ["", "x", "f", "Flight"],
    "thrusters": ["13", "12x5", "12x0N", "none", ""],
    "wheels": ["2", "0", "4x", "4x0Nm", "4x-1Nm", "9", "four", "4.5", "1e9"],
    "panels": ["2", "5x5kg", "0x5kg", "2x0kg", "2x5", "2x5 kg", "2x-5kg"],
    "capture": ["3", "3deg", "-3deg/s", "deg/s", "nan deg/s", "3rpm"],
    "driven": ["", "base", "base_position,joints", "all,joints"],
}


@pytest.mark.parametrize("name", WRONG)
def test_a_bad_value_is_one_line(name):
    for word in WRONG[name]:
        with pytest.raises(ScenarioError) as caught:
            Asked.parsed(**{name: word})
        assert str(caught.value).startswith(f"--{name}: ")
        assert "\n" not in str(caught.value)


@pytest.mark.slow
@given(st.sampled_from(sorted(WRONG)), st.text(max_size=12))
@settings(max_examples=100, deadline=None)
def test_any_text_is_a_value_or_one_line(name, word):
    refusal = ""
    try:
        Asked.parsed(**{name: word})
    except ScenarioError as error:
        refusal = str(error)
    assert refusal == "" or refusal.startswith(f"--{name}: ")
    assert len(refusal.splitlines()) <= 1


@pytest.mark.parametrize("seed", range(3))
def test_the_best_posture_is_that_of_real_shapes(seed, tmp_path):
    """Where shapes that stand for a base without a picture leave none clear."""
    urdf = MODELS / "servicer.urdf"
    invented = (  # from which the arm is farthest inside the base
        '<collision name="invented_0"><origin xyz="0 0 12"/><geometry><sphere radius="13"/>'
        "</geometry></collision>"
    )
    text = re.sub(r'(<link name="base">)', rf"\1{invented}", urdf.read_text())
    (tmp_path / "craft.urdf").write_text(text)
    names = [
        f"model.servicer={tmp_path / 'craft.urdf'}", f"model.debris={MODELS / 'debris.urdf'}"
    ]  # fmt: skip
    scenario = load_scenario("postcapture", names)
    servicer, true = read_urdf(urdf), make_true_plant(scenario)
    made = types.SimpleNamespace(
        true=true, scenario=scenario, servicer=servicer, coordinates=true.coordinates
    )
    arm, rng, shapes = Arm(made), np.random.default_rng(seed), Clearance(scenario.model)

    def distance(joints):
        return shapes.nearest(arm.whole(arm.filled(joints))).distance

    low, high = arm.low[arm.moving], arm.high[arm.moving]
    candidates = [*(low + (high - low) * rng.random((12, low.size)))]
    assert min(map(distance, candidates)) < 0.0  # otherwise any would do
    assert distance(*arm.best(candidates)) >= min(max(map(distance, candidates)) - 2e-3, 0.05)
    touching = [each for each in candidates if distance(each) < 0.0]
    deepest = max(map(distance, touching))
    assert distance(*arm.best(touching)) == pytest.approx(deepest, abs=2e-3)
