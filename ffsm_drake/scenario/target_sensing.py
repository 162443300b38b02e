"""A sensor of a target's pose, and the filter of its motion: their settings."""

from dataclasses import dataclass

from ffsm_drake.common.settings import setting
from ffsm_drake.scenario.fields import in_samples, unitless


@dataclass
class TargetSensor:
    """A camera or lidar that measures the pose of the target's frame.

    At range r the position noise is, added in quadrature, ``position_noise`` and r times
    ``angle_noise`` across the line of sight, ``position_noise`` and r times ``range_noise`` along
    it.
    """

    position_noise: float = setting(
        2e-3, "m", "position noise independent of range, per axis", above=0
    )
    angle_noise: float = setting(
        1e-3, "rad", "angular noise of the line of sight, per axis", least=0
    )
    range_noise: float = unitless(
        5e-3, "range noise along the line of sight, as a share of the range", least=0
    )
    rotation_noise: float = setting(
        0.01, "rad", "attitude noise independent of range, per axis", above=0
    )
    rotation_growth: float = setting(
        0.005, "rad/m", "growth of the attitude noise with range, per axis", least=0
    )
    period: int = in_samples(10, "period of the images", 1)
    latency: int = in_samples(10, "delay from an image to its pose")
    dropouts: float = unitless(0.0, "share of images without a pose", least=0, below=1)
    outliers: float = unitless(0.0, "share of wrong poses", least=0, below=1)
    outlier_scale: float = unitless(30.0, "factor on the noise of an outlier", above=1)


@dataclass
class TargetTracker:
    """A Kalman filter of the target's motion, centre of mass and inertia ratios. Before the first
    pose it uses the expected motion and mass properties.
    """

    rate_deviation: float = setting(
        0.02,
        "rad/s",
        "standard deviation of the target's rate from the expected one, per axis",
        above=0,
    )
    velocity_deviation: float = setting(
        0.01, "m/s", "standard deviation of the target's velocity, per axis", above=0
    )
    center_deviation: float = setting(
        0.02, "m", "standard deviation of the nominal payload's centre of mass, per axis", above=0
    )
    inertia_deviation: float = unitless(
        0.1, "standard deviation of the inertia ratios (inertia over a third of its trace)", above=0
    )
    rate_walk: float = setting(
        1e-6, "rad/s/sqrt(s)", "unmodelled torques (random walk of the rate)", least=0
    )
    velocity_walk: float = setting(
        1e-6, "m/s/sqrt(s)", "unmodelled forces (random walk of the velocity)", least=0
    )
    gate: float = unitless(
        22.5,
        "outlier threshold of the squared Mahalanobis distance of the six innovations",
        above=0,
    )


@dataclass
class Measured:
    """A target that is measured; the approach follows its estimate. Its initial rate and velocity
    deviate from ``capture`` by numbers drawn with the filter's deviations.
    """

    sensor: TargetSensor = setting(TargetSensor())
    filter: TargetTracker = setting(TargetTracker())
    replan: float = setting(1.0, "s", "time between replans of the approach", above=0)
    last: float = setting(
        3.0,
        "s",
        "time of the last plan before the gripper closes; the approach is aborted then if the "
        "estimate is too uncertain",
        above=0,
    )
