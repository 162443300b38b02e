"""A live simulation in Meshcat, to watch or with an operator's panel; its use is recorded.

The panel appears once a code is entered (see ``CodeLock``). Controls marked "now" act on the
current run from the next control sample on: the scale of the disturbance, and pushes on the
payload. Controls marked "next run" change the scenario of later runs: the controller, by the
start button clicked, and the payload's true mass.
(A body cannot change its mass during a run without its momentum jumping, so a new mass needs a new
run; the record's scenario then holds it.)
"""

import dataclasses
import sys
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.common.interrupts import interruptible
from ffsm_drake.common.numbers import counted
from ffsm_drake.plugins.interactive.controls import CodeLock, Controls, label_text
from ffsm_drake.plugins.interactive.door import keep_for_ever, live_server
from ffsm_drake.plugins.live.operator import make_operated_disturbance
from ffsm_drake.plugins.meshcat.arrows import Arrow
from ffsm_drake.plugins.meshcat.stage import SpacecraftView, set_stage
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.runs.simulate import simulate
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.plant import configuration, coordinates_of, find_body
from ffsm_drake.systems.controllers import complete_gains, controller_names
from ffsm_drake.systems.setup import BlockSetup

OPERATOR_ATTRIBUTE = "operator"  # attribute of a record's dataset: the operator's actions in words

PAUSE, QUIT = "Pause / resume (space)", "Quit (Esc)"
TIME, RATE = "time [s]", "x real time"
DISTURBANCE, IMPULSE, MASS = "now: disturb. x", "now: push [N s]", "next: mass [kg]"
_MASS_STEP = 0.05  # fraction of the scenario's true mass
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}  # world frame
_PUSH_DURATION = 0.1  # s, rounded to whole control samples
_PUSH_SHOWN = 1.0  # s (simulated) for which its arrow is visible
_PUSH_COLOR = (1.0, 0.9, 0.2)
_PATIENCE = 10.0  # s, until a browser opens the page
_LONGEST_WAIT = 0.04  # s, between two polls of the page
_LARGEST_DEBT = 0.1  # s of lag up to which the simulation tries to catch up


def start_button(controller: str) -> str:
    """Label of the button that starts a run with a controller."""
    return f"Start / restart run: {label_text(controller)}"


def push_button(axis: str) -> str:
    """Label of the button that pushes the payload along the world's x, y or z axis."""
    return f"Push the debris now along {axis}"


def watch(
    scenario: Scenario,
    *,
    meshcat: Meshcat | None = None,
    open_browser: bool = False,
    wait: Callable[[float], None] = time.sleep,
) -> RunRecord:
    """Run a scenario once, at real time or its ``target_realtime_rate``, to watch without controls.

    Arguments and errors as ``run_interactive``; with ``open_browser`` it waits up to 10 s for the
    page to open. Returns: the record of ``simulate``.
    """
    with live_server(meshcat) as (server, url):
        operator = _Operator(scenario, server, tell=None, wait=wait)
        if open_browser and webbrowser.open(url):
            end = time.monotonic() + _PATIENCE
            with interruptible(), operator.beside():
                while not server.GetNumActiveConnections() and time.monotonic() < end:
                    wait(_LONGEST_WAIT)
        try:
            chosen = operator.next_scenario()
            assert chosen is not None  # nobody can quit
            return operator.run(chosen)
        finally:
            operator.close()


def _print(line: str) -> None:
    print(line, file=sys.stderr)


