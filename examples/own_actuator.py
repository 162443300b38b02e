"""An actuator of your own, with all the rights of a shipped one: magnetorquers.

Three coils along the base's axes make a dipole m; in a magnetic field B it feels the torque m x B.
Of the base's commanded torque they give what they can, and the rest is left to ideal actuators.
One file holds everything: settings with their checks, physics, the signals of the record, figures
of merit, and what the stability analysis puts in its place. In a scenario:

    blocks: {actuation: {system: "own_actuator:Magnetorquers", settings: {largest_dipole: 80}}}
"""

import dataclasses
import math

import numpy as np
from pydrake.systems.framework import LeafSystem

import ffsm_drake
from ffsm_drake import Metric, Part, Signal, setting
from ffsm_drake.show.tables import results_table


@dataclasses.dataclass(frozen=True, kw_only=True)
class Magnetorquers(Part):
    """Three coils in a constant field."""

    largest_dipole: float = setting(50.0, "A m^2", "of each coil, either way", above=0)
    field: list[float] = setting([0.0, 2e-5, 1e-5], "T", "in the world", size=3, nonzero=True)
    resistance: float = setting(2e-3, "W/(A m^2)^2", "power of a coil's dipole", least=0)

    def build(self, setup):
        return Coils(self, len(setup.coordinates.names), setup.sample_time)

    def signals(self, setup):
        axes = {"components": ("x", "y", "z"), "dimension": "axis"}
        return (
            Signal(name="dipole", unit="A m^2", meaning="dipole of the coils, base's axes", **axes),
            Signal(name="magnetic_torque", unit="N m", meaning="m x B, in the world", **axes),
        )

    def metrics(self):
        return (
            Metric(
                key="magnetorquers.largest_dipole",
                unit="A m^2",
                label="Largest dipole",
                of=lambda run: np.abs(run["dipole"]).max(),
            ),
            Metric(
                key="magnetorquers.energy",
                unit="J",
                label="Energy of the coils",
                of=lambda run: (
                    self.resistance * (run["dipole"][:-1] ** 2).sum() * run.scenario.sample_time
                ),
            ),
        )

    def linear(self):
        return dataclasses.replace(self, largest_dipole=math.inf)  # a limit has no derivative


class Coils(LeafSystem):
    """From ``commanded_force`` to ``applied_force``; the base's attitude is that of the sample."""

    def __init__(self, settings, nv, sample_time):
        super().__init__()
        self._settings, self._nv = settings, nv
        commanded = self.DeclareVectorInputPort("commanded_force", nv)
        self.DeclareVectorInputPort("state", 2 * nv + 1)
        self.DeclareDiscreteState(np.r_[1.0, np.zeros(3)])  # quaternion of the base
        ready = {self.input_port_ticket(commanded.get_index()), self.xd_ticket()}
        for name, part in (("applied_force", 0), ("dipole", 1), ("magnetic_torque", 2)):
            size = 3 if part else nv
            self.DeclareVectorOutputPort(name, size, self._output(part), ready)
        self.DeclarePeriodicDiscreteUpdateEvent(sample_time, 0.0, self._sample)

    def _sample(self, context, values):
        values.set_value(self.get_input_port(1).Eval(context)[:4])

    def _output(self, part):
        return lambda context, output: output.SetFromVector(self._give(context)[part])

    def _give(self, context):
        force = self.get_input_port(0).Eval(context)
        w, x, y, z = context.get_discrete_state_vector().value()
        u = np.array([x, y, z])
        field = np.array(self._settings.field)
        wanted = force[:3]
        dipole = np.cross(field, wanted) / field.dot(field)  # the least that gives wanted x B x B
        in_base = dipole - 2.0 * w * np.cross(u, dipole) + 2.0 * np.cross(u, np.cross(u, dipole))
        limit = self._settings.largest_dipole
        kept = min(1.0, limit / max(np.abs(in_base).max(), 1e-300))
        torque = np.cross(kept * dipole, field)
        return np.r_[force], kept * in_base, torque


def main():
    block = '{system: "own_actuator:Magnetorquers", settings: {largest_dipole: 80}}'
    overrides = ["controller=tdc", "duration=5", f"blocks.actuation={block}"]
    record = ffsm_drake.simulate(ffsm_drake.load_scenario("flight_sensors", overrides))
    print(results_table([record]))
    ffsm_drake.write_outputs([record], "out/own_actuator")


if __name__ == "__main__":
    main()
