"""Mean output of thrusters over their control frame, which replaces pulses in a linearised loop.

Over a frame they give the mean wrench wanted at its start, and in the next frame the remaining
impulse. Wheels counter the torque of pulses and give the commanded torque immediately. Limits are
omitted.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.systems.primitives import PassThrough

from ffsm_drake.plugins.actuators.row import Actuators, acting, make_actuation
from ffsm_drake.scenario import Actuation, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.sampled import Arrays, Now, Sampled
from ffsm_drake.systems.setup import BlockSetup


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class MeanThrusters(Sampled):
    """The base's wrench, with some entries held over a control frame.

    Input: ``commanded_force`` (nv). Output: ``applied_force`` (nv). Memory: the held wrench (6),
    and the owed impulse (6). Phase: whether a frame begins (1).
    """

    held: np.ndarray  # (6) whether an entry is held over a frame
    owes: np.ndarray  # (6) whether the remaining impulse of an entry is given in the next frame
    num_velocities: int
    frame: int  # control samples
    sample_time: float
    acts = True

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return {"commanded_force": self.num_velocities}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return {"applied_force": self.num_velocities}

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled."""
        return {"wrench": np.zeros(6), "owed": np.zeros(6)}

    def phase(self, sample: Any) -> Sequence[Any]:
        """See Sampled."""
        return [(sample % self.frame == 0) * 1.0]

    @property
    def phase_period(self) -> int:
        """See Sampled."""
        return self.frame

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        applied, owed = inputs["commanded_force"].copy(), memory["owed"]
        commanded = inputs["commanded_force"][:6]
        given = commanded + owed / (self.frame * self.sample_time)
        later = np.where(self.held, memory["wrench"], given)
        applied[:6] = given = np.where(now.phase[0] > 0.5, given, later)
        left = owed + (commanded - given) * self.sample_time
        return {"applied_force": applied}, {"wrench": given, "owed": self.owes * left}


def _mean(scenario: Scenario, coordinates: Coordinates) -> tuple[Actuation, MeanThrusters | None]:
    """The actuators without thrusters and wheels, and what acts in place of them."""
    settings, base = scenario.actuation, None
    if settings.thrusters is not None:
        held = np.repeat([settings.wheels is None, True], 3)
        base = MeanThrusters(
            held=held,
            owes=held & (settings.thrusters.modulator != "pwpf"),
            num_velocities=len(coordinates.names),
            frame=settings.thrusters.frame,
            sample_time=scenario.sample_time,
        )
    return dataclasses.replace(settings, thrusters=None, wheels=None), base


def make_mean_actuation(setup: BlockSetup) -> Actuators:
    """Return the scenario's actuators with the mean of their pulses; without thrusters the base's
    wrench acts as commanded.
    """
    settings, base = _mean(setup.scenario, setup.coordinates)
    of, period = setup.coordinates, setup.sample_time
    found = make_actuation(settings, of, sample_time=period, base=base)
    return found or Actuators({"as_commanded": PassThrough(len(of.names))}, {})


def mean_blocks(
    scenario: Scenario, coordinates: Coordinates
) -> tuple[list[Sampled], list[Continuous]]:
    """Return the blocks of ``make_mean_actuation`` in a row after saturation, quantisation and
    delay, and those beside them.
    """
    settings, base = _mean(scenario, coordinates)
    row, beside = acting(settings, coordinates, scenario.sample_time, base=base)
    return [*row.values()], [*beside.values()]
