"""Faults of wheels, joints and thrusters, in windows of blocks of unexplained motion.

``wheel_watch`` decides on wheels. Joints and thrusters have one decision, of ``motion_watch``.
"""

import numpy as np

from ffsm_drake.plugins.actuators.wheel_set import WHEEL_STOPS
from ffsm_drake.plugins.faults.known import EVERY, KEPT, LEARNT, OLD, WINDOWS, Memory
from ffsm_drake.plugins.faults.motion_watch import MotionWatch
from ffsm_drake.plugins.faults.wheel_watch import stopped
from ffsm_drake.plugins.faults.windows import slope_of


class ForceWatch(MotionWatch):
    """A lost thruster or wheel leaves the allocation. A jammed joint, or the loss of a unit
    essential to the allocation, raises ``abort_request``.
    """

    def _collect(self, memory: Memory, before: np.ndarray, expected: np.ndarray) -> bool:
        """Sums of what is unexplained, in blocks; whether one ends."""
        nq, now = self._nq, memory.seen
        left = now[nq:] - before[nq:] - expected
        count = memory.samples = memory.samples + 1.0
        bound = self._settings.threshold * np.sqrt(memory.rough) + memory.reach
        known = np.clip(left, -bound, bound) if count > LEARNT else left
        # a velocity that jumps begins a new window of its sensor
        jumps = float((known != left).any())
        if jumps and not memory.jumped and memory.blocks >= WINDOWS[0]:
            memory.blocks = -1.0
        memory.jumped = jumps
        memory.rough += (known**2 - memory.rough) / min(count, 4.0 * LEARNT)
        memory.sums[self._at["left"]] += left
        memory.sums[self._at["velocity"]] = now[nq:]
        memory.part += memory.sums / EVERY
        self._collect_fired(memory, left, expected)
        is_whole = bool(count % EVERY == 0.0)
        if is_whole:
            memory.kept = np.vstack([memory.kept[1:], memory.part])
            memory.part = np.zeros_like(memory.part)
            memory.blocks += 1.0
            self._end_block(memory)
        return is_whole

    def _look_at_blocks(self, memory: Memory) -> None:
        """Wheels, velocities, then joints and thrusters, in windows of blocks."""
        valid, step, kept = int(memory.blocks), EVERY * self._step, memory.kept[-KEPT:]
        if valid >= KEPT or (memory.looks < OLD and valid >= 2 * OLD):
            old = kept[-min(valid, KEPT) :][OLD : 2 * OLD, self._at["slip"]]
            memory.looks += 1.0
            gain = 1.0 / min(memory.looks, 2.0 * LEARNT)
            memory.slope += gain * (slope_of(old, step)[0] - memory.slope)
        if self._wheels is not None:
            self._look_at_wheels(memory, valid)
        # an unpredictable motion allows no further detection
        if memory.abort_request or memory.samples < LEARNT:
            return
        slips = self._slips(memory)
        if memory.looks >= OLD:
            for window, off, deviation in zip(WINDOWS, *slips, strict=True):
                if window <= valid:
                    self._look_at_velocities(memory, off, deviation)
        if self._sees_forces:
            self._look_at_forces(memory, slips)

    def _look_at_wheels(self, memory: Memory, valid: int) -> None:
        """Report stopped wheels."""
        assert self._wheels is not None
        windows = (each for each in (EVERY, *WINDOWS) if each < valid)
        blocks = memory.kept[:, -2 * len(self._wheels.names) :]
        for name in stopped(blocks, windows, self._wheels):
            self._notice(memory, f"wheels.{name}", WHEEL_STOPS.name)
