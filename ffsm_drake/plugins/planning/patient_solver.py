"""SNOPT, stopped once it has stopped gaining."""

from collections.abc import Callable

import numpy as np
from pydrake.solvers import MathematicalProgram, SnoptSolver, SolverOptions

# The solver is stopped when merit falls by less than a share in so many evaluations.
_GAIN, _PATIENCE, _MOST = 1e-3, 100, 1000
_PENALTY = 10.0  # merit: relative increase of the cost by violation of constraints
# SNOPT would forget after 10 updates, and take thousands of iterations to least effort.
_OPTIONS = {"Major iterations limit": 1000, "Iterations limit": 100_000, "Hessian updates": 200}


class _NoGainError(Exception):
    """The solver has stopped gaining, or its time is over."""


class PatientSolver:
    """Solves a program, and keeps the best of the solver's iterates."""

    def __init__(
        self,
        program: MathematicalProgram,
        *,
        cost: Callable[[np.ndarray], float],
        evaluations: Callable[[], int],
        is_over: Callable[[], bool],
    ) -> None:
        """Args:
        program: whose constraints and cost are complete.
        cost: at values of the program's variables.
        evaluations: their number so far.
        is_over: True to end the search with its best.
        """
        self._program, self._cost = program, cost
        self._evaluations, self._is_over = evaluations, is_over
        program.AddVisualizationCallback(self._watch, program.decision_variables())

    def solve(self, first: np.ndarray, tolerance: float) -> tuple[np.ndarray, str]:
        """Return the best values found, with the solver's message.

        Args: values to begin with; the tolerance of optimality.
        """
        chosen, options = SnoptSolver(), SolverOptions()
        for key, value in (_OPTIONS | {"Major optimality tolerance": tolerance}).items():
            options.SetOption(chosen.solver_id(), key, value)
        self._best, self._least = first, float("inf")
        self._begun = self._gained = self._evaluations()
        self._mark = self._least
        try:
            result = chosen.Solve(self._program, first, options)
        except RuntimeError as error:
            if _NoGainError.__name__ not in str(error):
                raise
            return self._best, "no gain"
        return self._best, result.get_solution_result().name.removeprefix("k")

    def _watch(self, x: np.ndarray) -> None:
        """Keep the best of the solver's iterates, and stop the solver without further
        improvement.
        """
        beyond, evaluations = 0.0, self._evaluations
        program = self._program
        for binding in program.generic_constraints() + program.quadratic_constraints():
            value, evaluator = program.EvalBinding(binding, x), binding.evaluator()
            sides = np.r_[value - evaluator.upper_bound(), evaluator.lower_bound() - value]
            beyond = max(beyond, float(np.max(sides)))
        merit = self._cost(x) * (1.0 + _PENALTY * beyond)
        if merit < self._least:
            self._best, self._least = x.copy(), merit
        if merit < self._mark * (1.0 - _GAIN):
            self._mark, self._gained = merit, evaluations()
        is_stuck = evaluations() > min(self._gained + _PATIENCE, self._begun + _MOST)
        if is_stuck or self._is_over():
            raise _NoGainError
