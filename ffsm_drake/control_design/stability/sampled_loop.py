"""Stability of the sampled loop: time-delay control with a zero-order hold on an exactly integrated
plant.

The paper's proof in continuous time does not cover a force that is held over a period. The loop is
stable if the map from one control sample to the next contracts. Near a posture, with K_s constant
and no sign term, it is linear.

*One axis.* With eta an eigenvalue of H^-1 Hhat, error e, rate v = de/dt and I the sum of L e,

    a_k = (1 - eta) a_{k-1} - eta (k_v v + k_p e + k_i I),   e+ = e + L v + L^2 a / 2,   v+ = v + L
    a,   I+ = I + L e.

Its pole at z = -1 sets the limit (K_D + K_s) L < 2 (2 - eta) / eta. With the measurement noise as
input, the covariance of its response solves a discrete Lyapunov equation.

This is the explanation, for the paper's laws; the loop of all coordinates is read from the wiring
(``linearization``).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers import PAPER_LAWS, gain_vectors


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoopGains:
    """u = a_d + k_v de/dt + k_p e + k_i int e: what a law is for constant K_s and G = 0. Floats or
    (nv) arrays.
    """

    k_v: np.ndarray | float  # 1/s
    k_p: np.ndarray | float  # 1/s^2
    k_i: np.ndarray | float  # 1/s^3


@dataclasses.dataclass(frozen=True, kw_only=True)
class LawGains:
    """The published form of a law's gains (nv), from which LoopGains follow for any K_s."""

    k_d: np.ndarray
    k_p: np.ndarray  # zero for ASMC
    integral: bool  # whether the surface has its integral term
    k_s: np.ndarray  # at the start; zero for TDC
    # where adaptation is stopped; K_s itself where nothing adapts, infinite where nothing stops it
    k_s_max: np.ndarray

    def at(self, k_s: np.ndarray | float | None = None) -> LoopGains:
        """The loop gains for a K_s (default: the start's)."""
        k_s = self.k_s if k_s is None else k_s * np.ones_like(self.k_d)
        return LoopGains(
            k_v=self.k_d + k_s,
            k_p=self.k_p + k_s * self.k_d,
            k_i=k_s * self.k_p if self.integral else 0.0 * self.k_p,
        )


def law_gains(scenario: Scenario, coordinates: Coordinates) -> LawGains:
    """The gains of the scenario's controller.

    Raises ScenarioError for unknown or missing coordinates, and for a controller that is not one of
    the paper's.
    """
    name = scenario.controller
    if name not in PAPER_LAWS:
        raise ScenarioError(
            "controller",
            f"the sampled-loop margins are those of {', '.join(PAPER_LAWS)}; '{name}' is another",
        )
    gains, zero = gain_vectors(scenario, coordinates), np.zeros(len(coordinates.names))
    k_d = gains["k_d"]
    if name == "tdc":
        return LawGains(k_d=k_d, k_p=gains["k_p"], integral=False, k_s=zero, k_s_max=zero)
    if name == "asmc":
        return LawGains(k_d=k_d, k_p=zero, integral=False, k_s=gains["k_s"], k_s_max=gains["k_s"])
    k_s = gains["k_s_initial"]
    k_s_max = np.where(gains["alpha"] > 0, gains["k_s_max"], k_s)
    return LawGains(k_d=k_d, k_p=gains["k_p"], integral=True, k_s=k_s, k_s_max=k_s_max)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sampling:
    """How the loop is sampled and how N is estimated: everything in the linear loop except gains
    and inertia.
    """

    sample_time: float  # L, s
    # the plant steps as explicit Euler at the control period does, as in the paper
    euler: bool = False
    # (nv, 3, 2) of a KalmanEstimator; None: the published one-sample estimate
    kalman_gain: np.ndarray | None = None

    def axis(self, i: int) -> "Sampling":
        """The same for one coordinate."""
        return (
            self
            if self.kalman_gain is None
            else dataclasses.replace(self, kalman_gain=self.kalman_gain[i : i + 1])
        )


