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
    """Estimator of the lumped uncertainty N of equation (2)."""

    KIND: ClassVar[str] = "kind"  # another one drops the inherited settings

    kind: str = choice_of(
        "one_sample",
        '"one_sample", the paper\'s (5); "kalman", a filter for each coordinate; or "coupled", '
        "the same with one filter for attitude and joints",
        *ESTIMATOR_KINDS,
    )
    walk: PerCoordinate = setting(
        {"base_position": 1e-3, "base_rotation": 1e-3, "joints": 1e-2},
        "rad/s^2 or m/s^2 per sqrt(s)",
        "kalman, and coupled for the base's position: random walk of N, its standard deviation "
        "after one second; values that differ between the base's three axes refer to the base's "
        "axes, here and for the noises below",
        above=0,
    )
    force_walk: PerCoordinate = setting(
        {"all": 0.2},
        "N m or N per sqrt(s)",
        "coupled only: random walk of the generalized force equivalent to N in attitude and joints",
        above=0,
    )
    position_noise: PerCoordinate | None = setting(
        None,
        "rad or m",
        "kalman and coupled: assumed standard deviation of the positions; null: as in ``sensing``",
        least=0,
    )
    velocity_noise: PerCoordinate | None = setting(
        None,
        "rad/s or m/s",
        "kalman and coupled: assumed standard deviation of the velocities; null: as in ``sensing``",
        least=0,
    )
    velocity_bias_walk: PerCoordinate = setting(
        ZERO,
        "rad/s or m/s per sqrt(s)",
        "kalman and coupled: random walk of a velocity bias estimated with N (base: in its own "
        "axes), its standard deviation after one second; 0: none is estimated",
        least=0,
    )
    delay: int | None = in_samples(
        None, "kalman only: assumed age of the measurements; null: ``sensing.delay``"
    )


@dataclass
class CommandFilter:
    """Filters of the control law's commanded force, before any actuator. Stability and noise
    analyses include them.
    """

    low_pass: PerCoordinate = setting(
        ZERO, "Hz", "cut-off of a first-order low-pass filter; 0: none", least=0
    )
    notch: PerCoordinate = setting(
        ZERO, "Hz", "centre frequency of a notch filter; 0: none", least=0
    )
    notch_width: PerCoordinate = unitless(
        {"all": 0.5}, "the notch's width at half power, as a share of its frequency", above=0
    )


def _density(of: str, unit: str) -> Any:
    return setting(
        None,
        f"{unit} per sqrt(Hz)",
        f"density of the white noise, in place of ``{of}_noise`` for its coordinates: the standard "
        "deviation of a sample is the density / sqrt(sample_time); null: none",
        least=0,
    )


def _time(of: str) -> Any:
    meaning = f"in place of ``{of}``, a whole number of control samples; null: none"
    return setting(None, "s", meaning, least=0)


@dataclass
class Sensing:
    """The sensors' errors, in this order: bias, noise, quantisation, sampling and delay.

    Errors of the base's sensors are in the base's axes and turn with them.
    """

    velocity_noise: PerCoordinate = setting(
        {"all": 1e-6},
        "rad/s or m/s",
        "standard deviation of the velocities' noise, independent for each coordinate and control "
        "sample; errors of the base's sensors are in the base's axes, here and below",
        least=0,
    )
    position_noise: PerCoordinate = setting(
        ZERO,
        "rad or m",
        "standard deviation of the positions' noise, likewise; the same for the three base "
        "rotations",
        least=0,
    )
    velocity_bias: PerCoordinate = setting(
        ZERO,
        "rad/s or m/s",
        "constant error of the velocities; of the base's in the base's axes: base_rotation_z is "
        "the bias of the gyro about z",
    )
    position_bias: PerCoordinate = setting(
        ZERO,
        "rad or m",
        "constant error of the positions; of the base's in the base's axes, base rotations: a "
        "rotation vector",
    )
    velocity_bias_walk: PerCoordinate = setting(
        ZERO,
        "rad/s or m/s per sqrt(s)",
        "random walk of the velocities' bias (a gyro's rate random walk; of the base in its axes), "
        "its standard deviation after one second",
        least=0,
    )
    velocity_correlated_noise: PerCoordinate = setting(
        ZERO,
        "rad/s or m/s",
        "standard deviation of the velocities' noise that is correlated in time, beside the white "
        "noise (of the base in its axes)",
        least=0,
    )
    position_correlated_noise: PerCoordinate = setting(
        ZERO,
        "rad or m",
        "the same for the positions; equal for the three base rotations",
        least=0,
    )
    correlation_time: PerCoordinate = setting(
        {"all": 1.0}, "s", "time constant of the correlated noise, first order", above=0
    )
    velocity_quantization: PerCoordinate = setting(
        ZERO, "rad/s or m/s", "step of the velocities (of the base in its axes); 0: none", least=0
    )
    position_quantization: PerCoordinate = setting(
        ZERO,
        "rad or m",
        "step of the positions (of the base in its axes), not for base rotations; 0: none",
        least=0,
    )
    velocity_period: dict[str, int] = in_samples(
        {"all": 1},
        "period of the velocity measurements; equal for the base's three rotations, and for its "
        "three positions, also in the three keys below",
        least=1,
    )
    position_period: dict[str, int] = in_samples(
        {"all": 1}, "period of the position measurements", least=1
    )
    delay: int = in_samples(0, "age of a measurement when the controller first reads it")
    velocity_delay: dict[str, int] = in_samples(
        {"all": 0}, "additional age of the velocities, beyond delay"
    )
    position_delay: dict[str, int] = in_samples(
        {"all": 0}, "additional age of the positions, beyond delay"
    )
    velocity_noise_density: PerCoordinate | None = _density("velocity", "rad/s or m/s")
    position_noise_density: PerCoordinate | None = _density("position", "rad or m")
    delay_time: float | None = _time("delay")
    velocity_delay_time: PerCoordinate | None = _time("velocity_delay")
    position_delay_time: PerCoordinate | None = _time("position_delay")
    velocity_period_time: PerCoordinate | None = _time("velocity_period")
    position_period_time: PerCoordinate | None = _time("position_period")

    def at(self, sample_time: float) -> "Sensing":
        """The sensors with their densities and times as values of control samples."""
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
                    problem = f"{time:g} s are no whole number of samples of {step:g} s; {near}"
                    yield f"{place}.{inner}".rstrip("."), problem
