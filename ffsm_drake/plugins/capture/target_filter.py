"""A multiplicative extended Kalman filter of a free target (``spacecraft.free_body``), from
measured poses of its frame P: R and p_WP = p_WC - R p_PC.

Arrays may have any leading dimensions: filters side by side, which take poses at the same times.

Markley 2003, "Attitude error representations for Kalman filtering"; Aghili and Parsa 2009, "Motion
and parameter estimation of space objects using laser-vision data".
"""

import dataclasses

import numpy as np

from ffsm_drake.common.products import times
from ffsm_drake.common.so3 import composed, matrix_of, quaternion_of, turn_between
from ffsm_drake.plugins.capture.free_body import (
    ARM,
    POSITION,
    RATE,
    ROTATION,
    SHAPE,
    SIZE,
    VELOCITY,
    Target,
    path_of,
    shape_spread,
    steps_between,
)
from ffsm_drake.scenario import TargetSensor, TargetTracker
from ffsm_drake.spacecraft.orbit import Orbit

_POSE = np.r_[ROTATION, POSITION]
_OF_POSE = np.eye(SIZE)[_POSE]
_SLOWEST = 0.02  # rad/s
_LASTS = 0.85  # rad
_LEAST = 1e-13
_TRUSTED = 5  # poses in a row, the memory of how many fitted


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pose:
    """A measured pose of P, with its noise, in the world."""

    quaternion: np.ndarray  # (..., 4)
    position: np.ndarray  # (..., 3), m
    covariance: np.ndarray  # (..., 6, 6) of the rotation in P's axes, then the position; rad, m


def noise_of(sensor: TargetSensor, sight: np.ndarray) -> np.ndarray:
    """Covariance (..., 6, 6) of a pose at ``sight`` (..., 3; m) from the sensor."""
    r = np.linalg.norm(sight, axis=-1)[..., None, None]
    along = sight[..., :, None] * sight[..., None, :]
    found = np.zeros((*sight.shape[:-1], 6, 6))
    rotation = sensor.rotation_noise + sensor.rotation_growth * r
    found[..., :3, :3] = rotation**2 * np.eye(3)
    # along is r^2 times the projection on the line of sight
    found[..., 3:, 3:] = (sensor.position_noise**2 + (sensor.angle_noise * r) ** 2) * np.eye(3) + (
        sensor.range_noise**2 - sensor.angle_noise**2
    ) * along
    return found


def sound(covariance: np.ndarray) -> np.ndarray:
    """Covariances (..., n, n) made symmetric, and positive definite where rounding made them
    otherwise: no correlation has an eigenvalue below ``_LEAST``.
    """
    symmetric: np.ndarray = 0.5 * (covariance + np.swapaxes(covariance, -1, -2))
    sizes = np.sqrt(np.maximum(np.diagonal(symmetric, axis1=-2, axis2=-1), 1e-30))
    scale = sizes[..., :, None] * sizes[..., None, :]
    values, axes = np.linalg.eigh(symmetric / scale)
    if values.min() >= _LEAST:
        return symmetric
    floored = np.maximum(values, _LEAST)
    mended: np.ndarray = scale * ((axes * floored[..., None, :]) @ np.swapaxes(axes, -1, -2))
    return np.where((values[..., :1] < _LEAST)[..., None], mended, symmetric)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Estimate:
    """Estimate of a target's motion at a time."""

    time: float  # s
    target: Target
    covariance: np.ndarray  # (..., 20, 20)
    fitted: np.ndarray  # (...) how many of the last poses fitted, less those that did not

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviations (..., 20)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))

    @property
    def pose_deviation(self) -> tuple[np.ndarray, np.ndarray]:
        """Root of the sum of the variances of P's rotation, rad, and of its position, m (...)."""
        variances = self.deviation**2
        return tuple(np.sqrt(variances[..., part].sum(axis=-1)) for part in (ROTATION, POSITION))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Path:
    """Predicted path of a target."""

    motion: np.ndarray  # (n, 13) quaternion, p_WP, w_WP, v_WP; at control samples
    arm: np.ndarray  # (3) p_PC in P's axes, m

    def center(self, sample: int) -> np.ndarray:
        """p_WC (3) at a sample, m."""
        motion = self.motion[sample]
        center: np.ndarray = motion[4:7] + matrix_of(motion[:4]) @ self.arm
        return center


def observed(
    sensor: TargetSensor, target: Target, place: np.ndarray, random: np.random.Generator
) -> tuple[Pose, np.ndarray]:
    """Poses of targets as a sensor at ``place`` (..., 3; m, in the world) sees them, and whether it
    gives them (...).
    """
    covariance = noise_of(sensor, target.position - place)
    shape = target.quaternion.shape[:-1]
    wrong = random.random(shape) < sensor.outliers
    noise = times(np.linalg.cholesky(covariance), random.normal(size=(*shape, 6)))
    noise *= np.where(wrong, sensor.outlier_scale, 1.0)[..., None]
    pose = Pose(
        quaternion=composed(target.quaternion, quaternion_of(noise[..., :3])),
        position=target.position + noise[..., 3:],
        covariance=covariance,
    )
    return pose, random.random(shape) >= sensor.dropouts


