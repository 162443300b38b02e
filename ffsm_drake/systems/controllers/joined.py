"""The control laws of several copies of the spacecraft as one law on arrays with a row for each."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.systems.framework import System

from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.copies import copies_of
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.law import is_wide
from ffsm_drake.systems.controllers.sampled import SampledController


class _CannotJoin(Exception):
    """The laws differ in more than rows can hold."""


def join_controllers(
    controllers: Sequence[System], models: Sequence[PlantModel], scenario: Scenario
) -> SampledController | None:
    """The controllers of several copies as one; None where their laws are not wide, or differ in
    what rows cannot hold.

    Args:
      controllers: of each copy.
      models: of each copy, the nominal plant, which its law may hold.
      scenario: one of theirs; all have its model.
    """
    sampled = [each for each in controllers if isinstance(each, SampledController)]
    if len(sampled) < len(controllers) or not all(is_wide(each.law) for each in sampled):
        return None
    try:
        law = _joined([each.law for each in sampled], models, scenario)
    except _CannotJoin:
        return None
    return sampled[0].widened(law, [each.law for each in sampled])


def _joined(values: Sequence[Any], models: Sequence[PlantModel], scenario: Scenario) -> Any:
    """A field of all laws as one: of vectors a row for each, of numbers that differ a column, of
    dataclasses such a one; all else must be equal.
    """
    first = values[0]
    if all(each is model for each, model in zip(values, models, strict=True)):
        return copies_of(models, scenario)
    if isinstance(first, PlantModel) or len(set(map(type, values))) > 1:
        raise _CannotJoin
    if dataclasses.is_dataclass(first) and not isinstance(first, type):
        fields = {
            field.name: _joined([getattr(each, field.name) for each in values], models, scenario)
            for field in dataclasses.fields(first)
        }
        return dataclasses.replace(first, **fields)
    if isinstance(first, np.ndarray):
        if first.ndim == 1 and all(each.shape == first.shape for each in values):
            return np.stack(values)
        equal = all(np.array_equal(each, first) for each in values)
    else:
        equal = all(each == first for each in values)
        if isinstance(first, float) and not equal:
            return np.array(values)[:, None]
    if not equal:
        raise _CannotJoin
    return first
