"""Nonlinear model-predictive control by single shooting.

The unknowns are those of ``mpc``, c_k of the accelerations u_k = -K x_k + c_k, and so is the cost.
The forces of the prediction are those of the nonlinear stack along the predicted motion,

    tau_k = H(q_k) (a_d + u_k) + C(q_k, v_k) + d,

with q_k, v_k shot from the present state through the c before and d the part of the present force
that the model does not explain. Their derivatives along all of the motion enter a sequence of
quadratic programs (Gauss-Newton; the cost is quadratic, so its Hessian is exact), which begins with
the last solution, shifted by a sample. One program a sample is the real-time iteration (Diehl,
Bock, Schloeder, "A real-time iteration scheme for nonlinear optimization in optimal feedback
control", SIAM Journal on Control and Optimization 43 (2005) 1714, doi:10.1137/S0363012902400713).

The time of a sample is bounded by the numbers of programs and of Clarabel's iterations. Past it the
law goes on with the shifted solution, and ``fallbacks`` counts that.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np

from ffsm_drake.common.so3 import turned_by
from ffsm_drake.plugins.baselines.mpc import Mpc, _Now
from ffsm_drake.systems.controllers.law import Sample, State, gain

_STEP = 1e-6  # step of finite differences, rad, m, rad/s, m/s


@dataclasses.dataclass(frozen=True, kw_only=True)
class Nmpc(Mpc):
    """Model-predictive control that respects limits, with the nonlinear model of the stack.

    It differs from ``Mpc`` in the forces along the prediction. A linearisation about the plan has
    the regulator and the estimate, without limits. The state ``planned`` is the last solution.
    """

    solutions: float = gain(
        1.0,
        "",
        "largest number of quadratic programs in a control sample",
        scalar=True,
        positive=True,
        feedback=False,
    )

    def initial_state(self) -> State:
        return {**super().initial_state(), "planned": np.zeros(self.steps * len(self.error_size))}

    def held(self) -> Mapping[str, float | None]:
        return {**super().held(), "planned": None}

    def solve(
        self, sample: Sample, now: _Now, state: State
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """See ``Mpc``."""
        if not self.limits.exist:
            return np.zeros_like(now.known), {}
        c = state["planned"].reshape(self.steps, -1)
        share = self.sample_time / self.prediction_step
        c = c + share * (np.vstack([c[1:], np.zeros_like(c[:1])]) - c)
        programs, fallbacks = 0.0, 0.0
        none = np.zeros((*c.shape, *c.shape))
        alone = self.rows(sample, now, self._forces(sample, now, 0.0 * c), none)
        if all(each.is_kept(self.limits) for each in alone):
            c = np.zeros_like(c)
        else:
            for _ in range(max(1, round(self.solutions))):
                change = self._change(sample, now, c)
                forces = self._forces(sample, now, c) - np.einsum("kifj,fj->ki", change, c)
                found, solved = self.planned(self.rows(sample, now, forces, change))
                programs += solved is not None
                if solved is False:
                    fallbacks = 1.0
                    break
                c = found
        return c[0], {
            "programs": state["programs"] + programs,
            "fallbacks": state["fallbacks"] + fallbacks,
            "planned": c.ravel(),
        }

    def _shot(self, now: _Now, c: np.ndarray) -> np.ndarray:
        """[e'_k; u_k; e_k] (3, N, nv) with c (N, nv)."""
        found: np.ndarray = self.free(now) + np.einsum("rkfj,fj->rkj", self.prediction[1], c)
        return found[:, :-1]

    def _force(self, sample: Sample, steps: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """H (a_d + u) + C (m, nv) at steps (m), with [e'; u; e] of ``motion`` (3, m, nv)."""
        rate, u, error = motion
        t = self.prediction_step * steps[:, None]
        ahead = t * sample.v_d + 0.5 * t * t * sample.a_d
        whole = self.model.calc_whole_velocity
        ahead, error = (whole(sample.q_d, change) for change in (ahead, error))
        attitude = turned_by(-error[:, :3], turned_by(ahead[:, :3], sample.q_d[:4]))
        q = np.hstack([attitude, sample.q_d[4:] + ahead[:, 3:] - error[:, 3:]])
        v = sample.v_d + t * sample.a_d - rate
        return self.model.calc_inverse_dynamics(q, v, sample.a_d + u)

    def _forces(self, sample: Sample, now: _Now, c: np.ndarray) -> np.ndarray:
        """Forces (N, nv) along the prediction; the first is that of ``Mpc``, linear in c."""
        motion = self._shot(now, c)
        rows = self._force(sample, np.arange(self.steps), motion)
        return rows + (now.known + now.mass_matrix @ motion[1, 0] - rows[0])

    def _change(self, sample: Sample, now: _Now, c: np.ndarray) -> np.ndarray:
        """Derivative (N, nv, N, nv) of ``_forces``; along the motion by differences."""
        motion, size = self._shot(now, c), c.shape[1]
        count = self.steps - 1
        changed = np.repeat(motion[:, 1:, None], 3 * size + 1, axis=2)  # (3, N - 1, one more, nv)
        for kind in range(3):
            own = slice(1 + kind * size, 1 + (kind + 1) * size)
            changed[kind, :, own] += _STEP * np.eye(size)
        steps = np.repeat(np.arange(1, self.steps), 3 * size + 1)
        force = self._force(sample, steps, changed.reshape(3, -1, size))
        force = force.reshape(count, 3 * size + 1, size)
        slopes = ((force[:, 1:] - force[:, :1]) / _STEP).reshape(count, 3, size, size)
        found = np.empty((*c.shape, *c.shape))
        found[0] = np.einsum("ij,fj->ifj", now.mass_matrix, self.prediction[1][1, 0])
        found[1:] = np.einsum("krji,rkfj->kifj", slopes, self.prediction[1][:, 1:-1])
        return found
