"""Thrusters off after a grasp: what is told of the momentum, and the runs that show it."""

import dataclasses
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from ffsm_drake import RunRecord, ScenarioError, load_scenario, simulate
from ffsm_drake.common.numbers import number
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.capture import momentum
from ffsm_drake.plugins.capture.contact import planned_contact
from ffsm_drake.plugins.capture.momentum import MomentumBudget, momentum_budget, momentum_lines
from ffsm_drake.plugins.design.remarks import plan_remarks
from ffsm_drake.scenario import Scenario
from ffsm_drake.show.tables import results_table
from ffsm_drake.spacecraft.craft import make_nominal_plant, make_true_plant
from ffsm_drake.spacecraft.free_floating import FreeFloating, free_floating
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import models_dir

# From the grasp on, the payload known, without disturbance.
KNOWN = (
    "capture.approach=null",
    "reference.goal=stop",
    "reference.duration=3",
    "duration=4",
    "controller=tdc",
    "payload.nominal={mass: 100, inertia: [16.7, 16.7, 16.7]}",
    "disturbance.amplitude_scale=0",
    "sensing={velocity_noise: 1.0e-8, position_noise: 0}",
    "estimator.kind=one_sample",
)
JOINTS = "actuation={driven: [joints]}"


def wheels(speed_limit: float = 60.0) -> str:
    units = ", ".join(
        f"{name}: "
        f"{{axis: {axis}, inertia: 0.08, torque_limit: 4, speed_limit: {speed_limit}, "
        f"initial_momentum: {h}}}"
        for name, axis, h in (
            ("a", [1, 1, 1], 0.3),
            ("b", [-1, 1, 1], 0.0),
            ("c", [-1, -1, 1], 0.1),
            ("d", [1, -1, 1], -0.2),
        )
    )
    return f"actuation={{driven: [base_rotation, joints], wheels: {{units: {{{units}}}}}}}"


def known(*overrides: str) -> Scenario:
    return load_scenario("tumbling_capture", [*KNOWN, *overrides])


def told(scenario: Scenario) -> MomentumBudget:
    budget = momentum_budget(make_mission(scenario))
    assert budget is not None
    return budget


def last(record: RunRecord, name: str) -> np.ndarray:
    values: np.ndarray = record.dataset[name].values[-1]
    return values


def centers(record: RunRecord, model: PlantModel) -> np.ndarray:
    """Of mass, at the start and at the end (2, 3), m."""
    q = record.dataset["position"].values[[0, -1]]
    return q[:, 4:7] + free_floating(model, q).center_of_mass


@pytest.mark.slow
def test_with_the_arm_alone_the_stack_turns_and_drifts_as_told() -> None:
    accepted = "capture.accepted_drift={base_rotation: 0.005, base_position: 0.003}"
    scenario = known(JOINTS, accepted, "simulator_config.max_step_size=0.005")
    budget = told(scenario)
    remarks = [
        line for line in plan_remarks(scenario) if line.startswith("capture.accepted_drift.")
    ]
    assert [line.split(":")[0].rsplit(".")[-1] for line in remarks] == [
        "base_rotation",
        "base_position",
    ]
    record = simulate(scenario, check_stability=False)
    data, model = record.dataset, make_true_plant(scenario)
    for name in ("linear_momentum", "angular_momentum"):
        values = data[name].values
        assert np.abs(values - values[0]).max() <= 1e-9 * np.linalg.norm(values[0])
    assert_allclose(budget.linear, data["linear_momentum"].values[0], rtol=1e-12)
    assert record.grasp is not None
    assert_allclose(budget.angular, record.grasp["after"]["spin"], rtol=1e-12)
    assert budget.rate == pytest.approx(np.linalg.norm(last(record, "velocity")[:3]), rel=1e-4)
    assert np.abs(last(record, "velocity")[6:]).max() < 1e-5
    moved = np.diff(centers(record, model), axis=0)[0]
    assert_allclose(moved, 4.0 * np.array(budget.linear) / budget.mass, rtol=1e-6)
    assert budget.drift == pytest.approx(np.linalg.norm(moved) / 4.0, rel=1e-6)
    # When the accepted drift is used up: within a sample of the run.
    q = data["position"].values
    angle = Rotation.from_quat(q[:, [1, 2, 3, 0]]) * Rotation.from_quat(q[0, [1, 2, 3, 0]]).inv()
    for group, gone in (
        ("base_rotation", angle.magnitude()),
        ("base_position", np.linalg.norm(q[:, 4:7] - q[0, 4:7], axis=1)),
    ):
        assert budget.used_up[group] == pytest.approx(
            np.interp(budget.accepted[group], gone, data["time"]), abs=0.01
        )
    lines = results_table([record])
    assert all(line in lines for line in momentum_lines(record.grasp["momentum_budget"]))
    assert f"turns the stack at {math.degrees(budget.rate or 0.0):.3f} deg/s" in lines


