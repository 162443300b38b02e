"""A free rigid target: its motion, exact but for the integration, and how errors of it grow. The
approach, the filter of a measured target and the closing gripper all move it by ``Target.after``.

The target's frame is P, C its centre of mass. Its numbers are the attitude R_WP; the rate w = w_WP
and the arm p_PC in P's axes; p_WC and v_WC in the world's; and the shape s (5) of the inertia.
Without torque only ratios act: G = 1 + sum_k s_k B_k, with B_k a basis of the traceless symmetric
matrices, stands for the inverse inertia over a third of its trace. Then

    R' = R [w]x,   w' = G (G^-1 w x w),   p_WC'' = 0,

with the tide and the gravity gradient of a circular orbit, and a gripper's force, added. The
error is (rotation d in P's axes, R = R_est exp([d]x); rate; p_WP; velocity; arm; shape), 20
numbers. These are nearly linear in measured poses, while errors of the momentum and of p_WC are
nonlinear in those of shape and arm. Arrays may have any leading dimensions.
"""

import dataclasses
import math

import numpy as np

from ffsm_drake.common.products import times
from ffsm_drake.common.so3 import composed, cross_of, matrix_of, quaternion_of, skew, turn_between
from ffsm_drake.scenario import MassProperties, inertia_matrix
from ffsm_drake.spacecraft.orbit import Orbit

SIZE = 20  # size of the error
ROTATION, RATE, POSITION, VELOCITY, ARM = (slice(3 * i, 3 * i + 3) for i in range(5))
SHAPE = slice(15, SIZE)
_SIZES = np.cumsum([4, 3, 3, 3, 3])  # ends of the entries of ``Target.as_row``
_STEP, _TURN = 0.25, 0.1  # s and rad; of the integration, at most
FINE_TURN = 0.02  # rad; likewise, for a run's own target: off by some 1e-9 in 10 turns
_THINNEST = 0.02  # least eigenvalue of G
_FASTEST = 5.0  # rad/s; fastest estimate; its integration takes a step of 0.02 s
_SMALL = 0.01  # share of a deviation, step of second derivatives
_DIAGONAL, _OFF = np.array([[1.0, -1.0, 0.0], [1.0, 1.0, -2.0]]), ((0, 1), (0, 2), (1, 2))


def _basis() -> np.ndarray:
    """Basis of traceless symmetric matrices (5, 3, 3), orthogonal and of equal norm."""
    found = np.zeros((5, 3, 3))
    found[:2] = [np.diag(row) * math.sqrt(2.0) / np.linalg.norm(row) for row in _DIAGONAL]
    for matrix, (i, j) in zip(found[2:], _OFF, strict=True):
        matrix[i, j] = matrix[j, i] = 1.0
    return found


BASIS = _basis()


def shape_of(properties: MassProperties) -> np.ndarray:
    """Shape (5) of mass properties."""
    inverse = np.linalg.inv(inertia_matrix(properties))
    return 0.5 * np.einsum("kij,ij->k", BASIS, 3.0 * inverse / np.trace(inverse))


def inverse_inertia(shape: np.ndarray) -> np.ndarray:
    """G (..., 3, 3) of shapes (..., 5)."""
    return np.eye(3) + np.tensordot(shape, BASIS, axes=1)


