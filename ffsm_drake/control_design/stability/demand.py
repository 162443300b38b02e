"""What a scenario's motion and disturbance ask of any controller."""

import dataclasses

import numpy as np
from scipy.interpolate import CubicSpline

from ffsm_drake.scenario import Scenario, from_grasp
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.spacecraft.nominal import make_nominal_plant, make_true_plant
from ffsm_drake.systems.actuation.drives import DriveSet
from ffsm_drake.systems.disturbance import make_disturbance
from ffsm_drake.systems.reference import make_motion


@dataclasses.dataclass(frozen=True, kw_only=True)
class Demand:
    """What a scenario asks of any controller, at the middle of every control period."""

    coordinates: Coordinates
    times: np.ndarray  # (n,) control samples, s
    lumped: np.ndarray  # (n, nv) -N under perfect tracking, rad/s^2 or m/s^2
    force: np.ndarray  # (n, nv) of perfect tracking, N m or N
    ideal_isv: float  # effort of perfect tracking without noise


def make_demand(scenario: Scenario, *, points: int = 201) -> Demand:
    """The demand of a scenario. Raises ModelError or ScenarioError where its model or a value
    cannot be used.
    """
    scenario = from_grasp(scenario)
    nominal, true = (driven_model(make(scenario)) for make in (make_nominal_plant, make_true_plant))
    coordinates, period = nominal.coordinates, scenario.sample_time
    reference = make_motion(scenario, coordinates)
    disturbance = make_disturbance(scenario.disturbance, coordinates)
    port, context = (
        disturbance.GetOutputPort("generalized_force"),
        disturbance.CreateDefaultContext(),
    )
    drives = None
    if scenario.drives is not None:
        drives = DriveSet(scenario.drives, scenario.actuation.limit, coordinates)
    samples = (np.arange(scenario.num_control_periods) + 0.5) * period
    knots = np.linspace(0.0, samples[-1] + 0.5 * period, points)
    rows = []
    for time in knots:
        q, v, a = reference.evaluate(time)
        context.SetTime(time)
        tau = true.calc_mass_matrix(q) @ a + true.calc_bias(q, v) - port.Eval(context)
        if drives is not None:
            tau[NUM_BASE_VELOCITIES:] -= drives.friction(v[NUM_BASE_VELOCITIES:])
        rows.append(np.concatenate([np.linalg.solve(nominal.calc_mass_matrix(q), tau) - a, tau]))
    lumped, force = np.split(CubicSpline(knots, np.array(rows))(samples), 2, axis=1)
    return Demand(
        coordinates=coordinates,
        times=samples - 0.5 * period,
        lumped=lumped,
        force=force,
        ideal_isv=float(np.sum(force**2) * period),
    )
