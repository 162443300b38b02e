"""Forces in multiples of a resolution."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.quantization import quantize
from ffsm_drake.systems.sampled import Arrays


@dataclasses.dataclass(frozen=True, kw_only=True)
class Quantizer(Continuous):
    """Rounds its input ``u`` to multiples of a resolution, output ``y``; see quantize."""

    resolution: np.ndarray

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Continuous."""
        return {"u": self.resolution.size}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Continuous."""
        return {"y": self.resolution.size}

    def flow(self, inputs: Arrays, state: Arrays) -> tuple[Arrays, Arrays]:
        """See Continuous."""
        return {"y": quantize(inputs["u"], self.resolution)}, {}
