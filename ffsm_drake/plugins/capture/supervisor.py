"""The supervisor: the mode logic between plan, law and actuators.

It passes the plan to the law and the law's force to the actuators, unchanged, until the command
stays beyond the limits, an error leaves its bounds, or another block requests it (an output port
``abort_request``, above 0.5). Then it damps the rates,

    tau = -sigma kappa Hhat(q) v,   sigma = min(1, min_i limit_i / |kappa Hhat v|_i),

to lower the kinetic energy at every sample while kappa L lambda_max(H^-1 Hhat) < 2 (see
docs/rate_damping.md), and replans from the measured (q, v): the scenario's polynomial to the
target posture, in the first of 5 x 1.15^n s with inverse dynamics within ``plan_share`` of
every limit. The law restarts. Before the grasp, it replans immediately, without
damping, back to the start of the approach; and after a miss of a hand that closes later, to close
it at the end of the new plan.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.plugins.capture.modes import (
    SUPERVISED_CHAINS,
    Cause,
    Mode,
    SupervisedChain,
    Supervising,
    Supervisor,
)
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.systems.continuous import Continuous, InstantSystem
from ffsm_drake.systems.frame_path import goal_frame
from ffsm_drake.systems.mission_limits import actuation_limit
from ffsm_drake.systems.parts.metrics import Figure, Metric
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import STEPS, Signal, Signals, View
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_motion, prescribes_frame
from ffsm_drake.systems.sampled import Arrays, SampledSystem
from ffsm_drake.systems.setup import BlockSetup, CompositeBlock


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

    def build(self, setup: BlockSetup) -> CompositeBlock:
        """Return the block.

        Inputs: those of ``supervisor``, and the plan. Outputs: ``desired_state``,
        ``desired_acceleration``, ``generalized_force``, ``restart`` (1: the law starts afresh at
        this sample), ``mode``, ``mode_cause``.
        """
        supervisor = self.supervisor(setup)
        plan, command = _Plan(supervisor=supervisor), _Command(block=supervisor.block)
        passed = (*plan.outputs, *command.outputs)
        return _Supervisor(
            "supervisor",
            {
                "plan": InstantSystem(plan, name="plan"),
                "supervising": SampledSystem(
                    supervisor, name="supervising", sample_time=setup.sample_time, held=True
                ),
                "command": InstantSystem(command, name="command"),
            },
            inputs=(*passed, "estimated_state", "abort_request"),
            outputs=(*passed, "restart", "mode", "mode_cause"),
        )

    def supervisor(self, setup: BlockSetup) -> "Supervisor":
        """Return what the block does. Raises ScenarioError: no force has a limit."""
        block = _mode_logic(setup, begin=self._begin, waits=self._waits)
        chain: SupervisedChain | None = None
        if len(setup.scenario.contacts) > 1:
            chain = SUPERVISED_CHAINS.load("contacts", "contacts")(setup)
            block = dataclasses.replace(block, internal=chain.kept())
        return Supervisor(block=block, mission=setup.mission, nominal=setup.nominal, chain=chain)

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


def _mode_logic(setup: BlockSetup, *, begin: float, waits: bool) -> Supervising:
    """The mode logic of a phase, without the force between hands. Raises ScenarioError: no force
    has a limit.
    """
    scenario, coordinates, settings = setup.scenario, setup.coordinates, setup.scenario.supervisor
    assert settings is not None
    largest, limit = (
        np.where(
            coordinates.is_driven,
            actuation_limit(scenario, coordinates, helped=helped).upper,
            np.inf,
        )
        for helped in (True, False)
    )
    if not np.isfinite(limit).any():
        raise ScenarioError(
            "supervisor",
            "cannot detect saturation, because no force has a limit; set actuation.limit, "
            "actuation.thrusters or actuation.wheels",
        )
    error, rate = (
        np.where(
            coordinates.is_driven,
            coordinates.vector(given or {}, key=f"supervisor.{name}", default=np.inf),
            np.inf,
        )
        for name, given in (("error", settings.error), ("rate", settings.rate))
    )
    rest = scenario.planned_end  # of the scenario's own motion, s
    return Supervising(
        model=driven_model(setup.nominal),
        largest=largest,
        limit=limit,
        error=error,
        rate=rate,
        is_bounded=bool(np.isfinite([error, rate]).any()),
        waits=waits,
        saturated_time=np.array(settings.saturated_time),
        damping=settings.damping * coordinates.is_driven,
        share=np.array(min(1.0, setup.sample_time / settings.filter_time)),
        end_share=np.array(settings.end_share),
        end_time=np.array(settings.end_time),
        sample_time=setup.sample_time,
        grasp_time=begin + scenario.grasp_time,
        end=begin + (make_motion(setup.mission, setup.grip).end if rest is None else rest),
        is_empty=not setup.grip.holds,
        closed=setup.grip.closed or 0.0,
        internal=None,
        frame=goal_frame(scenario, setup.nominal.plant) if prescribes_frame(scenario) else None,
    )


def _events(run: View) -> Iterator[tuple[float, Mode]]:
    """Begin (s) of each mode of a run."""
    modes = np.asarray(run["mode"]).astype(int).ravel()
    for k in np.flatnonzero(np.diff(modes, prepend=-1)):
        yield float(run.time[k]), Mode(int(modes[k]))


class _Supervisor(CompositeBlock):
    """The block, whose memory the phases of late hands read and set."""

    def memory(self, context: Context) -> Arrays:
        """Return a copy of the memory."""
        found: Arrays = self._supervising.memory(self._own(context))
        return found

    def remember(self, context: Context, memory: Arrays) -> None:
        """Set the memory."""
        self._supervising.remember(self._own(context), memory)

    @property
    def block(self) -> Supervisor:
        """The supervisor with its plans."""
        found: Supervisor = self._supervising.block
        return found

    @property
    def _supervising(self) -> Any:
        return self.GetSubsystemByName("supervising")

    def _own(self, context: Context) -> Context:
        return self.GetMutableSubsystemContext(self._supervising, context)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Plan(Continuous):
    """The plan that the law follows, or what replaces it."""

    supervisor: Supervisor
    # a cache: the motions of new plans and of their frames, by their rows
    motions: dict[bytes, list[PlannedMotion]] = dataclasses.field(default_factory=dict)

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Continuous."""
        sizes = self.supervisor.outputs
        read = ("mode", "held", "held_frame", "plan")
        return {
            **self.outputs, **{name: sizes[name] for name in read if name in sizes}, "time": 1
        }  # fmt: skip

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Continuous."""
        sizes = self.supervisor.outputs
        framed = {"desired_frame": sizes["held_frame"]} if "held_frame" in sizes else {}
        return {"desired_state": sizes["held"], "desired_acceleration": sizes["force"], **framed}

    def flow(self, inputs: Arrays, state: Arrays) -> tuple[Arrays, Arrays]:
        """See Continuous; in rate damping the state last measured."""
        plan, given = inputs["plan"], {name: inputs[name] for name in self.outputs}
        if plan[1] > 0.0:
            given = dict(zip(given, self._along(plan, inputs["time"].item()), strict=True))
        return Supervising.follow(inputs, given), {}

    def _along(self, plan: np.ndarray, time: float) -> Iterator[np.ndarray]:
        """[q_d; v_d] and a_d of a new plan, and the row of its frame."""
        key, since, step = plan.tobytes(), time - plan[0], self.supervisor.block.sample_time
        if key not in self.motions:
            self.motions[key] = self.supervisor.motions(plan)
        sample = round(since / step) * step
        own, *frame = (
            each.row(sample if abs(sample - since) < 1e-9 else since) for each in self.motions[key]
        )
        yield from (*np.split(own, [len(plan) - 4]), *frame)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Command(Continuous):
    """The command in place of the law's force."""

    block: Supervising

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Continuous."""
        sizes = self.block.outputs
        read = ("restart", "force", "internal_force")
        return {**self.outputs, **{name: sizes[name] for name in read if name in sizes}}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Continuous."""
        return {"generalized_force": self.block.outputs["force"]}

    def flow(self, inputs: Arrays, state: Arrays) -> tuple[Arrays, Arrays]:
        """See Continuous."""
        return {"generalized_force": Supervising.give(inputs, inputs["generalized_force"])}, {}
