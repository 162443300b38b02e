"""Approaches that keep clear of a tumbling target."""

import dataclasses

import numpy as np
import pytest

from ffsm_drake import ScenarioError, load_scenario
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.capture.approach import approach_posture, given_approach
from ffsm_drake.plugins.capture.contact import planned_contact, target_path
from ffsm_drake.plugins.capture.grasping import Aim
from ffsm_drake.plugins.design.limits_left import CLEARANCE, distances_in, limits_left
from ffsm_drake.plugins.design.remarks import plan_clearance
from ffsm_drake.runs.exceeded_limits import INSTANTS, closest_of
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import EMPTY, planned_part
from ffsm_drake.spacecraft.craft import make_nominal_plant
from ffsm_drake.systems.mission_limits import actuation_limit
from ffsm_drake.systems.reference import make_motion

CLEAR = ["capture.approach.start=clear", "sample_time=0.02"]

# A short approach, at its end.
STILL = ["capture.rate=[0, 0, 0]", "capture.approach.duration=8", "duration=8.1"]


def tumbling(rate, *more):
    return load_scenario("tumbling_capture", [f"capture.rate={list(rate)}", *CLEAR, *more])


def planned(scenario, instants=60):
    """Times, motion [q; v; a] and the target's poses of a planned approach."""
    model = make_nominal_plant(scenario, EMPTY)
    path = Aim(make_mission(scenario)).path[:, :7]
    samples = np.linspace(0, len(path) - 1, instants).round().astype(int)
    times = samples * scenario.sample_time
    nq, nv = len(model.coordinates.position_names), len(model.coordinates.names)
    rows = make_motion(make_mission(scenario), EMPTY).rows(times)
    return model, times, np.split(rows, [nq, nq + nv], axis=1), path[samples]


# One draw each; others weekly.
draws = pytest.mark.parametrize(
    "seed",
    [
        pytest.param(0, marks=pytest.mark.slow),
        *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2, 3)),
    ],
)


@draws
def test_the_planned_approach_keeps_clear_and_is_gentle(seed):
    tumble, height, azimuth = np.random.default_rng(seed).uniform(
        [0.0, -1.0, 0.0], [0.05, 1.0, 6.28]
    )
    flat = np.sqrt(1.0 - height**2)
    rate = tumble * np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), height])
    scenario = tumbling(rate.tolist())
    model, times, (q, v, a), target = planned(scenario)
    for nearest in closest_of(scenario, times, q, target=target):
        assert nearest.distance > scenario.clearance  # at other instants than were looked at
    share = (
        np.abs(model.calc_tracking_force(q, v, a))
        / actuation_limit(scenario, model.coordinates).upper
    )
    assert share.max() <= 0.55
    # it ends where it would have from the posture given
    assert np.allclose(q[-1, 7:], Aim(make_mission(scenario)).reference[7:12], atol=0.05)


@pytest.mark.long
def test_the_start_does_not_depend_on_the_law():
    scenario = tumbling([0.05, 0.0, 0.0])
    posture = approach_posture(make_mission(scenario))
    assert posture != scenario.capture.approach.posture
    assert approach_posture(make_mission(scenario.replace(controller="tdc"))) == posture
    assert given_approach(make_mission(scenario)).start == "given"


@pytest.mark.parametrize("start", ["clear", "given"])
@pytest.mark.parametrize("seed", range(3))
def test_the_planned_part_moves_the_target_as_the_run_does(start, seed):
    rng = np.random.default_rng(seed)
    scenario = load_scenario(
        "tumbling_capture",
        [
            f"capture.rate={rng.uniform(-0.1, 0.1, 3).tolist()}",
            f"capture.approach.start={start}",
            f"payload.truth.inertia={rng.uniform(15, 25, 3).tolist()}",
            f"environment={{altitude: null, mean_motion: {rng.uniform(0.005, 0.01)}}}",
        ],
    )
    model = make_nominal_plant(scenario)
    contact = planned_contact(make_mission(scenario), model)
    part = planned_part(scenario, with_target=start == "given")
    _, path = target_path(scenario, model, contact)
    assert np.array_equal(target_path(part, model, contact)[1], path)
    calm = dataclasses.replace(scenario, environment=None)
    assert not np.array_equal(target_path(calm, model, contact)[1], path)


def test_the_planned_clearance_is_that_from_the_turning_target():
    given = "capture.rate=[0.1, 0.1, 0.1]", "payload.truth.inertia=[10, 22, 30]"
    scenario = load_scenario("tumbling_capture", given)
    _, times, (q, *_), path = planned(scenario, INSTANTS)
    here = list(closest_of(scenario, times, q, target=path))
    assert plan_clearance(make_mission(scenario))[: len(here)] == here


@draws
def test_the_margin_is_kept_beyond_the_clearance(seed):
    margin = np.random.default_rng(seed).uniform(0.005, 0.05)
    scenario = tumbling([0.01, 0.01, 0.0], f"capture.approach.margin={margin}")
    _, times, (q, _, _), target = planned(scenario)
    for nearest in closest_of(scenario, times, q, target=target):
        assert nearest.distance > scenario.clearance + margin - 1e-3


@pytest.mark.long
def test_a_margin_that_cannot_be_kept_is_refused():
    with pytest.raises(ScenarioError, match=r"keeps 0\.51 m from the target"):
        approach_posture(make_mission(tumbling([0.03, 0.02, -0.03], "capture.approach.margin=0.5")))


@pytest.mark.slow
def test_a_target_that_turns_too_fast_is_refused_in_one_line():
    scenario = tumbling([0.0, 1.5, 0.0])
    with pytest.raises(ScenarioError, match=r"capture\.approach\.start: no start within 1 m") as no:
        approach_posture(make_mission(scenario))
    assert "\n" not in str(no.value)


@pytest.mark.long
def test_an_approach_through_the_target_is_seen_in_the_run():
    still = load_scenario("tumbling_capture", STILL)
    clear = still.replace(capture={"approach": {"start": "clear"}})
    log, clear_log = (make_rollout(each).run() for each in (still, clear))
    assert log.outcome.completed
    times, distances = distances_in(log)
    assert distances.min() < -0.05
    assert times[np.argmin(distances)] < still.grasp_time
    assert limits_left(log)[CLEARANCE] < still.grasp_time
    assert clear_log.outcome.completed
    assert CLEARANCE not in limits_left(clear_log)


def test_what_the_arm_cannot_follow_is_met_half_way_through_the_closing():
    """Five joints cannot turn about every axis: the target turns in the gripper that closes."""
    rate = [0.02, 0.06, -0.03]
    at_once = load_scenario("tumbling_capture", [f"capture.rate={rate}"])
    closing = at_once.replace(capture={"closing": {"time": 0.4, "hold": 0.6}})
    model = make_nominal_plant(at_once)
    contact = planned_contact(make_mission(at_once), model)
    arm = model.calc_jacobian(contact.q, model.plant.GetBodyByName("debris").body_frame())
    left = contact.target_velocity - arm @ contact.velocity  # rad/s and m/s
    assert np.linalg.norm(left[:3]) > 0.01
    samples = round(1.0 / at_once.sample_time)
    turned = [
        Aim(make_mission(each)).path[-1 - samples, :4]
        * np.sign(Aim(make_mission(each)).path[-1 - samples, 0])
        for each in (at_once, closing)
    ]
    angle = 2.0 * np.linalg.norm(turned[0] - turned[1])
    assert angle == pytest.approx(0.5 * np.linalg.norm(left[:3]), rel=0.05)
