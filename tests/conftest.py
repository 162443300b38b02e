"""Runs that several tests look at, computed once per process."""

import functools

import pytest

from ffsm_drake import RunRecord, load_scenario, simulate


@functools.cache
def _run(name: str, *overrides: str) -> RunRecord:
    return simulate(load_scenario(name, overrides))


@pytest.fixture(scope="session")
def run():
    """run(scenario, *overrides) -> RunRecord; the same arguments give the same record."""
    return _run