def run_interactive(
    scenario: Scenario,
    *,
    meshcat: Meshcat | None = None,
    open_browser: bool = False,
    check_stability: bool = True,
    keep: Callable[[RunRecord], Any] | None = None,
    tell: Callable[[str], None] = _print,
    wait: Callable[[float], None] = time.sleep,
) -> list[Any]:
    """Run a scenario repeatedly with an operator's panel, until Quit is clicked or Ctrl-C is
    pressed.

    After a restart, Quit or an interrupt from the keyboard the record ends there, with
    the status "interrupted". The record's scenario has the run's controller and payload; its
    ``disturbance_force`` is the generalized force on the plant (scaled disturbance and pushes). The
    operator's actions, if any, are in the dataset's attribute ``operator`` and noted in the
    outcome's message. A run without intervention gives the record of ``simulate``. The metric
    ``momentum_residual`` assumes a smooth disturbance, so it is not valid with pushes.

    Args:
      scenario: the scenario; the page's slider replaces its ``target_realtime_rate``.
      meshcat: server for the display; default: a new one behind a proxy
        (``door.live_server``), with its address printed.
      open_browser: open the page in the default browser.
      check_stability: as in ``simulate``, before each run.
      keep: called with each record at the end of its run, to save it. Its result, such as the
        folder, replaces the record for the rest of the session.
      tell: called with each line for the terminal, such as the code for the panel; default: print
        to standard error.
      wait: called to let wall time pass, with seconds.

    Returns: the records of all runs in their order, or the results of ``keep``.

    Raises:
      ModelError, ScenarioError: the scenario's model or a value in it cannot be used.
    """
    with live_server(meshcat) as (server, url):
        operator = _Operator(scenario, server, tell=tell, wait=wait)
        if open_browser:
            webbrowser.open(url)
        return _session(operator, check_stability=check_stability, keep=keep)


def _session(
    operator: "_Operator", *, check_stability: bool, keep: Callable[[RunRecord], Any] | None
) -> list[Any]:
    """The runs that the operator starts, each as ``keep`` returns it."""
    kept = []
    try:
        while (run_scenario := operator.next_scenario()) is not None:
            try:
                record = operator.run(run_scenario, check_stability=check_stability)
            except FfsmError as error:  # such as missing gains of the controller
                operator.show_status(one_line(error))
                continue
            kept.append(record if keep is None else keep(record))
            operator.show_status(record.outcome.message)
            if record.outcome.status == "interrupted" and not operator.stopped_run:
                break  # from the keyboard
    except KeyboardInterrupt:
        pass  # outside any run
    finally:
        operator.close()
    return kept


@dataclasses.dataclass
class _Push:
    force: np.ndarray  # N, world frame
    samples: int  # samples left for which it acts


