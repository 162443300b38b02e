"""Planning a motion to rest within every limit: the optimal control problem, its solution, and what
it leaves.
"""

from ffsm_drake.plugins.planning.planner import (
    PlannedMotionReport,
    PlanningError,
    plan_motion,
)

__all__ = ["PlannedMotionReport", "PlanningError", "plan_motion"]
