"""The errors and times of sensors, as vectors along the state."""

import dataclasses
import itertools
import math
from typing import NamedTuple

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.so3 import turning_matrix
from ffsm_drake.scenario import Sensing as SensingSettings
from ffsm_drake.scenario.sensing import FURTHER, TIMES
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates


@dataclasses.dataclass(frozen=True)
class SensorErrors:
    """The settings of the sensors, as vectors. Raises ScenarioError for an unknown coordinate."""

    settings: SensingSettings
    coordinates: Coordinates
    sample_time: float

    def of(self, key: str, default: float = 0.0) -> np.ndarray:
        """Return a setting by coordinate (nv)."""
        further = FURTHER.get(key, key)
        if isinstance(given := getattr(self.settings, further), dict):
            self.coordinates.check_names(given, key=f"sensing.{further}")
        values = getattr(self.settings, key)
        return self.coordinates.vector(values, key=f"sensing.{key}", default=default)

    def pair(self, name: str, default: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return values of positions and of velocities (nv each)."""
        return self.of(f"position_{name}", default), self.of(f"velocity_{name}", default)

    @property
    def turn(self) -> np.ndarray:
        """Matrix (4, 4) by which the constant error turns the attitude's quaternion."""
        return turning_matrix(self.pair("bias")[0][:3])

    @property
    def bias(self) -> np.ndarray:
        """Constant errors along [q; v] (nq + nv), besides the attitude's."""
        return _of_state(*self.pair("bias"))

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviations of white noise along [q; v] (nq + nv)."""
        return _deviations(*self.pair("noise"))

    @property
    def resolution(self) -> np.ndarray:
        """Quantisation along [q; v] (nq + nv); 0: none."""
        return _of_state(*self.pair("quantization"))

    def drift_gains(self) -> np.ndarray:
        """Along [q; v], the intensities of random walks and the standard deviations of correlated
        noise (2, nq + nv).
        """
        walk = self.of("velocity_bias_walk")
        return np.array(
            [_of_state(np.zeros_like(walk), walk), _deviations(*self.pair("correlated_noise"))]
        )

    def drift(self) -> "Drift":
        """Errors that drift."""
        walk, correlated = self.drift_gains()
        constant = self.of("correlation_time", 1.0)
        time_constant = _of_state(constant, constant, quaternion=constant[0])
        walks, noises = np.flatnonzero(walk), np.flatnonzero(correlated)
        # share of the deviation left after one sample
        kept = np.exp(-self.sample_time / time_constant[noises])
        added = correlated[noises] * np.sqrt(1.0 - kept**2)
        return Drift(
            entries=np.concatenate([walks, noises]),
            kept=np.concatenate([np.ones(walks.size), kept]),
            added=np.concatenate([math.sqrt(self.sample_time) * walk[walks], added]),
            start=np.concatenate([np.zeros(walks.size), correlated[noises]]),
        )

    def times(self) -> np.ndarray:
        """Period and delay along [q; v] (2, nq + nv), in whole control samples."""
        each = np.array(measurement_times(self.settings, self.coordinates))
        return np.hstack([each[:, :1], each])  # the quaternion has four

    def axes_matter(self) -> np.ndarray:
        """Whether the base's white noise, and its other errors, depend on the axes (2)."""
        base = slice(0, NUM_BASE_VELOCITIES)
        white = np.stack(self.pair("noise"))[:, base].reshape(-1, 3)
        pairs = (self.pair(name) for name in ("bias", "correlated_noise", "quantization"))
        others = [*itertools.chain(*pairs), self.of("velocity_bias_walk")]
        return np.array([
            (white != white[:, :1]).any(), any(each[base].any() for each in others)
        ])  # fmt: skip

    def check_alike(self, name: str, group: str) -> None:
        """Raise ScenarioError if a setting differs between a base's three coordinates."""
        if len(set(self.of(name, 1.0)[self.coordinates.groups[group]].tolist())) > 1:
            raise ScenarioError(
                f"sensing.{name}", f"must be the same for the three {group} coordinates"
            )

    def check_rotation(self) -> None:
        """Raise ScenarioError for what cannot be applied to the base's rotation, a quaternion."""
        for name in ("noise", "correlated_noise"):
            self.check_alike(f"position_{name}", "base_rotation")
        if self.of("position_quantization")[self.coordinates.groups["base_rotation"]].any():
            raise ScenarioError(
                "sensing.position_quantization",
                "base_rotation has no scale to quantise; leave it out",
            )


class Drift(NamedTuple):
    """Random walks and correlated noise: x = kept x + added times a sample of deviation 1 (n)."""

    entries: np.ndarray  # entries of [q; v] that x is added to
    kept: np.ndarray
    added: np.ndarray
    start: np.ndarray  # standard deviation of x at the start


def _of_state(position: np.ndarray, velocity: np.ndarray, *, quaternion: float = 0.0) -> np.ndarray:
    """Return values along [q; v] (nq + nv) from those of the coordinates (nv each)."""
    return np.concatenate([np.full(4, quaternion), position[3:], velocity])


def _deviations(position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Standard deviations along [q; v] from those of the coordinates (nv each).

    Rotation noise of standard deviation sigma is added to the quaternion of the base as sigma/2 per
    component: along the quaternion it changes only the norm, which no reader of the state looks at;
    across it, it is a rotation of sigma about each axis to first order.
    """
    return _of_state(position, velocity, quaternion=0.5 * position[0])


def measurement_times(
    settings: SensingSettings, coordinates: Coordinates
) -> tuple[np.ndarray, np.ndarray]:
    """Period and delay of the measurements of positions, then velocities (2 nv): whole control
    samples.

    Raises ScenarioError for an unknown coordinate, and where the base's sensors, each of which
    measures along three axes at once, do so at different times.
    """
    errors = SensorErrors(settings, coordinates, 0.0)
    for name, group in itertools.product(TIMES[1:], ("base_rotation", "base_position")):
        errors.check_alike(name, group)
    period, delay = (
        np.concatenate(errors.pair(name, default)).astype(int)
        for name, default in (("period", 1.0), ("delay", 0.0))
    )
    return period, settings.delay + delay
