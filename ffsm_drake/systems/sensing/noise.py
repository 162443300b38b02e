"""Sources of the sensors' noise: of a seed, the samples that Drake's sources give."""

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import System
from pydrake.systems.primitives import LinearSystem, RandomSource

from ffsm_drake.systems.sensing.errors import SensorErrors
from ffsm_drake.systems.setup import CompositeBlock


class Noise(CompositeBlock):
    """Gaussian noise, output ``noise``: a shaping system gets independent samples of deviation 1,
    one for each control period and input.
    """

    def __init__(self, name: str, shaped_by: System, *, sample_time: float) -> None:
        size = shaped_by.get_input_port().size()
        samples = RandomSource(RandomDistribution.kGaussian, size, sample_time)
        signals = {"shaped": {"u0": "samples", "y0": "noise"}, "samples": {"output": "samples"}}
        super().__init__(
            name,
            {"shaped": shaped_by, "samples": samples},
            inputs=(),
            outputs=("noise",),
            signals=signals,
        )


def drift(errors: SensorErrors) -> LinearSystem:
    """First-order Gauss-Markov processes, stationary from the start, from independent samples."""
    drift = errors.drift()
    shown = np.eye(drift.kept.size)
    system = LinearSystem(
        A=np.diag(drift.kept),
        B=np.diag(drift.added),
        C=shown,
        D=np.zeros_like(shown),
        time_period=errors.sample_time,
    )
    system.configure_random_state(np.diag(drift.start**2))
    return system
