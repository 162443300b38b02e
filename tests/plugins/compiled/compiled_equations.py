"""The equations of a joint tree as compiled functions of several copies."""

import itertools

import numpy as np

from ffsm_drake.plugins.compiled.code import declarations, function
from ffsm_drake.plugins.compiled.compiling import Code, registers
from ffsm_drake.plugins.compiled.registers import Registers
from ffsm_drake.plugins.equations import equations
from ffsm_drake.tape.numbers import Tape

INPUTS = {
    "derivative": ("q", "v", "force", "own"), "bias": ("q", "v", "own"), "mass_matrix": ("q", "own")
}  # fmt: skip


def text_of(name, of, tree):
    """The LLVM text of an equation."""
    tape, sizes = Tape(), {"q": tree.num_positions, "own": tree.num_parameters}
    given = {each: sizes.get(each, tree.num_velocities) for each in INPUTS[name]}
    found = getattr(equations, name)(tree, *(tape.inputs(*each) for each in given.items()))
    row = [*itertools.chain(*found)] if name == "mass_matrix" else found
    return "\n".join((*declarations(of), function(of, name, tape, given, {"row": row})))


def compiled(name, tree, width=0):
    """An equation as a function of arrays (copies, n), which returns rows (copies, m)."""
    of = Registers(width) if width else registers()
    text, nv = text_of(name, of, tree), tree.num_velocities
    code = Code(lambda: text)
    size = {"derivative": tree.num_positions + nv, "bias": nv, "mass_matrix": nv * nv}[name]
    call = code.function(name, len(INPUTS[name]) + 1)

    def calculated(*inputs, _held=code):
        rows = [np.ascontiguousarray(each) for each in inputs]
        result = np.zeros((len(rows[0]), size))
        call(*(each.ctypes.data for each in (*rows, result)), len(result))
        return result

    return calculated
