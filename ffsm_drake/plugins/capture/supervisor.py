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
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.plugins.capture.approach import approach_posture
from ffsm_drake.scenario import Reference, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import posture_of
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.limits import actuation_limit
from ffsm_drake.systems.part import STEPS, Figure, Metric, Part, Signal, Signals, View
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.polynomial_motion import PolynomialMotion
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.sampled import Arrays, Now, Sampled
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
        return _Supervisor(setup, begin=self._begin, waits=self._waits)

    def watch(self, setup: BlockSetup) -> "Watch":
        """What the block does while it lets plan and force pass."""
        return _watch(setup, begin=self._begin, waits=self._waits)

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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Watch(Sampled):
    """The supervisor without requests, until it acts.

    Inputs: ``estimated_state``, ``desired_state``, and ``generalized_force``, the law's at the
    sample before. Outputs: ``mode`` and ``mode_cause``, which is not 0 if it acts at this sample.
    Memory: the time for which the force was beyond the limits, s.
    """

    model: PlantModel  # the nominal one
    largest: np.ndarray  # limits (nv) of the force
    error: np.ndarray  # bounds (nv)
    rate: np.ndarray
    is_bounded: bool
    waits: bool
    saturated_time: float  # s
    sample_time: float  # s
    grasp_time: float  # s
    end: float  # s, of the scenario's own motion
    is_empty: bool  # the gripper
    in_phase: ClassVar = ("grasp_time", "end", "is_empty")

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        nv = len(self.largest)
        return dict.fromkeys(("estimated_state", "desired_state"), 2 * nv + 1) | {
            "generalized_force": nv
        }

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return {"mode": 1, "mode_cause": 1}

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled."""
        return {"over": np.zeros(1)}

    def phase(self, sample: Any) -> Sequence[Any]:
        """The mode."""
        times = self.sample_time * np.atleast_1d(sample)
        modes = np.array([float(self.mode_at(time)) for time in times.tolist()])
        return [modes.reshape(np.shape(sample))]

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        state, desired = inputs["estimated_state"], inputs["desired_state"]
        cause, over = np.zeros_like(memory["over"]), memory["over"]
        if not self.waits:
            cause, over = self.look(over, inputs["generalized_force"], desired, state)
        return {"mode": np.reshape(now.phase, 1), "mode_cause": cause}, {"over": over}

    def look(
        self, over: np.ndarray, force: np.ndarray | None, desired: np.ndarray, state: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the cause (1) to act, and the time (1) for which the force was beyond the limits.

        Args: this time before, the force of the law, if it was commanded, and the two states.
        """
        cause = np.zeros_like(over)
        if force is not None:
            step, is_over = self.sample_time, (np.abs(force) > self.largest).any()
            over = np.maximum(0.0, over + np.where(is_over, step, -step))
        if self.is_bounded:
            errors = self.model.calc_tracking_errors(desired, state, len(self.largest) + 1)
            for each, bound, error in zip(
                (Cause.RATE, Cause.ERROR), (self.rate, self.error), errors[::-1], strict=True
            ):
                cause = np.where((np.abs(error) > bound).any(), float(each), cause)
        is_long = over > self.saturated_time + 1e-9
        return np.where(is_long, float(Cause.SATURATED), cause), over

    def is_before_grasp(self, time: float) -> bool:
        """Whether the gripper is empty at a time, s."""
        return self.is_empty or time < self.grasp_time - 0.5 * self.sample_time

    def mode_at(self, time: float) -> Mode:
        """Return the mode along the scenario's own plan at a time, s."""
        if self.is_before_grasp(time):
            return Mode.APPROACH
        if self.grasp_time > 0.0 and time < self.grasp_time + 0.5 * self.sample_time:
            return Mode.GRASP
        return Mode.STOP if time < self.end - 1e-9 else Mode.HOLD


def _watch(setup: BlockSetup, *, begin: float, waits: bool) -> Watch:
    """Raises ScenarioError: no force has a limit."""
    scenario, coordinates, settings = setup.scenario, setup.coordinates, setup.scenario.supervisor
    assert settings is not None
    largest = actuation_limit(scenario, coordinates, helped=True).upper
    error, rate = (
        coordinates.vector(given or {}, key=f"supervisor.{name}", default=np.inf)
        for name, given in (("error", settings.error), ("rate", settings.rate))
    )
    rest = scenario.planned_end  # of the scenario's own motion, s
    return Watch(
        model=setup.nominal,
        largest=largest,
        error=error,
        rate=rate,
        is_bounded=bool(np.isfinite([error, rate]).any()),
        waits=waits,
        saturated_time=settings.saturated_time,
        sample_time=setup.sample_time,
        grasp_time=begin + scenario.grasp_time,
        end=begin + (make_motion(scenario, coordinates).end if rest is None else rest),
        is_empty=not scenario.holds,
    )