def shape_spread(shape: np.ndarray) -> np.ndarray:
    """Matrix (5, 6) from independent relative changes of the inertia to a shape (5)."""
    G = inverse_inertia(shape)
    values, axes = np.linalg.eigh(G)
    root = (axes * np.sqrt(values)) @ axes.T
    changes = root @ np.concatenate([BASIS, math.sqrt(2.0 / 3.0) * np.eye(3)[None]]) @ root
    changes -= np.trace(changes, axis1=1, axis2=2)[:, None, None] * G / 3.0
    return 0.5 * np.einsum("kij,lij->kl", BASIS, changes)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Target:
    """A free rigid body; see the module docstring."""

    quaternion: np.ndarray  # (..., 4) of R_WP
    rate: np.ndarray  # (..., 3) w_WP in P's axes, rad/s
    center: np.ndarray  # (..., 3) p_WC, m
    velocity: np.ndarray  # (..., 3) v_WC, m/s
    arm: np.ndarray  # (..., 3) p_PC in P's axes, m
    shape: np.ndarray  # (..., 5)

    def as_row(self) -> np.ndarray:
        """All numbers (..., 21)."""
        return np.concatenate(list(vars(self).values()), axis=-1)

    @classmethod
    def from_row(cls, row: np.ndarray) -> "Target":
        """Build from a row of ``as_row``."""
        names = (field.name for field in dataclasses.fields(cls))
        return cls(**dict(zip(names, np.split(row, _SIZES, axis=-1), strict=True)))

    @classmethod
    def from_motion(cls, motion: np.ndarray, properties: MassProperties) -> "Target":
        """Build from [quaternion, p_WP; w_WP, v_WP] (13), world axes."""
        R = matrix_of(motion[:4])
        w, arm = motion[7:10], np.array(properties.center_of_mass)
        return cls(
            quaternion=motion[:4] / np.linalg.norm(motion[:4]),
            rate=R.T @ w,
            center=motion[4:7] + R @ arm,
            velocity=motion[10:] + np.cross(w, R @ arm),
            arm=arm,
            shape=shape_of(properties),
        )

    @property
    def motion(self) -> np.ndarray:
        """[quaternion, p_WP; w_WP, v_WP] (..., 13), world axes."""
        R = matrix_of(self.quaternion)
        w, arm = times(R, self.rate), times(R, self.arm)
        return np.concatenate(
            [self.quaternion, self.position, w, self.velocity - np.cross(w, arm)], axis=-1
        )

    @property
    def position(self) -> np.ndarray:
        """p_WP (..., 3), m."""
        return self.center - times(matrix_of(self.quaternion), self.arm)

    def error(self, truth: "Target") -> np.ndarray:
        """Error of the true target from this one (..., 20)."""
        names = ("rate", "position", "velocity", "arm", "shape")
        others = (getattr(truth, name) - getattr(self, name) for name in names)
        return np.concatenate([turn_between(self.quaternion, truth.quaternion), *others], axis=-1)

    def corrected(self, error: np.ndarray) -> "Target":
        """The target that an error (..., 20) leads to."""
        turned = composed(self.quaternion, quaternion_of(error[..., ROTATION]))
        quaternion = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
        arm = self.arm + error[..., ARM]
        return Target(
            quaternion=quaternion,
            rate=_within(self.rate + error[..., RATE], _FASTEST),
            center=self.position + error[..., POSITION] + times(matrix_of(quaternion), arm),
            velocity=self.velocity + error[..., VELOCITY],
            arm=arm,
            shape=_possible(self.shape + error[..., SHAPE]),
        )

    def after(
        self,
        step: float,
        time: float | np.ndarray = 0.0,
        orbit: Orbit | None = None,
        pushed: np.ndarray | None = None,
    ) -> "Target":
        """After a step (s) from a time (..., s) on, by ``runge_kutta4``.

        Args: ``pushed`` (..., 6): torque about C times a third of the trace of the inverse inertia,
        rad/s^2, and force over mass, m/s^2; held, in world axes.
        """
        G = inverse_inertia(self.shape)
        J = np.linalg.inv(G)
        row = np.concatenate([self.quaternion, self.rate, self.center, self.velocity], axis=-1)

        def slope(row: np.ndarray, time: float | np.ndarray) -> np.ndarray:
            u, w, velocity = row[..., 1:4], row[..., 4:7], row[..., 10:]
            vector = row[..., :1] * w + cross_of(u, w)  # 2 q'
            scalar = -(u * w).sum(axis=-1, keepdims=True)
            torque, pull = cross_of(times(J, w), w), np.zeros_like(w)
            if orbit is not None or pushed is not None:
                R = matrix_of(row[..., :4])
            if orbit is not None:
                torque += orbit.gradient(R, J, time)
                pull = orbit.tide(row[..., 7:10], time)
            if pushed is not None:
                torque += times(np.swapaxes(R, -1, -2), pushed[..., :3])
                pull = pull + pushed[..., 3:]
            both = 0.5 * scalar, 0.5 * vector
            return np.concatenate([*both, times(G, torque), velocity, pull], axis=-1)

        a = slope(row, time)
        b = slope(row + 0.5 * step * a, time + 0.5 * step)
        c = slope(row + 0.5 * step * b, time + 0.5 * step)
        d = slope(row + step * c, time + step)
        row = row + step / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        quaternion, rate, center, velocity = np.split(row, _SIZES[:3], axis=-1)
        quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
        return dataclasses.replace(
            self, quaternion=quaternion, rate=rate, center=center, velocity=velocity
        )

    def bend(self, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Second-order effect of the errors of rate and shape, with a covariance (..., 20, 20), on
        the rate's derivative: mean (..., 3; rad/s^2) and covariance (..., 3, 3).

        Both are bounded: the moments of inertia satisfy the triangle inequality, so the derivative
        of the rate is at most the rate squared.
        """
        within = np.r_[RATE, SHAPE]
        values, axes = np.linalg.eigh(covariance[..., within[:, None], within])
        root = axes * np.sqrt(np.maximum(values, 0.0))[..., None, :]
        moves = _SMALL * np.swapaxes(root, -1, -2)  # independent errors, one a row
        i, j = np.triu_indices(within.size, 1)
        both = moves[..., i, :] + moves[..., j, :]
        still = self._turned(np.zeros_like(moves[..., :1, :]))
        own, sums = (
            (0.5 * (self._turned(x) + self._turned(-x)) - still) / _SMALL**2 for x in (moves, both)
        )
        mixed = 0.5 * (sums - own[..., i, :] - own[..., j, :])
        spread = 2.0 * np.einsum("...ki,...kj->...ij", own, own)
        spread += 4.0 * np.einsum("...ki,...kj->...ij", mixed, mixed)
        mean = own.sum(axis=-2)
        variances = np.diagonal(covariance, axis1=-2, axis2=-1)[..., RATE]
        most = (self.rate**2 + variances).sum(axis=-1)[..., None]
        size = np.sqrt(
            np.trace(spread, axis1=-2, axis2=-1)[..., None] + (mean**2).sum(-1)[..., None]
        )
        share = np.minimum(1.0, most / np.maximum(size, 1e-300))
        return share * mean, share[..., None] ** 2 * spread

    def _turned(self, moves: np.ndarray) -> np.ndarray:
        """The rate's slopes (..., n, 3) without torque, rate and shape changed by (..., n, 8)."""
        w = self.rate[..., None, :] + moves[..., :3]
        G = inverse_inertia(self.shape[..., None, :] + moves[..., 3:])
        return times(G, np.cross(times(np.linalg.inv(G), w), w))

    def transition(self, step: float) -> np.ndarray:
        """Matrix (..., 20, 20) from the errors half a step before this to half a step after; the
        orbit's forces are left out.
        """
        G, w = inverse_inertia(self.shape), self.rate
        J = np.linalg.inv(G)
        momentum = times(J, w)
        cross = skew(w)
        F = np.zeros((*w.shape[:-1], SIZE, SIZE))
        F[..., ROTATION, ROTATION], F[..., ROTATION, RATE] = -cross, np.eye(3)
        F[..., RATE, RATE] = G @ (skew(momentum) - cross @ J)
        # derivatives of G by the shape, and of J: -J B J
        by_torque, by_momentum = (
            np.swapaxes(np.tensordot(x, BASIS, axes=([-1], [2])), -1, -2)
            for x in (np.cross(momentum, w), momentum)
        )
        F[..., RATE, SHAPE] = by_torque + G @ cross @ J @ by_momentum
        R = matrix_of(self.quaternion)
        F[..., POSITION, ROTATION] = R @ skew(np.cross(w, self.arm))
        F[..., POSITION, RATE], F[..., POSITION, ARM] = R @ skew(self.arm), -R @ cross
        F[..., POSITION, VELOCITY] = np.eye(3)
        F *= step
        twice = F @ F
        found: np.ndarray = np.eye(SIZE) + F + 0.5 * twice + twice @ F / 6.0
        return found


def _within(vector: np.ndarray, most: float) -> np.ndarray:
    """Vectors (..., 3) shortened to a length."""
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector * np.minimum(1.0, most / np.maximum(length, most))


def _possible(shape: np.ndarray) -> np.ndarray:
    """A shape whose G has no eigenvalue below the least."""
    least = np.linalg.eigvalsh(inverse_inertia(shape))[..., :1]
    share = (1.0 - _THINNEST) / (1.0 - np.minimum(least, _THINNEST))
    return shape * np.minimum(share, 1.0)


def steps_between(
    target: Target, first: float, last: float, *, turn: float = _TURN
) -> list[tuple[float, float]]:
    """Begin and length of the steps of an integration, s, in which it turns by ``turn`` (rad) at
    most.
    """
    most = _longest_step(target, turn)
    count = max(1, math.ceil(abs(last - first) / most - 1e-9)) if last != first else 0
    step = (last - first) / max(count, 1)
    return [(first + i * step, step) for i in range(count)]


def path_of(
    target: Target,
    time: float,
    *,
    period: float,
    samples: int,
    orbit: Orbit | None = None,
    turn: float = _TURN,
) -> np.ndarray:
    """The motion (samples, 13) of one target at a time (s) and every ``period`` (s) after it, or
    before it where that is negative; as ``steps_between``.
    """
    each = max(1, math.floor(_longest_step(target, turn) / abs(period) + 1e-9))  # samples a step
    rows, times_of = [target.as_row()], [time]
    while len(rows) * each < samples:
        last = time + len(times_of) * each * period
        for begin, step in steps_between(target, times_of[-1], last, turn=turn):
            target = target.after(step, begin, orbit)
        rows.append(target.as_row())
        times_of.append(last)
    begun = Target.from_row(np.stack(rows))
    between = [begun.motion]
    between += [begun.after(i * period, np.array(times_of), orbit).motion for i in range(1, each)]
    found: np.ndarray = np.stack(between, axis=1).reshape(-1, 13)
    return found[:samples]


def _longest_step(target: Target, turn: float) -> float:
    """Longest step of an integration, s."""
    fastest = float(np.linalg.norm(target.rate, axis=-1).max())
    return min(_STEP, turn / max(fastest, 1e-9))
