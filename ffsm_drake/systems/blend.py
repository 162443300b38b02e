"""Progress of a motion along its path: a polynomial to rest, from rest or a velocity.

Input shaping (Singer and Seering 1990, doi:10.1115/1.2894142) replaces a motion by a weighted sum
of copies delayed by half and whole periods of a vibration, so that the vibrations they excite
cancel. Here the path parameter is copied: path, start, end and total duration do not change.
"""

import dataclasses
import math

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.scenario import Reference, Shaper

# value, rate and acceleration of a function of time
Derivatives = tuple[np.ndarray, np.ndarray, np.ndarray]


def _share(time: np.ndarray | float, duration: float) -> np.ndarray:
    return np.minimum(np.maximum(time / duration, 0.0), 1.0)


def quintic_blend(time: np.ndarray | float, duration: float) -> Derivatives:
    """Return the blend s in [0, 1] with its first (1/s) and second (1/s^2) derivative; constant
    outside [0, duration].
    """
    x = _share(time, duration)
    return (
        x * x * x * (10.0 + x * (6.0 * x - 15.0)),
        30.0 * x * x * (1.0 + x * (x - 2.0)) / duration,
        60.0 * x * (1.0 + x * (2.0 * x - 3.0)) / (duration * duration),
    )


def quintic_stop(time: np.ndarray | float, duration: float) -> Derivatives:
    """Excursion g, s, with g', g'' in 1/s, from unit velocity until it returns to rest at 0.

    g(x) = T x (1 - x)^3 (1 + 3 x), x = t/T: fifth order, zero acceleration at both ends; constant
    outside [0, T].
    """
    x = _share(time, duration)
    y = 1.0 - x
    return (
        duration * x * y * y * y * (1.0 + 3.0 * x),
        y * y * (1.0 + x * (2.0 - 15.0 * x)),
        -12.0 * x * y * (3.0 - 5.0 * x) / duration,
    )


def septic_blend(time: np.ndarray | float, duration: float) -> Derivatives:
    """Seventh-order version of ``quintic_blend``, with zero jerk at both ends.

    Peak speed 2.1875/T, peak acceleration 7.5132/T^2.
    s(x) = x^4 (35 - 84 x + 70 x^2 - 20 x^3), s' = 140 x^3 (1 - x)^3 / T.
    """
    x = _share(time, duration)
    xy = x * (1.0 - x)
    return (
        x * x * x * x * (35.0 + x * (-84.0 + x * (70.0 - 20.0 * x))),
        140.0 * xy * xy * xy / duration,
        420.0 * xy * xy * (1.0 - 2.0 * x) / (duration * duration),
    )


def septic_stop(time: np.ndarray | float, duration: float) -> Derivatives:
    """Seventh-order version of ``quintic_stop``, with zero jerk at both ends.

    g(x) = T x (1 - x)^4 (1 + 4 x + 10 x^2).
    """
    x = _share(time, duration)
    y = 1.0 - x
    return (
        duration * x * y * y * y * y * (1.0 + x * (4.0 + 10.0 * x)),
        y * y * y * (1.0 + x * (3.0 + x * (6.0 - 70.0 * x))),
        -60.0 * x * x * y * y * (4.0 - 7.0 * x) / duration,
    )


_POLYNOMIALS = {"quintic": (quintic_blend, quintic_stop), "septic": (septic_blend, septic_stop)}


@dataclasses.dataclass(frozen=True)
class Impulses:
    """An input shaper: copies delayed by ``delays`` (s), weighted by ``shares`` (sum: one)."""

    delays: tuple[float, ...] = (0.0,)
    shares: tuple[float, ...] = (1.0,)

    @property
    def length(self) -> float:
        """Extra duration of the shaped motion, s."""
        return max(self.delays)

    @property
    def mean(self) -> float:
        """Weighted mean delay, s."""
        return math.fsum(
            delay * share for delay, share in zip(self.delays, self.shares, strict=True)
        )

    def reversed(self) -> "Impulses":
        """Return the shaper of a reversed motion."""
        return Impulses(tuple(self.length - delay for delay in self.delays), self.shares)


