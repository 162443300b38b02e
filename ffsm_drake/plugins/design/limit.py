"""The limit of linear controllers: the LQG front of error against effort, and the distance of a
controller to it.

The model is the closed loop at the middle of the planned motion, or at its end with a tracked frame
(``at_rest``). It has the sampled true plant and the sensor noise of the scenario: white noise,
correlated noise, and random walks of biases. An acceleration d with a random walk represents
everything that the controller does not model. The walk is as fast as the planned motion and the
disturbance require.

The linear quadratic Gaussian (LQG) controller has the smallest mean square error for its effort.
Effort is the force in excess of the compensating force -H d (H: mass matrix). The filter uses the
noise model, and every process with memory is one of its states. Delays and slow sensors would only
raise the limit, and are omitted. Constant biases of limit and controller are omitted too. Kalman
filter, shaping filters and regulator: Franklin, Powell and Workman, Digital Control of Dynamic
Systems, chapter 9.
"""

import contextlib
import dataclasses

import numpy as np
from scipy.linalg import solve_discrete_are

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.steps import step
from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.plugins.design.stability.adaptation import expected_gains
from ffsm_drake.plugins.design.stability.linear_loop import STATIONARY, covariance_after
from ffsm_drake.plugins.design.stability.linear_settings import smooth_sensing
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.planned_dynamics import (
    Demand,
    make_demand,
)
from ffsm_drake.plugins.estimators.filter_gains import SMALLEST_RATIO
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates

_UNNEEDED = 1e-6  # weight of coordinates that no output needs
# Prices of effort along the front, in the units of ``_regulator``.
_PRICES = np.geomspace(1e7, 1e-3, 16)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Limit:
    """A controller in the model above, and the LQG front."""

    # rms errors of the outputs of the controller, rad or m; infinite where it is unstable
    error: np.ndarray
    controlled: np.ndarray  # indices of the outputs that the controller controls
    excess: float  # its effort beyond -H d, as ISV over the run
    front_error: np.ndarray  # (m, outputs) the same of the LQG controllers, the cheapest first
    front_excess: np.ndarray  # (m,)

    @property
    def distance(self) -> float:
        """Its error over the least possible at its effort (at least 1); errors weighed by the
        controller's own.

        Infinite where it is unstable, NaN if a user-supplied block senses, whose noise has no
        model.
        """
        if not len(self.front_excess):
            return float("nan")
        error, front = self.error[self.controlled], self.front_error[:, self.controlled]
        if not np.isfinite(error).all() or self.excess <= 0.0:
            return float("inf")
        relative = np.sqrt(np.mean((front / error) ** 2, axis=1))
        possible = np.exp(
            np.interp(np.log(self.excess), np.log(self.front_excess), np.log(relative))
        )
        return float(1.0 / possible)


@step("computing the LQG limit")
def find_limit(scenario: Scenario | Mission, demand: Demand | None = None) -> Limit:
    """The limit for a scenario and its controller's distance to it; takes less than a second.

    Args:
      scenario: the scenario, or its mission.
      demand: demand of the scenario; None: computed.

    Raises: the errors of ``Linearizer`` and ``Linearizer.at``; FfsmError for a run of one control
    period (its demand has no rate).
    """
    mission = make_mission(scenario)
    demand = make_demand(mission) if demand is None else demand
    with Linearizer(mission) as linearizer:
        scenario, planned = linearizer.given, linearizer.planned
        count, step = scenario.num_control_periods, scenario.sample_time
        if count < 2:
            raise FfsmError("the limit needs two control periods; lengthen duration")
        time = planned.motion.part(1.0 if linearizer.tracks_frame else 0.5)
        loop, outputs = linearizer.at(time, held=expected_gains(linearizer)), linearizer.outputs
        jacobian = outputs.frame_jacobian(loop.time, free=True)
    mass, _ = planned.mass_matrices(time, locked=True)
    walk = np.sqrt(np.mean(np.gradient(demand.lumped, step, axis=0) ** 2, axis=0) * step)
    response = outputs.seen(loop).with_random_walk(walk, mass).noise_response(count)
    before, after = _filter(scenario, demand.coordinates, walk)
    rows, error = np.eye(len(walk)), response["error"]
    if jacobian is not None:
        rows, error = np.vstack([rows, jacobian]), np.append(error, response["frame_error"])
    known = np.sqrt((rows**2) @ before[:, 0, 0]) * step**2
    scale = np.where(np.isfinite(error), error, known)
    weight = np.zeros_like(scale)
    kept = outputs.controlled
    weight[kept] = (scale[kept].min() / scale[kept]) ** 2
    front = list[tuple[np.ndarray, float]]()
    for price in _PRICES if not scenario.blocks.sensing else ():
        # too badly scaled to be solved
        with contextlib.suppress(ValueError, np.linalg.LinAlgError):
            front.append(_regulator(mass, before, after, rows, weight, price))
    return Limit(
        error=error,
        controlled=kept,
        excess=float((response["force"] ** 2).sum() * count * step),
        front_error=np.array([error for error, _ in front]).reshape(-1, len(rows)) * step**2,
        front_excess=np.array([variance for _, variance in front]) * count * step,
    )


