"""Adaptive zero reaction control: the arm moves a frame and keeps the attitude of a floating base.

The idea is that of Xu, Wang and Zhao, "Adaptive zero reaction motion control for free-floating
space manipulators", arXiv 1402.5586: joint rates from the reaction null space of an estimated model
(Nenchev, Yoshida, Vichitkulsawat, Uchiyama, IEEE Transactions on Robotics and Automation 15 (1999)
1011, doi:10.1109/70.817666), with an adaptation that follows from an expression linear in the
unknown parameters. Only abstract and introduction of this paper were available, so the equations
are derived here.

With the payload's parameters theta (``baselines.payload``), and their estimate (hat),

    Hhat_uu v_u + Hhat_ua v_a = W (theta_hat - theta)      (zero momentum; H v is linear in theta)
    v_u = Fhat v_a + Hhat_uu^-1 W (theta_hat - theta),     Fhat = -Hhat_uu^-1 Hhat_ua,        (1)
    V = Jhat* v_a + J_u Hhat_uu^-1 W (theta_hat - theta),  Jhat* = J_a + J_u Fhat,            (2)

for the base's velocity v_u and the frame's twist V: both are linear in the error of the estimate.
The joint rates v_r give the base the rate b = w_d + K_b e_b, then the frame the twist
x = V_d + K e, and else follow the plan with z = v_d + k_plan e_q (F_r: rows of the rotation):

    v_1 = z + F_r^+ (b - F_r z),     N = 1 - F_r^+ F_r,
    v_r = v_1 + (J* N)^+ (x - J* v_1),
    tau_a = H* k_v (v_r - v_a) + C*,
    theta_hat' = Gamma (Y^T [e_b; e] - beta W^T (H v)_u),     Y = [I_r; J_u] H_uu^-1 W,       (3)

all with the estimate. Pseudoinverses are damped as in ``task_space.tasks``.

With v_a = v_r and feasible tasks, |e_b|^2 + |e|^2 + |theta_hat - theta|^2 in the metric of Gamma^-1
falls at the rate 2 (e_b^T K_b e_b + e^T K e + beta |W (theta_hat - theta)|^2).

The paper's adaptation of kinematic parameters is left out: the geometry of the arm is known here,
and unknown masses enter J*. If the base is driven, or only its position floats, momentum is not
zero, and the law is resolved-rate control with the nominal payload.
"""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from ffsm_drake.common.products import applied
from ffsm_drake.common.so3 import skew
from ffsm_drake.plugins.baselines.payload import SIZE, Payload
from ffsm_drake.plugins.task_space.resolved_motion import damped_inverse
from ffsm_drake.plugins.task_space.resolved_rate import ResolvedRate
from ffsm_drake.plugins.task_space.tasks import TaskSpace, limited
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.free_floating import FreeFloating
from ffsm_drake.systems.controllers.law import ControlLaw, Sample, State, field_values, gain
from ffsm_drake.systems.setup import BlockSetup

