"""The largest forces: of limits, URDFs, thrusters and wheels."""

import dataclasses
import itertools

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.joint_limits import joint_limits
from ffsm_drake.spacecraft.plant import coordinates_of
from ffsm_drake.systems.actuation.thrusters import ThrusterSet
from ffsm_drake.systems.actuation.wheels import WheelSet

# Axes, edges and corners of a cube.
_DIRECTIONS = np.array(
    [each for each in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(each)]
)
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1)[:, None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class BaseLimits:
    """The largest torque (N m) and force (N) that a base's actuators give alone; infinite where
    they are ideal.
    """

    torque: float  # in any direction
    most_torque: float  # in the best
    force: float
    most_force: float
    named: str  # what gives it beside actuation.limit, in words


def base_limits(scenario: Scenario) -> BaseLimits:
    """What thrusters and wheels of a scenario give; ScenarioError as for ``make_actuation``."""
    settings, period = scenario.actuation, scenario.sample_time
    torque = force = np.full(len(_DIRECTIONS), np.inf)
    is_limited = settings.thrusters is not None or settings.wheels is not None
    if scenario.blocks.actuation is None:
        if settings.thrusters is not None:
            thrusters, none = ThrusterSet(settings.thrusters, sample_time=period), np.zeros(3)
            torque, force = (
                np.array([thrusters.most(np.concatenate(parts(each))) for each in _DIRECTIONS])
                for parts in (lambda each: (each, none), lambda each: (none, each))
            )
        if settings.wheels is not None:
            wheels = WheelSet(settings.wheels, sample_time=period, alone=settings.thrusters is None)
            torque = np.array([wheels.most(each) for each in _DIRECTIONS])
    return BaseLimits(
        torque=float(torque.min()),
        most_torque=float(torque.max()),
        force=float(force.min()),
        most_force=float(force.max()),
        named=" or what thrusters and wheels give" if is_limited else "",
    )


def force_limits(scenario: Scenario, plant: MultibodyPlant) -> np.ndarray:
    """The largest force of each coordinate (nv), N m or N, infinite where there is none.

    That of ``actuation.limit``, the URDFs' efforts, and what thrusters and wheels give in any
    direction.

    Raises ScenarioError, ModelError: the limit names an unknown coordinate, or a URDF cannot be
    read.
    """
    coordinates = coordinates_of(plant)
    force = coordinates.vector(
        scenario.actuation.limit or {}, key="actuation.limit", default=np.inf
    )
    joints, base = (
        slice(len(coordinates.names) - len(coordinates.joints), None),
        base_limits(scenario),
    )
    force[joints] = np.minimum(force[joints], joint_limits(scenario.model, plant).effort)
    for group, largest in (("base_rotation", base.torque), ("base_position", base.force)):
        part = coordinates.groups[group]
        force[part] = np.minimum(force[part], largest)
    return force