class _Supervisor(LeafSystem):
    """The modes, with their memory in discrete state, updated once a control sample.

    Inputs: those of the block. Outputs: ``desired_state``, ``desired_acceleration``,
    ``generalized_force``, ``restart`` (1: the law starts afresh at this sample), ``mode``,
    ``mode_cause``.
    """

    def __init__(self, setup: BlockSetup, *, begin: float, waits: bool) -> None:
        super().__init__()
        self._scenario = scenario = setup.scenario
        self._model, self._watch = setup.nominal, _watch(setup, begin=begin, waits=waits)
        self._coordinates = coordinates = setup.coordinates
        self._nq, self._nv = len(coordinates.position_names), len(coordinates.names)
        assert scenario.supervisor is not None
        self._settings, self._step = scenario.supervisor, setup.sample_time
        self._limit = actuation_limit(scenario, coordinates, helped=False).upper
        if not np.isfinite(self._limit).any():
            raise ScenarioError(
                "supervisor",
                "cannot detect saturation, because no force has a limit; set actuation.limit, "
                "actuation.thrusters or actuation.wheels",
            )
        self._declare()
        self._motion_of: tuple[bytes, PlannedMotion] | None = None  # a cache, of a new plan's row
        untie(self)

    def _declare(self) -> None:
        nv, states = self._nv, self._nq + self._nv
        self._measured = self.DeclareVectorInputPort("estimated_state", states)
        self._planned = self.DeclareVectorInputPort("desired_state", states)
        self._planned_acceleration = self.DeclareVectorInputPort("desired_acceleration", nv)
        self._command = self.DeclareVectorInputPort("generalized_force", nv)
        self._request = self.DeclareVectorInputPort("abort_request", 1)
        first = {
            "mode": [float(Mode.APPROACH if self._watch.is_before_grasp(0.0) else Mode.STOP)],
            "cause": np.zeros(1),
            "restart": np.zeros(1),  # 1 while the law restarts at each sample, with damping's force
            # saturated time, time below ``end_share``, number of new plans, request before
            "counters": np.zeros(4),
            "force": np.zeros(nv),
            "filtered": np.zeros(nv),
            "held": np.zeros(states),  # measured at the last sample of damping
            "plan": np.zeros(3 + states),  # ``NewPlan``; duration 0: none
        }
        self._groups = {name: self.DeclareDiscreteState(row) for name, row in first.items()}
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
                within.stop - within.start,
                functools.partial(weak_callback(self._calc_motion), within),
                motion,
            )
        self.DeclareVectorOutputPort(
            "generalized_force",
            nv,
            weak_callback(self._calc_force),
            {own, read(self._command.get_index())},
        )
        for name, group in (("restart", "restart"), ("mode", "mode"), ("mode_cause", "cause")):
            self.DeclareStateOutputPort(name, self._groups[group])
        self.DeclarePeriodicDiscreteUpdateEvent(self._step, 0.0, weak_callback(self._update))

    def _memory(self, context: Context) -> dict[str, np.ndarray]:
        """A copy of the discrete state, by group."""
        return {name: self._now(context, name).copy() for name in self._groups}

    def _now(self, context: Context, name: str) -> np.ndarray:
        values: np.ndarray = context.get_discrete_state(self._groups[name]).value()
        return values

    def _calc_motion(self, within: slice, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._motion(context)[within])

    def _motion(self, context: Context) -> np.ndarray:
        """[q_d; v_d; a_d] of the plan in force; in rate damping the state last measured."""
        if self._now(context, "mode")[0] == Mode.RATE_DAMPING:
            return np.concatenate([self._now(context, "held"), np.zeros(self._nv)])
        plan = self._now(context, "plan")
        if plan[1] > 0.0:
            return self._along(plan, context.get_time())
        planned = self._planned, self._planned_acceleration
        return np.concatenate([port.Eval(context) for port in planned])

    def _along(self, plan: np.ndarray, time: float) -> np.ndarray:
        """[q_d; v_d; a_d] of a new plan."""
        key, since = plan.tobytes(), time - plan[0]
        if self._motion_of is None or self._motion_of[0] != key:
            made = NewPlan.from_row(plan.copy(), self._nq)
            self._motion_of = key, made.motion(self._scenario, self._coordinates)
        sample = round(since / self._step) * self._step
        return self._motion_of[1].row(sample if abs(sample - since) < 1e-9 else since)

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        damped = self._now(context, "restart")[0] > 0.0
        output.SetFromVector(self._now(context, "force") if damped else self._command.Eval(context))

    def _update(self, context: Context, values: DiscreteValues) -> None:
        memory, time = self._memory(context), context.get_time()
        state, command = self._measured.Eval(context), self._command.Eval(context)
        was_damping = bool(memory["mode"][0] == Mode.RATE_DAMPING)
        cause = self._cause(context, state, command, memory)
        if cause != Cause.NONE:
            memory["cause"][0] = cause
            memory["counters"][:2] = 0.0
            mode = self._react(time, state, command, memory)
        elif was_damping:
            mode = Mode.RATE_DAMPING
        else:
            memory["restart"][0] = 0.0
            mode = self._mode_at(time, memory["plan"])
        if mode == Mode.RATE_DAMPING:
            mode = self._damp(time, state, memory, begins=not was_damping)
        memory["mode"][0] = float(mode)
        for name, row in memory.items():
            values.set_value(self._groups[name], row)

    def _react(
        self, time: float, state: np.ndarray, command: np.ndarray, memory: dict[str, np.ndarray]
    ) -> Mode:
        """Rate damping; before the grasp a retreat at once, if there is a plan for it."""
        if not self._watch.is_before_grasp(time):
            return Mode.RATE_DAMPING
        plan = self._plan_anew(time, state, int(memory["counters"][2]))
        if plan is None:
            return Mode.RATE_DAMPING
        memory["counters"][2] += 1.0
        memory["plan"][:] = plan.as_row()
        memory["force"][:] = np.clip(command, -self._limit, self._limit)
        memory["restart"][0] = 1.0
        return Mode.RETREAT

    def _cause(
        self,
        context: Context,
        state: np.ndarray,
        command: np.ndarray,
        memory: dict[str, np.ndarray],
    ) -> Cause:
        """Why to damp the rates now, if there is a reason and they are not damped; the counters in
        ``memory`` are brought up to date.
        """
        if self._watch.waits or memory["mode"][0] == Mode.RATE_DAMPING:
            return Cause.NONE
        counters, desired = memory["counters"], self._motion(context)[: state.size]
        force = None if memory["restart"][0] else command  # the law's, if it was commanded
        found, counters[:1] = self._watch.look(counters[:1], force, desired, state)
        cause = Cause(int(found[0]))
        if self._request.HasValue(context):
            asked = bool(self._request.Eval(context)[0] > 0.5)
            if asked and counters[3] == 0.0:
                cause = Cause.REQUEST
            counters[3] = asked
        return cause

    def _damp(
        self, time: float, state: np.ndarray, memory: dict[str, np.ndarray], *, begins: bool
    ) -> Mode:
        """Command tau = -sigma kappa Hhat v, until kappa Hhat v, low-passed, has been small for a
        time and there is a plan from then on.
        """
        settings, limit = self._settings, self._limit
        q, v = np.split(state, [self._nq])
        wanted = settings.damping * (self._model.calc_mass_matrix(q) @ v)
        scale = 1.0 / max(1.0, float((np.abs(wanted) / limit).max()))
        memory["force"][:], memory["held"][:] = -scale * wanted, state
        memory["restart"][0] = 1.0
        filtered = wanted if begins else memory["filtered"]
        filtered = filtered + min(1.0, self._step / settings.filter_time) * (wanted - filtered)
        memory["filtered"][:], counters = filtered, memory["counters"]
        is_quiet = (np.abs(filtered) <= settings.end_share * limit).all()
        counters[1] = counters[1] + self._step if is_quiet else 0.0
        if counters[1] >= settings.end_time - 1e-9:
            counters[1] = 0.0  # without a plan damping continues
            plan = self._plan_anew(time, state, int(counters[2]))
            if plan is not None:
                counters[2] += 1.0
                memory["plan"][:] = plan.as_row()
                return self._mode_at(time, memory["plan"])
        return Mode.RATE_DAMPING

    def _plan_anew(self, time: float, state: np.ndarray, plans: int) -> NewPlan | None:
        """A plan from the measured state after a number of others. If no plan is within its share
        of the limits: None, or with an empty gripper the plan with the least use of them, since
        rate damping would leave the light joints to the disturbance.
        """
        settings, (q, v) = self._settings, np.split(state, [self._nq])
        most = settings.plan_share * settings.retry_factor**plans * self._limit
        retreats, duration = self._watch.is_before_grasp(time), _SHORTEST
        least, gentlest = np.inf, None
        while duration <= _LONGEST:
            plan = NewPlan(begin=time, duration=duration, retreats=retreats, q=q, v=v)
            motion = plan.motion(self._scenario, self._coordinates)
            rows = motion.rows(np.linspace(0.0, duration, _INSTANTS))
            force = self._model.calc_tracking_force(
                *np.split(rows, [self._nq, self._nq + self._nv], axis=1)
            )
            share = float((np.abs(force) / most).max())
            if share <= 1.0:
                return plan
            if retreats and share < least:
                least, gentlest = share, plan
            duration *= _GROWTH
        return gentlest

    def _mode_at(self, time: float, plan: np.ndarray) -> Mode:
        """The mode outside rate damping."""
        if plan[1]:
            if plan[2]:
                return Mode.RETREAT
            return Mode.STOP if time < plan[0] + plan[1] - 1e-9 else Mode.HOLD
        return self._watch.mode_at(time)
