"""The blocks of a loop on symbols at an instant, and their memory."""

import collections
import functools
from collections.abc import Iterator, Mapping

import numpy as np

from ffsm_drake.loop.blocks import usual_sizes
from ffsm_drake.plugins.compiled.blocks import Blocks, Placed
from ffsm_drake.plugins.compiled.models import traced_model
from ffsm_drake.plugins.compiled.parameters import with_symbols
from ffsm_drake.plugins.compiled.parts import Parts, at_start
from ffsm_drake.plugins.compiled.stepping import joined, parted, read, stepped
from ffsm_drake.plugins.tape.arrays import inputs, traced
from ffsm_drake.plugins.tape.numbers import Tape
from ffsm_drake.systems.sampled import Arrays, Now, Sampled, sized

Made = Arrays  # cell -> what a function writes there


class Cells:
    """Arrays of symbols as attributes, by the names of cells (``Blocks``); ``read`` has those that
    are read.
    """

    def __init__(self, tape: Tape, sizes: Mapping[str, int]) -> None:
        self._tape, self._sizes, self.read = tape, sizes, dict[str, np.ndarray]()

    def __getattr__(self, name: str) -> np.ndarray:
        array = inputs(self._tape, name, (self._sizes[name],))
        array.setflags(write=False)
        setattr(self, name, array)
        self.read[name] = array
        return array


class Instant:
    """The blocks of a loop with symbols in place of their numbers, at an instant."""

    def __init__(self, blocks: Blocks, cells: Cells) -> None:
        self.blocks, self.cells = blocks, cells
        self._after: dict[str, list[np.ndarray]] = collections.defaultdict(list)  # memory, by state

    @functools.cached_property
    def parts(self) -> Parts:
        """The blocks with symbols, by kind and name."""
        return with_symbols(self.blocks.parts, self.cells.parts, traced([]), traced_model)

    def alive(self, x: np.ndarray) -> np.ndarray:
        """A state, which is no number in a lost run, so that it asks for no loops."""
        first = np.where(self.is_lost, np.nan, x[:1])
        return np.concatenate([first, x[1:]])

    @property
    def x(self) -> np.ndarray:
        """The state of the plant and of the flows; no number in a lost run."""
        return self.alive(self.cells.x)

    @property
    def is_lost(self) -> np.ndarray:
        return self.cells.lost != 0.0

    def unless_lost(self, after: Made) -> dict[str, np.ndarray]:
        """What becomes of states; those of a lost run stay."""
        return {
            name: np.where(self.is_lost, getattr(self.cells, name), values)
            for name, values in after.items()
        }

    def states(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """The plant's state: known and hidden coordinates."""
        return {"state": x[list(self.blocks.known)], "hidden_state": x[list(self.blocks.hidden)]}

    @property
    def num_plant(self) -> int:
        return len(self.blocks.known) + len(self.blocks.hidden)

    def sampled(self, kind: str) -> Iterator[tuple[Placed, Sampled]]:
        """The sampled blocks of a kind, with symbols."""
        for placed in self.blocks.sampled:
            if placed.kind == kind:
                yield placed, self.parts.stepping[kind][placed.name]

    def _memory(self, placed: Placed) -> dict[str, np.ndarray]:
        values = getattr(self.cells, placed.cell)[placed.first :]
        return parted(values, at_start(placed.block))[0]

    def step(
        self, placed: Placed, block: Sampled, signals: Arrays, now: Now
    ) -> dict[str, np.ndarray]:
        """The outputs of a sampled block; its memory is noted."""
        usual = usual_sizes(placed.kind, self.blocks.coordinates)
        if placed.phases.stop > placed.phases.start:
            now = now._replace(phase=self.cells.phases[placed.phases])
        memory, own = self._memory(placed), placed.block
        outputs, after = stepped(
            block, sized(own.outputs, usual, placed.kind), read(own, signals), memory, now
        )
        self._after[placed.cell] += [after[name] for name in memory]
        return outputs

    def keep(self, placed: Placed) -> None:
        """Note that the memory of a block stays."""
        self._after[placed.cell] += self._memory(placed).values()

    def kept(self, state: str) -> np.ndarray:
        """The memory of the blocks after they have stepped."""
        return joined(self._after[state])

    def remembered(self, watched: np.ndarray) -> dict[str, np.ndarray]:
        """The memory of the supervisor, by name."""
        return parted(watched, at_start(self.blocks.parts.supervisor["supervisor"]))[0]