_TURN, _BASE = slice(0, 3), slice(0, NUM_BASE_VELOCITIES)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AdaptiveZeroReaction(ControlLaw):
    """Adaptive zero reaction control (Xu et al.): joint rates from the reaction null space.

    The state ``payload_change`` (10) is that of ``slotine_li``: the estimate minus its nominal
    value. A linearisation about the plan, for example by ``ffsm stability``, holds it constant.

    With a driven base the law is ``resolved_rate`` with these gains.
    """

    tracks_frame: ClassVar[bool] = True
    task_space: TaskSpace
    payload: Payload
    sample_time: float
    k_base: float = gain(1.0, "1/s", "gain K_b on the attitude error of the base", scalar=True)
    k_p_rotation: float = gain(2.0, "1/s", "gain K on the attitude error of the frame", scalar=True)
    k_p_position: float = gain(2.0, "1/s", "gain K on the position error of the frame", scalar=True)
    k_v: float = gain(20.0, "1/s", "gain on the rates of the joints", scalar=True)
    k_p_plan: float = gain(2.0, "1/s", "gain on the errors of free joints", scalar=True)
    speed_limit: float = gain(
        0.1,
        "rad/s, m/s",
        "largest speed at which an error of base or frame is corrected",
        scalar=True,
        positive=True,
        feedback=False,
    )
    damping: float = gain(
        0.1,
        "rad/rad, m/rad",
        "singular value of J* N, with 1 rad counted as 1 m, below which its inverse is damped",
        scalar=True,
        positive=True,
        feedback=False,
    )
    reaction_damping: float = gain(
        0.01,
        "rad/rad",
        "singular value of F_r below which its inverse is damped",
        scalar=True,
        positive=True,
        feedback=False,
    )
    mass_rate: float = gain(
        1e6,
        "kg^2/(N m)",
        "rate of adaptation of the mass, an entry of Gamma",
        scalar=True,
        feedback=False,
    )
    moment_rate: float = gain(
        1e6,
        "kg^2 m/N",
        "rate of adaptation of mass times centre of mass, an entry of Gamma",
        scalar=True,
        feedback=False,
    )
    inertia_rate: float = gain(
        1e6,
        "kg^2 m^3/N",
        "rate of adaptation of the inertia, an entry of Gamma",
        scalar=True,
        feedback=False,
    )
    prediction: float = gain(
        1e-3,
        "1/(N m s^2)",
        "weight beta of the momentum in the adaptation",
        scalar=True,
        feedback=False,
    )

    def initial_state(self) -> State:
        return {"payload_change": np.zeros(SIZE), "smallest_singular_value": np.zeros(1)}

    def held(self) -> Mapping[str, float | None]:
        return {"payload_change": None}

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        change, q, v = state["payload_change"], sample.q, sample.v
        model, driven = self.payload.model, self.task_space.driven
        point = self.task_space.at(sample, damping=self.damping)
        spacecraft = FreeFloating(
            mass_matrix=point.spacecraft.mass_matrix + self.payload.added_mass_matrix(q, change),
            base_position=q[4:NUM_BASE_POSITIONS],
            driven=driven,
        )
        e_b = model.calc_tracking_errors(
            np.concatenate([sample.q_d, sample.v_d]), np.concatenate([q, v]), q.size
        )[0][_TURN]
        base = sample.v_d[_TURN] + limited(self.k_base * e_b, self.speed_limit)
        gains = self.task_space.by_row(self.k_p_rotation, self.k_p_position)
        twist = point.desired_twist + limited(gains * point.e, self.speed_limit)
        plan = (sample.v_d + self.k_p_plan * sample.e)[driven]
        jacobian = spacecraft.generalized_jacobian(point.whole_jacobian)
        rates, smallest = self._rates(spacecraft.following[_TURN], jacobian, base, twist, plan)
        added = self.payload.force_regressor(q, v, v, np.zeros_like(v)) @ change
        bias = spacecraft.reduced_bias(model.calc_bias(q, v) + added)
        force = np.zeros_like(v)
        force[driven] = applied(spacecraft.reduced_mass_matrix, self.k_v * (rates - v[driven]))
        force[driven] += bias
        own = spacecraft.mass_matrix[_BASE]
        regressor = self._regressor(q, v)
        by_base = np.linalg.solve(own[:, _BASE], regressor)
        rate = by_base[_TURN].T @ e_b + by_base.T @ (point.whole_jacobian[:, _BASE].T @ point.e)
        rate = rate - self.prediction * (regressor.T @ applied(own, v))
        sizes = np.repeat([self.mass_rate, self.moment_rate, self.inertia_rate], [1, 3, 6])
        return force, {
            "payload_change": change + self.sample_time * sizes * rate,
            "smallest_singular_value": smallest,
        }

    def _rates(
        self,
        reaction: np.ndarray,
        jacobian: np.ndarray,
        base: np.ndarray,
        twist: np.ndarray,
        plan: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """v_r (nj), and the smallest singular value (1) of J* N.

        Args: F_r (3, nj), J* (m, nj), b (3), x (m) and z (nj).
        """
        left, sizes, right = np.linalg.svd(reaction, full_matrices=False)
        inverse = damped_inverse(sizes, self.reaction_damping)
        rates = plan + applied(right.T, inverse * applied(left.T, base - applied(reaction, plan)))
        free = np.eye(plan.size) - (right.T * (inverse * sizes)) @ right
        left, sizes, right = np.linalg.svd(jacobian @ free, full_matrices=False)
        lacking = applied(left.T, twist - applied(jacobian, rates))
        rates = rates + applied(right.T, damped_inverse(sizes, self.damping) * lacking)
        return rates, sizes.min(keepdims=True)

    def _regressor(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """W (6, 10) of the momentum about the base's origin."""
        about_world = self.payload.momentum_regressor(q, v)
        linear = about_world[3:]
        return np.concatenate([about_world[:3] - skew(q[4:NUM_BASE_POSITIONS]) @ linear, linear])

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> ControlLaw:
        """See ControlLaw. Raises ModelError also: there is no such frame, or no payload."""
        task_space, payload = TaskSpace.from_setup(setup), Payload.from_setup(setup)
        law = cls(**field_values(cls, setup, task_space=task_space, payload=payload))
        if task_space.driven[0] >= NUM_BASE_VELOCITIES:
            return law
        names = ("k_p_rotation", "k_p_position", "k_v", "k_p_plan", "speed_limit", "damping")
        return ResolvedRate(task_space=task_space, **{name: getattr(law, name) for name in names})
