"""Results of runs: status, verdict, figures of merit and ranking."""

import dataclasses
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import ParamSpec, TypeVar

import numpy as np

from ffsm_drake.common.errors import BlockError, FfsmError, one_line
from ffsm_drake.runs.ending import COMPLETED, DIVERGED, FAILED, INTERRUPTED, NOT_CAPTURED
from ffsm_drake.runs.metrics import isv, itae
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.runs.tracking import tracked_of
from ffsm_drake.show.style import Style, labels_of, styles_of

P = ParamSpec("P")
T = TypeVar("T")

HELD = ("generalized_force", "applied_force")  # from one sample to the next


class MissingWarning(UserWarning):
    """A section of a page has no content, since a block of the run's loop fails."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Result:
    """One run: name, status, verdict and figures; NaN if the record lacks what a figure
    needs.
    """

    record: RunRecord
    label: str
    style: Style
    status: str  # status in ``Ending``
    verdict: str  # one sentence
    itae: float
    isv: float
    # group and unit ("rad" or "m") of some coordinates -> their largest values: peak_error,
    # final_error, peak_effort (N m or N, commanded), peak_applied (by the actuators)
    magnitudes: Mapping[tuple[str, str], Mapping[str, float]]

    @property
    def comparable(self) -> bool:
        """Whether the run lasted for its whole duration, so that its sums may be compared."""
        return self.record.outcome.completed

    @property
    def time(self) -> np.ndarray:
        """Control samples (n), s."""
        values: np.ndarray = self.record.dataset["time"].values
        return values

    @property
    def units(self) -> dict[str, str]:
        """Unit of each coordinate, "rad" or "m"."""
        data = self.record.dataset
        names, units = (data[name].values.astype(str).tolist() for name in ("coordinate", "unit"))
        return dict(zip(names, units, strict=True))


def results_of(records: Sequence[RunRecord]) -> list[Result]:
    """Return every run with a name and a colour of its own."""
    styles = styles_of([record.scenario.controller for record in records])
    return [_result(*named) for named in zip(records, labels_of(records), styles, strict=True)]


def ranking(results: Sequence[Result], figure: Callable[[Result], float]) -> list[Result]:
    """Return the best first: completed runs by their figure, then interrupted ones, then those that
    did not capture the target, diverged or failed.
    """
    kinds = (COMPLETED, INTERRUPTED, *NOT_CAPTURED, DIVERGED, FAILED)
    order = {status: place for place, status in enumerate(kinds)}

    def key(result: Result) -> tuple[int, float]:
        value = figure(result) if result.comparable else -result.record.outcome.time
        return order[result.record.outcome.status], value if math.isfinite(value) else math.inf

    return sorted(results, key=key)


def actuators_act(results: Sequence[Result]) -> bool:
    """Whether applied and commanded force differ in a run; NaN equals NaN."""
    pairs = [(values_of(result.record, name) for name in HELD) for result in results]
    return any(
        a is not None and b is not None and not np.array_equal(a, b, equal_nan=True)
        for a, b in pairs
    )


def values_of(record: RunRecord, name: str) -> np.ndarray | None:
    """Return a variable of the record; None if it has none or no sample."""
    if name not in record.dataset or record.dataset.sizes.get("time", 0) == 0:
        return None
    values: np.ndarray = record.dataset[name].values
    return values


def _result(record: RunRecord, label: str, style: Style) -> Result:
    period = record.scenario.sample_time
    error, effort = values_of(record, "error"), values_of(record, "generalized_force")
    accuracy = math.nan
    if error is not None:
        accuracy = itae(
            record.dataset["time"].values[:-1], tracked_of(record.dataset).error[:-1], period
        )
    cost = math.nan if effort is None else isv(effort[:-1], period)
    return Result(
        record=record,
        label=label,
        style=style,
        status=record.ending.status,
        verdict=record.ending.sentence,
        itae=accuracy,
        isv=cost,
        magnitudes=_magnitudes(record, error, effort),
    )


def _magnitudes(
    record: RunRecord, error: np.ndarray | None, effort: np.ndarray | None
) -> dict[tuple[str, str], dict[str, float]]:
    groups, units = (record.dataset[name].values.astype(str) for name in ("group", "unit"))
    found = {
        "peak_error": error,
        "final_error": None if error is None else error[-1],
        "peak_effort": effort,
        "peak_applied": values_of(record, "applied_force"),
    }

    def largest(values: np.ndarray | None, members: np.ndarray) -> float:
        return math.nan if values is None else float(np.abs(values[..., members]).max())

    return {
        (group, unit): {
            name: largest(values, (groups == group) & (units == unit))
            for name, values in found.items()
        }
        for group, unit in dict.fromkeys(zip(groups.tolist(), units.tolist(), strict=True))
    }


def attempt(
    section: str, result: Result, make: Callable[P, T], *arguments: P.args, **options: P.kwargs
) -> tuple[T | None, str]:
    """Result of ``make``, or the reason for its absence: a failing section must not prevent the
    report.

    Warns (MissingWarning) if a block fails.
    """
    try:
        return make(*arguments, **options), ""
    except FfsmError as error:
        if isinstance(error, BlockError):
            name = result.record.scenario.controller
            text = f"{name}: the report lacks its {section}: {one_line(error)}"
            warnings.warn(text, MissingWarning, stacklevel=4)
        return None, one_line(error)
    except KeyError as error:  # a variable missing in the record, a controller without a law
        return None, (
            "there is no "
            f"{one_line(error).strip(chr(34)).removeprefix('No variable named ').split('. ')[0]}"
        )
