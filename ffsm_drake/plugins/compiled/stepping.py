"""Blocks on symbols, one at a time."""

from collections.abc import Iterable, Mapping

import numpy as np

from ffsm_drake.plugins.tape.arrays import traced
from ffsm_drake.plugins.tape.numbers import NotTraceable, none_caught
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.controllers.law_block import LawBlock
from ffsm_drake.systems.sampled import Arrays, Now, Sampled


def zeros(sizes: Mapping[str, int]) -> dict[str, np.ndarray]:
    return {name: np.zeros(size) for name, size in sizes.items()}


def parted(values: np.ndarray, shapes: Arrays) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The first of some numbers by name, in the shapes of others, and the rest."""
    found = dict[str, np.ndarray]()
    for name, like in shapes.items():
        found[name], values = values[: like.size].reshape(like.shape), values[like.size :]
    return found, values


def joined(values: Iterable[np.ndarray]) -> np.ndarray:
    """Arrays one after the other."""
    return np.concatenate([traced([]), *(traced(each).ravel() for each in values)])


def read(block: Sampled | Continuous, signals: Arrays) -> dict[str, np.ndarray]:
    """The inputs of a block. Raises NotTraceable: one of its ports is not known."""
    optional = getattr(block, "optional", ())
    ports = [name for name in block.inputs if name in signals or name not in optional]
    if unknown := set(ports) - set(signals):
        raise NotTraceable(f"{type(block).__name__} with an input {min(unknown)}")
    found = {name: traced(signals[name]) for name in ports}
    return found | {name: found[name][list(own)] for name, own in block.entries.items()}


def stepped(
    block: Sampled, ports: Mapping[str, int], inputs: Arrays, memory: Arrays, now: Now
) -> tuple[dict[str, np.ndarray], Arrays]:
    """What a block's step returns on symbols, with numbers in its output ports by name. Raises
    NotTraceable: other names or shapes.
    """
    for each in (*inputs.values(), *memory.values()):
        each.setflags(write=False)
    with none_caught():
        outputs, after = block.step(inputs, memory, now)
    shapes = {name: value.shape for name, value in memory.items()}
    sizes = {name: (size,) for name, size in ports.items()}
    for found, wanted in ((outputs, sizes), (after, shapes)):
        if {name: np.shape(value) for name, value in found.items()} != wanted:
            kind = "law" if isinstance(block, LawBlock) else type(block).__name__
            raise NotTraceable(f"the {kind} returns other names or shapes than it should")
    return {name: traced(value) for name, value in outputs.items()}, after
