"""Planning of a scenario's motion: first guess, solution, and margins to every limit."""

import dataclasses
import math
import time
from collections.abc import Callable, Iterator

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix

from ffsm_drake.common.errors import FfsmError, ScenarioError
from ffsm_drake.common.numbers import short
from ffsm_drake.common.steps import step
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.planning.chain_dynamics import PLANNED_CHAINS, ChainDynamics
from ffsm_drake.plugins.planning.curve import INSTANTS
from ffsm_drake.plugins.planning.ends import Ends
from ffsm_drake.plugins.planning.inverse_dynamics import Dynamics, FreeDynamics, InverseDynamics
from ffsm_drake.plugins.planning.motion_limits import (
    Margin,
    margins,
    motion_limits,
    wrench_margins,
)
from ffsm_drake.plugins.planning.planned_report import PlannedMotionReport
from ffsm_drake.plugins.planning.program import PlanningProgram
from ffsm_drake.plugins.task_space.free_motion import FreeMotion
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.spacecraft.coordinates import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    position_errors,
)
from ffsm_drake.spacecraft.free_floating import free_floating
from ffsm_drake.spacecraft.limits import FORCE
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.plan import DEGREE, Plan
from ffsm_drake.systems.planned_motion import PathMotion, PlannedMotion
from ffsm_drake.systems.start import velocity_at_start

_FINE = 8 * INSTANTS  # instants per segment, at which a plan is checked
_POSTURES = 100  # number of instants for the clearance
_DURATIONS = np.geomspace(0.0025, 1.0, 31)  # durations of the first guess, as parts of the longest
_ATTEMPTS = 5  # at limits that are exceeded between the solver's instants
_TOO_SHORT = 0.05  # share of the time of the search that is not used for a further solution
_MORE = 1.002  # by which a plan is stretched beyond what its forces need
_ACCURACY = 1e-8  # relative accuracy of the undriven base's final pose
_AT_REST = 1e-9  # N m s
_DETOUR = 0.05  # rad; about each axis, of the base in the first guess
_SETTLES = (0.5, 1.0, 2.0, 4.0, 8.0)  # s; decay times of the rates at the end
_MOST_SEGMENTS = 100  # upper bound of a scenario's setting


class PlanningError(FfsmError):
    """No motion was found that keeps every limit."""


@step("planning the motion")
def plan_motion(
    scenario: Scenario,
    *,
    progress: Callable[[str], None] = lambda line: None,
    time_limit: float = math.inf,
) -> PlannedMotionReport:
    """Plan the motion of ``scenario.planning``, with the nominal payload.

    Args:
      scenario: posture and velocity at the start, limits, goal.
      progress: called with a line about once a second.
      time_limit: s of wall time for the search; then the best plan within every limit is taken.

    Raises:
      PlanningError: no motion keeps every limit, or none was found; names the active limit.
      ModelError, ScenarioError: the model or a value cannot be used.
    """
    planner = _Planner(scenario, progress, time_limit)
    planner.check_momentum()
    planner.check_ends()
    return planner.plan()


