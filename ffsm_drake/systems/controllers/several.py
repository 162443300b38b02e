"""The laws of several runs as one, that works on arrays (runs, ...)."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import PlantModel, PlantModels
from ffsm_drake.systems.controllers.law import ControlLaw, Sample, State


class CannotShare(Exception):
    """The laws cannot work together; the message says why."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SharedLaw(ControlLaw):
    """The laws of several runs, the k-th row of an array being the k-th run's."""

    laws: tuple[Any, ...]
    merged: Any  # the law that works on all rows

    def initial_state(self) -> State:
        first, *others = [law.initial_state() for law in self.laws]
        return {name: np.stack([first[name], *(of[name] for of in others)]) for name in first}

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        """One control sample of all runs."""
        stepped: tuple[np.ndarray, State] = self.merged.step(sample, state)
        return stepped


def share_law(laws: Sequence[Any], coordinates: Coordinates) -> SharedLaw:
    """One law for several runs, each of which gets the bits that its own law gives it.

    The laws may differ in numbers and arrays, which are stacked, and in their nominal payloads. That each run gets its
    own bits is tried on made-up samples: a law that mixes its runs up, or takes no arrays (runs, ...), shows there.

    Raises:
      CannotShare: the laws differ in something else, or do not keep to themselves.
    """
    shared = SharedLaw(laws=tuple(laws), merged=_merge(list(laws), "law"))
    try:
        _try_out(shared, coordinates)
    except CannotShare:
        raise
    except Exception as error:  # a user's law may raise anything
        raise CannotShare(f"the law does not take several runs: {type(error).__name__}: {error}") from error
    return shared


def _merge(values: list[Any], place: str) -> Any:
    first = values[0]
    kind = type(first)
    if any(type(value) is not kind for value in values):
        raise CannotShare(f"{place} is not of one kind")
    if isinstance(first, PlantModel):
        return first if all(value is first for value in values) else PlantModels(models=tuple(values))
    if dataclasses.is_dataclass(first) and not isinstance(first, type):
        names = [field.name for field in dataclasses.fields(first)]
        merged = {name: _merge([getattr(value, name) for value in values], f"{place}.{name}") for name in names}
        return dataclasses.replace(first, **merged)
    if isinstance(first, np.ndarray):
        if any(value.shape != first.shape for value in values):
            raise CannotShare(f"{place} is not of one size")
        return first if all(np.array_equal(value, first) for value in values) else np.stack(values)
    if all(value is first or value == first for value in values):
        return first
    if isinstance(first, float):
        return np.array(values)[:, None]
    raise CannotShare(f"{place} differs")


_SAMPLES = 3


def _try_out(shared: SharedLaw, coordinates: Coordinates) -> None:
    """Raise CannotShare unless some samples of all runs together have the bits of each run alone."""
    random, runs = np.random.default_rng(0), len(shared.laws)
    nq, nv = len(coordinates.position_names), len(coordinates.names)
    states = [law.initial_state() for law in shared.laws]
    together = shared.initial_state()
    for k in range(_SAMPLES):
        sizes = (nq, nv, nq, nv, nv, nv, nv, nv)  # of the fields of Sample
        arrays = [1e-3 * random.standard_normal((runs, size)) for size in sizes]
        arrays[0][:, 0] = arrays[2][:, 0] = 1.0  # the scalars of the quaternions
        forces, together = shared.step(_sample(arrays, is_first=k == 0), together)
        for run, law in enumerate(shared.laws):
            own = _sample([values[run] for values in arrays], is_first=k == 0)
            force, states[run] = law.step(own, states[run])
            rows = {name: values[run] for name, values in together.items()}
            if not (_same_bits(forces[run], force) and set(rows) == set(states[run])):
                raise CannotShare("the law mixes its runs up")
            if not all(_same_bits(rows[name], states[run][name]) for name in rows):
                raise CannotShare("the law mixes its runs' memory up")


def _sample(arrays: Sequence[np.ndarray], *, is_first: bool) -> Sample:
    q, v, q_d, v_d, a_d, e, e_dot, applied_force = arrays
    return Sample(q, v, q_d, v_d, a_d, e, e_dot, applied_force, is_first)


def _same_bits(first: Any, second: Any) -> bool:
    first, second = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    return first.shape == second.shape and first.tobytes() == second.tobytes()
