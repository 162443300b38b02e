"""Torque of the momentum of wheels on a base that turns."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from ffsm_drake.plugins.actuators.attitude import attitude_ahead
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.sampled import Arrays


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gyroscopic(Continuous):
    """The wheels' total momentum p in world axes as continuous state, and its torque on a turning
    base.

    Inputs: ``state`` [q; v] of the plant, and ``wheel_reaction`` (3), the torque of the wheels on
    the base in world axes without the gyroscopic torque, held over a sample:
    dp/dt = w x p - reaction. Outputs: ``gyroscopic_force`` (nv), -w x p on the base, and
    ``stored_momentum`` p (3). The base gets the opposite of dp/dt in every stage of the integrator,
    so the sum of both momenta is conserved to rounding.
    """

    momentum: np.ndarray  # (3) at the start, in the base's axes, N m s
    num_velocities: int

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Continuous."""
        return {"state": 2 * self.num_velocities + 1, "wheel_reaction": 3}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Continuous."""
        return {"gyroscopic_force": self.num_velocities, "stored_momentum": 3}

    @property
    def entries(self) -> Mapping[str, Sequence[int]]:
        """See Continuous: w_WB."""
        first = self.num_velocities + 1
        return {"state": [first, first + 1, first + 2]}

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Continuous."""
        if state is None:
            return {"stored_momentum": self.momentum}
        rotation = attitude_ahead(state[:4], np.zeros(3), 0.0).reshape(3, 3)
        return {"stored_momentum": rotation.dot(self.momentum)}

    def flow(self, inputs: Arrays, state: Arrays) -> tuple[Arrays, Arrays]:
        """See Continuous."""
        w, p = inputs["state"], state["stored_momentum"]
        turning = w[[1, 2, 0]] * p[[2, 0, 1]] - w[[2, 0, 1]] * p[[1, 2, 0]]
        force = np.concatenate([-turning, np.zeros(self.num_velocities - 3)])
        return (
            {"gyroscopic_force": force, "stored_momentum": p},
            {"stored_momentum": turning - inputs["wheel_reaction"]},
        )
