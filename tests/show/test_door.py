"""What pages of any kind send to a live view, and that neither run nor record suffers."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from contextlib import contextmanager

import msgpack
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidHandshake, WebSocketException
from websockets.sync.client import connect

from ffsm_drake import RunRecord
from ffsm_drake.show.meshcat.controls import CODE, UNLOCK
from ffsm_drake.show.meshcat.door import BadFrame, live_server, page_event
from ffsm_drake.show.meshcat.interactive import start_button
from ffsm_drake.show.meshcat.live import QUIT

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text()
    | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)  # fmt: skip
KINDS = st.sampled_from(["button", "slider", "gamepad", "camera_pose", "img", ""])
NAMES = st.sampled_from([QUIT, CODE, UNLOCK, "nobody"]) | st.text()
EVENTS = st.fixed_dictionaries(
    {"type": KINDS | VALUES},
    optional={
        "name": NAMES | VALUES,
        "value": st.floats() | VALUES,
        "camera_pose": st.lists(st.floats(), max_size=17) | VALUES,
        "is_perspective": st.booleans() | VALUES,
        "gamepad": VALUES,
    },
)
PACKED = (EVENTS | VALUES).map(msgpack.packb)
HUGE = st.integers(4000, 200_000).map(bytes)
FRAMES = st.one_of(
    st.just(b""),
    st.binary(),
    st.text(),
    PACKED,
    st.tuples(PACKED, st.integers(0, 40)).map(lambda drawn: drawn[0][: drawn[1]]),
    PACKED.map(lambda packed: packed + b"\x00"),
    st.integers(1, 3000).map(lambda depth: b"\x91" * depth),  # nested without end
    HUGE,
)
SITES = st.sampled_from([None, "", "null", "http://evil.example", "http://localhost:1"])


@given(FRAMES)
def test_only_clicks_and_finite_values_come_through(frame):
    try:
        event = page_event(frame)
    except BadFrame:
        return
    if event is not None:
        read = msgpack.unpackb(event)
        assert read["type"] in ("button", "slider")
        assert isinstance(read["name"], str)
        assert ("value" in read) == (read["type"] == "slider")
        assert abs(read.get("value", 0.0)) < float("inf")


def page_at(url, site):
    """A page of a site; it reads the scene, else it would not see that it is closed."""
    return connect(
        url.replace("http", "ws"), origin=site, compression=None, max_size=None, max_queue=None,
        close_timeout=1.0,
    )  # fmt: skip


def send_as(url, site, frame):
    """What becomes of a frame of a page of a site."""
    try:
        with page_at(url, site) as page:
            page.send(frame)
            page.close()
    except (WebSocketException, ConnectionError):
        pass  # closed before or after: which is no matter


def hostile_frames(url, count):
    """Send ``count`` frames, nearly all of them as the view's own page would."""
    sent = []

    @settings(
        max_examples=count, deadline=None, database=None, derandomize=True,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(st.integers(0, 9).flatmap(lambda k: SITES if k == 0 else st.just(url)), FRAMES)
    def send(site, frame):
        send_as(url, site, frame)
        sent.append(frame)

    send()
    return len(sent)


@contextmanager
def command(*arguments):
    """A command of the terminal, and a function that waits for a line with a pattern."""
    process = subprocess.Popen(
        [sys.executable, "-m", "ffsm_drake", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"BROWSER": "true"},
    )
    lines = []
    reader = threading.Thread(target=lambda: lines.extend(iter(process.stderr.readline, "")))
    reader.start()

    def told(pattern, seconds=60.0):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if found := re.search(pattern, "".join(lines)):
                return found
            assert process.poll() is None, lines
            time.sleep(0.02)
        raise AssertionError(lines)

    try:
        yield process, told
    finally:
        process.kill()
        process.wait()
        reader.join()
        process.stderr.close()


ADDRESS = r"connections at (\S+)"


def press(page, *buttons):
    for name in buttons:
        page.send(msgpack.packb({"type": "button", "name": name}))


def run_watched(tmp_path, count):
    length = 4 + count // 20
    with command(
        "run", "--meshcat", "--no-report", "--set", f"duration={length}", "--out", str(tmp_path)
    ) as (process, told):
        sent = hostile_frames(told(ADDRESS)[1], count)
        assert process.wait(length + 60) == 0
    return sent, RunRecord.load(tmp_path)


def run_with_controls(tmp_path, count):
    length = 4 + count // 20
    with command(
        "run", "--controls", "--no-report", "--set", f"duration={length}", "--out", str(tmp_path)
    ) as (process, told):
        url = told(ADDRESS)[1]
        code = told(r"type (\d{5}) beside")[1]
        with page_at(url, url) as page:
            page.send(msgpack.packb({"type": "slider", "name": CODE, "value": int(code)}))
            press(page, UNLOCK)
            told("are unlocked")
            time.sleep(0.3)  # the panel is drawn
            press(page, start_button("tde_aismc"))
            time.sleep(1.0)
        sent = hostile_frames(url, count)
        end = time.monotonic() + length + 60
        while not (tmp_path / "run_1/record.nc").exists() and time.monotonic() < end:
            assert process.poll() is None
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) >= 0
    return sent, RunRecord.load(tmp_path / "run_1")


