"""The dynamics of a scenario along its planned motion: how far the nominal mass matrix is from the
true one, and the force that motion and disturbance demand of any controller.
"""

import dataclasses
import functools

import numpy as np

from ffsm_drake.mission import Mission, kept
from ffsm_drake.plugins.actuators.drives import DriveSet
from ffsm_drake.scenario import WHOLE, Grip
from ffsm_drake.scenario.contacts import closing_times
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.spacecraft.inertia import inertia_ratios
from ffsm_drake.spacecraft.limits import FORCE
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.disturbance import force_at, sines_of
from ffsm_drake.systems.reference import make_motion

_POINTS = 101  # instants at which the lightest coordinates are sought


@kept
def from_grasp(mission: Mission) -> tuple[Mission, Grip]:
    """The mission that begins with the grasp of another, as a user would write it: without approach
    and phases before it; and all its hands on the target. Unchanged without them.
    """
    scenario = mission.scenario
    grip = Grip(closed=closing_times(scenario)[-1])
    if scenario.capture is None or scenario.approach is None:
        return mission, grip
    held = dataclasses.replace(
        scenario.capture, approach=None, closing=None, retreat=None, measured=None
    )
    alone = mission.flown_by(
        duration=scenario.duration - scenario.grasp_time,
        capture=held,
        blocks=dataclasses.replace(scenario.blocks, phases={}),
        phases=[],
    )
    return alone, grip


class PlannedDynamics:
    """The nominal and the true plant of a mission along its planned motion, undriven coordinates
    free.
    """

    def __init__(self, mission: Mission, grip: Grip = WHOLE) -> None:
        """Raises ModelError or ScenarioError if a model or a value cannot be used."""
        self.mission, self.scenario = mission, mission.scenario
        self.nominal = driven_model(mission.craft.nominal(grip))
        self.true = driven_model(mission.craft.flexible(grip))  # with hidden coordinates
        self.coordinates = self.nominal.coordinates
        self.motion = make_motion(mission, grip)
        self._drifts = dict[bytes, np.ndarray]()

    @functools.cached_property
    def locked(self) -> PlantModel:
        """The true plant with its hidden coordinates locked."""
        names = self.true.split.names
        return driven_model(self.mission.craft.true(self.nominal.grip)) if names else self.true

    def mass_matrices(self, time: float, *, locked: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """H, apparent (``calc_apparent_mass_matrix``), and Hhat (nv, nv) at a time, s."""
        q, _, _ = self.motion.evaluate(time)
        true = self.locked if locked else self.true
        return true.calc_apparent_mass_matrix(q), self.nominal.calc_mass_matrix(q)

    def ratios(self, time: float, *, locked: bool = False) -> np.ndarray:
        """eta (na) of the driven coordinates at a time, s."""
        driven = np.ix_(self.coordinates.driven, self.coordinates.driven)
        return inertia_ratios(*(each[driven] for each in self.mass_matrices(time, locked=locked)))

    def lightest(self, begin: float, end: float) -> list[float]:
        """The times, s, between two at which a driven coordinate is lighter, the others free to
        react, than shortly before and after.
        """
        times = np.linspace(begin, end, _POINTS)
        mass_matrices = np.array([self.mass_matrices(time)[0] for time in times])
        inverse = np.diagonal(np.linalg.inv(mass_matrices), axis1=1, axis2=2)
        inverse = inverse[:, self.coordinates.driven]
        rounding, change = 1e-6 * inverse[1:-1], np.diff(inverse, axis=0)
        peaks = (change[:-1] > rounding) & (change[1:] < -rounding)
        return times[1:-1][peaks.any(axis=1)].tolist()

    def demand(self, times: np.ndarray) -> dict[str, np.ndarray]:
        """Values (n, k) of what has limits, by quantity, at times (n,), s, under perfect tracking
        against the disturbance, hidden coordinates locked.
        """
        sines = sines_of(self.scenario.disturbance, self.coordinates)
        return self.motion.demand(self.locked, times, force_at(times[:, None], sines))

    def perfect_tracking(
        self, times: np.ndarray, *, friction: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """-N = Hhat^-1 tau - a_d (equation (2)) and tau under perfect tracking, hidden coordinates
        locked.

        Args: times (n,), s; whether the friction of drives acts.
        Returns: both (n, nv), rad/s^2 or m/s^2, and N m or N.
        """
        scenario, coordinates = self.scenario, self.coordinates
        q, v, a = self.motion.evaluate(times)
        force = self.demand(times)[FORCE]
        if friction and scenario.drives is not None:
            drives = DriveSet(scenario.drives, scenario.actuation.limit, coordinates)
            force[:, NUM_BASE_VELOCITIES:] -= drives.friction(v[:, NUM_BASE_VELOCITIES:])
        nominal = self.nominal.calc_mass_matrix(q)
        return np.linalg.solve(nominal, force[..., None])[..., 0] - a, force

    def drift(self, times: np.ndarray) -> np.ndarray:
        """The rate of -N (n, nv) at times (n,), s, under perfect tracking."""
        if (key := times.tobytes()) not in self._drifts:
            self._drifts[key] = np.gradient(self.perfect_tracking(times)[0], times, axis=0)
        return self._drifts[key]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Demand:
    """The demand of perfect tracking, at the middle of every control period."""

    coordinates: Coordinates
    times: np.ndarray  # (n,) control samples, s
    lumped: np.ndarray  # (n, nv) -N, rad/s^2 or m/s^2
    force: np.ndarray  # (n, nv) N m or N
    ideal_isv: float  # effort without noise


def make_demand(mission: Mission, *, points: int = 201) -> Demand:
    """The demand of a mission, interpolated between ``points`` instants. Raises the errors of
    PlannedDynamics.
    """
    from scipy.interpolate import CubicSpline  # slow to load

    planned = PlannedDynamics(*from_grasp(mission))
    scenario, period = planned.scenario, planned.scenario.sample_time
    samples = (np.arange(scenario.num_control_periods) + 0.5) * period
    knots = np.linspace(0.0, samples[-1] + 0.5 * period, points)
    both = np.hstack(planned.perfect_tracking(knots, friction=True))
    lumped, force = np.split(CubicSpline(knots, both)(samples), 2, axis=1)
    return Demand(
        coordinates=planned.coordinates,
        times=samples - 0.5 * period,
        lumped=lumped,
        force=force,
        ideal_isv=float(np.sum(force**2) * period),
    )
