"""Many runs, one after another on Drake or many at once on an engine."""

import dataclasses
from collections.abc import Collection, Iterator, Sequence
from typing import Any

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.mission import Mission
from ffsm_drake.runs.ending import INTERRUPTED
from ffsm_drake.runs.engine import DRAKE, Engine, find_engine, on_drake
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.runs.rollout import user_supplied
from ffsm_drake.scenario import Scenario

_FAILURES = (Exception, SystemExit)  # Drake's refusals may be the latter
_FEWEST = 4
_MEMORY, _OF_A_SAMPLE = 400 * 2**20, 3 * 2**10  # bytes of the logs of a batch, and of a sample


def usual_batch(engine: Engine | None = None, *, samples: int = 1) -> int:
    """How many runs an engine computes at once by default; one on Drake. Runs of so many samples
    log at most ``_MEMORY``.
    """
    if engine is None:
        return 1
    return min(engine.batch, max(_FEWEST, _MEMORY // (_OF_A_SAMPLE * samples)))


def run_many(
    missions: Sequence[Mission],
    *,
    batch: int | None = None,
    engine: str = DRAKE,
    signals: Collection[str] | None = None,
    kept: "Kept | None" = None,
) -> Iterator[tuple[int, RunLog | Exception]]:
    """Run missions, in no fixed order.

    Args:
      missions: the missions, with durations in seconds (``timed``).
      batch: largest number of runs at once on the engine; default: ``usual_batch``.
      engine: what computes the runs (``find_engine``). A run that it does not cover, or that fails
        or diverges, is computed by Drake, and its log has the reason.
      signals: see ``Engine.run_all``.
      kept: rollouts of the caller, to be reused; default: own ones, freed at the end.

    Yields: the index of a mission and its log, or the exception of its run.

    Raises:
      FfsmError: the engine is unknown.
      KeyboardInterrupt: interrupted from the keyboard.
    """
    own = find_engine(engine)
    left = dict.fromkeys(range(len(missions)), DRAKE)  # and the engine in their logs
    if own is not None:
        samples = max((each.scenario.num_control_periods for each in missions), default=1)
        most, left = batch or usual_batch(own, samples=samples), {}
        for first in range(0, len(missions), most):
            found = own.run_all(missions[first : first + most], signals)
            for index, log in enumerate(found, start=first):
                if isinstance(log, RunLog):
                    yield index, log
                else:
                    left[index] = on_drake(log)
    rollouts = kept or Kept()
    try:
        for index, name in left.items():
            result = _on_drake(rollouts, missions[index])
            if isinstance(result, RunLog):
                result = dataclasses.replace(result, engine=name)
            yield index, result
    finally:
        if kept is None:
            rollouts.drop()


def _on_drake(kept: "Kept", mission: Mission) -> RunLog | Exception:
    try:
        log: RunLog = kept.rollout(mission).run(mission)
    except _FAILURES as error:
        kept.drop(mission.scenario.controller)
        return error if isinstance(error, Exception) else FfsmError(one_line(error))
    if log.outcome.status == INTERRUPTED:
        raise KeyboardInterrupt
    return log


class Kept:
    """The last rollout of each controller, reused for matching runs. Blocks built by users from
    settings that may differ between runs are built anew.
    """

    def __init__(self) -> None:
        self._rollouts: dict[str, Any] = {}

    def rollout(self, mission: Mission) -> Any:
        """Return the rollout of a mission."""
        scenario, name = mission.scenario, mission.scenario.controller
        found = self._rollouts.get(name)
        if found is None or user_supplied(scenario) or not found.accepts(scenario):
            self.drop(name)
            self._rollouts[name] = make_rollout(mission)
        return self._rollouts[name]

    def drop(self, *controllers: str) -> None:
        """Free the rollouts of some controllers; without a name, of all."""
        for name in controllers or tuple(self._rollouts):
            if (rollout := self._rollouts.pop(name, None)) is not None:
                rollout.release()


def all_but_controller(scenario: Scenario) -> tuple[int, ...]:
    """Return a key of a scenario while it lives. Scenarios with the same key have the same values,
    as the same objects, except the controller.
    """
    names = (field.name for field in dataclasses.fields(scenario) if field.name != "controller")
    return tuple(id(getattr(scenario, name)) for name in names)
