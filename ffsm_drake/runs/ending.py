"""The ending of a run, in one word: settled, not settled, growing, missed,
slipped, bounced, diverged, interrupted, failed.
"""

import dataclasses
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from ffsm_drake.common.numbers import number, rounded_up
from ffsm_drake.runs.tracking import Tracked, tracked_of
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.parts.signals import Signals
from ffsm_drake.systems.registry import section_parts

if TYPE_CHECKING:
    from ffsm_drake.runs.table import Labelled

# Statuses of an outcome; those but the first are endings too.
COMPLETED, MISSED, DIVERGED, INTERRUPTED = "completed", "missed", "diverged", "interrupted"
SLIPPED, BOUNCED = "slipped", "bounced"  # the target left the gripper, closed or closing
NOT_CAPTURED = (MISSED, SLIPPED, BOUNCED)
FAILED = "failed"  # user-supplied code raised an exception or returned an unusable result
OUTCOMES = (COMPLETED, *NOT_CAPTURED, DIVERGED, INTERRUPTED, FAILED)
# Endings of a completed run, best first.
SETTLED, NOT_SETTLED, GROWING = "settled", "not settled", "growing"
SETTLED_OVER = 1.0  # s, at the end of the run; over which errors are compared with the tolerance
_WINDOWS = 3  # number of windows of that length, at the end, for the growth of the peak error
_GROWTH = 1.5  # times, from each to the next
_FAST_GROWTH = 5.0  # times, from the largest before to the last
_PAST = 15.0  # s, before the last window
_BEYOND_PAST = 2.0  # factor of a growing error over the peak of that time
_NOTABLE = 0.3  # share of the tolerance; below it a rising peak is no growth


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcome:
    """The reason why a run ended, with its time.

    Example:
      >>> from ffsm_drake import load_scenario, simulate
      >>> outcome = simulate(load_scenario("postcapture", ["duration=0.1"])).outcome
      >>> outcome.status, round(outcome.time, 6)
      ('completed', 0.1)
    """

    status: str  # one of OUTCOMES
    time: float  # s, end of the record
    message: str  # one line
    coordinate: str = ""  # the coordinate that diverged

    @property
    def completed(self) -> bool:
        return self.status == COMPLETED


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ending:
    """The result of a run, such as settled or diverged, with the errors at its end.

    Example:
      >>> from ffsm_drake import load_scenario, simulate
      >>> ending = simulate(load_scenario("postcapture", ["duration=1"])).ending
      >>> ending.status, ending.is_settled, ending.is_failure
      ('not settled', False, False)
    """

    status: str  # of an outcome; instead of COMPLETED: SETTLED, NOT_SETTLED or GROWING
    sentence: str  # the errors and their sizes
    coordinate: str = ""  # the coordinate furthest beyond its tolerance, or diverged
    # largest error over the last second, in tolerances; NaN if the run did not complete
    excess: float = float("nan")
    gave_up: bool = False  # it ended off its plan, its rates damped or on a retreat

    @property
    def is_settled(self) -> bool:
        return self.status == SETTLED

    @property
    def is_failure(self) -> bool:
        """Whether the run failed, diverged, was about to diverge, or missed its target."""
        return self.status in (GROWING, *NOT_CAPTURED, DIVERGED, FAILED)


def ending_of(outcome: Outcome, scenario: Scenario, data: "Labelled", signals: Signals) -> Ending:
    """Return the ending of a run with an outcome, its time series and its parts' signals."""
    time = data["time"].values
    if outcome.completed:
        given_up = ""
        with suppress(KeyError):  # a record that lacks a signal
            told = (part.given_up(signals) for part in section_parts(scenario).values())
            given_up = next(filter(None, told), "")
        return ending_of_completed(scenario, time, tracked_of(data), given_up=given_up)
    message = outcome.message
    if outcome.status == INTERRUPTED:
        count = time.size or "no"
        message += f"; {count} sample{'s were' if time.size > 1 else ' was'} recorded"
    sentence = f"{message[:1].upper()}{message[1:].rstrip('.')}."
    return Ending(status=outcome.status, sentence=sentence, coordinate=outcome.coordinate)


