"""What is tracked and what drifts, in pictures and tables."""

import numpy as np
import pytest

from ffsm_drake.common.numbers import NONE, number
from ffsm_drake.plugins.meshcat.recording import recording_html
from ffsm_drake.plugins.meshcat.replay_view import ReplayView
from ffsm_drake.plugins.meshcat.stage import start_meshcat
from ffsm_drake.plugins.report.comparison import table
from ffsm_drake.plugins.report.time_panels import run_views
from ffsm_drake.show.results import results_of
from ffsm_drake.show.tables import results_table

SHORT = ("duration=1.4", "reference.duration=1", "reference.frame.position=[1.22, 0.59, 1.63]")
POSITION = (*SHORT, "reference.frame.task=position", "reference.frame.rpy=null")


@pytest.fixture
def record(run):
    return run("free_floating", *POSITION)


@pytest.fixture
def by_joints(run):
    """A law of the joints, which do not see where the payload is."""
    return run("free_floating", *POSITION, "controller=tdc")


@pytest.mark.slow
def test_the_recording_shows_where_the_base_was_and_what_went_where(record):
    meshcat = start_meshcat()
    view = ReplayView(meshcat, record, ghost=False, path=True, forces=False)
    assert all(meshcat.HasPath(path) for path in ("drift/start", "drift/path", "frame_path"))
    assert len(view.legend) == 2
    html = recording_html(record, ghost=False)
    assert all(line in html for line in view.legend)
    assert "debris::debris" in view.legend[1]
    bare = ReplayView(start_meshcat(), record, ghost=False, path=False, forces=False)
    assert bare.legend == []


def test_a_spacecraft_that_is_driven_has_none_of_it(run):
    record = run("postcapture", "controller=tdc", "duration=0.3", "reference.duration=0.2")
    view = ReplayView(start_meshcat(), record, ghost=False, path=True, forces=False)
    assert view.legend == []
    assert not any("not tracked" in row.label for row in table(results_of([record])))


def test_the_table_says_what_is_tracked(record, by_joints):
    (alone,) = ({row.label: row for row in table(results_of([record]))},)
    assert "Joints, not tracked" in alone
    assert "Base position, not tracked" in alone
    both = {row.label for row in table(results_of([record, by_joints]))}
    assert "Joints" in both  # one of them tracks them
    assert "Base position, not tracked" in both
    heads = {row.head: row for row in table(results_of([record]))}
    frame, drift = record.metrics["frame"], record.metrics["drift"]
    assert heads["Final error of the frame"].cells[0].text == number(frame["final"]["position"])
    assert heads["Largest drift of the base from its start"].cells[0].text == number(
        drift["largest"]["base_rotation"]
    )
    accuracy = next(iter(alone.values())).cells[0].text
    assert accuracy == number(record.metrics["itae"], 4)


def test_plain_text_has_no_error_where_nothing_tracks(by_joints):
    lines = results_table([by_joints]).splitlines()
    cells = lines[2].split()
    assert cells[4] == NONE  # peak error, m: of the base's position
    assert any(line.startswith("undriven base: final drift") for line in lines)


@pytest.mark.smoke
def test_the_reports_panels(record):
    views = run_views(results_of([record]))
    assert views["error"][0].label == "Frame"
    assert len(views["error"][0].charts) == 6
    forces = views["force"][0]
    assert len(forces.charts) == 5  # of the joints: elsewhere no force acts
    assert np.isfinite(record.dataset["frame_error"].values).all()
