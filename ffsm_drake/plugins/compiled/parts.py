"""The blocks of a loop beside its law, with their memory as rows of numbers."""

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np

from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.sampled import Sampled, memory_of, phases_of

# Kinds of sampled blocks, in the order of their phases, and the states with their memory; forces
# that do not step once in a sample have theirs in ``touched``.
STEPPING = {
    "sensing": "stored", "actuation": "loaded", "forces": "stored", "supervisor": "watched",
}  # fmt: skip
Block = TypeVar("Block")


class Parts(NamedTuple):
    """The blocks of a loop beside its law, by name."""

    sensing: Mapping[str, Sampled]  # stages in a row
    actuation: Mapping[str, Sampled]  # in a row, after limits, quantisation and delay
    flows: Mapping[str, Continuous]  # beside it
    forces: Mapping[str, Sampled]
    last: Mapping[str, Continuous]  # forces that read the sum of all others
    supervisor: Mapping[str, Sampled]  # its mode logic, if there is one

    @property
    def stepping(self) -> dict[str, Mapping[str, Sampled]]:
        """The sampled blocks by kind, in the order of their phases."""
        return {
            "sensing": self.sensing,
            "actuation": self.actuation,
            "forces": self.forces,
            "supervisor": self.supervisor,
        }


def frozen(blocks: Mapping[str, Block]) -> Mapping[str, Block]:
    """Blocks by name that cannot be changed."""
    return MappingProxyType({**blocks})


def sampled_of(parts: Parts) -> list[tuple[str, Sampled]]:
    """The sampled blocks with the states that have their memory."""
    return [
        (cell_of(kind, block), block)
        for kind, blocks in parts.stepping.items()
        for block in blocks.values()
    ]


def cell_of(kind: str, block: Sampled) -> str:
    return "touched" if kind == "forces" and block.per_sample != 1 else STEPPING[kind]


def phases_at(parts: Parts, samples: int) -> np.ndarray:
    """The phases of the sampled blocks at each of so many samples (samples, n)."""
    blocks = [block for _, block in sampled_of(parts)]
    found = [phases_of(each, samples, place=type(each).__name__) for each in blocks]
    return np.concatenate([np.zeros((samples, 0)), *found], axis=1)


def kept_at(parts: Parts, state: np.ndarray) -> dict[str, np.ndarray]:
    """The states of the blocks of a spacecraft that was at a state before (n)."""
    found: dict[str, list[np.ndarray]] = {cell: [] for cell in (*STEPPING.values(), "touched")}
    for cell, block in sampled_of(parts):
        found[cell] += memory_of(block, state, place=type(block).__name__).values()
    return {cell: row(values) for cell, values in found.items()}


def row(values: Iterable[np.ndarray]) -> np.ndarray:
    """Arrays one after the other."""
    return np.concatenate([np.zeros(0), *map(np.ravel, values)])


def at_start(block: Sampled | Continuous) -> dict[str, np.ndarray]:
    """The memory, or own state, of a block at the start."""
    return {name: np.asarray(value, float) for name, value in block.start().items()}


def sizes_of(arrays: Mapping[str, np.ndarray]) -> dict[str, int]:
    """The numbers in each array."""
    return {name: value.size for name, value in arrays.items()}


def total(arrays: Mapping[str, np.ndarray]) -> int:
    """The numbers in some arrays."""
    return sum(sizes_of(arrays).values())
