"""Phases of a user's own before the approach: one file, named in the scenario."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ffsm_drake import BlockError, RunRecord, ScenarioError, load_scenario, simulate
from ffsm_drake.plugins.capture.grasping import Aim
from ffsm_drake.plugins.design.stability.mission import linear_verdict
from ffsm_drake.runs.metrics import phases_of
from ffsm_drake.spacecraft.nominal import make_nominal_plant
from ffsm_drake.systems.reference import make_motion

# From a posture near that at the grasp, so that two seconds are enough.
NEAR = "{joint_1: 0.15, joint_2: 0.33, joint_3: 1.1, joint_4: 0.5, joint_5: -0.75}"
PLACE = "base_position: [0.1, 0.3, -0.2], base_rpy: [0.11, 0.08, -0.1]"
JOINTS = "{joint_1: 0.2, joint_2: 0.35, joint_3: 0.95, joint_4: 0.8, joint_5: -0.6}"
SHORT = [
    "reference.duration=3",
    f"capture.approach={{duration: 2, posture: {{{PLACE}, joints: {NEAR}}}}}",
    f"target_posture={{{PLACE}, joints: {JOINTS}}}",
]
HERE = f"python_path=[{Path(__file__).parent}]"


def phases(*given, duration=7):
    """A short capture with ``NAME=system`` or ``NAME={...}`` before the approach, a second each."""
    own = [f"blocks.phases.{each}" for each in given]
    own += [f"blocks.phases.{each.partition('=')[0]}.duration=1" for each in given]
    return load_scenario("tumbling_capture", [*SHORT, HERE, *own, f"duration={duration}"])


def run(scenario):
    return simulate(scenario, check_stability=False)


def counts(record):
    return {name: part.sizes["time"] for name, part in phases_of(record.dataset).items()}


@pytest.mark.slow
def test_a_wait_before_the_approach(tmp_path):
    scenario = phases("wait=own_phases:wait")
    record = run(scenario)
    assert counts(record) == {"wait": 100, "approach": 200, "stop": 401}
    assert record.ending.is_settled
    assert record.grasp["time"] == scenario.grasp_time == 3.0
    assert set(record.metrics["phases"]) == {"wait", "approach", "stop"}
    start = record.dataset["desired_position"].values
    assert np.array_equal(start[:100], np.tile(start[0], (100, 1)))
    record.save(tmp_path)
    again = RunRecord.load(tmp_path)
    assert again.blocks["phases.wait"]["file"].endswith("own_phases.py")
    assert again.dataset.identical(record.dataset)
    assert run(again.scenario).dataset.identical(record.dataset)


def test_the_approach_after_it_is_that_without_it():
    """Planned motion and target are those of the run without a wait, later."""
    alone, later = load_scenario("tumbling_capture", SHORT), phases("wait=own_phases:wait")
    coordinates = make_nominal_plant(alone).coordinates
    times = np.arange(0.0, 5.0, 0.37)
    rows = [
        make_motion(each, coordinates).rows(times + by) for each, by in ((alone, 0), (later, 1))
    ]
    assert_allclose(rows[0], rows[1], rtol=0.0, atol=1e-13)
    assert_allclose(Aim(alone).path, Aim(later).path[100:], rtol=0.0, atol=1e-9)


@pytest.mark.slow
def test_phases_go_in_turn_and_begin_where_their_motion_does():
    by = {"system": "own_phases:come", "settings": "{by: [0.02, 0, 0.01], lasts: 1}"}
    come = f"come={{system: {by['system']}, settings: {by['settings']}}}"
    record = run(phases(come, "wait=own_phases:wait", duration=8))
    assert list(counts(record)) == ["come", "wait", "approach", "stop"]
    place = record.dataset["position"].values[:, 4:7]
    assert_allclose(place[0] - place[150], [0.02, 0.0, 0.01], atol=4e-3)
    assert np.abs(record.dataset["error"].values[100:200]).max() < 5e-3
    assert record.ending.is_settled


@pytest.mark.slow
def test_a_law_of_its_own():
    record = run(phases("wait=own_phases:other_law"))
    assert counts(record) == {"wait": 100, "approach": 200, "stop": 401}
    data = record.dataset
    adapted = data["reaching_gain"].values
    assert np.isnan(adapted[:100]).all()
    assert np.isfinite(adapted[100:]).all()
    # the spacecraft goes on where it was
    step = np.abs(np.diff(data["position"].values, axis=0)).max(axis=1)
    assert step[99] < 3.0 * max(step[98], step[100])


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        ("wait=own_phases:no", BlockError, r"blocks.phases.wait.*has no 'no'"),
        ("wait=drift", ScenarioError, r"blocks.phases.wait: 'drift' is unknown"),
        ("wait=own_phases:system", BlockError, "must be a Phase, not ConstantVectorSource"),
        ("wait=own_phases:fails", BlockError, r"wait 'own_phases:fails' cannot be built.*no_such"),
        ("stop=own_phases:wait", ScenarioError, "'stop' is a phase of every capture"),
        ("approach_2=own_phases:wait", ScenarioError, "'approach_2' is a phase of every"),
        ("wait=own_phases:placed", BlockError, r"wait: its names follows from its place"),
        ("wait=own_phases:referred", BlockError, r"wait: give its motion in place of a block"),
        (
            "come={system: own_phases:come, settings: {by: [1, 0, 0], lasts: 3}}",
            BlockError,
            r"blocks.phases.come: its motion must end where the next begins, at base_position_x",
        ),
    ],
)
def test_what_cannot_be_is_said_in_a_line(given, error, words):
    with pytest.raises(error, match=words) as found:
        run(phases(given))
    assert "\n" not in str(found.value)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("raises", r"its motion failed: KeyError: 'joints' \(in Broken.rows: .*own_phases\.py"),
        ("narrow", r"its motion must have rows \(100, 34\) at 100 times, not \(100, 3\)"),
        ("nan", r"its motion must be finite, with unit quaternions, and is not at 0\.505 s"),
        ("turned", r"its motion must be finite, with unit quaternions, and is not at 0 s"),
        ("moves", r"its motion must end where the next begins, at velocity of base_position_y 0"),
    ],
)
def test_a_motion_with_a_fault_is_named(fault, words):
    given = f"turn={{system: own_phases:broken, settings: {{fault: {fault}}}}}"
    with pytest.raises(BlockError, match=rf"blocks\.phases\.turn: {words}"):
        run(phases(given))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("capture.approach=null", r"blocks\.phases\.wait: must come before an approach"),
        ("blocks.phases.wait.duration=0.123", r"wait\.duration: must be a whole number of control"),
        ("blocks.phases.wait.system=''", r"wait\.system: '' must be a name"),
        ("duration=3", r"capture\.approach\.duration: must leave time for the stop"),
    ],
)
def test_settings_that_cannot_be(given, words):
    wait = "blocks.phases.wait={system: own_phases:wait, duration: 1}"
    with pytest.raises(ScenarioError, match=words):
        load_scenario("tumbling_capture", [*SHORT, wait, given])


@pytest.mark.long
def test_with_all_that_a_capture_may_have():
    """A wait before a measured target that a closing gripper misses, and a second try."""
    given = ["blocks.phases.wait={system: own_phases:wait, duration: 1}", HERE, "supervisor={}"]
    given += ["capture.closing={}", "duration=50", "capture.envelope.position=1e-3"]
    given += ["capture.approach.duration=5", "capture.measured={replan: 0.5, last: 1.0}"]
    given += ["capture.retreat={tries: 2, duration: 5}", "capture.rate=[0.01, 0, 0]"]
    record = run(load_scenario("tumbling_capture", [*SHORT, *given]))
    assert list(counts(record))[:3] == ["wait", "approach", "retreat"]
    assert counts(record)["wait"] == 100
    assert counts(record)["approach"] == 400  # up to the first contact


@pytest.mark.slow
def test_its_loop_is_linearised_with_the_approach():
    legs = linear_verdict(phases("wait=own_phases:wait")).legs
    assert [leg.leg for leg in legs] == ["approach", "stop"]
    assert all(leg.status == "stable" for leg in legs)
    assert legs[1].time >= 3.0
