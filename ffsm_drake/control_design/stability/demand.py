"""The force that a scenario's motion and disturbance demand of any controller."""

import dataclasses

import numpy as np

from ffsm_drake.scenario import Scenario, from_grasp
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.spacecraft.nominal import make_nominal_plant, make_true_plant
from ffsm_drake.systems.actuation.drives import DriveSet
from ffsm_drake.systems.disturbance import make_disturbance
from ffsm_drake.systems.reference import make_motion


@dataclasses.dataclass(frozen=True, kw_only=True)
class Demand:
    """The demand of perfect tracking, at the middle of every control period."""

    coordinates: Coordinates
    times: np.ndarray  # (n,) control samples, s
    lumped: np.ndarray  # (n, nv) -N, rad/s^2 or m/s^2
    force: np.ndarray  # (n, nv) N m or N
    ideal_isv: float  # effort without noise


def make_demand(scenario: Scenario, *, points: int = 201) -> Demand:
    """The demand of a scenario. Raises ModelError or ScenarioError where its model or a value
    cannot be used.
    """
    from scipy.interpolate import CubicSpline  # slow to load

    scenario = from_grasp(scenario)
    period = scenario.sample_time
    samples = (np.arange(scenario.num_control_periods) + 0.5) * period
    knots = np.linspace(0.0, samples[-1] + 0.5 * period, points)
    both = np.hstack(perfect_tracking(scenario, knots, friction=True))
    lumped, force = np.split(CubicSpline(knots, both)(samples), 2, axis=1)
    return Demand(
        coordinates=make_nominal_plant(scenario).coordinates,
        times=samples - 0.5 * period,
        lumped=lumped,
        force=force,
        ideal_isv=float(np.sum(force**2) * period),
    )


def perfect_tracking(
    scenario: Scenario, times: np.ndarray, *, friction: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """-N = Hhat^-1 tau - a_d (equation (2)) and tau under perfect tracking with the true payload,
    flexible parts locked.

    Args: times (n,), s; whether the friction of drives acts.
    Returns: both (n, nv), rad/s^2 or m/s^2, and N m or N.
    """
    nominal, true = (driven_model(make(scenario)) for make in (make_nominal_plant, make_true_plant))
    coordinates = nominal.coordinates
    reference = make_motion(scenario, coordinates)
    disturbance = make_disturbance(scenario.disturbance, coordinates)
    port = disturbance.GetOutputPort("generalized_force")
    context = disturbance.CreateDefaultContext()
    drives = None
    if friction and scenario.drives is not None:
        drives = DriveSet(scenario.drives, scenario.actuation.limit, coordinates)
    lumped, force = np.empty((2, times.size, len(coordinates.names)))
    for k, time in enumerate(times.tolist()):
        q, v, a = reference.evaluate(time)
        context.SetTime(time)
        tau = true.calc_mass_matrix(q) @ a + true.calc_bias(q, v) - port.Eval(context)
        if drives is not None:
            tau[NUM_BASE_VELOCITIES:] -= drives.friction(v[NUM_BASE_VELOCITIES:])
        lumped[k], force[k] = np.linalg.solve(nominal.calc_mass_matrix(q), tau) - a, tau
    return lumped, force
