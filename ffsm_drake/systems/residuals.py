"""What residuals over a window say about faults: pure functions of arrays.

The unexplained velocity Y(t) = sum (dv - L H^-1 (tau - C)), with tau as told to the actuators and
H, C of the nominal masses, is noise where all works. Where thruster i fires though told not to it
grows by theta a_i (F_i t - I_i), where it gives too little by -theta a_i I_i (a_i: acceleration
of its unit force; I_i: impulse as told; F_i: its force). Of each such hypothesis g the best theta,
at most 1, and what it explains of Y,

    theta = g' M Y / g' M g,    J = 2 theta g' M Y - theta^2 g' M g,

with M the inverse of Y's covariance after a constant is taken out: white noise, and an acceleration
that nobody told of and that drifts. J is the square of a number of standard deviations: the
generalized likelihood ratio of one unknown size.
"""

import dataclasses

import numpy as np

LEAST_LEAK, LEAST_LOSS, WHOLE = 0.08, 0.3, 0.75  # shares theta that count, that are all of it
_MARGIN = 9.0  # by which J of one thruster exceeds that of all others where it is isolated
_LEFT = 2.0  # times its share of the noise that may be left, or as much as is explained


def times_of(count: int, step: float) -> np.ndarray:
    """Of blocks, from their mean (count), s."""
    return step * (np.arange(count) - 0.5 * (count - 1))


def noise_of(values: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Standard deviation of white noise on what changes slowly (n, ...); few values tell little:
    at least what is known from before.
    """
    return np.maximum(np.sqrt((np.diff(values, n=2, axis=0) ** 2).mean(axis=0) / 6.0), least)


def slope_of(
    values: np.ndarray, step: float, least: np.ndarray | float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The slope of values (n, ...) that are a time apart, and its standard deviation, with at
    least a noise of each value.
    """
    time = times_of(len(values), step)
    square, noise = float(time @ time), noise_of(values, np.asarray(least))
    return np.tensordot(time, values, axes=1) / square, noise / np.sqrt(square)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Suspicion:
    """The best hypothesis on thrusters."""

    explained: float  # J
    is_isolated: bool  # it is one thruster, and explains what is seen
    thruster: int
    kind: str
    theta: float


def suspect(
    unexplained: np.ndarray,
    told: np.ndarray,
    *,
    pushes: np.ndarray,
    force: np.ndarray,
    external: np.ndarray,
    least_noise: np.ndarray,
    in_use: np.ndarray,
    step: float,
) -> Suspicion:
    """The hypothesis on thrusters that explains most of a window of blocks.

    Args: Y (m, nv), rad/s and m/s, and impulses as told (m, n), N s, of blocks; a (nv, n); F (n),
      N; standard deviations of the acceleration that nobody told of (nv) and, at least, of Y
      (nv); which thrusters are looked at (n); time between blocks, s.
    """
    time = times_of(len(unexplained), step)
    noise = noise_of(unexplained, least_noise)
    y, fired = (unexplained - unexplained.mean(axis=0)) / noise, told - told.mean(axis=0)
    shapes = np.hstack([time[:, None] * force - fired, -fired])  # (m, 2 n)
    directions = np.tile(pushes, 2).T / noise  # (2 n, nv)
    product, size, total = shapes.T @ y, (shapes**2).sum(axis=0)[:, None], (y**2).sum()
    # what a constant acceleration that nobody told of may explain, and one that drifts
    for regressor, most in ((time, external), (time**2 - (time**2).mean(), 0.5 * external)):
        kept = 1.0 / (regressor @ regressor + (noise / np.maximum(most, 1e-12)) ** 2)
        of_shapes, of_y = regressor @ shapes, regressor @ y
        product = product - np.outer(of_shapes, kept * of_y)  # (2 n, nv)
        size = size - np.outer(of_shapes**2, kept)
        total -= (kept * of_y**2).sum()
    product, size = (product * directions).sum(axis=1), (size * directions**2).sum(axis=1)
    known = np.tile(in_use, 2) & (size > 1.0)  # a share of 1 is a standard deviation or more
    theta = np.clip(np.where(known, product / np.where(known, size, 1.0), 0.0), 0.0, 1.0)
    count = force.size
    least = np.repeat([LEAST_LEAK, LEAST_LOSS], count)
    explained = np.where(theta >= least, theta * (2.0 * product - theta * size), 0.0)
    best = int(explained.argmax())
    others = np.tile(np.arange(count), 2) != best % count
    rest = total - explained[best]
    names = ("stuck_on", "leaking") if best < count else ("stuck_off", "weak")
    return Suspicion(
        explained=float(explained[best]),
        is_isolated=bool(
            explained[best] - explained[others].max(initial=0.0) > _MARGIN
            and rest < max(_LEFT * y.size, explained[best])
        ),
        thruster=best % count,
        kind=names[0] if theta[best] > WHOLE else names[1],
        theta=float(theta[best]),
    )


class Observer:
    """Velocities from measured positions and expected changes: three equal poles for each
    coordinate, so that a constant force that nobody told of leaves no error.
    """

    def __init__(self, bandwidth: np.ndarray, sample_time: float) -> None:
        """Args: of each coordinate (nv), rad/s; s."""
        w = bandwidth
        self._step = sample_time
        self._gains = 3.0 * w * sample_time, 3.0 * w**2 * sample_time, w**3 * sample_time

    def step(
        self, v: np.ndarray, a: np.ndarray, *, expected: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """How far (nv) the positions move in a sample, and the velocity (nv) at its end, from the
        velocity at its start, an unmodelled acceleration and an expected change of velocity.
        """
        change = expected + self._step * a
        return self._step * (v + 0.5 * change), v + change

    def corrections(self, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of position, velocity and acceleration, from how far (nv) the position is seen ahead."""
        of_q, of_v, of_a = (gain * seen for gain in self._gains)
        return of_q, of_v, of_a
