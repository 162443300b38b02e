"""A sensor of a target's pose, and the filter of its motion: their settings."""

from dataclasses import dataclass

from ffsm_drake.common.settings import setting
from ffsm_drake.scenario.fields import in_samples, unitless


@dataclass
class TargetSensor:
    """A camera or lidar that measures the pose of the target's frame.

    At range r, the position noise across the line of sight is the root of the sum of squares of
    ``position_noise`` and r times ``angle_noise``. Along the line of sight it is the root of the
    sum of squares of ``position_noise`` and r times ``range_noise``.
    """

    position_noise: float = setting(
        2e-3, "m", "standard deviation of position noise on each axis, at any range", above=0
    )
    angle_noise: float = setting(
        1e-3,
        "rad",
        "standard deviation of the direction of the line of sight, about each axis",
        least=0,
    )
    range_noise: float = unitless(
        5e-3, "standard deviation of the measured range, divided by the range", least=0
    )
    rotation_noise: float = setting(
        0.01, "rad", "standard deviation of attitude noise about each axis at range 0", above=0
    )
    rotation_growth: float = setting(
        0.005, "rad/m", "growth of the attitude noise with range, about each axis", least=0
    )
    period: int = in_samples(10, "period of the images", 1)
    latency: int = in_samples(10, "delay from an image to the pose computed from it")
    dropouts: float = unitless(0.0, "share of images that give no pose", least=0, below=1)
    outliers: float = unitless(0.0, "share of poses that are wrong (outliers)", least=0, below=1)
    outlier_scale: float = unitless(
        30.0, "factor by which the noise of an outlier is larger", above=1
    )


@dataclass
class TargetTracker:
    """A Kalman filter that estimates the motion, centre of mass and inertia ratios of the target.

    Before the first pose it uses the expected motion and mass properties.
    """

    rate_deviation: float = setting(
        0.02,
        "rad/s",
        "standard deviation of the target's angular rate from the expected rate, about each axis",
        above=0,
    )
    velocity_deviation: float = setting(
        0.01,
        "m/s",
        "standard deviation of the target's velocity from the expected one, on each axis",
        above=0,
    )
    center_deviation: float = setting(
        0.02,
        "m",
        "standard deviation of the target's centre of mass from the nominal one, on each axis",
        above=0,
    )
    inertia_deviation: float = unitless(
        0.1,
        "standard deviation of the inertia ratios: inertia divided by a third of its trace",
        above=0,
    )
    rate_walk: float = setting(
        1e-6,
        "rad/s/sqrt(s)",
        "random walk of the angular rate, due to torques that are not modelled",
        least=0,
    )
    velocity_walk: float = setting(
        1e-6,
        "m/s/sqrt(s)",
        "random walk of the velocity, due to forces that are not modelled",
        least=0,
    )
    gate: float = unitless(
        22.5,
        "squared Mahalanobis distance of the six innovations above which a pose is rejected as an "
        "outlier",
        above=0,
    )


@dataclass
class Measured:
    """Measurement of the target. The approach follows the estimated motion.

    The initial rate and velocity of the target deviate from ``capture`` by numbers drawn with the
    standard deviations of the filter.
    """

    sensor: TargetSensor = setting(TargetSensor())
    filter: TargetTracker = setting(TargetTracker())
    replan: float = setting(1.0, "s", "time between new plans of the approach", above=0)
    last: float = setting(
        3.0,
        "s",
        "time before the closing of the gripper at which the last plan is made; the approach is "
        "aborted then if the estimate is too uncertain",
        above=0,
    )
