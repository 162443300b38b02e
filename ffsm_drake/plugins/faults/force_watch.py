"""Faults of wheels, joints and thrusters, in windows of blocks of unexplained motion.

``wheel_watch``, ``joint_watch`` and ``thruster_watch`` have what decides on each.
"""

from collections.abc import Sequence

import numpy as np

from ffsm_drake.plugins.actuators.wheel_set import WHEEL_STOPS
from ffsm_drake.plugins.faults.jam import JAMMED
from ffsm_drake.plugins.faults.joint_watch import jammed, stand
from ffsm_drake.plugins.faults.known import CODE, EVERY, KEPT, LEARNT, OLD, WINDOWS, Memory
from ffsm_drake.plugins.faults.sensor_watch import SensorWatch, noise_of_mean
from ffsm_drake.plugins.faults.thruster_watch import CONFIRMED, Suspicion, confirmed, suspect
from ffsm_drake.plugins.faults.wheel_watch import stopped
from ffsm_drake.plugins.faults.windows import slope_of
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES

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
        bound = self._bounds.of_force(mass[0], memory.seen)
        is_known = not self._is_flexible or bool(memory.largest.any())
        suspicions = list[Suspicion]()
        for window in (each for each in WINDOWS if each <= valid):
            blocks = kept[-window:]
            if memory.looks >= OLD:
                self._look_at_velocities(memory, blocks)
            if self._sees_forces and not self._are_velocities_off(memory, blocks):
                acceleration = slope_of(blocks[:, self._at["velocity"]], step)[0]
                total = bound + self._bounds.of_payload(memory.seen, acceleration)
                self._look_at_joints(memory, blocks, mass, total)
                if self._thrusters is not None and is_known:
                    most = np.max([np.abs(np.linalg.inv(each)) @ total for each in mass], axis=0)
                    most += _FLEXIBLE * memory.largest
                    stands = self._stand(blocks[-CONFIRMED:])
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
        """Report stopped wheels."""
        assert self._wheels is not None
        windows = (each for each in (EVERY, *WINDOWS) if each < valid)
        blocks = memory.kept[:, -2 * len(self._wheels.names) :]
        for name in stopped(blocks, windows, self._wheels):
            self._notice(memory, f"wheels.{name}", WHEEL_STOPS.name)

    def _stand(self, blocks: np.ndarray) -> np.ndarray:
        """Mask of the joints that stand still in blocks."""
        noise = self._settings.threshold * self._position_noise / np.sqrt(EVERY)
        return stand(blocks[:, self._at["moved"]], noise)

    def _look_at_joints(
        self, memory: Memory, blocks: np.ndarray, mass: Sequence[np.ndarray], bound: np.ndarray
    ) -> None:
        """Report jammed joints."""
        stands = self._stand(blocks[len(blocks) // 2 :])
        if not stands.any():
            return
        are_jammed = jammed(
            blocks[:, self._at["left"]],
            mass,
            bound=bound,
            noise=self._noise(memory),
            threshold=self._settings.threshold,
            step=EVERY * self._step,
        )
        for index in np.flatnonzero(stands & are_jammed):
            self._notice(memory, f"joints.{self._model.coordinates.joints[index]}", JAMMED.name)

    def _look_at_thrusters(
        self,
        memory: Memory,
        blocks: np.ndarray,
        pushes: np.ndarray,
        bound: np.ndarray,
        holds: np.ndarray,
    ) -> Suspicion:
        """The best hypothesis on thrusters; ``bound``: of accelerations (nv)."""
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
        """Report the thruster that the last window names, if it is confirmed."""
        looks = memory.suspected[WINDOWS.index(window)]
        if kind := confirmed(suspicions, looks, self._settings.threshold):
            self._notice(memory, self._names[suspicions[-1].thruster], kind)
