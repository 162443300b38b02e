"""The parameters of a law: the numbers in its fields, in the order of the fields.

Arrays of floats, declared gains and the masses of models are parameters, which may differ between
runs. All other fields are constants of the traced code.

An object with ``constants`` is a constant. What a block names in ``in_phase`` is read by its
``phase`` alone, or by ``at_samples``, whose numbers each sample reads.

A law, or a part of it, can name tables (n, ...) in ``by_sample``. Of these, a sample uses one row,
which depends only on the sample's number and the desired configuration. ``at_samples(q_d)`` returns
the rows for q_d (samples, nq), by field. In the traced law, the table has only this row.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Hashable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame
from pydrake.systems.framework import Context

from ffsm_drake.plugins.equations.tree import Reader
from ffsm_drake.plugins.tape.numbers import NotTraceable
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.spacecraft.free_floating import ReducedModel
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.law import gains_of

_CONSTANTS = (bool, int, float, str, slice, type(None), np.generic)


Law = TypeVar("Law")  # or other blocks
Models = Callable[[PlantModel, np.ndarray], PlantModel]


class _Unknown:
    """In place of a plant and its context, whose numbers would be constants of the code."""

    def __getattr__(self, name: str) -> Any:
        raise NotTraceable("the law reads the plant of its model")


UNKNOWN: Any = _Unknown()


class BySample(Protocol):
    """What has tables by sample."""

    def at_samples(self, q_d: np.ndarray) -> Mapping[str, np.ndarray]:
        """Return their rows, see above."""


class Parameters(NamedTuple):
    """What code has from the fields of a law, or of other blocks."""

    values: np.ndarray  # (n) that may differ between runs
    constants: tuple[Hashable, ...]  # equal for equal code
    num_planned: int  # size of a row of ``rows_of``


def parameters_of(law: object, place: str = "the law") -> Parameters:
    """Return the parameters of a law, or of other blocks. Raises NotCovered: a field is of an
    unknown kind.
    """
    rows, constants, planned = [np.zeros(0)], list[Hashable](), list[int]()

    def note(values: np.ndarray) -> np.ndarray:
        rows.append(values.ravel())
        constants.append(values.shape)
        return values

    def shape(part: BySample, name: str) -> np.ndarray:
        table: np.ndarray = getattr(part, name)
        constants.append(table.shape[1:])
        planned.append(math.prod(table.shape[1:]))
        return table

    _replaced(law, place, _Replacement(note, constants.append, lambda model, own: model, shape, {}))
    return Parameters(np.concatenate(rows), tuple(constants), sum(planned))


def rows_of(law: object, q_d: np.ndarray) -> np.ndarray:
    """Return the planned numbers (n, m) of a law at samples with desired configurations q_d
    (n, nq).
    """
    rows = list[np.ndarray]()

    def note(part: BySample, name: str) -> np.ndarray:
        rows.append(part.at_samples(q_d)[name].reshape(len(q_d), -1))
        return getattr(part, name)

    ignored = lambda *values: values[0]  # noqa: E731
    _replaced(law, "the law", _Replacement(ignored, ignored, ignored, note, {}))
    return rows[0] if len(rows) == 1 else np.hstack([np.zeros((len(q_d), 0)), *rows])


def with_symbols(law: Law, symbols: np.ndarray, planned: np.ndarray, model: Models) -> Law:
    """Return the law with symbols (n) in place of its parameters, and one row of ``planned`` (m)
    in place of tables by sample; ``model`` replaces a model, given the symbols of its masses.
    """
    taken = {"symbols": 0, "planned": 0}

    def take(which: str, array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        first = taken[which]
        taken[which] += math.prod(shape)
        return array[first : taken[which]].reshape(shape)

    def number(values: np.ndarray) -> Any:
        part = take("symbols", symbols, values.shape)
        return part if values.ndim else part.item()

    def row(part: BySample, name: str) -> np.ndarray:
        return take("planned", planned, (1, *getattr(part, name).shape[1:]))

    return _replaced(law, "the law", _Replacement(number, lambda constant: None, model, row, {}))


def reader_of(model: PlantModel) -> Reader:
    """Return the reader of the plant of a model, with the frames that are displaced in its context.
    Raises NotCovered.
    """
    return _reader(model.plant, _reader(model.plant, ()).displaced_in(model.context))


@functools.lru_cache(maxsize=64)
def _reader(plant: MultibodyPlant, displaced: tuple[int, ...]) -> Reader:
    return Reader(plant, displaced)


class _Replacement(NamedTuple):
    """What stands in place of the parts of an object."""

    number: Callable[[np.ndarray], Any]  # of an array or a number
    constant: Callable[[Hashable], None]  # gets all else, which stays
    model: Models  # of a model, given its masses
    row: Callable[[BySample, str], np.ndarray]  # of a table by sample, given its owner and name
    masses: dict[int, Any]  # what stands for those of a model, by the identity of its context


def _replaced(value: Any, place: str, new: _Replacement) -> Any:
    """An object with other numbers, models and tables by sample."""
    if type(value) in (PlantModel, ReducedModel):
        reader = reader_of(value)
        new.constant((type(value).__name__, value.coordinates.undriven, reader.tree))
        return new.model(value, _masses(value, reader, new))
    if isinstance(value, (MultibodyPlant, Context)):
        return UNKNOWN
    if isinstance(value, Frame):
        placed = _reader(value.GetParentPlant(), ()).place_of(value)
        new.constant(placed)
        return placed
    if hasattr(type(value), "constants"):
        new.constant((type(value).__name__, value.constants))
        return value
    if isinstance(value, np.ndarray) and value.dtype == float:
        return new.number(value)
    if isinstance(value, np.ndarray) and value.dtype.kind in "iub":
        new.constant((value.shape, value.dtype.str, value.tobytes()))
        return value
    if isinstance(value, _CONSTANTS):
        new.constant((type(value).__name__, repr(value)))
        return value
    if isinstance(value, MappingProxyType):  # which does not change
        new.constant(tuple(value))
        return {key: _replaced(each, f"{place}.{key}", new) for key, each in value.items()}
    if isinstance(value, tuple):
        new.constant(len(value))
        if not hasattr(value, "_fields"):
            return tuple(_replaced(each, place, new) for each in value)
        named = zip(value._fields, value, strict=True)
        return type(value)(*(_replaced(each, f"{place}.{name}", new) for name, each in named))
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        raise NotCovered(f"{place}: {type(value).__name__}, no number, array or dataclass")
    return _with_fields(value, place, new)


def _masses(model: PlantModel, reader: Reader, new: _Replacement) -> Any:
    """What stands for the masses of a model, once for all models with its context."""
    known, key = new.masses, id(model.context)
    new.constant([*known].index(key) if key in known else len(known))
    if key not in known:
        known[key] = new.number(reader.parameters(model.context))
    return known[key]


def _with_fields(value: Any, place: str, new: _Replacement) -> object:
    """A dataclass with other fields."""
    kind: type = type(value)
    gains, made = gains_of(kind), dict[str, object]()
    new.constant(kind)  # not its name, which another class may get
    for field in dataclasses.fields(value):
        own = getattr(value, field.name)
        if not field.init:
            raise NotCovered(f"{place}: its field {field.name} is computed")
        if field.name in getattr(kind, "in_phase", ()):
            made[field.name] = own
        elif (field.name in gains or field.name == "sample_time") and isinstance(own, float):
            made[field.name] = new.number(np.array(own))
        elif field.name in getattr(kind, "by_sample", ()):
            made[field.name] = new.row(value, field.name)
        else:
            made[field.name] = _replaced(own, f"{place}, field {field.name}", new)
    # not by the class, whose checks of values were made with the numbers
    other: object = object.__new__(kind)
    for name, each in made.items():
        object.__setattr__(other, name, each)
    return other
