"""The sampled loop of one axis: a time-delay law's own ``step`` around the double integrator

    d^2e/dt^2 = -eta (t - d),      t = Hhat^-1 tau - a_d held over a sample, exactly integrated,

with the tracking error e, eta an eigenvalue of H^-1 Hhat and d = -N under perfect tracking, to be
estimated by the controller. With the one-sample estimate the pole at z = -1 sets the limit
(K_D + K_s) L < 2 (2 - eta) / eta.

It equals the wired loop (``linearization``) for a true payload equal to the nominal one, with
decoupled axes, and is used for speed: one set of gains takes 54 ms on the wiring, 34 ms where
only held gains change, and 0.27 ms here with six values of eta; thousands at once take 11 us each.
Limits by coordinate, maps, the course of adaptation and the search of gains need thousands and
use it; spectral radii, boundaries and the choice of a design use the wiring.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from ffsm_drake.plugins.design.stability.linear_loop import STATIONARY, covariance_after
from ffsm_drake.systems.controllers.law import Sample
from ffsm_drake.systems.controllers.time_delay import TimeDelayControl

_STEPS = 400  # steps of a scan for a limit
_HALVINGS = 20  # halvings of the step that contains the limit


@dataclasses.dataclass(frozen=True, kw_only=True)
class AxisLoop:
    """x+ = A x + B [position noise; velocity noise] + f d + g u, for any shape (...) of gains.

    x is [e, de/dt, t] and the memory of the law and its estimator that feeds back.
    """

    names: tuple[str, ...]  # entries of x: "error", "error_rate", "force", then those of the memory
    a: np.ndarray  # (..., m, m)
    b: np.ndarray  # (..., m, 2)
    f: np.ndarray  # (..., m)
    g: np.ndarray  # (..., m); u adds to the acceleration that the law commands

    def __getitem__(self, index: tuple[int, ...]) -> "AxisLoop":
        """One of many loops."""
        arrays: dict[str, Any] = {name: getattr(self, name)[index] for name in "abfg"}
        return dataclasses.replace(self, **arrays)

    def part(self, name: str) -> int:
        """Index of an entry of x."""
        return self.names.index(name)

    @functools.cached_property
    def poles(self) -> np.ndarray:
        """(..., m), the largest magnitude first."""
        poles = np.linalg.eigvals(self.a)
        return np.take_along_axis(poles, np.argsort(-np.abs(poles), axis=-1), axis=-1)

    @property
    def spectral_radius(self) -> np.ndarray:
        """Largest pole magnitude (...); the loop is stable below 1."""
        return np.abs(self.poles[..., 0])

    def covariance(
        self, *, position_noise: np.ndarray | float, velocity_noise: np.ndarray | float
    ) -> np.ndarray:
        """Stationary covariance (..., m, m) of x under white noise of these standard deviations
        (...); meaningless for an unstable loop.
        """
        noise = np.stack(np.broadcast_arrays(position_noise, velocity_noise), axis=-1)
        b = self.b * noise[..., None, :]
        return covariance_after(self.a, b @ np.swapaxes(b, -1, -2), samples=STATIONARY)


def axis_loop(
    law: TimeDelayControl,
    *,
    eta: np.ndarray | float = 1.0,
    euler: bool = False,
    also: str = "",
) -> AxisLoop:
    """The loops of the coordinates of a law, linearised exactly.

    Args:
      law: one whose ``by_axis`` is itself; its gains (nv), or (..., nv) for many loops at once.
        Adapted gains are those of the start.
      eta: (..., nv).
      euler: whether the plant steps as explicit Euler at the control period does, as in the paper.
      also: a piece of the memory to keep even if nothing depends on it.
    """
    held, memory = law.held(), law.initial_state()
    step: Any = vars(law.estimator)["sample_time"]
    names = ["error", "error_rate", "force", *(name for name in memory if name not in held)]
    gains = (np.shape(value) for value in vars(law.dynamics).values())
    shape = np.broadcast_shapes(np.shape(step), *gains)
    shape = (1,) * (np.ndim(eta) - len(shape)) + shape
    size = len(names)
    unit = np.eye(size + 4).reshape(size + 4, size + 4, *(1 for _ in shape))
    x = np.broadcast_to(unit, (*unit.shape[:2], *shape))
    e, v, t = x[:3]
    e_noise, v_noise, d, u = x[size:]
    zero, rate = np.zeros(shape), v - v_noise
    sample = Sample(
        q=zero, v=-rate, q_d=zero, v_d=zero, a_d=zero,
        e=e - e_noise, e_dot=rate, applied_force=t, is_first=False,
    )  # fmt: skip
    state = dict(zip(names[3:], x[3:size], strict=True))
    for name, value in held.items():
        state[name] = memory[name] if value is None else np.full(shape, value)
    estimate, after = law.estimator.step(sample, np.eye(shape[-1]), state)
    wanted, after_law = law.dynamics.step(estimate.e, estimate.e_dot, zero, state)
    after = {**after, **after_law}
    t = estimate.base_force + wanted + u - estimate.base_acceleration
    acceleration = eta * (d - t)
    half = 0.0 if euler else 0.5 * step**2
    rows = [e + step * v + half * acceleration, v + step * acceleration, t]
    rows += [after[name] for name in names[3:]]
    found = np.empty((size, *acceleration.shape))
    for k, row in enumerate(rows):
        found[k] = row
    return _reduced(names, np.moveaxis(found, (0, 1), (-2, -1)), also)


def _reduced(names: list[str], found: np.ndarray, also: str) -> AxisLoop:
    """The loop of [A, B, f, g] (..., m, m + 4) without memory that has no input or no effect."""
    size = len(names)
    arrows = (found[..., :size] != 0.0).reshape(-1, size, size).any(axis=0)
    np.fill_diagonal(arrows, val=False)
    keep = arrows.any(axis=0) & arrows.any(axis=1)
    keep |= [k < 3 or name == also for k, name in enumerate(names)]
    a, b = found[..., keep, :size][..., keep], found[..., keep, size : size + 2]
    return AxisLoop(
        names=tuple(itertools.compress(names, keep)),
        a=a, b=b, f=found[..., keep, -2], g=found[..., keep, -1],
    )  # fmt: skip


def of_axes(law: TimeDelayControl, axes: list[int]) -> TimeDelayControl:
    """The law of a subset of its coordinates."""

    def cut(part: Any) -> Any:
        values = {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}
        arrays = {name: each[axes] for name, each in values.items() if np.ndim(each)}
        return dataclasses.replace(part, **arrays)

    return dataclasses.replace(law, dynamics=cut(law.dynamics), estimator=cut(law.estimator))


def with_sample_time(law: TimeDelayControl, step: np.ndarray) -> TimeDelayControl:
    """The law with another control period (..., nv), s, and the same Kalman gain."""

    def stepped(part: Any) -> Any:
        return dataclasses.replace(part, sample_time=step) if hasattr(part, "sample_time") else part

    return dataclasses.replace(
        law, dynamics=stepped(law.dynamics), estimator=stepped(law.estimator)
    )


def largest_stable_k_s(
    law: TimeDelayControl, axis: int, *, eta: np.ndarray, euler: bool = False
) -> np.ndarray:
    """Largest K_s (m), 1/s, up to 1000, that keeps one coordinate stable at each eta (m).

    NaN if none does, and for a law without K_s.
    """
    if law.reaching_gain is None:
        return np.full(np.shape(eta), np.nan)
    own = of_axes(law, [axis])
    return _largest_stable(own.with_reaching_gain, eta, euler, low=0.01, high=1000.0)


def largest_sample_time(
    law: TimeDelayControl, axis: int, *, eta: np.ndarray, euler: bool = False
) -> np.ndarray:
    """Largest L (m), s, up to 0.2, that keeps one coordinate stable at each eta (m), at the law's
    starting gains.
    """
    change = functools.partial(with_sample_time, of_axes(law, [axis]))
    return _largest_stable(change, eta, euler, low=1e-5, high=0.2)


def tolerated_eta(law: TimeDelayControl, axis: int, *, euler: bool = False) -> tuple[float, float]:
    """The interval of eta around 1, or nearest to 1, in which one coordinate is stable at the
    starting gains; (NaN, NaN) where no eta in (0, 4) is.
    """
    own = of_axes(law, [axis])

    def is_stable(eta: np.ndarray) -> np.ndarray:
        return axis_loop(own, eta=eta[:, None], euler=euler).spectral_radius[:, 0] < 1.0

    grid = np.linspace(0.005, 4.0, 2 * _STEPS)
    stable = is_stable(grid)
    if not stable.any():
        return float("nan"), float("nan")
    inside = np.flatnonzero(stable)
    anchor = int(inside[np.argmin(np.abs(grid[inside] - 1.0))])
    outside = np.flatnonzero(~stable)
    low = int(outside[outside < anchor].max(initial=-1))
    high = int(outside[outside > anchor].min(initial=grid.size))
    ends = grid[[low + 1, high - 1]], grid[[max(low, 0), min(high, grid.size - 1)]]
    found = _edge(is_stable, *ends)
    return float(found[0]), float(found[1])


def _largest_stable(
    change: Callable[[np.ndarray], TimeDelayControl],
    eta: np.ndarray,
    euler: bool,
    *,
    low: float,
    high: float,
) -> np.ndarray:
    """The largest x (m) in [low, high] with a stable law ``change(x)`` of one coordinate; NaN
    without one. The stable set need not start at ``low``.

    Args:
      change: values (..., m or 1, 1) -> law.
      eta: (m).
      euler: see ``axis_loop``.
      low, high: ends of the interval.
    """

    def is_stable(x: np.ndarray) -> np.ndarray:
        loop = axis_loop(change(x), eta=eta[:, None], euler=euler)
        return loop.spectral_radius[..., 0] < 1.0

    grid = np.linspace(low, high, _STEPS)
    stable = is_stable(grid[:, None, None])
    last = _STEPS - 1 - np.argmax(stable[::-1], axis=0)
    ends = grid[last], grid[np.minimum(last + 1, _STEPS - 1)]
    found = _edge(lambda x: is_stable(x[:, None]), *ends)
    return np.where(stable.any(axis=0), found, np.nan)


def _edge(
    is_stable: Callable[[np.ndarray], np.ndarray], inside: np.ndarray, outside: np.ndarray
) -> np.ndarray:
    """The limits (m) between stable and unstable values (m), by bisection."""
    for _ in range(_HALVINGS):
        middle = 0.5 * (inside + outside)
        stable = is_stable(middle)
        inside, outside = np.where(stable, middle, inside), np.where(stable, outside, middle)
    return inside
