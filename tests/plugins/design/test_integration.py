"""What the integrator's steps resolve, said before a run, and what they broke, said after it."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Integrator, Sine

from ffsm_drake import load_scenario, override_scenario, simulate
from ffsm_drake.plugins.design.remarks import plan_remarks
from ffsm_drake.runs.exceeded_limits import run_remarks

STEP = 0.01
SCENARIO = load_scenario("postcapture", ["duration=1"])


def remarks_on_harmonic(frequency):
    harmonics = (
        f"disturbance.harmonics={{base_position_x: {{amplitude: 1, frequency: {frequency}}}}}"
    )
    found = plan_remarks(override_scenario(SCENARIO, [harmonics]))
    return [each for each in found if each.startswith("disturbance.")]


def integrated(frequency, *, scheme="runge_kutta3", steps=200):
    """The mean of a sine over some steps, as the integrator has it, minus the exact one."""
    builder = DiagramBuilder()
    sine = builder.AddSystem(Sine(1.0, frequency, 0.3, 1))
    total = builder.AddSystem(Integrator(1))
    builder.Connect(sine.get_output_port(0), total.get_input_port())
    simulator = Simulator(builder.Build())
    config = SimulatorConfig(integration_scheme=scheme, max_step_size=STEP, use_error_control=False)
    ApplySimulatorConfig(config, simulator)
    end = steps * STEP
    simulator.AdvanceTo(end)
    exact = (np.cos(0.3) - np.cos(frequency * end + 0.3)) / frequency
    found = simulator.get_context().get_continuous_state_vector().CopyToVector()[0]
    return (found - exact) / end


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(frequency=st.floats(0.1, 1000.0))
def test_a_harmonic_that_is_not_integrated_is_named(frequency):
    if not remarks_on_harmonic(frequency):
        assert abs(integrated(frequency)) < 1e-4  # of its amplitude


def test_a_period_of_one_step_is_a_constant_force():
    frequency = 2.0 * np.pi / STEP
    assert abs(integrated(frequency)) > 0.05
    (remark,) = remarks_on_harmonic(frequency)
    assert "set simulator_config.max_step_size to 0.0008 or less" in remark
    assert not remarks_on_harmonic(2.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ([], ()),
        (
            [
                "simulator_config.integration_scheme=explicit_euler",
                "initial_velocity={base_rotation_x: 5}",
            ],
            ("norm of the base quaternion differs", "it changes the angular momentum by"),
        ),
    ],
)
def test_broken_balances_are_named_after_the_run(overrides, words):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scenario = load_scenario("free_floating", ["controller=tdc", "duration=5", *overrides])
        remarks = run_remarks(simulate(scenario, check_stability=False))
    for word in words:
        assert any(word in each for each in remarks), remarks
    if not words:
        assert not any("integrator" in each for each in remarks)
