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
from collections.abc import Callable

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame

from ffsm_drake.plugins.actuators.thrusters import ThrusterSet
from ffsm_drake.plugins.actuators.wheels import WheelSet
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
    """Actuators of the base: largest wrenches (6, n; torque about the base's origin, force), and
    the least share of each: 0 or -1.
    """

    wrenches: np.ndarray
    least: np.ndarray
    turn_with_base: bool  # True: axes fixed in the base; False: in the world


def least_times(
    scenario: Scenario, model: PlantModel, q: np.ndarray, *, spin: np.ndarray, linear: np.ndarray
) -> LeastTimes:
    """Least times from a configuration q (nq) with angular momentum ``spin`` (3; about the centre
    of mass, N m s) and ``linear`` momentum (3; N s), world axes; only the driven coordinates of the
    base count.

    Raises ScenarioError: errors of the actuators.
    """
    sets, stored = _units(scenario, model)
    rows = np.repeat([g in scenario.driven for g in ("base_rotation", "base_position")], 3)
    momentum = np.where(rows, np.concatenate([spin, linear]), 0.0)
    if not momentum.any():
        return LeastTimes(bound=0.0, held=0.0)
    stack = free_floating(model, q)
    lever = _largest_lever(model)
    return LeastTimes(
        bound=_bound(sets, momentum, lever=lever, stored=stored),
        held=_held(sets, momentum, rows, q, -stack.center_of_mass),
    )


def _units(scenario: Scenario, model: PlantModel) -> tuple[list[_Units], float]:
    """The base's actuators, and the angular momentum that wheels hold at the start, N m s."""
    actuation, step, stored, sets = scenario.actuation, scenario.sample_time, 0.0, list[_Units]()
    limit = model.coordinates.vector(actuation.limit or {}, key="actuation.limit", default=np.inf)[
        :6
    ]
    if actuation.wheels is not None:
        wheels = WheelSet(actuation.wheels, sample_time=step, alone=actuation.thrusters is None)
        torques = np.vstack([wheels.reach, np.zeros_like(wheels.reach)])
        least = -np.ones(torques.shape[1])
        sets.append(_Units(wrenches=torques, least=least, turn_with_base=True))
        stored = float(np.linalg.norm(wheels.initial))
        limit[:3] = 0.0
    if actuation.thrusters is not None:
        thrusters = ThrusterSet(actuation.thrusters, sample_time=step)
        wrenches = thrusters.wrenches * thrusters.force
        least = np.zeros(wrenches.shape[1])
        sets.append(_Units(wrenches=wrenches, least=least, turn_with_base=True))
        limit[:] = 0.0
    for group, part in (("base_rotation", slice(0, 3)), ("base_position", slice(3, 6))):
        if group not in scenario.driven:
            limit[part] = 0.0
    if limit.any():
        sets.append(_Units(wrenches=np.diag(limit), least=-np.ones(6), turn_with_base=False))
    return sets, stored


def _held(
    sets: list[_Units], momentum: np.ndarray, rows: np.ndarray, q: np.ndarray, lever: np.ndarray
) -> float:
    """The linear program, with the base's origin at a ``lever`` (3, m) from the centre of mass."""
    from scipy.optimize import linprog

    R_WB, columns = RotationMatrix(Quaternion(q[:4])).matrix(), list[np.ndarray]()
    for each in sets:
        torque, force = np.split(each.wrenches, 2)
        if each.turn_with_base:
            torque, force = R_WB @ torque, R_WB @ force
        unlimited = ~np.isfinite(np.abs(each.wrenches).sum(axis=0))
        force = np.where(unlimited, np.sign(force), force)
        torque = np.where(unlimited, np.sign(torque), torque)
        columns.append(np.vstack([torque + np.cross(lever, force.T).T, force]))
    wrenches = np.hstack(columns)[rows]
    least = np.concatenate([each.least for each in sets])
    free = np.concatenate([~np.isfinite(np.abs(each.wrenches).sum(axis=0)) for each in sets])
    count, limited = least.size, np.flatnonzero(~free)
    unit = np.eye(count)[limited]
    # the impulse x of each stays within [least T, T]; T is the last unknown
    found = linprog(
        np.r_[np.zeros(count), 1.0],
        A_ub=np.vstack([
            np.column_stack([unit, -np.ones(limited.size)]),
            np.column_stack([-unit, least[limited]]),
        ]),
        b_ub=np.zeros(2 * limited.size),
        A_eq=np.column_stack([wrenches, np.zeros(len(wrenches))]),
        b_eq=-momentum[rows],
        bounds=[*((None, None) for _ in range(count)), (0.0, None)],
    )  # fmt: skip
    return float(found.x[-1]) if found.x is not None else float("inf")