def axis_poles(
    gains: LoopGains,
    *,
    eta: np.ndarray | float,
    sampling: Sampling,
    sample_time: np.ndarray | float | None = None,
) -> np.ndarray:
    """Poles (..., m) of the one-axis loop, largest magnitude first.

    Args:
      gains, eta: floats, or arrays that broadcast to (...).
      sampling: of one axis.
      sample_time: s, float or (...), in place of that of ``sampling``.
    """
    step = sampling.sample_time if sample_time is None else sample_time
    given = np.broadcast_arrays(gains.k_v, gains.k_p, gains.k_i, eta, step)
    k_v, k_p, k_i, ratio, period = (
        np.array(values, dtype=float).reshape(-1, 1) for values in given
    )
    flat = LoopGains(k_v=k_v, k_p=k_p, k_i=k_i)
    if sampling.kalman_gain is None:
        matrices = _axis_matrices(flat, eta=ratio, step=period, euler=sampling.euler)
    else:
        gain = sampling.kalman_gain
        matrices = _input_output(
            flat, eta=ratio, step=period, euler=sampling.euler, kalman_gain=gain
        )[:, :, :7]
    if not k_i.any():  # the sum of errors is not fed back; its pole at 1 is not part of the loop
        matrices = np.delete(np.delete(matrices, 2, axis=1), 2, axis=2)
    poles = np.linalg.eigvals(matrices)
    poles = np.take_along_axis(poles, np.argsort(-np.abs(poles), axis=1), axis=1)
    return poles.reshape(*given[0].shape, -1)


def _axis_matrices(
    gains: LoopGains, *, eta: np.ndarray, step: np.ndarray, euler: bool
) -> np.ndarray:
    """One-sample maps (n, 4, 4) of [e, v, I, a_{k-1}] for the one-sample estimate; all arguments
    (n, 1).
    """
    row = np.hstack([-eta * gains.k_p, -eta * gains.k_v, -eta * gains.k_i, 1.0 - eta])
    matrices = np.tile(np.eye(4), (len(row), 1, 1))
    matrices[:, 0, 1] = matrices[:, 2, 0] = step[:, 0]
    matrices[:, 0] += (0.0 if euler else 0.5 * step**2) * row
    matrices[:, 1] += step * row
    matrices[:, 3] = row
    return matrices


def _scalar(law: LawGains, axis: int, k_s: np.ndarray | float) -> LoopGains:
    """One axis' gains for any shape of K_s."""
    return dataclasses.replace(law, k_d=law.k_d[axis], k_p=law.k_p[axis], k_s=np.asarray(k_s)).at()


def _root(
    function: Callable[[Any], float], low: float, high: float, *, xtol: float = 2e-12
) -> float:
    from scipy.optimize import brentq  # slow to load, and a run needs no margins

    return float(brentq(function, low, high, xtol=xtol))


def largest_stable(
    radius: Callable[[np.ndarray], np.ndarray], low: float, high: float, *, steps: int = 400
) -> float:
    """The largest x in [low, high] with radius(x) < 1; NaN where there is none, ``high`` where the
    end is stable.

    The stable set need not start at ``low``: the scan runs from the top.
    """
    grid = np.linspace(low, high, steps)
    inside = np.flatnonzero(radius(grid) < 1.0)
    if inside.size == 0:
        return float("nan")
    last = int(inside[-1])
    if last == steps - 1:
        return high
    return _root(lambda x: float(radius(x)) - 1.0, grid[last], grid[last + 1], xtol=1e-9 * high)


def largest_stable_k_s(
    law: LawGains, axis: int, *, eta: float, sampling: Sampling, ceiling: float = 1000.0
) -> float:
    """Largest K_s (1/s) that keeps one axis stable; NaN where none does. Not meaningful for TDC,
    which has no K_s.
    """
    own = sampling.axis(axis)

    def radius(k_s: np.ndarray) -> np.ndarray:
        return np.abs(axis_poles(_scalar(law, axis, k_s), eta=eta, sampling=own)[..., 0])

    return largest_stable(radius, 0.01, ceiling)


def largest_sample_time(
    law: LawGains, axis: int, *, eta: float, sampling: Sampling, ceiling: float = 0.2
) -> float:
    """Largest L (s) that keeps one axis stable at its starting gains (a Kalman gain stays what it
    is).
    """
    gains, own = _scalar(law, axis, law.k_s[axis]), sampling.axis(axis)

    def radius(step: np.ndarray) -> np.ndarray:
        return np.abs(axis_poles(gains, eta=eta, sampling=own, sample_time=step)[..., 0])

    return largest_stable(radius, 1e-5, ceiling)


