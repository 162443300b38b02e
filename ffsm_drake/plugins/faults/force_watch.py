"""Faults of wheels, joints and thrusters, in windows of blocks of unexplained motion.

``wheel_watch`` decides on wheels. Joints and thrusters have one decision, of ``motion_watch``.
"""

import numpy as np

from ffsm_drake.plugins.actuators.wheel_set import WHEEL_STOPS
from ffsm_drake.plugins.faults.known import EVERY, KEPT, LEARNT, OLD, WINDOWS
from ffsm_drake.plugins.faults.memory import Memory
from ffsm_drake.plugins.faults.motion_watch import MotionWatch
from ffsm_drake.plugins.faults.wheel_watch import stopped
from ffsm_drake.plugins.faults.windows import slope_weights


class ForceWatch(MotionWatch):
    """A lost thruster or wheel leaves the allocation. A jammed joint, or the loss of a unit
    essential to the allocation, raises ``abort_request``.
    """

    def _collect(self, memory: Memory) -> None:
        """Add the samples of a block that ends to what is kept of blocks."""
        rows, count, nq, step = memory.rows, len(self._force), self._nq, self._step
        before, told = rows[:, self._in["before"]], rows[:, self._in["told"]]
        now = np.vstack([before[1:], memory.seen])[:, nq:]
        fires = np.vstack([told[1:], memory.told])[:, :count]
        beyond, expected = self._changes(memory, rows, memory.samples - EVERY)
        left = now - before[:, nq:] - expected
        self._find_jumps(memory, left)
        moves = rows[:, self._in["slip"]], rows[:, self._in["moved"]]
        parts = left, *moves, 0.0 * now, step * fires, step * told[:, count:], beyond
        sums = np.cumsum(np.vstack([memory.sums, np.hstack(parts)]), axis=0)[1:]
        sums[:, self._at["velocity"]] = now
        memory.sums[:] = sums[-1]
        memory.kept = np.vstack([memory.kept[1:], sums.mean(axis=0)])
        memory.states = np.vstack([memory.states[1:], memory.seen])
        if count:
            samples = np.hstack([fires, left / step, expected / step])
            memory.fired = np.concatenate([memory.fired[1:], samples[None]])
            pushes = self._models.pushes(memory.seen)
            pushed = np.linalg.solve(self._models.dynamics(memory.seen)[0], pushes)
            memory.reach[:] = step * np.abs(pushed) @ self._force
        memory.blocks += 1.0
        memory.span += 1.0
        memory.clock += 1.0

    def _find_jumps(self, memory: Memory, left: np.ndarray) -> None:
        """Find velocities that jump in a block: each begins a new window of its sensor."""
        rough, count = memory.rough, memory.samples - EVERY
        for change in left:
            count += 1.0
            bound = self._settings.threshold * np.sqrt(rough) + memory.reach
            jumps = float(count > LEARNT and (np.abs(change) > bound).any())
            if jumps:
                change = np.clip(change, -bound, bound)
                if not memory.jumped and memory.blocks >= WINDOWS[0]:
                    memory.blocks = -1.0
            memory.jumped = jumps
            rough += (change**2 - rough) / min(count, 4.0 * LEARNT)

    def _look_at_blocks(self, memory: Memory) -> None:
        """Wheels, velocities, then joints and thrusters, in windows of blocks."""
        valid, step, kept = int(memory.blocks), EVERY * self._step, memory.kept[-KEPT:]
        if valid >= KEPT or (memory.looks < OLD and valid >= 2 * OLD):
            old = kept[-min(valid, KEPT) :][OLD : 2 * OLD, self._at["slip"]]
            memory.looks += 1.0
            gain = 1.0 / min(memory.looks, 2.0 * LEARNT)
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
