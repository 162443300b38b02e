"""A reference that is a block without inputs, computed before its phase runs."""

from collections.abc import Mapping

import numpy as np

from ffsm_drake.systems.sampled import Arrays, Now, Sampled


class FollowedReference:
    """A reference block, and its outputs over the phase that was computed last.

    ``rows`` has the outputs (samples of the phase, n), ``shown`` its signals as a record has them.
    """

    def __init__(self, block: Sampled, held: Mapping[str, bool]) -> None:
        """Args: the block; its signals, and whether a record has them after a sample's update."""
        self.block, self._held = block, held
        self.rows, self.shown = dict[str, np.ndarray](), dict[str, np.ndarray]()

    def follow(self, memory: Arrays, samples: range, period: float) -> Arrays:
        """Compute the reference from its memory at the first sample on. Return its memory before
        the last sample.
        """
        found, memories = list[Arrays](), [memory]
        for sample in (*samples, samples[-1]):  # again, to see what comes after it
            outputs, memory = self.block.step({}, memory, Now(period * sample))
            found.append(outputs)
            memories.append(memory)
        rows = {name: np.array([each[name] for each in found]) for name in found[0]}
        self.rows = {name: values[:-1] for name, values in rows.items()}
        self.shown = {
            name: rows[name][1:] if is_held else rows[name][:-1]
            for name, is_held in self._held.items()
        }
        return memories[-3]
