"""The operator's panel: what it does to a run, and that the record tells it. The tests play the
operator's hands.
"""

import contextlib
import dataclasses
import re
import signal
import sys
import time
import weakref
from urllib.parse import urlsplit

import numpy as np
import pytest
from browser import command, needs_chromium
from children import DEVNULL, child
from click.testing import CliRunner
from entry_points import installed
from meshcat_page import ForeignPage, click, click_message, resident, slider_message

from ffsm_drake import RunRecord, load_scenario, make_true_plant, override_scenario, simulate
from ffsm_drake.cli import main
from ffsm_drake.plugins.interactive.controls import CODE, UNLOCK, CodeLock, Controls
from ffsm_drake.plugins.interactive.panel import (
    DISTURBANCE,
    IMPULSE,
    MASS,
    OPERATOR_ATTRIBUTE,
    PAUSE,
    QUIT,
    RATE,
    TIME,
    push_button,
    run_interactive,
    start_button,
    watch,
)
from ffsm_drake.plugins.meshcat.stage import start_meshcat
from ffsm_drake.spacecraft.plant import find_body

PERIOD = 0.01


@pytest.fixture(scope="module")
def meshcat():
    return start_meshcat()


@pytest.fixture
def scenario():
    return load_scenario("postcapture", ["duration=1"])


@pytest.fixture
def plain(run):
    """The scenario's run without an operator."""
    return run("postcapture", "duration=1")


class Hands:
    """Does the next step of a script whenever the session waits (about once per control sample),
    and quits at its end.

    A step is a function of the hands; if it returns a function, that must be true before the next
    step.
    """

    def __init__(self, meshcat, *steps):
        self.meshcat = meshcat
        self.steps = iter(steps)
        self.waits = 0
        self.latest = time.monotonic() + 60.0
        self.ready = None

    def __call__(self, seconds):
        self.waits += 1
        assert time.monotonic() < self.latest, "the session does not end"
        if self.waits > 2000:  # for a browser, which takes its time
            time.sleep(1e-3)
        if self.ready is None or self.ready(self):
            self.ready = next(self.steps, quit_when_idle)(self)

    @property
    def status(self):
        return next(name for name in self.meshcat.GetButtonNames() if name.startswith("[ "))

    @property
    def idle(self):
        return not any(word in self.status for word in ("starting", "running", "paused"))


def quit_when_idle(hands):
    if hands.idle:
        click(hands.meshcat, QUIT)


def operate(meshcat, scenario, *steps, told=None, unlocked=True, **settings):
    """The records of a session in which hands do the steps, with the lines in ``told`` if given."""
    meshcat.Delete()
    told = [] if told is None else told
    first = [lambda _: dial(meshcat, told)] if unlocked else []
    settings.setdefault("wait", Hands(meshcat, *first, *steps))
    return run_interactive(
        scenario, meshcat=meshcat, check_stability=False, tell=told.append, **settings
    )


def dial(meshcat, told):
    """Dial in the code that the terminal was last told."""
    meshcat.SetSliderValue(CODE, code_in(told[-1]))
    click(meshcat, UNLOCK)


def code_in(line):
    return float(re.search(r"type (\d{5}) beside", line)[1])


def start(controller="tde_aismc"):
    return lambda hands: click(hands.meshcat, start_button(controller))


def press(label):
    return lambda hands: click(hands.meshcat, label)


def move(slider, value):
    return lambda hands: hands.meshcat.SetSliderValue(slider, value) and None


def let_pass(waits):
    def step(hands):
        end = hands.waits + waits
        return lambda hands: hands.waits >= end

    return step


def until_idle(hands):
    return lambda hands: hands.idle


def test_an_untouched_run_is_that_of_simulate(meshcat, scenario, plain):
    (record,) = operate(meshcat, scenario, start())
    assert record.dataset.identical(plain.dataset)
    assert record.outcome == plain.outcome
    assert record.scenario == scenario