def _bound(sets: list[_Units], momentum: np.ndarray, *, lever: float, stored: float) -> float:
    """The largest share of momentum along a direction over what is given along it at most."""
    spin, linear = np.split(momentum, 2)
    return max(
        _time(sets, linear, _most_force),
        _time(
            sets,
            spin * max(0.0, 1.0 - 2.0 * stored / max(float(np.linalg.norm(spin)), 1e-300)),
            lambda each, along: _most_torque(each, along, lever),
        ),
    )


def _time(
    sets: list[_Units], momentum: np.ndarray, most: Callable[[_Units, np.ndarray], np.ndarray]
) -> float:
    size = float(np.linalg.norm(momentum))
    if size == 0.0:
        return 0.0
    drawn = np.random.default_rng(0).standard_normal((_DIRECTIONS, 3))
    along = np.vstack([momentum / size, np.eye(3), -np.eye(3), drawn])
    along /= np.linalg.norm(along, axis=1)[:, None]
    given = sum((most(each, along) for each in sets), np.zeros(len(along)))
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.nan_to_num(along @ momentum / given, nan=0.0, posinf=np.inf).max())


def _most_force(units: _Units, along: np.ndarray) -> np.ndarray:
    """The largest force along directions (n, 3) in any attitude, N."""
    force = units.wrenches[3:]
    if not units.turn_with_base:
        return _box(along, np.abs(force).sum(axis=1))
    return np.full(len(along), _corner(units, np.zeros(3), force))


def _most_torque(units: _Units, along: np.ndarray, lever: float) -> np.ndarray:
    """The largest torque about the centre of mass along directions (n, 3), N m, in any attitude,
    the base's origin at most a ``lever`` (m) away.
    """
    torque, force = np.split(units.wrenches, 2)
    if not units.turn_with_base:
        largest = float(np.linalg.norm(np.abs(force).sum(axis=1)))
        turned = 0.0 if largest == 0.0 else lever * largest
        return _box(along, np.abs(torque).sum(axis=1)) + turned
    return np.full(len(along), _corner(units, torque, lever * force))


def _box(along: np.ndarray, limit: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        parts = np.abs(along) * limit
    total: np.ndarray = np.where(np.abs(along) > 0.0, parts, 0.0).sum(axis=1)
    return total


def _corner(units: _Units, first: np.ndarray, second: np.ndarray) -> float:
    """The largest |first| + |second| (3, n) that combinations of units give."""
    first = np.broadcast_to(first if first.ndim == 2 else first[:, None], second.shape)
    sizes = np.linalg.norm(first, axis=0) + np.linalg.norm(second, axis=0)
    if sizes.size > _CORNERS:
        return float(sizes.sum())
    corners = np.array(list(itertools.product((0.0, 1.0), repeat=sizes.size)))
    corners = units.least + corners * (1.0 - units.least)
    norms = (np.linalg.norm(corners @ each.T, axis=1) for each in (first, second))
    return float(sum(norms).max())


def _largest_lever(model: PlantModel) -> float:
    """No posture has the centre of mass further from the base's origin, m."""
    plant, total, weighted = model.plant, 0.0, 0.0
    far = _reaches(plant)
    for body, reach in far.items():
        own = plant.get_body(body)
        mass = own.get_mass(model.context)
        center = own.CalcCenterOfMassInBodyFrame(model.context)
        total, weighted = total + mass, weighted + mass * (reach + float(np.linalg.norm(center)))
    return weighted / total


def _reaches(plant: MultibodyPlant) -> dict[BodyIndex, float]:
    """The largest distance of each body's origin from the base's, m: the way by its joints."""

    def size(frame: Frame) -> float:
        return float(np.linalg.norm(frame.GetFixedPoseInBodyFrame().translation()))

    found, joints = {base_body(plant).index(): 0.0}, plant.GetJointIndices()
    for joint in map(plant.get_joint, [*joints] * len(joints)):  # in any order
        parent, child = joint.parent_body().index(), joint.child_body().index()
        if parent not in found or child in found:
            continue
        slides = joint.type_name() == "prismatic"
        limits = [*joint.position_lower_limits(), *joint.position_upper_limits()]
        way = size(joint.frame_on_parent()) + size(joint.frame_on_child())
        found[child] = found[parent] + way + (float(np.abs(limits).max()) if slides else 0.0)
    return found
