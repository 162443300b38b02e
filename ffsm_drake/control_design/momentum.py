"""The momentum of a captured target: where it can go after the grasp, and how long that lasts.

What nothing takes out stays in the stack. Wheels hold angular momentum until one is at its speed
limit, an arm as long as its joints can go on turning; what neither holds turns the stack, and
linear momentum moves it on.
"""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix

from ffsm_drake.common.errors import ModelError
from ffsm_drake.common.memo import memoized
from ffsm_drake.common.numbers import number, percent
from ffsm_drake.common.so3 import quaternion_rate
from ffsm_drake.scenario import Capture, Scenario, planned_part
from ffsm_drake.spacecraft.capture import planned_contact
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.spacecraft.coordinates import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    position_errors,
)
from ffsm_drake.spacecraft.free_floating import FreeFloating, free_floating
from ffsm_drake.spacecraft.limits import FORCE, POSITION, RATE, tightest
from ffsm_drake.spacecraft.nominal import PlantModel, make_nominal_plant
from ffsm_drake.spacecraft.plant import files_read
from ffsm_drake.systems.actuation.wheels import WheelSet
from ffsm_drake.systems.limits import joint_limits, limits_of
from ffsm_drake.systems.reference import make_motion

LONGEST = 1000.0  # s that are looked at
_INSTANTS = 201  # of a planned motion that are looked at, and after it as densely to the run's end
_INSTANTS_AFTER = 2001
_STEP = 0.1  # rad or m of a joint between two looks at the arm
_SHARE = 0.2  # of the time that is left to the joint that reaches its limit first, likewise
_OVER = 0.1  # s; when less of it is left
_TURN = 2.0 * math.pi  # what a joint without limits counts as having left
_MOMENTA = {"base_rotation": "angular", "base_position": "linear"}
_BEYOND = "longer than was looked at"


@dataclasses.dataclass(frozen=True, kw_only=True)
class WheelBudget:
    """What wheels take of the momentum while they hold the attitude; shares are of a wheel's speed
    limit.
    """

    capacity: float  # N m s; along the momentum, at the end of the planned motion
    least_capacity: float  # N m s; along the worst direction
    share: float  # of the fullest wheel at the end; beyond 1 the wheels cannot hold the attitude
    peak_share: float  # over the planned motion
    fullest: str  # the wheel of ``peak_share``
    least_time: float  # s; in which the motors' torque takes the momentum up


@dataclasses.dataclass(frozen=True, kw_only=True)
class ArmBudget:
    """What the arm takes by turning its joints while the base's attitude stays as it is at the
    grasp.
    """

    # N m s; along the momentum, within the joints' rate limits; None: there are none
    capacity: float | None
    time: float | None  # s for which a motion was found that holds it all; None: beyond ``LONGEST``
    ended_by: str  # what is in the way then; "" for nothing


@dataclasses.dataclass(frozen=True, kw_only=True)
class MomentumBudget:
    """The momentum after the planned grasp, with the nominal payload; world axes."""

    linear: list[float]  # N s
    angular: list[float]  # N m s; about the centre of mass, that of wheels included
    mass: float  # kg; of servicer and target
    # s; by driven group of the base, the least in which its force or torque takes the momentum out;
    # 0: no limit
    least_time: dict[str, float]
    wheels: WheelBudget | None  # where they alone hold the attitude
    arm: ArmBudget | None  # where nothing else does
    drift: float | None  # m/s; of the centre of mass; None: the base's position is driven
    # rad/s; of the stack with its joints at rest as planned; None: its attitude is held
    rate: float | None
    accepted: dict[str, float]  # ``capture.accepted_drift``, rad and m, by group
    # s after the grasp; by group, when the base has gone so far, as planned and then with its
    # joints at rest; None: not within ``LONGEST``
    used_up: dict[str, float | None]


def momentum_budget(scenario: Scenario) -> MomentumBudget | None:
    """Where the momentum of a scenario's target can go after the grasp; None without a capture.

    The arm's time is that of a motion that holds all of the angular momentum at every instant, with
    the rates that use up no joint's range sooner than they must; another may last longer.
    User-supplied references are not known here: the posture is then that of the grasp.

    Raises:
      ModelError, ScenarioError: as ``make_motion``.
    """
    if scenario.capture is None:
        return None
    return _budget_of(planned_part(scenario), files_read(scenario))


