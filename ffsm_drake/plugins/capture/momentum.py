"""The momentum of a captured target: its storage after the grasp, and the time until exhaustion.

Momentum stays in the stack unless a force or torque removes it. Momentum-storing actuators hold
angular momentum up to their limit, an arm as long as its joints can turn; the rest turns the stack,
and linear momentum makes it drift.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ffsm_drake.common.errors import ModelError
from ffsm_drake.common.numbers import number, percent
from ffsm_drake.common.so3 import in_body_axes, matrix_of, quaternion_rate
from ffsm_drake.mission import Mission, planned
from ffsm_drake.plugins.capture.contact import planned_contact
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.spacecraft.coordinates import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    position_errors,
)
from ffsm_drake.spacecraft.free_floating import FreeFloating, free_floating
from ffsm_drake.spacecraft.limits import FORCE, POSITION, RATE, tightest
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.mission_limits import joint_limits, limits_of
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.registry import base_actuators

LONGEST = 1000.0  # s; the budget looks no further
_INSTANTS = 201  # instants of the planned motion, and of the time after it as densely
_INSTANTS_AFTER = 2001
_STEP = 0.1  # rad or m, largest step of a joint in the arm's motion
_SHARE = 0.2  # largest step, as a share of the time until the first joint is at its limit
_LAST = 0.1  # s, remaining time that counts as zero
_TURN = 2.0 * math.pi  # rad or m, the range assumed of a joint without limits
_MOMENTA = {"base_rotation": "angular", "base_position": "linear"}
_BEYOND = f"more than {LONGEST:g} s"


@dataclasses.dataclass(frozen=True, kw_only=True)
class StorageBudget:
    """The momentum that an actuator stores while it holds the attitude, as shares of the limit of
    its units.
    """

    name: str  # section of the scenario
    momentum: float  # N m s; momentum to be held, including the initial one
    capacity: float  # N m s; along the momentum, at the end of the planned motion
    least_capacity: float  # N m s; along the worst direction
    share: float  # filled share of the fullest unit at the end; above 1 the attitude cannot be held
    peak_share: float  # over the planned motion
    fullest: str  # the unit of ``peak_share``
    least_time: float  # s; time for the largest torque to absorb the momentum


@dataclasses.dataclass(frozen=True, kw_only=True)
class ArmBudget:
    """The momentum that the arm holds by turning its joints, the base's attitude kept."""

    # N m s; along the momentum, within the joints' rate limits; None: no limits
    capacity: float | None
    # s; duration of the motion found that holds all of it; None: longer than ``LONGEST``
    time: float | None
    ended_by: str  # the limit that ends it; "" for none


@dataclasses.dataclass(frozen=True, kw_only=True)
class MomentumBudget:
    """The momentum after the planned grasp, with the nominal payload; world axes."""

    linear: list[float]  # N s
    angular: list[float]  # N m s; about the centre of mass, of the bodies alone
    mass: float  # kg; of servicer and target
    # s; by driven group of the base: the time in which its force or torque takes the momentum out
    # at the limit that holds in any direction; 0: no limit
    least_time: dict[str, float]
    storage: StorageBudget | None  # storage of the actuator that alone holds the attitude
    arm: ArmBudget | None  # where the attitude is undriven
    drift: float | None  # m/s; of the centre of mass; None: the base's position is driven
    # rad/s; of the stack with its joints at rest as planned; None: its attitude is held
    rate: float | None
    accepted: dict[str, float]  # ``capture.accepted_drift``, rad and m, by group
    # s after the grasp; by group, when the base has gone so far, as planned and then with its
    # joints at rest; None: not within ``LONGEST``
    used_up: dict[str, float | None]