def _filter(
    scenario: Scenario, coordinates: Coordinates, walk: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Covariances (nv, 3, 3) of each axis' [q, v, d] in units of [L^2, L, 1], of the Kalman filter.

    Before and after the correction of a sample, at the next power of two of the run's samples after
    a known state, as in ``covariance_after``. The filter knows the force, so that its axes are
    decoupled. Its state is [q, v, d], the bias of v, correlated noise of q and of v.
    """
    sensing, step = smooth_sensing(scenario, coordinates), scenario.sample_time

    def vector(name: str, default: float = 0.0) -> np.ndarray:
        return coordinates.vector(getattr(sensing, name), key=f"sensing.{name}", default=default)

    def both(name: str) -> np.ndarray:
        measured = np.stack([vector(f"position_{name}"), vector(f"velocity_{name}")], axis=1)
        return measured / [step**2, step]

    time_constant = np.repeat(vector("correlation_time", 1.0)[:, None], 2, axis=1)
    time_constant[:3, 0] = time_constant[0, 0]  # the attitude's three have one
    kept = np.exp(-step / time_constant)  # decay in one sample
    transition = np.tile(np.eye(6), (len(walk), 1, 1))
    transition[:, :3, :3] = [[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]
    transition[:, [4, 5], [4, 5]] = kept
    output = np.array([[1.0, 0.0, 0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 1.0, 0.0, 1.0]])
    correlated, white, bias_walk = (
        both("correlated_noise"),
        both("noise"),
        vector("velocity_bias_walk"),
    )
    process = np.zeros((len(walk), 6, 6))
    process[:, [2, 3], [2, 3]] = step * np.stack([walk, bias_walk / step], axis=1) ** 2
    process[:, [4, 5], [4, 5]] = correlated**2 * (1.0 - kept**2)
    # As in ``kalman_gain`` the gain assumes at least a little noise on every measurement.
    largest = np.column_stack([white, correlated, walk * np.sqrt(step)]).max(axis=1)
    assumed = np.maximum(white, SMALLEST_RATIO * largest[:, None]) ** 2
    assumed = np.maximum(assumed, np.finfo(float).tiny)  # of a coordinate that is known exactly
    before = process
    for _ in range(1 << (scenario.num_control_periods - 1).bit_length()):
        spread = output @ before @ output.T + assumed[:, None] * np.eye(2)
        gain = np.swapaxes(np.linalg.solve(spread, output @ before), 1, 2)
        correct = np.eye(6) - gain @ output
        after = correct @ before @ np.swapaxes(correct, 1, 2)
        after += (gain * white[:, None] ** 2) @ np.swapaxes(gain, 1, 2)
        last, before = before, transition @ after @ np.swapaxes(transition, 1, 2) + process
        if np.allclose(before, last, rtol=1e-10, atol=0.0):
            break
    return before[:, :3, :3], after[:, :3, :3]


def _regulator(
    mass: np.ndarray, before: np.ndarray, after: np.ndarray, rows: np.ndarray, weight: np.ndarray,
    price: float,
) -> tuple[np.ndarray, float]:  # fmt: skip
    """Rms errors of outputs (m, units of L^2) and variance of the excess force of the LQG
    controller.

    Args:
      mass: H (nv, nv).
      before, after: covariances (nv, 3, 3) of ``_filter``.
      rows: derivative of the outputs by the coordinates (m, nv).
      weight: of the squared outputs (m).
      price: of the squared force.
    """
    nv = len(mass)
    zero, eye = np.zeros((nv, nv)), np.eye(nv)
    unit = np.sqrt(np.mean(np.diagonal(mass) ** 2))  # force of an acceleration of one
    a = np.block([[eye, eye], [zero, eye]])
    b = np.vstack([0.5 * eye, eye]) @ np.linalg.inv(mass) * unit
    weights = np.zeros((2 * nv, 2 * nv))
    weights[:nv, :nv] = (rows.T * weight) @ rows
    if np.count_nonzero(weight) < len(weight):  # coordinates that no output needs stay bounded
        weights[:nv, :nv] += _UNNEEDED * weight.max() * eye
    cost = solve_discrete_are(a, b, weights, price * eye)
    gain = np.linalg.solve(price * eye + b.T @ cost @ b, b.T @ cost @ a)
    closed = a - b @ gain

    def joined(blocks: np.ndarray) -> np.ndarray:
        """The [q, v] part of (nv, 3, 3) as (2 nv, 2 nv)."""
        return np.block([[np.diag(blocks[:, i, j]) for j in range(2)] for i in range(2)])

    estimate = covariance_after(closed, joined(before - after), samples=STATIONARY)
    spread = (closed @ estimate @ closed.T + joined(before))[:nv, :nv]
    error = np.einsum("ij,jk,ik->i", rows, spread, rows)
    force = unit**2 * gain @ estimate @ gain.T + mass @ np.diag(after[:, 2, 2]) @ mass.T
    return np.sqrt(error), float(np.trace(force))