def test_pauses_and_pace_do_not_touch_the_run(meshcat, scenario):
    moments = []

    def note(hands):
        moments.append((hands.meshcat.GetSliderValue(TIME), hands.status))

    scenario = dataclasses.replace(
        scenario, simulator_config=load_scenario("paper").simulator_config
    )
    scenario.simulator_config.target_realtime_rate = 2.0
    steps = [
        start(),
        let_pass(30),
        press(PAUSE),
        lambda hands: time.sleep(0.05),
        let_pass(5),
        note,
        let_pass(200),
        note,
    ]
    (record,) = operate(meshcat, scenario, *steps, press(PAUSE), move(RATE, 0.5))
    assert moments[0] == moments[1]
    assert moments[0][1] == "[ paused: tde_aismc, 100 kg ]"
    assert 0.0 < moments[0][0] < 0.5
    assert record.dataset.identical(simulate(scenario, check_stability=False).dataset)
    assert record.scenario == scenario


def test_the_rate_slider_paces_the_run(meshcat, scenario):
    def asked_for(rate):
        asked, told = [], []
        steps = [let_pass(2), move(RATE, rate), start(), lambda hands: asked.clear()]
        hands = Hands(meshcat, lambda _: dial(meshcat, told), *steps)

        def wait(seconds):
            if not hands.idle:
                asked.append(seconds)
            hands(seconds)

        operate(meshcat, scenario, told=told, wait=wait)
        return sum(asked)

    # A sample takes 20 ms of wall time at rate 0.5, less than its computation at rate 10.
    assert 1.2 < asked_for(0.5) < 2.1
    assert asked_for(10.0) < 0.2


def test_a_push_acts_with_its_impulse_and_is_recorded(meshcat, scenario, plain):
    """Momentum, computed from the state, gains what the recorded force says, and the push's share
    is the slider's.
    """
    (record,) = operate(
        meshcat,
        scenario,
        start(),
        move(IMPULSE, -4.0),
        let_pass(20),
        press(push_button("y")),
        let_pass(40),
    )
    push = (record.dataset["disturbance_force"] - plain.dataset["disturbance_force"]).values
    acting = np.flatnonzero(np.abs(push).max(axis=1) > 1e-12)
    assert acting.size == 10
    assert np.array_equal(acting, np.arange(acting[0], acting[0] + 10))
    assert 10 < acting[0] < 60
    assert push[acting, 3:6].sum(axis=0) * PERIOD == pytest.approx([0.0, -4.0, 0.0], abs=1e-12)

    # The force acts on the payload's centre of mass: the power of J^T F is that of F on that point.
    sample = acting[4]
    model = make_true_plant(scenario)
    plant, context = model.plant, model.context
    velocity = np.random.default_rng(1).normal(size=11)
    plant.SetPositions(context, record.dataset["position"].values[sample])
    plant.SetVelocities(context, velocity)
    body = find_body(plant, scenario.payload.body, key="")
    point = body.EvalSpatialVelocityInWorld(context).translational()
    assert push[sample] @ velocity == pytest.approx(np.array([0.0, -40.0, 0.0]) @ point, rel=1e-9)

    momentum = record.dataset["linear_momentum"].values
    external = record.dataset["applied_force"].values[:-1, 3:6]
    smooth = plain.dataset["disturbance_force"].values[:, 3:6]
    gained = PERIOD * (external + 0.5 * (smooth[:-1] + smooth[1:]) + push[:-1, 3:6])
    assert np.diff(momentum, axis=0) == pytest.approx(gained, abs=2e-7)
    assert np.array_equal(
        record.dataset["position"][: acting[0] + 1], plain.dataset["position"][: acting[0] + 1]
    )

    started = record.dataset["time"].values[acting[0]]
    assert record.dataset.attrs[OPERATOR_ATTRIBUTE] == (
        f"from t = {started:.2f} s: push of -4 N s along y on debris::debris within 0.1 s"
    )
    assert record.outcome.message == "completed 1 s, with 1 input of an operator"


