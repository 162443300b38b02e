"""A sensor of one's own, behind the scenario's: joint encoders that are mounted off centre. From
the shell, in the folder of this file:

ffsm run flight_sensors --set blocks.sensing.encoders=own_sensor:Encoders
"""

import dataclasses

import numpy as np
from pydrake.systems.framework import LeafSystem

import ffsm_drake
from ffsm_drake import Part, setting
from ffsm_drake.show.tables import results_table


@dataclasses.dataclass(frozen=True, kw_only=True)
class Encoders(Part):
    """A joint at angle a reads a + error sin(a): once a turn, because the disk is off its axis."""

    error: float = setting(2e-4, "rad", "largest error of a joint's angle", least=0)

    def build(self, setup):
        return OffCentre(len(setup.coordinates.names), self.error)


class OffCentre(LeafSystem):
    """Takes and gives [q; v]: the base's quaternion and position, the joints, and their rates."""

    def __init__(self, nv, error):
        super().__init__()
        self.error = error
        self.angles, self.rates = slice(7, nv + 1), slice(nv + 7, 2 * nv + 1)
        self.state = self.DeclareVectorInputPort("state", 2 * nv + 1)
        self.DeclareVectorOutputPort("estimated_state", 2 * nv + 1, self.read)

    def read(self, context, output):
        state = np.array(self.state.Eval(context))
        angles = state[self.angles]
        state[self.rates] *= 1.0 + self.error * np.cos(angles)
        state[self.angles] += self.error * np.sin(angles)
        output.SetFromVector(state)


if __name__ == "__main__":
    scenario = ffsm_drake.load_scenario("flight_sensors", ["duration=5"])
    encoders = {"sensing.encoders": Encoders(error=2e-4)}
    records = [ffsm_drake.simulate(scenario, blocks=blocks) for blocks in ({}, encoders)]
    print(results_table(records))
    ffsm_drake.write_outputs(records, "out/own_sensor", figures=False)