class _Planner:
    """The steps of planning one motion."""

    def __init__(
        self, scenario: Scenario, progress: Callable[[str], None], time_limit: float
    ) -> None:
        self._begun, self._evaluations = time.perf_counter(), 0
        self._time_limit = time_limit
        mission = asked = Mission(scenario)
        if len(scenario.contacts) > 1:
            mission = PLANNED_CHAINS.load("contacts", "contacts").begun(mission)
        self._begins = "initial_posture" if mission.scenario is scenario else "last closing"
        self._mission, scenario = mission, mission.scenario
        self._scenario, self._progress = scenario, progress
        model = self._model = mission.craft.nominal()
        self._limits = motion_limits(mission)
        hands = [(each.effector, each.frame) for each in scenario.contacts.values()]
        self._clearance = Clearance(scenario.model, hands=hands)
        self._start = configuration(
            model.coordinates, scenario.initial_posture, key="initial_posture"
        )
        self._rate = velocity_at_start(mission, model)
        first = RotationMatrix(Quaternion(self._start[:4]))
        self._planned = order = model.coordinates.driven  # indices of the z that is planned
        self._dynamics: Dynamics = InverseDynamics(model, first)
        self._chain: ChainDynamics | None = None
        free = np.arange(model.coordinates.num_velocities)  # all but followers
        if len(scenario.contacts) > 1:
            self._dynamics = self._chain = of = ChainDynamics(mission, model, first, self._limits)
            self._start, self._planned, free = of.chain.start, of.planned, of.chain.free
            order = np.concatenate([of.planned, of.chain.following])
        if scenario.undriven:
            driven = np.searchsorted(free, self._planned)
            mass = model.plant.CalcTotalMass(model.context)
            self._dynamics = FreeDynamics(self._dynamics, driven, free.size, mass)
        self._own_limits = self._limits.of(order)
        if scenario.reference.duration is None:
            raise ScenarioError(
                "reference.duration", "is auto; give the longest duration of the plan in s"
            )
        self._longest = scenario.reference.duration
        self._ends = Ends(asked, mission, self._start, self._rate, self._planned)
        self._momentum = self._momentum_of(self._start, self._rate)
        torque = float(np.max(self._limits.force[:3])) / (1.0 - scenario.planning.reserve)
        self._least = self._momentum / torque  # s; by torque on the base alone

    def _momentum_of(self, q: np.ndarray, v: np.ndarray) -> float:
        """Angular momentum about the centre of mass, N m s."""
        return float(np.linalg.norm(free_floating(self._model, q).spin_map @ v))

    def check_momentum(self) -> None:
        """Raise ScenarioError if joints alone would have to remove angular momentum."""
        if "base_rotation" in self._scenario.undriven and self._momentum > _AT_REST:
            raise ScenarioError(
                "actuation.driven",
                f"joints cannot remove the angular momentum of {short(self._momentum)} N m s; add "
                "base_rotation to actuation.driven, or set reference.kind: quintic",
            )

    def check_ends(self) -> None:
        """Raise PlanningError if the start or the goal is beyond a limit, which no plan can
        mend.
        """
        names, units = self._model.coordinates.names, self._model.coordinates.units
        limits, rate = self._limits, self._rate
        for i in np.flatnonzero(np.abs(rate) > limits.rate):
            raise PlanningError(
                f"no plan: {names[i]} starts at {rate[i]:.4g} {units[i]}/s, beyond its limit of "
                f"{limits.rate[i]:.4g}"
            )
        for what, posture in ((self._begins, self._start), ("target_posture", self._ends.posture)):
            if posture is None:
                continue
            joints = np.r_[np.zeros(NUM_BASE_VELOCITIES), posture[NUM_BASE_POSITIONS:]]
            for i in np.flatnonzero((joints < limits.lower) | (joints > limits.upper)):
                span = f"{limits.lower[i]:.4g} to {limits.upper[i]:.4g} {units[i]}"
                raise PlanningError(
                    f"no plan: {what}: {names[i]} at {joints[i]:.4g}, outside its limits {span}"
                )
            nearest = self._clearance.nearest(posture)
            if not nearest.keeps(self._scenario.clearance):
                raise PlanningError(
                    f"no plan: {what}: {nearest}, below clearance ({self._scenario.clearance:g} m)"
                )

    def plan(self) -> PlannedMotionReport:
        """Return the plan from the first guess that leads to one. Raises PlanningError if none
        does.
        """
        # An impulse limit leaves no room for a detour; without, that comes first.
        straight = self._scenario.planning.impulse_limit or self._scenario.undriven
        failures = []
        for angle in (0.0, _DETOUR) if straight else (_DETOUR, 0.0):
            problem = self._problem()
            found, said = self._solved(problem, self._first_guess(problem, angle))
            if not found.exceeded:
                return self._settled(found)
            failures.append((said, found))
            if self._is_over:
                found = self._stretched(found)
                if not found.exceeded:
                    return self._settled(found)
                break
            self._progress(f"first guess {len(failures)}: {said}")
        raise PlanningError(self._why_not(failures))

    def _stretched(self, found: PlannedMotionReport) -> PlannedMotionReport:
        """A plan from rest that takes longer, so that its forces keep their limits: at a share s of
        its speed they are s^2 as large.
        """
        for _ in range(_ATTEMPTS):
            beyond = [each for each in found.exceeded if each.quantity in ("force", "wrench")]
            if self._rate.any() or not beyond or len(beyond) < len(found.exceeded):
                break
            most = max(abs(each.value / each.limit) for each in beyond)
            longer = found.plan.duration * math.sqrt(_MORE * most)
            if longer > self._longest:
                break
            found = self._evaluated(dataclasses.replace(found.plan, duration=longer))
        return found

    @property
    def _time_left(self) -> float:
        """s of the search."""
        return self._begun + self._time_limit - time.perf_counter()

    @property
    def _is_over(self) -> bool:
        return self._time_left < _TOO_SHORT * self._time_limit

    def _solution(
        self, problem: PlanningProgram, unknowns: np.ndarray, *, moving: bool
    ) -> tuple[np.ndarray, str]:
        """A solution in at most half of the time that is left, so that others can follow, which
        keep the limits between the instants of the solver.
        """
        self._kept = 0.5 * self._time_left
        return problem.solve(unknowns, moving=moving)

    def _problem(self) -> PlanningProgram:
        scenario = self._scenario

        def report(evaluations: int, duration: float, worst: float) -> None:
            self._progress(
                f"{evaluations} evaluations in {time.perf_counter() - self._begun:.0f} s: "
                f"duration {duration:.3f} s, force up to {worst:.2f} of its limit"
            )

        ends = self._ends
        return PlanningProgram(
            dynamics=self._dynamics, planning=scenario.planning, limits=self._own_limits,
            start=ends.start, rate=ends.rate, goal=ends.goal, end=ends.frame,
            shortest=scenario.sample_time,
            longest=self._longest, clearance=self._clearance if scenario.clearance > 0.0 else None,
            distance=scenario.clearance, report=report,
            is_over=lambda: self._time_left < self._kept,
        )  # fmt: skip

    def _first_guess(self, problem: PlanningProgram, angle: float) -> np.ndarray:
        """Return the fifth-order polynomial from the start, at its rate, to rest, in the shortest
        feasible of a few times, with a detour of the base's attitude, rad.

        Without a detour a solver never leaves the plane of its first guess.
        """
        best, least, taken, refused = np.empty(0), np.inf, 0.0, ""
        for duration in np.unique(np.clip(_DURATIONS * self._longest, *problem.durations)):
            try:
                guess = problem.curve.guess(self._from_end_to_end(duration), duration)
            except ScenarioError as error:  # of a closed chain
                refused = str(error)
                continue
            worst = problem.worst(guess)
            if worst < least:
                best, least, taken = guess, worst, duration
            if worst <= 1.0:
                break
        if not best.size:
            raise PlanningError(f"no plan: no motion to begin with; {refused}")
        self._progress(f"first guess: fifth-order polynomial of {taken:.2f} s")
        turned = np.arange(self._planned.size) < 3
        return best + problem.curve.guess(
            lambda share: angle * np.sin(np.pi * share[:, None]) ** 2 * turned, 0.0
        )

    def _from_end_to_end(self, duration: float) -> Callable[[np.ndarray], np.ndarray]:
        """z of what is planned (n, size) by the shares (n,) of a duration, s, along a fifth-order
        polynomial.
        """
        if self._chain is not None:
            return self._chain.along(self._mission, duration, self._start[:4])
        return self._ends.polynomial(duration)

    def _solved(
        self, problem: PlanningProgram, unknowns: np.ndarray
    ) -> tuple[PlannedMotionReport, str]:
        """Return a plan from a first guess, with the solver's message.

        Between the solver's instants a limit may be exceeded: the search then continues with a
        smaller share of it.
        """
        before = self._evaluations
        unknowns, _ = self._solution(problem, unknowns, moving=False)
        for attempt in range(_ATTEMPTS):
            unknowns, said = self._solution(problem, unknowns, moving=attempt == 0)
            self._evaluations = before + problem.evaluations
            found = self._evaluated(self._plan_of(unknowns))
            is_last = attempt == _ATTEMPTS - 1 or self._is_over
            if not found.exceeded or said == "InfeasibleConstraints" or is_last:
                break
            problem.learn_end(unknowns, found.last)
            used = {margin.quantity: margin for margin in found.margins}
            turn, near = used.get("turn"), used.get("clearance")
            problem.tighten(
                self._rows_in_use(problem, found),
                0.0 if turn is None else turn.value / turn.limit,
                0.0 if near is None else near.excess,
                where=attempt < _ATTEMPTS // 2,
            )
        return found, said

    def _rows_in_use(self, problem: PlanningProgram, found: PlannedMotionReport) -> np.ndarray:
        """Shares of the limits of the solver's rows (m, rows) that a plan takes."""
        if self._chain is not None:
            return problem.used(*(each[self._planned] for each in found.plan.curve(found.times)))
        shares: np.ndarray = np.abs(found.force[:, self._planned]) / self._own_limits.force
        return shares

    def _plan_of(self, unknowns: np.ndarray) -> Plan:
        """Return the plan with these unknowns.

        Columns of undriven coordinates hold position and rate at the start alone, by which a run
        knows their momentum.
        """
        coordinates, segments = self._model.coordinates, self._scenario.planning.segments
        points, (duration,), change = np.split(unknowns, [-segments - 1, -segments])
        lengths = duration / segments + change
        every = np.tile(np.r_[np.zeros(3), self._start[4:]], (segments + DEGREE, 1))
        every[1:] += self._rate * lengths[0] / DEGREE
        second = every[1].copy()
        every[:, self._planned] = points.reshape(len(every), -1)
        # Constraints met within the solver's tolerance are enforced exactly.
        every[1] = second
        if self._scenario.planning.end_rate == 0.0:
            every[-2] = every[-1]
        plan = Plan(
            duration=float(duration),
            settle=0.0,
            first_attitude=tuple(self._start[:4].tolist()),
            coordinates=coordinates.names,
            knots=np.r_[0.0, np.cumsum(lengths[:-1]) / duration, 1.0],
            control_points=every,
        )
        return plan if self._chain is None else self._chain.closed(plan)

    def _evaluated(self, plan: Plan) -> PlannedMotionReport:
        """Cost and limits of a plan, between the solver's instants too."""
        model, limits, times = self._model, self._limits, plan.instants(_FINE)
        size, sample_time = model.coordinates.num_velocities, self._scenario.sample_time
        motion: PlannedMotion = PathMotion(
            plan, coordinates=model.coordinates, sample_time=sample_time
        )
        if self._chain is not None:
            motion = self._chain.chain.along(plan)
        if model.coordinates.undriven:
            motion = followed = FreeMotion(motion, model=model, sample_time=sample_time)
            followed.accuracy = _ACCURACY
        rows, found = motion.rows(times), dict[str, np.ndarray]()
        if isinstance(self._dynamics, InverseDynamics):
            force = self._dynamics.calc(*plan.curve(times)).T
        else:
            found = motion.demand(model, times)
            force = found[FORCE]
        # The impulse is limited up to the planned duration.
        main = times <= plan.duration
        impulse = np.trapezoid(np.abs(force[main]), times[main], axis=0)
        turns = np.linalg.norm(position_errors(rows, rows[:1])[:, :3], axis=1)
        last = np.split(rows[main][-1, : 2 * size + 1], [size + 1])
        kept = margins(limits, model, times, rows, force, impulse)
        if self._chain is not None:
            kept += wrench_margins(limits, times, found["contact_wrench"])
        kept += self._other_margins(times, rows[:, : size + 1], turns)
        kept += self._ends.margins(plan.duration, *last)
        return PlannedMotionReport(
            plan=plan,
            solve_time=time.perf_counter() - self._begun,
            evaluations=self._evaluations,
            effort=float(np.trapezoid((force[main] ** 2).sum(axis=1), times[main])),
            impulse={
                group: float(impulse[part].sum())
                for group, part in model.coordinates.groups.items()
            },
            angular_momentum=self._momentum,
            least_by_torque=self._least,
            momentum_left=self._momentum_of(*last),
            base_turn=None if model.coordinates.is_driven[0] else float(turns.max()),
            margins=tuple(kept),
            times=times,
            rows=rows,
            force=force,
            limits=limits,
        )

    def _other_margins(
        self, times: np.ndarray, positions: np.ndarray, turns: np.ndarray
    ) -> Iterator[Margin]:
        """Margins of the base's turn and of the distances between parts."""
        limit, k = self._scenario.planning.base_attitude_limit, int(np.argmax(turns))
        if limit is not None:
            yield Margin(
                quantity="turn", name="base", value=float(turns[k]), limit=limit,
                time=float(times[k]), unit="rad",
            )  # fmt: skip
        if self._clearance.pairs:
            every = max(1, len(times) // _POSTURES)
            approach = self._clearance.along(positions[::every])
            nearest = approach.nearest
            yield Margin(
                quantity="clearance", name=f"{nearest.first}, {nearest.second}",
                value=nearest.distance, limit=self._scenario.clearance,
                time=float(times[every * approach.index]), unit="m", at_least=True,
            )  # fmt: skip

    def _settled(self, found: PlannedMotionReport) -> PlannedMotionReport:
        """Return the plan with the shortest time for the rates at its end to die away within
        limits.

        Raises PlanningError if none is.
        """
        if self._scenario.planning.end_rate == 0.0:
            return found
        for settle in _SETTLES:
            found = self._evaluated(dataclasses.replace(found.plan, settle=settle))
            if not found.exceeded:
                return found
        raise PlanningError(
            f"no plan: the rates left by planning.end_rate do not die away in {settle:g} s; "
            f"active limit: {found.exceeded[0]}"
        )

    def _why_not(self, failures: list[tuple[str, PlannedMotionReport]]) -> str:
        """One line: the active limit, and a suggestion."""
        if self._least > self._longest:
            return (
                f"no plan: base torque within actuation.limit takes {self._least:.3g} s to remove "
                f"{short(self._momentum)} N m s; set reference.duration above {self._longest:g} s"
            )
        tried = ", ".join(said for said, _ in failures)
        worst = max(
            (margin for _, found in failures for margin in found.exceeded),
            key=lambda margin: margin.excess / max(abs(margin.limit), 1e-3),
        )
        if self._is_over:
            return (
                f"no plan that keeps every limit within {self._time_limit:g} s of search; active "
                f"limit: {worst}; give it more time, or fewer planning.segments"
            )
        segments = self._scenario.planning.segments
        more = min(2 * segments, _MOST_SEGMENTS)
        segments = more if more > segments else segments // 2
        return (
            f"no plan in {self._longest:g} s keeps every limit ({tried}); active limit: {worst}; "
            f"try planning.segments {segments} or a longer reference.duration"
        )
