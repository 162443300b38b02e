"""Many runs, side by side in one diagram if they are compatible, with the bits of separate runs.

Compatible runs have the same model, blocks, controller, integrator and number of control samples.
They can differ in the sections ``_FREE``, in numbers of the sections ``_OF_ONE_KIND``, in the mass
properties of the payload, and in frequency and damping of panels and pendulums.

These runs are always separate: runs with error control, an implicit integrator, or a real-time
clock; runs with flexible joints, an environment or a capture.
"""

import dataclasses
import json
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.runs.engine import DRAKE, Engine, find_engine, on_drake
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.rollout import make_rollout, user_supplied
from ffsm_drake.scenario import MassProperties, Model, Scenario, scenario_to_dict
from ffsm_drake.systems.reference import timed

# Sections in which runs side by side may differ: they affect only computations before or after a
# run, its own context, or blocks with a row or an instance for each run.
_FREE = (
    "description",
    "random_seed",
    "divergence_speed",
    "tolerance",
    "clearance",
    "planning",
    "initial_posture",
    "initial_velocity",
    "target_posture",
    "controllers",
    "disturbance",
)
# Sections in which they may differ in numbers. What is none, zero, chosen by a word or counted may
# give the diagram another block or port, or make of one block for all runs one for each.
_OF_ONE_KIND = (
    "reference",
    "estimator",
    "command_filter",
    "environment",
    "sensing",
    "actuation",
    "blocks",
)
# All other sections are equal: clock, integrator, plant and controller. With fixed steps, these
# integrators compute each copy of the spacecraft separately.
_EXPLICIT = (
    "explicit_euler", "semi_explicit_euler", "runge_kutta2", "runge_kutta3", "runge_kutta5",
)  # fmt: skip
_FAILURES = (Exception, SystemExit)  # Drake's refusals may be the latter
_CACHE_OF_A_RUN = 2**16  # bytes of the plant of copies
_FEWEST, _USUAL, _MOST = 4, 16, 24
_MEMORY, _OF_A_SAMPLE = 400 * 2**20, 3 * 2**10  # bytes of the logs of a batch, and of a sample


