"""Rollout: a closed loop that is built once and run many times."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Hashable, Mapping
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import (
    LogVectorOutput,
    Multiplexer,
    VectorLog,
    VectorLogSink,
)

from ffsm_drake.common.errors import BlockError, FfsmError, ScenarioError
from ffsm_drake.common.files import same_folder
from ffsm_drake.common.guard import guarded, passes
from ffsm_drake.common.interrupts import interruptible
from ffsm_drake.common.lifetime import untie
from ffsm_drake.common.memo import content_of
from ffsm_drake.loop.closed_loop import ClosedLoop, add_closed_loop, build_closed_loop
from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.runs.ending import COMPLETED, DIVERGED, FAILED, INTERRUPTED, Outcome
from ffsm_drake.runs.failed_block import bad_output, failure_of, unconnected
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.monitor import Monitor
from ffsm_drake.runs.recorded_signals import RECORDED_SIGNALS
from ffsm_drake.scenario import HELD, Grip, Scenario, kind_of, planned_part
from ffsm_drake.scenario.contacts import closing_times
from ffsm_drake.spacecraft.plant import add_combined_plant, cause_of
from ffsm_drake.systems.controllers.law import ControlLaw
from ffsm_drake.systems.parts.placed import signals_of
from ffsm_drake.systems.registry import Factory, is_shipped_name, name_of

# A logger records the state before the update at its instant: at t_k it has these signals of sample
# k - 1.
_HELD = ("measurement", *(each.name for each in RECORDED_SIGNALS.values() if each.held))
_STOP = 0.25  # s between the instants at which a run is ended that diverges or is interrupted
# Fields that can change without a new build, like the payload's true mass properties.
_OF_THE_CONTEXT = ("description", "random_seed", "duration", "divergence_speed", "initial_velocity")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Leg:
    """Part of a run, from control sample ``first`` to ``last``, with callbacks at its ends.

    The update of sample ``last`` belongs to the next leg; without ``last`` the leg runs to the
    scenario's end.
    """

    first: int = 0
    last: int | None = None
    # called with the initialized loop and its context
    begin: Callable[[ClosedLoop, Context], None] | None = None
    end: Callable[[ClosedLoop, Context], None] | None = None


def has_phases(scenario: Scenario) -> bool:
    """Whether a run has several loops, one after another, or begins with a grasp."""
    return scenario.grasps or len(closing_times(scenario)) > 1


class Rollout:
    """A closed loop that is built once and run many times, of a mission without phases.

    Every run has the same bits as a run of a new loop. A new Rollout raises the errors of
    ``add_closed_loop``.

    Example:
      >>> from ffsm_drake import Rollout, load_scenario, override_scenario
      >>> scenario = load_scenario("postcapture", ["duration=0.1"])
      >>> rollout = Rollout(scenario)
      >>> logs = [rollout.run(override_scenario(scenario, [f"random_seed={k}"])) for k in range(3)]
      >>> [log.outcome.status for log in logs]
      ['completed', 'completed', 'completed']
    """

    @guarded
    def __init__(
        self,
        scenario: Scenario | Mission,
        *,
        blocks: Mapping[str, Factory] | None = None,
        meshcat: Meshcat | None = None,
        show: Callable[[DiagramBuilder, ClosedLoop], None] | None = None,
        joint_force: np.ndarray | None = None,
        grip: Grip | None = None,
    ) -> None:
        """Build the closed loop.

        Args:
          scenario: the scenario to build, or its mission.
          blocks: factories that replace blocks of the scenario, see ``add_closed_loop``.
          meshcat: shows the motion.
          show: adds the scene graph and the systems that move its bodies; default: from the plant.
          joint_force: see ``add_closed_loop``.
          grip: what holds the target; default: the gripper, in a mission without phases.

        Raises ScenarioError without ``grip`` for a mission with phases, see ``make_rollout``.
        """
        start, mission = time.perf_counter(), make_mission(scenario)
        if grip is None and has_phases(mission.scenario):
            raise ScenarioError(
                "capture" if mission.scenario.grasps else "contacts",
                "this mission has phases, and a Rollout has one loop; use simulate or make_rollout",
            )
        scenario, builder = mission.scenario, DiagramBuilder()
        plant = (
            None
            if meshcat is None or show is not None
            else add_combined_plant(builder, scenario.model, flexible=True)
        )
        how: Any = {"joint_force": joint_force, "grip": grip or HELD}
        loop = add_closed_loop(builder, mission, blocks=blocks, plant=plant, **how)
        if show is not None:
            show(builder, loop)
        self._logger, self._rows = _add_logger(builder, loop)
        if meshcat is not None:
            visualizer = MeshcatVisualizer.AddToBuilder(
                builder, builder.GetSubsystemByName("scene_graph"), meshcat
            )
            visualizer.set_name("meshcat_visualizer")
        self.loop = build_closed_loop(builder, loop)
        self._simulator = Simulator(self.loop.diagram)
        config = scenario.simulator_config
        logs_every_step = (
            not config.use_error_control and config.max_step_size >= scenario.sample_time
        )
        self._user_supplied = user_supplied(scenario, blocks)
        # With user-supplied blocks or a viewer, a run is not repeated with the monitor.
        self._checked_in_log = logs_every_step and meshcat is None and not self._user_supplied
        self._built_for: Hashable | None = _built_from(scenario)
        self._build_time = time.perf_counter() - start

    def release(self) -> None:
        """Free the closed loop, which Drake would otherwise keep.

        Do not use any part of it afterwards. A second call has no effect.
        """
        if self._built_for is not None:
            untie(self.loop.diagram)
        self._built_for = None

    def accepts(self, scenario: Scenario) -> bool:
        """True if ``run`` can run the scenario without a new build.

        A scenario can differ in description, seed, duration, divergence speed, initial velocity and
        true mass properties of the payload. With a capture the true centre of mass must be equal,
        because the motion of the target depends on it.
        """
        return _built_from(scenario) == self._built_for

    @guarded
    def run(
        self,
        scenario: Scenario | Mission | None = None,
        *,
        progress: Callable[[float, float], None] | None = None,
        leg: Leg | None = None,
    ) -> RunLog:
        """Run from the start, with the built scenario or one that ``accepts`` takes.

        On divergence (a velocity beyond ``divergence_speed``, or not finite) or an interrupt from
        the keyboard the run ends early with the log up to then; the outcome gives the reason.

        Args:
          scenario: the scenario to run, or its mission; None for the built one.
          progress: called with (simulated time, duration) in s, every 0.25 simulated seconds.
          leg: the part of the run; None for all of it.

        Raises:
          ScenarioError: the scenario needs another build.
          BlockError: a user-supplied block fails; its ``log`` holds the run up to then.
        """
        start = time.perf_counter()
        loop, leg = self.loop, leg or Leg()
        if scenario is not None:
            loop = dataclasses.replace(loop, mission=self._accepted(scenario))
        monitor = Monitor(loop, progress)
        # A monitor calls Python in every step. Where all steps are in the log, that shows
        # afterwards where a monitor would have stopped the run.
        watched = not self._checked_in_log
        interrupted, failure, advance_time = self._advance(monitor, leg, watched=watched)
        if failure is not None and self._log.num_samples() < 2:
            raise failure
        last = None if watched else self._first_beyond(monitor)
        if last is not None:  # the log up to there is what a monitor would have left
            interrupted, failure = False, None
        times, series = self._read_log(
            unfinished=interrupted or failure is not None or leg.last is not None, last=last
        )
        if bad := bad_output(monitor.bounded(series["state"]), series, self._user_supplied):
            failure = BlockError(f"{bad.problem}; at t = {times[bad.sample]:.2f} s")
            if bad.sample == 0:
                raise failure
            times = times[: bad.sample]
            series = {name: values[: bad.sample] for name, values in series.items()}
        outcome = _outcome(monitor, float(times[-1]), failure, interrupted=interrupted)
        total = time.perf_counter() - start
        wall_time = {"build": self._build_time, "advance_to": advance_time, "total": total}
        log = _make_log(loop, outcome, times, series, wall_time)
        if failure is not None:
            failure.log = log
            raise failure
        return log

    @guarded
    def check(self) -> None:
        """Initialize a run and evaluate its derivatives, without a step; errors as ``run`` raises
        them at its start.
        """
        loop = self.loop
        context = loop.diagram.CreateDefaultContext()
        loop.initialize(loop.diagram, context)
        try:
            with same_folder():
                loop.diagram.EvalTimeDerivatives(context)
        except BaseException as error:
            if passes(error):
                raise
            raise self._failure(error, context) from error

    def _accepted(self, scenario: Scenario | Mission) -> Mission:
        """Return the mission to run. Raises ScenarioError: it needs another build."""
        given = scenario.scenario if isinstance(scenario, Mission) else scenario
        if not self.accepts(given):
            raise ScenarioError(
                "scenario",
                "differs from the built one in more than a run can change; build another",
            )
        return scenario if isinstance(scenario, Mission) else self.loop.mission.of(scenario)

    def _advance(
        self, monitor: Monitor, leg: Leg, *, watched: bool
    ) -> tuple[bool, BlockError | None, float]:
        """Run from the start to the end, or to divergence, which ``monitor`` then reports.

        Returns: whether it was interrupted from the keyboard, how a user-supplied block failed, and
        the wall time spent advancing, s.
        """
        simulator, loop = self._simulator, monitor.loop
        context = self._begun(monitor, leg, watched=watched)
        sample_time = loop.scenario.sample_time
        last = loop.scenario.num_control_periods if leg.last is None else leg.last
        # A log that doubles its room when it is full copies itself.
        self._logger.FindMutableLog(context).Reserve(last - leg.first + 1)
        # Stops at control samples do not change the steps.
        stop_periods = max(1, round(_STOP / sample_time))
        start = time.perf_counter()
        interrupted, failure = False, None
        # The run beyond the point of divergence is discarded.
        unremarked = (
            np.errstate(over="ignore", invalid="ignore")
            if self._checked_in_log
            else contextlib.nullcontext()
        )
        signal_before = 0
        try:
            with interruptible() as interruption, same_folder(), unremarked:
                signal_before = interruption.number
                simulator.Initialize()
                for period in (*range(leg.first, last, stop_periods), last):
                    simulator.AdvanceTo(period * sample_time)
                    if interruption.number != signal_before:  # and the exception was lost
                        raise KeyboardInterrupt
                    if monitor.message or not monitor.check(context):
                        break
                    monitor.report(context)
                if leg.last is None:
                    simulator.AdvancePendingEvents()  # the control update of the last sample
                elif leg.end is not None and not monitor.message:
                    leg.end(loop, context)
        except BaseException as error:
            # User-supplied code may raise anything, and turn the exception of Ctrl-C into another.
            through = passes(error) and not isinstance(error, BlockError)
            if interruption.number != signal_before or (
                through and isinstance(error, KeyboardInterrupt)
            ):
                interrupted = True
            elif through:
                raise
            elif _is_sound(monitor, context):  # Drake refuses numbers that are not finite
                failure = self._failure(error, context)
        return interrupted, failure, time.perf_counter() - start

    def _begun(self, monitor: Monitor, leg: Leg, *, watched: bool) -> Context:
        """Return the context of a new run at the begin of its leg."""
        simulator, loop = self._simulator, monitor.loop
        simulator.reset_context(loop.diagram.CreateDefaultContext())
        # a new integrator: one with error control goes on with its last step's size
        ApplySimulatorConfig(loop.scenario.simulator_config, simulator)
        context = simulator.get_mutable_context()
        loop.initialize(loop.diagram, context)
        if leg.first:
            context.SetTime(leg.first * loop.scenario.sample_time)
        if leg.begin is not None:
            leg.begin(loop, context)
        if watched:
            simulator.set_monitor(monitor)
        else:
            simulator.clear_monitor()
        return context

    def _failure(self, error: BaseException, context: Context) -> BlockError:
        """Return the error of a block. Without a user-supplied one, Drake's reason for stopping is
        raised, or the error itself.
        """
        if isinstance(error, BlockError):
            return error
        problem = unconnected(error, self.loop)
        if problem or self._user_supplied:
            failed = BlockError(problem)
            if not problem:
                failed = failure_of(error, self.loop, self._user_supplied, context)
            failed.__cause__ = error
            return failed
        if type(error) not in (RuntimeError, SystemExit):  # C++'s
            raise error
        raise ScenarioError(
            "simulator_config",
            f"the simulation cannot continue at t = {context.get_time():.2f} s; set another "
            f"integration_scheme or accuracy ({cause_of(error)})",
        ) from error

    @property
    def _log(self) -> VectorLog:
        """The log of the present run."""
        return self._logger.FindLog(self._simulator.get_context())

    def _first_beyond(self, monitor: Monitor) -> int | None:
        """Return the first sample of the log at which the known state is not within its bounds, or
        is not finite, which ``monitor`` then reports.
        """
        states = self._log.data()[self._rows["state"]].T
        beyond = np.flatnonzero(~monitor.bounded(states))
        if not beyond.size:
            return None
        first = int(beyond[0])
        monitor.judge(float(self._log.sample_times()[first]), states[first].copy())
        return first

    def _read_log(
        self, *, unfinished: bool, last: int | None = None
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Sample times and the aligned series (copied).

        Args:
          unfinished: the run may have ended before the update of its last sample.
          last: the run's last sample, of its divergence; None: the log's.
        """
        loop, context = self.loop, self._simulator.get_context()
        held = {*_HELD, *(each.name for each in signals_of(loop.parts) if each.held)}
        held.update(*(placed.part.logged for placed in loop.parts.values()))
        times, rows = self._log.sample_times().copy(), self._log.data()
        count = times.size if last is None else last + 1
        if unfinished and count == 0:
            raise KeyboardInterrupt
        if unfinished and count > 1:
            count -= 1  # perhaps before the update of the last sample, which is therefore left out
        series = {}
        for name, part in self._rows.items():
            if name not in held:
                series[name] = rows[part, :count].T.copy()
                continue
            # Sample k is entry k + 1 of the log; that of the last sample stands in the context.
            found = rows[part, 1 : count + 1].T
            if len(found) < count:
                found = np.vstack([found, loop.diagram.GetOutputPort(name).Eval(context)])
            series[name] = found.copy()
        return times[:count], series