@planned
def momentum_budget(mission: Mission) -> MomentumBudget | None:
    """The momentum budget of a mission after the grasp; None without a capture.

    The arm's time is the duration of a motion with all of the angular momentum in the arm at every
    instant, at rates chosen to delay the first joint limit; another motion may last longer. With a
    user-supplied reference the posture of the grasp is used.

    Raises:
      ModelError, ScenarioError: see ``make_motion``.
    """
    scenario, model = mission.scenario, mission.craft.nominal()
    if scenario.capture is None:
        return None
    accepted = scenario.capture.accepted_drift or {}
    contact = planned_contact(mission, model)
    name, storage = _storage(scenario)
    linear, of_bodies = contact.momentum_after[3:], contact.spin_after
    angular = of_bodies  # including stored momentum
    if storage is not None:
        angular = of_bodies + matrix_of(contact.q[:4]) @ storage.initial
    times, q, spin = _along(mission, model, contact.q)
    end = free_floating(model, q[-1])
    mass = float(end.mass_matrix[3, 3])
    speed = float(np.linalg.norm(linear)) / mass
    stored = on_arm = None
    turning = np.zeros(3)  # the part of ``angular`` that turns the stack
    if "base_rotation" in scenario.undriven:
        on_arm = _arm_budget(mission, model, contact.q, angular)
        turning = angular
    elif storage is not None and scenario.undriven:
        stored = _storage_budget(name, storage, q, angular - spin, angular)
        if stored.share > 1.0:
            turning = (1.0 - stored.capacity / float(np.linalg.norm(angular))) * angular
    limits = tightest(limits_of(mission), FORCE).upper
    least = {
        group: float((np.abs(momentum) / limits[model.coordinates.groups[group]]).max())
        for group, momentum in (("base_rotation", of_bodies), ("base_position", linear))
        if group in scenario.driven
    }
    used_up: dict[str, float | None] = {}
    if accepted:
        path = np.vstack([q[:-1, :NUM_BASE_POSITIONS], _coast(end, q[-1], linear, turning)])
        after = times[-1] + np.linspace(0.0, LONGEST, _INSTANTS_AFTER)
        used_up = _used_up(path, np.r_[times[:-1], after], accepted)
    return MomentumBudget(
        linear=linear.tolist(),
        angular=of_bodies.tolist(),
        mass=mass,
        least_time=least,
        storage=stored,
        arm=on_arm,
        drift=speed if "base_position" in scenario.undriven else None,
        rate=float(np.linalg.norm(np.linalg.solve(end.spin_map[:, :3], turning)))
        if turning.any()
        else None,
        accepted=dict(accepted),
        used_up=used_up,
    )