def tolerated_eta(
    law: LawGains, axis: int, *, sampling: Sampling, k_s: float | None = None
) -> tuple[float, float]:
    """The interval of eta around 1 (or nearest to it, where 1 is unstable) that keeps one axis
    stable.

    eta > 1 is an over-estimated inertia, eta < 1 an under-estimated one. (NaN, NaN) where no eta in
    (0, 4) is stable.
    """
    gains, own = _scalar(law, axis, law.k_s[axis] if k_s is None else k_s), sampling.axis(axis)

    def excess(eta: float) -> float:
        return float(np.abs(axis_poles(gains, eta=eta, sampling=own)[0])) - 1.0

    grid = np.linspace(0.005, 4.0, 800)
    stable = np.abs(axis_poles(gains, eta=grid, sampling=own)[:, 0]) < 1.0
    if not stable.any():
        return float("nan"), float("nan")
    anchor = int(np.flatnonzero(stable)[np.argmin(np.abs(grid[stable] - 1.0))])
    low = high = anchor
    while low > 0 and stable[low - 1]:
        low -= 1
    while high < grid.size - 1 and stable[high + 1]:
        high += 1
    return (
        float(grid[0]) if low == 0 else _root(excess, grid[low - 1], grid[low]),
        float(grid[-1]) if high == grid.size - 1 else _root(excess, grid[high], grid[high + 1]),
    )


def inertia_ratios(true_mass_matrix: np.ndarray, nominal_mass_matrix: np.ndarray) -> np.ndarray:
    """Eigenvalues eta of H^-1 Hhat, ascending (nv): free of units, since both matrices have the
    same.
    """
    scale = np.linalg.inv(np.linalg.cholesky(true_mass_matrix))
    return np.linalg.eigvalsh(scale @ nominal_mass_matrix @ scale.T)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AxisLoop:
    """One axis near one posture, one control sample to the next:

    x+ = A x + B [position noise; velocity noise] + f d,     Hhat^-1 tau_k - a_d = force @ x_{k+1}.

    x begins with the true error e and its rate v, the sum of errors and t = Hhat^-1 tau - a_d; the
    rest is what the estimator remembers: the delayed measured rate, or [e, v, d] as estimated. The
    input d is what the controller has to estimate, -N under perfect tracking, constant over the
    sample.
    """

    a: np.ndarray  # (..., m, m), for any shape (...) of gains
    b: np.ndarray  # (..., m, 2)
    f: np.ndarray  # (..., m)
    force: np.ndarray  # (m,)
    scale: np.ndarray  # (..., m), what each entry of x gains per unit of acceleration and sample

    @functools.cached_property
    def spectral_radius(self) -> np.ndarray:
        """Largest pole magnitude (...); the loop is stable below 1."""
        return np.abs(np.linalg.eigvals(self.a)).max(axis=-1)

    def covariance(
        self, *, position_noise: np.ndarray | float, velocity_noise: np.ndarray | float
    ) -> np.ndarray:
        """Stationary covariance (..., m, m) of x under white noise of the given standard deviations
        (...).

        Of a stable loop; that of an unstable one means nothing.
        """
        noise = np.stack(np.broadcast_arrays(position_noise, velocity_noise), axis=-1)
        # In units of acceleration every entry is of order one; in SI units the equation is too
        # badly scaled to solve.
        size, largest = self.scale, noise.max(axis=-1)[..., None]
        largest = np.where(largest > 0.0, largest, 1.0)
        b = self.b * (noise / largest)[..., None, :] / size[..., :, None]
        a = self.a * size[..., None, :] / size[..., :, None]
        with np.errstate(over="ignore", invalid="ignore"):
            # stationary
            covariance = covariance_after(a, b @ np.swapaxes(b, -1, -2), samples=2**18)
            return (largest**2)[..., None] * covariance * (size[..., :, None] * size[..., None, :])


