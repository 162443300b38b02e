"""Stability of the sampled loop: time-delay control with a zero-order hold on an exactly integrated plant.

The paper's proof in continuous time does not cover a force that is held over a period. The loop is stable if the map
from one control sample to the next contracts. Near a posture, with K_s constant and no sign term, it is linear.

*One axis.* With eta an eigenvalue of H^-1 Hhat, error e, rate v = de/dt and I the sum of L e,

    a_k = (1 - eta) a_{k-1} - eta (k_v v + k_p e + k_i I),   e+ = e + L v + L^2 a / 2,   v+ = v + L a,   I+ = I + L e.

Its pole at z = -1 sets the limit (K_D + K_s) L < 2 (2 - eta) / eta.

*All coordinates.* The same with M = H^-1 Hhat in place of eta, which couples them, and with the measurement noise as
input; the covariance of its response solves a discrete Lyapunov equation.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.linalg import eigh, solve_discrete_lyapunov

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers import PAPER_LAWS, gain_vectors


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoopGains:
    """u = a_d + k_v de/dt + k_p e + k_i int e: what a law is for constant K_s and G = 0. Floats or (nv) arrays."""

    k_v: np.ndarray  # 1/s
    k_p: np.ndarray  # 1/s^2
    k_i: np.ndarray  # 1/s^3


@dataclasses.dataclass(frozen=True, kw_only=True)
class LawGains:
    """The published form of a law's gains (nv), from which LoopGains follow for any K_s."""

    k_d: np.ndarray
    k_p: np.ndarray  # zero for ASMC
    integral: bool  # whether the surface has its integral term
    k_s: np.ndarray  # at the start; zero for TDC
    k_s_max: np.ndarray  # where adaptation is stopped; K_s itself where nothing adapts, infinite where nothing stops it

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

    Raises ScenarioError for unknown or missing coordinates, and for a controller that is not one of the paper's.
    """
    name = scenario.controller
    if name not in PAPER_LAWS:
        raise ScenarioError(
            "controller", f"the sampled-loop margins are those of {', '.join(PAPER_LAWS)}; '{name}' is another"
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
    """How the loop is sampled and how N is estimated: everything in the linear loop except gains and inertia."""

    sample_time: float  # L, s
    euler: bool = False  # the plant steps as explicit Euler at the control period does, as in the paper
    kalman_gain: np.ndarray | None = None  # (nv, 3, 2) of a KalmanEstimator; None: the published one-sample estimate

    def axis(self, i: int) -> "Sampling":
        """The same for one coordinate."""
        return self if self.kalman_gain is None else dataclasses.replace(self, kalman_gain=self.kalman_gain[i : i + 1])


def axis_poles(
    gains: LoopGains, *, eta: np.ndarray | float, sampling: Sampling, sample_time: np.ndarray | float | None = None
) -> np.ndarray:
    """Poles (..., m) of the one-axis loop, largest magnitude first.

    Args:
      gains, eta: floats, or arrays that broadcast to (...).
      sampling: of one axis.
      sample_time: s, float or (...), in place of that of ``sampling``.
    """
    step = sampling.sample_time if sample_time is None else sample_time
    given = np.broadcast_arrays(gains.k_v, gains.k_p, gains.k_i, eta, step)
    k_v, k_p, k_i, ratio, period = (np.array(values, dtype=float).reshape(-1, 1) for values in given)
    flat = LoopGains(k_v=k_v, k_p=k_p, k_i=k_i)
    if sampling.kalman_gain is None:
        matrices = _axis_matrices(flat, eta=ratio, step=period, euler=sampling.euler)
    else:
        # Axes that do not meet: the coupled loop of as many coordinates, with a diagonal M.
        update = _loop_update(
            flat, lambda t: ratio * t, step=period, euler=sampling.euler, kalman_gain=sampling.kalman_gain
        )
        size, count = 7, ratio.size
        columns = update(np.kron(np.eye(size), np.ones((count, 1))), np.zeros((2 * count, 1)), np.zeros((count, 1)))
        matrices = columns.reshape(size, count, size).swapaxes(0, 1)
    if not k_i.any():  # the sum of errors is not fed back; its pole at 1 is not part of the loop
        matrices = np.delete(np.delete(matrices, 2, axis=1), 2, axis=2)
    poles = np.linalg.eigvals(matrices)
    poles = np.take_along_axis(poles, np.argsort(-np.abs(poles), axis=1), axis=1)
    return poles.reshape(*given[0].shape, -1)


def _axis_matrices(gains: LoopGains, *, eta: np.ndarray, step: np.ndarray, euler: bool) -> np.ndarray:
    """One-sample maps (n, 4, 4) of [e, v, I, a_{k-1}] for the one-sample estimate; all arguments (n, 1)."""
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


def _root(function: Callable[[Any], float], low: float, high: float, *, xtol: float = 2e-12) -> float:
    from scipy.optimize import brentq  # slow to load, and a run needs no margins

    return float(brentq(function, low, high, xtol=xtol))


def largest_stable(radius: Callable[[np.ndarray], np.ndarray], low: float, high: float, *, steps: int = 400) -> float:
    """The largest x in [low, high] with radius(x) < 1; NaN where there is none, ``high`` where the end is stable.

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