@pytest.mark.slow
def test_what_lasts_longer_than_the_plan_is_that_of_the_stack_at_rest() -> None:
    accepted = "capture.accepted_drift={base_rotation: 0.05, base_position: 0.03}"
    short, long = (told(known(JOINTS, accepted, f"duration={end}")).used_up for end in (4, 40))
    for group, time in short.items():
        assert time is not None
        assert 10.0 < time < 40.0
        assert time == pytest.approx(long[group], abs=0.05)
    assert told(known(JOINTS, "capture.accepted_drift.base_position=5")).used_up == {
        "base_position": None
    }


def test_wheels_take_the_angular_momentum() -> None:
    scenario = known(wheels())
    budget = told(scenario)
    record = simulate(scenario, check_stability=False)
    data = record.dataset
    assert budget.storage is not None
    assert np.abs(data["error"].values[:, :3]).max() < 1e-6
    assert np.linalg.norm(last(record, "velocity")[:3]) < 1e-6
    assert budget.rate is None
    held = last(record, "stored_momentum")
    total = np.array(budget.angular) + data["stored_momentum"].values[0]
    assert_allclose(held, total, rtol=1e-3, atol=1e-3 * np.linalg.norm(total))
    assert budget.storage.momentum == pytest.approx(np.linalg.norm(total))
    assert record.grasp is not None
    spin = np.array(record.grasp["after"]["spin"])  # of the bodies, not of the wheels
    assert np.linalg.norm(record.grasp["stored_momentum"]) > 0.1
    assert_allclose(budget.angular, spin, rtol=1e-12)
    after, *_ = momentum_lines(dataclasses.asdict(budget))
    assert f"{number(float(np.linalg.norm(spin)))} N m s about the centre of mass" in after
    shares = np.abs(data["wheel_speed"].values) / 60.0
    assert budget.storage.share == pytest.approx(shares[-1].max(), rel=1e-3)
    assert budget.storage.peak_share == pytest.approx(shares.max(), rel=2e-2)  # sensor noise, too
    assert budget.storage.fullest == data["wheel"].values[int(shares.max(axis=0).argmax())]
    moved = np.diff(centers(record, make_true_plant(scenario)), axis=0)[0]
    assert_allclose(moved, 4.0 * np.array(budget.linear) / budget.mass, rtol=1e-6)


def test_wheels_that_are_too_small_are_told_of_and_saturate() -> None:
    scenario = known(wheels(speed_limit=4.0), "duration=2")
    budget = told(scenario)
    assert budget.storage is not None
    assert budget.storage.least_capacity <= budget.storage.capacity < budget.storage.momentum
    assert budget.storage.peak_share >= budget.storage.share > 1.0
    assert budget.rate is not None
    assert any(line.startswith("actuation.wheels: ") for line in plan_remarks(scenario))
    record = simulate(scenario, check_stability=False)
    assert record.metrics["wheels"]["speed_used"] == pytest.approx(1.0, abs=0.02)
    assert np.abs(record.dataset["error"].values[:, :3]).max() > 1e-3


@pytest.mark.smoke
def test_what_wheels_hold_is_what_their_directions_say() -> None:
    settings = known(wheels()).wheels
    assert settings is not None
    from ffsm_drake.plugins.actuators.wheel_set import WheelSet

    units = WheelSet(settings, sample_time=0.01, alone=True)
    directions = np.random.default_rng(3).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    most = np.array([units.capacity(each) for each in directions])
    assert_allclose(units.filled(most[:, None] * directions).max(axis=1), 1.0, rtol=1e-12)
    assert units.least_capacity <= most.min() <= 1.01 * units.least_capacity
    # They start there.
    start = units.axes @ units.initial_momentum
    assert_allclose(units.filled(start), np.abs([0.3, 0.0, 0.1, -0.2]) / (0.08 * 60.0), atol=1e-12)


def stack_at_grasp(scenario: Scenario) -> tuple[PlantModel, np.ndarray, np.ndarray]:
    model = make_nominal_plant(scenario)
    contact = planned_contact(make_mission(scenario), model)
    return model, contact.q, contact.spin_after


def on_joints(stack: FreeFloating) -> np.ndarray:
    return stack.spin_map[:, 6:]


