"""Residuals of what was applied against what was seen: pure functions of arrays.

Of the thrusters: by the nominal masses and the measured velocities the momentum of the whole
spacecraft, wheels included, changes by the impulse of the thrusters alone. What is left over a
window,

    Y(t) = sum (dp - L W f),

is a multiple of w_i (F_i - f_i) L where thruster i fires though told not to, of -w_i f_i L where
it does not though told to (w_i: wrench of its unit force; f: forces as told; F: the largest). Of
each such hypothesis the best multiple and what it explains of Y,

    theta = g' P Y / g' P g,    J = (g' P Y)^2 / g' P g,

with P the inverse of Y's covariance (noise of the velocities, and external force that nobody told
of, which grows with time) after a constant is taken out. J is the square of a number of standard
deviations: the generalized likelihood ratio of one unknown size.
"""

import dataclasses

import numpy as np

from ffsm_drake.common.so3 import turning_matrix
from ffsm_drake.spacecraft.coordinates import position_error

_LEAST_LEAK, _LEAST_LOSS = 0.05, 0.2  # thetas that count
_MARGIN = 9.0  # by which J of one thruster exceeds that of all others where it is isolated
_REST = 0.05  # of a sample's largest impulse, by which the momentum may be off beside noise


@dataclasses.dataclass(frozen=True, kw_only=True)
class Suspicion:
    """The best hypothesis on thrusters."""

    explained: float  # J, relative to how much Y is usually beyond its covariance
    usual: float  # Y' P Y per number, 1 where the covariance is right
    lead: float = 0.0  # of J over that of other thrusters
    thruster: int = 0
    is_loss: bool = False  # it gives too little; else too much
    theta: float = 0.0  # share of its force


class ThrusterBank:
    """The hypotheses on a set of thrusters."""

    def __init__(
        self,
        wrenches: np.ndarray,
        force: np.ndarray,
        *,
        noise: np.ndarray,
        unmodelled: np.ndarray,
        sample_time: float,
        count: int,
    ) -> None:
        """Args: W (6, n); F (n), N; standard deviation of the momentum (6), N m s and N s; of the
        external force (6), N m and N; s; control samples of the longest window.
        """
        self._wrenches, self._force, self._step = np.tile(wrenches, 2), force, sample_time
        rest = _REST * sample_time * np.abs(wrenches * force).max(axis=1)
        deviation = np.hypot(noise, rest)
        self._weights = {
            length: np.stack([_weight(s, f, sample_time, length) for s, f in zip(deviation, unmodelled, strict=True)])
            for length in sorted({max(4, count // 4), max(4, count // 2), count})
        }  # fmt: skip

    def suspect(
        self, residuals: np.ndarray, told: np.ndarray, works: np.ndarray, usual: float
    ) -> Suspicion | None:
        """The hypothesis that explains most; None where too few samples are known.

        Args: dp - L W f (m, 6) of the last samples, told forces (m, n), which thrusters are in use
        (n), how much Y usually is beyond its covariance.
        """
        best = None
        for length, weights in self._weights.items():
            if len(residuals) < length:
                break
            found = self._suspect(residuals[-length:], told[-length:], weights, works, usual)
            if best is None or found.explained > best.explained:
                best = found
        return best

    def _suspect(
        self,
        residuals: np.ndarray,
        told: np.ndarray,
        weights: np.ndarray,
        works: np.ndarray,
        usual: float,
    ) -> Suspicion:
        total = np.cumsum(residuals, axis=0)
        scaled = np.einsum("amk,ka->ma", weights, total)
        fired = self._step * np.cumsum(told, axis=0)
        most = self._step * np.arange(1, len(told) + 1)[:, None] * self._force
        shapes = np.hstack([most - fired, -fired])
        along = (shapes * (scaled @ self._wrenches)).sum(axis=0)
        size = np.einsum("mi,ami,ai->i", shapes, weights @ shapes, self._wrenches**2)
        is_known = np.tile(works, 2) & (size > 1.0)  # a share of 1 is a standard deviation or more
        theta = np.where(is_known, along / np.where(is_known, size, 1.0), 0.0)
        count = self._force.size
        least = np.repeat([_LEAST_LEAK, _LEAST_LOSS], count)
        explained = np.where(theta >= least, theta * along, 0.0) / max(1.0, usual)
        best = int(explained.argmax())
        others = np.tile(np.arange(count), 2) != best % count
        return Suspicion(
            explained=float(explained[best]),
            usual=float((scaled * total).sum() / total.size),
            lead=float(explained[best] - explained[others].max(initial=0.0)),
            thruster=best % count,
            is_loss=best >= count,
            theta=float(theta[best]),
        )

    @staticmethod
    def is_alarm(found: Suspicion, threshold: float) -> bool:
        """Whether a suspicion passes some standard deviations."""
        return found.explained > threshold**2

    @staticmethod
    def is_clear(found: Suspicion) -> bool:
        """Whether it is one thruster and no other."""
        return found.lead > _MARGIN


def _weight(noise: float, force: float, step: float, length: int) -> np.ndarray:
    """P (length, length) of one axis."""
    time = step * np.arange(1, length + 1)
    inverse = np.linalg.inv(noise**2 * np.eye(length) + force**2 * np.outer(time, time))
    ones = inverse.sum(axis=1)
    taken: np.ndarray = inverse - np.outer(ones, ones) / ones.sum()
    return taken


def moved(q: np.ndarray, by: np.ndarray) -> np.ndarray:
    """A configuration (nq) after a rotation vector and differences (nv)."""
    result = np.concatenate([q[:4], q[4:] + by[3:]])
    result[:4] = turning_matrix(by[:3]) @ q[:4]
    return result


class Observer:
    """Positions, velocities and unmodelled accelerations from measured positions and expected
    accelerations: three equal poles for each coordinate.
    """

    def __init__(self, bandwidth: np.ndarray, sample_time: float) -> None:
        """Args: of each coordinate (nv), rad/s; s."""
        self._step, w = sample_time, bandwidth
        self._gains = 3.0 * w * sample_time, 3.0 * w**2 * sample_time, w**3 * sample_time

    def step(
        self,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        *,
        measured: np.ndarray,
        expected: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(q, v, a) a sample later, with a measured configuration (nq) and an expected change of
        velocity (nv).
        """
        change = expected + self._step * a
        ahead = moved(q, self._step * (v + 0.5 * change))
        seen = position_error(measured, ahead)
        of_q, of_v, of_a = (gain * seen for gain in self._gains)
        return moved(ahead, of_q), v + change + of_v, a + of_a
