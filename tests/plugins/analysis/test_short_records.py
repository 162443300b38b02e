"""Runs of a few periods: no figure is NaN, and NumPy warns of nothing."""

import dataclasses
import functools
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ffsm_drake import FfsmError, RunRecord, analyze, load_scenario, simulate
from ffsm_drake.plugins.design.limit import find_limit
from ffsm_drake.plugins.design.stability.prediction import predict
from ffsm_drake.show.tables import results_data, results_table

# plain; wheels, and thrusters that open in frames; slow sensors; an undriven base
NAMES = ("postcapture", "thrusters_and_wheels", "slow_navigation", "free_floating")


@pytest.fixture(autouse=True)
def _warnings_are_errors():
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        yield


def numbers(tree):
    if isinstance(tree, dict):
        for inner in tree.values():
            yield from numbers(inner)
    elif isinstance(tree, (int, float)):
        yield tree


@functools.cache
def scenario_of(name, periods):
    scenario = load_scenario(name)
    return dataclasses.replace(scenario, duration=periods * scenario.sample_time)


@functools.cache
def recorded(name):
    return simulate(scenario_of(name, 6), check_stability=False)


@given(st.sampled_from(NAMES), st.integers(1, 7), st.data())
@settings(deadline=None, max_examples=20)
def test_a_record_of_few_rows_has_all_its_figures(name, rows, data):
    whole = recorded(name)
    first = data.draw(st.integers(0, 7 - rows))
    part = whole.dataset.isel(time=slice(first, first + rows))
    record = dataclasses.replace(whole, dataset=part)
    assert np.isfinite([*numbers(record.metrics)]).all()
    assert np.isfinite([*numbers(results_data([record])[0]["metrics"])]).all()
    assert results_table([record])
    assert all("nan" not in found.statement for found in analyze(record).findings)


@pytest.mark.slow
@given(st.sampled_from(("postcapture", "thrusters_and_wheels")), st.integers(1, 3))
@settings(deadline=None, max_examples=4)
def test_what_is_foretold_of_few_periods_is_finite(name, periods):
    scenario = scenario_of(name, periods)
    predicted = predict(scenario)
    assert np.isfinite(predicted.rms_error).all()
    assert np.isfinite(predicted.isv_by_coordinate).all()
    if periods > 1:
        assert find_limit(scenario).distance > 0.0
    else:
        with pytest.raises(FfsmError, match="two control periods"):
            find_limit(scenario)


@pytest.mark.parametrize("rows", [2, 3, 4])
def test_momentum_of_few_rows_is_in_balance(rows):
    whole = recorded("postcapture")
    record: RunRecord = dataclasses.replace(whole, dataset=whole.dataset.isel(time=slice(rows)))
    moves = np.abs(whole.dataset["applied_force"].values[:rows]).max() * 0.01
    for size in record.metrics["momentum_residual"].values():
        assert size < 1e-2 * moves