def test_two_pushes_at_once_add_up(meshcat, scenario, plain):
    steps = [start(), let_pass(20), press(push_button("x")), press(push_button("z")), let_pass(40)]
    (record,) = operate(meshcat, scenario, *steps)
    push = (record.dataset["disturbance_force"] - plain.dataset["disturbance_force"]).values
    assert push[:, 3:6].sum(axis=0) * PERIOD == pytest.approx([5.0, 0.0, 5.0], abs=1e-12)


def test_the_scale_acts_from_the_next_sample_and_is_recorded(meshcat, scenario, plain):
    (record,) = operate(
        meshcat, scenario, start(), let_pass(20), move(DISTURBANCE, 2.5), let_pass(30)
    )
    plain = plain.dataset
    force, published = record.dataset["disturbance_force"].values, plain["disturbance_force"].values
    changed = int(np.argmax(np.any(force != published, axis=1)))
    assert 10 < changed < 60
    assert np.array_equal(force[:changed], published[:changed])
    assert np.array_equal(force[changed:], 2.5 * published[changed:])
    # From that very sample on it moves the spacecraft.
    assert np.array_equal(
        record.dataset["position"][: changed + 1], plain["position"][: changed + 1]
    )
    assert not np.array_equal(
        record.dataset["position"][changed + 1], plain["position"][changed + 1]
    )
    assert record.dataset.attrs[OPERATOR_ATTRIBUTE] == (
        f"from t = {changed * PERIOD:.2f} s: disturbance x 2.5"
    )


def test_a_scale_set_before_the_start_is_that_of_the_scenario(meshcat, scenario):
    (record,) = operate(meshcat, scenario, move(DISTURBANCE, 2.0), start())
    assert record.scenario.disturbance.amplitude_scale == 1.0
    scenario = load_scenario("postcapture", ["duration=1", "disturbance.amplitude_scale=2"])
    assert np.array_equal(
        record.dataset["position"], simulate(scenario, check_stability=False).dataset["position"]
    )
    assert record.dataset.attrs[OPERATOR_ATTRIBUTE] == "from the start: disturbance x 2"


def test_controller_and_mass_are_those_of_the_next_run(meshcat, scenario, tmp_path, plain):
    steps = [start(), let_pass(10), move(MASS, 150.0), until_idle, start("tdc"), until_idle]
    records = operate(meshcat, scenario, *steps)
    assert [record.scenario.controller for record in records] == ["tde_aismc", "tdc"]
    assert [record.scenario.payload.truth.mass for record in records] == [
        100.0,
        pytest.approx(150.0),
    ]
    assert OPERATOR_ATTRIBUTE not in records[0].dataset.attrs
    assert records[0].dataset.identical(plain.dataset)
    said = records[1].dataset.attrs[OPERATOR_ATTRIBUTE]
    assert "controller tdc (scenario: tde_aismc)" in said
    assert "payload.truth.mass 150 kg, inertia in proportion (scenario: 100 kg)" in said
    assert records[1].scenario.payload.truth.inertia == pytest.approx([1.5 * 16.7] * 3)
    assert records[1].scenario.payload.nominal == scenario.payload.nominal
    again = simulate(RunRecord.load(records[1].save(tmp_path)).scenario, check_stability=False)
    assert np.array_equal(again.dataset["position"], records[1].dataset["position"])


def test_restart_and_quit_leave_loadable_records(meshcat, scenario, tmp_path):
    steps = [start(), let_pass(40), start("asmc"), let_pass(30), press(QUIT)]
    records = operate(meshcat, scenario, *steps)
    assert [record.outcome.status for record in records] == ["interrupted", "interrupted"]
    assert [record.scenario.controller for record in records] == ["tde_aismc", "asmc"]
    for i, record in enumerate(records):
        loaded = RunRecord.load(record.save(tmp_path / str(i)))
        assert loaded.dataset.identical(record.dataset)
        assert 0.1 < loaded.outcome.time < 0.9
    assert meshcat.GetButtonNames() == []
    assert meshcat.GetSliderNames() == []


