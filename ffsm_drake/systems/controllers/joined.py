"""The control laws of several copies of the spacecraft as one law on arrays with a row for each."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from pydrake.systems.framework import System

from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.law import is_wide
from ffsm_drake.systems.controllers.sampled import SampledController

Joined = Callable[[Sequence[PlantModel]], PlantModel]


class _CannotJoin(Exception):
    """The laws differ in more than rows can hold."""


def join_controllers(
    controllers: Sequence[System], models: Sequence[PlantModel], join_models: Joined
) -> SampledController | None:
    """Return the controllers of several copies as one; None if their laws are not wide, or differ
    in fields without rows.

    Args:
      controllers: the controller of each copy.
      models: the nominal plant of each copy; its law may hold it.
      join_models: the nominal models of several copies as one.
    """
    sampled = [each for each in controllers if isinstance(each, SampledController)]
    if len(sampled) < len(controllers) or not all(is_wide(each.law) for each in sampled):
        return None
    try:
        law = _joined([each.law for each in sampled], models, join_models)
    except _CannotJoin:
        return None
    return sampled[0].widened(law, [each.law for each in sampled])


def _joined(values: Sequence[Any], models: Sequence[PlantModel], join_models: Joined) -> Any:
    """Return a field of all laws as one: of vectors a row for each, of numbers that differ a
    column, of dataclasses such a one; all else, indices among it, must be equal.
    """
    first = values[0]
    if len(set(map(type, values))) > 1:
        raise _CannotJoin
    if isinstance(first, PlantModel):
        if any(each.context is not own.context for each, own in zip(values, models, strict=True)):
            raise _CannotJoin
        return join_models(values)
    if dataclasses.is_dataclass(first) and not isinstance(first, type):
        fields = dict[str, Any]()
        for field in dataclasses.fields(first):
            own = [getattr(each, field.name) for each in values]
            kept = field.metadata.get("of_each", False)
            fields[field.name] = tuple(own) if kept else _joined(own, models, join_models)
        return dataclasses.replace(first, **fields)
    if isinstance(first, np.ndarray):
        if _is_vector(first) and all(each.shape == first.shape for each in values):
            return np.stack(values)
        equal = all(np.array_equal(each, first) for each in values)
    else:
        equal = all(each == first for each in values)
        if isinstance(first, float) and not equal:
            return np.array(values)[:, None]
    if not equal:
        raise _CannotJoin
    return first


def _is_vector(values: np.ndarray) -> bool:
    """Whether it has a number for each coordinate; indices say which coordinates."""
    return values.ndim == 1 and bool(np.issubdtype(values.dtype, np.floating))
