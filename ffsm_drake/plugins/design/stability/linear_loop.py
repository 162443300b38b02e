"""A linear loop, sample by sample: poles, modes, response to noise; see ``linearization``."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Self

import numpy as np

from ffsm_drake.common.errors import BlockError
from ffsm_drake.common.numbers import number
from ffsm_drake.scenario import PerCoordinate
from ffsm_drake.spacecraft.coordinates import Coordinates

WARM_UP = 5  # control samples on the plan before the map is taken, to fill every memory
MARGINAL = 1e-6  # distance from the unit circle within which a pole neither grows nor decays
_NEAR_ONE = 5e-3  # distance of an eigenvalue at one, as it is found
_KEPT = 1e-7  # singular value of A - 1 that is zero, but for the differences' rounding
STATIONARY = 2**18  # control samples until a loop that contracts has stationary noise


class NotLinear(BlockError):
    """A loop with a block that cannot be linearised."""


class TooLarge(NotLinear):
    """A loop whose linearisation would take minutes, or fill the memory."""


def radius_digits(radius: float) -> str:
    """A spectral radius as a number: five decimals, or three digits from 100 on."""
    return f"{radius:.5f}" if radius < 100.0 else number(radius, 3)


def radius_told(radius: float) -> str:
    """A spectral radius as a number, or why there is no finite one."""
    if math.isfinite(radius):
        return radius_digits(radius)
    return f"none: the loop diverges from the plan within {WARM_UP} samples"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mode:
    """A mode of the loop: a real pole, or a conjugate pair."""

    # z, over the common period of all blocks; of a pair the one with the positive imaginary part
    pole: complex
    frequency: float  # rad/s, natural
    damping: float  # ratio; negative where the mode grows
    # coordinate, known or hidden -> share of the plant's motion in the mode, largest first
    coordinates: PerCoordinate


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SampleMap:
    """x+ = A x + B w, u = C x + D w over one control sample; for x, w and u see LinearLoop."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class LinearLoop:
    """The loop near one instant of the planned motion.

    Its state x begins with the plant's e and its rate (2 nv), then its hidden coordinates and their
    rates; u is the controller's force until the next sample (nv, N m or N); w is white noise of
    unit variance, one value per sample. Undriven coordinates have no poles: they follow the others
    at constant momentum. Where a frame is tracked, their positions act on the driven coordinates,
    and one unit pole for each is not counted: the frame can be held in as many ways.
    """

    coordinates: Coordinates
    time: float  # s
    sample_time: float  # s
    samples: tuple[SampleMap, ...]  # maps over one common period of all blocks
    hidden: tuple[str, ...] = ()  # names of the hidden coordinates
    tracks_frame: bool = False
    # memory of the controller: name -> its part of x
    memory: Mapping[str, slice] = dataclasses.field(default_factory=dict)
    # (6, nv) derivative of the pose of the tracked frame by e; None: there is none
    frame_jacobian: np.ndarray | None = None
    # name of a source -> its part of w
    noise: Mapping[str, slice] = dataclasses.field(default_factory=dict)

    @functools.cached_property
    def a(self) -> np.ndarray:
        """The map of x over the common period; of equal samples in a row a power."""
        powers = (
            np.linalg.matrix_power(sample.a, len(list(row)))
            for sample, row in itertools.groupby(self.samples)
        )
        return functools.reduce(lambda product, power: power @ product, powers)

    @property
    def _plant_size(self) -> int:
        return 2 * (self.coordinates.num_velocities + len(self.hidden))

    @functools.cached_property
    def poles(self) -> np.ndarray:
        """Poles of the states with feedback, over the common period, the largest first; one
        infinite pole where A is not finite.
        """
        if not np.isfinite(self.a).all():
            return np.full(1, np.inf)
        poles = np.linalg.eigvals(self._fed_back[1])
        return poles[self._counted(poles)]

    @property
    def spectral_radius(self) -> float:
        """Largest pole magnitude per control sample; the loop is stable below 1."""
        return float(np.abs(self.poles[0]) ** (1.0 / len(self.samples)))

    @property
    def fast_radius(self) -> float:
        """Largest magnitude per control sample of the poles with a negative real part, the modes
        that alternate between samples; 0 without one.
        """
        fast = np.abs(self.poles[self.poles.real < 0.0])
        return float(fast.max(initial=0.0) ** (1.0 / len(self.samples)))

    @property
    def is_marginal(self) -> bool:
        """True if some small errors are constant: they do not grow or decay."""
        return abs(self.spectral_radius - 1.0) < MARGINAL

    @property
    def unit_poles(self) -> int:
        """The number of poles at one: of states that nothing moves back.

        They are counted as the directions that A keeps: eigenvalues at one of a matrix that is far
        from normal are found with few digits. A direction that a matrix with large entries seems to
        keep has no eigenvalue even near one.
        """
        kept = self._fed_back[1]
        if not np.isfinite(kept).all():
            return 0
        sizes = np.linalg.svd(kept - np.eye(len(kept)), compute_uv=False)
        return int(min((sizes < _KEPT).sum(), (np.abs(self.poles - 1.0) < _NEAR_ONE).sum()))

    @property
    def kept_memory(self) -> tuple[str, ...]:
        """Names of the controller's memory that neither grows nor decays: without it, fewer poles
        lie on the unit circle.
        """

        def marginal(loop: LinearLoop) -> int:
            return int((np.abs(np.abs(loop.poles) - 1.0) < MARGINAL).sum())

        def without(part: slice) -> LinearLoop:
            rest = np.delete(np.arange(len(self.a)), part)
            samples = tuple(
                SampleMap(a=s.a[np.ix_(rest, rest)], b=s.b[rest], c=s.c[:, rest], d=s.d)
                for s in self.samples
            )
            return dataclasses.replace(self, samples=samples, memory={})

        count = marginal(self)
        return tuple(name for name, part in self.memory.items() if marginal(without(part)) < count)

    def modes(self, count: int = 6) -> list[Mode]:
        """The slowest modes, those that grow first."""
        names, found = self.coordinates.names, list[Mode]()
        parts = (*names, *self.hidden)
        if not np.isfinite(self.poles).all():
            return found
        poles, vectors = self._eigen()
        for pole, vector in zip(poles.tolist(), vectors.T, strict=True):
            if pole.imag < 0.0 or abs(pole) < 1e-6 or len(found) == count:
                continue
            exponent = np.log(complex(pole)) / (len(self.samples) * self.sample_time)
            weight = np.abs(
                np.concatenate([vector[: len(names)], vector[2 * len(names) :][: len(self.hidden)]])
            )
            share = weight / weight.sum()
            found.append(
                Mode(
                    pole=complex(pole),
                    frequency=float(abs(exponent)),
                    damping=float(-exponent.real / abs(exponent)) if exponent else 0.0,
                    coordinates={
                        parts[i]: float(share[i]) for i in np.argsort(-share, kind="stable")
                    },
                )
            )
        return found

    def noise_response(self, samples: int) -> dict[str, np.ndarray]:
        """Standard deviations (nv) under the noise, a number of control samples after a start
        without error, rounded up to a power of two.

        Keys ``error`` (rad, m), ``error_rate`` (per s) and ``force`` (N m, N); ``sliding_variable``
        (after a sample's update) where the controller has one; ``frame_error`` (6; rad, m) with a
        tracked frame.
        """
        nv = self.coordinates.num_velocities
        if not np.isfinite(self.poles).all():
            found = {name: np.full(nv, np.inf) for name in ("error", "error_rate", "force")}
            of_frame = np.full(0 if self.frame_jacobian is None else 6, np.inf)
            return {**found, "frame_error": of_frame} if of_frame.size else found
        with np.errstate(over="ignore", invalid="ignore"):  # growing loops
            variances = self._variances(samples)
        return {
            name: np.sqrt(np.where(np.isfinite(values), np.maximum(values, 0.0), np.inf))
            for name, values in variances.items()
        }

    def _variances(self, samples: int) -> dict[str, np.ndarray]:
        """The squares of ``noise_response``; not finite where the loop overflows."""
        nv = self.coordinates.num_velocities
        noisy = sum(np.abs(sample.b).sum(axis=1) for sample in set(self.samples)) > 0.0
        keep = self._matters(noisy)
        keep[: self._plant_size] = True  # undriven coordinates too, which drift
        maps = [
            (sample.a[np.ix_(keep, keep)], sample.b[keep], sample.c[:, keep], sample.d)
            for sample in self.samples
        ]
        power, once = np.eye(int(keep.sum())), np.zeros((keep.sum(),) * 2)
        for a, b, _, _ in maps:
            power, once = a @ power, a @ once @ a.T + b @ b.T
        covariance = covariance_after(power, once, samples=math.ceil(samples / len(maps)))
        of_state, of_force, jacobian = np.zeros(len(covariance)), np.zeros(nv), self.frame_jacobian
        of_frame = np.zeros(0 if jacobian is None else len(jacobian))
        for a, b, c, d in maps:
            of_state += np.diagonal(covariance) / len(maps)
            if jacobian is not None:
                spread = jacobian @ covariance[:nv, :nv]
                of_frame += np.einsum("ij,ij->i", spread, jacobian) / len(maps)
            of_force += (np.einsum("ij,jk,ik->i", c, covariance, c) + (d**2).sum(axis=1)) / len(
                maps
            )
            covariance = a @ covariance @ a.T + b @ b.T
        variances = {"error": of_state[:nv], "error_rate": of_state[nv : 2 * nv], "force": of_force}
        if of_frame.size:
            variances["frame_error"] = of_frame
        if "sliding_variable" in self.memory:
            part, sample = self.memory["sliding_variable"], self.samples[0]
            row = sample.a[part][:, keep]
            variances["sliding_variable"] = np.einsum("ij,jk,ik->i", row, covariance, row)
            variances["sliding_variable"] += (sample.b[part] ** 2).sum(axis=1)
        return variances

    def with_random_walk(self, walk: np.ndarray, mass_matrix: np.ndarray) -> Self:
        """The loop with a random walk of acceleration d, and with the excess over -H d as its
        force.

        Args:
          walk: intensity (nv), its standard deviation after one second, rad/s^2 or m/s^2 per
            sqrt(s).
          mass_matrix: H of the plant (nv, nv); the force -H d would compensate d.
        """
        nv, step = len(walk), self.sample_time
        enter = np.zeros((len(self.a), nv))
        enter[: 2 * nv] = np.vstack([0.5 * step**2 * np.eye(nv), step * np.eye(nv)])
        samples = tuple(
            SampleMap(
                a=np.block([[sample.a, enter], [np.zeros((nv, len(self.a))), np.eye(nv)]]),
                b=np.block([
                    [sample.b, np.zeros((len(self.a), nv))],
                    [np.zeros((nv, sample.b.shape[1])), np.diag(np.sqrt(step) * walk)],
                ]),
                c=np.hstack([sample.c, mass_matrix]),
                d=np.hstack([sample.d, np.zeros((nv, nv))]),
            )
            for sample in self.samples
        )  # fmt: skip
        return dataclasses.replace(self, samples=samples)

    @functools.cached_property
    def _fed_back(self) -> tuple[np.ndarray, np.ndarray]:
        """Mask of the states with feedback, and A of them."""
        keep = self._matters(np.zeros(len(self.a), dtype=bool))
        return keep, self.a[np.ix_(keep, keep)]

    def _counted(self, poles: np.ndarray) -> np.ndarray:
        """The places of those poles that count, the largest first."""
        free = int((~self.coordinates.is_driven).sum()) if self.tracks_frame else 0
        counted = np.sort(np.argsort(np.abs(poles - 1.0), kind="stable")[free:])
        return counted[np.argsort(-np.abs(poles[counted]), kind="stable")]

    def _eigen(self) -> tuple[np.ndarray, np.ndarray]:
        """``poles`` with their right eigenvectors, which take several times as long."""
        keep, a = self._fed_back
        poles, kept = np.linalg.eig(a)
        counted = self._counted(poles)
        vectors = np.zeros((len(self.a), len(counted)), dtype=kept.dtype)
        vectors[keep] = kept[:, counted]
        return poles[counted], vectors

    def _matters(self, driven: np.ndarray) -> np.ndarray:
        """Mask of the entries of x that act on the plant and are acted on by it or by ``driven``
        (mask).
        """
        arrows = sum(np.abs(sample.a) for sample in set(self.samples)) > 0.0
        plant = np.arange(len(arrows)) < self._plant_size
        is_driven = self.coordinates.is_driven
        plant[: 2 * is_driven.size] = np.concatenate([is_driven | self.tracks_frame, is_driven])
        acting, driven = plant, driven | plant
        before = -1
        while (reached := int(acting.sum() + driven.sum())) > before:
            before = reached
            acting = acting | arrows[acting].any(axis=0)
            driven = driven | arrows[:, driven].any(axis=1)
        return acting & driven


def at_rest(loops: Sequence[LinearLoop]) -> Sequence[LinearLoop]:
    """The loops along a motion by which stability at rest is judged: with a tracked frame, those of
    its ends, because a frame that moves may pass a singular posture.
    """
    return (loops[0], loops[-1]) if loops[0].tracks_frame else loops


def covariance_after(a: np.ndarray, noise: np.ndarray, *, samples: int) -> np.ndarray:
    """Covariance (..., m, m) of x from zero, x+ = A x + w, w of covariance ``noise``, after the
    next power of two of ``samples``.

    By doubling: the sum of A^k noise A^k' (a discrete Lyapunov equation where it converges). Not
    finite where it overflows.
    """
    covariance, power = noise, a
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        for _ in range(max(samples - 1, 0).bit_length()):
            covariance, power = (
                covariance + power @ covariance @ np.swapaxes(power, -1, -2),
                power @ power,
            )
    return covariance
