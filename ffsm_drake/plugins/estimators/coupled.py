"""Kalman filter of the attitude and the joints together.

The disturbance is a force, and H couples its effects on attitude and joints: d = -Hhat^-1 f, with
f a random walk. One filter of all their measurements is then more accurate than separate filters.
Biases are states of it, as in ``plugins.estimators.kalman``. H changes along a motion, and the gain
of a posture with H_0 makes the filter unstable if an eigenvalue of H^-1 H_0 exceeds about 2.4.
Gains are therefore computed for enough postures of the plan, and the gain of the posture nearest to
the desired one is used.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import ClassVar, Self

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.mission import Mission, planned
from ffsm_drake.plugins.estimators.assumed_noise import sensed_axes
from ffsm_drake.plugins.estimators.filter_gains import SensedAxis, SensedGains, sensed_gains
from ffsm_drake.plugins.estimators.kalman import (
    KalmanEstimator,
    LateKalmanEstimator,
    predict,
    turned,
)
from ffsm_drake.scenario import Grip
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, Coordinates
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.systems.controllers.estimation import Estimate, Estimator
from ffsm_drake.systems.controllers.law import Sample, State
from ffsm_drake.systems.reference import make_motion

# Largest eigenvalue of the inertia of a posture with a gain of its own relative to its neighbour's.
_NEIGHBOURS = 1.15
_MOST_POSTURES = 41  # 3 to 4 ms each
_INSTANTS = 201  # instants of a plan, candidates for these postures


@dataclasses.dataclass(frozen=True, kw_only=True)
class CoupledEstimator(Estimator):
    """Kalman estimate of [e, e', f] of several coordinates together, d = -(Hhat^-1 f), and of the
    others one by one.
    """

    random_walks: ClassVar[tuple[str, ...]] = ("walk", "force_walk")
    by_sample: ClassVar[tuple[str, ...]] = ("gain",)
    in_phase: ClassVar[tuple[str, ...]] = ("postures",)  # compiled, ``at_samples`` alone reads them
    separate: KalmanEstimator | LateKalmanEstimator
    axes: np.ndarray  # (n,) the coordinates that are taken together
    biased: np.ndarray  # (k,) those of them whose velocities have a bias
    kinds: np.ndarray  # (k, 2 n) the new measurements of [e, e'] that occur together
    # postures (m, nq) of the gains, and gains (m, k, size, 2 n): correction of [e, e', f, b, past]
    # per unit of innovation of [e, e']
    postures: np.ndarray
    gain: np.ndarray

    @classmethod
    def make(
        cls,
        mission: Mission,
        coordinates: Coordinates,
        jacobian: np.ndarray | None,
        grip: Grip,
    ) -> Self:
        scenario = mission.scenario
        sensed = sensed_axes(scenario, coordinates)
        if len(set(sensed[:3])) > 1:
            raise ScenarioError(
                "estimator.kind",
                "coupled needs one noise and walk for the base's three axes; set kalman",
            )
        axes = np.flatnonzero([group != "base_position" for group in coordinates.group_of])
        walk = coordinates.vector(scenario.estimator.force_walk, key="estimator.force_walk")
        together = [dataclasses.replace(sensed[i], walk=float(walk[i])) for i in axes]
        whole = mission.craft.nominal(grip).coordinates.names  # a closed chain has fewer
        places = [whole.index(coordinates.names[i]) for i in axes]
        postures, (kinds, gain) = _gains_along(
            mission, grip, axes=tuple(places), sensed=tuple(together)
        )
        bias = np.array([axis.bias_walk for axis in together])
        unbiased = 3 * axes.size + np.flatnonzero(bias == 0.0)
        return cls(
            separate=KalmanEstimator.make(mission, coordinates, None, grip),
            axes=axes,
            biased=axes[bias > 0.0],
            kinds=kinds,
            postures=postures,
            gain=np.delete(gain, unbiased, axis=-2),
        )

    def initial_state(self) -> State:
        return {**self.separate.initial_state(), "estimated_force": np.zeros(self.axes.size)}

    def gain_at(self, q_d: np.ndarray) -> np.ndarray:
        """Return the gains (..., k, size, 2 n) of the posture nearest to q_d (..., nq) by the angle
        of the base's rotation and the joints' positions, rad or m.
        """
        if len(self.gain) == 1 and q_d.ndim == 1:
            return self.gain[0]
        nearest: np.ndarray = self.gain[self.nearest(q_d)]
        return nearest

    def nearest(self, q_d: np.ndarray) -> np.ndarray:
        """The index of that gain."""
        return _nearest(self.postures, q_d)

    def at_samples(self, q_d: np.ndarray) -> Mapping[str, np.ndarray]:
        """The gains at postures q_d (samples, nq), for the compiled engine."""
        return {"gain": self.gain_at(q_d)}

    def step(
        self, sample: Sample, nominal_mass_matrix: np.ndarray, state: State
    ) -> tuple[Estimate, State]:
        """One sample; see Estimator."""
        predicted = predict(sample, nominal_mass_matrix, state, step=self.separate.sample_time)
        estimate, after = self.separate.step(sample, nominal_mass_matrix, state)
        e, e_dot, d = estimate.e.copy(), estimate.e_dot.copy(), -estimate.base_acceleration
        n, axes, past = self.axes.size, self.axes, self.separate.past(sample, state)
        of_all = self.separate.expected(*predicted[:2], past)
        is_own = np.tile(np.isin(np.arange(d.size), axes), 2)
        measured = np.concatenate((sample.e, sample.e_dot))
        innovation = (measured - of_all)[is_own]
        if self.biased.size:
            R, bias = matrix_of(sample.q[:4]), state["estimated_velocity_bias"]
            innovation[n:] = innovation[n:] + turned(R, bias)[axes]
        gains = self.gain_at(sample.q_d)
        gain = gains[-1]
        if sample.is_new is not None:
            new = sample.is_new[is_own]
            gain, innovation = self.of_kind(gains, new), np.where(new, innovation, 0.0)
        ends = np.cumsum([n, n, n, self.biased.size])
        of_e, of_rate, of_force, of_bias, of_past = np.split(gain.dot(innovation), ends)
        force = state["estimated_force"] + of_force
        # Its effect on the other coordinates is theirs to estimate.
        acting = np.zeros_like(d)
        acting[axes] = force
        e[axes], e_dot[axes] = predicted[0][axes] + of_e, predicted[1][axes] + of_rate
        d[axes] = -np.linalg.solve(nominal_mass_matrix, acting)[axes]
        kept = {"estimated_error": e, "estimated_error_rate": e_dot, "estimated_negative_n": d}
        if self.biased.size:  # in the base's axes
            correction = np.zeros_like(d)
            correction[self.biased] = of_bias
            bias = bias + turned(R.T, correction)
            of_others = after["estimated_velocity_bias"]
            kept["estimated_velocity_bias"] = np.where(is_own[: d.size], bias, of_others)
        if past.size:
            kept["past"] = after["past"].copy()
            of_own = is_own[self.separate.owner]
            kept["past"][of_own] = past[of_own] + of_past
        return estimate._replace(e=e, e_dot=e_dot, base_acceleration=-d), {
            **after,
            **kept,
            "estimated_force": force,
        }

    def of_kind(self, gains: np.ndarray, new: np.ndarray) -> np.ndarray:
        """The gain of the kind of sample that is most like one with ``new`` (2 n) measurements."""
        gain, least = gains[-1], (new != self.kinds[-1]).sum()
        for of, kind in zip(gains[-2::-1], self.kinds[-2::-1], strict=True):
            apart = (new != kind).sum()
            gain, least = np.where(apart < least, of, gain), np.minimum(apart, least)
        return gain

    def resume(self, state: State, ratio: np.ndarray, v_d: np.ndarray) -> State:
        """See Estimator."""
        return self.separate.resume(state, ratio, v_d)


def _nearest(postures: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Index of the posture (m, nq) nearest to q (..., nq), see ``gain_at``."""
    each = q[..., None, :]
    joints = (each - postures)[..., NUM_BASE_POSITIONS:]
    cosine = np.abs((each * postures)[..., :4].sum(axis=-1))  # cosine of half the angle
    nearest: np.ndarray = np.argmin((joints * joints).sum(axis=-1) - 8.0 * cosine, axis=-1)
    return nearest


@planned
def _gains_along(
    mission: Mission,
    /,
    grip: Grip,
    *,
    axes: tuple[int, ...],
    sensed: tuple[SensedAxis, ...],
) -> tuple[np.ndarray, SensedGains]:
    """Postures (m, nq) of a mission's plan, with the gains of each.

    With a capture it is the plan of the phase with ``grip``. The relative eigenvalues of the
    inertias of neighbours stay within ``_NEIGHBOURS``, if ``_MOST_POSTURES`` are enough.

    Args:
      mission: with its model and plan.
      axes: places of the coordinates that are taken together in those of the spacecraft (n).
      sensed: their noise assumptions (n), with the walk of the force.
    """
    model = driven_model(mission.craft.nominal(grip))
    motion = make_motion(mission, grip)
    q, _, _ = motion.evaluate(np.linspace(motion.begin, motion.end, _INSTANTS))
    inverse = np.linalg.inv(model.calc_mass_matrix(q))[:, np.array(axes)[:, None], axes]
    # Distances by the logarithm of the eigenvalue farthest from one: they add up along the motion.
    ratios = np.linalg.eigvals(np.linalg.solve(inverse[1:], inverse[:-1])).real
    passed = np.cumsum([0.0, *np.abs(np.log(ratios)).max(axis=1)])
    steps = passed[-1] / math.log(_NEIGHBOURS) - 1e-9  # but for rounding
    count = min(math.ceil(steps) + 1, _MOST_POSTURES)
    chosen = np.abs(passed - np.linspace(0.0, passed[-1], count)[:, None]).argmin(axis=1)
    step = mission.scenario.sample_time
    return q[chosen], sensed_gains(sensed, responses=-inverse[chosen], sample_time=step)
