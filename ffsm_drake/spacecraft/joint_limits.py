"""Limits of the joints, from the URDFs."""

import dataclasses
from xml.etree import ElementTree

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.common.errors import ModelError
from ffsm_drake.scenario import Model, Scenario
from ffsm_drake.spacecraft.plant import coordinates_of, urdfs_of
from ffsm_drake.spacecraft.urdf.elements import read_joint


@dataclasses.dataclass(frozen=True, kw_only=True)
class JointLimits:
    """Limits of the joints, in their order (n); infinite if there are none."""

    names: tuple[str, ...]
    units: tuple[str, ...]  # "rad" or "m"
    lower: np.ndarray  # rad or m
    upper: np.ndarray
    velocity: np.ndarray  # rad/s or m/s
    effort: np.ndarray  # N m or N


def joint_limits(model: Model, plant: MultibodyPlant) -> JointLimits:
    """The limits of a model's joints; a zero velocity or effort in a URDF means unknown.

    Drake drops effort limits of joints without a transmission, so all are read from the URDFs.

    Raises:
      ModelError: a URDF cannot be read.
    """
    coordinates = coordinates_of(plant)
    count = len(coordinates.joints)
    limits = JointLimits(
        names=coordinates.joints,
        units=coordinates.joint_units,
        lower=np.full(count, -np.inf),
        upper=np.full(count, np.inf),
        velocity=np.full(count, np.inf),
        effort=np.full(count, np.inf),
    )
    for path in urdfs_of(model):
        try:
            elements = list(ElementTree.parse(path).getroot().iter("joint"))
        except (OSError, ElementTree.ParseError):
            # Drake could read it, so the fault is unusual
            continue
        for element in elements:
            if element.get("name") not in limits.names or element.find("limit") is None:
                continue
            try:
                joint, i = read_joint(element), limits.names.index(element.get("name", ""))
            except ModelError as error:
                raise ModelError(f"model: {path}: {error}") from None
            limits.lower[i], limits.upper[i] = joint.lower, joint.upper
            limits.velocity[i], limits.effort[i] = joint.velocity, joint.effort
    return limits


def rate_limits(scenario: Scenario, plant: MultibodyPlant) -> np.ndarray:
    """Largest rate of each joint (n), rad/s or m/s, from URDFs and drives; else infinite.

    Raises ScenarioError, ModelError: a limit names an unknown joint, or a URDF cannot be read.
    """
    velocity = joint_limits(scenario.model, plant).velocity
    if scenario.drives is None:
        return velocity
    key, own = "actuation.drives.rate_limit", scenario.drives.rate_limit or {}
    return np.minimum(velocity, coordinates_of(plant).joint_vector(own, key=key, default=np.inf))
