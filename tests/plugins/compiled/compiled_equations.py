"""The equations of a joint tree as compiled functions of several copies."""

import itertools

import numpy as np

from ffsm_drake.plugins.compiled.code import declarations, of_lanes
from ffsm_drake.plugins.compiled.compiling import Code, registers
from ffsm_drake.plugins.compiled.registers import Registers
from ffsm_drake.plugins.equations import equations
from ffsm_drake.plugins.tape.arrays import inputs
from ffsm_drake.plugins.tape.numbers import Tape

INPUTS = {
    "derivative": ("q", "v", "force", "own"), "bias": ("q", "v", "own"), "mass_matrix": ("q", "own")
}  # fmt: skip


def text_of(name, of, tree):
    """The LLVM text of an equation."""
    tape, sizes = Tape(), {"q": tree.num_positions, "own": tree.num_parameters}
    given = {each: sizes.get(each, tree.num_velocities) for each in INPUTS[name]}
    found = getattr(equations, name)(
        tree, *(inputs(tape, name, (size,)) for name, size in given.items())
    )
    row = [*itertools.chain(*found)] if name == "mass_matrix" else found
    return text_of_traced(of, tape, given, row)


def text_of_traced(of, tape, given, row):
    """The LLVM text of a function ``run`` of arrays of lanes, of inputs and of a row."""
    pointers = ", ".join(f"ptr %{each}" for each in (*given, "row"))
    run = f"define void @run({pointers}) {{\n  call void @traced({pointers})\n  ret void\n}}\n"
    return "\n".join((*declarations(of), of_lanes(of, "traced", tape, given, {"row": row}), run))


def of_copies(text, of, count, size):
    """A function ``run`` of so many inputs as a function of arrays (copies, n), which returns rows
    (copies, size).
    """
    code = Code(lambda: text)
    run = code.function("run", count + 1)

    def calculated(*inputs, _held=code):
        copies = len(inputs[0])
        result = np.zeros((copies, size))
        for first in range(0, copies, of.width):  # lanes beyond the last copy do what it does
            some = np.minimum(np.arange(first, first + of.width), copies - 1)
            lanes = [np.ascontiguousarray(each[some].T) for each in inputs]
            found = np.zeros((size, of.width))
            run(*(each.ctypes.data for each in (*lanes, found)))
            result[some] = found.T
        return result

    return calculated


def compiled(name, tree, width=0):
    """An equation as a function of arrays (copies, n), which returns rows (copies, m)."""
    of, nv = Registers(width) if width else registers(), tree.num_velocities
    size = {"derivative": tree.num_positions + nv, "bias": nv, "mass_matrix": nv * nv}[name]
    return of_copies(text_of(name, of, tree), of, len(INPUTS[name]), size)
