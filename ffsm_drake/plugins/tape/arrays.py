"""Arrays of symbols: unchanged NumPy code runs on them.

``Traced`` is an array of objects. NumPy hands its functions over (``__array_ufunc__`` and
``__array_function__``), and ``elements`` and ``functions`` apply them to the symbols. What has no
rule there raises NotTraceable.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.plugins.tape import numbers
from ffsm_drake.plugins.tape.elements import called, each, objects, reduced
from ffsm_drake.plugins.tape.functions import RULES
from ffsm_drake.plugins.tape.numbers import Loop, NotTraceable, Tape, Traceable, select


class Traced(np.ndarray):
    """An array of numbers and symbols."""

    __array_priority__ = 1000.0  # its type is that of results with other arrays

    def __array_ufunc__(
        self, ufunc: Any, method: str, *given: Any, out: Any = None, where: Any = True, **more: Any
    ) -> Any:
        name = ufunc.__name__
        for unused in ("dtype", "casting", "order", "subok"):
            more.pop(unused, None)
        if method == "reduce":
            if where is not True:
                raise NotTraceable(f"np.{name}.reduce with where=")
            made = reduced(name, given[0], **more)
        elif method != "__call__" or more:
            raise NotTraceable(f"np.{name}.{method}" + "".join(f" with {key}=" for key in more))
        else:
            made = called(ufunc, *given)
        target = None if out is None else out[0]
        if where is not True:
            made = each(select, where, made, 0.0 if target is None else target)
        if target is None:
            return wrapped(made)
        if target.dtype != object:
            raise NotTraceable("out= an array of numbers")
        target.view(np.ndarray)[...] = made
        return target

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if function in RULES:
            return wrapped(RULES[function](*args, **kwargs))
        if function.__module__ == "numpy.linalg":
            raise NotTraceable(f"np.linalg.{function.__name__}")
        return wrapped(super().__array_function__(function, types, args, kwargs))

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, (Traced, Traceable)):
            key = _known(key, "an index that is known only when it runs")
        return super().__getitem__(key)

    def __setitem__(self, key: Any, value: Any) -> None:
        if isinstance(key, Traced) and _has_symbols(key):
            if np.ndim(value) and np.shape(value) != self.shape:
                raise NotTraceable("an assignment of fewer values under a mask")
            now = self.view(np.ndarray)
            now[...] = each(select, key, value, now)
            return
        super().__setitem__(_known(key, "an index") if isinstance(key, Traced) else key, value)

    def __pow__(self, power: Any, _modulo: Any = None) -> Any:
        return np.power(self, power)  # an array's own method compares the power

    def __bool__(self) -> bool:
        if self.size == 1:
            return bool(self.item())
        raise ValueError("the truth of an array is ambiguous")

    def astype(self, dtype: Any, *_: Any, **__: Any) -> Any:
        """Floats are what it holds; nothing else is known."""
        if np.dtype(dtype) in (float, object):
            return wrapped(each(numbers.number, self))
        return _known(self, f"astype({np.dtype(dtype).name})").astype(dtype)


def traced(values: Any) -> Any:
    """An array of symbols and numbers, from nested lists or an array."""
    return np.asarray(values, dtype=object).view(Traced)


def inputs(tape: Tape, array: str, shape: Sequence[int]) -> Any:
    """An array of symbols: an input of a traced function."""
    return traced(tape.inputs(array, math.prod(shape))).reshape(shape)


def _recorded_loop(
    _self: Any,
    step: Callable[[Mapping[str, Any], Mapping[str, Any]], Mapping[str, Any]],
    state: Mapping[str, Any],
    fixed: Mapping[str, Any],
    most: int,
) -> Mapping[str, Any]:
    """``choice.repeated``: the loop is an operation on the tape of its symbols."""
    given = [*state.values(), *fixed.values()]
    symbols = [entry for array in given for entry in objects(array).ravel()]
    tape = next(entry.tape for entry in symbols if isinstance(entry, Traceable))
    own = Tape()
    before, read = (
        _parted(inputs(own, which, (sum(map(np.size, of.values())),)), of)
        for which, of in (("state", state), ("fixed", fixed))
    )
    made = step(before, read)
    after = [numbers.number(entry) for name in state for entry in objects(made[name]).ravel()]
    size = len(after)
    found = tape.repeat(Loop(own, after, len(symbols) - size, most), symbols[:size], symbols[size:])
    return _parted(traced(found), state)


def _parted(values: Any, shapes: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers one after the other as arrays in the shapes of others."""
    found, first = {}, 0
    for name, like in shapes.items():
        found[name] = values[first : first + np.size(like)].reshape(np.shape(like))
        first += np.size(like)
    return found


def wrapped(made: Any) -> Any:
    """A result of NumPy: an array of objects as ``Traced``, one without dimensions as its value."""
    if isinstance(made, np.ndarray):
        if made.dtype != object:
            return made
        return made.item() if made.ndim == 0 else made.view(Traced)
    return type(made)(map(wrapped, made)) if type(made) in (tuple, list) else made


def _has_symbols(values: Any) -> bool:
    return any(isinstance(entry, Traceable) for entry in objects(values).ravel())


def _known(values: Any, what: str) -> np.ndarray:
    """The values of an array without symbols."""
    if _has_symbols(values):
        raise NotTraceable(what)
    return np.array(objects(values).tolist())


def _ufunc(self: Any, ufunc: Any, method: str, *given: Any, **more: Any) -> Any:
    own = [traced(value) if isinstance(value, Traceable) else value for value in given]
    return getattr(ufunc, method)(*own, **more)


def _function(self: Any, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
    return function(*map(_deep, args), **kwargs)


def _deep(value: Any) -> Any:
    if isinstance(value, Traceable):
        return traced(value)
    return type(value)(map(_deep, value)) if type(value) in (list, tuple) else value


Traceable.__array_ufunc__ = _ufunc  # type: ignore[attr-defined]
Traceable.__array_function__ = _function  # type: ignore[attr-defined]
Traceable.recorded_loop = _recorded_loop  # type: ignore[attr-defined]
Traced.recorded_loop = _recorded_loop  # type: ignore[attr-defined]