def _along(
    mission: Mission, model: PlantModel, q: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (n,), configurations (n, nq) and angular momentum of the bodies (n, 3), to the end of
    motion and run; without a known motion at the posture (nq) of the grasp alone.
    """
    scenario = mission.scenario
    if not scenario.undriven or scenario.blocks.reference is not None:
        return np.zeros(1), q[None], np.zeros((1, 3))
    motion = make_motion(mission)
    parts = max(1.0, scenario.duration / motion.end)
    times = np.linspace(0.0, parts * motion.end, math.ceil(parts * _INSTANTS))
    positions, v, _ = motion.evaluate(times)
    return times, positions, (free_floating(model, positions).spin_map @ v[..., None])[..., 0]


def _storage(scenario: Scenario) -> tuple[str, Any]:
    """The actuator that stores angular momentum, and the name of its section."""
    for name, part in base_actuators(scenario).items():
        if (storage := part.storage(scenario)) is not None:
            return name, storage
    return "", None


def _storage_budget(
    name: str, storage: Any, q: np.ndarray, stored: np.ndarray, angular: np.ndarray
) -> StorageBudget:
    """Args: section; storage; momentum (n, 3) that it holds in configurations (n, nq), and finally
    (3).
    """
    shares = storage.filled(in_body_axes(q[:, :4], stored))
    first, last = in_body_axes(q[[0, -1], :4], np.tile(angular, (2, 1)))
    fullest = int(np.argmax(shares.max(axis=0)))
    change = first - storage.initial
    return StorageBudget(
        name=name,
        momentum=float(np.linalg.norm(angular)),
        capacity=storage.capacity(last) if last.any() else storage.least_capacity,
        least_capacity=storage.least_capacity,
        share=float(storage.filled(last).max()),
        peak_share=float(shares.max()),
        fullest=storage.names[fullest],
        least_time=1.0 / storage.most(change) if change.any() else 0.0,
    )


def _arm_budget(
    mission: Mission, model: PlantModel, q: np.ndarray, angular: np.ndarray
) -> ArmBudget:
    """Turn the joints from a posture (nq) on so that they hold all of an angular momentum (3)."""
    scenario, limits = mission.scenario, joint_limits(mission)
    (_, rate), (lower, upper) = (tightest(limits, each).joints for each in (RATE, POSITION))
    capacity = _largest_held(free_floating(model, q), angular, rate)
    try:
        clearance = Clearance(scenario.model) if scenario.clearance > 0.0 else None
    except ModelError:  # shapes without a distance, which the plan's remarks report
        clearance = None
    q, time, ended_by, most = q.copy(), 0.0, "", np.minimum(rate, scenario.divergence_speed)
    arm = slice(NUM_BASE_POSITIONS, None)

    def found(q: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
        """Rates in a configuration, and the range left to the joints there."""
        room = np.stack([upper - q[arm], q[arm] - lower])
        stack, finite = free_floating(model, q), np.where(np.isfinite(room), room, _TURN)
        return _longest_lasting_rates(stack, angular, finite, most), room

    while time < LONGEST:
        rates, room = found(q)
        if rates is None:
            ended_by = "no joint rates hold it there"
            break
        own = np.where(rates > 0.0, room[0], room[1]) / np.maximum(np.abs(rates), 1e-300)
        first = int(np.argmin(own))
        if own[first] < _LAST:
            time += max(float(own[first]), 0.0)
            ended_by = f"{model.coordinates.joints[first]} reaches its limit"
            break
        if clearance and not (nearest := clearance.nearest(q)).keeps(scenario.clearance):
            ended_by = (
                f"{nearest.first} and {nearest.second} come within {scenario.clearance:g} "
                "m of each other"
            )
            break
        step = min(
            _STEP / max(float(np.abs(rates).max()), 1e-300), _SHARE * float(own[first]), LONGEST
        )
        middle = q.copy()
        middle[arm] += 0.5 * step * rates
        between = found(middle)[0]
        q[arm] += step * (rates if between is None else between)
        time += step
    return ArmBudget(capacity=capacity, time=time if ended_by else None, ended_by=ended_by)


def _largest_held(stack: FreeFloating, angular: np.ndarray, rate: np.ndarray) -> float | None:
    """The largest momentum along ``angular`` (3), N m s, of joints within their rates (n), the base
    at rest.
    """
    from scipy.optimize import linprog

    size = float(np.linalg.norm(angular))
    if size == 0.0:
        return None
    on_joints = stack.spin_map[:, NUM_BASE_VELOCITIES:]
    found = linprog(
        np.r_[np.zeros(rate.size), -1.0],
        A_eq=np.column_stack([on_joints, -angular / size]),
        b_eq=np.zeros(3),
        bounds=[*((-each, each) for each in rate), (0.0, None)],
    )
    return None if found.x is None else float(found.x[-1])


def _longest_lasting_rates(
    stack: FreeFloating, angular: np.ndarray, room: np.ndarray, most: np.ndarray
) -> np.ndarray | None:
    """Joint rates (n) of an angular momentum (3), the base at rest, that exhaust the first joint's
    range latest; None: there are none.

    Args: the range left to each joint upwards and downwards (2, n), rad or m; largest rates (n).
    """
    from scipy.optimize import linprog

    unit, count = np.eye(most.size), most.size
    found = linprog(
        np.r_[np.zeros(count), 1.0],
        A_ub=np.block([[unit, -room[0][:, None]], [-unit, -room[1][:, None]]]),
        b_ub=np.zeros(2 * count),
        A_eq=np.column_stack([stack.spin_map[:, NUM_BASE_VELOCITIES:], np.zeros(3)]),
        b_eq=angular,
        bounds=[*((-each, each) for each in most), (0.0, None)],
    )
    return None if found.x is None else found.x[:-1]


def _used_up(
    path: np.ndarray, times: np.ndarray, accepted: dict[str, float]
) -> dict[str, float | None]:
    """The time, s, by group, at which the base, with poses (n, 7) at times (n,), exceeds its
    accepted drift.
    """
    moved = position_errors(path, np.broadcast_to(path[0], path.shape))
    found: dict[str, float | None] = {}
    for group, most in accepted.items():
        gone = np.linalg.norm(moved[:, :3] if group == "base_rotation" else moved[:, 3:], axis=1)
        after = int(np.argmax(gone > most))
        pair = slice(after - 1, after + 1)
        found[group] = (
            float(np.interp(most, gone[pair], times[pair])) if gone[after] > most else None
        )
    return found


def _coast(
    stack: FreeFloating, q: np.ndarray, momentum: np.ndarray, turning: np.ndarray
) -> np.ndarray:
    """Poses (``_INSTANTS_AFTER``, 7) of the base over ``LONGEST`` with the joints at rest.

    Args: the stack in its configuration (nq); linear momentum (3); the angular one that turns it
    (3).
    """
    from scipy.integrate import solve_ivp

    R_WB, inertia, offset = matrix_of(q[:4]), stack.spin_map[:, :3], stack.center_of_mass
    times = np.linspace(0.0, LONGEST, _INSTANTS_AFTER)

    def turned(quaternion: np.ndarray) -> np.ndarray:
        """From then to now."""
        return matrix_of(quaternion) @ R_WB.T

    def rate(time: float, quaternion: np.ndarray) -> np.ndarray:
        R = turned(quaternion)
        return quaternion_rate(quaternion, R @ np.linalg.solve(inertia, R.T @ turning))

    found = solve_ivp(rate, (0.0, LONGEST), q[:4], t_eval=times, rtol=1e-9, atol=1e-12).y.T
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    center = q[4:NUM_BASE_POSITIONS] + offset + times[:, None] * momentum / stack.mass_matrix[3, 3]
    return np.hstack([found, center - np.array([turned(each) @ offset for each in found])])


def momentum_lines(budget: Mapping[str, Any] | None) -> list[str]:
    """A ``MomentumBudget`` as plain data in words, a line each; none without one."""
    if budget is None:
        return []
    linear, angular = (number(math.hypot(*budget[key])) for key in ("linear", "angular"))
    lines = [
        f"momentum after the planned grasp: {linear} N s, and {angular} N m s about the centre of "
        "mass"
    ]
    storage, arm, turning = budget["storage"], budget["arm"], ""
    if budget["rate"] is not None:
        turning = f"turns the stack at {number(math.degrees(budget['rate']), 3)} deg/s"
    for group, what in (("base_rotation", "torque"), ("base_position", "force")):
        if group in budget["least_time"] and (storage is None or group == "base_position"):
            least = budget["least_time"][group]
            within = (
                f" in {number(least, 3)} s at its limit in any direction" if least > 0.0 else ""
            )
            lines.append(f"{what} on the base removes the {_MOMENTA[group]} momentum{within}")
    if storage is not None:
        lines.append(
            f"{storage['name']}: the angular momentum of {number(storage['momentum'])} N m s fills "
            f"{storage['fullest']} to {percent(storage['share'])} (peak "
            f"{percent(storage['peak_share'])}), in at least {number(storage['least_time'], 3)} s"
            + (f"; the rest {turning}" if turning else "")
        )
        lines.append(
            f"{storage['name']}: capacity {number(storage['capacity'], 3)} N m s in this direction"
            f", {number(storage['least_capacity'], 3)} N m s in the worst direction"
        )
    if arm is not None:
        until, rates = _BEYOND, ""
        if arm["ended_by"]:
            until = f"{number(arm['time'], 3)} s, until {arm['ended_by']}"
        if arm["capacity"] is not None:
            rates = f"; its rate limits allow {number(arm['capacity'], 3)} N m s"
        lines.append(
            f"arm: it can hold the angular momentum, at constant base attitude, for {until}{rates}"
        )
        lines += [f"with its joints at rest the angular momentum {turning}"] if turning else []
    if budget["drift"] is not None:
        lines.append(
            f"linear momentum remains: the stack of {budget['mass']:g} kg drifts at "
            f"{number(1e3 * budget['drift'], 3)} mm/s"
        )
    for group, time in budget["used_up"].items():
        size = budget["accepted"][group]
        most = f"{math.degrees(size):.4g} deg" if group == "base_rotation" else f"{size:.4g} m"
        when = f"lasts {_BEYOND}" if time is None else f"exceeded {number(time)} s after the grasp"
        lines.append(f"accepted drift of {group}, {most}: {when}")
    return lines


def storage_remark(budget: MomentumBudget) -> str:
    """A warning where the angular momentum after a grasp exceeds its storage; else empty."""
    storage = budget.storage
    if storage is None or storage.peak_share <= 1.0:
        return ""
    left = number(storage.momentum, 3)
    return (
        f"{storage.name}: cannot hold the attitude after the grasp: {left} N m s fill "
        f"{storage.fullest} to {percent(storage.peak_share)} (capacity "
        f"{number(storage.capacity, 3)} N m s); use larger wheels or a slower tumble"
    )
