"""Planned motions part of which nothing drives, and laws that command the rest alone."""

import numpy as np
import pytest
from pydrake.systems.framework import LeafSystem

from ffsm_drake import ScenarioError, load_scenario, make_nominal_plant, make_true_plant, simulate
from ffsm_drake.loop.closed_loop import make_closed_loop
from ffsm_drake.mission import make_mission
from ffsm_drake.spacecraft.free_floating import driven_model, free_floating
from ffsm_drake.systems.controllers import make_law
from ffsm_drake.systems.reference import make_motion

JOINTS = ["actuation.driven=[joints]"]
# The base stays where it is, by plan or by leave.
FREE = [
    "target_posture.base_position=[0,0,0]",
    "target_posture.base_rpy=[0,0,0]",
    "disturbance.harmonics={}",
]
FREE += [f"initial_{override[7:]}" for override in FREE[:2]]
TUMBLING = [
    "capture={rate: [0.02, -0.03, 0.04]}",
    "reference.goal=stop",
    "reference.base_rotation=eigenaxis",
]


def make(*overrides):
    scenario = load_scenario("postcapture", [*FREE, *overrides])
    model = make_nominal_plant(scenario)
    return scenario, model, make_motion(make_mission(scenario))


def split(model, rows):
    sizes = np.cumsum([len(model.coordinates.position_names), len(model.coordinates.names)])
    return np.split(rows, sizes, axis=1)


@pytest.mark.parametrize(
    "overrides",
    [JOINTS, ["actuation.driven=[base_rotation, joints]"], [*JOINTS, *TUMBLING]],
    ids=["joints", "attitude too", "with momentum"],
)
def test_inverse_dynamics_of_the_plan_pushes_where_something_drives(overrides):
    _, model, motion = make(*overrides)
    times = np.linspace(0.0, 25.0, 80)
    q, v, a = split(model, motion.rows(times))
    force, driven = model.calc_inverse_dynamics(q, v, a), model.coordinates.is_driven
    assert np.abs(force[:, ~driven]).max() < 1e-12
    assert np.abs(force[:, driven]).max() > 0.01
    assert np.ptp(q[:, ~np.r_[driven[0], driven]], axis=0).max() > 1e-3  # they move all the same
    momentum = free_floating(model, q).momentum(v)
    conserved = slice(0, 6) if not driven[0] else slice(3, 6)
    assert np.ptp(momentum[:, conserved], axis=0).max() < 1e-9
    assert (np.abs(momentum[0]).max() > 0.1) == (overrides[1:] == TUMBLING)


def test_velocities_are_the_rates_of_the_place_that_is_integrated():
    _, model, motion = make(*JOINTS, *TUMBLING)
    step = 1e-3
    around = [motion.row(5.0 + k * step) for k in (-2, -1, 1, 2)]
    rate = np.array([1.0, -8.0, 8.0, -1.0]) @ np.array(around) / (12.0 * step)
    q, v, a = (part[0] for part in split(model, motion.row(5.0)[None]))
    plant, context = model.plant, model.context
    plant.SetPositions(context, q)
    nq = q.size
    assert rate[:nq] == pytest.approx(plant.MapVelocityToQDot(context, v), abs=1e-9)
    assert rate[nq : nq + v.size] == pytest.approx(a, abs=1e-8)


@pytest.mark.smoke
def test_rows_do_not_depend_on_what_was_asked_before():
    asked, fresh = make(*JOINTS)[2], make(*JOINTS)[2]
    asked.rows(np.array([37.0]))
    assert np.array_equal(asked.rows(np.array([3.21])), fresh.rows(np.array([3.21])))


