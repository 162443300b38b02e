"""What pages of any kind send to a live view, and that neither run nor record suffers."""

import collections
import os
import re
import signal
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
from contextlib import contextmanager, suppress

import msgpack
import pytest
from children import DEVNULL, PIPE, child, finished
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from meshcat_page import resident
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import connect

from ffsm_drake import RunRecord, load_scenario
from ffsm_drake.plugins.interactive.controls import CODE, UNLOCK
from ffsm_drake.plugins.interactive.door import live_server, page_event
from ffsm_drake.plugins.interactive.panel import PAUSE, QUIT, start_button
from ffsm_drake.plugins.live.door import BadFrame
from ffsm_drake.plugins.meshcat.stage import set_stage

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
OF_THE_PAGE = st.one_of(
    st.fixed_dictionaries({"type": st.just("button"), "name": NAMES}),
    st.fixed_dictionaries(
        {"type": st.just("slider"), "name": NAMES, "value": st.floats() | st.integers(-9, 9)}
    ),
)
PACKED = (EVENTS | VALUES | OF_THE_PAGE).map(msgpack.packb)
HUGE = st.integers(4000, 200_000).map(bytes)
FRAMES = st.one_of(
    st.just(b""),
    st.binary(),
    st.text(),
    PACKED,
    OF_THE_PAGE.map(msgpack.packb),
    st.tuples(PACKED, st.integers(0, 40)).map(lambda drawn: drawn[0][: drawn[1]]),
    PACKED.map(lambda packed: packed + b"\x00"),
    st.integers(1, 3000).map(lambda depth: b"\x91" * depth),  # nested without end
    HUGE,
)
SITES = st.sampled_from([None, "", "null", "http://evil.example", "http://localhost:1"])


@pytest.mark.slow
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


def until_closed(page):
    while True:
        page.recv(timeout=10.0)


def fate(url, site, frame):
    """What the server says of a frame of a page of a site: "outside", if the page is not let in;
    "heard", if it answers after the frame; else the code with which it closes for the frame.
    """
    try:
        with page_at(url, site) as page:
            try:
                page.send(frame)
                if predicted(frame) == "heard":
                    return "heard" if page.ping().wait(30.0) else "silent"
                until_closed(page)
            except ConnectionClosed as closed:
                return closed.rcvd.code if closed.rcvd else "lost"
    except InvalidStatus as error:
        return "outside" if error.response.status_code == 403 else error.response.status_code


def predicted(frame):
    """What is to become of a frame of the view's own page."""
    if len(frame if isinstance(frame, bytes) else frame.encode()) > 4096:
        return 1009
    try:
        page_event(frame)
    except BadFrame:
        return 1008
    return "heard"


def ends_the_run(frame):
    """Whether a frame clicks what an operator ends or halts a run with."""
    with suppress(BadFrame):
        event = msgpack.unpackb(page_event(frame) or b"\x80")
        return event.get("name") in (QUIT, PAUSE, start_button("tde_aismc"))


