"""A new law is one file and one registration: it then works in run, compare, campaign and the live
panel.
"""

import json
import re

import pytest
from click.testing import CliRunner
from meshcat_page import click

from ffsm_drake import load_scenario
from ffsm_drake.cli import main
from ffsm_drake.show.meshcat import start_meshcat
from ffsm_drake.show.meshcat.controls import CODE, UNLOCK
from ffsm_drake.show.meshcat.interactive import QUIT, run_interactive, start_button
from ffsm_drake.systems.registry import block_names

LAW = '''
import dataclasses

import numpy as np
from ffsm_drake import InjectedDynamics, gain


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stiff(InjectedDynamics):
    """Time-delay control with a stiffness that grows with the error."""

    k_p: np.ndarray = gain(100.0, "1/s^2", "gain on the error")
    k_d: np.ndarray = gain(40.0, "1/s", "gain on the error's rate")

    def step(self, e, e_dot, a_d, state):
        return a_d + self.k_d * e_dot + self.k_p * (1.0 + np.abs(e)) * e, {}
'''
REGISTRATION = "[ffsm_drake.controllers]\nstiff = stiff_law:Stiff\n"


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder on Python's path with the law and, as an installed package has it, its entry
    point.
    """
    folder = tmp_path_factory.mktemp("site")
    (folder / "stiff_law.py").write_text(LAW)
    information = folder / "stiff_law-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: stiff-law\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(REGISTRATION)
    return folder


@pytest.fixture
def known(installed, monkeypatch):
    """The law can be found, as after its installation."""
    monkeypatch.syspath_prepend(installed)
    block_names.cache_clear()
    yield
    block_names.cache_clear()


@pytest.fixture
def ffsm(known, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        done = CliRunner().invoke(main, arguments)
        assert done.exit_code == 0, done.output
        return done.stdout

    return call


@pytest.mark.slow
def test_run_and_compare(ffsm, tmp_path):
    ffsm(
        "run",
        "-c",
        "stiff",
        "--set",
        "duration=0.1",
        "--set",
        "controllers.stiff.k_p.joints=90",
        "--no-report",
    )
    manifest = json.loads((tmp_path / "out/postcapture_stiff/manifest.json").read_text())
    assert manifest["blocks"]["controller"]["system"] == "stiff"
    assert manifest["scenario"]["controllers"]["stiff"]["k_p"] == {"all": 100.0, "joints": 90.0}
    assert "stiff " in ffsm(
        "compare", "-c", "stiff", "-c", "tdc", "--set", "duration=0.1", "--no-report"
    )
    assert "stiff" in json.loads(ffsm("schema"))["properties"]["controllers"]["properties"]


@pytest.mark.slow
def test_campaign(ffsm, tmp_path):
    (tmp_path / "spec.yaml").write_text(
        """{scenario: postcapture, overrides: {duration: 0.1}, settled: {hold: 0.1},
        controllers: [stiff, tdc],
        cases: 1,
        parameters: {payload.truth.mass: {distribution: uniform, low: 80, high: 120}}}"""
    )
    out = ffsm("campaign", "run", "spec.yaml", "--database", "spec.db", "--workers", "1")
    assert "2 of 2 runs" in out
    rows = ffsm(
        "campaign", "rerun", "spec.db", "--case", "0", "--controller", "stiff", "--no-recording"
    )
    assert "all values equal the stored ones, bit for bit" in rows


@pytest.mark.usefixtures("known")
def test_the_live_panel():
    meshcat, told = start_meshcat(), []
    steps = iter([start_button("stiff"), QUIT])

    def wait(_):
        if UNLOCK in meshcat.GetButtonNames():
            meshcat.SetSliderValue(CODE, float(re.search(r"type (\d{5}) beside", told[-1])[1]))
            click(meshcat, UNLOCK)
            return
        status = next(name for name in meshcat.GetButtonNames() if name.startswith("[ "))
        if "ready" in status or "completed" in status:
            click(meshcat, next(steps))

    scenario = load_scenario("postcapture", ["duration=0.1"])
    (record,) = run_interactive(
        scenario, meshcat=meshcat, check_stability=False, tell=told.append, wait=wait
    )
    assert record.scenario.controller == "stiff"
    assert record.outcome.completed