@pytest.mark.parametrize("groups", ["[joints]", "[base_rotation, joints]"])
def test_the_model_of_laws_accelerates_as_the_whole_plant(groups):
    """Under forces on the driven coordinates alone."""
    scenario, model, _ = make(f"actuation.driven={groups}")
    random = np.random.default_rng(3)
    q = np.concatenate([random.standard_normal(4), random.uniform(-1.0, 1.0, 8)])
    q[:4] /= np.linalg.norm(q[:4])
    v, driven = random.uniform(-1.0, 1.0, 11), model.coordinates.driven
    force = np.zeros(11)
    force[driven] = random.uniform(-5.0, 5.0, driven.size)
    whole = np.linalg.solve(model.calc_mass_matrix(q), force - model.calc_bias(q, v))
    reduced = driven_model(model)
    own = np.linalg.solve(reduced.calc_mass_matrix(q), force - reduced.calc_bias(q, v))
    assert own[driven] == pytest.approx(whole[driven], abs=1e-12)
    several = (
        reduced.calc_mass_matrix(np.stack([q, q])),
        reduced.calc_bias(np.stack([q, q]), np.stack([v, v])),
    )
    assert np.array_equal(several[0][1], reduced.calc_mass_matrix(q))
    assert np.array_equal(several[1][1], reduced.calc_bias(q, v))
    law = make_law(make_mission(scenario), model)
    assert np.array_equal(law.model.calc_mass_matrix(q), reduced.calc_mass_matrix(q))


class Everything(LeafSystem):
    """A user's controller that pushes everywhere."""

    def __init__(self, setup):
        super().__init__()
        for name, size in (
            ("estimated_state", 23),
            ("desired_state", 23),
            ("desired_acceleration", 11),
        ):
            self.DeclareVectorInputPort(name, size)
        state = self.DeclareDiscreteState(np.ones(11))
        self.DeclareStateOutputPort("generalized_force", state)


def test_no_force_acts_where_nothing_drives_whatever_is_commanded():
    scenario = load_scenario("postcapture", [*FREE, *JOINTS, "duration=1"])
    record = simulate(scenario, blocks={"controller": Everything})
    applied = record.dataset["applied_force"].values
    assert np.array_equal(applied, np.tile(np.r_[np.zeros(6), np.ones(5)], (len(applied), 1)))
    momentum = record.dataset["linear_momentum"].values
    assert np.abs(momentum).max() < 1e-7
    assert np.abs(record.dataset["velocity"].values[-1, :6]).max() > 1e-3


@pytest.mark.slow
def test_what_is_tracked_counts_and_what_drifts_is_reported():
    record = simulate(load_scenario("postcapture", [*FREE, *JOINTS]), check_stability=False)
    data, metrics = record.dataset, record.metrics
    assert data["driven"].values.tolist() == [False] * 6 + [True] * 5
    error, time = np.abs(data["error"].values), data["time"].values
    assert metrics["itae"] == pytest.approx(
        np.sum(time[:-1] * error[:-1, 6:].sum(axis=1)) * 0.01, rel=1e-12
    )
    assert metrics["peak_error"]["joints"] < 1e-5
    # The true payload takes the base elsewhere than the nominal one, both far from the start.
    assert metrics["final_error"]["base_position"] > 1e-3
    place = data["position"].values[:, 4:7]
    moved = np.linalg.norm(place - place[0], axis=1)
    assert metrics["drift"]["largest"]["base_position"] == pytest.approx(moved.max(), rel=1e-12)
    assert metrics["drift"]["final"]["base_position"] == pytest.approx(moved[-1], rel=1e-12)
    assert moved[-1] > 0.02
    assert 0.02 < metrics["drift"]["final"]["base_rotation"] < 1.0


