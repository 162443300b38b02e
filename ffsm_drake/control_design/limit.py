"""What no linear controller can do better: the LQG front of error against effort, and how far a
controller is from it.

The model is that of the closed loop at the middle of the planned motion: the true plant, sampled;
the scenario's sensor noise; and in place of all that the controller does not know an acceleration d
that walks at random, as fast as the planned motion and the disturbance ask for. Under it the linear
quadratic Gaussian controller has the least mean square error for its effort, which counts beyond
the force -H d that keeps d from acting (H: mass matrix). Delays and slow sensors are left out of
the limit, which they only raise. Stationary Kalman filter and regulator: Franklin, Powell and
Workman, Digital Control of Dynamic Systems, chapter 9.
"""

import contextlib
import dataclasses

import numpy as np
from scipy.linalg import solve_discrete_are

from ffsm_drake.common.errors import BlockError
from ffsm_drake.control_design.stability.demand import Demand, make_demand
from ffsm_drake.control_design.stability.linearization import Linearizer, smooth_sensing
from ffsm_drake.control_design.stability.margins import expected_gains
from ffsm_drake.control_design.stability.sampled_loop import covariance_after
from ffsm_drake.scenario import Scenario, from_grasp
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.spacecraft.nominal import make_true_plant
from ffsm_drake.systems.controllers.filter_gains import kalman_gain
from ffsm_drake.systems.reference import make_motion

# Prices of effort that the front is computed for, in units of the regulator's (see there).
_PRICES = np.geomspace(1e7, 1e-3, 16)
_STATIONARY = 2**18  # control samples


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Limit:
    """A controller in the model above, and the front of what is possible."""

    error: np.ndarray  # (nv,) rms error of the controller, rad or m; infinite where it is unstable
    excess: float  # its effort beyond -H d, as ISV over the run
    front_error: np.ndarray  # (m, nv) the same of the LQG controllers, the cheapest first
    front_excess: np.ndarray  # (m,)

    @property
    def distance(self) -> float:
        """Its error over the least possible at its effort (at least 1); errors weighed by the
        controller's own.
        """
        if not np.isfinite(self.error).all() or self.excess <= 0.0:
            return float("inf")
        relative = np.sqrt(np.mean((self.front_error / self.error) ** 2, axis=1))
        possible = np.exp(
            np.interp(np.log(self.excess), np.log(self.front_excess), np.log(relative))
        )
        return float(1.0 / possible)


def find_limit(scenario: Scenario, demand: Demand | None = None) -> Limit:
    """The limit for a scenario and its controller's distance to it; takes less than a second.

    Args:
      scenario: what is looked at.
      demand: that of the scenario, if it is known already.

    Raises: as ``Linearizer`` and ``Linearizer.at``; BlockError for a controller that tracks a
    frame.
    """
    scenario = from_grasp(scenario)
    demand = make_demand(scenario) if demand is None else demand
    motion, step, count = (
        make_motion(scenario, demand.coordinates),
        scenario.sample_time,
        scenario.num_control_periods,
    )
    time = motion.part(0.5)
    q, _, _ = motion.evaluate(time)
    mass = driven_model(make_true_plant(scenario)).calc_mass_matrix(q)
    walk = np.sqrt(np.mean(np.gradient(demand.lumped, step, axis=0) ** 2, axis=0) * step)
    with Linearizer(scenario) as linearizer:
        if linearizer.loop.tracks_frame:
            raise BlockError(
                f"{scenario.controller} tracks a frame; the limit is one of coordinates"
            )
        loop = linearizer.at(time, held=expected_gains(linearizer))
    response = loop.with_random_walk(walk, mass).noise_response(count)
    sensing = smooth_sensing(scenario)
    position, velocity = (
        demand.coordinates.vector(noise, key="sensing", default=0.0)
        for noise in (sensing.position_noise, sensing.velocity_noise)
    )
    axes = zip(position, velocity, walk, strict=True)
    before, after = np.array(
        [_filter(*map(float, axis), sample_time=step) for axis in axes]
    ).swapaxes(0, 1)
    scale = np.where(
        np.isfinite(response["error"]), response["error"], np.sqrt(before[:, 0, 0]) * step**2
    )
    front = list[tuple[np.ndarray, float]]()
    for price in _PRICES:
        # too badly scaled to be solved
        with contextlib.suppress(ValueError, np.linalg.LinAlgError):
            front.append(_regulator(mass, before, after, scale / step**2, price))
    return Limit(
        error=response["error"],
        excess=float((response["force"] ** 2).sum() * count * step),
        front_error=np.array([error for error, _ in front]) * step**2,
        front_excess=np.array([variance for _, variance in front]) * count * step,
    )


def _filter(
    position_noise: float, velocity_noise: float, walk: float, *, sample_time: float
) -> tuple[np.ndarray, np.ndarray]:
    """Covariances (3, 3) of one axis' [q, v, d] in units of [L^2, L, 1], before and after the
    correction of a sample.

    The filter knows the force, so that axes do not meet in it.
    """
    gain = kalman_gain(
        position_noise=position_noise,
        velocity_noise=velocity_noise,
        walk=walk,
        sample_time=sample_time,
    )
    size = np.array([sample_time**2, sample_time, 1.0])
    correct = np.eye(3)
    correct[:, :2] -= gain / size[:, None] * size[:2]
    motion = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    measured = (
        (gain / size[:, None])
        @ np.diag(np.array([position_noise, velocity_noise]) ** 2)
        @ (gain / size[:, None]).T
    )
    process = np.diag([0.0, 0.0, walk**2 * sample_time])
    after = covariance_after(
        correct @ motion, measured + correct @ process @ correct.T, samples=_STATIONARY
    )
    return motion @ after @ motion.T + process, after


def _regulator(
    mass: np.ndarray, before: np.ndarray, after: np.ndarray, scale: np.ndarray, price: float
) -> tuple[np.ndarray, float]:
    """Rms error (nv, units of L^2) and variance of the excess force of the LQG controller.

    Args:
      mass: H (nv, nv).
      before, after: covariances (nv, 3, 3) of ``_filter``.
      scale: by which errors are weighed (nv), units of L^2.
      price: of the squared force.
    """
    nv = len(mass)
    zero, eye = np.zeros((nv, nv)), np.eye(nv)
    unit = np.sqrt(np.mean(np.diagonal(mass) ** 2))  # force of an acceleration of one
    a = np.block([[eye, eye], [zero, eye]])
    b = np.vstack([0.5 * eye, eye]) @ np.linalg.inv(mass) * unit
    weight = np.zeros((2 * nv, 2 * nv))
    weight[:nv, :nv] = np.diag((scale.min() / scale) ** 2)
    cost = solve_discrete_are(a, b, weight, price * eye)
    gain = np.linalg.solve(price * eye + b.T @ cost @ b, b.T @ cost @ a)
    closed = a - b @ gain

    def joined(blocks: np.ndarray) -> np.ndarray:
        """The [q, v] part of (nv, 3, 3) as (2 nv, 2 nv)."""
        return np.block([[np.diag(blocks[:, i, j]) for j in range(2)] for i in range(2)])

    estimate = covariance_after(closed, joined(before - after), samples=_STATIONARY)
    error = np.diagonal(closed @ estimate @ closed.T + joined(before))[:nv]
    force = unit**2 * gain @ estimate @ gain.T + mass @ np.diag(after[:, 2, 2]) @ mass.T
    return np.sqrt(error), float(np.trace(force))
