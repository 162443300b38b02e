"""Coils beside wheels: ffsm run thrusters_and_wheels --set blocks.forces.coils=own_torquers:Coils

The controller counters their external torque with the wheels, which so lose momentum.
"""

import dataclasses

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.systems.framework import LeafSystem

import ffsm_drake
from ffsm_drake import Part, Signal, setting


@dataclasses.dataclass(frozen=True, kw_only=True)
class Coils(Part):
    """Three magnetorquers along the base's axes."""

    largest_dipole: float = setting(400.0, "A m^2", "of each coil, either way", above=0)
    gain: float = setting(0.05, "1/s", "wanted torque per momentum of the wheels", above=0)
    field: list[float] = setting([0.0, 2e-5, 2e-5], "T", "B, in the world", size=3, nonzero=True)

    def build(self, setup):
        return Torque(self, len(setup.coordinates.names), setup.sample_time)

    def signals(self, setup):
        more = {"components": setup.coordinates.names, "dimension": "coordinate"}
        more |= {"meaning": "generalized force of the coils", "role": "held_force"}
        return (Signal(name="coil_force", unit="N m, N", **more),)


class Torque(LeafSystem):
    """The dipole m gives torque m x B against the momentum, once a control sample."""

    def __init__(self, part, nv, period):
        super().__init__()
        self.part, self.stored = part, self.DeclareVectorInputPort("stored_momentum", 3)
        self.state = self.DeclareVectorInputPort("state", 2 * nv + 1)
        for name in ("generalized_force", "coil_force"):
            self.DeclareStateOutputPort(name, self.DeclareDiscreteState(nv))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self.update)

    def update(self, context, values):
        field, most = np.array(self.part.field), self.part.largest_dipole
        rotation = RotationMatrix(Quaternion(self.state.Eval(context)[:4])).matrix()
        wanted = self.part.gain * np.cross(self.stored.Eval(context), field) / field.dot(field)
        torque = np.cross(rotation @ np.clip(rotation.T @ wanted, -most, most), field)
        for group in range(2):
            values.get_mutable_vector(group).get_mutable_value()[:3] = torque


if __name__ == "__main__":
    scenario = ffsm_drake.load_scenario("thrusters_and_wheels", ["controller=tdc", "duration=10"])
    record = ffsm_drake.simulate(scenario, blocks={"forces.coils": Coils()})
    ffsm_drake.write_outputs([record], "out/own_torquers")
