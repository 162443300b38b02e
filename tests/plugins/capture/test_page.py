"""The report's section of a grasp."""

import numpy as np
import pytest
from near_captures import approach

from ffsm_drake import FfsmError
from ffsm_drake.plugins.report.page import render_report
from ffsm_drake.show.tables import results_table


def left_out(_):
    raise FfsmError("left out")


@pytest.mark.slow
def test_the_report_tells_of_the_grasp(run, monkeypatch):
    captured = run("tumbling_capture", "duration=2.5", approach(2))
    for section in ("analysis.page.analyze", "design.panels.stability"):  # cost most of it
        monkeypatch.setattr(f"ffsm_drake.plugins.{section}", left_out)
    page = render_report([captured])
    assert '<section id="grasp">' in page
    assert "Angular momentum about the centre of mass [N m s]" in page
    assert f"Grasp at t = 2 s: impulse {np.linalg.norm(captured.grasp['impulse']):.3g} N s" in page
    assert page.count("<td") > 40
    assert "\ngrasp at t = 2 s" in results_table([captured])
    both = results_table([captured, captured])
    assert both.count(f"\n{captured.scenario.controller}: grasp at t = 2 s") == 2
