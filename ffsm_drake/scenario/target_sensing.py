"""A sensor of a target's pose, and the filter of its motion: their settings."""

from dataclasses import dataclass
from typing import Any

from ffsm_drake.common.settings import Problems, setting
from ffsm_drake.scenario.fields import in_samples, unitless


@dataclass
class TargetSensor:
    """A camera or lidar that measures the pose of the target's frame.

    At range r the position is off by ``position_noise`` and r times ``angle_noise`` across the line
    of sight, and ``position_noise`` and r times ``range_noise`` along it.
    """

    position_noise: float = setting(2e-3, "m", "at any range, per axis", above=0)
    angle_noise: float = setting(1e-3, "rad", "of the line of sight, per axis", least=0)
    range_noise: float = unitless(5e-3, "along the line of sight, of the range", least=0)
    rotation_noise: float = setting(0.01, "rad", "of the attitude, at any range, per axis", above=0)
    rotation_growth: float = setting(
        0.005, "rad/m", "of the attitude's noise with range, per axis", least=0
    )
    period: int = in_samples(10, "between images", 1)
    latency: int = in_samples(10, "from an image to its pose")
    dropouts: float = unitless(0.0, "of the images, without a pose", least=0, below=1)
    outliers: float = unitless(0.0, "of the poses, wrong", least=0, below=1)
    outlier_scale: float = unitless(30.0, "by so many times the noise", above=1)


@dataclass
class TargetTracker:
    """A Kalman filter of the target's motion, centre of mass and inertia ratios. Before the first
    pose it knows the motion and the mass properties that are expected.
    """

    rate_deviation: float = setting(
        0.02, "rad/s", "of the target's rate from what is expected, per axis", above=0
    )
    velocity_deviation: float = setting(0.01, "m/s", "likewise, of its velocity", above=0)
    center_deviation: float = setting(
        0.02, "m", "likewise, of the nominal payload's centre of mass", above=0
    )
    inertia_deviation: float = unitless(
        0.1, "likewise, of its inertia ratios: of the inertia over a third of its trace", above=0
    )
    rate_walk: float = setting(1e-6, "rad/s/sqrt(s)", "of torques that it knows not of", least=0)
    velocity_walk: float = setting(1e-6, "m/s/sqrt(s)", "of such forces", least=0)
    gate: float = unitless(
        22.5, "poses beyond are outliers: squared, of the six innovations' deviations", above=0
    )


@dataclass
class Measured:
    """A target that is measured, and whose estimate the approach follows. Its rate and velocity at
    the start differ from what ``capture`` says by numbers drawn at the filter's deviations.
    """

    sensor: TargetSensor = setting(TargetSensor())
    filter: TargetTracker = setting(TargetTracker())
    replan: float = setting(1.0, "s", "from a new plan of the approach to the next", above=0)
    last: float = setting(
        3.0, "s", "before the gripper closes, the last plan; then covariance decides", above=0
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """A closing gripper, and a reference that can follow."""
        if scenario.capture.closing is None:
            yield key, "needs capture.closing: the gripper meets a target that is elsewhere"
        if scenario.blocks.reference is not None:
            yield key, "has no effect with blocks.reference; leave one of them out"
        closing, approach = scenario.capture.closing, scenario.capture.approach
        if closing and approach and self.last + closing.duration >= approach.duration:
            yield f"{key}.last", "must leave time to follow the target in capture.approach.duration"
