"""The signed power |x|^p sgn x with a boundary layer, in which it is linear."""

import numpy as np


def signed_power(x: np.ndarray, power: float, width: np.ndarray | float) -> np.ndarray:
    """x (x^2 + width^2)^((power - 1) / 2), (..., n): |x|^power sgn x for |x| far above ``width``.

    At zero its slope is width^(power - 1). A power of 0 gives a smooth sign, x / sqrt(x^2 +
    width^2).
    """
    scale: np.ndarray = (x * x + width * width) ** (0.5 * (power - 1.0))
    return x * scale


def slope(x: np.ndarray, power: float, width: np.ndarray | float) -> np.ndarray:
    """The derivative of ``signed_power`` with respect to x, (..., n)."""
    square = x * x + width * width
    return square ** (0.5 * (power - 3.0)) * (power * x * x + width * width)


def check_powers(near: np.ndarray | float, far: np.ndarray | float) -> None:
    """Raise ValueError unless the power of small errors is below 1, and the other above 1."""
    if not (np.all(near < 1.0) and np.all(far > 1.0)):
        raise ValueError(f"power must be below 1 and far_power above, not {near} and {far}")
