"""Compiled functions of a joint tree: derivative, mass matrix and bias of many copies."""

import functools
from collections.abc import Callable

import numpy as np

from ffsm_drake.plugins.generated.code import function
from ffsm_drake.plugins.generated.compiling import Code, registers
from ffsm_drake.plugins.generated.equations import bias, derivative, mass_matrix
from ffsm_drake.plugins.generated.registers import LANES, Registers
from ffsm_drake.plugins.generated.symbols import Tape
from ffsm_drake.plugins.generated.tree import Tree

_INPUTS = {
    "derivative": ("q", "v", "force", "own"),
    "mass_matrix": ("q", "own"),
    "bias": ("q", "v", "own"),
}


class Lanes:
    """An array of B copies (B, rows) as (blocks, rows, 8), for compiled functions."""

    def __init__(self, copies: int, rows: int) -> None:
        self.blocks, self._copies, self._rows = -(-copies // LANES), copies, rows
        self.values = np.zeros((self.blocks, rows, LANES))
        self.pointer = self.values.ctypes.data
        self._staged = np.zeros((self.blocks * LANES, rows))
        self._as_blocks = self._staged.reshape(self.blocks, LANES, rows).transpose(0, 2, 1)
        self._flat = self._staged.reshape(-1)[: copies * rows]

    def fill(self, values: np.ndarray) -> None:
        """Give each copy its row; what the lanes beyond the last one hold affects none."""
        self._flat[:] = values.reshape(-1)
        self.values[:] = self._as_blocks

    def read(self) -> np.ndarray:
        """The row of each copy (B, rows): a view, valid until the next call."""
        self._as_blocks[:] = self.values
        return self._staged[: self._copies]


class Kernels:
    """The functions of a tree. Arrays: see ``code``."""

    def __init__(self, tree: Tree) -> None:
        self.tree = tree
        self._code = Code(repr(tree), functools.partial(module_text, registers(), tree))

    def function(self, name: str) -> Callable[..., None]:
        """``derivative``, ``mass_matrix`` or ``bias``: of pointers to its inputs, which are q, v,
        force and parameters as it needs them, to its result, and of the number of blocks.
        """
        return self._code.function(name, len(_INPUTS[name]) + 1)


def module_text(registers: Registers, tree: Tree) -> str:
    """The LLVM text of all functions of a tree."""
    return "\n".join(_function_text(registers, tree, name) for name in _INPUTS)


def _function_text(registers: Registers, tree: Tree, name: str) -> str:
    rows = {
        "q": tree.num_positions,
        "v": tree.num_velocities,
        "force": tree.num_velocities,
        "own": tree.num_parameters,
    }
    tape, arrays = Tape(), {each: rows[each] for each in _INPUTS[name]}
    inputs = [tape.inputs(each, count) for each, count in arrays.items()]
    if name == "derivative":
        results = derivative(tree, *inputs)
    elif name == "bias":
        results = bias(tree, *inputs)
    else:
        results = [value for row in mass_matrix(tree, *inputs) for value in row]
    return function(registers, name, tape, arrays, results)