def test_quit_at_the_very_start_leaves_a_record(meshcat, scenario, tmp_path):
    (record,) = operate(meshcat, scenario, start(), press(QUIT))
    assert record.outcome.status == "interrupted"
    assert RunRecord.load(record.save(tmp_path)).dataset.sizes["time"] >= 1


def test_ctrl_c_ends_the_session(meshcat, scenario):
    assert operate(meshcat, scenario, interrupt) == []
    (record,) = operate(meshcat, scenario, start(), let_pass(50), interrupt)
    assert record.outcome.status == "interrupted"
    assert record.outcome.message == f"interrupted at t = {record.outcome.time:.2f} s"
    assert meshcat.GetButtonNames() == []


def test_ctrl_c_between_two_controls_keeps_the_records(meshcat, scenario, monkeypatch):
    """The panel's status line is taken away and put back; an interrupt in between must not cost the
    session.
    """
    add_button = Controls.add_button

    def interrupted(controls, label, **options):
        if label.startswith("[ running"):
            signal.raise_signal(signal.SIGINT)
        add_button(controls, label, **options)

    monkeypatch.setattr(Controls, "add_button", interrupted)
    (record,) = operate(meshcat, scenario, start())
    assert record.outcome.status == "interrupted"
    assert meshcat.GetButtonNames() == []


@pytest.mark.smoke
def test_clicks_while_nothing_runs_do_nothing(meshcat, scenario, plain):
    (record,) = operate(meshcat, scenario, press(push_button("x")), press(PAUSE), start())
    assert record.dataset.identical(plain.dataset)


@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
@pytest.mark.parametrize(
    "count",
    [pytest.param(40, marks=pytest.mark.long), pytest.param(100, marks=pytest.mark.exhaustive)],
)
def test_restarts_need_no_more_memory_than_twenty(meshcat, scenario, count):
    told, sizes, records = [], [], []

    def keep(record):
        sizes.append(resident())
        assert not any(earlier() for earlier in records[:-1])  # the last one is still at hand
        records.append(weakref.ref(record))

    steps = [lambda _: dial(meshcat, told), *[start(), let_pass(25)] * (count + 1)]
    hands = Hands(meshcat, *steps)
    hands.latest += 300.0
    kept = operate(meshcat, scenario, told=told, wait=hands, keep=keep)
    assert len(kept) == count + 1
    assert max(sizes[20:]) - sizes[20] < 5.0, sizes


def test_a_controller_that_cannot_be_loaded_is_one_line_on_the_panel(meshcat, scenario):
    scenario = override_scenario(scenario, ["controller=nowhere:Law"])
    seen = []

    def look(hands):
        seen.append(hands.status)
        # Meshcat pastes labels into a script, between single quotes.
        assert not [name for name in meshcat.GetButtonNames() if "'" in name or "\\" in name]

    steps = [start("nowhere:Law"), let_pass(2), look, start(), until_idle]
    records = operate(meshcat, scenario, *steps)
    assert [record.scenario.controller for record in records] == ["tde_aismc"]
    assert "No module named \N{RIGHT SINGLE QUOTATION MARK}nowhere" in seen[0]
    assert not {"'", "\\"} & set(start_button("x'); alert('\\"))


# Pages of other sites.

COMMANDS = [start_button("tde_aismc"), start_button("tdc"), PAUSE, *map(push_button, "xyz"), QUIT]


def until(true, seconds=10.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.005)


def foreign_clicks(meshcat, page):
    """Everything that a page can ask for, and the proof that it has arrived."""
    meshcat.AddButton("arrived")
    for label in (*COMMANDS, "arrived"):
        page.send(click_message(label))
    until(lambda: meshcat.GetButtonClicks("arrived") == 1)
    meshcat.DeleteButton("arrived")


