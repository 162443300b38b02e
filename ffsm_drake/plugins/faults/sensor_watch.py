"""Faults of sensors: silent, frozen, biased; and their ends."""

import itertools
import math
import operator

import numpy as np

from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.plugins.faults.correction import Correction, moved
from ffsm_drake.plugins.faults.known import CODE, LEARNT, OLD, WINDOWS
from ffsm_drake.plugins.faults.memory import Memory
from ffsm_drake.plugins.faults.sensors import entries_in_state
from ffsm_drake.plugins.faults.windows import EVERY, slope_weights, times_of
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, position_error, position_errors

_REPEATED = 5  # samples with the same bits
_ALIKE = 0.3  # largest difference of a change that ends a bias, as a share of it
JUMP, SLOPE = 1e-3, 1e-3  # m or rad, m/s or rad/s; smaller sensor errors are ignored
Slips = tuple[np.ndarray, np.ndarray]  # what ``SensorWatch._slips`` returns


class SensorWatch(Correction):
    """Compares each sensor with the other one of its coordinate. A sensor that works again is read
    again.
    """

    def _look_at_samples(self, memory: Memory) -> None:
        """Detect silent, frozen or jumping sensors, and those that work again, in the samples that
        waited: together, if nothing is wrong.
        """
        rows = memory.rows[int(memory.done) : int(memory.count) + 1]
        state, new = rows[:, self._in["state"]], rows[1:, self._in["new"]]
        now, before, nq, count = state[1:], state[:-1], self._nq, len(rows) - 1
        change = position_errors(now[:, :nq], before[:, :nq])
        slip = change - 0.5 * self._step * (now[:, nq:] + before[:, nq:])
        frozen = np.logical_and.reduceat(now == before, self._columns, axis=1) & self._is_exact
        jumps = self._jumps(memory, slip)
        if not memory.limit or frozen.any() or jumps.any() or not new.all():
            for row in range(int(memory.done) + 1, int(memory.count) + 1):
                self._look_at_sample(memory, memory.rows[row - 1 : row + 1])
            return
        memory.raw[:] = memory.seen[:] = now[-1]
        gain = count / min(memory.samples + count, 4.0 * LEARNT)
        memory.jitter += gain * ((slip**2).mean(axis=0) - memory.jitter)
        rows[1:, self._in["slip"]], rows[1:, self._in["moved"]] = slip, change
        memory.samples += count
        memory.done = memory.count

    def _is_usual(self, before: np.ndarray, now: np.ndarray, room: np.ndarray) -> bool:
        """Whether a state seems to have no frozen or jumping sensor: a fast test."""
        was, state, rooms = before.tolist(), now.tolist(), room.tolist()
        if any(map(operator.eq, was, state)) and ((before == now) & self._is_fine_state).any():
            return False
        nq, step = self._nq, self._step
        usual = step * math.hypot(*state[nq : nq + 3]) + rooms[0]
        slips = map(_slip, state[4:nq], was[4:], state[nq + 3 :], itertools.repeat(step))
        return 2.0 * math.dist(state[:4], was[:4]) < usual and all(
            map(operator.lt, slips, rooms[3:])
        )

    def _look_at_sample(self, memory: Memory, rows: np.ndarray) -> None:
        """Examine one sample, of which the row follows the one before, and correct its state."""
        row, nq, before = rows[1], self._nq, memory.seen.copy()
        raw, new = row[self._in["state"]].copy(), row[self._in["new"]]
        self._correct(memory, rows, is_first=False)
        change = position_error(memory.seen[:nq], before[:nq])
        slip = change - 0.5 * self._step * (memory.seen[nq:] + before[nq:])
        if new.size:
            memory.stale[:] = np.where(new > 0.0, 0.0, memory.stale + 1.0)
        self._examine(memory, raw, slip)
        gain = 1.0 / min(memory.samples + 1.0, 4.0 * LEARNT)
        memory.jitter += gain * (slip**2 - memory.jitter)
        row[self._in["slip"]], row[self._in["moved"]] = slip, change
        row[self._in["state"]], memory.raw[:] = memory.seen, raw
        memory.samples += 1.0
        memory.done += 1.0

    def _are_calm(self, memory: Memory) -> bool:
        """Whether no sensor is lost, old or repeats its bits, so that samples may wait."""
        lost = memory.codes[self._of_sensors].any() or memory.stale.any()
        return not (lost or memory.repeats[self._is_exact].any())

    def _examine(self, memory: Memory, raw: np.ndarray, slip: np.ndarray) -> None:
        """Examine each sensor; the slip of one that does not work is zero."""
        equal, jumps = raw == memory.raw, self._jumps(memory, slip)
        codes = memory.codes[self._of_sensors]
        memory.since += np.concatenate([slip, slip])
        same, works = np.logical_and.reduceat(equal, self._columns), codes == 0.0
        memory.repeats[works] = np.where(same, memory.repeats + 1.0, 0.0)[works]
        memory.since[np.repeat(works & ~same, self._widths)] = 0.0
        # silent for too long; repeating bits, by rounding or at rest perhaps
        silent = np.minimum.reduceat(memory.stale, self._columns) > self._least_patience
        frozen = self._is_exact & (memory.repeats >= _REPEATED)
        for index in np.flatnonzero(~works | silent | frozen | (jumps & ~same)).tolist():
            name, entries = self._sensor_names[index], self._sensor_entries[index]
            if not works[index]:
                if self._works_again(
                    memory, name, slip, same=bool(same[index]), jumps=bool(jumps[index])
                ):
                    self._read_again(memory, name, raw)
                slip[entries[entries < self._nv]] = 0.0
            elif silent[index]:
                self._lose(memory, name, "silent")
            elif frozen[index]:
                if not self._is_at_rest(memory, index, entries):
                    self._lose(memory, name, "frozen")
            # a jump back to a value that was repeated would not be one
            else:
                self._take_off(memory, entries, slip)
                self._lose(memory, name, "biased")

    def _jumps(self, memory: Memory, slip: np.ndarray) -> np.ndarray:
        """Mask of sensors (..., n): positions that jump by more than their velocities, if those are
        not lost, explain, from slips (..., nv).
        """
        count, square = len(self._widths) // 2, slip**2
        starts = self._entries[:count]
        jumps = np.zeros((*slip.shape[:-1], 2 * count), dtype=bool)
        if memory.samples < LEARNT:
            return jumps
        is_clear = np.add.reduceat(square, starts, axis=-1) > JUMP**2
        if is_clear.any():
            share = np.add.reduceat(square / (memory.jitter + 1e-30), starts, axis=-1)
            is_clear &= share > (self._settings.threshold + 1.0) ** 2
            lost = self._lost(memory.codes)[self._nv :]
            is_clear &= self._are_prompt[:count] & ~np.logical_or.reduceat(lost, starts)
            jumps[..., :count] = is_clear
        return jumps

    def _is_at_rest(self, memory: Memory, index: int, entries: np.ndarray) -> bool:
        """Whether a sensor that repeats its bits is of a jammed joint, or the other sensor of its
        coordinate shows no motion either.
        """
        joint = entries[0] % self._nv - NUM_BASE_VELOCITIES
        if joint >= 0 and memory.codes[self._of_joints[joint]]:
            return True
        walk = self._velocity_noise[entries % self._nv].max() * np.sqrt(memory.repeats[index])
        least = 1e-7 + self._settings.threshold * self._step * walk
        return bool(np.abs(memory.since[entries]).max() <= least)

    def _take_off(self, memory: Memory, entries: np.ndarray, slip: np.ndarray) -> None:
        """Subtract the jump of a position from now on; its slip is zero."""
        nq, nv, now = self._nq, self._nv, memory.seen
        found = np.zeros(2 * nv)
        found[entries] = slip[entries]
        memory.off += self._of_base(matrix_of(now[:4]).T, found)
        now[:nq] = moved(now[:nq], -found[:nv])
        slip[entries] = 0.0

    def _works_again(
        self, memory: Memory, sensor: str, slip: np.ndarray, *, same: bool, jumps: bool
    ) -> bool:
        """Whether a sensor that was lost measures: a position's bias ends with a jump back, that of
        a velocity as in ``_look_at_velocities``.
        """
        entries, code = self._sensors[sensor], memory.codes[self._unit(sensor)]
        if code == CODE["silent"]:
            return bool((memory.stale[entries_in_state(entries)] == 0.0).all())
        if code == CODE["frozen"]:
            return not same
        return jumps and self._ends_bias(memory, entries, -slip[entries])

    def _ends_bias(self, memory: Memory, entries: np.ndarray, change: np.ndarray) -> bool:
        """Whether a change, in world axes, is about the known bias of a sensor."""
        known = self._of_base(matrix_of(memory.seen[:4]), memory.off)[entries]
        return bool(np.linalg.norm(change - known) < _ALIKE * np.linalg.norm(known))

    def _read_again(self, memory: Memory, sensor: str, raw: np.ndarray) -> None:
        """Replace a sensor's measurement no more."""
        entries = self._sensors[sensor]
        columns = entries_in_state(entries)
        memory.codes[self._unit(sensor)] = 0.0
        memory.off[entries], memory.since[entries] = 0.0, 0.0
        memory.seen[columns] = raw[columns]
        self._forget(memory)

    def _lose(self, memory: Memory, sensor: str, kind: str) -> None:
        """Handle a lost sensor: the estimates of its coordinates are reset."""
        nq, nv, entries = self._nq, self._nv, self._sensors[sensor]
        memory.codes[self._unit(sensor)] = CODE[kind]
        now = memory.seen
        if kind != "biased" and entries[0] < nv:  # changes missed meanwhile
            missed = np.zeros(nv)
            missed[entries] = memory.since[entries]
            now[:nq] = moved(now[:nq], -missed)
        elif kind != "biased":
            memory.observed[:] = now
            memory.acceleration[:] = 0.0
        lost = self._lost(memory.codes)
        if (lost[:nv] & lost[nv:]).any() or not self._is_prompt[entries].all():
            memory.abort_request = 1.0
        self._forget(memory)

    def _slips(self, memory: Memory) -> Slips:
        """Of the last ``WINDOWS`` of blocks, differences (3, nv) between velocities and the slopes
        of their positions beyond the usual ones, and their standard deviations (3, nv).
        """
        step, white = EVERY * self._step, noise_of_mean(memory.jitter)
        longest, sizes = max(WINDOWS), np.array(WINDOWS)[:, None]
        blocks = memory.kept[-longest:, self._at["slip"]]
        weights = slope_weights(WINDOWS, longest, step)
        seconds = np.cumsum(np.diff(blocks, n=2, axis=0)[::-1] ** 2, axis=0)
        noise = np.sqrt(seconds[sizes[:, 0] - 3] / (6.0 * (sizes - 2)))
        deviation = np.maximum(noise, white) * np.linalg.norm(weights, axis=1)[:, None]
        velocity = 1.2 * self._velocity_noise / np.sqrt(EVERY)
        known = times_of(OLD, step)
        of_usual = np.hypot(white / np.sqrt(known @ known), velocity / np.sqrt(OLD))
        of_usual /= np.sqrt(max(memory.looks / OLD, 1.0))
        deviation = np.hypot(deviation, velocity / np.sqrt(sizes))
        return weights @ blocks - memory.slope, np.hypot(deviation, of_usual) + 1e-30

    def _look_at_velocities(self, memory: Memory, off: np.ndarray, deviation: np.ndarray) -> None:
        """Detect velocities that differ from the slope of their position.

        Args: ``_slips`` of windows (w, nv each).
        """
        nv, count = self._nv, len(self._widths) // 2
        starts, are_prompt = self._entries[:count], self._are_prompt.reshape(2, count).all(axis=0)
        is_off = np.add.reduceat(off**2, starts, axis=1) > SLOPE**2
        if not is_off.any():
            return
        share = np.add.reduceat((off / deviation) ** 2, starts, axis=1)
        is_off &= share > (self._settings.threshold + 1.0) ** 2
        is_off &= are_prompt & (memory.codes[self._of_sensors[:count]] == 0.0)
        for window, which in np.argwhere(is_off).tolist():
            name, entries = self._sensor_names[count + which], self._sensor_entries[count + which]
            at, code = entries - nv, memory.codes[self._of_sensors[count + which]]
            if not code:
                found = np.zeros(2 * nv)
                found[entries] = off[window, at]
                memory.off -= self._of_base(matrix_of(memory.seen[:4]).T, found)
                self._lose(memory, name, "biased")
            elif code == CODE["biased"] and self._ends_bias(memory, entries, off[window, at]):
                self._read_again(memory, name, memory.raw)


def _slip(now: float, before: float, velocity: float, step: float) -> float:
    return abs(now - before - step * velocity)


def noise_of_mean(square: np.ndarray) -> np.ndarray:
    """The noise of a block's mean, from the mean square of the differences of its samples."""
    noise: np.ndarray = np.sqrt(square / (2.0 * EVERY))
    return noise