def hostile_frames(process, url, count):
    """Send frames until ``count`` of them have reached the door of a command that still runs."""
    arrived = collections.Counter()
    ours = st.tuples(st.just(url), FRAMES.filter(lambda frame: not ends_the_run(frame)))

    @settings(
        max_examples=count + count // 5, deadline=None, database=None, derandomize=True,
        phases=[Phase.generate], suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(st.integers(0, 11).flatmap(lambda k: ours if k else st.tuples(SITES, FRAMES)))
    def send(drawn):
        site, frame = drawn
        found = fate(url, site, frame)
        assert found == (predicted(frame) if site == url else "outside"), drawn
        arrived[found] += 1
        assert process.poll() is None

    send()
    assert sum(arrived.values()) - arrived["outside"] >= count, arrived
    return arrived


@contextmanager
def command(*arguments):
    """A command of the terminal, and a function that waits for a line with a pattern."""
    lines = []

    def told(pattern, seconds=60.0):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if found := re.search(pattern, "".join(lines)):
                return found
            assert process.poll() is None, lines
            time.sleep(0.02)
        raise AssertionError(lines)

    with child(
        [sys.executable, "-m", "ffsm_drake", *arguments],
        longest=3600.0,
        stdout=DEVNULL,
        stderr=PIPE,
        text=True,
        env=os.environ | {"BROWSER": "true"},
    ) as process:
        reader = threading.Thread(target=lambda: lines.extend(iter(process.stderr.readline, "")))
        reader.start()
        yield process, told


ADDRESS = r"connections at (\S+)"


def press(page, *buttons):
    for name in buttons:
        page.send(msgpack.packb({"type": "button", "name": name}))


LONG = ("--no-report", "--set", "duration=1000", "--out")  # runs until it is interrupted


def interrupted(process, told, folder):
    """The record of a run that was never at its end, whose view was there to the last."""
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 130
    said = told("(?s).*")[0]
    assert "Traceback" not in said
    assert "lost" not in said
    return RunRecord.load(folder)


def await_motion(url):
    """Wait until a body has moved five times: of a run that has not begun there is no record."""
    moved = collections.Counter()
    with page_at(url, url) as page:
        while max(moved.values(), default=0) < 5:
            message = msgpack.unpackb(page.recv(timeout=60.0))
            moved[message.get("path")] += message["type"] == "set_transform"


def run_watched(tmp_path, count):
    with command("run", "--meshcat", *LONG, str(tmp_path)) as (process, told):
        url = told(ADDRESS)[1]
        arrived = hostile_frames(process, url, count)
        await_motion(url)
        return arrived, interrupted(process, told, tmp_path)


def run_with_controls(tmp_path, count):
    with command("run", "--controls", *LONG, str(tmp_path)) as (process, told):
        url = told(ADDRESS)[1]
        code = told(r"type (\d{5}) beside")[1]
        with page_at(url, url) as page:
            page.send(msgpack.packb({"type": "slider", "name": CODE, "value": int(code)}))
            press(page, UNLOCK)
            told("are unlocked")
            time.sleep(0.3)  # the panel is drawn
            press(page, start_button("tde_aismc"))
            time.sleep(1.0)
        arrived = hostile_frames(process, url, count)
        return arrived, interrupted(process, told, tmp_path / "run_1")


@pytest.mark.parametrize(
    ("live", "count"),
    [
        pytest.param(run_watched, 20, marks=pytest.mark.long),
        pytest.param(run_with_controls, 20, marks=pytest.mark.long),
        *(
            pytest.param(live, 1670, marks=pytest.mark.exhaustive)
            for live in (run_watched, run_with_controls)
        ),
    ],
)
def test_no_frame_costs_a_record(live, count, tmp_path):
    _, record = live(tmp_path, count)
    assert record.outcome.status == "interrupted"
    assert record.dataset.sizes["time"] > 1


ABANDONED = """
import gc, threading
from pydrake.geometry import Meshcat
from ffsm_drake import load_scenario
from ffsm_drake.plugins.meshcat.stage import SpacecraftView, start_meshcat

class Cycle:
    def __init__(self, held):
        self.me, self.held = self, held

def collect_elsewhere():
    thread = threading.Thread(target=gc.collect)
    thread.start()
    thread.join()

gc.disable()
Cycle(Meshcat())  # a user's
SpacecraftView(start_meshcat(), load_scenario("postcapture"))
collect_elsewhere()
server = start_meshcat()
Cycle(server)
del server
collect_elsewhere()
start_meshcat()
"""


@pytest.mark.slow
def test_only_its_own_thread_frees_a_server():
    """Else Drake would end the process."""
    done = finished([sys.executable, "-c", ABANDONED])
    assert done.returncode == 0, done.stderr


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


PAGES = """
import sys, msgpack
from websockets.sync.client import connect

url, count = sys.argv[1], int(sys.argv[2])
for k in range(count):
    with connect(
        url.replace("http", "ws"), origin=url, compression=None, max_size=None, max_queue=None,
        close_timeout=1.0,
    ) as page:
        page.recv(timeout=30.0)
        if k % 5 == 0:
            page.send(b"")
        else:
            page.send(msgpack.packb({"type": "button", "name": "nobody"}))
            assert page.ping().wait(30.0)
"""


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
def test_hundreds_of_pages_need_no_more_memory_than_a_hundred(served):
    meshcat, url = served
    set_stage(meshcat, load_scenario("postcapture"))
    sizes = []
    for count in (100, 300):
        finished([sys.executable, "-c", PAGES, url, str(count)], check=True)
        sizes.append(resident())
    assert max(sizes) - sizes[0] < 5.0, sizes


def test_a_port_in_use_is_passed_over():
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the door does
        try:
            taken.bind(("127.0.0.1", 7000))
            taken.listen()
        except OSError:
            pass  # in use already, which serves as well
        with live_server(None) as (_, url):
            assert re.fullmatch(r"http://127\.0\.0\.1:7\d{3}", url)
            assert not url.endswith(":7000")
