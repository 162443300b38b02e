"""Several runs in one simulation, each with the bits that it has alone."""

import time
from collections.abc import Callable, Sequence

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus

from ffsm_drake.common.files import same_folder
from ffsm_drake.common.lifetime import untie
from ffsm_drake.loop.batch import Batch, add_batch, batch_key
from ffsm_drake.loop.blocks import block_choices
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.runs.rollout import Rollout, RunLog, SignalLog, completed
from ffsm_drake.runs.simulate import make_record
from ffsm_drake.scenario import Scenario

# Beyond, the loops' contexts leave a processor's second cache (benchmarks/rollout.py).
BATCH_SIZE = 8


def simulate_many(
    scenarios: Sequence[Scenario], *, batch: int = BATCH_SIZE, progress: Callable[[int, int], None] | None = None
) -> list[RunRecord]:
    """Run scenarios and return their records, each the same as ``simulate`` gives, in less time.

    Scenarios with the same controller, model, control period and explicit integrator without error control run
    together, up to ``batch`` in one simulation; any other runs alone. Nothing is said of stability or limits.

    Args:
      scenarios: what to run.
      batch: the most runs in one simulation; 1: each alone.
      progress: called with (runs done, runs in all).

    Raises:
      ModelError, ScenarioError, BlockError: as ``simulate``.
    """
    records: dict[int, RunRecord] = {}
    for group in batches(scenarios, batch):
        start = time.perf_counter()
        logs = run_together([scenarios[k] for k in group])
        for k, log in zip(group, logs, strict=True):
            if log is None:
                rollout = Rollout(scenarios[k])
                try:
                    log = rollout.run()
                finally:
                    rollout.release()
            records[k] = make_record(log, start=start)
            if progress is not None:
                progress(len(records), len(scenarios))
    return [records[k] for k in range(len(scenarios))]


def batches(scenarios: Sequence[Scenario], size: int) -> list[list[int]]:
    """The scenarios' places, in groups of at most ``size`` that may run together."""
    alike: dict[str, list[int]] = {}
    for k, scenario in enumerate(scenarios):
        alike.setdefault(batch_key(scenario) or f"alone {k}", []).append(k)
    return [group[k : k + size] for group in alike.values() for k in range(0, len(group), size)]


def run_together(scenarios: Sequence[Scenario]) -> list[RunLog | None]:
    """Run scenarios in one simulation; None for each that has to be run alone.

    That is one that diverges, which is stopped and leaves the others as they are. Where anything fails, it is all of
    them: alone, a run says what is wrong with it.
    """
    if len(scenarios) < 2 or len({batch_key(scenario) for scenario in scenarios}) > 1:
        return [None] * len(scenarios)
    try:
        return _Together(scenarios).run()
    except (Exception, SystemExit, GeneratorExit):
        return [None] * len(scenarios)


class _Together:
    """The runs of some scenarios in one simulation."""

    def __init__(self, scenarios: Sequence[Scenario]) -> None:
        self._start = time.perf_counter()
        builder = DiagramBuilder()
        self._batch: Batch = add_batch(builder, scenarios)
        self._logs = [SignalLog(builder, loop, prefix=f"run_{k}.") for k, loop in enumerate(self._batch.loops)]
        self._diagram = builder.Build()
        self._bound = np.array([[scenario.divergence_speed] for scenario in scenarios])

    def run(self) -> list[RunLog | None]:
        loops, diagram, scenario = self._batch.loops, self._diagram, self._batch.loops[0].scenario
        try:
            simulator = Simulator(diagram)
            ApplySimulatorConfig(scenario.simulator_config, simulator)
            context = simulator.get_mutable_context()
            for loop in loops:
                loop.set_start(context)
            self._watch(context)
            simulator.set_monitor(self._monitor)
            periods = max(loop.scenario.num_control_periods for loop in loops)
            built = time.perf_counter()
            with np.errstate(over="ignore", invalid="ignore"), same_folder():
                simulator.Initialize()
                simulator.AdvanceTo(periods * scenario.sample_time)
                steps = simulator.get_num_steps_taken()
                simulator.AdvancePendingEvents()  # the control update of the last sample
            if block_choices(scenario) and steps != periods:
                return [None] * len(loops)  # a user's block has events of its own, which divide everybody's steps
            share = 1.0 / len(loops)
            wall_time = {"build": (built - self._start) * share, "advance_to": (time.perf_counter() - built) * share}
            return [self._log_of(k, context, wall_time) for k in range(len(loops))]
        finally:
            untie(diagram)

    def _log_of(self, run: int, context: Context, wall_time: dict[str, float]) -> RunLog | None:
        loop = self._batch.loops[run]
        times, series = self._logs[run].read(context, num_samples=loop.scenario.num_control_periods + 1)
        speed = np.abs(series["state"][:, loop.plant.num_positions() :]).max()
        if not speed <= loop.scenario.divergence_speed:
            return None
        return RunLog(
            scenario=loop.scenario,
            outcome=completed(times),
            coordinates=loop.coordinates,
            time=times,
            series=series,
            wall_time=wall_time | {"total": wall_time["build"] + wall_time["advance_to"]},
        )

    def _watch(self, context: Context) -> None:
        """Prepare ``_monitor``: where the velocities stand in the diagram's state, and where each run starts."""
        sizes = [system.GetMyContextFromRoot(context).num_continuous_states() for system in self._diagram.GetSystems()]
        first = dict(zip(self._diagram.GetSystems(), np.cumsum(sizes) - sizes, strict=True))
        plants = [loop.plant for loop in self._batch.loops]
        self._velocities = np.array(
            [first[plant] + plant.num_positions() + np.arange(plant.num_velocities()) for plant in plants]
        )
        self._first = [plant.GetPositions(plant.GetMyContextFromRoot(context)) for plant in plants]
        self._context = context

    def _monitor(self, context: Context) -> EventStatus:
        """Stop every run that leaves its bound: back to its start, at rest and without force, for the others' sake."""
        velocity = context.get_continuous_state_vector().CopyToVector()[self._velocities]
        for run in np.flatnonzero(~(np.abs(velocity) <= self._bound).all(axis=1)).tolist():
            plant, controller = self._batch.loops[run].plant, self._batch.controller
            own = plant.GetMyMutableContextFromRoot(self._context)
            plant.SetPositions(own, self._first[run])
            plant.SetVelocities(own, np.zeros(plant.num_velocities()))
            controller.stop_run(controller.GetMyMutableContextFromRoot(self._context), run)
        return EventStatus.DidNothing()
