"""A closed loop as a map of numbers from just before a control sample to just before the next, with
small changes of its state.

A sample is compiled code with an exact derivative (plug-in ``compiled``), or a Drake diagram
(``drake_sample``) with finite differences.
"""

import dataclasses
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff

from ffsm_drake.common.registrations import Registry
from ffsm_drake.common.so3 import quaternion_rate
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.actuators.mean import mean_blocks
from ffsm_drake.plugins.design.stability.drake_sample import DrakeSample
from ffsm_drake.plugins.design.stability.linear_loop import WARM_UP, SampleMap
from ffsm_drake.plugins.design.stability.users_period import period_of
from ffsm_drake.scenario import Grip, MassProperties
from ffsm_drake.systems.controllers.law import is_shipped

# From Drake's loop after ``WARM_UP`` samples, as a share of the state's largest entry.
_LARGEST_DIFFERENCE = 1e-7
_agrees: dict[Any, bool] = {}  # key of code -> whether it does what Drake's loop does
Held = Mapping[str, np.ndarray]  # values of held memory, in place of its own


class SampledLoop:
    """A closed loop from sample to sample. A state is that just before a control sample."""

    def __init__(self, sample: Any, mission: Mission, grip: Grip) -> None:
        """Args: a sample of a mission without what has no derivative, the mission, and what holds
        the target.
        """
        self.sample, self._mission, self._grip = sample, mission, grip
        self._scenario = mission.scenario
        self.motion, self.law, self.coordinates = sample.motion, sample.law, sample.coordinates
        self.tracks_frame: bool = sample.tracks_frame
        self.hidden: tuple[str, ...] = sample.hidden_names
        self.user_supplied: Sequence[Any] = getattr(sample, "user_supplied", ())
        self.noise, self.num_noise = sample.noise, int(sample.num_noise)
        self._undriven = np.flatnonzero(~self.coordinates.is_driven)
        self._positions = self.coordinates.num_positions
        # rates at constant momentum
        self._following = np.array(sample.known)[self._positions + self._undriven]
        plant = [*sample.known, *sample.hidden]
        held = [np.arange(part.start, part.stop) for part, _ in sample.held.values()]
        beside = np.arange(sample.size)[getattr(sample, "beside", slice(0))]
        rest = np.setdiff1d(np.arange(sample.size), np.concatenate([plant, beside, *held]))
        # entries of the state that are the linear loop's from its fourth on
        self._attitude, self._kept = plant[:4], np.concatenate([plant[4:], rest]).astype(int)
        # entries of the linear loop's state, the plant's first
        self.size, self.plant_size = 3 + self._kept.size, len(plant) - 1
        self.parts_of_memory = dict[str, slice]()
        for name, part in sample.memory.items():
            if name not in sample.held:
                begin = self.plant_size + int(np.searchsorted(rest, part.start))
                self.parts_of_memory[name] = slice(begin, begin + part.stop - part.start)
        self._users_period: int | None = None if self.user_supplied else 1

    @property
    def is_exact(self) -> bool:
        """Whether its derivatives are exact; else they are finite differences."""
        return not isinstance(self.sample, DrakeSample)

    def release(self) -> None:
        """Free its diagram."""
        if not self.is_exact:
            self.sample.release()

    def known(self, state: np.ndarray) -> np.ndarray:
        """[q; v] of the plant."""
        return state[self.sample.known]

    def has_diverged(self, state: np.ndarray) -> bool:
        """Whether the plant moves as no motion does, or its state is none."""
        velocity = self.known(state)[self._positions :]
        return not np.abs(velocity).max() <= self._scenario.divergence_speed  # true for NaN too

    def placed(self, index: int, held: Held) -> np.ndarray:
        """A state on the plan, with all memory as at the start of the run."""
        row = self.motion.row(index * self.sample.sample_time)
        state = self.sample.placed(row[: len(self.sample.known)])
        if "samples" in self.sample.memory and is_shipped(self.law):  # it counts them
            state[self.sample.memory["samples"]] = index
        return self._holding(state, held)

    def first(self, held: Held) -> np.ndarray:
        """The state at the start of the run, as if samples had been before."""
        state = self.sample.start.copy()
        for name in ("delayed_desired_velocity", "delayed_velocity"):
            if name in self.sample.memory:
                state[self.sample.memory[name]] = self.motion.evaluate(0.0)[1]
        return self._holding(state, held)

    def after(self, index: int, state: np.ndarray, held: Held) -> tuple[np.ndarray, np.ndarray]:
        """The state before the next sample, and the controller's force (nv) until then."""
        found, force = self.sample.after(index, state)
        return self._holding(found, held), np.asarray(force)

    def _holding(self, state: np.ndarray, held: Held) -> np.ndarray:
        """A state with held memory at its values."""
        state = state.copy()
        for name, (part, value) in self.sample.held.items():
            own = self.sample.start[part] if value is None else value
            state[part] = np.ravel(held[name]) if name in held else own
        return state

    def maps(
        self, index: int, state: np.ndarray, held: Held, truth: MassProperties | None
    ) -> tuple[SampleMap, ...]:
        """The maps of one common period of all blocks; one of NaN of a loop that has diverged.

        Args:
          index: the control sample.
          state: before it.
          held: see ``Linearizer.at``.
          truth: likewise.

        Raises NotLinear: user-supplied systems do not repeat themselves.
        """
        if self._users_period is None and not self.has_diverged(state):
            self._users_period = period_of(self, index, state, held)
        if (own := self._users_period) is None or not np.isfinite(state).all():
            forces, count = self.coordinates.num_velocities, self.num_noise
            shapes = {"a": (self.size, self.size), "b": (self.size, count)}
            shapes |= {"c": (forces, self.size), "d": (forces, count)}
            return (SampleMap(**{name: np.full(each, np.nan) for name, each in shapes.items()}),)
        own = math.lcm(own, self.sample.latched_period)
        found = dict[Hashable, SampleMap]()
        indices = range(index, index + math.lcm(self.sample.period, own))
        kinds = [(self.sample.kind(each), each % own) for each in indices]
        at = state
        for each, kind in zip(indices, kinds, strict=True):
            passed = (each - index) % own
            if passed == 0:
                at = state
            if kind not in found:
                found[kind] = self._map(each, at, truth)
            if own > 1:
                at, _ = self.after(index + passed, at, held)
        return tuple(found[kind] for kind in kinds)

    def _map(self, index: int, state: np.ndarray, truth: MassProperties | None) -> SampleMap:
        directions = self.directions(state, truth)
        after, of_state, of_force = self.sample.derivative(index, state, truth, directions)
        both, n = self._small_change(after) @ of_state, self.size
        if not self.tracks_frame:
            both[self._undriven, self._undriven] = 1.0  # their drift adds up
        return SampleMap(a=both[:, :n], b=both[:, n:], c=of_force[:, :n], d=of_force[:, n:])

    def directions(self, state: np.ndarray, truth: MassProperties | None = None) -> np.ndarray:
        """Derivative of a state and the noise (n + m) by the small change of the state, which turns
        the attitude about axes of the world, and by the noise. Undriven rates change so that the
        momentum stays. Undriven positions change only if a frame is tracked.
        """
        found = np.zeros((state.size + self.num_noise, self.size + self.num_noise))
        found[state.size :, self.size :] = np.eye(self.num_noise)
        turns = [quaternion_rate(state[self._attitude], axis) for axis in np.eye(3)]
        found[self._attitude, :3] = np.transpose(turns)
        found[self._kept, np.arange(3, self.size)] = 1.0
        if self._undriven.size:
            if not self.tracks_frame:
                found[:, self._undriven] = 0.0
            slope = self.momentum_slope(state, truth)[self._undriven]
            change = slope @ found[: slope.shape[1]]
            found[self._following] -= np.linalg.solve(slope[:, self._following], change)
        return found

    def momentum_slope(self, state: np.ndarray, truth: MassProperties | None = None) -> np.ndarray:
        """Derivative of the momentum (6) about the world's origin by the plant's state (6, n).

        Args: the state; true mass properties of the payload, in place of the scenario's.
        """
        payload = self._scenario.payload
        if truth is not None:
            payload = dataclasses.replace(payload, truth=truth)
        true = self._mission.flown_by(payload=payload).craft.flexible(self._grip)
        plant = true.plant.ToAutoDiffXd()
        context = plant.CreateDefaultContext()
        context.SetTimeStateAndParametersFrom(true.context)
        x = state[: plant.num_multibody_states()]
        plant.SetPositionsAndVelocities(context, InitializeAutoDiff(x)[:, 0])
        momentum = plant.CalcSpatialMomentumInWorldAboutPoint(context, np.zeros(3))
        return ExtractGradient(momentum.get_coeffs())

    def _small_change(self, state: np.ndarray) -> np.ndarray:
        """Derivative of the small change of a state by the state."""
        found, attitude = np.zeros((self.size, len(state))), state[self._attitude]
        w, x, y, z = attitude * (2.0 / (attitude @ attitude))
        found[:3, self._attitude] = [[-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]]
        found[np.arange(3, self.size), self._kept] = 1.0
        return found


