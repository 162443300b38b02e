"""Many runs, side by side in one diagram if they are compatible, with the bits of separate runs.

Compatible runs have the same model, blocks, controller, integrator and number of control samples.
They can differ in the sections ``_FREE``, in numbers of the sections ``_OF_ONE_KIND``, in the mass
properties of the payload, and in frequency and damping of panels and pendulums. Runs with a capture
must grasp at the same sample, or all begin with the grasp. Their captures can differ otherwise; of
a gripper that closes in time, only the friction can differ.

These runs are always separate: runs with error control, an implicit integrator, or a real-time
clock; runs with flexible joints; runs with a measured target.
"""

import dataclasses
import functools
import json
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.rollout import make_rollout, user_supplied
from ffsm_drake.scenario import Capture, MassProperties, Model, Scenario, scenario_to_dict
from ffsm_drake.scenario.capture import Approach
from ffsm_drake.spacecraft.dynamics import DRAKE, Chosen, Dynamics, NotCovered, find_dynamics
from ffsm_drake.systems.reference import timed
from ffsm_drake.systems.side_by_side import NotAlike

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
_EXPLICIT = ("explicit_euler", "semi_explicit_euler", "runge_kutta2", "runge_kutta3")
_FAILURES = (Exception, SystemExit)  # Drake's refusals may be the latter
_CACHE_OF_A_RUN = 2**16  # bytes of the plant of copies
_FEWEST, _USUAL, _MOST = 4, 16, 24
_MEMORY, _OF_A_SAMPLE = 400 * 2**20, 3 * 2**10  # bytes of the logs of a batch, and of a sample


def usual_batch(dynamics: Dynamics | None = None, *, samples: int = 1) -> int:
    """How many runs go side by side by default: as many as the second-level cache holds, 4 to
    24; 16 where its size is not known. Other dynamics than Drake's may say a number. Runs of so
    many samples log at most ``_MEMORY``.
    """
    logged = max(_FEWEST, _MEMORY // (_OF_A_SAMPLE * samples))
    if dynamics is not None and dynamics.batch is not None:
        return min(dynamics.batch, logged)
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
    scenarios: Sequence[Scenario], *, batch: int | None = None, dynamics: str = DRAKE
) -> Iterator[tuple[int, RunLog | Exception]]:
    """Run scenarios side by side if possible, in no fixed order.

    Args:
      scenarios: the scenarios, with durations in seconds (``timed``).
      batch: largest number of runs side by side; default: ``usual_batch``.
      dynamics: implementation of the dynamics (``find_dynamics``). If it is not Drake's, a run that
        fails, or diverges between samples, is repeated with Drake's. Its log has the reason.

    Yields: the index of a scenario and its log, or the exception of a separate run. With Drake's
    dynamics, a log has the same bits as ``Rollout.run``.

    Raises:
      FfsmError: the dynamics are unknown.
      KeyboardInterrupt: interrupted from the keyboard.
    """
    chosen = find_dynamics(dynamics)
    samples = max((scenario.num_control_periods for scenario in scenarios), default=1)
    most = batch or usual_batch(chosen.dynamics, samples=samples)
    runs = _Runs(chosen)
    try:
        for indices in batches_of(scenarios, most):
            results = runs.results([scenarios[index] for index in indices])
            yield from zip(indices, results, strict=True)
    finally:
        runs.release()


