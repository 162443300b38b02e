"""Stability of the sampled loop: time-delay control with a zero-order hold on an exactly integrated plant.

A held force makes the paper's continuous-time proof silent: what decides is whether the map from one control sample to
the next contracts. Near a posture, with K_s constant and the sign term left out, that map is linear.

*One axis.* With eta an eigenvalue of H^-1 Hhat, error e, rate v = de/dt and I the sum of L e,

    a_k = (1 - eta) a_{k-1} - eta (k_v v + k_p e + k_i I),   e+ = e + L v + L^2 a / 2,   v+ = v + L a,   I+ = I + L e.

Its pole at z = -1 sets the limit (K_D + K_s) L < 2 (2 - eta) / eta.

*All coordinates.* The same with M = H^-1 Hhat in place of eta, which couples them, and with the measurement noise as
input; the covariance of its response solves a discrete Lyapunov equation.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.linalg import eigh, solve_discrete_lyapunov
from scipy.optimize import brentq

from ffsm_drake.coordinates import Coordinates
from ffsm_drake.scenario import Scenario


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
    """The gains of the scenario's controller. Raises ScenarioError for unknown or missing coordinates."""
    name = scenario.controller
    gains = getattr(scenario.controllers, name)

    def vector(field: str, default: float | None = None) -> np.ndarray:
        return coordinates.vector(getattr(gains, field) or {}, key=f"controllers.{name}.{field}", default=default)

    k_d, zero = vector("k_d"), np.zeros(len(coordinates.names))
    if name == "tdc":
        return LawGains(k_d=k_d, k_p=vector("k_p"), integral=False, k_s=zero, k_s_max=zero)
    if name == "asmc":
        return LawGains(k_d=k_d, k_p=zero, integral=False, k_s=vector("k_s"), k_s_max=vector("k_s"))
    k_s = vector("k_s_initial")
    adapts = vector("alpha") > 0
    k_s_max = np.where(adapts, vector("k_s_max", np.inf), k_s)
    return LawGains(k_d=k_d, k_p=vector("k_p"), integral=True, k_s=k_s, k_s_max=k_s_max)


def axis_matrix(gains: LoopGains, *, eta: float, sample_time: float, euler: bool = False) -> np.ndarray:
    """One-sample map (4, 4) of [e, v, I, a_{k-1}] for scalar gains; without I where k_i is zero.

    ``euler``: the plant steps as explicit Euler at the control period does.
    """
    row = np.array([-eta * gains.k_p, -eta * gains.k_v, -eta * gains.k_i, 1.0 - eta], dtype=float)
    step = sample_time
    matrix = np.zeros((4, 4))
    matrix[0] = np.array([1.0, step, 0.0, 0.0]) + (0.0 if euler else 0.5 * step**2) * row
    matrix[1] = np.array([0.0, 1.0, 0.0, 0.0]) + step * row
    matrix[2] = [step, 0.0, 1.0, 0.0]
    matrix[3] = row
    if gains.k_i == 0.0:  # the sum of errors feeds nothing back; its pole at 1 is no part of the loop
        return np.delete(np.delete(matrix, 2, axis=0), 2, axis=1)
    return matrix


def axis_poles(gains: LoopGains, *, eta: float, sample_time: float, euler: bool = False) -> np.ndarray:
    """Poles of the one-axis loop, largest magnitude first."""
    poles = np.linalg.eigvals(axis_matrix(gains, eta=eta, sample_time=sample_time, euler=euler))
    return poles[np.argsort(-np.abs(poles))]


def is_stable(gains: LoopGains, *, eta: float, sample_time: float, euler: bool = False) -> bool:
    """Whether every pole of the one-axis loop lies inside the unit circle."""
    return bool(np.abs(axis_poles(gains, eta=eta, sample_time=sample_time, euler=euler)[0]) < 1.0)


def _scalar(law: LawGains, axis: int, k_s: float) -> LoopGains:
    gains = law.at(k_s)
    return LoopGains(k_v=gains.k_v[axis], k_p=gains.k_p[axis], k_i=gains.k_i[axis])


def largest_stable(radius: Callable[[float], float], low: float, high: float, *, steps: int = 400) -> float:
    """The largest x in [low, high] with radius(x) < 1; NaN where there is none, ``high`` where the end is stable.

    The stable set need not start at ``low``: the scan runs from the top.
    """
    grid = np.linspace(low, high, steps)
    values = np.array([radius(x) for x in grid]) - 1.0
    inside = np.flatnonzero(values < 0.0)
    if inside.size == 0:
        return float("nan")
    last = int(inside[-1])
    if last == steps - 1:
        return high
    return float(brentq(lambda x: radius(x) - 1.0, grid[last], grid[last + 1], xtol=1e-9 * high))


def largest_stable_k_s(
    law: LawGains, axis: int, *, eta: float, sample_time: float, euler: bool = False, ceiling: float = 1000.0
) -> float:
    """Largest K_s (1/s) that keeps one axis stable; NaN where none does. Not meaningful for TDC, which has no K_s."""

    def radius(k_s: float) -> float:
        poles = axis_poles(_scalar(law, axis, k_s), eta=eta, sample_time=sample_time, euler=euler)
        return float(np.abs(poles[0]))

    return largest_stable(radius, 0.01, ceiling)