def largest_stable_k_s(law: LawGains, axis: int, *, eta: float, sampling: Sampling, ceiling: float = 1000.0) -> float:
    """Largest K_s (1/s) that keeps one axis stable; NaN where none does. Not meaningful for TDC, which has no K_s."""
    own = sampling.axis(axis)

    def radius(k_s: np.ndarray) -> np.ndarray:
        return np.abs(axis_poles(_scalar(law, axis, k_s), eta=eta, sampling=own)[..., 0])

    return largest_stable(radius, 0.01, ceiling)


def largest_sample_time(law: LawGains, axis: int, *, eta: float, sampling: Sampling, ceiling: float = 0.2) -> float:
    """Largest L (s) that keeps one axis stable at its starting gains (a Kalman gain stays what it is)."""
    gains, own = _scalar(law, axis, law.k_s[axis]), sampling.axis(axis)

    def radius(step: np.ndarray) -> np.ndarray:
        return np.abs(axis_poles(gains, eta=eta, sampling=own, sample_time=step)[..., 0])

    return largest_stable(radius, 1e-5, ceiling)


def tolerated_eta(law: LawGains, axis: int, *, sampling: Sampling, k_s: float | None = None) -> tuple[float, float]:
    """The interval of eta around 1 (or nearest to it, where 1 is unstable) that keeps one axis stable.

    eta > 1 is an over-estimated inertia, eta < 1 an under-estimated one. (NaN, NaN) where no eta in (0, 4) is stable.
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
    """Eigenvalues eta of H^-1 Hhat, ascending (nv): free of units, since both matrices have the same."""
    return eigh(nominal_mass_matrix, true_mass_matrix, eigvals_only=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CoupledLoop:
    """All coordinates near one posture, one control sample to the next:

    x+ = A x + B [position noise; velocity noise] + F d,     tau_k - Hhat a_d = force @ x_{k+1}.

    x begins with the true error e and its rate v (nv each), the sum of errors and t = Hhat^-1 tau - a_d; the rest is
    what the estimator remembers: the delayed measured rate, or [e, v, d] as estimated. The input d (nv) is what the
    controller has to estimate, -N under perfect tracking, constant over the sample.
    """

    a: np.ndarray
    b: np.ndarray
    f: np.ndarray
    force: np.ndarray
    scale: np.ndarray  # what each entry of x gains per unit of acceleration and sample
    num_velocities: int

    @functools.cached_property
    def spectral_radius(self) -> float:
        """Largest pole magnitude; the loop is stable below 1."""
        return float(np.abs(np.linalg.eigvals(self.a)).max())

    def covariance(self, *, position_noise: np.ndarray, velocity_noise: np.ndarray) -> np.ndarray:
        """Stationary covariance of x under white noise of the given standard deviations (nv); a stable loop only."""
        noise = np.concatenate([position_noise, velocity_noise])
        # In units of acceleration every entry is of order one; in SI units the equation is too badly scaled to solve.
        size = self.scale
        largest = noise.max() or 1.0
        b = self.b * (noise / largest) / size[:, None]
        a = self.a * size / size[:, None]
        covariance = solve_discrete_lyapunov(a, b @ b.T)
        return largest**2 * covariance * np.outer(size, size)

    def noise_response(self, *, position_noise: np.ndarray, velocity_noise: np.ndarray) -> dict[str, np.ndarray]:
        """Standard deviations (nv) of ``error`` (rad, m), ``error_rate`` and ``force`` (N m, N) under white noise.

        Args: the noise's standard deviations (nv), rad or m, and per s. All NaN where the loop is unstable.
        """
        n = self.num_velocities
        if self.spectral_radius >= 1.0:
            return {name: np.full(n, np.nan) for name in ("error", "error_rate", "force")}
        covariance = self.covariance(position_noise=position_noise, velocity_noise=velocity_noise)
        rms = np.sqrt(np.clip(np.diagonal(covariance), 0.0, None))
        force = np.sqrt(np.clip(np.einsum("ij,jk,ik->i", self.force, covariance, self.force), 0.0, None))
        return {"error": rms[:n], "error_rate": rms[n : 2 * n], "force": force}


def _loop_update(
    gains: LoopGains,
    accelerate: Callable[[np.ndarray], np.ndarray],
    *,
    step: np.ndarray | float,
    euler: bool,
    kalman_gain: np.ndarray | None,
) -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """One sample as a function of columns of states, noises and d; its matrices are its values on unit columns.

    In error coordinates d^2e/dt^2 = -M (t - d), where tau = Hhat (a_d + t).

    Args: gains (n, 1); ``accelerate``, the product with M; ``step``, float or (n, 1); ``kalman_gain`` (n or 1, 3, 2).
    """
    k_v, k_p, k_i = gains.k_v, gains.k_p, gains.k_i
    half = 0.0 if euler else 0.5 * step**2

    def one_sample(x: np.ndarray, noise: np.ndarray, d: np.ndarray) -> np.ndarray:
        e, v, total, delayed_t, delayed_v = np.split(x, 5)
        e_noise, v_noise = np.split(noise, 2)
        e_m, v_m = e - e_noise, v - v_noise
        u = k_v * v_m + k_p * e_m + k_i * total
        # N(t - L): the measured acceleration of the last period, less what the force of that period should have given.
        t = u + (v_m - delayed_v) / step + delayed_t
        a = accelerate(d - t)
        return np.concatenate([e + step * v + half * a, v + step * a, total + step * e_m, t, v_m])

    def kalman(x: np.ndarray, noise: np.ndarray, d: np.ndarray) -> np.ndarray:
        assert kalman_gain is not None
        e, v, total, delayed_t, e_hat, v_hat, d_hat = np.split(x, 7)
        e_noise, v_noise = np.split(noise, 2)
        known = d_hat - delayed_t
        e_hat, v_hat = e_hat + step * v_hat + 0.5 * step**2 * known, v_hat + step * known
        r = (e - e_noise - e_hat, v - v_noise - v_hat)
        e_hat, v_hat, d_hat = (
            old + kalman_gain[:, i, :1] * r[0] + kalman_gain[:, i, 1:] * r[1]
            for i, old in enumerate((e_hat, v_hat, d_hat))
        )
        t = k_v * v_hat + k_p * e_hat + k_i * total + d_hat
        a = accelerate(d - t)
        return np.concatenate([e + step * v + half * a, v + step * a, total + step * e_hat, t, e_hat, v_hat, d_hat])

    return one_sample if kalman_gain is None else kalman


def coupled_loop(
    gains: LoopGains,
    *,
    true_mass_matrix: np.ndarray,
    nominal_mass_matrix: np.ndarray,
    sampling: Sampling,
) -> CoupledLoop:
    """The linear loop of all coordinates at rest in one posture.

    Args:
      gains: of the law, floats or (nv).
      true_mass_matrix, nominal_mass_matrix: H and Hhat (nv, nv) in that posture.
      sampling: period, plant and estimator.
    """
    n, step, kalman_gain = true_mass_matrix.shape[0], sampling.sample_time, sampling.kalman_gain
    m = np.linalg.solve(true_mass_matrix, nominal_mass_matrix)
    k_v, k_p, k_i = ((k * np.ones(n))[:, None] for k in (gains.k_v, gains.k_p, gains.k_i))
    columns = LoopGains(k_v=k_v, k_p=k_p, k_i=k_i)
    update = _loop_update(columns, lambda t: m @ t, step=step, euler=sampling.euler, kalman_gain=kalman_gain)
    blocks = 5 if kalman_gain is None else 7
    size = blocks * n
    sizes = (size, 2 * n, n)
    a, b, f = (
        update(*(np.eye(rows) if i == j else np.zeros((rows, sizes[j])) for i, rows in enumerate(sizes)))
        for j in range(3)
    )
    keep = np.ones(size, dtype=bool)
    # Where the sum of errors is not fed back, its pole at 1 is not part of the loop.
    keep[2 * n : 3 * n] = k_i[:, 0] > 0.0
    scale = np.repeat([step**2, step, 0.0, 1.0, *((step,) if blocks == 5 else (step**2, step, 1.0))], n)
    scale[2 * n : 3 * n] = 1.0 / np.where(k_i[:, 0] > 0.0, k_i[:, 0], 1.0)
    force = np.zeros((n, size))
    force[:, 3 * n : 4 * n] = nominal_mass_matrix
    return CoupledLoop(
        a=a[np.ix_(keep, keep)],
        b=b[keep],
        f=f[keep],
        force=force[:, keep],
        scale=scale[keep],
        num_velocities=n,
    )
