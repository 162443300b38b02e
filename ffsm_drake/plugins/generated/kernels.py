"""Compiled functions of a joint tree: derivative, mass matrix and bias of many copies."""

import functools
from collections.abc import Callable

import numpy as np

from ffsm_drake.plugins.compiled.code import declarations, function
from ffsm_drake.plugins.compiled.compiling import Code, registers
from ffsm_drake.plugins.compiled.registers import Registers
from ffsm_drake.plugins.equations.equations import bias, derivative, mass_matrix
from ffsm_drake.plugins.equations.errors import tracking_errors
from ffsm_drake.plugins.equations.tree import Tree
from ffsm_drake.tape.numbers import Tape

# The arrays of each function: its inputs, and then its results.
_INPUTS = {
    "derivative": ("q", "v", "force", "own"),
    "mass_matrix": ("q", "own"),
    "bias": ("q", "v", "own"),
    "tracking_errors": ("desired", "actual"),
}
_RESULTS = {
    "derivative": ("q_rate", "v_rate"),
    "mass_matrix": ("matrix",),
    "bias": ("bias",),
    "tracking_errors": ("e", "e_dot"),
}


class Kernels:
    """The functions of a tree."""

    def __init__(self, tree: Tree, width: int = 0) -> None:
        """Args: the tree, and the numbers that a register holds; 0: those of this processor's."""
        self.tree, of = tree, Registers(width) if width else registers()
        self._code = Code(functools.partial(module_text, of, tree), repr((of, tree)))

    def on(self, name: str, *arrays: np.ndarray) -> Callable[[], None]:
        """A function on arrays with a row for each copy, in memory row after row.

        Args:
          name: ``derivative``, ``mass_matrix``, ``bias`` or ``tracking_errors``.
          arrays: its inputs, as it needs them: q, v, force and parameters, or the desired and the
            actual [q; v]; then its results: rates of q and v; the mass matrix with a row to spare
            (nv + 1, nv); the bias; or error and rate (nv each).
        """
        compiled = self._code.function(name, len(arrays))
        given = (*(each.ctypes.data for each in arrays), len(arrays[0]))

        def call(_held: tuple[np.ndarray, ...] = arrays) -> None:
            compiled(*given)

        return call

    def calculated(self, name: str, *inputs: np.ndarray) -> np.ndarray:
        """The results (copies, n) of a function, side by side, from inputs (copies, n) each."""
        lengths = _lengths(self.tree)
        results = [np.zeros((len(inputs[0]), lengths[each])) for each in _RESULTS[name]]
        self.on(name, *map(np.ascontiguousarray, inputs), *results)()
        return np.hstack(results)


def _lengths(tree: Tree) -> dict[str, int]:
    """The length of a copy's row in each array."""
    nq, nv = tree.num_positions, tree.num_velocities
    inputs = {"q": nq, "v": nv, "force": nv, "own": tree.num_parameters}
    rates = {"q_rate": nq, "v_rate": nv, "matrix": (nv + 1) * nv, "bias": nv}
    return {**inputs, **rates, "desired": nq + nv, "actual": nq + nv, "e": nv, "e_dot": nv}


def module_text(registers: Registers, tree: Tree) -> str:
    """The LLVM text of all functions of a tree."""
    functions = [_function_text(registers, tree, name) for name in _INPUTS]
    return "\n".join((*declarations(registers), *functions))


def _function_text(registers: Registers, tree: Tree, name: str) -> str:
    tape, lengths = Tape(), _lengths(tree)
    arrays = {each: lengths[each] for each in _INPUTS[name]}
    inputs = [tape.inputs(each, count) for each, count in arrays.items()]
    if name == "derivative":
        rates = derivative(tree, *inputs)
        found = [rates[: tree.num_positions], rates[tree.num_positions :]]
    elif name == "bias":
        found = [bias(tree, *inputs)]
    elif name == "tracking_errors":
        desired, actual = inputs
        found = list(tracking_errors(desired, actual, tree.num_positions))
    else:
        spare = [0.0] * tree.num_velocities
        found = [[*(value for row in mass_matrix(tree, *inputs) for value in row), *spare]]
    results = dict(zip(_RESULTS[name], found, strict=True))
    return function(registers, name, tape, arrays, results)
