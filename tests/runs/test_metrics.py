"""Metrics against closed forms."""

import numpy as np
import pytest
import xarray as xr

from ffsm_drake import load_scenario, make_closed_loop
from ffsm_drake.runs.dataset import make_table
from ffsm_drake.runs.metrics import (
    METRICS,
    compute_metrics,
    isv,
    itae,
    momentum_residual,
)
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.runs.table import Table

PERIOD, DURATION = 0.01, 20.0
TIME = PERIOD * np.arange(2000)


@pytest.mark.smoke
def test_constant_error_and_constant_effort():
    error, effort = np.full((2000, 11), -0.3), np.tile(np.arange(11.0), (2000, 1))
    # left sums: L / t_f off
    assert itae(TIME, error, PERIOD) == pytest.approx(11 * 0.3 * DURATION**2 / 2, rel=1e-3)
    assert isv(effort, PERIOD) == pytest.approx(385 * DURATION)


@pytest.mark.parametrize(
    ("scales", "expected"),
    [
        ([], 6.921),
        (["disturbance.frequency_scale=3"], 6.875),
        (["disturbance.amplitude_scale=3"], 9 * 6.921),
    ],
)
@pytest.mark.smoke
def test_energy_of_the_disturbances(scales, expected):
    loop = make_closed_loop(load_scenario("paper", scales))
    port, context = (
        loop.blocks["forces.disturbance"].GetOutputPort("generalized_force"),
        loop.blocks["forces.disturbance"].CreateDefaultContext(),
    )
    values = []
    for time in np.linspace(0, DURATION, 4001):
        context.SetTime(time)
        values.append(port.Eval(context).copy())
    energy = np.trapezoid((np.array(values) ** 2).sum(axis=1), dx=DURATION / 4000)
    assert energy == pytest.approx(expected, rel=2e-4)


def test_metrics_of_a_run(run):
    record = run("postcapture", "duration=5")
    data, metrics = record.dataset, record.metrics
    tau, error = data["generalized_force"].values[:-1], data["error"].values[:-1]
    assert metrics["isv"] == pytest.approx((tau**2).sum() * PERIOD)
    assert metrics["itae"] == pytest.approx((TIME[:500, None] * np.abs(error)).sum() * PERIOD)
    joints = data["group"].values == "joints"
    assert metrics["peak_error"]["joints"] == np.abs(data["error"].values[:, joints]).max()
    assert metrics["final_error"]["base_position"] == np.abs(data["error"].values[-1, 3:6]).max()
    assert set(metrics["peak_effort"]) == {"base_rotation", "base_position", "joints"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("tumbling_capture", ["duration=32"]),
        ("thrusters_and_wheels", []),
        ("flexible_panels", []),
        ("free_floating", []),
        (
            "postcapture",
            ["actuation.limit=5", "actuation.drives={rate_limit: 0.5, coulomb_friction: 0.1}"],
        ),
    ],
)
def test_metrics_need_no_dataset(name, overrides):
    """Those of the table are those of the dataset that is made of it, and the dataset loses
    nothing.
    """
    table = make_table(make_rollout(load_scenario(name, ["duration=2", *overrides])).run())
    dataset = table.to_dataset()
    assert compute_metrics(table) == compute_metrics(dataset)
    assert list(dataset.variables) == list(table.columns)
    assert set(dataset.coords) == set(table.coords)
    for column in table.columns:
        assert dataset[column].dims == table[column].dims
        assert dataset[column].attrs == table[column].attrs
        np.testing.assert_array_equal(dataset[column].values, table[column].values)
    for part in (slice(0, 5), np.arange(len(table["time"].values)) % 2 == 0, [3, 1]):
        xr.testing.assert_identical(table.isel(time=part).to_dataset(), dataset.isel(time=part))


@pytest.mark.parametrize("rate", [0.3, 3.0])
@pytest.mark.smoke
def test_impulse_of_a_smooth_force(rate):
    """A force along y that changes, one along x that is held, and where they act moves along y."""
    time = PERIOD * np.arange(500)
    names = [f"base_{part}_{axis}" for part in ("rotation", "position") for axis in "xyz"]
    force, held, zero = np.zeros((500, 6)), np.zeros((500, 6)), np.zeros((500, 6))
    force[:, 4], held[:, 3] = np.sin(rate * time + 1.0), 2.0
    impulse = np.stack(
        [2.0 * time, (np.cos(1.0) - np.cos(rate * time + 1.0)) / rate, 0.0 * time], axis=1
    )
    path = np.stack([0.0 * time, np.cos(time), 0.0 * time], axis=1)  # of the point where both act
    moment = np.stack([0.0 * time, 0.0 * time, -2.0 * np.sin(time)], axis=1)
    velocity = zero.copy()
    velocity[:, 4] = -np.sin(time)
    along = ("time", "coordinate")
    table = Table().assign(
        {
            "position": (("time", "position_name"), np.hstack([np.zeros((500, 4)), path])),
            "velocity": (along, velocity),
            "applied_force": (along, held),
            "disturbance_force": (along, force),
            "linear_momentum": (("time", "axis"), impulse),
            "angular_momentum": (("time", "axis"), moment),
        },
        {
            "time": ("time", time),
            "coordinate": ("coordinate", names),
            "position_name": ("position_name", ["w", *names]),
        },
    )
    for residual in momentum_residual(table).values():
        # that of a cubic, twice
        assert np.abs(residual).max() < PERIOD**4 * max(rate, 1.0) ** 3 / 200


@pytest.mark.parametrize("units", [("rad",) * 3, ("rad", "m", "rad"), ("m", "m"), ()])
def test_every_effort_in_the_table_has_its_unit(units):
    draw = np.random.default_rng(len(units))
    names = ("rad",) * 3 + ("m",) * 3 + units
    effort = draw.normal(size=(5, len(names)))
    group = ("base_rotation",) * 3 + ("base_position",) * 3 + ("joints",) * len(units)
    along = ("time", "coordinate")
    run = Table().assign(
        {"error": (along, effort), "generalized_force": (along, effort)},
        {
            "coordinate": ("coordinate", names),
            "group": ("coordinate", group),
            "unit": ("coordinate", names),
        },
    )
    shown = {each.unit: each.of(run) for each in METRICS if each.unit[:1] in ("b", "j")}
    for whose, part in (("base", slice(0, 6)), ("joints", slice(6, None))):
        for unit, what in (("rad", "N m"), ("m", "N")):
            own = [i for i in range(len(names))[part] if names[i] == unit]
            largest = np.abs(effort[:, own]).max() if own else None
            assert shown.pop(f"{whose}, {what}") == largest
    assert not shown


def test_the_variables_that_metrics_read_are_those_of_the_record():
    """Campaigns make no record."""
    log = make_rollout(load_scenario("postcapture", ["duration=0.1"])).run()
    record = make_table(log)
    for name in ("position", "velocity", "error", "generalized_force"):
        np.testing.assert_array_equal(log.table[name].values, record[name].values)
