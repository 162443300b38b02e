"""The period of user-supplied systems, which may count samples in their state without a word of
it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ffsm_drake.plugins.design.stability.drake_sample import STEP, DrakeSample
from ffsm_drake.plugins.design.stability.linear_loop import NotLinear

# Longest period, in control samples, that is searched, and the change of the map, relative to its
# rows, between different samples.
_LONGEST_PERIOD, _DIFFERENT = 12, 0.3
_COARSE = 1e-4  # step with which a smooth function has the derivative of ``STEP``
_ROUNDING = 1e-14  # rounding of numbers in memory, relative to the largest of a group
# Stretches of samples evaluated: a transient may hide the period in the first.
_TRIES = 3


def period_of(
    loop: Any, index: int, state: np.ndarray, held: Mapping[str, np.ndarray]
) -> int | None:
    """Control samples after which user-supplied systems repeat themselves; None: the loop diverges.

    Args:
      loop: the ``SampledLoop``.
      index: of a control sample.
      state: before it.
      held: see ``Linearizer.at``.

    Raises NotLinear where they do not repeat themselves.
    """
    sample: DrakeSample = loop.sample

    def slope(index: int, state: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        of_plant = loop.directions(state)[:, : loop.plant_size]
        return sample.update_slope(index, state, of_plant, step)

    for _ in range(_TRIES):
        memories, maps = list[np.ndarray](), list[np.ndarray]()
        indices = range(index, index + 2 * _LONGEST_PERIOD)
        for each in indices:
            memory, found = slope(each, state, STEP)
            memories.append(memory)
            maps.append(found)
            state, _ = loop.after(each, state, held)
            if loop.has_diverged(state) or not np.isfinite(state).all():
                return None
        period = _period_in(sample, indices, np.array(memories), np.array(maps))
        if period is not None:
            return period
        index += 2 * _LONGEST_PERIOD
    names = ", ".join(system.get_name() for system in sample.user_supplied)
    rows = np.r_[sample.groups]
    fine, coarse = (slope(index, state, step)[1][rows] for step in (STEP, _COARSE))
    if (np.abs(fine - coarse) > _DIFFERENT * np.abs(fine).max()).any():
        raise NotLinear(
            f"{names}: has no derivative at small errors (sign, root or rounding); smooth "
            "it, or make its factor a state and return 0 for it in held()"
        )
    raise NotLinear(
        f"{names}: differs from sample to sample, without a period of up to "
        f"{_LONGEST_PERIOD} samples"
    )


def _period_in(
    sample: DrakeSample, indices: range, memories: np.ndarray, maps: np.ndarray
) -> int | None:
    """The least period of the maps (n, m, k) of control samples, None for maps without a period;
    ``memories`` (n, m) are the values after the samples.

    Samples with equal behaviour of the shipped systems are compared, since a navigation with
    one output per second makes one map of a hundred differ; if no two are equal, all are compared.
    """
    kinds = [sample.kind(each) for each in indices]
    largest, least = np.abs(maps).max(axis=(0, 2)), np.full(memories.shape[1], np.inf)
    for part in sample.groups:  # small dependences are rounding
        rounding = _ROUNDING / STEP * np.abs(memories)[:, part].max(initial=0.0)
        least[part] = np.maximum(_DIFFERENT * largest[part], rounding)
    for period in range(1, _LONGEST_PERIOD + 1):
        pairs = [(k, k + period) for k in range(len(maps) - period)]
        alike = [(a, b) for a, b in pairs if kinds[a] == kinds[b]]
        if all((np.abs(maps[b] - maps[a]) <= least[:, None]).all() for a, b in alike or pairs):
            return period
    return None