def usual_batch(engine: Engine | None = None, *, samples: int = 1) -> int:
    """How many runs go side by side by default: as many as the second-level cache holds, 4 to
    24; 16 where its size is not known. An engine has its own number. Runs of so many samples log
    at most ``_MEMORY``.
    """
    logged = max(_FEWEST, _MEMORY // (_OF_A_SAMPLE * samples))
    if engine is not None:
        return min(engine.batch, logged)
    try:
        size = os.sysconf("SC_LEVEL2_CACHE_SIZE")
    except (AttributeError, ValueError, OSError):
        size = 0
    usual = min(max(size // _CACHE_OF_A_RUN, _FEWEST), _MOST) if size > 0 else _USUAL
    return min(usual, logged)


def batches_of(scenarios: Sequence[Scenario], batch: int | None = None) -> list[list[int]]:
    """Return the indices of the scenarios that run side by side, at most ``batch`` at once."""
    most = usual_batch() if batch is None else batch
    groups: dict[str, list[int]] = {}
    for index, scenario in enumerate(scenarios):
        key = group_of(scenario) if most > 1 else None
        groups.setdefault(key or str(index), []).append(index)
    parts = [np.array_split(group, -(-len(group) // most)) for group in groups.values()]
    return [part.tolist() for each in parts for part in each]


def runs_alone(scenario: Scenario) -> bool:
    """Whether a scenario cannot run side by side with others."""
    return group_of(timed(scenario)) is None


def run_many(
    scenarios: Sequence[Scenario],
    *,
    batch: int | None = None,
    engine: str = DRAKE,
    signals: Collection[str] | None = None,
) -> Iterator[tuple[int, RunLog | Exception]]:
    """Run scenarios side by side if possible, in no fixed order.

    Args:
      scenarios: the scenarios, with durations in seconds (``timed``).
      batch: largest number of runs side by side; default: ``usual_batch``.
      engine: what computes the runs (``find_engine``). A run that it does not cover, or that fails
        or diverges, is computed by Drake, and its log has the reason.
      signals: see ``Engine.run_all``.

    Yields: the index of a scenario and its log, or the exception of a separate run. With Drake, a
    log has the same bits as ``Rollout.run``.

    Raises:
      FfsmError: the engine is unknown.
      KeyboardInterrupt: interrupted from the keyboard.
    """
    own = find_engine(engine)
    samples = max((scenario.num_control_periods for scenario in scenarios), default=1)
    left = dict.fromkeys(range(len(scenarios)), DRAKE)  # and the engine in their logs
    if own is not None:
        most, left = batch or usual_batch(own, samples=samples), {}
        for first in range(0, len(scenarios), most):
            found = own.run_all(scenarios[first : first + most], signals)
            for index, log in enumerate(found, start=first):
                if isinstance(log, RunLog):
                    yield index, log
                else:
                    left[index] = on_drake(log)
    runs, most = _Runs(), batch or usual_batch(samples=samples)
    # a run that diverges costs least alone, where it ends at once
    alone = [index for index, engine in left.items() if engine == on_drake(None)]
    others = [index for index, engine in left.items() if engine != on_drake(None)]
    parts = batches_of([scenarios[index] for index in others], most)
    try:
        for indices in (*([others[at] for at in part] for part in parts), *([i] for i in alone)):
            results = runs.results([scenarios[index] for index in indices])
            for index, result in zip(indices, results, strict=True):
                if isinstance(result, RunLog):
                    result = dataclasses.replace(result, engine=left[index])
                yield index, result
    finally:
        runs.release()


class _Runs:
    """Runs of batches."""

    def __init__(self) -> None:
        self._alone, self._together = Kept(make_rollout), Kept(make_rollout)

    def release(self) -> None:
        """Free all rollouts."""
        self._alone.drop()
        self._together.drop()

    def results(self, scenarios: Sequence[Scenario]) -> Iterator[RunLog | Exception]:
        """The log of each scenario of a batch, or the exception of a separate run."""
        logs = self._side_by_side(scenarios) if len(scenarios) > 1 else [None]
        for scenario, log in zip(scenarios, logs, strict=True):
            yield self._by_itself(scenario) if log is None else log

    def _side_by_side(self, scenarios: Sequence[Scenario]) -> Sequence[RunLog | None]:
        """Return the log of each run; None: repeat the run separately."""
        try:
            rollout = self._together.rollout(scenarios, scenarios[0])
            logs: Sequence[RunLog | None] = rollout.run_all(scenarios)
        except _FAILURES:  # a run failed; separate runs find it
            self._together.drop()
            return [None] * len(scenarios)
        return logs

    def _by_itself(self, scenario: Scenario) -> RunLog | Exception:
        try:
            log: RunLog = self._alone.rollout(scenario, scenario).run(scenario)
        except _FAILURES as error:
            self._alone.drop()
            return error if isinstance(error, Exception) else FfsmError(one_line(error))
        return log


class Kept:
    """The last rollout, reused for matching runs. Blocks built by users from settings that may
    differ between runs are built anew.
    """

    def __init__(self, make: Callable[[Any], Any]) -> None:
        """Args: makes a rollout for a scenario, or for several."""
        self._make, self._rollout = make, None

    def rollout(self, scenario: Any, first: Scenario) -> Any:
        """Return the rollout of a scenario or of several, with the same blocks as the first."""
        if self._rollout is None or user_supplied(first) or not self._rollout.accepts(scenario):
            self.drop()
            self._rollout = self._make(scenario)
        return self._rollout

    def drop(self) -> None:
        """Free the rollout."""
        if self._rollout is not None:
            self._rollout.release()
        self._rollout = None


def group_of(scenario: Scenario) -> str | None:
    """Return the key that is equal for runs that can run side by side; None: run this one
    separately.
    """
    config = scenario.simulator_config
    if (
        config.use_error_control
        or config.integration_scheme not in _EXPLICIT
        or config.target_realtime_rate > 0.0
        or any(part.kind in ("joint", "gear") for part in scenario.model.flexible.values())
        or scenario.grasps
        or scenario.environment is not None
    ):
        return None
    return kind_of_run(scenario)


def kind_of_run(scenario: Scenario) -> str:
    """Return a key that is equal for runs with the same diagram."""
    neutral = Scenario()
    payload = dataclasses.replace(
        scenario.payload, truth=MassProperties(), nominal=MassProperties()
    )
    common = dataclasses.replace(
        scenario,
        payload=payload,
        # without an approach it gives the velocity at the start
        capture=None if scenario.approach is None else scenario.capture,
        duration=scenario.num_control_periods * scenario.sample_time,
        model=_without_springs(scenario.model),
        **{name: getattr(neutral, name) for name in _FREE},
    )
    data = scenario_to_dict(common)
    kinds = {name: _kind(data[name]) for name in _OF_ONE_KIND}
    # one phase for all: its settings may change anything of the loop
    phases = data["blocks"]["phases"]
    return json.dumps(data | kinds | {"phases": phases}, sort_keys=True)


def all_but_controller(scenario: Scenario) -> tuple[int, ...]:
    """Return a key of a scenario while it lives. Scenarios with the same key have the same values,
    as the same objects, except the controller.
    """
    names = (field.name for field in dataclasses.fields(scenario) if field.name != "controller")
    return tuple(id(getattr(scenario, name)) for name in names)


def _without_springs(model: Model) -> Model:
    """Return a model without springs and dampers of hinges, whose values are in a context."""
    hinged = ("panel", "pendulum")
    parts = {
        name: dataclasses.replace(part, frequency=None, stiffness=None, damping_ratio=0.0)
        if part.kind in hinged
        else part
        for name, part in model.flexible.items()
    }
    return dataclasses.replace(model, flexible=parts)


def _kind(data: Any) -> Any:
    """Plain data without the values of its numbers other than zero; those by coordinate, and of
    vectors, as one.
    """
    entries = data.values() if isinstance(data, dict) else data if isinstance(data, list) else ()
    if entries and all(isinstance(each, float) for each in entries):
        return any(entries)
    if isinstance(data, dict):
        return {name: _kind(value) for name, value in data.items()}
    if isinstance(data, list):
        return [_kind(value) for value in data]
    return bool(data) if isinstance(data, float) else data
