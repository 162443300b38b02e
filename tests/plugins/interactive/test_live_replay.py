"""The live replay of a record under its controls.

No browser: the test moves the sliders and sends the clicks.
"""

import numpy as np
import pytest
from meshcat_page import click, transform

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.plugins.interactive import live
from ffsm_drake.plugins.interactive.live import PLAY, QUIT, SPEED, TIME, LiveReplay, replay_live
from ffsm_drake.show.meshcat import start_meshcat
from ffsm_drake.show.meshcat.arrows import ARROW_KINDS


@pytest.fixture(scope="module")
def meshcat():
    return start_meshcat()


@pytest.fixture
def record(run):
    return run("postcapture", "duration=2")


@pytest.fixture
def replay(meshcat, record):
    meshcat.Delete()
    replay = LiveReplay(record, meshcat=meshcat, forces=True)
    yield replay
    replay.close()


def test_it_plays_at_the_speed_of_its_slider(replay):
    assert replay.step(0.5)
    assert replay.time == pytest.approx(0.5)
    replay.meshcat.SetSliderValue(SPEED, 2.0)
    replay.step(0.25)
    assert replay.time == pytest.approx(1.0)
    assert replay.meshcat.GetSliderValue(TIME) == pytest.approx(1.0)


def test_it_shows_the_record(replay, record):
    replay.step(0.7)
    force = record.dataset["applied_force"].values[70, 3:6]
    arrow = transform(replay.meshcat, ARROW_KINDS[0].path)
    assert arrow[:3, 2] == pytest.approx(force / np.linalg.norm(force), abs=1e-6)


def test_pause_and_play(replay):
    replay.step(0.5)
    click(replay.meshcat, PLAY)
    replay.step(0.5)
    replay.step(0.5)
    assert replay.time == pytest.approx(0.5)
    click(replay.meshcat, PLAY)
    replay.step(0.5)
    assert replay.time == pytest.approx(1.0)


def test_the_time_slider_pauses_there(replay):
    replay.step(0.1)
    replay.meshcat.SetSliderValue(TIME, 1.5)
    replay.step(0.1)
    replay.step(0.1)
    assert not replay.playing
    assert replay.time == pytest.approx(1.5)


def test_it_pauses_at_the_end_and_starts_over(replay):
    replay.step(5.0)
    assert replay.time == pytest.approx(2.0)
    assert not replay.playing
    click(replay.meshcat, PLAY)
    replay.step(0.3)
    assert replay.time == pytest.approx(0.3)


def test_arrow_buttons_hide_and_show(replay):
    labels = [
        name
        for name in replay.meshcat.GetButtonNames()
        if name.startswith("red: disturbance force")
    ]
    assert len(labels) == 1
    shown = {}
    for state in ("hidden", "shown"):
        click(replay.meshcat, labels[0])
        replay.step(0.1)
        shown[state] = replay.meshcat._GetPackedProperty(ARROW_KINDS[2].path, "visible")
    assert shown["hidden"].endswith(b"\xc2")  # msgpack's false
    assert shown["shown"].endswith(b"\xc3")


def test_quit_ends_it_and_takes_the_controls_away(meshcat, record):
    replay = LiveReplay(record, meshcat=meshcat)
    click(meshcat, QUIT)
    assert not replay.step(0.1)
    replay.close()
    assert meshcat.GetButtonNames() == []
    assert meshcat.GetSliderNames() == []


@pytest.mark.parametrize("by_keyboard", [False, True])
def test_replay_live_runs_until_it_is_told_to_stop(meshcat, record, monkeypatch, by_keyboard):
    shown = []

    def sleep(_):
        shown.append(meshcat.GetSliderValue(TIME))
        if len(shown) == 5:
            if by_keyboard:
                raise KeyboardInterrupt
            click(meshcat, QUIT)

    monkeypatch.setattr(live.time, "sleep", sleep)
    replay_live(record, speed=4.0, meshcat=meshcat, ghost=False)
    assert len(shown) == 5
    assert meshcat.GetButtonNames() == []


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_a_bad_speed_gets_one_line(record, meshcat, speed):
    with pytest.raises(FfsmError, match="speed: must be > 0"):
        LiveReplay(record, speed=speed, meshcat=meshcat)
