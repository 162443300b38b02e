"""A plan, with what it takes and its margins to the limits."""

import dataclasses

import numpy as np

from ffsm_drake.plugins.planning.motion_limits import Margin, MotionLimits
from ffsm_drake.systems.plan import Plan


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PlannedMotionReport:
    """A plan, and what it takes."""

    plan: Plan
    solve_time: float  # s of wall time
    evaluations: int
    effort: float  # integral of the squared force, up to the plan's duration, as in ISV
    # by group: integral of the force's size summed over its coordinates, up to the duration
    impulse: dict[str, float]
    # |H0| about the centre of mass, N m s, and the least time in which torque on the base alone
    # takes it out, s
    angular_momentum: float
    least_by_torque: float
    momentum_left: float  # N m s; |H| about the centre of mass at ``plan.duration``
    # rad; the largest, where momentum turns the base, from its first attitude
    base_turn: float | None
    margins: tuple[Margin, ...]
    times: np.ndarray  # (n,), s, to the end of the plan
    rows: np.ndarray  # [q_d; v_d; dv_d/dt] (n, nq + 2 nv)
    force: np.ndarray  # (n, nv), N m and N
    limits: MotionLimits

    @property
    def last(self) -> np.ndarray:
        """q (nq) at ``plan.duration``."""
        row: np.ndarray = self.rows[self.times <= self.plan.duration][-1]
        return row[: self.force.shape[1] + 1]

    @property
    def exceeded(self) -> list[Margin]:
        """Limits that the plan does not keep."""
        return [margin for margin in self.margins if not margin.kept]
