"""A sampled loop as compiled code, linearised exactly; only with the plug-in ``compiled``."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.plugins import SERVICES, optional
from ffsm_drake.common.so3 import quaternion_rate
from ffsm_drake.plugins.design.stability.differences import DifferencedLoop, Way
from ffsm_drake.plugins.design.stability.linear_loop import WARM_UP, SampleMap
from ffsm_drake.scenario import MassProperties, Scenario
from ffsm_drake.systems.controllers.law import is_shipped
from ffsm_drake.systems.planned_motion import PlannedMotion

# From Drake's loop after two samples, as a share of the state's largest entry.
_LARGEST_DIFFERENCE = 1e-9
_agrees: dict[Any, bool] = {}  # key of code -> whether it does what Drake's loop does


class TracedLoop:
    """A closed loop at one instant: just before the update at a control sample. Its methods are
    those of ``DifferencedLoop``.
    """

    hidden: tuple[str, ...] = ()
    tracks_frame = False
    user_supplied: Sequence[Any] = ()

    def __init__(self, sample: Any, motion: PlannedMotion) -> None:
        """Args: the traced sample, of a scenario without what has no derivative; its motion."""
        self._sample, self.motion = sample, motion
        self.law, self.coordinates = sample.law, sample.coordinates
        self._nq, self._nv = len(self.coordinates.position_names), len(self.coordinates.names)
        held = {name: sample.memory[name] for name in self.law.held()}
        places = [np.arange(part.start, part.stop) for part in held.values()]
        first = self._nq + self._nv  # the state's first entry that is not the plant's
        rest = np.arange(first, sample.size)
        self._rest = np.setdiff1d(rest, np.concatenate([np.zeros(0, int), *places]))
        self.parts_of_memory = {}
        for name, part in sample.memory.items():
            if name not in held:
                begin = 2 * self._nv + int(np.searchsorted(self._rest, part.start))
                self.parts_of_memory[name] = slice(begin, begin + part.stop - part.start)
        self.noise: Mapping[str, slice] = {}
        self.start, self._state = sample.start, sample.start

    @property
    def size(self) -> int:
        """Of the linear loop's state."""
        return 2 * self._nv + self._rest.size

    @property
    def num_noise(self) -> int:
        """Of its noise."""
        return int(self._sample.num_noise)

    def release(self) -> None:
        """Nothing is left to free."""

    def place(self, index: int, held: Mapping[str, np.ndarray]) -> None:
        """Go to a control sample on the plan, with all memory as at the start of the run."""
        state = self.start.copy()
        known = self._nq + self._nv
        state[:known] = self.motion.row(index * self._sample.sample_time)[:known]
        self._state = self._holding(state, held)

    def save(self) -> np.ndarray:
        """The present instant, for ``load``."""
        return self._state

    def load(self, instant: np.ndarray) -> None:
        """Go to a saved instant."""
        self._state = instant

    def known(self) -> np.ndarray:
        """[q; v] of the plant."""
        return self._state[: self._nq + self._nv].copy()

    def go_on(self, index: int, held: Mapping[str, np.ndarray]) -> None:
        """Go on from just before the update at a control sample to just before the next."""
        self._state = self._holding(self._sample.after(index, self._state)[0], held)

    def from_start(self, held: Mapping[str, np.ndarray]) -> Way:
        """The way from the start of the run on."""
        self._state = self.start.copy()
        velocity = self.motion.evaluate(0.0)[1]
        for name in ("delayed_desired_velocity", "delayed_velocity"):
            if name in self._sample.memory:
                self._state[self._sample.memory[name]] = velocity

        def go_on(index: int) -> np.ndarray:
            before = self._holding(self._state, held)
            self._state, force = self._sample.after(index, before)
            return np.asarray(force)

        return Way(self.known, go_on)

    def samples(
        self,
        first: int,
        held: Mapping[str, np.ndarray],
        truth: MassProperties | None,
        before: Callable[[], np.ndarray],
    ) -> tuple[SampleMap, ...]:
        """The map of one control sample; arguments as of ``DifferencedLoop.samples``."""
        state = before()
        after, found = self._sample.derivative(first + WARM_UP, state, truth)
        by_noise = np.eye(self.num_noise)
        enter = np.zeros((found.state.shape[1], self.size + self.num_noise))
        enter[: len(state), : self.size] = self._from_small_change(state)
        enter[len(state) :, self.size :] = by_noise
        both = self._small_change(after) @ (found.state @ enter)
        force = found.force @ enter
        return (
            SampleMap(
                a=both[:, : self.size],
                b=both[:, self.size :],
                c=force[:, : self.size],
                d=force[:, self.size :],
            ),
        )

    def _holding(self, state: np.ndarray, held: Mapping[str, np.ndarray]) -> np.ndarray:
        """A state with held memory at its values."""
        state = state.copy()
        for name, value in self.law.held().items():
            part = self._sample.memory[name]
            state[part] = self.start[part] if value is None else value
            if name in held:
                state[part] = np.ravel(held[name])
        return state

    def _from_small_change(self, state: np.ndarray) -> np.ndarray:
        """Derivative of a state by its small change, which turns the attitude about axes of the
        world.
        """
        nq, nv = self._nq, self._nv
        found = np.zeros((len(state), self.size))
        found[:4, :3] = np.transpose([quaternion_rate(state[:4], axis) for axis in np.eye(3)])
        found[4 : nq + nv, 3 : 2 * nv] = np.eye(2 * nv - 3)
        found[self._rest, np.arange(2 * nv, self.size)] = 1.0
        return found

    def _small_change(self, state: np.ndarray) -> np.ndarray:
        """Derivative of the small change of a state by the state."""
        nq, nv = self._nq, self._nv
        found = np.zeros((self.size, len(state)))
        w, x, y, z = state[:4] * (2.0 / (state[:4] @ state[:4]))
        found[:3, :4] = [[-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]]
        found[3 : 2 * nv, 4 : nq + nv] = np.eye(2 * nv - 3)
        found[np.arange(2 * nv, self.size), self._rest] = 1.0
        return found


def traced_loop(
    scenario: Scenario, motion: PlannedMotion, make_other: Callable[[], DifferencedLoop]
) -> TracedLoop | None:
    """The loop of a scenario; None where the code does not cover it, or does not what Drake's loop
    does, which ``make_other`` makes.
    """
    make = optional(SERVICES, "traced_sample")
    sample = None if make is None else make(scenario, motion)
    if sample is None or not is_shipped(sample.law) or sample.law.least_change:
        return None
    loop = TracedLoop(sample, motion)
    if sample.key not in _agrees:
        other = make_other()
        try:
            _agrees[sample.key] = _difference(loop, other) <= _LARGEST_DIFFERENCE
        finally:
            other.release()
    return loop if _agrees[sample.key] else None


def _difference(one: TracedLoop, other: DifferencedLoop) -> float:
    """Of two loops, as a share of the state's largest entry, in the middle of the motion."""
    period = other.scenario.sample_time
    index, found = round(one.motion.part(0.5) / period), list[np.ndarray]()
    for loop in (one, other):
        loop.place(index, {})
        for each in (index, index + 1):
            loop.go_on(each, {})
        found.append(loop.known())
    return float(np.abs(found[0] - found[1]).max() / np.abs(found[1]).max())