def _make_log(
    loop: ClosedLoop,
    outcome: Outcome,
    times: np.ndarray,
    series: Mapping[str, np.ndarray],
    wall_time: dict[str, float],
) -> RunLog:
    """Log of a run of the loop's scenario."""
    law = getattr(loop.blocks["controller"], "law", None)
    return RunLog(
        mission=loop.mission,
        outcome=outcome,
        tracks_frame=loop.tracks_frame,
        sliding_unit=str(getattr(law, "sliding_unit", ControlLaw.sliding_unit)),
        parts=loop.parts,
        time=times,
        series=series,
        wall_time=wall_time,
    )


def _outcome(
    monitor: Monitor, time: float, failure: BlockError | None, *, interrupted: bool
) -> Outcome:
    """Return the outcome of a run whose log ends at a time, s."""
    if failure is not None:
        return Outcome(status=FAILED, time=time, message=str(failure))
    if monitor.coordinate:
        return Outcome(
            status=DIVERGED, time=time, coordinate=monitor.coordinate, message=monitor.message
        )
    if interrupted:
        return Outcome(status=INTERRUPTED, time=time, message=f"interrupted at t = {time:.2f} s")
    return Outcome(status=COMPLETED, time=time, message=f"completed {time:g} s")


def user_supplied(
    scenario: Scenario, blocks: Mapping[str, Factory] | None = None
) -> dict[str, str]:
    """Return the user-supplied blocks of a closed loop, in words by name."""
    names = {name: choice.system for name, choice in scenario.blocks.choices().items()}
    names["controller"] = scenario.controller
    names = {name: own for name, own in names.items() if not is_shipped_name(kind_of(name), own)}
    names |= {name: name_of(factory) for name, factory in (blocks or {}).items()}
    return {
        name: f"{'' if name == 'controller' else 'blocks.'}{name} '{system}'"
        for name, system in names.items()
    }


