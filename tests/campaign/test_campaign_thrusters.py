"""Campaigns over thrusters: their failures are values as any other, and what they take is a column."""

import contextlib
import sqlite3

import pytest
from campaign_tools import run_here, write_spec

from ffsm_drake import load_scenario, simulate

CHANGES = {
    "scenario": "thrusters_only",
    "overrides": {"duration": 0.4},
    "controllers": ["tdc"],
    "cases": 4,
    "parameters": {
        "actuation.thrusters.failures.top_1_x": {"distribution": "choice", "values": ["stuck_off", "stuck_on"]},
        "actuation.thrusters.layout": {"distribution": "choice", "values": ["16x22N"]},
    },
    "factors": {},
    "derive": {},
    "settled": {"hold": 0.1},
}
COLUMNS = (
    'case_index, random_seed, outcome, itae, propellant, thrusters_saturated, "actuation.thrusters.failures.top_1_x"'
)


def rows_of(database):
    with contextlib.closing(sqlite3.connect(database)) as connection:
        return connection.execute(
            f"SELECT {COLUMNS} FROM results JOIN cases USING (case_index) ORDER BY case_index"
        ).fetchall()


def test_failures_and_propellant(tmp_path):
    spec = write_spec(tmp_path / "spec.yaml", **CHANGES)
    here = rows_of(run_here(spec, tmp_path / "here.sqlite"))
    assert here == rows_of(run_here(spec, tmp_path / "two.sqlite", workers=2))
    assert {row[-1] for row in here} == {"stuck_off", "stuck_on"}
    _, seed, _, _, propellant, saturated, failure = here[0]
    overrides = ["duration=0.4", "controller=tdc", f"random_seed={seed}"]
    overrides.append(f"actuation.thrusters.failures={{top_1_x: {failure}}}")
    record = simulate(load_scenario("thrusters_only", overrides), check_stability=False)
    assert propellant == pytest.approx(record.metrics["thrusters"]["propellant"])
    assert saturated == pytest.approx(record.metrics["thrusters"]["saturated"])
