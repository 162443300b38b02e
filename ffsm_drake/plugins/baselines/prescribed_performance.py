"""Prescribed performance control with time-delay estimation and a compensator of saturation.

The idea is that of Yan, Cui, Han, "Fixed-time control for free-floating space manipulators with
prescribed constraints and input saturation", The Aeronautical Journal (2023): a transformation of
tangent type keeps the error within bounds, and an auxiliary system compensates for saturation.
Only the abstract and the list of symbols of this paper were read. The equations are not copied from
it, but are the common forms of both methods: the performance function of Bechlioulis, Rovithakis,
"Robust adaptive control of feedback linearizable MIMO nonlinear systems with prescribed
performance", IEEE Transactions on Automatic Control 53 (2008) 2090, doi:10.1109/TAC.2008.929402,
and a linear auxiliary system as in Chen, Ge, Ren, "Adaptive tracking control of uncertain MIMO
nonlinear systems with input constraints", Automatica 47 (2011) 452,
doi:10.1016/j.automatica.2011.01.025. The fixed-time surface and the adaptation of the paper are
left out.

The funnel |e| < rho narrows with rho = rho_inf + (rho_0 - rho_inf) exp(-c t), and

    epsilon = (2 rho_inf / pi) tan(pi e / (2 rho)),
    w = e' - e rho'/rho,     epsilon' = r w,     r = (rho_inf / rho) / cos^2(pi e / (2 rho)),
    s = w + Lambda epsilon,
    u = a_d - (e rho'/rho)' + Lambda r w + K_s (s + xi) - A xi,
    xi' = -A xi + Hhat^-1 (applied force - commanded force),

so that (s + xi)' = -K_s (s + xi) - Ntilde. Without saturation |s| stays below S = max(|s(0)|,
max |Ntilde| / K_s), and |epsilon| below max(|epsilon(0)|, S / Lambda): the error remains within
the funnel. Saturation makes s differ from s + xi, which voids this bound.

In the sampled loop, the tangent continues as its tangent line beyond a share ``edge`` of the
funnel. This bounds the gains, and defines the law outside the funnel.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ffsm_drake.systems.controllers.law import Sample, State, gain
from ffsm_drake.systems.controllers.time_delay import (
    InjectedDynamics,
    TimeDelayControl,
)
from ffsm_drake.systems.setup import BlockSetup


@dataclasses.dataclass(frozen=True, kw_only=True)
class PrescribedPerformance(InjectedDynamics):
    """Prescribed performance control: the error stays in a funnel that narrows with time.

    s = e' - e rho'/rho + Lambda epsilon, with epsilon of the form tan(pi e / (2 rho)). Gains are
    diagonals (nv). The funnel begins anew at a grasp.

    A linearisation about the plan, for example by ``ffsm stability``, uses the final funnel and its
    middle, where epsilon = e: the gains are K_P = K_s Lambda and K_D = K_s + Lambda. Gains near
    the edge of the funnel are larger, and are not part of it.
    """

    by_axis: ClassVar[bool] = False  # Hhat^-1 of the compensator couples the coordinates
    sample_time: float
    rho_start: np.ndarray = gain(
        0.1, "rad or m", "half width rho_0 of the funnel at the start", positive=True
    )
    rho_end: np.ndarray = gain(
        0.01, "rad or m", "half width rho_inf of the funnel at the end", positive=True
    )
    decay: np.ndarray = gain(0.5, "1/s", "rate c at which the funnel narrows", feedback=False)
    slope: np.ndarray = gain(10.0, "1/s", "gain Lambda on the transformed error")
    k_s: np.ndarray = gain(20.0, "1/s", "reaching gain K_s")
    forgetting: np.ndarray = gain(
        2.0, "1/s", "rate A at which the compensator forgets a saturation", feedback=False
    )
    edge: float = gain(
        0.8, "", "share of the funnel, below 1, beyond which gains are constant", scalar=True,
        positive=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        if not np.all(self.edge < 1.0):
            raise ValueError(f"edge must be below 1, not {self.edge}")
        if not np.all(self.rho_end <= self.rho_start):
            raise ValueError("rho_end must be at most rho_start, for each coordinate")

    def initial_state(self) -> State:
        zeros = np.zeros_like(self.k_s)
        return {
            "sliding_variable": zeros,
            "funnel_excess": np.ones_like(self.k_s),  # (rho - rho_inf) / (rho_0 - rho_inf)
            "lost_velocity": zeros,  # xi
            "lost_acceleration": zeros,  # Hhat^-1 (applied force - commanded force)
        }

    def held(self) -> Mapping[str, float | None]:
        return {"funnel_excess": 0.0}

    @classmethod
    def gains_for(cls, omega: Any, k_s: Any) -> dict[str, Any]:
        return {"slope": omega, "k_s": omega}

    def resume(self, state: State, ratio: np.ndarray) -> State:
        """See InjectedDynamics. The funnel and the compensator begin anew."""
        start = self.initial_state()
        return {name: start[name] for name in ("funnel_excess", "lost_velocity")}

    def step(
        self, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, state: State
    ) -> tuple[np.ndarray, State]:
        """One control sample; see InjectedDynamics. ``lost_acceleration`` is that of the last
        period.
        """
        excess = state["funnel_excess"]
        rho = self.rho_end + (self.rho_start - self.rho_end) * excess
        # rho'/rho, and its derivative
        narrowing = self.decay * (self.rho_end / rho - 1.0)
        change = -narrowing * (self.decay + narrowing)
        epsilon, r = self._transformed(e, rho)
        w = e_dot - e * narrowing
        s = w + self.slope * epsilon
        xi = state["lost_velocity"] + self.sample_time * state["lost_acceleration"]
        u = a_d - e_dot * narrowing - e * change + self.slope * (r * w)
        u = u + self.k_s * (s + xi) - self.forgetting * xi
        return u, {
            "sliding_variable": s,
            "funnel_excess": excess * np.exp(-self.decay * self.sample_time),
            "lost_velocity": xi - self.sample_time * self.forgetting * xi,
            "lost_acceleration": state["lost_acceleration"],
        }

    def _transformed(self, e: np.ndarray, rho: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """epsilon and r = epsilon' / w, (..., nv)."""
        share = e / rho
        within = np.minimum(np.maximum(share, -self.edge), self.edge)
        tangent = np.tan(0.5 * np.pi * within)
        steepness = 1.0 + tangent * tangent
        epsilon = self.rho_end * (2.0 / np.pi * tangent + steepness * (share - within))
        return epsilon, self.rho_end / rho * steepness

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> "CompensatedControl":
        """See InjectedDynamics; the compensator is part of it."""
        given = super().from_setup(setup)
        return CompensatedControl(
            model=given.model, estimator=given.estimator, dynamics=given.dynamics
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompensatedControl(TimeDelayControl):
    """Time-delay control that tells its dynamics what acceleration saturation took."""

    def initial_state(self) -> State:
        state = super().initial_state()
        return {**state, "commanded_force": np.zeros_like(state["lost_velocity"])}

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        lost = np.zeros_like(sample.v)
        if not sample.is_first:
            missing = sample.applied_force - state["commanded_force"]
            missing = np.where(self.model.coordinates.is_driven, missing, 0.0)
            lost = np.linalg.solve(self.model.calc_mass_matrix(sample.q), missing)
        force, memory = super().step(sample, {**state, "lost_acceleration": lost})
        return force, {**memory, "commanded_force": force}
