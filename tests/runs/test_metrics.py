"""Metrics against closed forms."""

import numpy as np
import pytest

from ffsm_drake import load_scenario, make_closed_loop
from ffsm_drake.runs.metrics import isv, itae

PERIOD, DURATION = 0.01, 20.0
TIME = PERIOD * np.arange(2000)


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


def test_disturbance_is_table_1():
    loop = make_closed_loop(load_scenario("paper"))
    disturbance = loop.blocks["forces.disturbance"]
    context = disturbance.CreateDefaultContext()
    t = 3.7
    context.SetTime(t)
    value = dict(
        zip(
            loop.coordinates.names,
            loop.blocks["forces.disturbance"].GetOutputPort("generalized_force").Eval(context),
            strict=True,
        )
    )
    for part in ("base_position", "base_rotation"):
        expected = (0.4 * np.sin(0.3 * t), 0.3 * np.cos(0.1 * t), 0.2 * np.sin(0.3 * t))
        assert [value[f"{part}_{axis}"] for axis in "xyz"] == pytest.approx(expected)
    expected = (
        0.1 * np.sin(1.2 * t), 0.08 * np.sin(0.1 * t) + 0.1, -0.1 * np.sin(0.6 * t),
        0.09 * np.sin(0.8 * t + np.pi / 4) - 0.1, 0.1 * np.cos(t) + 0.1,
    )  # fmt: skip
    assert [value[f"joint_{i}"] for i in range(1, 6)] == pytest.approx(expected)


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