def test_a_foreign_page_cannot_start_a_run(meshcat, scenario):
    page, told = ForeignPage(meshcat), []

    def guess(hands):
        page.send(slider_message(CODE, code_in(told[-1]) - 1.0))
        page.send(click_message(UNLOCK))
        until(lambda: meshcat.GetButtonClicks(UNLOCK) == 1)

    def clicks(hands):
        foreign_clicks(meshcat, page)

    def is_barred(hands):
        assert "stay locked" in told[-1]
        assert not {CODE, UNLOCK} & {*meshcat.GetSliderNames(), *meshcat.GetButtonNames()}

    steps = [clicks, guess, guess, guess, is_barred, clicks, let_pass(2), interrupt]
    assert operate(meshcat, scenario, *steps, told=told, unlocked=False) == []
    assert len(told) == 4
    page.close()


def interrupt(_):
    signal.raise_signal(signal.SIGINT)


def test_a_foreign_page_cannot_push_or_stop_a_run(meshcat, scenario, plain):
    """Another page locks the controls by coming; what it asks for then is not done."""
    until(lambda: meshcat.GetNumActiveConnections() == 0)
    pages, told = [], []

    def come(hands):
        pages.append(ForeignPage(meshcat))
        foreign_clicks(meshcat, pages[0])

    steps = [let_pass(2), start(), let_pass(20), come, until_idle, interrupt]
    (record,) = operate(meshcat, scenario, *steps, told=told)
    pages[0].close()
    assert "A page has joined or left, so the controls are locked" in told[-1]
    assert code_in(told[-1]) != code_in(told[0])
    assert record.outcome.status == "completed"
    assert record.dataset.identical(plain.dataset)


def test_a_page_that_comes_while_the_controls_are_read_is_not_obeyed(
    meshcat, scenario, monkeypatch, plain
):
    until(lambda: meshcat.GetNumActiveConnections() == 0)
    pages, told = [], []
    moved = Controls.moved

    def come(controls, label):
        if (
            label == MASS
            and not pages
            and any(name.startswith("[ running") for name in meshcat.GetButtonNames())
        ):
            pages.append(ForeignPage(meshcat))
            foreign_clicks(meshcat, pages[0])
        return moved(controls, label)

    monkeypatch.setattr(Controls, "moved", come)
    steps = [let_pass(2), start(), until_idle, interrupt]
    (record,) = operate(meshcat, scenario, *steps, told=told)
    pages[0].close()
    assert "A page has joined or left" in told[-1]
    assert record.dataset.identical(plain.dataset)
    assert record.outcome.status == "completed"


def test_the_right_code_unlocks_for_a_single_page_only(meshcat):
    meshcat.Delete()
    until(lambda: meshcat.GetNumActiveConnections() == 0)
    told, pages = [], [ForeignPage(meshcat), ForeignPage(meshcat)]
    until(lambda: meshcat.GetNumActiveConnections() == 2)
    lock = CodeLock(meshcat, told.append)
    dial(meshcat, told)
    assert not lock.check()
    assert "close the others" in told[-1]
    pages.pop().close()
    until(lambda: meshcat.GetNumActiveConnections() == 1)
    dial(meshcat, told)
    assert lock.check()
    pages.pop().close()
    until(lambda: meshcat.GetNumActiveConnections() == 0)
    assert not lock.check()
    lock.remove()
    assert meshcat.GetButtonNames() == []


def test_a_run_that_is_watched_obeys_nobody(meshcat, scenario, plain):
    until(lambda: meshcat.GetNumActiveConnections() == 0)
    meshcat.Delete()
    page = ForeignPage(meshcat)
    config = load_scenario("postcapture").simulator_config
    config.target_realtime_rate = 1000.0

    def wait(seconds):
        foreign_clicks(meshcat, page)  # at every sample

    record = watch(
        dataclasses.replace(scenario, simulator_config=config), meshcat=meshcat, wait=wait
    )
    assert meshcat.GetButtonNames() == []
    assert meshcat.GetSliderNames() == []
    page.close()
    assert record.dataset.identical(plain.dataset)
    assert record.outcome.completed


