"""A link that bends, and modes that the integrator's steps do not resolve."""

import os
from pathlib import Path

import numpy as np
import pytest
from c_code import needs_llvm
from entry_points import needs

from ffsm_drake import load_scenario, simulate
from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.plugins.flexible.steps import check_steps
from ffsm_drake.spacecraft.craft import Craft
from ffsm_drake.spacecraft.plant import configuration

HERE = Path(__file__).parent
# the middle of a link of 0.62 m with EI = 5.2e4 N m^2 (a tube of aluminium, 100 mm by 2 mm): a
# hinge there has the stiffness 2 EI / length
BENDS = {
    "model": {
        "directives": None,
        "servicer": str(HERE / "flexible_link.urdf"),
        "flexible": {
            "bend": {"kind": "joint", "joint": "bend", "stiffness": 1.7e5, "damping_ratio": 0.005}
        },
    }
}


def bending(*given):
    return load_scenario("postcapture", [BENDS, *given])


@pytest.mark.smoke
def test_steps_that_are_unstable_for_a_mode_are_refused():
    """Its mode at 238 Hz turns by 15 rad in a step of 10 ms."""
    with pytest.raises(ScenarioError) as error:
        simulate(bending("controller=pd_plus"), check_stability=False, engine="drake")
    assert str(error.value) == (
        "simulator_config.max_step_size: with steps of 0.01 s the integrator is unstable for the "
        "flexible mode at 238 Hz, whatever the controller; set at most 0.0005"
    )


@pytest.mark.parametrize("seed", range(int(os.environ.get("STEP_DRAWS", "8"))))
def test_steps_are_refused_beyond_the_limit_of_the_scheme(seed):
    """Of drawn stiffness without damping, on both sides of w h = sqrt(3), the limit of the third
    order on the imaginary axis.
    """
    draw = np.random.default_rng(seed)
    stiffness = 10.0 ** draw.uniform(3.5, 6.0)
    given = f"model.flexible.bend={{stiffness: {stiffness}, damping_ratio: 0}}"
    craft = Craft(bending(given))
    frequencies = [
        craft.flexible().modes(configuration(craft.coordinates, each, key=""))[-1].frequency
        for each in bending(given).postures.values()
    ]
    limit = np.sqrt(3.0) / (2.0 * np.pi * max(frequencies))

    def checked(step):
        step = f"simulator_config.max_step_size={step}"
        check_steps(bending(given, "sample_time=0.1", step), craft.flexible())

    checked(draw.uniform(0.3, 0.99) * limit)
    with pytest.raises(ScenarioError, match="the integrator is unstable for the flexible mode"):
        checked(draw.uniform(1.05, 3.0) * limit)


@needs("compiled")
@needs_llvm
@pytest.mark.long
@pytest.mark.parametrize("law", ["pd_plus", "computed_torque"])
def test_a_mission_with_a_link_that_bends_follows_that_of_a_rigid_link(law):
    """With a target of 100 kg, over the whole mission, with steps that resolve the mode."""
    given = [f"controller={law}", "simulator_config.max_step_size=5e-4"]
    bent = simulate(bending(*given), check_stability=False, engine="compiled")
    rigid = simulate(load_scenario("postcapture", given), check_stability=False, engine="compiled")
    assert bent.outcome.status == rigid.outcome.status == "completed"
    apart = np.abs(bent.dataset["position"].values - rigid.dataset["position"].values).max()
    deflection = bent.metrics["hidden"]["peak"]["bend"]
    print(law, apart, deflection)
    assert 1e-7 < deflection < 1e-4
    assert apart < 1e-3
