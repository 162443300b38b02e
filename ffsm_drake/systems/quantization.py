"""Rounding to multiples of a resolution."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from ffsm_drake.common.lifetime import weak_callback


def quantize(values: np.ndarray, resolution: np.ndarray) -> np.ndarray:
    """Round to the nearest multiple of each entry's resolution; entries with resolution 0 pass
    unchanged.
    """
    steps = np.where(resolution > 0.0, resolution, 1.0)
    return np.where(resolution > 0.0, np.round(values / steps) * steps, values)


class Quantizer(LeafSystem):
    """Rounds its input ``u`` to multiples of a resolution, output ``y``; see quantize."""

    def __init__(self, resolution: np.ndarray) -> None:
        super().__init__()
        self._resolution = resolution
        self._input = self.DeclareVectorInputPort("u", resolution.size)
        # Depends on its input alone: while that is held, the integrator's stages read the cached
        # value.
        self.DeclareVectorOutputPort(
            "y",
            resolution.size,
            weak_callback(self._calc),
            {self.input_port_ticket(self._input.get_index())},
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(quantize(self._input.Eval(context), self._resolution))