@pytest.mark.long
def test_momentum_through_a_minute_of_control():
    """To 1e-11 of what the arm's motion gives the base."""
    overrides = ["duration=60", "simulator_config.max_step_size=0.002", "reference.duration=60"]
    scenario = load_scenario("postcapture", [*FREE, *JOINTS, *overrides])
    data = simulate(scenario, check_stability=False).dataset
    model = make_true_plant(scenario)
    given = []
    for q, v in zip(data["position"].values[::100], data["velocity"].values[::100], strict=True):
        given.append(model.calc_mass_matrix(q)[:6, 6:] @ v[6:])
    angular, linear = (
        np.linalg.norm(part, axis=1).max() for part in np.split(np.array(given), 2, axis=1)
    )
    for name, size in (("linear", linear), ("angular", angular)):
        assert np.linalg.norm(data[f"{name}_momentum"].values, axis=1).max() < 1e-11 * size


@pytest.mark.parametrize(
    ("overrides", "problem"),
    [
        (["actuation.driven=[base_position]"], "must be all, [base_rotation, joints] or [joints]"),
        (["actuation.driven=[joints, joints]"], "must be all"),
        (
            [*JOINTS, "actuation.thrusters={}"],
            "thrusters act on base_position, which is not driven",
        ),
        (
            ["actuation.driven=[joints, base_rotation]", "actuation.thrusters={}"],
            "thrusters act on base_position, which is not driven",
        ),
        (
            [*JOINTS, "actuation.wheels={units: {x: {}}}"],
            "wheels act on base_rotation, which is not driven",
        ),
        ([*JOINTS, "target_posture.base_rpy=[0,0,0.1]"], "base_rotation is not driven"),
        (
            [*JOINTS, *TUMBLING, "capture.approach={duration: 5, posture: {base_rpy: [0, 0, 3]}}"],
            "approach.posture.base_rpy: must be as in initial_posture",
        ),
    ],
)
def test_bad_input(overrides, problem):
    with pytest.raises(ScenarioError) as error:
        load_scenario("postcapture", [*FREE, *overrides])
    assert problem in str(error.value).replace("'", "")


def test_a_motion_that_cannot_be_integrated_is_refused_within_a_bound(monkeypatch):
    """At 1e9 rad an angle's rounding alone is beyond the tolerance."""
    monkeypatch.setattr("ffsm_drake.plugins.task_space.free_motion._MOST", 100)
    monkeypatch.setattr("ffsm_drake.plugins.task_space.free_motion._MOST_PER_SECOND", 10)
    scenario = load_scenario("reaction_null", ["initial_posture.joints.shoulder_roll=1e9"])
    with pytest.raises(ScenarioError, match="cannot be integrated"):
        make_closed_loop(scenario)


@pytest.mark.parametrize(
    "duration",
    [
        pytest.param(each, marks=pytest.mark.slow if each == 1e-4 else pytest.mark.long)
        for each in (1e-4, 3e-3, 0.04, 0.5, 3.0)
    ],
)
def test_the_cost_of_a_motion_does_not_grow_as_it_becomes_shorter(duration, monkeypatch):
    """Afterwards nothing moves, however long the run; at rest the momentum is none."""
    _, _, motion = make(*JOINTS, f"reference.duration={duration}")
    calls, usual = [], type(motion).velocity
    monkeypatch.setattr(type(motion), "velocity", lambda *given: calls.append(1) or usual(*given))
    rows = motion.rows(np.array([0.0, duration, 7.3, 40.0]))
    assert 100 < len(calls) < 20_000
    nq = len(motion.coordinates.position_names)
    np.testing.assert_allclose(rows[2:, :nq], np.tile(rows[1, :nq], (2, 1)), atol=1e-8)
    assert np.abs(rows[0, :nq] - rows[1, :nq]).max() > 0.01


def test_a_target_turns_about_its_true_centre_of_mass():
    """It moves the grasp point, and with it where the base goes, though the plans differ in nothing
    else.
    """
    centers = ([0.0, 0.0, 0.0], [0.0, 0.3, 0.0])
    rows = [
        make(*JOINTS, *TUMBLING, f"payload.truth.center_of_mass={center}")[2].row(5.0)
        for center in centers
    ]
    assert np.abs((rows[1] - rows[0])[:7]).max() > 1e-4
