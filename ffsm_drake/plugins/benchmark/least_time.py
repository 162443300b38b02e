"""Least times for a spacecraft's actuators to remove its momentum.

``held``: with the initial attitude of the base and posture of the arm, by a linear program over the
actuators' outputs, including the torque of forces about the centre of mass. This is no bound:
rotation of the stack, or motion of its centre of mass by the arm, may shorten the time.

``bound``: a lower bound for any attitude and posture. Along any direction the actuators give at
most their largest torque in any attitude, and forces act with at most the largest lever allowed by
the arm's lengths; so the momentum along every direction bounds the time from below.
"""

import dataclasses
import itertools

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.multibody.tree import RigidBody

from ffsm_drake.plugins.actuators.thrusters import ThrusterSet
from ffsm_drake.plugins.actuators.wheel_set import WheelSet
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.free_floating import free_floating
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import base_body

_CORNERS = 16  # most units with every combination tried; above, their sizes are summed
_DIRECTIONS = 2000  # number of directions for comparing momentum, beside its own


@dataclasses.dataclass(frozen=True, kw_only=True)
class LeastTimes:
    """Least times, s; 0 without momentum to remove, or without a limit on its removal."""

    bound: float
    held: float


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Units:
    """Actuators fixed in the base: largest wrenches (6, n; torque about the base's origin, force),
    and the least share of each: 0 or -1.
    """

    wrenches: np.ndarray
    least: float


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Actuators:
    """Everything that acts on the base."""

    sets: list[_Units]
    limit: np.ndarray  # (6) of the torque and force in world axes; infinite without a limit
    stored: float  # angular momentum that wheels hold at the start, N m s


def least_times(
    scenario: Scenario, model: PlantModel, q: np.ndarray, *, spin: np.ndarray, linear: np.ndarray
) -> LeastTimes:
    """Least times from a configuration q (nq) with angular momentum ``spin`` (3; about the centre
    of mass, N m s) and ``linear`` momentum (3; N s), world axes; only the driven coordinates of the
    base count.

    Raises ScenarioError: errors of the actuators.
    """
    driven = np.repeat([g in scenario.driven for g in ("base_rotation", "base_position")], 3)
    actuators = _actuators(scenario, model, driven)
    momentum = np.where(driven, np.concatenate([spin, linear]), 0.0)
    if not momentum.any():
        return LeastTimes(bound=0.0, held=0.0)
    stack = free_floating(model, q)
    return LeastTimes(
        bound=_bound(actuators, momentum, lever=_largest_lever(model)),
        held=_held(actuators, momentum, driven, q, -stack.center_of_mass),
    )


def _actuators(scenario: Scenario, model: PlantModel, driven: np.ndarray) -> _Actuators:
    actuation, step, stored, sets = scenario.actuation, scenario.sample_time, 0.0, list[_Units]()
    limits = actuation.limit or {}
    limit = model.coordinates.vector(limits, key="actuation.limit", default=np.inf)[:6]
    limit = np.where(driven, limit, 0.0)
    if actuation.wheels is not None:
        wheels = WheelSet(actuation.wheels, sample_time=step, alone=actuation.thrusters is None)
        torques = np.vstack([wheels.reach, np.zeros_like(wheels.reach)])
        sets.append(_Units(wrenches=torques, least=-1.0))
        stored = float(np.linalg.norm(wheels.initial))
        limit[:3] = 0.0
    if actuation.thrusters is not None:
        thrusters = ThrusterSet(actuation.thrusters, sample_time=step)
        sets.append(_Units(wrenches=thrusters.wrenches * thrusters.force, least=0.0))
        limit[:] = 0.0
    return _Actuators(sets=sets, limit=limit, stored=stored)