def replay_served(record, count):
    with command("replay", "--live", str(record)) as (process, told):
        url = told(ADDRESS)[1]
        sent = 0
        while sent < count and process.poll() is None:  # a drawn click may be on Quit
            sent += hostile_frames(url, count)
        assert process.poll() in (None, 0)
        if process.poll() is None:
            with page_at(url, url) as page:
                press(page, QUIT)
                assert process.wait(60) == 0
    return sent


@pytest.mark.parametrize("count", [70, pytest.param(1670, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("live", [run_watched, run_with_controls])
def test_no_frame_costs_a_record(live, count, tmp_path):
    sent, record = live(tmp_path, count)
    assert sent >= count
    assert record.outcome.status == "completed"


@pytest.mark.parametrize("count", [70, pytest.param(1670, marks=pytest.mark.exhaustive)])
def test_no_frame_ends_a_replay(count, tmp_path, run):
    run("postcapture", "duration=1").save(tmp_path)
    assert replay_served(tmp_path, count) >= count


@pytest.fixture(scope="module")
def served():
    with live_server(None) as view:
        yield view


@given(site=SITES)
@settings(max_examples=10, deadline=None, suppress_health_check=list(HealthCheck))
def test_pages_of_other_sites_stay_outside(served, site):
    meshcat, url = served
    with pytest.raises(InvalidHandshake), connect(url.replace("http", "ws"), origin=site):
        pass
    assert meshcat.GetNumActiveConnections() == 0


@pytest.mark.parametrize("host", ["evil.example", "evil.example:7000", "127.evil.example", ""])
def test_other_names_of_this_machine_get_no_page(served, host):
    request = urllib.request.Request(served[1], headers={"Host": host})
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(request)


def until_closed(page):
    while True:
        page.recv(timeout=10.0)


def test_a_page_of_ours_is_served_shown_and_heard(served):
    meshcat, url = served
    with urllib.request.urlopen(url) as page:
        assert b"<!DOCTYPE html>" in page.read()
    meshcat.AddButton("pressed")
    meshcat.AddSlider("moved", 0.0, 1.0, 0.1, 0.0)
    with page_at(url, url) as page:
        assert isinstance(page.recv(timeout=10.0), bytes)
        press(page, "pressed")
        page.send(msgpack.packb({"type": "camera_pose", "camera_pose": []}))  # of no interest
        page.send(msgpack.packb({"type": "slider", "name": "moved", "value": 1}))
        end = time.monotonic() + 10.0
        while meshcat.GetSliderValue("moved") != 1.0 and time.monotonic() < end:
            time.sleep(0.01)
        assert meshcat.GetSliderValue("moved") == 1.0
        assert meshcat.GetButtonClicks("pressed") == 1
        page.send(b"")
        with pytest.raises(ConnectionClosed, match="1008"):
            until_closed(page)
