"""Traced operations on arrays of numbers, for many sets of inputs at once."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.plugins.tape.numbers import NotTraceable, Symbol, Tape, needed

_FUNCTIONS: Mapping[str, Any] = {
    "add": np.add, "subtract": np.subtract, "multiply": np.multiply, "divide": np.divide,
    "negate": np.negative, "sqrt": np.sqrt, "sine": np.sin, "cosine": np.cos,
}  # fmt: skip


class Program:
    """Arithmetic of a tape."""

    def __init__(self, tape: Tape, results: Sequence[Any]) -> None:
        """Args: the tape; symbols and numbers. Raises NotTraceable: there is more than sums,
        products, roots and sines.
        """
        self._results = [each.index if isinstance(each, Symbol) else each for each in results]
        places = [each for each in self._results if isinstance(each, int)]
        self._steps: list[tuple[int, str, tuple[Any, ...]]] = [
            (index, *tape.operations[index]) for index in needed(tape.operations, places)
        ]
        if unknown := {kind for _, kind, _ in self._steps} - {"input", *_FUNCTIONS}:
            raise NotTraceable(f"a program with {min(unknown)}")
        used = [(index, of) for index, kind, of in self._steps if kind != "input"]
        last = {each: index for index, operands in used for each in operands}
        kept = {*places}
        self._done = dict[int, list[int]]()  # values that nothing needs after a step
        for value, index in last.items():
            if isinstance(value, int) and value not in kept:
                self._done.setdefault(index, []).append(value)

    def run(self, inputs: Mapping[str, Any]) -> list[Any]:
        """Return the results. Args: arrays or numbers, of inputs by name."""
        made = dict[int, Any]()
        for index, kind, operands in self._steps:
            if kind == "input":
                array, entry = operands
                made[index] = inputs[array][entry]
                continue
            given = (made[each] if isinstance(each, int) else each for each in operands)
            made[index] = _FUNCTIONS[kind](*given)
            for each in self._done.get(index, ()):
                del made[each]
        return [made[each] if isinstance(each, int) else each for each in self._results]