def make_impulses(shaper: Shaper | None) -> Impulses:
    """Return the shaper of a scenario: one for each frequency, in series.

    ZV leaves no vibration at its frequency: two copies, half a damped period apart, with shares in
    the ratio 1 : K, K = exp(-pi z / sqrt(1 - z^2)). ZVD, two of them in series, leaves little near
    its frequency.
    """
    if shaper is None:
        return Impulses()
    delays, shares = np.zeros(1), np.ones(1)
    for frequency in shaper.frequencies:
        root = math.sqrt(1.0 - shaper.damping_ratio**2)
        half = 0.5 / (frequency * root)
        ratio = math.exp(-math.pi * shaper.damping_ratio / root)
        for _ in range(1 if shaper.kind == "zv" else 2):
            delays = np.concatenate([delays, delays + half])
            shares = np.concatenate([shares, ratio * shares]) / (1.0 + ratio)
    # coincident copies are merged, such as the two in the middle of ZVD
    found = dict[float, float]()
    for delay, share in zip(np.round(delays, 12).tolist(), shares.tolist(), strict=True):
        found[delay] = found.get(delay, 0.0) + share
    return Impulses(tuple(found), tuple(found.values()))


class Blend:
    """The blend of a motion, and the stop from a velocity, over a duration."""

    def __init__(self, reference: Reference, duration: float, *, backwards: bool = False) -> None:
        """Args:
          reference: the reference.
          duration: its duration, s.
          backwards: run the motion backwards.

        Raises ScenarioError: the shaper takes the whole duration or more.
        """
        impulses = make_impulses(reference.shaper)
        self._impulses = impulses.reversed() if backwards else impulses
        self._blend, self._stop = _POLYNOMIALS.get(reference.kind, _POLYNOMIALS["quintic"])
        self.duration, self._own = duration, duration - impulses.length
        if self._own <= 0.0:
            raise ScenarioError(
                "reference.shaper",
                f"needs {impulses.length:.4g} s of a motion of {duration:g} s; lengthen "
                "reference.duration, or shape fewer or higher frequencies",
            )

    @property
    def stopping_time(self) -> float:
        """Distance to rest from unit velocity at the least cost, s."""
        return 0.5 * self._own + self._impulses.mean

    def blend(self, times: np.ndarray) -> Derivatives:
        """s from 0 to 1 with its derivatives at times (n,); constant outside the duration."""
        if self._impulses.length == 0.0:
            return self._blend(times, self._own)
        return self._shaped(
            [self._blend(times - delay, self._own) for delay in self._impulses.delays]
        )

    def stop(self, times: np.ndarray) -> Derivatives:
        """Excursion from unit velocity until it returns to rest; arguments as ``blend``.

        Shaped as if the velocity had always been constant, which excites nothing.
        """
        if self._impulses.length == 0.0:
            return self._stop(times, self._own)
        copies = []
        for delay in self._impulses.delays:
            late = times - delay
            g, rate, acceleration = self._stop(late, self._own)
            copies.append((np.where(late < 0.0, late, g), rate, acceleration))
        mean = self._impulses.mean
        g, rate, acceleration = self._shaped(copies)
        s, s_rate, s_acceleration = self.blend(times)
        at_start = times < 0.0
        return (
            np.where(at_start, 0.0, g + mean * (1.0 - s)),
            rate - mean * s_rate,
            acceleration - mean * s_acceleration,
        )

    def _shaped(self, copies: list[Derivatives]) -> Derivatives:
        shares = self._impulses.shares
        first, second, third = (
            sum(share * copy[order] for share, copy in zip(shares, copies, strict=True))
            for order in range(3)
        )
        return np.asanyarray(first), np.asanyarray(second), np.asanyarray(third)