def _add_logger(
    builder: DiagramBuilder, loop: ClosedLoop
) -> tuple[VectorLogSink, dict[str, slice]]:
    """Return a logger of the loop's signals at every control sample, and each one's rows in its
    log.

    One logger behind a multiplexer costs less than one for each.
    """
    # the measurement
    sources = {name: source for name, source in loop.sources.items() if name != "estimated_state"}
    # some signals share a port
    ports = {source: loop.output_port(name) for name, source in sources.items()}
    sizes = [port.size() for port in ports.values()]
    stacked = builder.AddNamedSystem("signals", Multiplexer(sizes))
    for index, port in enumerate(ports.values()):
        builder.Connect(port, stacked.get_input_port(index))
    logger = LogVectorOutput(stacked.get_output_port(), builder, loop.scenario.sample_time)
    logger.set_name("log")
    ends = np.cumsum(sizes).tolist()
    rows = {
        source: slice(end - size, end) for source, size, end in zip(ports, sizes, ends, strict=True)
    }
    return logger, {name: rows[source] for name, source in sources.items()}


def _is_sound(monitor: Monitor, context: Context) -> bool:
    """True unless the state, or the controller's force, shows that the run has diverged."""
    try:
        return monitor.check(context) and monitor.check_force(context)
    except BaseException as error:
        if passes(error) and not isinstance(error, FfsmError):
            raise
        return True  # the force itself cannot be computed


def _built_from(scenario: Scenario) -> Hashable:
    """Return the content of a scenario that the build depends on; a run's context holds the
    rest.
    """
    neutral = Scenario()
    changes = {name: getattr(neutral, name) for name in _OF_THE_CONTEXT}
    if scenario.stops_from_start:
        del changes["initial_velocity"]
    # drawn, by the seed, when the loop is built
    if scenario.faults is not None or scenario.effects != neutral.effects:
        del changes["random_seed"]
    payload = planned_part(scenario).payload
    return content_of(dataclasses.replace(scenario, payload=payload, **changes))
