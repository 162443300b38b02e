"""Figures of a law on a mission without a simulation: margins, distance to the LQG front,
processor time. They are computed in the workers and do not depend on the seed.
"""

import contextlib
import functools
import math
import statistics
import time
from collections.abc import Callable

from pydrake.systems.analysis import ApplySimulatorConfig, Simulator

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.time_limit import TimeLimit, time_limit
from ffsm_drake.loop.closed_loop import make_closed_loop
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.campaign.prediction import expected_radius, most_overestimated
from ffsm_drake.plugins.design.limit import find_limit
from ffsm_drake.plugins.design.stability.boundaries import (
    LARGEST_DELAY,
    LARGEST_FACTOR,
    largest_stable,
)
from ffsm_drake.plugins.design.stability.planned_dynamics import PlannedDynamics, from_grasp
from ffsm_drake.scenario import Grip, Scenario, scenario_from_yaml
from ffsm_drake.systems.reference import timed

RADIUS, PAYLOAD, DELAY = "spectral_radius", "payload_factor", "delay_margin"
ERROR, TIME = "error_over_lqg", "law_time"
FIGURES = (RADIUS, PAYLOAD, DELAY, ERROR, TIME)
_SAMPLES = 100  # whose processor time is taken
_LONGEST = 120.0  # s, for one figure


def law_figures(scenario: str) -> dict[str, float | None]:
    """The figures of a scenario's law, by name; None: there is none; NaN: cut, it takes longer than
    two minutes. Takes a scenario as YAML.

    For the linear loop as wired, in the posture nearest to instability: ``spectral_radius`` at the
    gains expected after adaptation; at the starting gains ``payload_factor`` (tolerated further
    over-estimation of the nominal payload, up to 30) and ``delay_margin`` (tolerated further delay
    of the sensors, unknown to the estimator, s, up to 30 samples). ``error_over_lqg``: the rms
    error due to noise and unknown effects, over the least possible at the same effort
    (``find_limit``).
    ``law_time``: processor time of the controller at one control sample, s.
    """
    try:
        mission, grip = from_grasp(timed(Mission(scenario_from_yaml(scenario))))
        given, edge = mission.scenario, most_overestimated(PlannedDynamics(mission, grip))
    except FfsmError:  # such as no motion within the limits
        return dict.fromkeys(FIGURES)

    largest = functools.partial(largest_stable, given, time=edge)

    def found(figure: Callable[[], float]) -> float | None:
        with contextlib.suppress(FfsmError, ArithmeticError, ValueError):
            try:
                with time_limit(_LONGEST):
                    value = figure()
            except TimeLimit:
                return math.nan
            return None if math.isnan(value) else value
        return None

    return {
        RADIUS: found(lambda: expected_radius(mission)),
        PAYLOAD: found(lambda: min(largest("nominal_payload"), LARGEST_FACTOR)),
        DELAY: found(lambda: min(largest("delay"), LARGEST_DELAY) * given.sample_time),
        ERROR: found(lambda: find_limit(mission).distance),
        TIME: found(lambda: _law_time(given, grip)),
    }


def _law_time(scenario: Scenario, grip: Grip) -> float:
    """Processor time of an update of the controller, s: lower quartile of the first control
    samples, or of those before Drake refuses a diverged state, which other work on the machine
    moves less than the mean.
    """
    loop = make_closed_loop(scenario, grip=grip)
    simulator = Simulator(loop.diagram)
    ApplySimulatorConfig(scenario.simulator_config, simulator)
    context = simulator.get_mutable_context()
    loop.initialize(loop.diagram, context)
    controller = loop.blocks["controller"]
    own = controller.GetMyContextFromRoot(context)
    times = []
    for sample in range(1, min(_SAMPLES, scenario.num_control_periods) + 1):
        try:
            simulator.AdvanceTo((sample - 0.5) * scenario.sample_time)
        except RuntimeError:  # Drake's
            break
        for port in range(controller.num_input_ports()):
            if controller.get_input_port(port).HasValue(own):
                controller.get_input_port(port).Eval(own)
        start = time.process_time()
        controller.EvalUniquePeriodicDiscreteUpdate(own)
        times.append(time.process_time() - start)
    if len(times) < 2:
        return times[0] if times else math.nan
    return statistics.quantiles(times, n=4)[0]