def ending_of_completed(
    scenario: Scenario, time: np.ndarray, tracked: Tracked, *, given_up: str = ""
) -> Ending:
    """Return the ending of a completed run.

    Settled: over the last second every tracked error is within its tolerance. Growing: from each of
    the last three seconds to the next the peak of a coordinate rises by half, or fivefold at once,
    to twice the peak of the 15 s before, and to at least 0.3 of its tolerance; during the
    planned motion, beyond it. An oscillating error does not grow.

    Args:
      scenario: scenario of the run, for its tolerances and the end of its planned motion.
      time: control samples (n,), s.
      tracked: the tracked errors.
      given_up: final action in place of the plan, in words; such a run is not settled, even with
        small errors.
    """
    tolerance = np.array([
        scenario.tolerance_of(name, group)
        for name, group in zip(tracked.names, tracked.groups, strict=True)
    ])  # fmt: skip
    size = np.abs(tracked.error) / tolerance
    end, planned_end = float(time[-1]), scenario.planned_end
    last = _peaks(size, time, end, SETTLED_OVER)
    moves = planned_end is not None and end < planned_end - 1e-9
    begin = scenario.grasp_time if end > scenario.grasp_time else 0.0
    growing = _growing(size, time, begin=begin, notable=1.0 if moves else _NOTABLE)
    i = int(np.argmax(np.where(growing, last, -1.0) if growing.any() else last))
    reached = f"{number(last[i] * tolerance[i], 3)} {tracked.units[i]}"
    if growing.any():
        status, sentence = (
            GROWING,
            (
                f"Completed {end:g} s, but errors grow at the end: {tracked.names[i]} reaches "
                f"{reached}, tolerance {tolerance[i]:g}."
            ),
        )
    elif given_up:
        status, sentence = NOT_SETTLED, f"Completed {end:g} s but not settled: {given_up}."
    elif moves:
        status, sentence = (
            NOT_SETTLED,
            (f"Completed {end:g} s, before the planned motion ends at {planned_end:g} s."),
        )
    elif last.max() <= 1.0:
        largest = _largest_by_unit(last * tolerance, tracked.units)
        status, sentence = SETTLED, f"Settled: over the last second no error exceeds {largest}."
    else:
        status, sentence = (
            NOT_SETTLED,
            (
                f"Completed {end:g} s but not settled: over the last second the error of "
                f"{tracked.names[i]} reaches {reached}, tolerance {tolerance[i]:g}."
            ),
        )
    return Ending(
        status=status,
        sentence=sentence,
        coordinate=tracked.names[i],
        excess=float(last.max()),
        gave_up=bool(given_up),
    )


def _largest_by_unit(errors: np.ndarray, units: Sequence[str]) -> str:
    """Return the largest of errors (k) in rad and in m, as text."""
    largest = {
        unit: max(
            error for error, other in zip(errors.tolist(), units, strict=True) if other == unit
        )
        for unit in ("rad", "m")
        if unit in units
    }
    return ", ".join(f"{number(rounded_up(error, 3), 3)} {unit}" for unit, error in largest.items())


def _peaks(size: np.ndarray, time: np.ndarray, end: float, length: float) -> np.ndarray:
    """Return the largest of each column (k) over the samples from ``end - length`` to ``end``."""
    chosen = (time >= end - length - 1e-9) & (time <= end + 1e-9)
    return size[chosen].max(axis=0, initial=0.0)


def _growing(size: np.ndarray, time: np.ndarray, *, begin: float, notable: float) -> np.ndarray:
    """Return the mask (k) of the columns growing at the end of a leg with a given start time."""
    end = float(time[-1])
    length = min(SETTLED_OVER, (end - begin) / (_WINDOWS + 1))
    if not length > 0.0:
        return np.zeros(size.shape[1], dtype=bool)
    first, second, last = (
        _peaks(size, time, end - length * back, length) for back in reversed(range(_WINDOWS))
    )
    past = min(_PAST, end - begin - 2.0 * length)
    before = _peaks(size, time, end - length, past)
    steadily = (last > _GROWTH * second) & (second > _GROWTH * first)
    at_once = last > _FAST_GROWTH * np.maximum(first, second)
    return (last > notable) & (last > _BEYOND_PAST * before) & (steadily | at_once)