# Of a mission, and the mission with its limits, in a phase, with what makes its actuators: its
# ``TracedSample``, or None.
TRACED_SAMPLES = Registry[Callable[[Mission, Mission, Grip, Callable[..., Any]], Any]](
    "traced_samples"
)


def traced_sample(mission: Mission, before: Mission, grip: Grip) -> Any:
    """Return the compiled sample of a phase with a shipped law; None: it is not covered. Thrusters
    give their mean, and wheels what is commanded. ``before``: the mission with its limits.
    """
    make = TRACED_SAMPLES.first()
    sample = None if make is None else make(mission, before, grip, mean_blocks)
    if sample is None or not is_shipped(sample.law) or sample.law.least_change:
        return None
    return sample


def agrees(loop: SampledLoop, make_other: Callable[[], SampledLoop]) -> bool:
    """Whether the code does what Drake's loop does, which ``make_other`` makes. It is asked until a
    loop stays near its plan, so that the answer does not depend on the loop that is first.
    """
    key = loop.sample.key
    if key not in _agrees:
        other = make_other()
        try:
            has_all = other.sample.blocks <= set(loop.sample.blocks)
            difference = _difference(loop, other) if has_all else math.inf
        finally:
            other.release()
        if math.isnan(difference):
            return True
        _agrees[key] = difference <= _LARGEST_DIFFERENCE
    return _agrees[key]


def _difference(one: SampledLoop, other: SampledLoop) -> float:
    """Of two loops, as a share of the state's largest entry, in the middle of the motion. NaN: they
    leave the motion, and amplify rounding.
    """
    index, found = round(one.motion.part(0.5) / one.sample.sample_time), list[np.ndarray]()
    for loop in (one, other):
        with np.errstate(all="ignore"):
            state = loop.placed(index, {})
            for each in range(index, index + WARM_UP):
                state, _ = loop.after(each, state, {})
        if loop.has_diverged(state):
            return math.nan
        found.append(loop.known(state))
    return float(np.abs(found[0] - found[1]).max() / np.abs(found[1]).max())
