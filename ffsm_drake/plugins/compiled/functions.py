"""The traced functions of a compiled loop, as code on its cells."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ffsm_drake.plugins.compiled import marching
from ffsm_drake.plugins.compiled.blocks import COUNTS, Blocks
from ffsm_drake.plugins.compiled.code import of_lanes
from ffsm_drake.plugins.compiled.instant import Cells, Made
from ffsm_drake.plugins.compiled.registers import Registers
from ffsm_drake.plugins.compiled.sampling import Sampling
from ffsm_drake.plugins.compiled.schemes import SCHEMES
from ffsm_drake.plugins.tape.numbers import NotTraceable, Symbol, Tape, number
from ffsm_drake.plugins.tape.tangents import tangents

Traceable = Callable[[Sampling], Made]

_NOISE = ("noise", "drift_noise")  # of a row, the only numbers with a derivative


class Function(NamedTuple):
    """A traced function."""

    text: str  # in LLVM's language
    arrays: tuple[str, ...]  # what it reads, and then what else it writes


def functions(
    blocks: Blocks, registers: Registers, *, steps: int, begins: bool, slopes: bool
) -> dict[str, Function]:
    """Return the functions of a sample and of the integrator.

    Args:
      blocks: the loop.
      registers: what each number is a register of.
      steps: of the integrator in a sample.
      begins: with the first sample of a run, and what is known of a run after a sample.
      slopes: with derivatives along a direction (cells ``d_...``).

    Raises NotTraceable, or what the law raises on symbols.
    """
    made = functions_of(blocks, steps=steps, begins=begins)
    return {
        name: _function(blocks, registers, name, each, slopes=slopes) for name, each in made.items()
    }


def functions_of(blocks: Blocks, *, steps: int, begins: bool) -> dict[str, Traceable]:
    """Return what is traced, by name. Arguments: see ``functions``."""
    scheme = SCHEMES[blocks.scheme]
    made: dict[str, Traceable] = {
        "instants": functools.partial(marching.instants, times=scheme.times),
        "derivative": Sampling.derivative,
        "carried": marching.carried,
    }
    if blocks.called:
        made |= {"sensed": Sampling.sensed, "acted": Sampling.acted}
    else:  # the map of one sample has no detector
        is_split = begins and blocks.detector is not None
        sample = Sampling.decided if is_split else Sampling.sample
        made |= {"sensed": Sampling.sensed} if is_split else {}
        made["sample"] = functools.partial(sample, is_first=False)
        if begins:
            made["first"] = functools.partial(sample, is_first=True)
    if begins:
        made["judged"] = marching.judged
    if blocks.per_sample > 1:
        made["touching"] = Sampling.touching
    *points, last = scheme.points
    for i, weights in enumerate(points):
        made[f"point{i}"] = functools.partial(marching.point, weights=weights)
    end = functools.partial(marching.arrived, weights=last, steps=steps)
    made[f"point{len(points)}"] = end
    return made


class Traced(NamedTuple):
    """A function of cells on symbols."""

    tape: Tape
    reads: dict[str, np.ndarray]  # arrays of symbols
    results: dict[str, list[Symbol | float]]
    sizes: dict[str, int]  # of all cells


def traced_function(blocks: Blocks, made: Traceable) -> Traced:
    """Trace a function of cells. Raises NotTraceable, or what the law raises on symbols."""
    changing = blocks.states | blocks.results
    sizes = blocks.parameters | changing | blocks.row | COUNTS
    sizes |= {"t": 1, "state": sizes["x"], "rates": sizes["x"]}
    tape = Tape()
    cells = Cells(tape, sizes)
    results = {
        each: [number(one) for one in np.asarray(values, dtype=object).ravel()]
        for each, values in made(Sampling(blocks, cells)).items()
    }
    for each, values in results.items():
        if len(values) != sizes[each]:
            raise NotTraceable(f"size {len(values)} of {each} instead of {sizes[each]}")
        for one in values:
            tape.place_of(one)
    return Traced(tape, cells.read, results, sizes)


def _function(
    blocks: Blocks,
    registers: Registers,
    name: str,
    made: Traceable,
    *,
    slopes: bool,
) -> Function:
    """Trace a function of cells."""
    tape, read, results, sizes = traced_function(blocks, made)
    given = {each: sizes[each] for each in read}
    if slopes:
        seeds = dict[int, Symbol]()
        changing = blocks.states | blocks.results
        times = {f"t{i}" for i in range(len(SCHEMES[blocks.scheme].times))}
        for each in filter((changing.keys() - times | {"state", *_NOISE}).__contains__, read):
            given[f"d_{each}"] = sizes[each]
            direction = tape.inputs(f"d_{each}", sizes[each])
            symbols = [symbol.index for symbol in read[each].ravel()]
            seeds |= dict(zip(symbols, direction, strict=True))
        flat = [value for values in results.values() for value in values]
        slope = iter(tangents(tape, flat, seeds))
        results |= {
            f"d_{each}": [next(slope) for _ in range(len(values))]
            for each, values in results.items()
        }
    arrays = tuple(dict.fromkeys((*given, *results)))
    return Function(of_lanes(registers, name, tape, given, results), arrays)