@pytest.mark.slow
def test_the_command_line_only_watches(run, tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url))  # there is no browser
    words = [
        "run",
        "--meshcat",
        "--no-report",
        "--set",
        "duration=0.05",
        "--out",
        str(tmp_path / "run"),
    ]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    assert urlsplit(opened[0]).hostname in ("127.0.0.1", "localhost")
    plain = run("postcapture", "duration=0.05")
    assert RunRecord.load(tmp_path / "run").dataset.identical(plain.dataset)


def test_drakes_servers_are_where_no_page_can_know():
    first, second = (urlsplit(start_meshcat().web_url()) for _ in range(2))
    for address in (first, second):
        assert address.hostname.startswith("127.")
    assert first.hostname != second.hostname
    assert not first.hostname.startswith("127.0.")


@pytest.mark.long
@needs_chromium
def test_a_foreign_page_in_a_browser_cannot_command(meshcat, scenario, tmp_path, plain):
    """Neither a run that the operator has started nor afterwards, though it is told the address and
    never rests.
    """
    until(lambda: meshcat.GetNumActiveConnections() == 0)
    messages = [slider_message(CODE, 12345.0), *map(click_message, [UNLOCK, *COMMANDS, "arrived"])]
    script = f"""<script>const s = new WebSocket("{meshcat.web_url().replace("http", "ws")}");
        const send = () => {{ for (const m of {[list(m) for m in messages]})
          s.send(new Uint8Array(m)) }};
        s.onopen = () => {{ send(); setInterval(send, 20) }};</script>"""
    (tmp_path / "foreign.html").write_text(script)
    start_browser = command(
        tmp_path, "--remote-debugging-port=0", (tmp_path / "foreign.html").as_uri()
    )
    told, browser = [], contextlib.ExitStack()

    def come(hands):
        meshcat.AddButton("arrived")
        browser.enter_context(child(start_browser, stdout=DEVNULL, stderr=DEVNULL))
        until(lambda: meshcat.GetButtonClicks("arrived") >= 1, seconds=60.0)

    def is_still_sending(hands):
        clicks = meshcat.GetButtonClicks("arrived")
        return lambda hands: meshcat.GetButtonClicks("arrived") > clicks

    meshcat.Delete()
    steps = [let_pass(2), start(), let_pass(20), come, until_idle, is_still_sending]
    own = ForeignPage(meshcat)  # the operator's
    until(lambda: meshcat.GetNumActiveConnections() == 1)
    try:
        with browser:
            (record,) = operate(meshcat, scenario, *steps, let_pass(20), interrupt, told=told)
    finally:
        own.close()
        meshcat.DeleteButton("arrived")
    assert "A page has joined or left, so the controls are locked" in told[2]
    assert record.outcome.status == "completed"
    assert record.dataset.identical(plain.dataset)


LAW = '''
from ffsm_drake import ControlLaw


class Idle(ControlLaw):
    """No force."""

    def initial_state(self):
        return {}

    def step(self, sample, state):
        return 0.0 * sample.v, state
'''


@pytest.fixture
def idle(tmp_path, monkeypatch):
    """An installed package offers a law."""
    offers = {"ffsm_drake.controllers": {"idle": "idle_law:Idle"}}
    yield from installed(tmp_path, monkeypatch, {"idle_law": LAW}, offers)


@pytest.mark.usefixtures("idle")
def test_an_installed_law_has_its_button(meshcat):
    scenario = load_scenario("postcapture", ["duration=0.1"])
    (record,) = operate(meshcat, scenario, let_pass(2), start("idle"), until_idle)
    assert record.scenario.controller == "idle"
    assert record.outcome.completed
