"""The stability proof of Section 3.2, evaluated on what happened: equations (7) and (12) to (16), and Lemma 1.

N* is the bound on the TDE errors; here, the one found in the run. The arrays are samples (n, nv) of s, K_s, G.
"""

import dataclasses

import numpy as np


def reaching_law_remainder(
    *, s: np.ndarray, k_s: np.ndarray, g: np.ndarray, tde_error: np.ndarray, period: float
) -> np.ndarray:
    """What equation (7) leaves out, per period (n - 1, nv): (s_{k+1} - s_k) / L + Ntilde + K_s s + G sgn s.

    (7) is about continuous time. Over a period, s also changes by what de/dt and d^2e/dt^2 vary within it, the noise of
    two measurements, and on a plant stepped by explicit Euler the step's own error.
    """
    return np.diff(s, axis=0) / period + tde_error + (k_s * s + g * np.sign(s))[:-1]


def outside(s: np.ndarray, k_s: np.ndarray, *, beta: np.ndarray, epsilon: float) -> np.ndarray:
    """Which coordinates are outside |s_i| <= max(K_si / beta_i, epsilon), (n, nv)."""
    return np.abs(s) > np.maximum(k_s / beta, epsilon)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lyapunov:
    """V of equation (12) at every sample, and its rate over every period."""

    value: np.ndarray  # V (n)
    rate_of_s: np.ndarray  # s^T ds/dt (n - 1), the first term of equation (13)
    rate_of_k_s: np.ndarray  # (n - 1), the second
    rate_of_g: np.ndarray  # (n - 1), the third

    @property
    def rate(self) -> np.ndarray:
        """dV/dt of equation (13), (V_{k+1} - V_k) / L, (n - 1)."""
        return self.rate_of_s + self.rate_of_k_s + self.rate_of_g


def lyapunov(
    *, s: np.ndarray, k_s: np.ndarray, g: np.ndarray, alpha: np.ndarray, phi: np.ndarray, bound: float, period: float
) -> Lyapunov:
    """Evaluate (12) and (13) on samples.

    The rates are differences over the period, so that their sum is the change of V. A gain that does not adapt
    (alpha_i or phi_i zero) has no term: it is constant, and its quotient is not a number.
    """

    def term(distance: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        weight = np.divide(1.0, rate, out=np.zeros_like(rate), where=rate > 0.0)
        middle = 0.5 * (distance[1:] + distance[:-1])
        value = 0.5 * (weight * distance**2).sum(axis=1)
        return value, (weight * middle * np.diff(distance, axis=0)).sum(axis=1) / period

    parts = [term(s, np.ones_like(alpha)), term(k_s - bound, alpha), term(g - bound, phi)]
    return Lyapunov(
        value=np.sum([value for value, _ in parts], axis=0),
        rate_of_s=parts[0][1],
        rate_of_k_s=parts[1][1],
        rate_of_g=parts[2][1],
    )


def ultimate_bound(*, bound: float, alpha: np.ndarray, beta: np.ndarray, phi: np.ndarray, epsilon: float) -> float:
    """The bound on ||s||_2 of equation (16). Infinite where a gain does not adapt."""
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = np.maximum(bound / beta, epsilon) ** 2 + bound**2 / alpha + bound**2 / phi
    return float(np.sqrt(np.where(np.isnan(squares), np.inf, squares).sum()))


def direct_bound(*, first: np.ndarray, bound: np.ndarray, k_s_min: np.ndarray, g_min: np.ndarray) -> np.ndarray:
    """Bound on |s_i| (nv) that follows from equation (7) alone: max(|s_i(0)|, (N*_i - G_i)^+ / K_si).

    Beyond it d|s_i|/dt <= N*_i - G_i - K_si |s_i| < 0. Neither adaptation nor V is needed, but (7) must hold as it
    stands, which it does in continuous time only.

    Args: s at the start, N* by coordinate, and the smallest K_s and G of the run, all (nv).
    """
    excess = np.maximum(bound - g_min, 0.0)
    # 0 / 0 is no excess at all; anything else over 0 is no bound at all.
    steady = np.divide(excess, k_s_min, out=np.where(excess > 0.0, np.inf, 0.0), where=k_s_min > 0.0)
    return np.maximum(np.abs(first), steady)
