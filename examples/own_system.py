"""A controller of one's own that is a Drake system with discrete state. From the shell, in the
folder of this file:

ffsm run -c own_system:Damper --set controllers.Damper.k_d.all=200
"""

from pydrake.systems.framework import LeafSystem

import ffsm_drake
from ffsm_drake.show.tables import results_table
from ffsm_drake.testing import check_controller


class Damper(LeafSystem):
    """tau = K_d (v_d - v), sampled and held. Setting: `k_d`, by coordinate."""

    def __init__(self, setup):
        super().__init__()
        nv = len(setup.coordinates.names)
        self.gain = setup.coordinates.vector(setup.settings.get("k_d", {"all": 100}), key="k_d")
        self.state = self.DeclareVectorInputPort("estimated_state", 2 * nv + 1)
        self.desired = self.DeclareVectorInputPort("desired_state", 2 * nv + 1)
        self.DeclareVectorInputPort("desired_acceleration", nv)
        self.DeclareStateOutputPort("generalized_force", self.DeclareDiscreteState(nv))
        self.DeclarePeriodicDiscreteUpdateEvent(setup.sample_time, 0.0, self.update)

    def update(self, context, values):
        error = self.desired.Eval(context) - self.state.Eval(context)
        values.set_value(self.gain * error[-self.gain.size :])


if __name__ == "__main__":
    print(check_controller(Damper))
    scenario = ffsm_drake.load_scenario("postcapture", ["duration=5"])
    record = ffsm_drake.simulate(scenario, blocks={"controller": Damper})
    print(results_table([record]))
    ffsm_drake.write_outputs([record], "out/own_system", figures=False)