class TargetFilter:
    """The filter, with its settings; estimates go in and come out."""

    def __init__(self, settings: TargetTracker, prior: Target, orbit: Orbit | None = None) -> None:
        """Args: settings; the target that is expected, at t = 0; the orbit, if there is one."""
        self._settings, self._prior, self._orbit = settings, prior, orbit
        self._walk = np.zeros(SIZE)
        self._walk[RATE], self._walk[VELOCITY] = settings.rate_walk**2, settings.velocity_walk**2

    def first(self, time: float, pose: Pose) -> Estimate:
        """Start from a first pose at a time, s."""
        settings, R = self._settings, matrix_of(pose.quaternion)
        shape, prior = R.shape[:-2], self.moved(self._prior, 0.0, time)
        row = np.broadcast_to(prior.as_row(), (*shape, prior.as_row().shape[-1]))
        known = Target.from_row(row)
        target = dataclasses.replace(
            known, quaternion=pose.quaternion, center=pose.position + times(R, known.arm)
        )
        variances = np.zeros((*shape, SIZE, SIZE))
        given = (settings.rate_deviation, settings.velocity_deviation, settings.center_deviation)
        for part, deviation in zip((RATE, VELOCITY, ARM), given, strict=True):
            variances[..., part, part] = deviation**2 * np.eye(3)
        unlike = settings.inertia_deviation * shape_spread(prior.shape)
        variances[..., SHAPE, SHAPE] = unlike @ unlike.T
        variances[..., ROTATION, ROTATION] = pose.covariance[..., :3, :3]
        variances[..., POSITION, POSITION] = pose.covariance[..., 3:, 3:]
        return Estimate(
            time=time, target=target, covariance=variances, fitted=np.zeros(shape, dtype=int)
        )

    def moved(self, target: Target, first: float, last: float) -> Target:
        """A target from one time to another, s."""
        for begin, step in steps_between(target, first, last):
            target = target.after(step, begin, self._orbit)
        return target

    def path(self, estimate: Estimate | None, time: float, period: float, samples: int) -> "Path":
        """Predicted path of the target from a time (s), at every ``period`` (s); without an
        estimate the expected path.
        """
        if estimate is None:
            target = self.moved(self._prior, 0.0, time)
        else:
            target = self.moved(estimate.target, estimate.time, time)
        motion = path_of(target, time, period=period, samples=samples, orbit=self._orbit)
        return Path(motion=motion, arm=target.arm)

    def predicted(self, estimate: Estimate, time: float) -> Estimate:
        """An estimate at a later time, s."""
        target, covariance = estimate.target, estimate.covariance
        for begin, step in steps_between(target, estimate.time, time):
            middle = target.after(0.5 * step, begin, self._orbit)
            phi = middle.transition(step)
            covariance = phi @ covariance @ np.swapaxes(phi, -1, -2) + np.diag(step * self._walk)
            covariance = sound(covariance)
            mean, spread = middle.bend(covariance)
            # it turns with the body, so that it lasts for about a radian
            lasts = _LASTS / np.maximum(np.linalg.norm(middle.rate, axis=-1), _SLOWEST)
            covariance[..., RATE, RATE] += step * lasts[..., None, None] * spread
            middle = dataclasses.replace(middle, rate=middle.rate + step * mean)
            target = middle.after(0.5 * step, begin + 0.5 * step, self._orbit)
        return dataclasses.replace(estimate, time=time, target=target, covariance=covariance)

    def updated(self, estimate: Estimate, pose: Pose, given: np.ndarray) -> Estimate:
        """An estimate with a pose at its time; ``given`` (...): whether there is one.

        A pose beyond the gate is left out. If more of the last poses were left out than taken,
        the filter restarts with the next.
        """
        target, P = estimate.target, estimate.covariance
        innovation = np.concatenate(
            [turn_between(target.quaternion, pose.quaternion), pose.position - target.position],
            axis=-1,
        )
        across = P[..., _POSE]
        inverse = np.linalg.inv(across[..., _POSE, :] + pose.covariance)
        distance = np.einsum("...i,...ij,...j->...", innovation, inverse, innovation)
        fits = given & (distance <= self._settings.gate)
        fitted = np.where(fits, np.minimum(estimate.fitted + 1, _TRUSTED), estimate.fitted)
        fitted = np.where(given & ~fits, fitted - 1, fitted)
        gain = np.where(fits[..., None, None], across @ inverse, 0.0)
        kept = np.eye(SIZE) - gain @ _OF_POSE
        covariance = kept @ P @ np.swapaxes(kept, -1, -2)
        covariance += gain @ pose.covariance @ np.swapaxes(gain, -1, -2)
        corrected = target.corrected(times(gain, innovation)).as_row()
        begins = fitted < 0
        anew = self.first(estimate.time, pose)
        return Estimate(
            time=estimate.time,
            target=Target.from_row(np.where(begins[..., None], anew.target.as_row(), corrected)),
            covariance=np.where(begins[..., None, None], anew.covariance, sound(covariance)),
            fitted=np.where(begins, 0, fitted),
        )
