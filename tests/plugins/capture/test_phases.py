"""Phases of a user's own before the approach: one file, named in the scenario."""

import json
from pathlib import Path

import numpy as np
import pytest
from near_captures import SHORT
from numpy.testing import assert_allclose

from ffsm_drake import BlockError, RunRecord, ScenarioError, load_scenario, simulate
from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.capture.grasping import Aim
from ffsm_drake.plugins.design.stability.mission import linear_verdict
from ffsm_drake.runs.metrics import phases_of
from ffsm_drake.systems.reference import make_motion

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
    times = np.arange(0.0, 5.0, 0.37)
    rows = [
        make_motion(make_mission(each)).rows(times + by) for each, by in ((alone, 0), (later, 1))
    ]
    assert_allclose(rows[0], rows[1], rtol=0.0, atol=1e-13)
    assert_allclose(
        Aim(make_mission(alone)).path, Aim(make_mission(later)).path[100:], rtol=0.0, atol=1e-9
    )


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


def listed(given, *more):
    """A short capture with the key ``phases``."""
    return load_scenario("tumbling_capture", [*SHORT, f"phases={given}", "duration=9", *more])


def motion_of(scenario):
    return make_motion(make_mission(scenario))


def test_a_list_of_phases_is_that_of_the_blocks():
    times = np.arange(0.0, 6.0, 0.31)
    alone = load_scenario("tumbling_capture", SHORT)
    by = "{by: [0.02, 0, 0.01], lasts: 1}"
    come = f"come={{system: own_phases:come, settings: {by}}}"
    for one, other in (
        (alone, listed("[approach, stop]")),
        (
            phases(come, "wait=own_phases:wait"),
            listed(
                f"[{{come: {{kind: own_phases:come, duration: 1, {by[1:-1]}}}}}, "
                "{wait: {kind: own_phases:wait, duration: 1}}, approach, stop]",
                HERE,
            ),
        ),
    ):
        assert one.grasp_time == other.grasp_time
        assert np.array_equal(motion_of(one).rows(times), motion_of(other).rows(times))


@pytest.mark.parametrize("seed", range(4))
def test_a_hold_keeps_its_place_to_the_target_and_leads_to_the_grasp(seed):
    """The base rests to the target's centre of mass, and rates fit positions."""
    random = np.random.default_rng(seed)
    distance, rate = random.uniform(0.0, 1.0), random.uniform(-0.2, 0.2, 3).round(3).tolist()
    drift, toward = random.uniform(-0.05, 0.05, (2, 3)).round(3).tolist()
    direction = f", direction: {toward}" if seed % 2 else ""
    scenario = listed(
        f"[{{hold: {{duration: 3, distance: {distance}{direction}}}}}, approach, stop]",
        f"capture.rate={rate}",
        f"capture.velocity={drift}",
    )
    motion, nq, nv = motion_of(scenario), 12, 11
    times = np.arange(0.0, 3.0, 0.25)
    path = Aim(make_mission(scenario)).path[(100 * times).round().astype(int)]
    arm, rows = np.array(scenario.payload.truth.center_of_mass), motion.rows(times)
    centers = path[:, 4:7] + matrix_of(path[:, :4]) @ arm
    assert np.ptp(centers, axis=0).max() > 0.02  # it drifts
    assert_allclose(np.ptp(rows[:, 4:7] - centers, axis=0), 0.0, atol=1e-9)
    assert not np.ptp(np.delete(rows[:, :nq], [4, 5, 6], axis=1), axis=0).any()
    grasp, X_WP = motion.row(scenario.grasp_time), Aim(make_mission(scenario)).target[0]
    there = grasp[4:7] - X_WP @ arm
    way = rows[0, 4:7] - centers[0] - there
    along = np.array(toward) if seed % 2 else there
    assert_allclose(way, distance * along / np.linalg.norm(along), atol=1e-9)
    # through hold and approach, up to the planned grasp without it
    alone = motion_of(scenario.replace(phases=[]))
    assert_allclose(grasp, alone.row(alone.begin), atol=1e-9)
    step, times = 1e-4, np.concatenate([random.uniform(0.0, 5.0, 20), [3.0 - 2e-4, 3.0 + 2e-4]])
    before, now, after = (motion.rows(times + d) for d in (-step, 0.0, step))
    slope = (after - before) / (2.0 * step)
    assert_allclose(slope[:, 4:nq], now[:, nq + 3 : nq + nv], atol=1e-7)
    assert_allclose(slope[:, nq : nq + nv], now[:, nq + nv :], atol=1e-6)


