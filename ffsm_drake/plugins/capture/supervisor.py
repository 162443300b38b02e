"""The supervisor: the mode logic between plan, law and actuators.

It passes the plan to the law and the law's force to the actuators, unchanged, until the command
stays beyond the limits, an error leaves its bounds, or another block requests it (an output port
``abort_request``, above 0.5). Then it damps the rates,

    tau = -sigma kappa Hhat(q) v,   sigma = min(1, min_i limit_i / |kappa Hhat v|_i),

to lower the kinetic energy at every sample while kappa L lambda_max(H^-1 Hhat) < 2 (see
docs/rate_damping.md), and replans from the measured (q, v): the scenario's polynomial to the
target posture, in the first of 5 x 1.15^n s with inverse dynamics within ``plan_share`` of
every limit. The law restarts. Before the grasp, it replans immediately, without
damping, back to the start of the approach.
"""

import dataclasses
import enum
import functools
from collections.abc import Iterator, Sequence

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, InputPort, LeafSystem

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.plugins.capture.approach import approach_posture
from ffsm_drake.scenario import Reference, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates, tracking_errors
from ffsm_drake.spacecraft.plant import posture_of
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.limits import actuation_limit
from ffsm_drake.systems.part import STEPS, Figure, Metric, Part, Signal, Signals, View
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.polynomial_motion import PolynomialMotion
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.setup import BlockSetup

_SHORTEST, _GROWTH, _LONGEST = 5.0, 1.15, 600.0  # s, of a new plan
_INSTANTS = 41  # number of instants of a plan at which its force is compared with the limits


class Mode(enum.IntEnum):
    """Mode of a loop."""

    APPROACH = 0
    GRASP = 1  # the sample of the grasp
    STOP = 2  # the motion with the target held
    HOLD = 3  # its end posture
    RATE_DAMPING = 4
    RETREAT = 5

    @property
    def words(self) -> str:
        """As the report has it."""
        return self.name.lower().replace("_", " ")


class Cause(enum.IntEnum):
    """Reason for which the plan was abandoned."""

    NONE = 0
    SATURATED = 1
    ERROR = 2
    RATE = 3
    REQUEST = 4


class SupervisorPart(Part):
    """The section ``supervisor`` of a scenario."""

    title = "Supervisor"
    section = "Supervisor"
    about = "Modes: " + ", ".join(f"{mode.value} {mode.words}" for mode in Mode) + "."

    def __init__(self, *, begin: float = 0.0, waits: bool = False) -> None:
        """Args:
        begin: time of the run at which the scenario's own plan begins, s.
        waits: True: monitoring is off (while the gripper closes).
        """
        self._begin, self._waits = begin, waits

    @classmethod
    def of(cls, scenario: Scenario) -> "SupervisorPart | None":
        """The supervisor of a scenario."""
        return None if scenario.supervisor is None else cls()

    def build(self, setup: BlockSetup) -> LeafSystem:
        """The block."""
        return _Supervisor([setup], begin=self._begin, waits=self._waits)

    def build_wide(self, setups: Sequence[BlockSetup]) -> LeafSystem | None:
        """The block of several copies of the spacecraft, see ``systems.side_by_side``; None if
        their settings differ.
        """
        alike = {(each.scenario.holds, each.scenario.grasp_time) for each in setups}
        first = setups[0].scenario.supervisor
        if len(alike) > 1 or any(each.scenario.supervisor != first for each in setups):
            return None
        return _Supervisor(setups, begin=self._begin, waits=self._waits)

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """The mode, and what ended the one before rate damping."""
        causes = ", ".join(f"{cause.value} {cause.name.lower()}" for cause in Cause)
        return (
            Signal(
                name="mode",
                unit="1",
                meaning=", ".join(f"{mode.value} {mode.words}" for mode in Mode),
                heading="Mode",
                chart=STEPS,
            ),
            Signal(
                name="mode_cause",
                unit="1",
                meaning=f"reason for last abandoning a plan: {causes}",
                heading="",
                chart=STEPS,
            ),
        )

    def metrics(self) -> Sequence[Metric]:
        """Count and duration of rate damping, and the start of each mode."""
        return (
            Metric(
                key="supervisor.dampings",
                unit="1",
                label="Rate damping, count",
                of=lambda run: sum(mode == Mode.RATE_DAMPING for _, mode in _events(run)),
            ),
            Metric(
                key="supervisor.damped_time",
                unit="s",
                label="Rate damping, duration",
                of=lambda run: (
                    run.scenario.sample_time * float((run["mode"] == Mode.RATE_DAMPING).sum())
                ),
            ),
            Metric(
                key="supervisor.events",
                unit="s",
                label="Start of",
                column="",
                of=lambda run: {
                    f"{number} {mode.words}": time
                    for number, (time, mode) in enumerate(_events(run), start=1)
                },
            ),
        )

    def given_up(self, signals: Signals) -> str:
        """Rate damping, or a retreat, that lasts until the end."""
        modes = np.asarray(signals["mode"]).astype(int).ravel()
        last = Mode(int(modes[-1])) if modes.size else Mode.HOLD
        if last not in (Mode.RATE_DAMPING, Mode.RETREAT):
            return ""
        return f"its supervisor abandoned the plan and ended in {last.words}"

    def sentence(self, figures: Sequence[Figure]) -> str:
        """The modes with their times."""
        (events,) = (each.value for each in figures if each.key == "supervisor.events")
        assert isinstance(events, dict)
        named = (f"{name.partition(' ')[2]} from {time:.4g} s" for name, time in events.items())
        return f"Supervisor: {', '.join(named)}"


