"""From a scenario to a plan: first guess, solution, and how near the plan comes to every limit."""

import dataclasses
import functools
import time
from collections.abc import Callable

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.solvers import SolutionResult

from ffsm_drake.common.errors import FfsmError, ScenarioError
from ffsm_drake.common.so3 import rotation_error
from ffsm_drake.control_design.planning.free_dynamics import FreeDynamics
from ffsm_drake.control_design.planning.limits import Margin, MotionLimits, margins, motion_limits
from ffsm_drake.control_design.planning.program import PlanningProgram
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.capture import velocity_at_start
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.spacecraft.coordinates import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    position_errors,
)
from ffsm_drake.spacecraft.inverse_dynamics import InverseDynamics
from ffsm_drake.spacecraft.nominal import PlantModel, make_nominal_plant
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.free_motion import FreeMotion
from ffsm_drake.systems.plan import DEGREE, Plan
from ffsm_drake.systems.reference import SplineMotion

_INSTANTS = 401  # at which a plan is looked at
_DURATIONS = np.geomspace(0.0025, 1.0, 31)  # of the first guess, as parts of the longest
# at keeping forces between the solver's instants; share by which they are cut beyond need
_ATTEMPTS, _LESS = 3, 0.005
# short of the optimum, where what limits a motion has kinks
_STALLED = SolutionResult.kSolverSpecificError
_ACCURACY = 1e-8  # of where the undriven base goes, relative
_FURTHER = 2e-3  # m; by which parts keep off each other beyond need
_AT_REST = 1e-9  # N m s
_DETOUR = 0.05  # rad; about each axis, of the base in the first guess
_SETTLES = (0.5, 1.0, 2.0, 4.0, 8.0)  # s, in which rates at the end die away


