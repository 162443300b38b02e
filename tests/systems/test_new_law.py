"""A new law is one file and one registration: it then works in run, compare and campaign, with its
label in figures and tables.
"""

import json

import pytest
from click.testing import CliRunner
from entry_points import installed, needs

from ffsm_drake.cli import main
from ffsm_drake.show.style import label_of, styles_of
from ffsm_drake.systems.registry import find_factory, shipped_names

LAW = '''
import dataclasses

import numpy as np
from ffsm_drake import InjectedDynamics, gain


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stiff(InjectedDynamics):
    """Time-delay control with a stiffness that grows with the error."""

    label = "Stiffening TDC"
    k_p: np.ndarray = gain(100.0, "1/s^2", "gain on the error")
    k_d: np.ndarray = gain(40.0, "1/s", "gain on the error's rate")

    def step(self, e, e_dot, a_d, state):
        return a_d + self.k_d * e_dot + self.k_p * (1.0 + np.abs(e)) * e, {}
'''
REGISTRATION = {"ffsm_drake.controllers": {"stiff": "stiff_law:Stiff"}}


@pytest.fixture
def known(tmp_path_factory, monkeypatch):
    """The law can be found, as after its installation."""
    folder = tmp_path_factory.mktemp("site")
    yield from installed(folder, monkeypatch, {"stiff_law": LAW}, REGISTRATION)


@pytest.fixture
def ffsm(known, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        done = CliRunner().invoke(main, arguments)
        assert done.exit_code == 0, done.output
        return done.stdout

    return call


@pytest.mark.usefixtures("known")
def test_figures_and_tables_show_its_label():
    assert label_of("stiff") == "Stiffening TDC"
    assert len({style.color for style in styles_of(["stiff", "tdc"])}) == 2


@pytest.mark.parametrize("name", shipped_names("controller"))
def test_labels_are_those_of_the_laws(name):
    law = find_factory("controller", name)
    assert label_of(name) == vars(law).get("label", name)
    assert label_of(f"module:{law.__name__}") == law.__name__


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


@pytest.mark.long
@needs("campaign")
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
