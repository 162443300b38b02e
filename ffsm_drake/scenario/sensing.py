"""The sections ``sensing``, ``estimator`` and ``command_filter``: the controller's inputs and the
filters of its output.
"""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from ffsm_drake.common.settings import Problems, setting
from ffsm_drake.scenario.fields import (
    ZERO,
    PerCoordinate,
    choice_of,
    in_samples,
    sample_problems,
    unitless,
)

DENSITIES = ("velocity_noise", "position_noise")
TIMES = ("delay", "velocity_delay", "position_delay", "velocity_period", "position_period")
# Keys of ``Sensing`` in control samples -> the keys that replace them at any sample time.
FURTHER = {name: f"{name}_time" for name in TIMES} | {name: f"{name}_density" for name in DENSITIES}
ESTIMATOR_KINDS = ("one_sample", "kalman", "coupled")


@dataclass
class Estimator:
    """Estimator of the lumped uncertainty N in equation (2)."""

    KIND: ClassVar[str] = "kind"  # another one drops the inherited settings

    kind: str = choice_of(
        "one_sample",
        'kind of estimator: "one_sample", equation (5) of the paper; "kalman", one Kalman filter '
        'for each coordinate; "coupled", one filter for attitude and joints together',
        *ESTIMATOR_KINDS,
    )
    walk: PerCoordinate = setting(
        {"base_position": 1e-3, "base_rotation": 1e-3, "joints": 1e-2},
        "rad/s^2 or m/s^2 per sqrt(s)",
        "standard deviation of the random walk of N after one second, for kalman, and for the base "
        "position with coupled; values that differ between base axes are along the axes of the "
        "base",
        above=0,
    )
    force_walk: PerCoordinate = setting(
        {"all": 0.2},
        "N m or N per sqrt(s)",
        "standard deviation after one second of the random walk of the force equivalent to N in "
        "attitude and joints; only for coupled",
        above=0,
    )
    position_noise: PerCoordinate | None = setting(
        None,
        "rad or m",
        "assumed standard deviation of measured positions; only for kalman and coupled; null: "
        "as in "
        "``sensing``",
        least=0,
    )
    velocity_noise: PerCoordinate | None = setting(
        None,
        "rad/s or m/s",
        "assumed standard deviation of measured velocities; only for kalman and coupled; null: as "
        "in ``sensing``",
        least=0,
    )
    velocity_bias_walk: PerCoordinate = setting(
        ZERO,
        "rad/s or m/s per sqrt(s)",
        "standard deviation after one second of the random walk of a velocity bias, which kalman "
        "and coupled estimate together with N; for the base in its axes; 0: no bias is estimated",
        least=0,
    )
    delay: int | None = in_samples(
        None,
        "assumed age of the measurements, from which the filter predicts the present state; null: "
        "``sensing.delay``",
    )


@dataclass
class Barriers:
    """Control barrier functions, which change the commanded force of the joints as little as
    possible to keep them within their limits of position, rate and force.
    """

    decay: PerCoordinate = setting(
        {"all": 2.0},
        "1/s",
        "decay rate of the distance to a position limit, twice: a joint approaches its limit at "
        "most at this rate times the distance",
        above=0,
    )
    rate_decay: PerCoordinate = setting(
        {"all": 10.0}, "1/s", "decay rate of the distance to a rate limit", above=0
    )
    margin: PerCoordinate = setting(
        {"all": 0.01},
        "rad/s^2 or m/s^2",
        "bound of the error of the acceleration that the nominal model predicts",
        least=0,
    )
    lower: PerCoordinate = setting(
        {}, "rad or m", "lower position limit, in addition to the limit of the model"
    )
    upper: PerCoordinate = setting(
        {}, "rad or m", "upper position limit, in addition to the limit of the model"
    )
    rate: PerCoordinate = setting(
        {}, "rad/s or m/s", "rate limit, in addition to the limits of model and drives", above=0
    )


@dataclass
class CommandFilter:
    """Filters of the force that the control law commands, before any actuator. Stability and noise
    analyses include them, except the barriers.
    """

    low_pass: PerCoordinate = setting(
        ZERO, "Hz", "cut-off frequency of a first-order low-pass filter; 0: no filter", least=0
    )
    notch: PerCoordinate = setting(
        ZERO, "Hz", "centre frequency of a notch filter; 0: no filter", least=0
    )
    notch_width: PerCoordinate = unitless(
        {"all": 0.5}, "width of the notch at half power, divided by its centre frequency", above=0
    )
    barriers: Barriers | None = unitless(
        None, "barriers that keep the joints within their limits, after the filters; null: none"
    )


def _value(values: PerCoordinate, key: str) -> float | None:
    """Return the value of a coordinate or group, which its group or ``all`` may give."""
    stem = key.rstrip("_xyz")
    group = stem if stem in ("all", "base_rotation", "base_position") else "joints"
    return values.get(key, values.get(group, values.get("all")))


def _per_sample(name: str, value: float, sample_time: float, period: float = 1) -> float:
    value = value if 0.0 <= value < math.inf else 0.0  # a wrong one is refused by its own key
    if name in DENSITIES:
        return value / math.sqrt(sample_time * period)
    return int(math.ceil(value / sample_time - 1e-6) or name.endswith("period"))