def _events(run: View) -> Iterator[tuple[float, Mode]]:
    """Begin (s) of each mode of a run."""
    modes = np.asarray(run["mode"]).astype(int).ravel()
    for k in np.flatnonzero(np.diff(modes, prepend=-1)):
        yield float(run.time[k]), Mode(int(modes[k]))


@dataclasses.dataclass(frozen=True, kw_only=True)
class NewPlan:
    """A motion from a state to rest, planned during a run.

    As a row (``as_row``) it stands in a context.
    """

    begin: float  # s
    duration: float  # s
    retreats: bool
    q: np.ndarray  # (nq) at its begin
    v: np.ndarray  # (nv)

    def as_row(self) -> np.ndarray:
        """[begin; duration; retreats; q; v]."""
        return np.concatenate([[self.begin, self.duration, self.retreats], self.q, self.v])

    @classmethod
    def from_row(cls, row: np.ndarray, num_positions: int) -> "NewPlan":
        """Build from a row of ``as_row``."""
        q, v = np.split(row[3:], [num_positions])
        return cls(begin=row[0], duration=row[1], retreats=bool(row[2]), q=q, v=v)

    def motion(self, scenario: Scenario, coordinates: Coordinates) -> PolynomialMotion:
        """As a function of the time since its begin."""
        goal = None if scenario.reference.goal == "stop" else scenario.target_posture
        if self.retreats and scenario.grasp_time > 0.0:
            goal = approach_posture(scenario)
        return PolynomialMotion(
            coordinates=coordinates,
            start=posture_of(self.q, coordinates),
            target=goal,
            blend=Blend(Reference(), self.duration),
            base_rotation="eigenaxis",
            sample_time=scenario.sample_time,
            velocity=self.v,
        )


