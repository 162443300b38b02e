"""The sections ``disturbance`` and ``environment``: external forces."""

from dataclasses import dataclass
from typing import Any

from ffsm_drake.common.settings import Problems, setting
from ffsm_drake.scenario.fields import ORIGIN, X_AXIS, unitless, vector_in


@dataclass
class Harmonic:
    """One coordinate's disturbance, ``amplitude * sin(frequency * t + phase) + bias``."""

    amplitude: float = setting(0.0, "N m or N", "amplitude")
    frequency: float = setting(0.0, "rad/s", "angular frequency")
    phase: float = setting(0.0, "rad", "phase")
    bias: float = setting(0.0, "N m or N", "constant part")


@dataclass
class Disturbance:
    """External generalized force tau_d on the plant (Table 1)."""

    amplitude_scale: float = unitless(1.0, "multiplies amplitudes and biases")
    frequency_scale: float = unitless(1.0, "multiplies frequencies", least=0)
    harmonics: dict[str, Harmonic] = unitless({}, "harmonics, by coordinate or group")


@dataclass
class SolarPressure:
    """The force of sunlight on the base, constant in the world frame: -pressure * coefficient *
    area along ``sun``.
    """

    area: float = setting(10.0, "m^2", "area that faces the sun", least=0)
    coefficient: float = unitless(
        1.3, "coefficient of the pressure: 1 for full absorption, 2 for full reflection", least=0
    )
    pressure: float = setting(
        4.56e-6, "N/m^2", "pressure of sunlight, by default at the Earth's distance", least=0
    )
    sun: list[float] = vector_in(
        X_AXIS, "", "direction towards the sun, world axes; of any length", nonzero=True
    )
    center_of_pressure: list[float] = vector_in(
        ORIGIN, "m", "where the force acts, in the base's frame"
    )


@dataclass
class Environment:
    """Forces of a circular orbit on every body. The world frame falls freely with a point of the
    orbit and does not turn.
    """

    altitude: float | None = setting(
        400e3,
        "m",
        "altitude of the orbit above the Earth's equator; null with ``mean_motion``",
        above=0,
        most=1e9,
    )
    mean_motion: float | None = setting(
        None,
        "rad/s",
        "angular rate of the orbit, about any body, in place of the altitude",
        above=0,
        most=0.01,  # an orbit of ten minutes, shorter than any real one
    )
    hill_rpy: list[float] = vector_in(
        ORIGIN,
        "rad",
        "roll, pitch, yaw of Hill's frame in the world at the start: x away from the Earth, y "
        "along the flight, z along the orbit's normal, the axis of rotation",
    )
    gravity_gradient: bool = unitless(
        True,
        "include the difference of gravity between the spacecraft's centre of mass and each "
        "part of a body",
    )
    tidal: bool = unitless(
        True,
        "include the difference of gravity between the world's origin and the spacecraft's "
        "centre of mass",
    )
    solar_pressure: SolarPressure | None = unitless(None, "null: none")

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that the orbit is given in exactly one way."""
        if self.mean_motion is None and self.altitude is None:
            yield f"{key}.altitude", "give a number of metres, or mean_motion"
        if self.mean_motion is not None and self.altitude is not None:
            yield f"{key}.altitude", "has no effect beside a mean_motion; set altitude: null"
