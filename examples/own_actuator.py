"""An actuator of one's own: ffsm run --set blocks.actuation=own_actuator:Magnetorquers"""

import dataclasses

import numpy as np
from pydrake.systems.framework import LeafSystem

import ffsm_drake
from ffsm_drake import Metric, Part, Signal, setting


@dataclasses.dataclass(frozen=True, kw_only=True)
class Magnetorquers(Part):
    """Three coils: their dipole m gives what it can of the base's torque; the rest stays ideal."""

    largest_dipole: float = setting(50.0, "A m^2", "of each coil, either way", above=0)
    field: list[float] = setting([0.0, 2e-5, 1e-5], "T", "B, in the world", size=3, nonzero=True)

    def build(self, setup):
        return Coils(self, len(setup.coordinates.names))

    def signals(self, setup):
        axes = {"components": ("x", "y", "z"), "dimension": "axis"}
        torque = {"unit": "N m", "of": lambda run: np.cross(run["dipole"], self.field)}
        return (
            Signal(name="dipole", unit="A m^2", meaning="m, in the world", **axes),
            Signal(name="magnetic_torque", meaning="m x B, in the world", **torque, **axes),
        )

    def metrics(self):
        key, of = "magnetorquers.largest_dipole", lambda run: np.abs(run["dipole"]).max()
        return (Metric(key=key, unit="A m^2", label="Largest dipole", of=of),)

    def linear(self):
        return dataclasses.replace(self, largest_dipole=np.inf)  # a limit has no derivative


class Coils(LeafSystem):
    def __init__(self, part, nv):
        super().__init__()
        self.part, self.command = part, self.DeclareVectorInputPort("commanded_force", nv)
        self.DeclareVectorOutputPort("applied_force", nv, self.force)
        self.DeclareVectorOutputPort("dipole", 3, self.dipole)

    def force(self, context, output):
        output.SetFromVector(self.command.Eval(context))

    def dipole(self, context, output):
        field, most = np.array(self.part.field), self.part.largest_dipole
        least = np.cross(field, self.command.Eval(context)[:3]) / field.dot(field)
        output.SetFromVector(np.clip(least, -most, most))


if __name__ == "__main__":
    scenario = ffsm_drake.load_scenario("flight_sensors", ["controller=tdc", "duration=5"])
    record = ffsm_drake.simulate(scenario, blocks={"actuation": Magnetorquers(largest_dipole=80)})
    ffsm_drake.write_outputs([record], "out/own_actuator")
