"""A user's stage of sensing, and a force, as pure functions."""

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


@dataclass(frozen=True, kw_only=True)
class Pull(Sampled):
    """A force towards where the spacecraft was, which grows with time."""

    inputs, outputs = ("state",), ("generalized_force",)
    stiffness: np.ndarray

    @classmethod
    def from_setup(cls, setup):
        return cls(stiffness=np.linspace(0.1, 0.5, len(setup.coordinates.names) - 3))

    def start(self, state=None):
        return {"before": np.zeros(self.stiffness.size) if state is None else state[4 : self.end]}

    @property
    def end(self):
        return 4 + self.stiffness.size

    def step(self, inputs, memory, now):
        moved = inputs["state"][4 : self.end] - memory["before"]
        force = np.concatenate([[0.0, 0.0, 1e-3 * now.time], -self.stiffness * moved])
        return {"generalized_force": force}, {"before": inputs["state"][4 : self.end]}
