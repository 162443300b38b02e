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

import functools
from collections.abc import Iterator, Sequence

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem,
)

from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.plugins.capture.modes import Cause, Mode, Supervising, Supervisor, supervising
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.part import STEPS, Figure, Metric, Part, Signal, Signals, View
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.sampled import SampledSystem
from ffsm_drake.systems.setup import BlockSetup


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

    def build(self, setup: BlockSetup) -> Diagram:
        """The block."""
        return _System(self.supervisor(setup), setup)

    def supervisor(self, setup: BlockSetup) -> "Supervisor":
        """Return what the block does. Raises ScenarioError: no force has a limit."""
        block = supervising(setup, begin=self._begin, waits=self._waits)
        return Supervisor(block=block, scenario=setup.scenario, coordinates=setup.coordinates)

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


class _System(Diagram):
    """The Drake system. Inputs: those of the block. Outputs: ``desired_state``,
    ``desired_acceleration``, ``generalized_force``, ``restart`` (1: the law starts afresh at this
    sample), ``mode``, ``mode_cause``.
    """

    def __init__(self, supervisor: Supervisor, setup: BlockSetup) -> None:
        super().__init__()
        builder = DiagramBuilder()
        own = SampledSystem(
            supervisor, name="supervising", sample_time=setup.sample_time, held=True
        )
        own, passing = (
            builder.AddSystem(own),
            builder.AddNamedSystem("passing", _Passing(supervisor)),
        )
        for port in map(passing.get_input_port, range(passing.num_input_ports())):
            if own.HasOutputPort(name := port.get_name()):
                builder.Connect(own.GetOutputPort(name), port)
        for name in _PASSED:
            builder.ExportInput(passing.GetInputPort(f"given_{name}"), name)
            builder.ExportOutput(passing.GetOutputPort(name), name)
        builder.ConnectInput("generalized_force", own.GetInputPort("generalized_force"))
        builder.Connect(passing.GetOutputPort("desired_state"), own.GetInputPort("desired_state"))
        for name in ("estimated_state", "abort_request"):
            builder.ExportInput(own.GetInputPort(name), name)
        for name in ("restart", "mode", "mode_cause"):
            builder.ExportOutput(own.GetOutputPort(name), name)
        builder.BuildInto(self)


_PASSED = "desired_state", "desired_acceleration", "generalized_force"


class _Passing(LeafSystem):
    """What the supervisor lets pass: the plan, or what replaces it; and the force."""

    def __init__(self, supervisor: Supervisor) -> None:
        super().__init__()
        self._supervisor, sizes = supervisor, supervisor.block.outputs
        given = dict(zip(_PASSED, (sizes["held"], sizes["force"], sizes["force"]), strict=True))
        self._ports = {
            f"given_{name}": self.DeclareVectorInputPort(f"given_{name}", size)
            for name, size in given.items()
        }
        for name in ("mode", "held", "plan", "restart", "force"):
            self._ports[name] = self.DeclareVectorInputPort(name, sizes[name])
        of_motion, of_force = (
            {self.input_port_ticket(self._ports[name].get_index()) for name in names}
            for names in (
                ("given_desired_state", "given_desired_acceleration", "mode", "held", "plan"),
                ("given_generalized_force", "restart", "force"),
            )
        )
        of_motion.add(self.time_ticket())
        for index, (name, size) in enumerate(given.items()):
            calc = functools.partial(weak_callback(self._calc), index)
            reads = of_force if name == "generalized_force" else of_motion
            self.DeclareVectorOutputPort(name, size, calc, reads)
        self._motion_of: tuple[bytes, PlannedMotion] | None = None  # a cache, of a new plan's row
        untie(self)

    def _calc(self, index: int, context: Context, output: BasicVector) -> None:
        if index == _PASSED.index("generalized_force"):
            names = "restart", "force", "given_generalized_force"
            memory = {name: self._ports[name].Eval(context) for name in names}
            output.SetFromVector(Supervising.give(memory, memory.pop(names[-1])))
        else:
            output.SetFromVector(self._motion(context)[index])

    def _motion(self, context: Context) -> tuple[np.ndarray, ...]:
        """[q_d; v_d] and a_d of the plan in force; in rate damping the state last measured."""
        memory = {name: self._ports[name].Eval(context) for name in ("mode", "held", "plan")}
        if memory["plan"][1] > 0.0:
            given = self._along(memory["plan"], context.get_time())
        else:
            given = [self._ports[f"given_{name}"].Eval(context) for name in _PASSED[:2]]
        return Supervising.follow(memory, *given)

    def _along(self, plan: np.ndarray, time: float) -> list[np.ndarray]:
        """[q_d; v_d] and a_d of a new plan."""
        key, since, step = plan.tobytes(), time - plan[0], self._supervisor.block.sample_time
        if self._motion_of is None or self._motion_of[0] != key:
            self._motion_of = key, self._supervisor.motion(plan)
        sample = round(since / step) * step
        row = self._motion_of[1].row(sample if abs(sample - since) < 1e-9 else since)
        return np.split(row, [len(plan) - 3])
