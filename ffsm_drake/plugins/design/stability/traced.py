"""A sampled loop as compiled code, linearised exactly; only with the plug-in ``compiled``."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.plugins import SERVICES, optional
from ffsm_drake.common.so3 import quaternion_rate
from ffsm_drake.plugins.design.stability.differences import DifferencedLoop, Way
from ffsm_drake.plugins.design.stability.linear_loop import WARM_UP, SampleMap
from ffsm_drake.scenario import Grip, MassProperties, Scenario
from ffsm_drake.systems.controllers.law import is_shipped

# From Drake's loop after ``WARM_UP`` samples, as a share of the state's largest entry.
_LARGEST_DIFFERENCE = 1e-7
_agrees: dict[Any, bool] = {}  # key of code -> whether it does what Drake's loop does


class TracedLoop:
    """A closed loop at one instant: just before the update at a control sample. Its methods are
    those of ``DifferencedLoop``.
    """

    user_supplied: Sequence[Any] = ()

    def __init__(self, sample: Any) -> None:
        """Args: the traced sample, of a scenario without what has no derivative."""
        self._sample, self.motion, self.key = sample, sample.motion, sample.key
        self.law, self.coordinates = sample.law, sample.coordinates
        self.tracks_frame = bool(getattr(self.law, "tracks_frame", False))
        self._undriven = np.flatnonzero(~self.coordinates.is_driven)
        self.hidden: tuple[str, ...] = sample.hidden_names
        held = {name: sample.memory[name] for name in self.law.held()}
        plant = [*sample.known, *sample.hidden]
        places = [np.arange(part.start, part.stop) for part in held.values()]
        places.append(np.arange(sample.size)[sample.applied])
        beside = np.arange(sample.size)[sample.beside]
        rest = np.setdiff1d(np.arange(sample.size), np.concatenate([plant, beside, *places]))
        self._attitude, nq = plant[:4], len(self.coordinates.position_names)
        self._following = np.array(sample.known)[nq + self._undriven]  # rates at constant momentum
        # entries of the state that are the linear loop's from its fourth on
        self._kept = np.concatenate([plant[4:], places[-1], rest]).astype(int)
        self.parts_of_memory = {}
        for name, part in sample.memory.items():
            if name not in held:
                begin = 3 + int(np.flatnonzero(self._kept == part.start)[0])
                self.parts_of_memory[name] = slice(begin, begin + part.stop - part.start)
        white = len(sample.known) if sample.num_noise else 0
        self.noise = {"samples": slice(0, white), "drift": slice(white, sample.num_noise)}
        self.start, self._state = sample.start, sample.start

    def has_all_of(self, other: DifferencedLoop) -> bool:
        """Whether it has every block of a loop."""
        return set(other.loop.blocks) <= set(self._sample.blocks)

    @property
    def size(self) -> int:
        """Of the linear loop's state."""
        return 3 + self._kept.size

    @property
    def num_noise(self) -> int:
        """Of its noise."""
        return int(self._sample.num_noise)

    def release(self) -> None:
        """Nothing is left to free."""

    def place(self, index: int, held: Mapping[str, np.ndarray]) -> None:
        """Go to a control sample on the plan, with all memory as at the start of the run."""
        row = self.motion.row(index * self._sample.sample_time)
        self._state = self._holding(self._sample.placed(row[: len(self._sample.known)]), held)

    def save(self) -> np.ndarray:
        """The present instant, for ``load``."""
        return self._state

    def load(self, instant: np.ndarray) -> None:
        """Go to a saved instant."""
        self._state = instant

    def known(self) -> np.ndarray:
        """[q; v] of the plant."""
        known: np.ndarray = self._state[self._sample.known]
        return known

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
        state, first = before(), first + WARM_UP
        kinds = [tuple(each) for each in self._sample.phases.tolist()]
        found = dict[Any, SampleMap]()
        for index in range(first, first + len(kinds)):
            if (kind := kinds[index % len(kinds)]) not in found:
                found[kind] = self._map(index, state, truth)
        return tuple(found[kinds[each % len(kinds)]] for each in range(first, first + len(kinds)))

    def _map(self, index: int, state: np.ndarray, truth: MassProperties | None) -> SampleMap:
        after, found = self._sample.derivative(index, state, truth)
        enter = np.zeros((found.state.shape[1], self.size + self.num_noise))
        enter[: len(state), : self.size] = self._from_small_change(state, truth)
        enter[len(state) :, self.size :] = np.eye(self.num_noise)
        both = self._small_change(after) @ (found.state @ enter)
        force, n = found.force @ enter, self.size
        if not self.tracks_frame:
            both[self._undriven, self._undriven] = 1.0  # their drift adds up
        return SampleMap(a=both[:, :n], b=both[:, n:], c=force[:, :n], d=force[:, n:])

    def _holding(self, state: np.ndarray, held: Mapping[str, np.ndarray]) -> np.ndarray:
        """A state with held memory at its values."""
        state = state.copy()
        for name, value in self.law.held().items():
            part = self._sample.memory[name]
            state[part] = self.start[part] if value is None else value
            if name in held:
                state[part] = np.ravel(held[name])
        return state

    def _from_small_change(self, state: np.ndarray, truth: MassProperties | None) -> np.ndarray:
        """Derivative of a state by its small change, which turns the attitude about axes of the
        world. Undriven rates change so that the momentum stays. Undriven positions change only if a
        frame is tracked.
        """
        found = np.zeros((len(state), self.size))
        turns = [quaternion_rate(state[self._attitude], axis) for axis in np.eye(3)]
        found[self._attitude, :3] = np.transpose(turns)
        found[self._kept, np.arange(3, self.size)] = 1.0
        if self._undriven.size:
            if not self.tracks_frame:
                found[:, self._undriven] = 0.0
            slope = self._sample.momentum_slope(state, truth)[self._undriven]
            change = slope @ found[: slope.shape[1]]
            found[self._following] -= np.linalg.solve(slope[:, self._following], change)
        return found

    def _small_change(self, state: np.ndarray) -> np.ndarray:
        """Derivative of the small change of a state by the state."""
        found, attitude = np.zeros((self.size, len(state))), state[self._attitude]
        w, x, y, z = attitude * (2.0 / (attitude @ attitude))
        found[:3, self._attitude] = [[-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]]
        found[np.arange(3, self.size), self._kept] = 1.0
        return found


