"""Faults of sensors: silent, frozen, biased; and what replaces them."""

import numpy as np

from ffsm_drake.common.so3 import matrix_of, turning_matrix
from ffsm_drake.plugins.faults.known import CODE, EVERY, LEARNT, OLD, Known, Memory
from ffsm_drake.plugins.faults.sensors import entries_in_state
from ffsm_drake.plugins.faults.windows import slope_of, times_of
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, position_error

_REPEATED = 5  # samples with the same bits
_ALIKE = 0.3  # largest difference of a change that ends a bias, as a share of it
_JUMP, _SLOPE = 1e-3, 1e-3  # m or rad, m/s or rad/s; smaller sensor errors are ignored


class SensorWatch(Known):
    """A lost position is extrapolated with its velocity, a lost velocity comes from an observer of
    position and reported force, a bias is subtracted (base sensors: in the base's axes). A sensor
    that works again is read again.
    """

    @staticmethod
    def _of_base(R: np.ndarray, off: np.ndarray) -> np.ndarray:
        """Errors of positions and velocities (2 nv) with the base's vectors turned by R."""
        turned = off.copy().reshape(2, -1)
        base = turned[:, :NUM_BASE_VELOCITIES].reshape(2, 2, 3)
        turned[:, :NUM_BASE_VELOCITIES] = (base @ R.T).reshape(2, -1)
        return turned.ravel()

    def _correct(
        self,
        memory: Memory,
        raw: np.ndarray,
        seen: np.ndarray,
        expected: np.ndarray,
        new: np.ndarray | None,
        *,
        is_first: bool,
    ) -> None:
        """Write the measured state, without lost sensors and biases, into ``seen`` of the memory;
        ``seen`` is the one before.
        """
        nq, nv = self._nq, self._nv
        off = self._of_base(matrix_of(seen[:4]), memory.off)
        q, v = _moved(raw[:nq], -off[:nv]), raw[nq:] - off[nv:]
        lost, old = self._lost(memory.codes), self._old(new)
        v = np.where(old[nv:], seen[nq:] + expected, v)
        if lost[nv:].any():
            before, speed = np.split(memory.observed, [nq])
            change = expected + self._step * memory.acceleration
            ahead = _moved(before, self._step * (speed + 0.5 * change))
            of_q, of_v, of_a = self._gains * position_error(q, ahead)
            speed = speed + change + of_v
            memory.observed = np.concatenate([_moved(ahead, of_q), speed])
            memory.acceleration += of_a
            v = np.where(lost[nv:], speed, v)
        lost = lost | old
        if lost[:nv].any() and not is_first:
            carried = _moved(seen[:nq], 0.5 * self._step * (seen[nq:] + v))
            q = np.where(np.concatenate([lost[:1], lost[:nv]]), carried, q)
        memory.seen[:] = np.concatenate([q, v])

    def _old(self, new: np.ndarray | None) -> np.ndarray:
        """Mask of the measurements (2 nv) that a sensor without delay or period did not renew."""
        if new is None:
            return np.zeros(2 * self._nv, dtype=bool)
        return self._is_prompt & (new[1:] == 0.0)

    def _lost(self, codes: np.ndarray) -> np.ndarray:
        """Mask of the measurements (2 nv) that are replaced."""
        lost = np.zeros(2 * self._nv, dtype=bool)
        for name, entries in self._sensors.items():
            if codes[self._unit(name)] in (CODE["frozen"], CODE["silent"]):
                lost[entries] = self._is_prompt[entries]
        return lost

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
        moved = position_error(now[:nq], before[:nq])
        slip = moved - 0.5 * self._step * (now[nq:] + before[nq:])
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
        memory.sums[self._at["moved"]] += moved

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
        now[:nq] = _moved(now[:nq], -found[:nv])
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
            now[:nq] = _moved(now[:nq], -missed)
        elif kind != "biased":
            memory.observed[:] = now
            memory.acceleration[:] = 0.0
        lost = self._lost(memory.codes)
        if (lost[:nv] & lost[nv:]).any() or not self._is_prompt[entries].all():
            memory.abort_request = 1.0
        self._forget(memory)

    def _renewed(self, new: np.ndarray, codes: np.ndarray) -> np.ndarray:
        """A value in a lost sensor's place is new."""
        new = new.copy()
        for name, entries in self._sensors.items():
            if codes[self._unit(name)] and self._is_prompt[entries].all():
                new[entries_in_state(entries)] = 1.0
        return new

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


def _moved(q: np.ndarray, by: np.ndarray) -> np.ndarray:
    """A configuration (nq) after a rotation vector and differences (nv)."""
    moved = np.concatenate([q[:4], q[4:] + by[3:]])
    moved[:4] = turning_matrix(by[:3]) @ q[:4]
    return moved
