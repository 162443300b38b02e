"""The map of a sampled loop from just before a control sample to just before the next, compiled,
with its exact derivative.
"""

import dataclasses
import functools
import math

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.compiled.apart import reason_of
from ffsm_drake.plugins.compiled.called import parts
from ffsm_drake.plugins.compiled.case import case_of
from ffsm_drake.plugins.compiled.engine import BLOCKS, Compiled
from ffsm_drake.plugins.compiled.kernel import Step
from ffsm_drake.plugins.compiled.parameters import rows_of
from ffsm_drake.plugins.compiled.parts import kept_at, phases_at, sampled_of, sizes_of
from ffsm_drake.plugins.compiled.recent import Recent
from ffsm_drake.plugins.compiled.run import Run, run_of
from ffsm_drake.plugins.compiled.scenario_blocks import ActingBlocks
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.scenario import HELD, Grip, MassProperties
from ffsm_drake.systems.reference import make_frame_motion
from ffsm_drake.systems.registry import base_actuators

_KEPT = 32  # codes
_Codes = tuple[Step, Step]  # of a sample alone, and with its derivatives
_codes = Recent[_Codes | NotCovered](_KEPT)
_MOST = 1000  # numbers of a state
_LONGEST = 5000  # samples in a common period of the sensors


class TracedSample:
    """A control sample of a scenario's loop, which is not the first of a run.

    Its state (n) has the plant's [q; v] at ``known`` and ``hidden``, the force over the last period
    at ``applied``, and the parts of the law's memory at ``memory``; of it at ``held`` what a
    linearisation holds, with its value (None: that at the start). The rest is delayed forces and
    measurements, and what drifts in the sensors. ``noise`` has the parts of its noise (m).
    """

    def __init__(
        self,
        mission: Mission,
        before: Mission,
        grip: Grip = HELD,
        acting: ActingBlocks | None = None,
    ) -> None:
        """Args: the mission, and one whose run is used if it differs in ``actuation.limit`` alone;
        what holds the target; what makes the actuators in place of thrusters and wheels. Raises
        NotCovered.
        """
        run = _covered(mission, before, grip, acting)
        self.motion = run.case.motion
        self._frame = make_frame_motion(mission, run.case.nominal, self.motion)
        self.key, self.law, self.coordinates = run.key, run.law, run.coordinates
        self.tracks_frame, self.sample_time = self.law.tracks_frame, run.scenario.sample_time  # s
        blocks = run.blocks
        self.size = sum(blocks.states.values())
        if self.size > _MOST:
            raise NotCovered("so long delays")
        self._plain, self._slopes = _code(run)
        self._sizes = blocks.parameters | blocks.states | blocks.results
        self.known, self.hidden = list(blocks.known), list(blocks.hidden)
        self.hidden_names = run.case.true.split.names
        plant = len(self.known) + len(self.hidden)
        self.beside = slice(plant, blocks.states["x"])  # what feeds nothing back
        self._run = run
        # of the loops that it can be the sample of
        self.blocks = BLOCKS | {
            f"forces.{name}" for name in (*blocks.parts.forces, *blocks.parts.last)
        }
        period = math.lcm(*(each.phase_period for _, each in sampled_of(blocks.parts)))
        if period > _LONGEST:
            raise NotCovered("sensors with a long common period")
        self.period = period
        self.latched_period = math.lcm(*(of.phase_period for of in blocks.parts.actuation.values()))
        self._phases = phases_at(blocks.parts, period)  # of each sample of a common period
        white, drift = blocks.row["noise"], blocks.row["drift_noise"]
        self.num_noise = white + drift
        self.noise = {"samples": slice(0, white), "drift": slice(white, white + drift)}
        places = self._plain.places
        end = places["memory"] - places["x"]
        first = places["applied"] - places["x"]
        self.applied = slice(first, first + blocks.nv)
        self.memory = parts(sizes_of(blocks.memory), end)
        self.held = {name: (self.memory[name], value) for name, value in self.law.held().items()}
        self.start = np.zeros(self.size)  # the state at the run's start, with sensors without drift
        for name in set(run.states) - {"drift"}:
            first = places[name] - places["x"]
            self.start[first : first + self._sizes[name]] = run.states[name]
        free = {"limit": np.full(blocks.nv, np.inf), "bound": np.full(1, np.inf)}
        self._parameters = run.parameters | free
        self._cells = self._filled(self._plain)
        self._row = np.zeros(sum(blocks.row.values()))  # without noise
        self._in_row = parts(blocks.row)
        self._planned = np.zeros((0, blocks.num_planned))  # of the first samples

    def kind(self, index: int) -> tuple[float, ...]:
        """A key that is equal for control samples with the same phases."""
        return tuple(self._phases[index % self.period].tolist())

    def placed(self, known: np.ndarray) -> np.ndarray:
        """The state of the run's start with another [q; v], which was measured before too (n)."""
        state = self.start.copy()
        state[self.known] = known
        first = self._plain.places["stored"] - self._plain.places["x"]
        kept = kept_at(self._run.blocks.parts, known)["stored"]
        state[first : first + kept.size] = kept
        return state

    def after(self, index: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The state before the next sample (n), and the controller's force until then (nv),
        without noise.

        Args: the control sample, and the state before it.
        """
        code, cells = self._plain, self._cells
        first, force = code.places["x"], code.places["generalized_force"]
        cells[first : first + self.size, 0] = state
        self._set_sample(code, cells, index)
        code.run(cells)
        found = cells[first : first + self.size, 0].copy()
        return found, cells[force : force + self._sizes["generalized_force"], 0].copy()

    def derivative(
        self, index: int, state: np.ndarray, truth: MassProperties | None, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The state before the next sample (n), and derivatives of it and of the force (nv) by
        directions (k).

        Args:
          index: of the control sample.
          state: before it.
          truth: true mass properties of the payload, in place of the scenario's.
          directions: of the state and of its noise (n + m, k), white of deviation 1.
        """
        code, count = self._slopes, directions.shape[1]
        start, width = self._filled(code), code.width
        self._set_sample(code, start, index)
        if truth is not None:
            changed = self._run.carrying(truth).parameters
            for name in ("own", "parts"):
                self._of(code, start, name, changed[name].size)[:] = changed[name][:, None]
        self._of(code, start, "x", self.size)[:] = state[:, None]
        directions = np.pad(directions, ((0, 0), (0, -count % width)))
        of_state = np.empty((self.size, directions.shape[1]))
        of_force = np.empty((self._sizes["generalized_force"], directions.shape[1]))
        for first in range(0, count, width):
            part, cells = slice(first, first + width), start.copy()
            self._of(code, cells, "d_x", self.size)[:] = directions[: self.size, part]
            self._of(code, cells, "d_noise", self.num_noise)[:] = directions[self.size :, part]
            code.run(cells)
            of_state[:, part] = self._of(code, cells, "d_x", self.size)
            of_force[:, part] = self._of(code, cells, "d_generalized_force", len(of_force))
        after = self._of(code, cells, "x", self.size)[:, 0].copy()
        return after, of_state[:, :count], of_force[:, :count]

    def _filled(self, code: Step) -> np.ndarray:
        """Cells with the parameters of the run."""
        cells = code.cells()
        for name, values in self._parameters.items():
            self._of(code, cells, name, values.size)[:] = values[:, None]
        return cells

    def _set_sample(self, code: Step, cells: np.ndarray, index: int) -> None:
        """Set the number of a sample in the cells, and what it reads."""
        row = self._read(index)
        cells[code.places["number"]], cells[code.places["lost"]] = index, 0.0
        self._of(code, cells, "reference", row.size)[:] = row[:, None]

    def _read(self, index: int) -> np.ndarray:
        """What a sample reads (n), see ``Blocks.row``."""
        time, row, places = index * self.sample_time, self._row, self._in_row
        row[places["reference"]] = self.motion.row(time)
        row[places["phases"]] = self._phases[index % self.period]
        if self._frame is not None:
            row[places["frame"]] = self._frame.row(time)
        if self._planned.shape[1]:
            if index >= len(self._planned):
                times = self.sample_time * np.arange(2 * index + 1)
                self._planned = rows_of(self.law, self.motion.evaluate(times)[0])
            row[places["planned"]] = self._planned[index]
        return row

    @staticmethod
    def _of(code: Step, cells: np.ndarray, name: str, size: int) -> np.ndarray:
        first = code.places[name]
        return cells[first : first + size]


def traced_sample(
    mission: Mission, before: Mission, grip: Grip, acting: ActingBlocks
) -> TracedSample | None:
    """Return the sample of a phase; None: it is not covered. Args: see ``TracedSample``."""
    try:
        return TracedSample(mission, before, grip, acting)
    except FfsmError:
        return None


def _covered(mission: Mission, before: Mission, grip: Grip, acting: ActingBlocks | None) -> Run:
    """The run whose sample it is. Arguments: see ``TracedSample``. Raises NotCovered."""
    scenario, given = mission.scenario, before.scenario
    Compiled().check(scenario)
    unlimited = dataclasses.replace(given.actuation, limit=scenario.actuation.limit)
    is_alike = dataclasses.replace(given, actuation=unlimited) == scenario
    own = before if is_alike else mission
    run = run_of(case_of(own, grip, acting if base_actuators(scenario) else None), own)
    if run.blocks.called:
        raise NotCovered(run.blocks.called)
    if scenario.blocks.choices() or scenario.supervisor is not None:
        raise NotCovered("blocks of a user, or a supervisor")
    return run


def _code(run: Run) -> _Codes:
    """The compiled sample of a run. Raises NotCovered."""
    found = _codes.get(run.code) or _codes.keep(run.code, _compiled(run))
    if isinstance(found, NotCovered):
        raise found
    return found


def _compiled(run: Run) -> _Codes | NotCovered:
    """The compiled sample of a run; if it cannot be compiled, why."""
    step = functools.partial(Step, run.blocks, steps=run.steps, key=run.key_on_disk)
    try:
        return step(slopes=False), step(slopes=True)
    except (FfsmError, MemoryError):
        raise
    except Exception as error:  # the law may raise anything on symbols
        return NotCovered(f"{run.scenario.controller}: {reason_of(error)}")
