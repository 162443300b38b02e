"""A reference of one's own: the joints swing, the base stays where it is. From the shell, in the
folder of this file:

ffsm run -c tdc --set blocks.reference=own_reference:Swing
"""

import numpy as np
from pydrake.systems.framework import LeafSystem

import ffsm_drake
from ffsm_drake.show.tables import results_table
from ffsm_drake.systems.reference import make_motion


class Swing(LeafSystem):
    """Settings: `angle` (rad), half of the swing of every joint, and `omega` (rad/s)."""

    def __init__(self, setup):
        super().__init__()
        self.nv = len(setup.coordinates.names)
        self.start = make_motion(setup.mission).evaluate(0.0)[0]
        self.angle = setup.settings.get("angle", 0.1)
        self.omega = setup.settings.get("omega", 0.5)
        self.DeclareVectorOutputPort("desired_state", 2 * self.nv + 1, self.calc_state)
        self.DeclareVectorOutputPort("desired_acceleration", self.nv, self.calc_acceleration)

    def calc_state(self, context, output):
        phase = self.omega * context.get_time()
        q, v = self.start.copy(), np.zeros(self.nv)
        q[7:] += self.angle * (1 - np.cos(phase))
        v[6:] = self.angle * self.omega * np.sin(phase)
        output.SetFromVector(np.concatenate([q, v]))

    def calc_acceleration(self, context, output):
        a = np.zeros(self.nv)
        a[6:] = self.angle * self.omega**2 * np.cos(self.omega * context.get_time())
        output.SetFromVector(a)


if __name__ == "__main__":
    scenario = ffsm_drake.load_scenario("postcapture", ["duration=5", "controller=tdc"])
    record = ffsm_drake.simulate(scenario, blocks={"reference": Swing})
    print(results_table([record]))
    ffsm_drake.write_outputs([record], "out/own_reference", figures=False)
