"""Results of runs: status, verdict, figures of merit and ranking."""

import dataclasses
import math
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import numpy as np

from ffsm_drake.common.errors import BlockError, FfsmError, one_line
from ffsm_drake.runs.ending import COMPLETED, DIVERGED, FAILED, INTERRUPTED, NOT_CAPTURED
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.show.style import Style, labels_of, styles_of

if TYPE_CHECKING:
    import xarray as xr

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

    @property
    def status(self) -> str:
        """Status in ``Ending``."""
        return self.record.ending.status

    @property
    def verdict(self) -> str:
        """The ending in one sentence."""
        return self.record.ending.sentence

    def figure(self, of: Callable[["xr.Dataset"], float | None]) -> float:
        """Return a figure of the run's dataset; NaN if the record lacks what it needs."""
        data, value = self.record.dataset, None
        with suppress(KeyError):
            value = of(data) if data.sizes.get("time", 0) else None
        return math.nan if value is None else value

    @property
    def kinds(self) -> list[tuple[str, str]]:
        """Group and unit ("rad" or "m") of each coordinate."""
        data = self.record.dataset
        groups, units = (data[name].values.astype(str).tolist() for name in ("group", "unit"))
        return list(zip(groups, units, strict=True))

    @property
    def comparable(self) -> bool:
        """Whether the run lasted for its whole duration, so that its sums may be compared."""
        return self.record.outcome.completed

    @property
    def time(self) -> np.ndarray:
        """Control samples (n), s."""
        return self.record.dataset["time"].values

    @property
    def units(self) -> dict[str, str]:
        """Unit of each coordinate, "rad" or "m"."""
        data = self.record.dataset
        names, units = (data[name].values.astype(str).tolist() for name in ("coordinate", "unit"))
        return dict(zip(names, units, strict=True))


def results_of(records: Sequence[RunRecord]) -> list[Result]:
    """Return every run with a name and a colour of its own."""
    styles = styles_of([record.scenario.controller for record in records])
    return [
        Result(record=record, label=label, style=style)
        for record, label, style in zip(records, labels_of(records), styles, strict=True)
    ]


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
    return record.dataset[name].values


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
