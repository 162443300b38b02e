"""Mean output of thrusters over their control frame, which replaces pulses in a linearised loop.

Over a frame they give the mean wrench wanted at its start, and in the next frame the remaining
impulse. Wheels counter the torque of pulses and give the commanded torque immediately. Limits are
omitted.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.systems.framework import System
from pydrake.systems.primitives import PassThrough

from ffsm_drake.plugins.actuators.row import Actuators, make_actuation
from ffsm_drake.systems.sampled import Arrays, Now, Sampled, SampledSystem
from ffsm_drake.systems.setup import BlockSetup


@dataclasses.dataclass(frozen=True, kw_only=True)
class MeanThrusters(Sampled):
    """The base's wrench, with some entries held over a control frame.

    Input: ``commanded_force`` (nv). Output: ``applied_force`` (nv). Memory: the held wrench and the
    owed impulse (6 each). Phase: samples since a frame began.
    """

    num_velocities: int
    sample_time: float  # s
    frame: int  # its control samples
    is_held: np.ndarray  # (6) entries of the wrench that are held over a frame
    is_owed: np.ndarray  # (6) and whose missing impulse is given in the next frame
    acts = True

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return {"commanded_force": self.num_velocities}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return {"applied_force": self.num_velocities}

    @property
    def phase_period(self) -> int:
        """See Sampled."""
        return self.frame

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled."""
        return {"held": np.zeros(6), "owed": np.zeros(6)}

    def phase(self, sample: Any) -> Sequence[Any]:
        """See Sampled."""
        return [sample % self.frame]

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        commanded, rest = np.split(inputs["commanded_force"], [6])
        given = commanded + memory["owed"] / (self.frame * self.sample_time)
        if now.phase[0]:
            given = np.where(self.is_held, memory["held"], given)
        owed = self.is_owed * (memory["owed"] + (commanded - given) * self.sample_time)
        return {"applied_force": np.concatenate([given, rest])}, {"held": given, "owed": owed}


def make_mean_actuation(setup: BlockSetup) -> Actuators | None:
    """The scenario's actuators with the mean of their pulses; without thrusters the base's wrench
    acts as commanded.
    """
    settings, coordinates, period = setup.scenario.actuation, setup.coordinates, setup.sample_time
    base: System = PassThrough(len(coordinates.names))
    if (thrusters := settings.thrusters) is not None:
        is_held = np.repeat([settings.wheels is None, True], 3)
        mean = MeanThrusters(
            num_velocities=len(coordinates.names),
            sample_time=period,
            frame=thrusters.frame,
            is_held=is_held,
            is_owed=is_held & (thrusters.modulator != "pwpf"),
        )
        base = SampledSystem(mean, name="base", sample_time=period)
    return make_actuation(settings, coordinates, sample_time=period, base=base)
