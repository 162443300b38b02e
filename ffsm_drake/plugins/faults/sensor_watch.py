"""Faults of sensors: silent, frozen, biased; and their ends."""

import numpy as np

from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.plugins.faults.correction import Correction, moved
from ffsm_drake.plugins.faults.known import CODE, EVERY, LEARNT, OLD, Memory
from ffsm_drake.plugins.faults.sensors import entries_in_state
from ffsm_drake.plugins.faults.windows import slope_of, times_of
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, position_error

_REPEATED = 5  # samples with the same bits
_ALIKE = 0.3  # largest difference of a change that ends a bias, as a share of it
_JUMP, _SLOPE = 1e-3, 1e-3  # m or rad, m/s or rad/s; smaller sensor errors are ignored


class SensorWatch(Correction):
    """Compares each sensor with the other one of its coordinate. A sensor that works again is read
    again.
    """

    def _jammed(self, codes: np.ndarray) -> np.ndarray:
        """Mask of the jammed coordinates (nv)."""
        base, joints = np.zeros(NUM_BASE_VELOCITIES, dtype=bool), self._model.coordinates.joints
        at = [self._names.index(f"joints.{name}") for name in joints]
        return np.concatenate([base, codes[at] > 0.0])

    def _look_at_sensors(
        self, memory: Memory, raw: np.ndarray, before: np.ndarray, new: np.ndarray | None
    ) -> None:
        """Detect silent, frozen or jumping sensors, and those that work again."""
        nq, now = self._nq, memory.seen
        change = position_error(now[:nq], before[:nq])
        slip = change - 0.5 * self._step * (now[nq:] + before[nq:])
        memory.since += np.tile(slip, 2)
        memory.stale[:] = 0.0 if new is None else np.where(new > 0.0, 0.0, memory.stale + 1.0)
        lost, joints = self._lost(memory.codes), self._jammed(memory.codes)
        for index, (name, entries) in enumerate(self._sensors.items()):
            columns = entries_in_state(entries)
            same = bool((raw[columns] == memory.raw[columns]).all())
            if memory.codes[self._unit(name)]:
                if self._works_again(memory, name, slip, same=same):
                    self._read_again(memory, name, raw)
                slip[entries[entries < self._nv]] = 0.0
                continue
            memory.repeats[index] = memory.repeats[index] + 1.0 if same else 0.0
            if not same:
                memory.since[entries] = 0.0
            if self._is_silent(memory, name):
                self._lose(memory, name, "silent")
            elif self._is_frozen(memory, index, entries):
                still = joints[entries % self._nv].any() or self._is_at_rest(memory, index, entries)
                if not still:
                    self._lose(memory, name, "frozen")
            # a jump back to a value that was repeated would not be one
            elif not same and self._jumps(memory, entries, slip, lost):
                self._take_off(memory, entries, slip)
                self._lose(memory, name, "biased")
        gain = 1.0 / min(memory.samples + 1.0, 4.0 * LEARNT)
        memory.jitter += gain * (slip**2 - memory.jitter)
        memory.sums[self._at["slip"]] += slip
        memory.sums[self._at["moved"]] += change

    def _is_silent(self, memory: Memory, sensor: str) -> bool:
        """Whether a sensor has reported no new measurement for too long."""
        entries = self._sensors[sensor]
        stale = memory.stale[entries_in_state(entries)]
        return bool((stale > self._patience[entries[0]]).all())

    def _is_frozen(self, memory: Memory, index: int, entries: np.ndarray) -> bool:
        """Whether a sensor repeats its bits, by rounding or at rest perhaps."""
        is_exact = self._is_prompt[entries].all() and self._is_fine[entries].all()
        return bool(is_exact and memory.repeats[index] >= _REPEATED)

    def _is_at_rest(self, memory: Memory, index: int, entries: np.ndarray) -> bool:
        """Whether the other sensor of a sensor that repeats its bits shows no motion either."""
        walk = self._velocity_noise[entries % self._nv].max() * np.sqrt(memory.repeats[index])
        least = 1e-7 + self._settings.threshold * self._step * walk
        return bool(np.abs(memory.since[entries]).max() <= least)

    def _jumps(
        self, memory: Memory, entries: np.ndarray, slip: np.ndarray, lost: np.ndarray
    ) -> bool:
        """Whether a position jumps by more than its velocity, if that is not lost, explains."""
        if memory.samples < LEARNT or entries[0] >= self._nv:
            return False
        if not self._is_prompt[entries].all() or lost[entries + self._nv].any():
            return False
        size = np.linalg.norm(slip[entries] / np.sqrt(memory.jitter[entries] + 1e-30))
        is_clear = size > self._settings.threshold + 1.0
        return bool(is_clear and np.linalg.norm(slip[entries]) > _JUMP)

    def _take_off(self, memory: Memory, entries: np.ndarray, slip: np.ndarray) -> None:
        """Subtract the jump of a position from now on; its slip is zero."""
        nq, nv, now = self._nq, self._nv, memory.seen
        found = np.zeros(2 * nv)
        found[entries] = slip[entries]
        memory.off += self._of_base(matrix_of(now[:4]).T, found)
        now[:nq] = moved(now[:nq], -found[:nv])
        slip[entries] = 0.0

    def _works_again(self, memory: Memory, sensor: str, slip: np.ndarray, *, same: bool) -> bool:
        """Whether a sensor that was lost measures: a position's bias ends with a jump back, that of
        a velocity as in ``_look_at_velocities``.
        """
        entries, code = self._sensors[sensor], memory.codes[self._unit(sensor)]
        if code == CODE["silent"]:
            return bool((memory.stale[entries_in_state(entries)] == 0.0).all())
        if code == CODE["frozen"]:
            return not same
        if not self._jumps(memory, entries, slip, self._lost(memory.codes)):
            return False
        return self._ends_bias(memory, entries, -slip[entries])

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

    def _slips(self, memory: Memory, blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Difference (nv) between velocities and the slopes of their positions beyond the usual
        one, and its standard deviation.
        """
        step, white = EVERY * self._step, noise_of_mean(memory.jitter)
        slope, deviation = slope_of(blocks[:, self._at["slip"]], step, white)
        velocity = 1.2 * self._velocity_noise / np.sqrt(EVERY)
        known = times_of(OLD, step)
        of_usual = np.hypot(white / np.sqrt(known @ known), velocity / np.sqrt(OLD))
        of_usual /= np.sqrt(max(memory.looks / OLD, 1.0))
        deviation = np.hypot(deviation, velocity / np.sqrt(len(blocks)))
        return slope - memory.slope, np.hypot(deviation, of_usual) + 1e-30

    def _are_velocities_off(self, memory: Memory, blocks: np.ndarray) -> bool:
        """Whether a velocity seems to differ from the slope of its position and cannot reveal
        forces.
        """
        off, deviation = self._slips(memory, blocks)
        return bool((np.abs(off) > _SLOPE + 4.0 * deviation).any())

    def _look_at_velocities(self, memory: Memory, blocks: np.ndarray) -> None:
        """Detect velocities that differ from the slope of their position."""
        nv, codes = self._nv, memory.codes
        off, deviation = self._slips(memory, blocks)
        for name, entries in self._sensors.items():
            at, code = entries - nv, codes[self._unit(name)]
            if at[0] < 0 or codes[self._unit(name.removesuffix("_velocity"))]:
                continue
            if not (self._is_prompt[entries].all() and self._is_prompt[at].all()):
                continue
            size = np.linalg.norm(off[at] / deviation[at])
            if np.linalg.norm(off[at]) <= _SLOPE or size <= self._settings.threshold + 1.0:
                continue
            if not code:
                found = np.zeros(2 * nv)
                found[entries] = off[at]
                memory.off -= self._of_base(matrix_of(memory.seen[:4]).T, found)
                self._lose(memory, name, "biased")
            elif code == CODE["biased"] and self._ends_bias(memory, entries, off[at]):
                self._read_again(memory, name, memory.raw)


def noise_of_mean(square: np.ndarray) -> np.ndarray:
    """The noise of a block's mean, from the mean square of the differences of its samples."""
    noise: np.ndarray = np.sqrt(square / (2.0 * EVERY))
    return noise
