"""The sections ``sensing``, ``estimator`` and ``command_filter``: the controller's inputs and the
filters of its output.
"""

from dataclasses import dataclass
from typing import ClassVar

from ffsm_drake.common.settings import setting
from ffsm_drake.scenario.fields import ZERO, PerCoordinate, choice_of, in_samples, unitless

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