def traced_sample(scenario: Scenario, given: Scenario, grip: Grip) -> Any:
    """Return the traced sample of a phase with a shipped law; None: it is not covered. Wheels
    give what is commanded. ``given``: the scenario with its limits.
    """
    make = optional(SERVICES, "traced_sample")
    actuation = dataclasses.replace(scenario.actuation, wheels=None)
    sample = (
        None
        if make is None
        else make(dataclasses.replace(scenario, actuation=actuation), given, grip)
    )
    if sample is None or not is_shipped(sample.law) or sample.law.least_change:
        return None
    return sample


def agrees(loop: TracedLoop, make_other: Callable[[], DifferencedLoop]) -> bool:
    """Whether the code does what Drake's loop does, which ``make_other`` makes. It is asked until a
    loop stays near its plan, so that the answer does not depend on the loop that is first.
    """
    if loop.key not in _agrees:
        other = make_other()
        try:
            difference = _difference(loop, other) if loop.has_all_of(other) else math.inf
        finally:
            other.release()
        if math.isnan(difference):
            return True
        _agrees[loop.key] = difference <= _LARGEST_DIFFERENCE
    return _agrees[loop.key]


def _difference(one: TracedLoop, other: DifferencedLoop) -> float:
    """Of two loops, as a share of the state's largest entry, in the middle of the motion. NaN: they
    leave the motion, and amplify rounding.
    """
    period, bound = other.scenario.sample_time, other.scenario.divergence_speed
    index, found = round(one.motion.part(0.5) / period), list[np.ndarray]()
    for loop in (one, other):
        with np.errstate(all="ignore"):
            try:
                loop.place(index, {})
                for each in range(index, index + WARM_UP):
                    loop.go_on(each, {})
            except (Exception, SystemExit):  # Drake refuses numbers that are not finite
                return math.nan
        velocity = loop.known()[len(one.coordinates.position_names) :]
        if not np.abs(velocity).max() <= bound:
            return math.nan
        found.append(loop.known())
    return float(np.abs(found[0] - found[1]).max() / np.abs(found[1]).max())