class _Supervisor(LeafSystem):
    """The modes, with their memory in discrete state, updated once a control sample.

    Inputs: those of the block. Outputs: ``desired_state``, ``desired_acceleration``,
    ``generalized_force``, ``restart`` (1: the law starts afresh at this sample), ``mode``,
    ``mode_cause``. Of several copies of the spacecraft ports and memory hold copy after copy.
    """

    def __init__(self, setups: Sequence[BlockSetup], *, begin: float, waits: bool) -> None:
        super().__init__()
        self._scenarios = [setup.scenario for setup in setups]
        self._models = [setup.nominal for setup in setups]
        scenario, self._waits = self._scenarios[0], waits
        self._is_empty = not scenario.holds
        self._begin, self._grasp_time = begin, begin + scenario.grasp_time
        self._coordinates = coordinates = setups[0].coordinates
        self._nq, self._nv = len(coordinates.position_names), len(coordinates.names)
        assert scenario.supervisor is not None
        self._settings, self._step = scenario.supervisor, setups[0].sample_time
        self._limit, self._largest = (
            np.stack(
                [
                    actuation_limit(each, coordinates, helped=helped).upper
                    for each in self._scenarios
                ]
            )
            for helped in (False, True)
        )
        if not np.isfinite(self._limit).any():
            raise ScenarioError(
                "supervisor",
                "cannot detect saturation, because no force has a limit; set actuation.limit, "
                "actuation.thrusters or actuation.wheels",
            )
        self._bounds = [
            coordinates.vector(given or {}, key=f"supervisor.{name}", default=np.inf)
            for name, given in (("error", self._settings.error), ("rate", self._settings.rate))
        ]
        self._is_bounded = any(np.isfinite(bound).any() for bound in self._bounds)
        self._ends = [begin + self._rest(each) for each in self._scenarios]
        self._declare()
        self._motions = dict[int, tuple[bytes, PlannedMotion]]()  # a cache: of a copy's row
        untie(self)

    def _rest(self, scenario: Scenario) -> float:
        """End of a scenario's own motion, s."""
        end = scenario.planned_end
        return make_motion(scenario, self._coordinates).end if end is None else end

    def _declare(self) -> None:
        copies, nv, states = len(self._scenarios), self._nv, self._nq + self._nv
        self._measured = self.DeclareVectorInputPort("estimated_state", copies * states)
        self._planned = self.DeclareVectorInputPort("desired_state", copies * states)
        self._planned_acceleration = self.DeclareVectorInputPort(
            "desired_acceleration", copies * nv
        )
        self._command = self.DeclareVectorInputPort("generalized_force", copies * nv)
        self._request = self.DeclareVectorInputPort("abort_request", copies)
        first = Mode.APPROACH if self._is_before_grasp(0.0) else Mode.STOP
        sizes = {
            "mode": 1,
            "cause": 1,
            "restart": 1,  # 1 while the law restarts at each sample, with the force of damping
            # saturated time, time below ``end_share``, number of new plans, request before
            "counters": 4,
            "force": nv,
            "filtered": nv,
            "held": states,  # measured at the last sample of damping
            "plan": 3 + states,  # ``NewPlan``; duration 0: none
        }
        self._first = {name: np.zeros(size) for name, size in sizes.items()}
        self._first["mode"][:] = float(first)
        self._groups = {
            name: self.DeclareDiscreteState(np.tile(row, copies))
            for name, row in self._first.items()
        }
        own, read = self.xd_ticket(), self.input_port_ticket
        motion = {
            own,
            self.time_ticket(),
            read(self._planned.get_index()),
            read(self._planned_acceleration.get_index()),
        }
        for name, within in (
            ("desired_state", slice(0, states)),
            ("desired_acceleration", slice(states, states + nv)),
        ):
            self.DeclareVectorOutputPort(
                name,
                copies * (within.stop - within.start),
                functools.partial(weak_callback(self._calc_motion), within),
                motion,
            )
        self.DeclareVectorOutputPort(
            "generalized_force",
            copies * nv,
            weak_callback(self._calc_force),
            {own, read(self._command.get_index())},
        )
        for name, group in (("restart", "restart"), ("mode", "mode"), ("mode_cause", "cause")):
            self.DeclareStateOutputPort(name, self._groups[group])
        self.DeclarePeriodicDiscreteUpdateEvent(self._step, 0.0, weak_callback(self._update))

    def park(self, context: Context, copy: int) -> None:
        """Put a copy's memory to its start (``systems.side_by_side``)."""
        for name, rows in self._memory(context).items():
            rows[copy] = self._first[name]
            context.SetDiscreteState(self._groups[name], rows.ravel())

    def _memory(self, context: Context) -> dict[str, np.ndarray]:
        """A copy of the discrete state: rows of each group."""
        return {name: self._rows(context, name).copy() for name in self._groups}

    def _rows(self, context: Context, name: str) -> np.ndarray:
        values: np.ndarray = context.get_discrete_state(self._groups[name]).value()
        return values.reshape(len(self._scenarios), -1)

    def _of_each(self, port: InputPort, context: Context) -> np.ndarray:
        """The values of an input, a row for each copy."""
        values: np.ndarray = port.Eval(context)
        return values.reshape(len(self._scenarios), -1)

    def _calc_motion(self, within: slice, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._motion(context)[:, within].ravel())

    def _motion(self, context: Context) -> np.ndarray:
        """[q_d; v_d; a_d] of the plans in force; in rate damping the state last measured."""
        planned = self._of_each(self._planned, context)
        rows = np.hstack([planned, self._of_each(self._planned_acceleration, context)])
        damps = self._rows(context, "mode")[:, 0] == Mode.RATE_DAMPING
        plans = self._rows(context, "plan")
        for copy in np.flatnonzero(damps | (plans[:, 1] > 0.0)).tolist():
            rows[copy] = (
                np.concatenate([self._rows(context, "held")[copy], np.zeros(self._nv)])
                if damps[copy]
                else self._along(copy, plans[copy], context.get_time())
            )
        return rows

    def _along(self, copy: int, plan: np.ndarray, time: float) -> np.ndarray:
        """[q_d; v_d; a_d] of a copy's new plan."""
        key, since = plan.tobytes(), time - plan[0]
        if copy not in self._motions or self._motions[copy][0] != key:
            made = NewPlan.from_row(plan.copy(), self._nq)
            motion = made.motion(self._scenarios[copy], self._coordinates)
            self._motions[copy] = key, motion
        sample = round(since / self._step) * self._step
        return self._motions[copy][1].row(sample if abs(sample - since) < 1e-9 else since)

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        command = self._of_each(self._command, context)
        damped = self._rows(context, "restart") > 0.0
        if damped.any():
            command = np.where(damped, self._rows(context, "force"), command)
        output.SetFromVector(command.ravel())

    def _update(self, context: Context, values: DiscreteValues) -> None:
        memory, time = self._memory(context), context.get_time()
        state, command = (self._of_each(each, context) for each in (self._measured, self._command))
        was_damping = memory["mode"][:, 0] == Mode.RATE_DAMPING
        causes = self._causes(context, state, command, memory, was_damping)
        memory["restart"][~was_damping & (causes == Cause.NONE)] = 0.0
        for copy in range(len(self._scenarios)):
            row = {name: rows[copy] for name, rows in memory.items()}  # views
            is_damping = bool(was_damping[copy])
            if causes[copy] != Cause.NONE:
                row["cause"][0] = causes[copy]
                row["counters"][:2] = 0.0
                mode = self._react(copy, time, state[copy], command[copy], row)
            else:
                mode = Mode.RATE_DAMPING if is_damping else self._mode_at(copy, time, row["plan"])
            if mode == Mode.RATE_DAMPING:
                mode = self._damp(copy, time, state[copy], row, begins=not is_damping)
            row["mode"][0] = float(mode)
        for name, rows in memory.items():
            values.set_value(self._groups[name], rows.ravel())

    def _react(
        self,
        copy: int,
        time: float,
        state: np.ndarray,
        command: np.ndarray,
        row: dict[str, np.ndarray],
    ) -> Mode:
        """Rate damping; before the grasp a retreat at once, if there is a plan for it."""
        if not self._is_before_grasp(time):
            return Mode.RATE_DAMPING
        plan = self._plan_anew(copy, time, state, int(row["counters"][2]))
        if plan is None:
            return Mode.RATE_DAMPING
        row["counters"][2] += 1.0
        row["plan"][:] = plan.as_row()
        row["force"][:] = np.clip(command, -self._limit[copy], self._limit[copy])
        row["restart"][0] = 1.0
        return Mode.RETREAT

    def _is_before_grasp(self, time: float) -> bool:
        return self._is_empty or time < self._grasp_time - 0.5 * self._step

    def _causes(
        self,
        context: Context,
        state: np.ndarray,
        command: np.ndarray,
        memory: dict[str, np.ndarray],
        is_damping: np.ndarray,
    ) -> np.ndarray:
        """Why to damp the rates of each copy now, if there is a reason and it does not; the
        counters in ``memory`` are brought up to date.
        """
        causes = np.full(len(self._scenarios), Cause.NONE, dtype=int)
        if self._waits:
            return causes
        saturated, asked_before = memory["counters"][:, 0], memory["counters"][:, 3]
        commands = ~is_damping & (memory["restart"][:, 0] == 0.0)  # the law's force was commanded
        over = (np.abs(command) > self._largest).any(axis=1)
        counted = np.maximum(0.0, saturated + np.where(over, self._step, -self._step))
        saturated[commands] = counted[commands]
        if self._is_bounded:
            desired = self._motion(context)[:, : state.shape[1]]
            errors = tracking_errors(desired, state, self._nq)
            for cause, bound, error in zip(
                (Cause.RATE, Cause.ERROR), self._bounds[::-1], errors[::-1], strict=True
            ):
                causes[(np.abs(error) > bound).any(axis=1)] = cause
        causes[saturated > self._settings.saturated_time + 1e-9] = Cause.SATURATED
        if self._request.HasValue(context):
            asked = self._request.Eval(context) > 0.5
            causes[asked & (asked_before == 0.0)] = Cause.REQUEST
            asked_before[~is_damping] = asked[~is_damping]
        causes[is_damping] = Cause.NONE
        return causes

    def _damp(
        self, copy: int, time: float, state: np.ndarray, row: dict[str, np.ndarray], *, begins: bool
    ) -> Mode:
        """Command tau = -sigma kappa Hhat v, until kappa Hhat v, low-passed, has been small for a
        time and there is a plan from then on.
        """
        settings, limit = self._settings, self._limit[copy]
        q, v = np.split(state, [self._nq])
        wanted = settings.damping * (self._models[copy].calc_mass_matrix(q) @ v)
        scale = 1.0 / max(1.0, float((np.abs(wanted) / limit).max()))
        row["force"][:], row["held"][:], row["restart"][0] = -scale * wanted, state, 1.0
        filtered = wanted if begins else row["filtered"]
        filtered = filtered + min(1.0, self._step / settings.filter_time) * (wanted - filtered)
        row["filtered"][:], counters = filtered, row["counters"]
        is_quiet = (np.abs(filtered) <= settings.end_share * limit).all()
        counters[1] = counters[1] + self._step if is_quiet else 0.0
        if counters[1] >= settings.end_time - 1e-9:
            counters[1] = 0.0  # without a plan damping continues
            plan = self._plan_anew(copy, time, state, int(counters[2]))
            if plan is not None:
                counters[2] += 1.0
                row["plan"][:] = plan.as_row()
                return self._mode_at(copy, time, row["plan"])
        return Mode.RATE_DAMPING

    def _plan_anew(self, copy: int, time: float, state: np.ndarray, plans: int) -> NewPlan | None:
        """A plan from the measured state after a number of others. If no plan is within its share
        of the limits: None, or with an empty gripper the plan with the least use of them, since
        rate damping would leave the light joints to the disturbance.
        """
        settings, (q, v) = self._settings, np.split(state, [self._nq])
        most = settings.plan_share * settings.retry_factor**plans * self._limit[copy]
        retreats, duration = self._is_before_grasp(time), _SHORTEST
        least, gentlest = np.inf, None
        while duration <= _LONGEST:
            plan = NewPlan(begin=time, duration=duration, retreats=retreats, q=q, v=v)
            motion = plan.motion(self._scenarios[copy], self._coordinates)
            rows = motion.rows(np.linspace(0.0, duration, _INSTANTS))
            force = self._models[copy].calc_tracking_force(
                *np.split(rows, [self._nq, self._nq + self._nv], axis=1)
            )
            share = float((np.abs(force) / most).max())
            if share <= 1.0:
                return plan
            if retreats and share < least:
                least, gentlest = share, plan
            duration *= _GROWTH
        return gentlest

    def _mode_at(self, copy: int, time: float, plan: np.ndarray) -> Mode:
        """The mode outside rate damping."""
        if plan[1]:
            if plan[2]:
                return Mode.RETREAT
            return Mode.STOP if time < plan[0] + plan[1] - 1e-9 else Mode.HOLD
        if self._is_before_grasp(time):
            return Mode.APPROACH
        if self._grasp_time > 0.0 and time < self._grasp_time + 0.5 * self._step:
            return Mode.GRASP
        return Mode.STOP if time < self._ends[copy] - 1e-9 else Mode.HOLD