def test_a_hold_in_the_world_is_at_rest():
    hold = "{hold: {duration: 2, distance: 0.3, direction: [0, 0, 2], relative: world}}"
    scenario = listed(f"[{hold}, approach, stop]")
    rows = motion_of(scenario).rows(np.arange(0.0, 2.0, 0.1))
    assert not np.ptp(rows, axis=0).any()
    place = [*scenario.initial_posture.base_position]
    assert_allclose(rows[0, 4:7], [place[0], place[1], place[2] + 0.3])


@pytest.mark.slow
def test_station_keeping_before_a_capture(tmp_path):
    scenario = listed(
        "[{hold: {duration: 2, distance: 0.05}}, approach, close, stop]",
        "capture.closing={}",
        "capture.envelope={position: null, angle: null}",
    )
    record = run(scenario)
    assert list(counts(record)) == ["hold", "approach", "closing", "stop"]
    assert counts(record)["hold"] == 200
    assert np.abs(record.dataset["error"].values[100:200, 3:6]).max() < 5e-3
    record.save(tmp_path)
    again = RunRecord.load(tmp_path).scenario
    assert again.phases == scenario.phases
    assert np.array_equal(motion_of(again).row(1.0), motion_of(scenario).row(1.0))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("[hold, approach]", "phases: must end with approach, stop"),
        ("[approach, close, stop]", r"must end with approach, stop \(close needs capture.closing"),
        ("[approach, stop, hold]", "phases: must end with approach, stop"),
        (
            "[{hold: 5}, approach, stop]",
            r"phases\[0\]: must be a name, or {name: {setting: value}}",
        ),
        ("[hold, hold, approach, stop]", r"phases\.hold: is there twice"),
        ("[{approach: {duration: 3}}, stop]", r"phases\.approach: has its settings in capture"),
        ("[{hold: {duration: long}}, approach, stop]", r"phases\.hold\.duration: must be a number"),
        ("[{hold: {duration: 0.123}}, approach, stop]", r"phases\.hold\.duration: must be a whole"),
        ("[{hold: {distance: -1}}, approach, stop]", r"phases\.hold\.distance: must be >= 0 m"),
        ("[{hold: {far: 1}}, approach, stop]", r"phases\.hold\.far: unknown key"),
        ("[{hold: {direction: [0, 0, 0]}}, approach, stop]", r"phases\.hold\.direction: must"),
        ("[{park: {}}, approach, stop]", r"phases\.park: 'park' is unknown"),
        ("[{a b: {kind: hold}}, approach, stop]", r"phases\.a b: a phase's name must be letters"),
        (
            "[{one: {kind: hold}}, hold, approach, stop]",
            r"phases\.one: must be the last one before",
        ),
    ],
)
def test_lists_of_phases_that_cannot_be(given, words):
    with pytest.raises((ScenarioError, BlockError), match=words) as found:
        motion_of(listed(given, "duration=40"))
    assert "\n" not in str(found.value)
    assert len(str(found.value)) < 160


HOLD = {
    "distance": (-1, 0.3), "direction": ([1], [0, 0, 1]), "relative": ("it", "world"),
    "duration": (0, 3), "kind": ("a b", "hold"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "wrong", "right"), [(key, *of) for key, of in HOLD.items()])
def test_the_key_of_a_phase_in_an_error_can_be_set(name, wrong, right):
    given = ["[hold, approach, stop]", "duration=40"]
    with pytest.raises(ScenarioError) as found:
        motion_of(listed(*given, f"phases.hold.{name}={json.dumps(wrong)}"))
    assert found.value.key == f"phases.hold.{name}"
    scenario = listed(*given, f"{found.value.key}={json.dumps(right)}")
    assert scenario.phases == [{"hold": {name: right}}, "approach", "stop"]
    motion_of(scenario)


def test_an_error_lists_every_key_of_a_phase():
    with pytest.raises(ScenarioError) as found:
        motion_of(listed("[{hold: {far: 1}}, approach, stop]", "duration=40"))
    assert {*found.value.problem.partition(": ")[2].split(", ")} == {*HOLD}
    with pytest.raises(ScenarioError, match=r"duration: unknown key; .* holds a single"):
        listed("[{hold: {distance: 1}}, approach, stop]", "phases.hold.distance.duration=3")
    with pytest.raises(ScenarioError) as found:
        motion_of(phases("wait={system: hold, settings: {far: 1}}"))
    assert found.value.key == "blocks.phases.wait.settings.far"


def test_a_hold_gives_the_start_of_the_approach():
    """The place of a start that was searched for would not be used."""
    clear = listed("[hold, approach, stop]", "duration=40", "capture.approach.start=clear")
    with pytest.raises(ScenarioError, match=r"start: must be given, because .* phases\.hold ends"):
        motion_of(clear)


def test_phases_need_an_approach():
    with pytest.raises(ScenarioError, match="phases: needs an approach"):
        load_scenario("postcapture", ["phases=[approach, stop]"])
