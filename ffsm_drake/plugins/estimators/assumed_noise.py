"""What the filters assume of sensors and disturbance: noise, walks, periods and delays."""

from collections.abc import Sequence

import numpy as np

from ffsm_drake.plugins.estimators.filter_gains import SensedAxis
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.systems.sensing.errors import measurement_times


def sensed_axes(scenario: Scenario, coordinates: Coordinates) -> list[SensedAxis]:
    """Noise assumptions of a filter for each coordinate."""
    settings, nv = scenario.estimator, len(coordinates.names)
    walk = coordinates.vector(settings.walk, key="estimator.walk")
    bias_walk = coordinates.vector(
        settings.velocity_bias_walk, key="estimator.velocity_bias_walk", default=0.0
    )
    period, delay = measurement_times(scenario.sensing, coordinates)
    if settings.delay is not None:
        delay = delay - scenario.sensing.delay + settings.delay
    position, velocity = assumed_noise(scenario, coordinates)
    return [
        SensedAxis(
            position_noise=float(position[i]),
            velocity_noise=float(velocity[i]),
            walk=float(walk[i]),
            bias_walk=float(bias_walk[i]),
            period=(int(period[i]), int(period[nv + i])),
            delay=(int(delay[i]), int(delay[nv + i])),
        )
        for i in range(nv)
    ]


def axes_matter(axes: Sequence[SensedAxis]) -> bool:
    """Whether it matters along which axes the filters of the base's coordinates are."""
    base = axes[:NUM_BASE_VELOCITIES]
    alike = len(set(base[:3])) == len(set(base[3:])) == 1
    return not alike or any(axis.bias_walk > 0.0 for axis in base)


def assumed_noise(scenario: Scenario, coordinates: Coordinates) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations (nv) of the measured positions and velocities assumed by the filter.

    Correlated noise counts as white noise of equal strength at low frequencies.
    """
    sensing, nv = scenario.sensing, len(coordinates.names)
    period, _ = measurement_times(sensing, coordinates)
    time_constant = coordinates.vector(
        sensing.correlation_time, key="sensing.correlation_time", default=1.0
    )

    def of(part: str, samples: np.ndarray) -> np.ndarray:
        given = getattr(scenario.estimator, f"{part}_noise")
        if given is not None:
            return coordinates.vector(given, key=f"estimator.{part}_noise", default=0.0)
        white, correlated = (
            coordinates.vector(getattr(sensing, name), key=f"sensing.{name}", default=0.0)
            for name in (f"{part}_noise", f"{part}_correlated_noise")
        )
        kept = np.exp(-samples * scenario.sample_time / time_constant)
        return np.hypot(white, correlated * np.sqrt((1.0 + kept) / (1.0 - kept)))

    return of("position", period[:nv]), of("velocity", period[nv:])
