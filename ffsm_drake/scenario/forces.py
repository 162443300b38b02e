"""The sections ``disturbance`` and ``environment``: external forces."""

from dataclasses import dataclass
from typing import Any

from ffsm_drake.common.settings import Problems, setting
from ffsm_drake.scenario.fields import ORIGIN, X_AXIS, unitless, vector_in


@dataclass
class Harmonic:
    """The disturbance of one coordinate: ``amplitude * sin(frequency * t + phase) + bias``."""

    amplitude: float = setting(0.0, "N m or N", "amplitude of the disturbance")
    frequency: float = setting(0.0, "rad/s", "angular frequency of the disturbance")
    phase: float = setting(0.0, "rad", "phase of the disturbance at t = 0")
    bias: float = setting(0.0, "N m or N", "constant part of the disturbance")


@dataclass
class Disturbance:
    """External generalized force tau_d on the plant (Table 1)."""

    amplitude_scale: float = unitless(1.0, "factor on all amplitudes and biases")
    frequency_scale: float = unitless(1.0, "factor on all frequencies", least=0)
    harmonics: dict[str, Harmonic] = unitless({}, "sinusoidal disturbances, by coordinate or group")


@dataclass
class SolarPressure:
    """The force of sunlight on the base: -pressure * coefficient * area along ``sun``.

    It is constant in the world frame.
    """

    area: float = setting(10.0, "m^2", "area of the spacecraft that faces the sun", least=0)
    coefficient: float = unitless(
        1.3, "pressure coefficient: 1 for full absorption, 2 for full reflection", least=0
    )
    pressure: float = setting(
        4.56e-6, "N/m^2", "pressure of sunlight; default: at the distance of the Earth", least=0
    )
    sun: list[float] = vector_in(
        X_AXIS, "", "direction towards the sun in world axes; any length", nonzero=True
    )
    center_of_pressure: list[float] = vector_in(
        ORIGIN, "m", "point at which the force acts, in the frame of the base"
    )


@dataclass
class Environment:
    """Forces of a circular orbit on every body.

    The world frame falls freely with a point of the orbit and does not turn.
    """

    altitude: float | None = setting(
        400e3,
        "m",
        "altitude of the orbit above the Earth's equator; null if ``mean_motion`` is given",
        above=0,
        most=1e9,
    )
    mean_motion: float | None = setting(
        None,
        "rad/s",
        "angular rate of an orbit about any body; null if ``altitude`` is given",
        above=0,
        most=0.01,  # an orbit of ten minutes, shorter than any real one
    )
    hill_rpy: list[float] = vector_in(
        ORIGIN,
        "rad",
        "roll, pitch, yaw of Hill's frame in the world at t = 0; x points away from the Earth, y "
        "along the velocity, z along the orbit normal",
    )
    gravity_gradient: bool = unitless(
        True,
        "true: include the gravity gradient, the difference of gravity between the centre of mass "
        "of the spacecraft and each part of a body",
    )
    tidal: bool = unitless(
        True,
        "true: include the tidal force, the difference of gravity between the origin of the world "
        "and the centre of mass of the spacecraft",
    )
    solar_pressure: SolarPressure | None = unitless(
        None, "force of sunlight on the base; null: none"
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that the orbit is given in exactly one way."""
        if self.mean_motion is None and self.altitude is None:
            yield f"{key}.altitude", "give a number of metres, or mean_motion"
        if self.mean_motion is not None and self.altitude is not None:
            yield f"{key}.altitude", "has no effect with mean_motion; set altitude: null"