def covariance_after(a: np.ndarray, noise: np.ndarray, *, samples: int) -> np.ndarray:
    """Covariance of x from zero, x+ = A x + w, w of covariance ``noise``, after the next power of
    two of ``samples``.

    Of one A or of many (..., m, m). By doubling: the sum of A^k noise A^k' (a discrete Lyapunov
    equation where it converges). Not finite where it grows beyond all numbers.
    """
    covariance, power = noise, a
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        for _ in range(max(samples - 1, 0).bit_length()):
            covariance, power = (
                covariance + power @ covariance @ np.swapaxes(power, -1, -2),
                power @ power,
            )
    return covariance


def _input_output(
    gains: LoopGains,
    *,
    eta: np.ndarray,
    step: np.ndarray,
    euler: bool,
    kalman_gain: np.ndarray | None,
) -> np.ndarray:
    """[A, B, f] (n, m, m + 3) of one axis for n choices of gains, eta and step (n, 1),
    ``kalman_gain`` (1 or n, 3, 2).

    One sample as a function of columns of states, noises and d; its matrices are its values on unit
    columns. In error coordinates d^2e/dt^2 = -eta (t - d), where tau = Hhat (a_d + t).
    """
    size = 5 if kalman_gain is None else 7
    unit = np.eye(size + 3)[:, None, :]
    x, (e_noise, v_noise), d = unit[:size], unit[size : size + 2], unit[-1]
    e, v, total, delayed_t = x[:4]
    half = 0.0 if euler else 0.5 * step**2
    e_m, v_m = e - e_noise, v - v_noise
    if kalman_gain is None:
        delayed_v = x[4]
        # N(t - L): the measured acceleration of the last period, less what the force of that period
        # should have given.
        t = (
            gains.k_v * v_m
            + gains.k_p * e_m
            + gains.k_i * total
            + (v_m - delayed_v) / step
            + delayed_t
        )
        summed, estimator = e_m, [v_m]
    else:
        e_hat, v_hat, d_hat = x[4:]
        known = d_hat - delayed_t
        e_hat, v_hat = e_hat + step * v_hat + 0.5 * step**2 * known, v_hat + step * known
        r_e, r_v = e_m - e_hat, v_m - v_hat
        e_hat, v_hat, d_hat = (
            old + kalman_gain[:, i, :1] * r_e + kalman_gain[:, i, 1:] * r_v
            for i, old in enumerate((e_hat, v_hat, d_hat))
        )
        t = gains.k_v * v_hat + gains.k_p * e_hat + gains.k_i * total + d_hat
        summed, estimator = e_hat, [e_hat, v_hat, d_hat]
    a = eta * (d - t)
    rows = [e + step * v + half * a, v + step * a, total + step * summed, t, *estimator]
    return np.stack(np.broadcast_arrays(*rows), axis=1)


def axis_loop(gains: LoopGains, *, sampling: Sampling, eta: np.ndarray | float = 1.0) -> AxisLoop:
    """The linear loop of one axis, or of many at once.

    Args:
      gains, eta: floats, or arrays that broadcast to (...).
      sampling: period, plant and estimator, of one axis or of as many as there are gains.
    """
    period, kalman_gain = sampling.sample_time, sampling.kalman_gain
    given = np.broadcast_arrays(gains.k_v, gains.k_p, gains.k_i, eta)
    k_v, k_p, k_i, ratio = (np.array(values, dtype=float).reshape(-1, 1) for values in given)
    columns = LoopGains(k_v=k_v, k_p=k_p, k_i=k_i)
    found = _input_output(
        columns, eta=ratio, step=np.array([[period]]), euler=sampling.euler, kalman_gain=kalman_gain
    )
    found = found.reshape(*given[0].shape, *found.shape[1:])
    size = found.shape[-2]
    # Where the sum of errors is not fed back, its pole at 1 is not part of the loop.
    keep = np.array([i for i in range(size) if i != 2 or k_i.any()])
    scale = np.tile(
        [period**2, period, 1.0, 1.0, *((period,) if size == 5 else (period**2, period, 1.0))],
        (k_i.size, 1),
    )
    scale[:, 2:3] = np.divide(1.0, k_i, out=np.ones_like(k_i), where=k_i > 0.0)
    a, b, f = found[..., :size], found[..., size:-1], found[..., -1]
    return AxisLoop(
        a=a[..., keep[:, None], keep],
        b=b[..., keep, :],
        f=f[..., keep],
        force=np.eye(size)[3][keep],
        scale=scale.reshape(*given[0].shape, size)[..., keep],
    )
