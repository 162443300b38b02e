"""The sections ``sensing``, ``estimator`` and ``command_filter``: the controller's inputs and the
filters of its output.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from ffsm_drake.common.settings import Problems, join, setting
from ffsm_drake.scenario.fields import ZERO, PerCoordinate, choice_of, in_samples, unitless

# Keys of ``Sensing`` that also have ``<key>_density``, and those that have ``<key>_time``.
DENSITIES = ("velocity_noise", "position_noise")
TIMES = ("delay", "velocity_delay", "position_delay", "velocity_period", "position_period")
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
        "assumed age of the measurements, from which kalman predicts the present state; null: "
        "``sensing.delay``",
    )


@dataclass
class CommandFilter:
    """Filters of the force that the control law commands, before any actuator. Stability and noise
    analyses include them.
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


def _density(of: str, unit: str) -> Any:
    return setting(
        None,
        f"{unit} per sqrt(Hz)",
        f"density of the white {of} noise, which sets ``{of}_noise`` for its coordinates to "
        f"density / sqrt(sample_time); null: ``{of}_noise`` is used",
        least=0,
    )


def _time(of: str) -> Any:
    meaning = (
        f"time that replaces ``{of}``, a whole number of control samples; null: ``{of}`` is used"
    )
    return setting(None, "s", meaning, least=0)


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
    velocity_noise_density: PerCoordinate | None = _density("velocity", "rad/s or m/s")
    position_noise_density: PerCoordinate | None = _density("position", "rad or m")
    delay_time: float | None = _time("delay")
    velocity_delay_time: PerCoordinate | None = _time("velocity_delay")
    position_delay_time: PerCoordinate | None = _time("position_delay")
    velocity_period_time: PerCoordinate | None = _time("velocity_period")
    position_period_time: PerCoordinate | None = _time("position_period")

    def at(self, sample_time: float) -> "Sensing":
        """Return the sensors with their densities and times as values of control samples."""
        found: dict[str, Any] = {}
        for name in (*DENSITIES, *TIMES):
            dense, least = name in DENSITIES, int(name.endswith("period"))

            def of_sample(value: float, dense: bool = dense, least: int = least) -> float:
                if not 0.0 <= value < math.inf:  # a wrong one is refused by its own key
                    return least
                if dense:
                    return value / math.sqrt(sample_time)
                return max(math.ceil(value / sample_time - 1e-6), least)

            given = getattr(self, f"{name}_{'density' if dense else 'time'}")
            if isinstance(given, dict):
                own = {key: of_sample(each) for key, each in given.items()}
                found[name] = getattr(self, name) | own
            elif given is not None:
                found[name] = of_sample(given)
        return replace(self, **found) if found else self

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that times are whole numbers of control samples."""
        step = scenario.sample_time
        for place in (join(key, f"{name}_time") for name in TIMES):
            given = getattr(self, place.rpartition(".")[2])
            each = given if isinstance(given, dict) else {"": given or 0.0}
            for inner, time in each.items():
                below = math.floor(time / step + 1e-6)
                if abs(time / step - below) > 1e-6:
                    near = f"the nearest are {below * step:.6g} and {(below + 1) * step:.6g} s"
                    problem = f"{time:g} s are not a whole number of samples of {step:g} s; {near}"
                    yield f"{place}.{inner}".rstrip("."), problem
