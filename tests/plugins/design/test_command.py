"""``ffsm stability``: what it prints, writes and answers with."""

import json

import pytest
from click.testing import CliRunner

from ffsm_drake.cli import main
from ffsm_drake.plugins.design.stability import boundaries
from ffsm_drake.plugins.design.stability.boundaries import Boundaries


def ffsm(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.mark.long
def test_stability(tmp_path, monkeypatch):
    """Its table and picture of a stable loop: ``test_stability.py``."""
    unstable = ffsm("stability", "--set", "controllers.tde_aismc.k_s_initial=150", "--json")
    assert unstable.exit_code == 3
    data = json.loads(unstable.stdout)
    assert data["stable"] is False
    assert data["coordinates"]["joint_1"]["k_s_limit"] == pytest.approx(100, rel=1e-6)
    found = Boundaries(
        gains=1.25, nominal_payload=float("inf"), sample_time=1.25, flexible_mass={}, delay=3.0
    )
    monkeypatch.setattr(boundaries, "find_boundaries", lambda scenario, *, time: found)
    other = ffsm("stability", "-c", "pd_plus", "--limits", "--out", tmp_path / "other")
    assert other.exit_code == 0
    assert "nominal payload" in other.stdout
    without = ffsm("stability", "-c", "pd_plus", "--no-rehearsal")
    assert "stability limits, one parameter at a time: --limits" in without.stdout
    assert "worst posture: 0.9996" in other.stdout
    assert (tmp_path / "other" / "stability.png").is_file()


@pytest.mark.long
@pytest.mark.usefixtures("few_delays")
def test_stability_with_disk_margins():
    options = ("-c", "tdc", "--set", "duration=3", "--no-rehearsal", "--disk")
    shown = ffsm("stability", *options)
    assert shown.exit_code == 0, shown.output
    assert "all at once" in shown.stdout
    data = json.loads(ffsm("stability", *options, "--json").stdout)["disk"]
    assert data["names"][-1] == "joint_5"
    assert 0.0 < data["together"] <= min(data["alone"])
