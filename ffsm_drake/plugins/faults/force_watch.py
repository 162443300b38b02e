"""Faults of wheels, joints and thrusters, in windows of blocks of unexplained motion.

``wheel_watch`` decides on wheels. Joints and thrusters have one decision, of ``motion_watch``.
"""

import numpy as np

from ffsm_drake.plugins.actuators.wheel_set import WHEEL_STOPS
from ffsm_drake.plugins.faults import features
from ffsm_drake.plugins.faults.known import KEPT, LEARNT, OLD, WINDOWS
from ffsm_drake.plugins.faults.memory import Memory
from ffsm_drake.plugins.faults.motion_watch import MotionWatch
from ffsm_drake.plugins.faults.wheel_watch import stopped
from ffsm_drake.plugins.faults.windows import BATCH, EVERY, slope_weights
from ffsm_drake.plugins.faults.wrists import FADES


class ForceWatch(MotionWatch):
    """A lost thruster or wheel leaves the allocation. A jammed joint, or the loss of a unit
    essential to the allocation, raises ``abort_request``.
    """

    def _collect(self, memory: Memory, first: int, size: int) -> int:
        """Add the blocks that some samples form to what is kept; return how many they are."""
        count, step, before = len(self._force), self._step, memory.samples - memory.done
        rows, blocks = memory.rows[first : first + size + 1], size // EVERY
        velocity, told = rows[:, self._in["state"]][:, self._nq :], rows[:, self._in["told"]]
        beyond, expected, errors = self._changes(rows, before)
        left, now = np.diff(velocity, axis=0) - expected, velocity[1:]
        self._find_jumps(memory, left, rows[0, self._in["state"]], before)
        if self._has_wrists:
            memory.pressed *= np.exp(-size * self._step / FADES)
            largest = rows[1:, self._in["pressed"]].max(axis=0)
            memory.pressed[:] = np.maximum(memory.pressed, largest)
        moves = rows[1:, self._in["slip"]], rows[1:, self._in["moved"]]
        errors = errors.reshape(size, -1)
        impulses = step * told[1:, :count], step * told[:-1, count:]
        parts = left, *moves, 0.0 * now, errors, *impulses, beyond
        sums = np.cumsum(np.vstack([memory.sums, np.hstack(parts)]), axis=0)[1:]
        sums[:, self._at["velocity"]] = now
        memory.sums[:] = sums[-1]
        means = sums.reshape(blocks, EVERY, -1).mean(axis=1)
        memory.kept = np.vstack([memory.kept[blocks:], means])
        memory.done -= size
        memory.blocks += blocks
        memory.span += blocks
        if count:
            fresh = EVERY * int(np.clip(memory.span, 0, blocks))
            memory.pulses *= float(fresh == size)
            samples = np.hstack([told[1:, :count], left / step, errors / step])[size - fresh :]
            features.pulses(memory.pulses, samples, told[size - fresh :, :count], fresh // EVERY)
        memory.clock += blocks
        if memory.clock % BATCH == 0.0:
            memory.states = np.vstack([memory.states[1:], rows[-1, self._in["state"]]])
        return blocks

    def _find_jumps(
        self, memory: Memory, left: np.ndarray, state: np.ndarray, before: float
    ) -> None:
        """Find velocities that jump: they begin a new window of their sensors.

        Args: unexplained changes; the state before them; how many samples were before.
        """
        _, inverse, _, pushes = self._models.at(state[None])
        reach = self._step * np.abs(inverse[0] @ pushes[0]) @ self._force
        bound = self._settings.threshold * np.sqrt(memory.rough) + reach
        first = int(max(LEARNT - before, 0))
        jumps = (np.abs(left) > bound).any(axis=1) & (np.arange(len(left)) >= first)
        begins = np.flatnonzero(jumps & ~np.append(memory.jumped > 0.0, jumps[:-1]))
        if begins.size and memory.blocks >= WINDOWS[0]:
            memory.blocks = -1.0 - begins[0] // EVERY
        memory.jumped = float(jumps[-1])
        change = np.where(jumps[:, None], np.clip(left, -bound, bound), left)
        gain = len(left) / min(before + len(left), 4.0 * LEARNT)
        memory.rough += gain * ((change**2).mean(axis=0) - memory.rough)

    def _look_at_blocks(self, memory: Memory, blocks: int) -> None:
        """Wheels, velocities, then joints and thrusters, in windows of blocks, as many of which are
        new.
        """
        valid, step, kept = int(memory.blocks), EVERY * self._step, memory.kept[-KEPT:]
        if valid >= KEPT or (memory.looks < OLD and valid >= 2 * OLD):
            old = kept[-min(valid, KEPT) :][OLD : 2 * OLD, self._at["slip"]]
            memory.looks += blocks
            gain = blocks / min(memory.looks, 2.0 * LEARNT)
            memory.slope += gain * (
                slope_weights((len(old),), len(old), step)[0] @ old - memory.slope
            )
        if self._wheels is not None:
            self._look_at_wheels(memory, valid)
        # an unpredictable motion allows no further detection
        if memory.abort_request or memory.samples < LEARNT:
            return
        slips = self._slips(memory)
        if memory.looks >= OLD:
            count = sum(window <= valid for window in WINDOWS)
            self._look_at_velocities(memory, *(of[:count] for of in slips))
        if self._sees_forces:
            self._look_at_forces(memory, slips)

    def _look_at_wheels(self, memory: Memory, valid: int) -> None:
        """Report stopped wheels."""
        assert self._wheels is not None
        windows = [each for each in (EVERY, *WINDOWS) if each < valid]
        blocks = memory.kept[:, -2 * len(self._wheels.names) :]
        for name in stopped(blocks, windows, self._wheels):
            self._notice(memory, f"wheels.{name}", WHEEL_STOPS.name)
