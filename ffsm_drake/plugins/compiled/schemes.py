"""The integrators of compiled runs."""

import math
from typing import NamedTuple


class Scheme(NamedTuple):
    """A Runge-Kutta scheme with the derivatives k0 (at the step's begin), k1, ..."""

    times: tuple[float, ...]  # of the derivatives, in steps
    # weights of the derivatives: for the point of each further derivative, and for the step's end
    points: tuple[tuple[float, ...], ...]


SCHEMES = {
    "explicit_euler": Scheme((0.0,), ((1.0,),)),
    "runge_kutta2": Scheme((0.0, 1.0), ((1.0,), (0.5, 0.5))),
    "runge_kutta3": Scheme(
        (0.0, 0.5, 1.0), ((0.5,), (-1.0, 2.0), (1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0))
    ),
    "runge_kutta5": Scheme(  # of Dormand and Prince
        (0.0, 1.0 / 5.0, 3.0 / 10.0, 4.0 / 5.0, 8.0 / 9.0, 1.0),
        (
            (1.0 / 5.0,),
            (3.0 / 40.0, 9.0 / 40.0),
            (44.0 / 45.0, -56.0 / 15.0, 32.0 / 9.0),
            (19372.0 / 6561.0, -25360.0 / 2187.0, 64448.0 / 6561.0, -212.0 / 729.0),
            (9017.0 / 3168.0, -355.0 / 33.0, 46732.0 / 5247.0, 49.0 / 176.0, -5103.0 / 18656.0),
            (35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0),
        ),
    ),
}


def steps_of(sample_time: float, longest: float, per_sample: int = 1) -> int:
    """Steps of the integrator in a control sample; 0: they do not divide it.

    Args: the sample and a step at most, s; the number of parts of a sample that have equal steps.
    """
    if per_sample > 1:
        return per_sample * steps_of(sample_time / per_sample, longest)
    steps = max(1, math.ceil(sample_time / longest - 1e-9))
    return steps if steps == 1 or abs(steps * longest / sample_time - 1.0) < 1e-9 else 0
