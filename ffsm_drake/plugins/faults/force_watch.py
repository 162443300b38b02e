"""Faults of wheels, joints and thrusters, in windows of blocks of unexplained motion."""

from collections.abc import Sequence

import numpy as np

from ffsm_drake.plugins.faults.known import CODE, EVERY, KEPT, LEARNT, OLD, WINDOWS, Memory
from ffsm_drake.plugins.faults.residuals import Suspicion, between, slope_of, suspect, times_of
from ffsm_drake.plugins.faults.sensor_watch import SensorWatch, noise_of_mean
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES

# consecutive evaluations that name the same thruster; share of the threshold required in them:
# residuals that are not white stay within bounds
_CONFIRMED, _ASKED = 4, 0.6
_SPEED, _SHARE = 0.2, 0.3  # rad/s and share of the commanded impulse: tolerance of a wheel
_STILL, _LEAST = 2e-5, 0.05  # for a jam: rad or m; N m or N beyond all bounds
_PULSE = 0.1  # share of the largest impulse of a frame that is noise
_FLEXIBLE = 4.0  # times the largest acceleration so far that flexible parts may give


class ForceWatch(SensorWatch):
    """A lost thruster or wheel leaves the allocation. A jammed joint, or the loss of a unit
    essential to the allocation, raises ``abort_request``.
    """

    def _collect(
        self, memory: Memory, before: np.ndarray, expected: np.ndarray, pushes: np.ndarray
    ) -> bool:
        """Sums of what is unexplained, in blocks; whether one ends."""
        nq, now = self._nq, memory.seen
        left = now[nq:] - before[nq:] - expected  # (models, nv)
        count = memory.samples = memory.samples + 1.0
        bound = self._settings.threshold * np.sqrt(memory.rough)
        bound += self._step * np.abs(pushes) @ self._force
        known = np.clip(left[0], -bound, bound) if count > LEARNT else left[0]
        # a jump of a sensor is no force; a lasting change is one
        jumps = float((known != left[0]).any())
        if jumps and not memory.jumped and memory.blocks >= WINDOWS[0]:
            self._forget(memory)
            left = left - left[0] + known
        memory.jumped = jumps
        memory.rough += (known**2 - memory.rough) / min(count, 4.0 * LEARNT)
        memory.sums[self._at["left"]] += left.ravel()
        memory.sums[self._at["velocity"]] = now[nq:]
        memory.part += memory.sums / EVERY
        is_whole = bool(count % EVERY == 0.0)
        if is_whole:
            memory.kept = np.vstack([memory.kept[1:], memory.part])
            memory.part = np.zeros_like(memory.part)
            memory.blocks += 1.0
        return is_whole

    def _look_at_blocks(self, memory: Memory, pushes: np.ndarray) -> None:
        """Wheels, joints, velocities, thrusters, in windows of blocks."""
        valid, step, nv, kept = int(memory.blocks), EVERY * self._step, self._nv, memory.kept
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
        if self._is_flexible and valid >= KEPT:
            old = np.abs(slope_of(kept[:OLD, :nv], step)[0])
            memory.largest = np.maximum(memory.largest, old)
        mass = [model.calc_mass_matrix(memory.seen[: self._nq]) for model in self._models]
        bound = self._bound(mass[0], memory.seen)
        is_known = not self._is_flexible or bool(memory.largest.any())
        suspicions = list[Suspicion]()
        for window in (each for each in WINDOWS if each <= valid):
            blocks = kept[-window:]
            if memory.looks >= OLD:
                self._look_at_velocities(memory, blocks)
            if self._sees_forces and not self._are_velocities_off(memory, blocks):
                acceleration = slope_of(blocks[:, self._at["velocity"]], step)[0]
                total = bound + self._bound_payload(memory.seen, acceleration)
                self._look_at_joints(memory, blocks, mass, total)
                if self._thrusters is not None and is_known:
                    most = np.max([np.abs(np.linalg.inv(each)) @ total for each in mass], axis=0)
                    most += _FLEXIBLE * memory.largest
                    stands = self._stand(memory, blocks[-_CONFIRMED:])
                    holds = np.linalg.inv(mass[0])[:, NUM_BASE_VELOCITIES:][:, stands]
                    suspicions.append(self._look_at_thrusters(memory, blocks, pushes, most, holds))
                    self._confirm(memory, suspicions, window)

    def _noise(self, memory: Memory) -> np.ndarray:
        """Standard deviation (nv) of a block's mean of the velocities' noise."""
        assumed = self._velocity_noise / np.sqrt(EVERY)
        noise: np.ndarray = np.maximum(noise_of_mean(memory.rough), assumed)
        return noise

    def _notice(self, memory: Memory, unit: str, kind: str) -> None:
        index = self._names.index(unit)
        if memory.codes[index]:
            return
        memory.codes[index] = CODE[kind]
        self._forget(memory)
        is_without = self._base is not None and not unit.startswith("joints.")
        if is_without and self._base is not None:
            is_without = self._base.without(self._isolated(memory.codes))[2]
        if not is_without:
            memory.abort_request = 1.0

    def _look_at_wheels(self, memory: Memory, valid: int) -> None:
        """Detect a momentum that does not follow the commanded torque."""
        assert self._wheels is not None
        count = len(self._wheels.names)
        for window in (each for each in (EVERY, *WINDOWS) if each < valid):
            change = np.abs(memory.kept[-1] - memory.kept[-1 - window])
            told, beyond = change[-2 * count :].reshape(2, count)
            for index in np.flatnonzero(beyond > _SHARE * told + _SPEED * self._wheels.inertia):
                self._notice(memory, f"wheels.{self._wheels.names[index]}", "stops")

    def _stand(self, memory: Memory, blocks: np.ndarray) -> np.ndarray:
        """Mask of the joints that stand still."""
        moved = blocks[:, self._at["moved"]]
        most = _STILL + self._settings.threshold * self._position_noise / np.sqrt(EVERY)
        still: np.ndarray = (np.ptp(moved, axis=0) < most)[NUM_BASE_VELOCITIES:]
        return still

    def _look_at_joints(
        self, memory: Memory, blocks: np.ndarray, mass: Sequence[np.ndarray], bound: np.ndarray
    ) -> None:
        """Detect joints at rest under a force beyond all bounds, for any payload mass.

        The mean over a window of a force within +-D, by any weights, is within +-D at any
        frequency.
        """
        nv, step, base = self._nv, EVERY * self._step, NUM_BASE_VELOCITIES
        stands = self._stand(memory, blocks[len(blocks) // 2 :])
        if not stands.any():
            return
        time = times_of(len(blocks), step)
        slopes = (time @ blocks[:, self._at["left"]] / (time @ time)).reshape(-1, nv)
        forces = np.array([each @ slope for each, slope in zip(mass, slopes, strict=True)])
        noise = np.sqrt(mass[0] ** 2 @ self._noise(memory) ** 2 / (time @ time))
        low, high = between(forces)
        beyond = np.maximum(low, -high) - bound - self._settings.threshold * noise
        for index in np.flatnonzero(stands & (beyond[base:] > _LEAST)):
            self._notice(memory, f"joints.{self._model.coordinates.joints[index]}", "jammed")

    def _look_at_thrusters(
        self,
        memory: Memory,
        blocks: np.ndarray,
        pushes: np.ndarray,
        bound: np.ndarray,
        holds: np.ndarray,
    ) -> Suspicion:
        """The best hypothesis of ``residuals``; ``bound``: of accelerations (nv)."""
        assert self._thrusters is not None
        count, (left, told) = len(self._force), (blocks[:, self._at[e]] for e in ("left", "told"))
        pulse = _PULSE * self._thrusters.frame * np.abs(pushes * self._force).max(axis=1)
        return suspect(
            left.reshape(len(blocks), -1, self._nv),
            told[:, :count],
            pushes=pushes,
            force=self._force,
            bound=bound,
            noise=np.hypot(self._noise(memory), pulse),
            in_use=memory.codes[:count] == 0.0,
            step=EVERY * self._step,
            band=self._settings.band,
            holds=holds,
        )

    def _confirm(self, memory: Memory, suspicions: Sequence[Suspicion], window: int) -> None:
        """Report the thruster of the last window after enough consecutive evaluations have named
        it, with the kind of the best explanation in the window: before and after a fault's start
        two kinds differ by a constant force.
        """
        found = suspicions[-1]
        looks = memory.suspected[WINDOWS.index(window)]
        before, looks[:] = looks[found.thruster], 0.0
        if found.explained > (_ASKED * self._settings.threshold) ** 2 and found.is_isolated:
            looks[found.thruster] = before + 1.0
            if looks[found.thruster] >= _CONFIRMED:
                same = [each for each in suspicions if each.thruster == found.thruster]
                kind = max(same, key=lambda each: each.explained).kind
                self._notice(memory, self._names[found.thruster], kind)