class _Operator:
    """The control panel, and the state of the session."""

    def __init__(
        self,
        scenario: Scenario,
        meshcat: Meshcat,
        *,
        tell: Callable[[str], None] | None,
        wait: Callable[[float], None],
    ) -> None:
        self.meshcat = meshcat
        self.stopped_run = False  # the last run ended by Quit or by a start button
        self._lost = False  # Drake's server has failed: no display and no input any more
        self._scenario = scenario
        self._run_scenario = scenario
        self._wait = wait
        self._quit = False
        self._paused = False
        # Controller whose start button was clicked; without an operator the run starts at once.
        self._requested = "" if tell is not None else scenario.controller
        self._pushed: set[str] = set()  # axes of requested pushes
        self._pushes: list[_Push] = []
        self._scale = 1.0
        self._events: list[str] = []
        self._due = self._drawn = 0.0  # wall time, s
        set_stage(meshcat, scenario)
        self._view = SpacecraftView(meshcat, scenario)
        self._payload_frame = find_body(
            self._view.plant, scenario.payload.body, key="payload.body"
        ).body_frame()
        self._arrow = Arrow(meshcat, "push", size=self._view.longest, color=_PUSH_COLOR)
        self._arrow_direction, self._arrow_until = np.array(_AXES["z"]), 0.0
        coordinates = coordinates_of(self._view.plant)
        self._show(0.0, configuration(coordinates, scenario.initial_posture, key="initial_posture"))

        others = [name for name in controller_names() if name != scenario.controller]
        self._controllers = (scenario.controller, *others)
        self._values = {
            RATE: scenario.simulator_config.target_realtime_rate or 1.0,
            DISTURBANCE: 1.0,
            IMPULSE: 5.0,
            MASS: scenario.payload.truth.mass,
        }
        self._controls: Controls | None = None  # None while locked
        self._panel, self._status = Controls(meshcat), ""
        self._lock = None if tell is None else CodeLock(meshcat, tell)  # None: no operator
        self.show_status("starting" if tell is None else "locked: enter the terminal's code")

    def _add_controls(self) -> Controls:
        controls, values = Controls(self.meshcat), self._values
        for name in self._controllers:
            controls.add_button(start_button(name))
        controls.add_button(PAUSE, keycode="Space")
        duration, step = self._scenario.duration, self._scenario.sample_time
        controls.add_slider(TIME, low=0.0, high=duration, step=step, value=0.0)
        rate, mass = values[RATE], self._scenario.payload.truth.mass
        controls.add_slider(RATE, low=min(0.1, rate), high=max(10.0, rate), step=0.1, value=rate)
        controls.add_slider(DISTURBANCE, low=0.0, high=5.0, step=0.25, value=values[DISTURBANCE])
        controls.add_slider(IMPULSE, low=-20.0, high=20.0, step=0.5, value=values[IMPULSE])
        for axis in _AXES:
            controls.add_button(push_button(axis))
        controls.add_slider(
            MASS, low=0.1 * mass, high=5.0 * mass, step=_MASS_STEP * mass, value=values[MASS]
        )
        controls.add_button(QUIT, keycode="Escape")
        return controls

    def close(self) -> None:
        """Remove the panel; the scene stays."""
        with self.beside():
            if self._lock is not None:
                self._lock.remove()
            self._panel.remove()
            if self._controls is not None:
                self._controls.remove()

    @contextmanager
    def beside(self) -> Iterator[None]:
        """Turn a failure of Drake's server in the block into one warning and the end of the view;
        the run continues.
        """
        try:
            yield
        except RuntimeError as error:
            if not self._lost:
                _print(f"warning: the view is lost, the run goes on: {one_line(error)}")
                keep_for_ever(self.meshcat)
            self._lost = True

    def show_status(self, text: str) -> None:
        """Meshcat has no labels: the panel's last button, which does nothing, shows the status."""
        label = f"[ {label_text(text)} ]"
        if label == self._status:
            return
        with self.beside():
            self._panel.remove_button(self._status)
            self._status = label
            self._panel.add_button(label)

    def next_scenario(self) -> Scenario | None:
        """Wait for a start button and return its scenario; None once Quit was clicked."""
        with interruptible(), self.beside():
            while not (self._quit or self._requested or self._lost):
                self._wait(_LONGEST_WAIT)
                self._read_page()
        if self._quit or not self._requested:  # without a page nobody can ask for a run
            return None
        scenario, controller, mass = self._scenario, self._requested, self._values[MASS]
        self._requested, self.stopped_run, self._paused = "", False, False
        self._pushes, self._events, self._scale, self._arrow_until = [], [], 1.0, 0.0
        self._pushed.clear()  # clicks before the run do not push
        if controller != scenario.controller:
            self._events.append(f"controller {controller} (scenario: {scenario.controller})")
            scenario = scenario.replace(controller=controller)
        truth = scenario.payload.truth
        if abs(mass - truth.mass) > 0.5 * _MASS_STEP * truth.mass:
            self._events.append(
                f"payload.truth.mass {mass:g} kg, inertia in proportion "
                f"(scenario: {truth.mass:g} kg)"
            )
            inertia = [mass / truth.mass * entry for entry in truth.inertia]
            scenario = scenario.replace(payload={"truth": {"mass": mass, "inertia": inertia}})
        self._run_scenario = scenario
        # The page's slider paces the run; Drake's own pacing would catch up after every pause.
        self._due = time.perf_counter()
        self.show_status("starting")
        return scenario.replace(simulator_config={"target_realtime_rate": 0.0})

    def _make_disturbance(self, setup: BlockSetup) -> Diagram:
        """The disturbance of the next run, under the operator's control."""
        self._note_scale("from the start")
        return make_operated_disturbance(
            setup, initial=np.array([self._scale, 0.0, 0.0, 0.0]), poll=self._poll
        )

    def run(self, scenario: Scenario, *, check_stability: bool = True) -> RunRecord:
        """Run the result of ``next_scenario``; the record lists the operator's actions."""
        hands = {"forces.disturbance": self._make_disturbance}
        record = simulate(scenario, check_stability=check_stability, blocks=hands)
        record = dataclasses.replace(record, scenario=complete_gains(self._run_scenario))
        if not self._events:
            return record
        given = counted(len(self._events), "input")
        message = f"{record.outcome.message}, with {given} of an operator"
        return dataclasses.replace(
            record,
            outcome=dataclasses.replace(record.outcome, message=message),
            dataset=record.dataset.assign_attrs({OPERATOR_ATTRIBUTE: "; ".join(self._events)}),
        )

    def _poll(self, now: float, q: np.ndarray) -> np.ndarray:
        """Read the page, wait for real time, and return [scale, F] (4) from the next sample on.

        Raises:
          KeyboardInterrupt: the run must end.
        """
        if not self._lost:
            with self.beside():
                self._attend(now, q)
        period = self._scenario.sample_time
        force = np.zeros(3)
        # else it would act after the run
        if now + 1.5 * period < self._scenario.num_control_periods * period:
            self._note_scale(f"from t = {now + period:.2f} s")
            self._read_pushes(now + period)
            for push in self._pushes:
                force += push.force
                push.samples -= 1
            self._pushes = [push for push in self._pushes if push.samples > 0]
        return np.array([self._scale, *force])

    def _attend(self, now: float, q: np.ndarray) -> None:
        """Show the sample that is due, and wait while the operator pauses."""
        self._pace()
        self._draw(now, q)
        while self._paused:
            self._draw(now, q)
            self._wait(_LONGEST_WAIT)
            self._read_page()
            self._stop_if_asked()
            self._due = time.perf_counter()

    def _pace(self) -> None:
        """Wait until the present sample is due, polling the page meanwhile."""
        now = time.perf_counter()
        period = self._scenario.sample_time / self._values[RATE]
        self._due = max(min(self._due, now) + period, now - _LARGEST_DEBT)
        remaining = max(0.0, self._due - now)
        while True:
            self._wait(min(remaining, _LONGEST_WAIT))
            remaining -= _LONGEST_WAIT
            self._read_page()
            self._stop_if_asked()
            if remaining <= 0.0 or self._paused:
                break

    def _stop_if_asked(self) -> None:
        if self._quit or self._requested:
            self.stopped_run = True
            raise KeyboardInterrupt

    def _read_page(self) -> None:
        """Read the page's requests, unless it is locked."""
        if not self._is_unlocked():
            return
        if self._controls is None:
            self._controls = self._add_controls()
            if self._status.startswith("[ locked"):
                self.show_status("ready: click a start button")
        clicked = self._controls.all_clicked()
        moved = {
            label: self._controls.value(label)
            for label in self._values
            if self._controls.moved(label)
        }
        if not self._is_unlocked():  # the request may come from a page that has just joined
            return
        for name in self._controllers:
            if start_button(name) in clicked:
                self._requested = name
        if PAUSE in clicked:
            self._paused = not self._paused
        self._quit = self._quit or QUIT in clicked
        self._pushed |= {axis for axis in _AXES if push_button(axis) in clicked}
        self._values |= moved

    def _is_unlocked(self) -> bool:
        """True if the page is unlocked; otherwise its controls are removed."""
        if self._lock is not None and self._lock.check():
            return True
        if self._controls is not None:
            self._controls.remove()
            self._controls = None
        return False

    def _note_scale(self, when: str) -> None:
        scale = self._values[DISTURBANCE]
        if scale != self._scale:
            self._scale = scale
            self._events.append(f"{when}: disturbance x {scale:g}")

    def _read_pushes(self, start: float) -> None:
        for axis, direction in _AXES.items():
            if axis in self._pushed and (impulse := self._values[IMPULSE]) != 0.0:
                samples = max(1, round(_PUSH_DURATION / self._scenario.sample_time))
                duration = samples * self._scenario.sample_time
                self._pushes.append(_Push(impulse / duration * np.array(direction), samples))
                self._arrow_direction = np.sign(impulse) * np.array(direction)
                self._arrow_until = start + _PUSH_SHOWN
                body = self._scenario.payload.body
                self._events.append(
                    f"from t = {start:.2f} s: push of {impulse:g} N s along {axis} on {body} "
                    f"within {duration:g} s"
                )
        self._pushed.clear()

    def _draw(self, now: float, q: np.ndarray) -> None:
        wall = time.perf_counter()
        if wall - self._drawn < _LONGEST_WAIT:
            return
        self._drawn = wall
        self._show(now, q)
        if self._controls is not None:
            self._controls.set_value(TIME, now)
        mass = self._run_scenario.payload.truth.mass
        what = "paused" if self._paused else "running"
        self.show_status(f"{what}: {self._run_scenario.controller}, {mass:g} kg")

    def _show(self, now: float, q: np.ndarray) -> None:
        """Show the spacecraft and, for a while after a push, an arrow that ends where it acts."""
        self._view.show(q)
        length = self._view.longest if now < self._arrow_until else 0.0
        tip = self._view.position_of(
            self._payload_frame, np.array(self._scenario.payload.truth.center_of_mass)
        )
        self._arrow.show(tip - length * self._arrow_direction, self._arrow_direction, length)
