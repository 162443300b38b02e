"""A compiled run from step to step and from sample to sample, and what is known of it there."""

import functools
from collections.abc import Sequence

import numpy as np

from ffsm_drake.plugins.compiled.blocks import CARRIED
from ffsm_drake.plugins.compiled.instant import Instant, Made
from ffsm_drake.plugins.compiled.stepping import joined


def instants(at: Instant, times: Sequence[float]) -> Made:
    """The times of derivatives in a step, and whether a sample is a first one for the law.

    Args: times after the begin of the step, in steps.
    """
    cells, start = at.cells, _time_of(at, at.cells.j)
    is_first = cells.number == cells.first_at
    if at.blocks.watch is not None:
        is_first = is_first | (at.remembered(cells.watched)["restart"] != 0.0)
    made = {f"t{i}": start + cells.step * each for i, each in enumerate(times)}
    return made | {"is_first": np.where(is_first, 1.0, 0.0)}


def judged(at: Instant) -> Made:
    """What is known of a run after a sample."""
    cells, places = at.cells, at.blocks.log.values()
    logged = joined(getattr(cells, cell)[first : first + size] for cell, first, size in places)
    is_sound = _is_bounded(at, cells.x) & np.isfinite(logged).all()
    acted = np.where(at.is_lost, 0.0, 1.0)
    return {"acted_on": cells.acted_on + acted, **_seen(at, cells.t0, is_sound)}


def carried(at: Instant) -> Made:
    """The states after a sample."""
    after = {name: getattr(at.cells, cell) for name, cell in CARRIED.items()}
    return at.unless_lost(after)


def point(at: Instant, weights: Sequence[float]) -> Made:
    """A point of the integrator's step."""
    step = at.cells.step[0]
    parts = [step * w * getattr(at.cells, f"k{i}") for i, w in enumerate(weights)]
    return {"y": at.cells.x + functools.reduce(np.add, parts)}


def arrived(at: Instant, weights: Sequence[float], steps: int) -> Made:
    """The end of a step, of so many in a sample."""
    cells, made = at.cells, at.unless_lost({"x": point(at, weights)["y"]})
    following = cells.j + 1.0
    # Drake looks after every step; the next sample after the last one
    is_last = following >= steps
    is_sound = _is_bounded(at, made["x"]) | is_last
    return {
        **made,
        **_seen(at, _time_of(at, following), is_sound),
        "j": np.where(is_last, 0.0, following),
        "number": cells.number + np.where(is_last, 1.0, 0.0),
    }


def _time_of(at: Instant, step: np.ndarray) -> np.ndarray:
    """The begin of a step in the present sample (1), s."""
    cells = at.cells
    return cells.number * cells.sample_time + step * cells.step


def _is_bounded(at: Instant, x: np.ndarray) -> np.ndarray:
    velocities = x[list(at.blocks.known[at.blocks.nq :])]
    return (np.abs(velocities) <= at.cells.bound).all()


def _seen(at: Instant, time: np.ndarray, is_sound: np.ndarray) -> dict[str, np.ndarray]:
    """What is known of a run that is sound at a time, or not."""
    return {
        "lost": np.where(at.is_lost | ~is_sound, 1.0, 0.0),
        "seen_at": np.where(at.is_lost, at.cells.seen_at, time),
    }