class PlanningError(FfsmError):
    """No motion was found that keeps every limit."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PlannedMotionReport:
    """A plan, and what it takes."""

    plan: Plan
    solve_time: float  # s of wall time
    evaluations: int
    effort: float  # integral of the squared force, up to the plan's duration: what ISV counts
    # by group: integral of the force's size summed over its coordinates, up to the duration
    impulse: dict[str, float]
    # |H0| about the centre of mass, N m s, and the least time in which torque on the base alone
    # takes it out, s
    angular_momentum: float
    least_by_torque: float
    momentum_left: float  # N m s; |H| about the centre of mass at ``plan.duration``
    # rad; the largest, where momentum turns the base, from its first attitude
    base_turn: float | None
    margins: tuple[Margin, ...]
    times: np.ndarray  # (n,), s, to the end of the plan
    rows: np.ndarray  # [q_d; v_d; dv_d/dt] (n, nq + 2 nv)
    force: np.ndarray  # (n, nv), N m and N
    limits: MotionLimits


def plan_motion(
    scenario: Scenario, *, progress: Callable[[str], None] = lambda line: None
) -> PlannedMotionReport:
    """Plan the motion that ``scenario.planning`` asks for, with the nominal payload.

    Args:
      scenario: posture and velocity at the start, limits, goal.
      progress: called with a line about once a second.

    Raises:
      PlanningError: no motion keeps every limit, or none was found; names the limit in the way.
      ModelError, ScenarioError: the model or a value cannot be used.
    """
    begun = time.perf_counter()
    model, planning = make_nominal_plant(scenario), scenario.planning
    coordinates = model.coordinates
    limits = motion_limits(scenario, model)
    q = configuration(model.plant, scenario.initial_posture, key="initial_posture")
    target = configuration(model.plant, scenario.target_posture, key="target_posture")
    rate = velocity_at_start(scenario, model)
    longest = scenario.reference.duration
    if longest is None:
        raise ScenarioError(
            "reference.duration", "is auto; a plan needs the longest time that it may take, s"
        )
    start, goal = np.r_[np.zeros(3), q[4:]], np.r_[np.zeros(3), target[4:]]
    goal[:3] = rotation_error(target[:4], q[:4])
    free = scenario.reference.goal == "stop"
    clearance = Clearance(scenario.model)
    momentum = _angular_momentum(model, q, rate)
    size = float(np.linalg.norm(momentum))
    largest = float(np.max(limits.force[:3]))
    least = size / largest if np.isfinite(largest) else 0.0
    driven = coordinates.driven
    if "base_rotation" in scenario.undriven and size > _AT_REST:
        raise ScenarioError(
            "actuation.driven",
            f"joints alone cannot take out the angular momentum of {size:.3g} N m s, and a plan "
            "with it is not found "
            "here; have base_rotation driven, or take reference.kind quintic",
        )
    _check_ends(scenario, model, limits, clearance, q=q, rate=rate, target=None if free else target)

    everything = InverseDynamics(model, RotationMatrix(Quaternion(q[:4])))
    dynamics = FreeDynamics(everything, coordinates) if scenario.undriven else everything

    def report(evaluations: int, duration: float, worst: float) -> None:
        progress(
            f"{evaluations} evaluations in {time.perf_counter() - begun:.0f} s: duration "
            f"{duration:.3f} s, "
            f"force up to {worst:.2f} of its limit"
        )

    problem = PlanningProgram(
        dynamics=dynamics, planning=planning, limits=limits.of(driven), start=start[driven],
        rate=rate[driven], goal=None if free else goal[driven],
        shortest=planning.segments * scenario.sample_time, longest=longest,
        clearance=clearance if scenario.clearance > 0.0 else None, distance=scenario.clearance,
        largest_turn=planning.base_attitude_limit, report=report,
    )  # fmt: skip
    allowed = limits.force[driven] * (1.0 - planning.reserve)
    guess = _first_guess(problem, allowed, start[driven], rate[driven], goal[driven], free=free)
    progress(f"first guess: fifth-order polynomial of {guess[-1]:.2f} s")
    failures = []
    # An impulse limit leaves no room for a detour; without, that comes first.
    angles = (
        (0.0, _DETOUR) if planning.impulse_limit or everything is not dynamics else (_DETOUR, 0.0)
    )
    for number, angle in enumerate(angles, start=1):
        detour = functools.partial(_detour, size=driven.size, angle=angle)
        unknowns, share, turn = (
            guess + problem.guess(detour, 0.0),
            1.0,
            planning.base_attitude_limit,
        )
        further = 0.0
        for _ in range(_ATTEMPTS):
            problem.tighten(share, turn)
            problem.keep_off(further)
            result, points, duration = problem.solve(unknowns)
            plan = Plan(
                duration=duration,
                settle=0.0,
                first_attitude=tuple(q[:4].tolist()),
                coordinates=coordinates.names,
                control_points=_of_all(points, rate * duration, driven),
            )
            found = _looked_at(plan, model, everything, limits, clearance, scenario)
            solved = result.is_success() or (
                dynamics.turns and result.get_solution_result() == _STALLED
            )
            kept = solved and all(margin.kept for margin in found.margins)
            used = {
                name: _used(found.margins, name)
                for name in (("force", "turn") if dynamics.turns else ("force",))
            }
            near = (
                [m for m in found.margins if m.quantity == "clearance" and not m.kept]
                if dynamics.turns
                else []
            )
            if kept or not solved or (max(used.values()) <= 1.0 and not near):
                break
            # Between the instants that the solver looks at, force and turn are larger: on from here
            # with less of them.
            further += sum(margin.limit - margin.value + _FURTHER for margin in near)
            share /= max(used["force"] + _LESS, 1.0)
            if turn is not None and used.get("turn", 0.0) > 1.0:
                turn /= used["turn"] + _LESS
            unknowns = np.r_[points.ravel(), duration]
        if kept:
            break
        failures.append((result.get_solution_result().name.removeprefix("k"), found))
        progress(f"first guess {number}: {failures[-1][0]}")
    else:
        raise PlanningError(_why_not(failures, scenario, size, least))
    if planning.end_rate > 0.0:
        for settle in _SETTLES:
            found = _looked_at(
                dataclasses.replace(plan, settle=settle),
                model,
                everything,
                limits,
                clearance,
                scenario,
            )
            if all(margin.kept for margin in found.margins if margin.quantity != "impulse"):
                break
    return dataclasses.replace(
        found,
        solve_time=time.perf_counter() - begun,
        evaluations=problem.evaluations,
        angular_momentum=size,
        least_by_torque=least,
    )


def _angular_momentum(model: PlantModel, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """About the centre of mass, world axes (3,), N m s."""
    plant, context = model.plant, model.context
    plant.SetPositionsAndVelocities(context, np.r_[q, v])
    center = plant.CalcCenterOfMassPositionInWorld(context)
    momentum: np.ndarray = plant.CalcSpatialMomentumInWorldAboutPoint(context, center).rotational()
    return momentum


def _check_ends(
    scenario: Scenario,
    model: PlantModel,
    limits: MotionLimits,
    clearance: Clearance,
    *,
    q: np.ndarray,
    rate: np.ndarray,
    target: np.ndarray | None,
) -> None:
    """Raise PlanningError where the start or the goal is beyond a limit, which no plan can mend."""
    names, units = model.coordinates.names, model.coordinates.units
    for i in np.flatnonzero(np.abs(rate) > limits.rate):
        raise PlanningError(
            f"no plan: {names[i]} starts at {rate[i]:.4g} {units[i]}/s, beyond its limit of "
            f"{limits.rate[i]:.4g}"
        )
    for what, posture in (("initial_posture", q), ("target_posture", target)):
        if posture is None:
            continue
        joints = np.r_[np.zeros(NUM_BASE_VELOCITIES), posture[NUM_BASE_POSITIONS:]]
        for i in np.flatnonzero((joints < limits.lower) | (joints > limits.upper)):
            span = f"{limits.lower[i]:.4g} to {limits.upper[i]:.4g} {units[i]}"
            raise PlanningError(
                f"no plan: {what}: {names[i]} at {joints[i]:.4g}, outside its limits {span}"
            )
        nearest = clearance.nearest(posture)
        if nearest.distance < scenario.clearance:
            raise PlanningError(
                f"no plan: {what}: {nearest.first} and {nearest.second} are "
                f"{nearest.distance:.3g} m apart, below "
                f"clearance ({scenario.clearance:g} m)"
            )


def _first_guess(
    problem: PlanningProgram,
    allowed: np.ndarray,
    start: np.ndarray,
    rate: np.ndarray,
    goal: np.ndarray,
    *,
    free: bool,
) -> np.ndarray:
    """The fifth-order polynomial from the start, at its rate, to rest, in the shortest of a few
    times that fits.
    """
    best, least = np.empty(0), np.inf
    shortest, longest = problem.durations
    for duration in np.unique(np.clip(_DURATIONS * longest, shortest, longest)):
        first = rate * duration
        change = 0.5 * first if free else goal - start

        def curve(
            share: np.ndarray, change: np.ndarray = change, first: np.ndarray = first
        ) -> np.ndarray:
            x = share[:, None]
            return (
                start
                + first * x
                + (10 * change - 6 * first) * x**3
                + (8 * first - 15 * change) * x**4
                + (6 * change - 3 * first) * x**5
            )

        guess = problem.guess(curve, duration)
        worst = float(np.max(np.abs(problem.evaluate(guess)[0]) / allowed))
        if worst < least:
            best, least = guess, worst
        if worst <= 1.0:
            break
    return best


def _detour(share: np.ndarray, size: int, angle: float) -> np.ndarray:
    """A detour of the base's attitude (n, size): a solver never leaves a plane that its first guess
    lies in.
    """
    return angle * np.sin(np.pi * share[:, None]) ** 2 * (np.arange(size) < 3)


def _used(found: tuple[Margin, ...], quantity: str) -> float:
    """The largest share of a limit that is used."""
    return max(
        (abs(margin.value / margin.limit) for margin in found if margin.quantity == quantity),
        default=0.0,
    )


def _of_all(points: np.ndarray, change: np.ndarray, driven: np.ndarray) -> np.ndarray:
    """Control points (count, nv) of driven ones (count, na): the others' have but the rate at the
    start, ``change``/T.

    That is what their momentum is known by; a run then has them where it takes them.
    """
    result = np.zeros((len(points), change.size))
    result[1:] = change / (DEGREE * (len(points) - DEGREE))
    result[:, driven] = points
    return result


def _looked_at(
    plan: Plan,
    model: PlantModel,
    dynamics: InverseDynamics,
    limits: MotionLimits,
    clearance: Clearance,
    scenario: Scenario,
) -> PlannedMotionReport:
    """What a plan takes and leaves, on a finer grid than it was made on."""
    times = np.linspace(0.0, plan.end, _INSTANTS)
    z, rate, acceleration = plan.curve(times)
    if model.coordinates.undriven:
        planned = SplineMotion(
            plan, coordinates=model.coordinates, sample_time=scenario.sample_time
        )
        followed = FreeMotion(planned, model=model, sample_time=scenario.sample_time)
        followed.accuracy = _ACCURACY
        rows = followed.rows(times)
        force = model.calc_tracking_force(*np.split(rows, [len(z) + 1, 2 * len(z) + 1], axis=1))
    else:
        rows, force = plan.rows(times), dynamics.force(z, rate, acceleration).T
    main = times <= plan.duration
    found = margins(limits, model, times, rows, force)
    within = margins(limits, model, times[main], rows[main], force[main])
    # The impulse is limited up to the duration, as it was planned.
    found = [m for m in found if m.quantity != "impulse"] + [
        m for m in within if m.quantity == "impulse"
    ]
    num_positions = len(model.coordinates.position_names)
    turns, base_turn, largest_turn = (
        np.linalg.norm(z[:3], axis=0),
        None,
        scenario.planning.base_attitude_limit,
    )
    if not model.coordinates.is_driven[0]:
        turns = np.linalg.norm(
            position_errors(rows, np.broadcast_to(rows[0], rows.shape))[:, :3], axis=1
        )
        base_turn = float(turns.max())
    if largest_turn is not None:
        k = int(np.argmax(turns))
        turn, time_of = float(turns[k]), float(times[k])
        found.append(
            Margin(
                quantity="turn",
                name="base",
                value=turn,
                limit=largest_turn,
                time=time_of,
                unit="rad",
            )
        )
    if clearance.pairs:
        approach = clearance.along(rows[::4, :num_positions])
        nearest = approach.nearest
        found.append(
            Margin(
                quantity="clearance",
                name=f"{nearest.first}, {nearest.second}",
                value=nearest.distance,
                limit=scenario.clearance,
                time=float(times[4 * approach.index]),
                unit="m",
            )
        )
    last = rows[main][-1]
    left = _angular_momentum(
        model,
        last[:num_positions],
        last[num_positions : num_positions + plan.control_points.shape[1]],
    )
    impulses = np.trapezoid(np.abs(force[main]), times[main], axis=0)
    return PlannedMotionReport(
        plan=plan,
        solve_time=0.0,
        evaluations=0,
        effort=float(np.trapezoid((force[main] ** 2).sum(axis=1), times[main])),
        impulse={
            group: float(impulses[part].sum()) for group, part in model.coordinates.groups.items()
        },
        angular_momentum=0.0,
        least_by_torque=0.0,
        momentum_left=float(np.linalg.norm(left)),
        base_turn=base_turn,
        margins=tuple(found),
        times=times,
        rows=rows,
        force=force,
        limits=limits,
    )


def _why_not(
    failures: list[tuple[str, PlannedMotionReport]],
    scenario: Scenario,
    momentum: float,
    least: float,
) -> str:
    """One line: which limit is in the way."""
    longest = scenario.reference.duration
    if longest is not None and least > longest:
        return (
            f"no plan: base torque within actuation.limit takes {least:.3g} s to take out the "
            "angular momentum of "
            f"{momentum:.3g} N m s, more than reference.duration ({longest:g} s)"
        )
    broken = [margin for _, found in failures for margin in found.margins if not margin.kept]
    tried = ", ".join(status for status, _ in failures)
    if not broken:
        return f"no plan was found ({tried}); try another planning.segments or reference.duration"

    def excess(margin: Margin) -> float:
        return abs(margin.value - margin.limit) / max(abs(margin.limit), 1e-3)

    worst = max(broken, key=excess)
    return f"no plan in {longest:g} s keeps every limit ({tried}); in the way: {worst}"
