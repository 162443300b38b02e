"""Fixed steps of an explicit integrator that make a flexible mode grow, whatever the controller."""

import math

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.plugins.flexible.bodies import VibrationMode
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import configuration

# Coefficients of the factor R(z) by which a step h changes a solution exp(s t), with z = s h
# (E. Hairer and G. Wanner, Solving Ordinary Differential Equations II, section IV.2).
_FACTORS = {
    "explicit_euler": (1.0, 1.0),
    "runge_kutta2": (1.0, 1.0, 1 / 2),
    "runge_kutta3": (1.0, 1.0, 1 / 2, 1 / 6),
    "runge_kutta5": (1.0, 1.0, 1 / 2, 1 / 6, 1 / 24, 1 / 120, 1 / 600),
}
_GROWTH = math.log(10.0)  # 1/s; of the amplitude, above which a step is refused
_TURN = 0.75  # rad of a mode in a step that is recommended


def check_steps(scenario: Scenario, model: PlantModel) -> None:
    """Raise ScenarioError if the integrator makes a mode grow more than tenfold in a second."""
    config = scenario.simulator_config
    factor = _FACTORS.get(config.integration_scheme)
    if config.use_error_control or factor is None:
        return
    step, modes = min(config.max_step_size, scenario.sample_time), list[VibrationMode]()
    for name, posture in scenario.postures.items():
        q = configuration(model.coordinates, posture, key=name)
        modes += model.modes(q)
    fastest = max(modes, key=lambda mode: mode.frequency)
    w = 2.0 * math.pi * fastest.frequency
    if math.log(_growth(factor, fastest, step)) / step > _GROWTH:
        raise ScenarioError(
            "simulator_config.max_step_size",
            f"with steps of {step:g} s the integrator is unstable for the flexible mode at "
            f"{fastest.frequency:.3g} Hz, whatever the controller; set at most "
            f"{float(f'{_TURN / w:.1g}'):g}",
        )


def _growth(factor: tuple[float, ...], mode: VibrationMode, step: float) -> float:
    """The factor by which a step (s) changes the amplitude of a mode."""
    w, damping = 2.0 * math.pi * mode.frequency, min(mode.damping_ratio, 1.0)
    z = w * step * complex(-damping, math.sqrt(1.0 - damping**2))
    return abs(sum(each * z**power for power, each in enumerate(factor)))
