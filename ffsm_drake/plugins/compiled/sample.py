"""The map of a sampled loop from just before a control sample to just before the next, compiled,
with its exact derivative.
"""

import collections
import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.memo import content_of
from ffsm_drake.plugins.compiled.apart import reason_of
from ffsm_drake.plugins.compiled.engine import Compiled
from ffsm_drake.plugins.compiled.kernel import Slopes
from ffsm_drake.plugins.compiled.loop import kept_at, phases_of
from ffsm_drake.plugins.compiled.run import Case, Run
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.scenario import MassProperties, Scenario
from ffsm_drake.spacecraft.plant import files_read

_KEPT = 32  # codes
_codes: collections.OrderedDict[Any, Slopes | NotCovered] = collections.OrderedDict()
_case = list[tuple[Any, Case]]()  # the last one
_MOST = 1000  # numbers of a state
_LONGEST = 5000  # samples in a common period of the sensors


class Derivative(NamedTuple):
    """Derivatives by the state before a sample (n) and by its noise (m), white of deviation 1."""

    state: np.ndarray  # (n, n + m) of the state before the next sample
    force: np.ndarray  # (nv, n + m) of the controller's force


class TracedSample:
    """A control sample of a scenario's loop, which is not the first of a run.

    Its state (n) has the plant's [q; v] at ``known`` and ``hidden``, the force over the last period
    at ``applied``, and the parts of the law's memory at ``memory``. The rest is delayed forces and
    measurements, and what drifts in the sensors.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Raises NotCovered."""
        Compiled().check(scenario)
        run = Run(scenario, _case_of(scenario))
        if not run.coordinates.is_driven.all():
            raise NotCovered("undriven coordinates")
        if len(run.blocks.sensors) > 1:
            raise NotCovered("further stages of sensing")
        if run.blocks.num_planned:
            raise NotCovered("gains along the plan")
        if getattr(run.law, "tracks_frame", False):
            raise NotCovered("a law that tracks a frame")
        self._scenario, self.motion = scenario, run.case.motion
        self.key, self.law, self.coordinates = run.key, run.law, run.coordinates
        self.sample_time = scenario.sample_time  # s
        blocks = run.blocks
        self.size = sum(blocks.states.values())
        if self.size > _MOST:
            raise NotCovered("so long delays")
        self._code = _code(run)
        self._sizes = blocks.parameters | blocks.states | blocks.results
        self.known, self.hidden = list(blocks.known), list(blocks.hidden)
        self.hidden_names = run.case.true.split.names
        self._sensors = blocks.sensors
        period = math.lcm(*(stage.phase_period for stage in blocks.sensors))
        if period > _LONGEST:
            raise NotCovered("sensors with a long common period")
        self.phases = phases_of(blocks.sensors, period)  # kind of each sample of a common period
        self.num_noise = blocks.row["noise"] + blocks.row["drift_noise"]
        places = self._code.places
        end = places["memory"] - places["x"]
        first = places["applied"] - places["x"]
        self.applied = slice(first, first + blocks.nv)
        self.memory = dict[str, slice]()
        for name, value in blocks.memory.items():
            self.memory[name] = slice(end, end + value.size)
            end += value.size
        self.start = np.zeros(self.size)  # the state at the run's start, with sensors without drift
        for name in set(run.states) - {"drift"}:
            first = places[name] - places["x"]
            self.start[first : first + self._sizes[name]] = run.states[name]
        self._cells = self._code.cells()
        for name, values in run.parameters.items():
            self._of(self._cells, name)[:] = values[:, None]
        self._row = np.zeros((sum(blocks.row.values()), self._code.width))  # without noise

    def placed(self, known: np.ndarray) -> np.ndarray:
        """The state of the run's start with another [q; v], which was measured before too (n)."""
        state = self.start.copy()
        state[self.known] = known
        first = self._code.places["stored"] - self._code.places["x"]
        state[first : first + self._sizes["stored"]] = kept_at(self._sensors, known)
        return state

    def after(self, index: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The state before the next sample (n), and the controller's force until then (nv),
        without noise.

        Args: the control sample, and the state before it.
        """
        self._state(self._cells)[:] = state[:, None]
        self._go(self._cells, index)
        force = self._of(self._cells, "generalized_force")
        return self._state(self._cells)[:, 0].copy(), force[:, 0].copy()

    def derivative(
        self, index: int, state: np.ndarray, truth: MassProperties | None = None
    ) -> tuple[np.ndarray, Derivative]:
        """The state before the next sample (n), and the derivative there.

        Args:
          index: of the control sample.
          state: before it.
          truth: true mass properties of the payload, in place of the scenario's.
        """
        start, width = self._cells.copy(), self._code.width
        if truth is not None:
            payload = dataclasses.replace(self._scenario.payload, truth=truth)
            run = Run(dataclasses.replace(self._scenario, payload=payload))
            self._of(start, "own")[:] = run.parameters["own"][:, None]
        self._state(start)[:] = state[:, None]
        count = self.size + self.num_noise
        directions = np.eye(count, -(-count // width) * width)
        of_state = np.empty((self.size, directions.shape[1]))
        of_force = np.empty((self._sizes["generalized_force"], directions.shape[1]))
        noise = self._code.places["d_noise"]
        for first in range(0, count, width):
            part, cells = slice(first, first + width), start.copy()
            self._state(cells, "d_")[:] = directions[: self.size, part]
            cells[noise : noise + self.num_noise] = directions[self.size :, part]
            self._go(cells, index)
            of_state[:, part] = self._state(cells, "d_")
            of_force[:, part] = self._of(cells, "d_generalized_force")
        found = Derivative(of_state[:, :count], of_force[:, :count])
        return self._state(cells)[:, 0].copy(), found

    def _go(self, cells: np.ndarray, index: int) -> None:
        time = index * self.sample_time
        row, phase = self.motion.row(time), self.phases[index % len(self.phases)]
        self._row[: row.size] = row[:, None]
        self._row[len(self._row) - phase.size :] = phase[:, None]
        self._code.run(cells, self._row, time)

    def _state(self, cells: np.ndarray, prefix: str = "") -> np.ndarray:
        first = self._code.places[f"{prefix}x"]
        return cells[first : first + self.size]

    def _of(self, cells: np.ndarray, name: str) -> np.ndarray:
        first = self._code.places[name]
        return cells[first : first + self._sizes[name.removeprefix("d_")]]


def traced_sample(scenario: Scenario) -> TracedSample | None:
    """Return the sample of a scenario; None: it is not covered."""
    try:
        return TracedSample(scenario)
    except FfsmError:
        return None


def _case_of(scenario: Scenario) -> Case:
    """What it shares with the scenario before it, if they differ in the controller at most."""
    shared = dataclasses.replace(scenario, controller="")
    key = shared, content_of(files_read(scenario))
    if not _case or _case[0][0] != key:
        _case[:] = [(key, Case(scenario))]
    return _case[0][1]


def _code(run: Run) -> Slopes:
    """The compiled sample of a run. Raises NotCovered."""
    found = _codes.get(run.code)
    if found is None:
        try:
            found = Slopes(run.blocks, steps=run.steps, key=run.key_on_disk)
        except (FfsmError, MemoryError):
            raise
        except Exception as error:  # the law may raise anything on symbols
            found = NotCovered(f"{run.scenario.controller}: {reason_of(error)}")
        _codes[run.code] = found
        if len(_codes) > _KEPT:
            _codes.popitem(last=False)
    if isinstance(found, NotCovered):
        raise found
    return found
