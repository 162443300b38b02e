"""What a log of poses says about a gyro: its axes, bias, delay and noise. NumPy and SciPy only.

The model: the gyro's rate is w_g(t) = M w(t) + b + noise, with M from the axes of the poses to
those of the gyro, and the pose of time stamp t is the attitude at t - delay.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation, Slerp


class Fit(NamedTuple):
    axes: Rotation  # of the gyro: M
    bias: np.ndarray  # b, rad/s, gyro axes (3)
    spread: np.ndarray  # standard error of b, from fifths of the log (3)
    delay: float  # s
    off: np.ndarray  # attitude error over each window, rad (n, 3)
    windows: np.ndarray  # their lengths, s


def integrated(times, rates):
    """Attitudes (n) from rates (n, 3) by the trapezoidal rule, from the identity."""
    turns = 0.5 * (rates[1:] + rates[:-1]) * np.diff(times)[:, None]
    at, reach = Rotation.from_rotvec(np.vstack([np.zeros(3), turns])), 1
    while reach < len(times):  # each attitude is the product of twice as many turns as before
        at = Rotation.concatenate([at[:reach], at[:-reach] * at[reach:]])
        reach *= 2
    return at


def robust_deviation(values):
    """Standard deviation of each column, from the median of its magnitude."""
    return 1.4826 * np.median(np.abs(values), axis=0)


class Log(NamedTuple):
    gyro_times: np.ndarray  # s (m)
    gyro: np.ndarray  # rad/s (m, 3)
    times: np.ndarray  # of the poses, s (n)
    attitudes: Rotation  # from the axes of the poses to the world (n)

    def rates(self, at):
        return np.array([np.interp(at, self.gyro_times, each) for each in self.gyro.T]).T

    def start(self):
        """Axes from the differences of attitudes."""
        turned = (self.attitudes[:-1].inv() * self.attitudes[1:]).as_rotvec()
        posed = turned / np.diff(self.times)[:, None]
        read = self.rates(0.5 * (self.times[1:] + self.times[:-1]))
        return Rotation.align_vectors(read - read.mean(0), posed - posed.mean(0))[0]

    def errors(self, axes, bias, delay, steps):
        """Attitude errors over windows of some poses (n, 3), and how they depend on bias, axes and
        delay (n, 3, 7).
        """
        inner = slice(3, -3)  # the gyro's log covers them with any delay
        at = self.times[inner] - delay
        flown = Slerp(self.gyro_times, integrated(self.gyro_times, self.gyro - bias))(at)
        posed = axes * self.attitudes[inner] * axes.inv()
        turn, of_pose = (each[:-steps].inv() * each[steps:] for each in (flown, posed))
        rates, back = self.rates(at) - bias, turn.inv().as_matrix()
        by_delay = -rates[steps:] + np.einsum("nij,nj->ni", back, rates[:-steps])
        by_bias = -(at[steps:] - at[:-steps])[:, None, None] * np.eye(3)
        sides = [by_bias, np.eye(3) - back, by_delay[..., None]]
        return (of_pose.inv() * turn).as_rotvec(), np.concatenate(sides, axis=2)

    def fit(self, steps=5, axes=None, delay=0.0):
        """Gauss-Newton on the attitude errors, in which a large error weighs little."""
        axes, bias = axes or self.start(), np.zeros(3)
        for _ in range(5):
            off, by = self.errors(axes, bias, delay, steps)
            weight, change = np.ones(len(off)), np.zeros(7)
            for _ in range(8):
                sides, values = (by * weight[:, None, None], off * weight[:, None])
                change = np.linalg.lstsq(sides.reshape(-1, 7), -values.ravel(), rcond=None)[0]
                size = np.linalg.norm(off + by @ change, axis=1)
                weight = 1.0 / np.sqrt(1.0 + (size / np.median(size)) ** 2)
            bias, delay = bias + change[:3], delay + change[6]
            axes = Rotation.from_rotvec(change[3:6]) * axes
        off, by = self.errors(axes, bias, delay, steps)
        length = self.times[3 + steps : -3] - self.times[3 : -3 - steps]
        fifths = [np.median(each, axis=0) for each in np.array_split(off / length[:, None], 5)]
        return Fit(axes, bias, np.std(fifths, axis=0, ddof=1) / math.sqrt(5), delay, off, length)

    def noise(self, found, steps=(1, 2, 5, 10, 20, 50, 100)):
        """White noise of attitudes, rad; angle random walk, rad/sqrt(s); rate random walk,
        rad/s/sqrt(s): the variance over T is 2 a^2 + w^2 T + r^2 T^3 / 3 (mean of three axes).
        """
        sides, variances = [], []
        for each in steps:
            off, _ = self.errors(found.axes, found.bias, found.delay, each)
            length = float(np.median(self.times[each:] - self.times[:-each]))
            variance = float((robust_deviation(off) ** 2).mean())
            sides.append(np.array([2.0, length, length**3 / 3.0]) / variance)
            variances.append(1.0)
        return np.sqrt(nnls(np.array(sides), np.array(variances))[0])


def white_density(rates, period, order=8):
    """Density of the white noise, rad/s/sqrt(Hz) (3): the difference of an order that the motion
    does not reach, of standard deviation sqrt(binomial(2 n, n)) times that of a sample.
    """
    differences = robust_deviation(np.diff(rates, n=order, axis=0))
    return differences / math.sqrt(math.comb(2 * order, order)) * math.sqrt(period)