class _Runs:
    """Runs of batches with some dynamics."""

    def __init__(self, chosen: Chosen) -> None:
        self._dynamics, self._else_drake = chosen
        self._alone = Kept(make_rollout)
        self._together = Kept(functools.partial(make_rollout, dynamics=self._dynamics))

    def release(self) -> None:
        """Free all rollouts."""
        self._alone.drop()
        self._together.drop()

    def results(self, scenarios: Sequence[Scenario]) -> Iterator[RunLog | Exception]:
        """The log of each scenario of a batch, or the exception of a separate run."""
        if self._dynamics.runs_whole:
            yield from self._whole(scenarios)
            return
        logs = self._side_by_side(scenarios) if len(scenarios) > 1 else [None]
        for scenario, log in zip(scenarios, logs, strict=True):
            yield self._by_itself(scenario) if log is None else log

    def _whole(self, scenarios: Sequence[Scenario]) -> Iterator[RunLog | Exception]:
        """``results`` with dynamics that compute whole runs. What they do not cover goes side by
        side on Drake.
        """
        found = self._dynamics.run_all(scenarios)
        refused = [i for i, each in enumerate(found) if isinstance(each, NotCovered)]
        most, with_drake = usual_batch(), _Runs(Chosen(Dynamics(), False))
        others = dict[int, RunLog | Exception]()
        try:
            for at in range(0, len(refused) if self._else_drake else 0, most):
                part = refused[at : at + most]
                results = with_drake.results([scenarios[i] for i in part])
                others |= dict(zip(part, results, strict=True))
        finally:
            with_drake.release()
        for i, scenario in enumerate(scenarios):
            if i in others:
                yield _named(others[i], one_line(found[i]))
            elif isinstance(found[i], RunLog):
                yield found[i]
            else:
                yield self._otherwise(scenario, found[i])

    def _side_by_side(self, scenarios: Sequence[Scenario]) -> Sequence[RunLog | None]:
        """Return the log of each run; None: repeat the run separately."""
        try:
            self._dynamics.check(scenarios[0])
            rollout = self._together.rollout(scenarios, scenarios[0])
            logs: Sequence[RunLog | None] = rollout.run_all(scenarios)
        except _FAILURES:  # a run failed; separate runs find it
            self._together.drop()
            return [None] * len(scenarios)
        return logs

    def _by_itself(self, scenario: Scenario) -> RunLog | Exception:
        if self._dynamics.name == DRAKE:
            return self._with_drake(scenario)
        try:
            if (log := self._doubled(scenario)) is not None:
                return log
        except NotCovered as error:
            return self._otherwise(scenario, error)
        except _FAILURES:  # Drake's run shows it
            self._together.drop()
        return self._otherwise(scenario, None)

    def _otherwise(self, scenario: Scenario, error: NotCovered | None) -> RunLog | Exception:
        """The run with Drake, as it is not covered, or fails or diverges."""
        if error is not None and not self._else_drake:
            return error
        reason = "the run fails or diverges" if error is None else one_line(error)
        return _named(self._with_drake(scenario), reason)

    def _doubled(self, scenario: Scenario) -> RunLog | None:
        """Return the log of a run next to a copy of itself, for dynamics that compute several
        copies.
        """
        self._dynamics.check(scenario)
        if group_of(scenario) is None:
            raise NotCovered("a run that cannot go side by side with others")
        both = [scenario, scenario]
        try:
            log: RunLog | None = self._together.rollout(both, scenario).run_all(both)[0]
        except NotAlike as error:
            raise NotCovered(one_line(error)) from error
        return log

    def _with_drake(self, scenario: Scenario) -> RunLog | Exception:
        try:
            log: RunLog = self._alone.rollout(scenario, scenario).run(scenario)
        except _FAILURES as error:
            self._alone.drop()
            return error if isinstance(error, Exception) else FfsmError(one_line(error))
        return log


def _named(result: RunLog | Exception, reason: str) -> RunLog | Exception:
    """A result of Drake's, with the reason why other dynamics did not compute the run."""
    if isinstance(result, RunLog):
        return dataclasses.replace(result, dynamics=f"{DRAKE} ({reason})")
    return result


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
        or scenario.measured is not None
    ):
        return None
    neutral = Scenario()
    payload = dataclasses.replace(
        scenario.payload, truth=MassProperties(), nominal=MassProperties()
    )
    capture = scenario.capture
    if capture is not None:
        approach = None if capture.approach is None else Approach(scenario.grasp_time)
        closing, compliance = scenario.closing, None
        if closing is not None:
            closing, compliance = dataclasses.replace(closing, friction=1.0), capture.compliance
        capture = Capture(approach=approach, closing=closing, compliance=compliance)
    common = dataclasses.replace(
        scenario,
        payload=payload,
        capture=capture,
        duration=scenario.num_control_periods * scenario.sample_time,
        model=_without_springs(scenario.model),
        **{name: getattr(neutral, name) for name in _FREE},
    )
    data = scenario_to_dict(common)
    kinds = {name: _kind(data[name]) for name in _OF_ONE_KIND}
    # one phase for all: its settings may change anything of the loop
    phases = data["blocks"]["phases"]
    return json.dumps(data | kinds | {"phases": phases}, sort_keys=True)


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
