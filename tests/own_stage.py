"""A user's stage of sensing, as pure functions."""

from dataclasses import dataclass

import numpy as np

from ffsm_drake import Sampled


@dataclass(frozen=True, kw_only=True)
class Mean(Sampled):
    """A weighted mean of the last two measurements, with an offset that begins at a sample."""

    inputs, outputs = ("state",), ("estimated_state",)
    offset: np.ndarray
    begin: int

    @classmethod
    def from_setup(cls, setup):
        size = 2 * len(setup.coordinates.names) + 1
        return cls(offset=1e-7 * np.arange(size), begin=10)

    def start(self, state=None):
        return {"before": np.zeros(self.offset.size) if state is None else state}

    def phase(self, sample):
        return [sample >= self.begin]

    def step(self, inputs, memory, now):
        shown = 0.98 * inputs["state"] + 0.02 * memory["before"] + now.phase[0] * self.offset
        return {"estimated_state": shown}, {"before": inputs["state"]}
