"""What replaces the measurements of faulty sensors."""

import numpy as np

from ffsm_drake.common.so3 import matrix_of, turning_matrix
from ffsm_drake.plugins.faults.known import CODE, Known
from ffsm_drake.plugins.faults.memory import Memory
from ffsm_drake.plugins.faults.sensors import entries_in_state
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, position_error


class Correction(Known):
    """A lost position is extrapolated with its velocity, a lost velocity comes from an observer of
    position and reported force, a bias is subtracted (base sensors: in the base's axes). A single
    velocity that is not new is predicted with the reported force.
    """

    @staticmethod
    def _of_base(R: np.ndarray, off: np.ndarray) -> np.ndarray:
        """Errors of positions and velocities (2 nv) with the base's vectors turned by R."""
        turned = off.copy().reshape(2, -1)
        base = turned[:, :NUM_BASE_VELOCITIES].reshape(2, 2, 3)
        turned[:, :NUM_BASE_VELOCITIES] = (base @ R.T).reshape(2, -1)
        return turned.ravel()

    def _correct(self, memory: Memory, rows: np.ndarray, *, is_first: bool) -> None:
        """Write the measured state, without lost sensors and biases, into ``seen`` of the memory.

        Args: also the row of the sample, after that of the sample before if it is not the first.
        """
        nq, nv, raw = self._nq, self._nv, rows[-1, self._in["state"]]
        old = self._old(rows[-1, self._in["new"]])
        if not (np.count_nonzero(old) or np.count_nonzero(memory.codes[self._of_sensors])):
            memory.seen[:] = raw
            return
        seen, expected = memory.seen, np.zeros(nv)
        if not is_first:
            held = rows.copy()  # what is measured now may be wrong
            held[-1, self._in["state"]] = rows[0, self._in["state"]]
            expected = self._changes(held, memory.samples)[1][0]
        off = self._of_base(matrix_of(seen[:4]), memory.off)
        q, v = moved(raw[:nq], -off[:nv]), raw[nq:] - off[nv:]
        lost = self._lost(memory.codes)
        v = np.where(old[nv:], seen[nq:] + expected, v)
        if lost[nv:].any():
            before, speed = np.split(memory.observed, [nq])
            change = expected + self._step * memory.acceleration
            ahead = moved(before, self._step * (speed + 0.5 * change))
            of_q, of_v, of_a = self._gains * position_error(q, ahead)
            speed = speed + change + of_v
            memory.observed[:] = np.concatenate([moved(ahead, of_q), speed])
            memory.acceleration += of_a
            v = np.where(lost[nv:], speed, v)
        lost = lost | old
        if lost[:nv].any() and not is_first:
            carried = moved(seen[:nq], 0.5 * self._step * (seen[nq:] + v))
            q = np.where(np.concatenate([lost[:1], lost[:nv]]), carried, q)
        memory.seen[:] = np.concatenate([q, v])

    def _old(self, new: np.ndarray) -> np.ndarray:
        """Mask of the measurements (2 nv) that a sensor without delay or period did not renew."""
        if not new.size:
            return np.zeros(2 * self._nv, dtype=bool)
        return self._is_prompt & (new[1:] == 0.0)

    def _lost(self, codes: np.ndarray) -> np.ndarray:
        """Mask of the measurements (2 nv) that are replaced."""
        lost = np.zeros(2 * self._nv, dtype=bool)
        for index in np.flatnonzero(codes[self._of_sensors]).tolist():
            entries = self._sensor_entries[index]
            if codes[self._of_sensors[index]] in (CODE["frozen"], CODE["silent"]):
                lost[entries] = self._is_prompt[entries]
        return lost

    def _renewed(self, new: np.ndarray, codes: np.ndarray) -> np.ndarray:
        """A value in a lost sensor's place is new."""
        new = new.copy()
        for name, entries in self._sensors.items():
            if codes[self._unit(name)] and self._is_prompt[entries].all():
                new[entries_in_state(entries)] = 1.0
        return new


def moved(q: np.ndarray, by: np.ndarray) -> np.ndarray:
    """A configuration (nq) after a rotation vector and differences (nv)."""
    after = np.concatenate([q[:4], q[4:] + by[3:]])
    after[:4] = turning_matrix(by[:3]) @ q[:4]
    return after
