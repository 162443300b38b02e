"""State of a closed loop as vectors: the plant's, with its small changes, and discrete state."""

import math
from collections.abc import Callable, Hashable, Sequence

import numpy as np
from pydrake.systems.framework import Context, System

from ffsm_drake.common.so3 import quaternion_rate, rotation_error
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.spacecraft.coordinates import BASE_ROTATION, NUM_BASE_POSITIONS
from ffsm_drake.spacecraft.free_floating import FreeFloating


class PlantState:
    """The plant's state in a context of the closed loop, [q; v] followed by its hidden state, and
    small changes of it: of e, its rate and the hidden state.
    """

    def __init__(self, loop: ClosedLoop, root_context: Context) -> None:
        self._loop, self._plant = loop, loop.plant
        self._context = loop.plant.GetMyMutableContextFromRoot(root_context)

    def known(self) -> np.ndarray:
        """[q; v] without hidden coordinates."""
        whole = self._plant.GetPositionsAndVelocities(self._context)
        return self._loop.split.known_part(whole).copy()

    def read(self) -> np.ndarray:
        """The state."""
        whole = self._plant.GetPositionsAndVelocities(self._context)
        return np.concatenate([self.known(), self._loop.split.hidden_part(whole)])

    def write(self, state: np.ndarray) -> None:
        """Set the state."""
        known, hidden = np.split(state, [2 * len(self._loop.coordinates.names) + 1])
        self._plant.SetPositionsAndVelocities(self._context, self._loop.split.whole(known, hidden))

    def moved(self, state: np.ndarray, change: np.ndarray) -> np.ndarray:
        """A state after a small change, which turns the attitude about axes of the world."""
        moved, nv = state.copy(), len(self._loop.coordinates.names)
        # to first order, which needs no sine; the quaternion's norm does not matter
        moved[:4] += quaternion_rate(state[:4], change[:3])
        moved[4 : nv + 1] += change[3:nv]
        moved[nv + 1 :] += change[nv:]
        return (
            moved if not self._loop.coordinates.undriven else self._at_same_momentum(moved, state)
        )

    def _at_same_momentum(self, moved: np.ndarray, state: np.ndarray) -> np.ndarray:
        """A moved state with the undriven positions of the state before, unless a frame is tracked,
        and undriven velocities of the same momentum.
        """
        coordinates, split = self._loop.coordinates, self._loop.split
        nq, model = len(coordinates.position_names), self._loop.model(self._context)
        # the base comes first in every state
        undriven = np.flatnonzero(~coordinates.is_driven)
        places = np.arange(4) if "base_rotation" in coordinates.undriven else np.empty(0, dtype=int)
        places = np.concatenate([places, undriven[undriven >= len(BASE_ROTATION)] + 1])
        result = moved.copy()
        if not self._loop.tracks_frame:
            result[places] = state[places]

        def whole(known_and_hidden: np.ndarray) -> tuple[FreeFloating, np.ndarray]:
            known, rest = np.split(known_and_hidden, [nq + len(coordinates.names)])
            q, v = np.split(split.whole(known, rest), [nq + len(split.names)])
            others = np.delete(np.arange(v.size), undriven)
            mass_matrix = model.calc_mass_matrix(q)
            return FreeFloating(
                mass_matrix=mass_matrix, base_position=q[4:NUM_BASE_POSITIONS], driven=others
            ), v

        before, v_before = whole(state)
        after, v = whole(result)
        momentum = before.momentum(v_before)
        change = after.velocity(v[after.driven], momentum) - before.velocity(
            v_before[before.driven], momentum
        )
        # no difference of rounding where nothing changes
        result[nq + undriven] = state[nq + undriven] + change[undriven]
        return result


def difference(state: np.ndarray, base: np.ndarray) -> np.ndarray:
    """The small change from one plant state to another."""
    return np.concatenate([rotation_error(state[:4], base[:4]), state[4:] - base[4:]])


class Memory:
    """The discrete state of several systems as one vector, with a slice for each group in
    ``parts``.
    """

    def __init__(
        self,
        systems: Sequence[System],
        root_context: Context,
        *,
        sample_time: float,
        leave_out: Callable[[System, int], bool] = lambda system, group: False,
    ) -> None:
        self.systems, self.size, self.parts = systems, 0, list[slice]()
        self._groups: list[tuple[Context, int]] = []
        self._where = dict[tuple[System, int], slice]()
        # with period and offset in control samples
        self._updated: list[tuple[System, Context, float, float]] = []
        # for each of them its groups with their slices
        self._parts_of: list[list[tuple[int, slice]]] = []
        # A system may behave differently from sample to sample: it says how by ``phase`` and
        # ``phase_period``.
        self._phased = [system for system in systems if hasattr(system, "phase_period")]
        for system in systems:
            context = system.GetMyMutableContextFromRoot(root_context)
            parts = list[tuple[int, slice]]()
            for group in range(context.num_discrete_state_groups()):
                if not leave_out(system, group):
                    width = context.get_discrete_state(group).size()
                    self._where[system, group] = slice(self.size, self.size + width)
                    parts.append((group, self._where[system, group]))
                    self.size += width
            self.parts += [part for _, part in parts]
            self._groups += [(context, group) for group, _ in parts]
            timing = system.GetUniquePeriodicDiscreteUpdateAttribute()
            if timing is not None:
                times = timing.period_sec() / sample_time, timing.offset_sec() / sample_time
                self._updated.append((system, context, *times))
                self._parts_of.append(parts)
        periods = [max(1, round(period)) for _, _, period, _ in self._updated]
        self.common_period = math.lcm(*periods, *(system.phase_period for system in self._phased))
        every_sample = all(
            abs(period - 1.0) + abs(offset) < 1e-6 for _, _, period, offset in self._updated
        )
        self._always = (True,) * len(self._updated) if every_sample else ()

    def part_of(self, system: System, group: int) -> slice | None:
        """The part of a system's discrete group; None if it was left out."""
        return self._where.get((system, group))

    def kind(self, index: int) -> Hashable:
        """A key that is equal for control samples with the same updates."""
        return self.which(index), self.phases(index)

    def phases(self, index: int) -> tuple[int, ...]:
        """Phases of the systems with changing behaviour from sample to sample."""
        return tuple(system.phase(index) for system in self._phased)

    def which(self, index: int) -> tuple[bool, ...]:
        """Systems with an update at a control sample."""
        if self._always:
            return self._always
        times = [(index - offset) / period for _, _, period, offset in self._updated]
        return tuple(time > -1e-6 and abs(time - round(time)) < 1e-6 for time in times)

    def update(self, index: int) -> None:
        """Perform the update of a control sample, every system from the state before it."""
        self.write(self.after(index))

    def after(self, index: int, *, without: System | None = None) -> np.ndarray:
        """The values after the update of a control sample, without performing it; zeros in place of
        those of one system.
        """
        result = self.read()
        for (system, context, _, _), parts, due in zip(
            self._updated, self._parts_of, self.which(index), strict=True
        ):
            if system is without:
                for _, part in parts:
                    result[part] = 0.0
            elif due:
                values = system.EvalUniquePeriodicDiscreteUpdate(context)
                for group, part in parts:
                    result[part] = values.value(group)
        return result

    def read(self) -> np.ndarray:
        return np.concatenate(
            [context.get_discrete_state(group).value() for context, group in self._groups] or [[]]
        )

    def write(self, values: np.ndarray) -> None:
        for number, part in enumerate(self.parts):
            self.write_part(number, values[part])

    def write_part(self, number: int, values: np.ndarray) -> None:
        context, group = self._groups[number]
        context.SetDiscreteState(group, values)