@memoized(maxsize=16)  # a run's check, its record and its report ask for the same
def _budget_of(scenario: Scenario, files: tuple[Path, ...]) -> MomentumBudget:
    """Of a scenario whose model and plan are made from ``files``."""
    accepted = (scenario.capture or Capture()).accepted_drift or {}
    model = make_nominal_plant(scenario)
    contact = planned_contact(scenario, model)
    wheels = None
    if scenario.wheels is not None:
        alone = scenario.actuation.thrusters is None
        wheels = WheelSet(scenario.wheels, sample_time=scenario.sample_time, alone=alone)
    linear, angular = contact.momentum_after[3:], contact.spin_after
    if wheels is not None:
        angular = angular + _attitude(contact.q) @ wheels.axes @ wheels.initial_momentum
    times, q, spin = _along(scenario, model, contact.q)
    end = free_floating(model, q[-1])
    mass = float(end.mass_matrix[3, 3])
    on_wheels = on_arm = None
    turning = np.zeros(3)  # of ``angular``, what turns the stack
    if "base_rotation" in scenario.undriven:
        on_arm = _arm_budget(scenario, model, contact.q, angular)
        turning = angular
    elif wheels is not None and scenario.undriven:
        on_wheels = _wheel_budget(wheels, q, angular - spin, angular)
        if on_wheels.share > 1.0:
            turning = (1.0 - on_wheels.capacity / float(np.linalg.norm(angular))) * angular
    limits = tightest(limits_of(scenario, model.plant), FORCE).upper
    least = {
        group: float((np.abs(momentum) / limits[model.coordinates.groups[group]]).max())
        for group, momentum in (("base_rotation", angular), ("base_position", linear))
        if group in scenario.driven
    }
    used_up: dict[str, float | None] = {}
    if accepted:
        path = np.vstack([q[:-1, :NUM_BASE_POSITIONS], _coast(end, q[-1], linear, turning)])
        used_up = _used_up(
            path,
            np.r_[times[:-1], times[-1] + np.linspace(0.0, LONGEST, _INSTANTS_AFTER)],
            accepted,
        )
    return MomentumBudget(
        linear=linear.tolist(),
        angular=angular.tolist(),
        mass=mass,
        least_time=least,
        wheels=on_wheels,
        arm=on_arm,
        drift=float(np.linalg.norm(linear)) / mass
        if "base_position" in scenario.undriven
        else None,
        rate=float(np.linalg.norm(np.linalg.solve(end.spin_map[:, :3], turning)))
        if turning.any()
        else None,
        accepted=dict(accepted),
        used_up=used_up,
    )