def largest_sample_time(law: LawGains, axis: int, *, eta: float, euler: bool = False, ceiling: float = 0.2) -> float:
    """Largest L (s) that keeps one axis stable at its starting gains."""
    gains = _scalar(law, axis, float(law.k_s[axis]))

    def radius(step: float) -> float:
        return float(np.abs(axis_poles(gains, eta=eta, sample_time=step, euler=euler)[0]))

    return largest_stable(radius, 1e-5, ceiling)


def tolerated_eta(
    law: LawGains, axis: int, *, sample_time: float, k_s: float | None = None, euler: bool = False
) -> tuple[float, float]:
    """The interval of eta around 1 (or below it, where 1 is unstable) that keeps one axis stable.

    eta > 1 is an over-estimated inertia, eta < 1 an under-estimated one. (NaN, NaN) where no eta in (0, 2) is stable.
    """
    gains = _scalar(law, axis, float(law.k_s[axis]) if k_s is None else k_s)

    def excess(eta: float) -> float:
        return float(np.abs(axis_poles(gains, eta=eta, sample_time=sample_time, euler=euler)[0])) - 1.0

    grid = np.linspace(0.005, 2.0, 400)
    stable = np.array([excess(eta) < 0.0 for eta in grid])
    if not stable.any():
        return float("nan"), float("nan")
    anchor = int(np.flatnonzero(stable)[np.argmin(np.abs(grid[stable] - 1.0))])
    low = high = anchor
    while low > 0 and stable[low - 1]:
        low -= 1
    while high < grid.size - 1 and stable[high + 1]:
        high += 1
    return (
        float(grid[0]) if low == 0 else float(brentq(excess, grid[low - 1], grid[low])),
        float(grid[-1]) if high == grid.size - 1 else float(brentq(excess, grid[high], grid[high + 1])),
    )


def inertia_ratios(true_mass_matrix: np.ndarray, nominal_mass_matrix: np.ndarray) -> np.ndarray:
    """Eigenvalues eta of H^-1 Hhat, ascending (nv): free of units, since both matrices have the same."""
    return eigh(nominal_mass_matrix, true_mass_matrix, eigvals_only=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CoupledLoop:
    """All coordinates at one posture: x+ = A x + B [position noise; velocity noise].

    x = [e, v, I, a_{k-1}, w_{k-1}] with e, v the true error and its rate, w the velocity noise of the last sample
    (which the differentiated velocity still holds); force is tau_k = H a_k.
    """

    a: np.ndarray
    b: np.ndarray
    force: np.ndarray  # tau_k = force @ x_{k+1}
    scale: np.ndarray  # what each entry of x gains per unit of acceleration and sample
    num_velocities: int

    @property
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


def coupled_loop(
    gains: LoopGains,
    *,
    true_mass_matrix: np.ndarray,
    nominal_mass_matrix: np.ndarray,
    sample_time: float,
    euler: bool = False,
) -> CoupledLoop:
    """The linear loop of all coordinates at rest in one posture (mass matrices (nv, nv) there)."""
    n, step = true_mass_matrix.shape[0], sample_time
    eye, zero = np.eye(n), np.zeros((n, n))
    m = np.linalg.solve(true_mass_matrix, nominal_mass_matrix)
    k_v, k_p, k_i = (np.diag(k * np.ones(n)) for k in (gains.k_v, gains.k_p, gains.k_i))
    # In error coordinates, a = d^2 e / dt^2. Measured: e - p and v - w, so that the measured acceleration of the last
    # period is a_{k-1} - (w_k - w_{k-1}) / L, and
    # a_k = (1 - M) a_{k-1} + M (w_k - w_{k-1}) / L - M (k_v (v - w) + k_p (e - p) + k_i I).
    row = np.hstack([-m @ k_p, -m @ k_v, -m @ k_i, eye - m, -m / step])
    row_noise = np.hstack([m @ k_p, m @ k_v + m / step])
    a = np.zeros((5 * n, 5 * n))
    b = np.zeros((5 * n, 2 * n))
    half = 0.0 if euler else 0.5 * step**2
    a[:n] = np.hstack([eye, step * eye, zero, zero, zero]) + half * row
    b[:n] = half * row_noise
    a[n : 2 * n] = np.hstack([zero, eye, zero, zero, zero]) + step * row
    b[n : 2 * n] = step * row_noise
    a[2 * n : 3 * n] = np.hstack([step * eye, zero, eye, zero, zero])
    b[2 * n : 3 * n] = np.hstack([-step * eye, zero])
    a[3 * n : 4 * n] = row
    b[3 * n : 4 * n] = row_noise
    b[4 * n :] = np.hstack([zero, eye])
    keep = np.ones(5 * n, dtype=bool)
    # Where nothing reads the sum of errors, its pole at 1 is no part of the loop.
    keep[2 * n : 3 * n] = np.diagonal(k_i) > 0.0
    force = np.hstack([zero, zero, zero, true_mass_matrix, zero])
    scale = np.repeat([step**2, step, step**3, 1.0, step], n)
    return CoupledLoop(a=a[np.ix_(keep, keep)], b=b[keep], force=force[:, keep], scale=scale[keep], num_velocities=n)