def test_the_arm_holds_the_momentum_while_it_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Along the motion that is found the base stays, where with the joints at rest it would turn by
    0.1 rad.
    """
    scenario, path = known(JOINTS), []

    class Recorder(momentum.Clearance):
        def nearest(self, q: np.ndarray, *, below: float = np.inf):
            path.append(q.copy())
            return super().nearest(q, below=below)

    monkeypatch.setattr(momentum, "Clearance", Recorder)
    model, q, angular = stack_at_grasp(scenario)
    found = momentum._arm_budget(make_mission(scenario), model, q, angular)
    assert found.capacity is None
    assert found.ended_by == "base and debris come within 0.01 m of each other"
    assert found.time is not None
    assert found.time > 40.0
    positions = np.array(path)
    steps = np.diff(positions, axis=0)[:, 7:]
    maps = free_floating(model, 0.5 * (positions[1:] + positions[:-1])).spin_map
    # The time that each step takes if the joints are to hold all along it, and how far the base
    # turns then.
    moved = (maps[:, :, 6:] @ steps[..., None])[..., 0]
    times = (moved @ angular) / (angular @ angular)
    turned = np.linalg.solve(maps[:, :, :3], (moved - times[:, None] * angular)[..., None])[..., 0]
    assert times.sum() == pytest.approx(found.time, rel=2e-2)
    assert np.linalg.norm(turned.sum(axis=0)) < 3e-3


def test_limits_of_the_joints_bound_what_the_arm_holds(tmp_path) -> None:
    def limited(range_: float, velocity: float) -> tuple[Scenario, PlantModel]:
        text = (models_dir() / "urdf" / "servicer.urdf").read_text()
        start = known(JOINTS).initial_posture.joints
        for name, at in start.items():
            limit = (
                f'<limit lower="{at - range_}" upper="{at + range_}" effort="50" '
                f'velocity="{velocity}"/>'
            )
            text = text.replace(
                f'<joint name="{name}" type="continuous">',
                f'<joint name="{name}" type="revolute">{limit}',
            )
        (tmp_path / "servicer.urdf").write_text(text)
        scenario = known(
            JOINTS, "model.directives=null", f"model.servicer={tmp_path}/servicer.urdf"
        )
        return scenario, make_nominal_plant(scenario)

    scenario, model = limited(0.05, 0.5)
    model, q, angular = stack_at_grasp(scenario)
    budget = momentum._arm_budget(make_mission(scenario), model, q, angular)
    columns, size = on_joints(free_floating(model, q)), np.linalg.norm(angular)
    # Duality: the least of the bounds that any weights give.
    across = np.linalg.svd(angular[None])[2][1:]

    def bound(weights: np.ndarray) -> float:
        return float(0.5 * np.abs(columns.T @ (angular / size + weights @ across)).sum())

    least = min(minimize(bound, start, method="Nelder-Mead").fun for start in np.eye(2))
    assert budget.capacity == pytest.approx(least, rel=1e-3)
    # Of all rates that hold it there, those that last longest.
    some = np.linalg.pinv(columns) @ angular
    free, rng = np.linalg.svd(columns)[2][3:], np.random.default_rng(5)
    longest = max(
        0.05 / np.abs(some + weights @ free).max() for weights in 0.1 * rng.normal(size=(20000, 2))
    )
    assert budget.time == pytest.approx(longest, rel=0.05)
    assert budget.ended_by.endswith("reaches its limit")

    slow = 0.5 * size / budget.capacity * 0.9
    scenario, model = limited(0.05, slow)
    held = momentum._arm_budget(make_mission(scenario), *stack_at_grasp(scenario))
    assert held.capacity == pytest.approx(0.9 * size, rel=1e-6)
    assert (held.time, held.ended_by) == (0.0, "no joint rates hold it there")


def test_where_all_is_driven_force_and_torque_take_it_out() -> None:
    budget = told(known())
    assert (budget.arm, budget.storage, budget.drift, budget.rate) == (None, None, None, None)
    assert budget.least_time == pytest.approx(
        {
            "base_rotation": np.abs(budget.angular).max() / 10.0,
            "base_position": np.abs(budget.linear).max() / 22.0,
        }
    )
    assert momentum_budget(make_mission(load_scenario("postcapture"))) is None


@pytest.mark.parametrize(
    ("override", "problem"),
    [
        ("capture.accepted_drift.base_rotation=0.1", "leave it out"),
        (f"{JOINTS} capture.accepted_drift.base_rotation=4", "below pi, not 4"),
        (f"{JOINTS} capture.accepted_drift.base_position=0", "must be > 0, not 0"),
        (f"{JOINTS} capture.accepted_drift.joints=1", "choose one of base_rotation, base_position"),
    ],
)
def test_bad_accepted_drift_is_refused(override: str, problem: str) -> None:
    *before, final = override.rsplit(" ", 1)
    with pytest.raises(ScenarioError, match=problem):
        known(*before, final)