def _along(
    scenario: Scenario, model: PlantModel, q: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (n,), configurations (n, nq) and angular momentum of all but wheels (n, 3), to the end
    of motion and run.

    Where no motion is known, of the posture (nq) at the grasp.
    """
    if not scenario.undriven or scenario.blocks.reference is not None:
        return np.zeros(1), q[None], np.zeros((1, 3))
    motion = make_motion(scenario, model.coordinates)
    parts = max(1.0, scenario.duration / motion.end)
    times = np.linspace(0.0, parts * motion.end, math.ceil(parts * _INSTANTS))
    positions, v, _ = np.split(
        motion.rows(times), np.cumsum([q.size, len(model.coordinates.names)]), axis=1
    )
    return times, positions, (free_floating(model, positions).spin_map @ v[..., None])[..., 0]


def _attitude(q: np.ndarray) -> np.ndarray:
    return RotationMatrix(Quaternion(q[:4])).matrix()


def _wheel_budget(
    wheels: WheelSet, q: np.ndarray, stored: np.ndarray, angular: np.ndarray
) -> WheelBudget:
    """Args: momentum (n, 3) in the wheels in configurations (n, nq), and what is left in them at
    the end (3).
    """
    turn = np.array([_attitude(each) for each in q])  # R_WB
    shares = wheels.filled(np.einsum("nji,nj->ni", turn, stored))
    first, last = (turn[i].T @ angular for i in (0, -1))
    fullest = int(np.argmax(shares.max(axis=0)))
    change = first - wheels.axes @ wheels.initial_momentum
    return WheelBudget(
        capacity=wheels.capacity(last) if last.any() else wheels.least_capacity,
        least_capacity=wheels.least_capacity,
        share=float(wheels.filled(last).max()),
        peak_share=float(shares.max()),
        fullest=wheels.names[fullest],
        least_time=1.0 / wheels.most(change) if change.any() else 0.0,
    )


def _arm_budget(
    scenario: Scenario, model: PlantModel, q: np.ndarray, angular: np.ndarray
) -> ArmBudget:
    """Turn the joints from a posture (nq) on so that they hold all of an angular momentum (3), as
    long as they can.
    """
    limits = joint_limits(scenario, model.plant)
    (_, rate), (lower, upper) = (tightest(limits, each).joints for each in (RATE, POSITION))
    capacity = _most(free_floating(model, q), angular, rate)
    try:
        clearance = Clearance(scenario.model) if scenario.clearance > 0.0 else None
    except ModelError:  # shapes without a distance, of which the plan's remarks tell
        clearance = None
    q, time, ended_by, most = q.copy(), 0.0, "", np.minimum(rate, scenario.divergence_speed)
    arm = slice(NUM_BASE_POSITIONS, None)

    def found(q: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
        """Rates in a configuration, and the room of the joints there."""
        room = np.stack([upper - q[arm], q[arm] - lower])
        return _evenest(
            free_floating(model, q), angular, np.where(np.isfinite(room), room, _TURN), most
        ), room

    while time < LONGEST:
        rates, room = found(q)
        if rates is None:
            ended_by = "no joint rates hold it there"
            break
        own = np.where(rates > 0.0, room[0], room[1]) / np.maximum(np.abs(rates), 1e-300)
        first = int(np.argmin(own))
        if own[first] < _OVER:
            time += max(float(own[first]), 0.0)
            ended_by = f"{model.coordinates.joints[first]} reaches its limit"
            break
        if (
            clearance is not None
            and (nearest := clearance.nearest(q)).distance < scenario.clearance
        ):
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


def _most(stack: FreeFloating, angular: np.ndarray, rate: np.ndarray) -> float | None:
    """The largest momentum along ``angular`` (3) that joints within their rates (n) hold, the base
    at rest; N m s.
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


def _evenest(
    stack: FreeFloating, angular: np.ndarray, room: np.ndarray, most: np.ndarray
) -> np.ndarray | None:
    """Joint rates (n) that hold an angular momentum (3), the base at rest, and use up no range
    sooner than they must.

    Args: what each joint has left upwards and downwards (2, n), rad or m; the largest rates (n).
    None: there are none.
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
    """When the base, with poses (n, 7) at times (n,), has gone farther than accepted, s, by
    group.
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

    R_WB, inertia, offset = _attitude(q), stack.spin_map[:, :3], stack.center_of_mass
    times = np.linspace(0.0, LONGEST, _INSTANTS_AFTER)

    def turned(quaternion: np.ndarray) -> np.ndarray:
        """From then to now."""
        return _attitude(quaternion / np.linalg.norm(quaternion)) @ R_WB.T

    def rate(time: float, quaternion: np.ndarray) -> np.ndarray:
        R = turned(quaternion)
        return quaternion_rate(quaternion, R @ np.linalg.solve(inertia, R.T @ turning))

    found = solve_ivp(rate, (0.0, LONGEST), q[:4], t_eval=times, rtol=1e-9, atol=1e-12).y.T
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    center = q[4:NUM_BASE_POSITIONS] + offset + times[:, None] * momentum / stack.mass_matrix[3, 3]
    return np.hstack([found, center - np.array([turned(each) @ offset for each in found])])


def momentum_lines(budget: Mapping[str, Any] | None) -> list[str]:
    """Where the momentum can go after a grasp (``MomentumBudget`` as plain data), a line each; none
    without.
    """
    if budget is None:
        return []
    linear, angular = (number(math.hypot(*budget[key])) for key in ("linear", "angular"))
    lines = [
        f"after the grasp as planned: {linear} N s, and {angular} N m s about the centre of mass"
    ]
    wheels, arm, turning = budget["wheels"], budget["arm"], ""
    if budget["rate"] is not None:
        turning = f"turns the stack at {number(180.0 / math.pi * budget['rate'], 3)} deg/s"
    for group, what in (("base_rotation", "torque"), ("base_position", "force")):
        if group in budget["least_time"] and (wheels is None or group == "base_position"):
            least = budget["least_time"][group]
            within = f" in {number(least, 3)} s at the least" if least > 0.0 else ""
            lines.append(f"{what} on the base takes out the {_MOMENTA[group]} momentum{within}")
    if wheels is not None:
        rest = f"; what they do not hold {turning}" if turning else ""
        lines.append(
            f"wheels: the angular momentum takes {percent(wheels['share'])} of the speed of "
            f"{wheels['fullest']}, up to "
            f"{percent(wheels['peak_share'])} on the way, and {number(wheels['least_time'], 3)} s "
            "at the least; they "
            f"hold {number(wheels['capacity'], 3)} N m s along it, "
            f"{number(wheels['least_capacity'], 3)} along the "
            f"worst direction{rest}"
        )
    if arm is not None:
        rates = (
            ""
            if arm["capacity"] is None
            else (f"; its rate limits allow {number(arm['capacity'], 3)} N m s")
        )
        until = (
            f"{number(arm['time'], 3)} s, until {arm['ended_by']}" if arm["ended_by"] else _BEYOND
        )
        lines.append(
            f"arm: it can hold the angular momentum, the base's attitude kept, for {until}{rates}"
        )
        lines += [f"with its joints at rest the angular momentum {turning}"] if turning else []
    if budget["drift"] is not None:
        speed = f"{number(1e3 * budget['drift'], 3)} mm/s"
        lines.append(
            f"nothing takes out the linear momentum: the stack of {budget['mass']:g} kg "
            f"drifts at {speed}"
        )
    for group, time in budget["used_up"].items():
        size = budget["accepted"][group]
        most = f"{math.degrees(size):.4g} deg" if group == "base_rotation" else f"{size:.4g} m"
        when = (
            f"lasts for {_BEYOND}"
            if time is None
            else (f"is used up {number(time)} s after the grasp")
        )
        lines.append(f"accepted drift of {group}, {most}: {when}")
    return lines


def storage_remark(budget: MomentumBudget) -> str:
    """Says so when the wheels cannot hold what a grasp leaves; empty where they can."""
    wheels = budget.wheels
    if wheels is None or wheels.peak_share <= 1.0:
        return ""
    return (
        f"actuation.wheels: {wheels.fullest} has to take {100.0 * wheels.peak_share:.3g} % of its "
        f"most to hold the attitude after the grasp; {np.linalg.norm(budget.angular):.3g} N m s "
        f"are left in the stack, along which the wheels hold {wheels.capacity:.3g}"
    )