def _instead(of: str, unit: str = "s", meaning: str = "time, in whole control samples,") -> Any:
    return setting(
        None, unit, f"{meaning} that sets ``{of}`` for its coordinates; null: it does not", least=0
    )


# Begins the meaning of a density.
_DENSITY = "density of white noise, divided by the square root of the time between measurements,"


@dataclass
class Sensing:
    """The errors of the sensors, in this order: bias, noise, quantisation, sampling and delay.

    Errors of the base sensors are along the axes of the base and turn with them.
    """

    velocity_noise: PerCoordinate = setting(
        {"all": 1e-6},
        "rad/s or m/s",
        "standard deviation of the white noise on measured velocities, independent for each "
        "coordinate and control sample; for the base along its axes",
        least=0,
    )
    position_noise: PerCoordinate = setting(
        ZERO,
        "rad or m",
        "standard deviation of the white noise on measured positions, independent for each "
        "coordinate and control sample; one value for all three base rotations",
        least=0,
    )
    velocity_bias: PerCoordinate = setting(
        ZERO,
        "rad/s or m/s",
        "constant error of measured velocities; for the base along its axes, so base_rotation_z is "
        "the bias of the gyro about z",
    )
    position_bias: PerCoordinate = setting(
        ZERO,
        "rad or m",
        "constant error of measured positions; for the base along its axes; the base rotations are "
        "a rotation vector",
    )
    velocity_bias_walk: PerCoordinate = setting(
        ZERO,
        "rad/s or m/s per sqrt(s)",
        "standard deviation after one second of the random walk of the velocity bias (rate random "
        "walk of a gyro); for the base along its axes",
        least=0,
    )
    velocity_correlated_noise: PerCoordinate = setting(
        ZERO,
        "rad/s or m/s",
        "standard deviation of noise on measured velocities that is correlated in time, in "
        "addition "
        "to the white noise; for the base along its axes",
        least=0,
    )
    position_correlated_noise: PerCoordinate = setting(
        ZERO,
        "rad or m",
        "standard deviation of noise on measured positions that is correlated in time, in addition "
        "to the white noise; one value for all three base rotations",
        least=0,
    )
    correlation_time: PerCoordinate = setting(
        {"all": 1.0}, "s", "time constant of the correlated noise of first order", above=0
    )
    velocity_quantization: PerCoordinate = setting(
        ZERO,
        "rad/s or m/s",
        "quantisation step of measured velocities; for the base along its axes; 0: none",
        least=0,
    )
    position_quantization: PerCoordinate = setting(
        ZERO,
        "rad or m",
        "quantisation step of measured positions, except base rotations; for the base along its "
        "axes; 0: none",
        least=0,
    )
    velocity_period: dict[str, int] = in_samples(
        {"all": 1},
        "period of the velocity measurements; one value for the three base rotations, and one for "
        "the three base positions",
        least=1,
    )
    position_period: dict[str, int] = in_samples(
        {"all": 1},
        "period of the position measurements; one value for the three base "
        "rotations, and "
        "one for the three base positions",
        least=1,
    )
    delay: int = in_samples(0, "age of every measurement when the controller first reads it")
    velocity_delay: dict[str, int] = in_samples(
        {"all": 0}, "age of measured velocities in addition to ``delay``"
    )
    position_delay: dict[str, int] = in_samples(
        {"all": 0}, "age of measured positions in addition to ``delay``"
    )
    velocity_noise_density: PerCoordinate | None = _instead(
        "velocity_noise", "rad/s or m/s per sqrt(Hz)", _DENSITY
    )
    position_noise_density: PerCoordinate | None = _instead(
        "position_noise", "rad or m per sqrt(Hz)", _DENSITY
    )
    delay_time: float | None = _instead("delay")
    velocity_delay_time: PerCoordinate | None = _instead("velocity_delay")
    position_delay_time: PerCoordinate | None = _instead("position_delay")
    velocity_period_time: PerCoordinate | None = _instead("velocity_period")
    position_period_time: PerCoordinate | None = _instead("position_period")

    def at(self, sample_time: float) -> "Sensing":
        """Return the sensors with their densities and times as values of control samples."""
        found = dict(vars(self))
        for name, other in FURTHER.items():
            given, own, period = found[other], found[name], found.get(f"{name[:8]}_period", {})
            if isinstance(given, dict):
                found[name] = own | {
                    key: _per_sample(name, value, sample_time, abs(_value(period, key) or 1))
                    for key in own | period | given
                    if (value := _value(given, key)) is not None
                }
            elif given is not None:
                found[name] = _per_sample(name, given, sample_time)
        return Sensing(**found)

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that times are whole numbers of control samples."""
        for name in TIMES:
            given = getattr(self, FURTHER[name])
            each = given if isinstance(given, dict) else {"": given}
            for inner, time in each.items():
                if time:
                    place = f"{key}.{FURTHER[name]}.{inner}".rstrip(".")
                    yield from sample_problems(time, scenario.sample_time, place)
