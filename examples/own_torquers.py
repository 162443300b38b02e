"""Magnetorquers beside wheels: they take the wheels' momentum out against the Earth's field.

    ffsm run thrusters_and_wheels --set blocks.forces.coils=own_torquers:Magnetorquers

Their torque is an external one; the controller counters it with the wheels, which so lose momentum.
"""

import dataclasses

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.systems.framework import LeafSystem

import ffsm_drake
from ffsm_drake import Metric, Part, Signal, setting


@dataclasses.dataclass(frozen=True, kw_only=True)
class Magnetorquers(Part):
    """Three coils along the base's axes."""

    largest_dipole: float = setting(400.0, "A m^2", "of each coil, either way", above=0)
    gain: float = setting(0.05, "1/s", "wanted torque per momentum of the wheels", above=0)
    field: list[float] = setting([0.0, 2e-5, 2e-5], "T", "B, in the world", size=3, nonzero=True)

    def build(self, setup):
        return Coils(self, len(setup.coordinates.names), setup.sample_time)

    def signals(self, setup):
        more = {"components": setup.coordinates.names, "dimension": "coordinate"}
        more |= {"meaning": "generalized force of the coils", "role": "held_force"}
        return (Signal(name="coil_force", unit="N m, N", **more),)

    def metrics(self):
        def impulse(run):
            torque = run["coil_force"][:-1, :3].sum(axis=0)
            return run.scenario.sample_time * float(np.linalg.norm(torque))

        key, label = "magnetorquers.impulse", "Angular impulse of the coils"
        return (Metric(key=key, unit="N m s", label=label, of=impulse),)


class Coils(LeafSystem):
    """A dipole m that gives torque m x B against the momentum, once a control sample."""

    def __init__(self, part, nv, period):
        super().__init__()
        self.part = part
        self.state = self.DeclareVectorInputPort("state", 2 * nv + 1)
        self.stored = self.DeclareVectorInputPort("stored_momentum", 3)
        group = self.DeclareDiscreteState(nv)
        for name in ("generalized_force", "coil_force"):
            self.DeclareStateOutputPort(name, group)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self.update)

    def update(self, context, values):
        if not self.stored.HasValue(context):  # a spacecraft without wheels
            return
        field, momentum = np.array(self.part.field), self.stored.Eval(context)
        rotation = RotationMatrix(Quaternion(self.state.Eval(context)[:4])).matrix()
        dipole = rotation.T @ np.cross(self.part.gain * momentum, field) / field.dot(field)
        dipole = rotation @ np.clip(dipole, -self.part.largest_dipole, self.part.largest_dipole)
        force = np.zeros(values.value().size)
        force[:3] = np.cross(dipole, field)
        values.set_value(force)


if __name__ == "__main__":
    scenario = ffsm_drake.load_scenario("thrusters_and_wheels", ["controller=tdc"])
    record = ffsm_drake.simulate(scenario, blocks={"forces.coils": Magnetorquers()})
    ffsm_drake.write_outputs([record], "out/own_torquers")