def _held(
    actuators: _Actuators,
    momentum: np.ndarray,
    rows: np.ndarray,
    q: np.ndarray,
    lever: np.ndarray,
) -> float:
    """The linear program for the largest wrench against the momentum, with the base's origin at a
    ``lever`` (3, m) from the centre of mass.
    """
    from scipy.optimize import linprog

    turned = np.kron(np.eye(2), RotationMatrix(Quaternion(q[:4])).matrix())
    wrenches = [turned @ each.wrenches for each in actuators.sets]
    bounds = [(each.least, 1.0) for each in actuators.sets for _ in each.wrenches.T]
    # of the limits in world axes, the outputs themselves
    torque, force = np.split(np.hstack([*wrenches, np.eye(6)]), 2)
    bounds += [(-each, each) for each in actuators.limit.tolist()]
    wrench = np.vstack([torque + np.cross(lever, force.T).T, force])
    size = float(np.linalg.norm(momentum))
    found = linprog(
        np.r_[np.zeros(len(bounds)), -1.0],
        A_eq=np.column_stack([wrench, momentum / size])[rows],
        b_eq=np.zeros(rows.sum()),
        bounds=[*bounds, (0.0, None)],
    )
    if found.x is None:  # outputs without limits give any wrench
        return 0.0
    return size / float(found.x[-1]) if found.x[-1] > 0.0 else float("inf")


def _bound(actuators: _Actuators, momentum: np.ndarray, *, lever: float) -> float:
    """The largest share of momentum along a direction over what is given along it at most."""
    spin, linear = np.split(momentum, 2)
    torque, force = np.split(actuators.limit, 2)
    held = 2.0 * actuators.stored / max(float(np.linalg.norm(spin)), 1e-300)
    pushed, turned = 0.0, lever * float(np.linalg.norm(force)) if force.any() else 0.0
    for each in actuators.sets:
        own, pushing = np.split(each.wrenches, 2)
        pushed += _corner(each, np.zeros_like(pushing), pushing)
        turned += _corner(each, own, lever * pushing)
    return max(_time(linear, force, pushed), _time(spin * max(0.0, 1.0 - held), torque, turned))


def _time(momentum: np.ndarray, limit: np.ndarray, turning: float) -> float:
    """Least time of a momentum (3) with limits along the world's axes, and the most that units
    which turn with the base give along any direction.
    """
    size = float(np.linalg.norm(momentum))
    if size == 0.0:
        return 0.0
    drawn = np.random.default_rng(0).standard_normal((_DIRECTIONS, 3))
    along = np.vstack([momentum / size, np.eye(3), -np.eye(3), drawn])
    along /= np.linalg.norm(along, axis=1)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        given = np.where(along == 0.0, 0.0, np.abs(along) * limit).sum(axis=1) + turning
        return float(np.nan_to_num(along @ momentum / given, nan=0.0, posinf=np.inf).max())


def _corner(units: _Units, first: np.ndarray, second: np.ndarray) -> float:
    """The largest |first| + |second| (3, n) that combinations of units give."""
    sizes = np.linalg.norm(first, axis=0) + np.linalg.norm(second, axis=0)
    if sizes.size > _CORNERS:
        return float(sizes.sum())
    corners = np.array(list(itertools.product((0.0, 1.0), repeat=sizes.size)))
    corners = units.least + corners * (1.0 - units.least)
    norms = (np.linalg.norm(corners @ each.T, axis=1) for each in (first, second))
    return float(sum(norms).max())


def _largest_lever(model: PlantModel) -> float:
    """No posture has the centre of mass further from the base's origin, m."""
    plant, base = model.plant, base_body(model.plant)
    inboard = {
        joint.child_body().index(): joint for joint in map(plant.get_joint, plant.GetJointIndices())
    }

    def reach(body: RigidBody) -> float:
        """The largest distance of a body's origin from the base's: the way by its joints."""
        if body.index() == base.index():
            return 0.0
        joint = inboard[body.index()]
        way = reach(joint.parent_body())
        for frame in (joint.frame_on_parent(), joint.frame_on_child()):
            way += float(np.linalg.norm(frame.GetFixedPoseInBodyFrame().translation()))
        if joint.type_name() == "prismatic":
            limits = [*joint.position_lower_limits(), *joint.position_upper_limits()]
            way += float(np.abs(limits).max())
        return way

    total = weighted = 0.0
    for body in map(plant.get_body, inboard):
        mass, center = body.get_mass(model.context), body.CalcCenterOfMassInBodyFrame(model.context)
        total, weighted = total + mass, weighted + mass * (reach(body) + np.linalg.norm(center))
    return float(weighted / total)
