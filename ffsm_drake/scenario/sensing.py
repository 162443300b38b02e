"""The sections ``sensing``, ``estimator`` and ``command_filter``: what the controller hears."""

from dataclasses import dataclass
from typing import ClassVar

from ffsm_drake.common.settings import setting
from ffsm_drake.scenario.fields import ZERO, PerCoordinate, choice_of, in_samples, unitless

ESTIMATOR_KINDS = ("one_sample", "kalman", "coupled")


@dataclass
class Estimator:
    """How the controller estimates the lumped uncertainty N of equation (2)."""

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
        "kalman, and coupled for the base's position: N's random walk, its standard deviation "
        "after one second; what differs between the base's three axes is in the base's axes, as "
        "for the noises below",
        above=0,
    )
    force_walk: PerCoordinate = setting(
        {"all": 0.2},
        "N m or N per sqrt(s)",
        "coupled only: random walk of the generalized force that stands for N in attitude and "
        "joints",
        above=0,
    )
    position_noise: PerCoordinate | None = setting(
        None,
        "rad or m",
        "not for one_sample: standard deviation that it assumes of the positions; null: that of "
        "``sensing``",
        least=0,
    )
    velocity_noise: PerCoordinate | None = setting(
        None,
        "rad/s or m/s",
        "not for one_sample: standard deviation that it assumes of the velocities; null: that of "
        "``sensing``",
        least=0,
    )
    velocity_bias_walk: PerCoordinate = setting(
        ZERO,
        "rad/s or m/s per sqrt(s)",
        "not for one_sample: random walk of a bias of the velocities that it estimates with N (of "
        "the base in its axes), its standard deviation after one second; 0: none is estimated",
        least=0,
    )
    delay: int | None = in_samples(
        None, "kalman only: age of the measurements that it assumes; null: ``sensing.delay``"
    )


@dataclass
class CommandFilter:
    """Filters of the force that the control law commands, before any actuator; stability and noise
    include them.
    """

    low_pass: PerCoordinate = setting(
        ZERO, "Hz", "cut-off of a first-order low-pass filter; 0: none", least=0
    )
    notch: PerCoordinate = setting(ZERO, "Hz", "frequency that a notch takes out; 0: none", least=0)
    notch_width: PerCoordinate = unitless(
        {"all": 0.5}, "the notch's width at half power, as a share of its frequency", above=0
    )


@dataclass
class Sensing:
    """The sensors' errors, in this order: bias, noise, quantisation, sampling and delay.

    Those of the base's sensors are in the base's axes, which they turn with.
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
        "that of the gyro about z",
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
        "likewise of the positions; the same for the three base rotations",
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
        "between two measurements of the velocities; the same for the base's three rotations, and "
        "for its three positions, as for the three keys below",
        least=1,
    )
    position_period: dict[str, int] = in_samples(
        {"all": 1}, "between two measurements of the positions", least=1
    )
    delay: int = in_samples(0, "age of a measurement when the controller first reads it")
    velocity_delay: dict[str, int] = in_samples(
        {"all": 0}, "further age of the velocities, beyond delay"
    )
    position_delay: dict[str, int] = in_samples(
        {"all": 0}, "further age of the positions, beyond delay"
    )
