"""Friction of hands: the share of it that a wrench uses, and the least preload within it.

A pad with the normal n into the target, the coefficient mu and the radius r bears the force f and
the moment m of the hand on the target, if with the normal force N

    |f_t| / mu + |m_n| / gamma <= N,    |m_t| <= r N,    gamma = 2 mu r / 3.

The first line is a soft finger (Murray, Li and Sastry, A Mathematical Introduction to Robotic
Manipulation, 1994, chapter 5), with the sum of Prattichizzo and Trinkle (Springer Handbook of
Robotics, chapter Grasping), which is within the ellipse of the limit surface. gamma is that of a
uniform pressure. In the second line, the centre of pressure is on the pad. One pad has N = n.f. Two
opposite pads that the force s closes have N = 2 s - |n.f| and |n.f| <= s, as the force of one of
them is s.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from pydrake.solvers import ClarabelSolver, MathematicalProgram, SolutionResult

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.scenario.contacts import Friction

_LOST = 1000.0  # share without a normal force
_WITHIN = 1.0 - 1e-6  # of a share, for the accuracy of the solver
_NONE = 1e-6  # N or N m; a smaller preload is none
_UNLOADED = 1e-9  # N; a hand with less has nothing to hold
_MOST = 1e9  # N m or N; a larger limit of a joint is none, for the accuracy of the solver
_SIGNS = (1.0, -1.0)
_IMPOSSIBLE = (
    SolutionResult.kInfeasibleConstraints,
    SolutionResult.kInfeasibleOrUnbounded,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cone:
    """The friction of a hand."""

    axes: np.ndarray  # (3, 3) rows: unit vectors along the normal and across it, in the hand's axes
    coefficient: float
    radius: float  # m
    squeeze: float  # N; 0: one pad

    @classmethod
    def of(cls, given: Friction) -> "Cone":
        """The friction of a scenario."""
        axes = np.linalg.svd(np.array([given.axis]))[2]
        axes[0] = np.array(given.axis) / np.linalg.norm(given.axis)
        return cls(
            axes=axes,
            coefficient=given.coefficient,
            radius=given.radius,
            squeeze=given.squeeze,
        )

    @property
    def torsion(self) -> float:
        """Largest moment about the normal by normal force, m."""
        return 2.0 / 3.0 * self.coefficient * self.radius

    def used(self, wrench: np.ndarray) -> np.ndarray:
        """The used share (...) of moments and forces (..., 6): 1 where the hand begins to slip."""
        about, *tilting = np.moveaxis(wrench[..., :3] @ self.axes.T, -1, 0)
        along, *across = np.moveaxis(wrench[..., 3:] @ self.axes.T, -1, 0)
        needed = np.maximum(
            np.hypot(*across) / self.coefficient + np.abs(about) / self.torsion,
            np.hypot(*tilting) / self.radius,
        )
        s = self.squeeze
        pressed = 2.0 * s - np.abs(along) if s else along
        is_lost, is_loaded = pressed <= needed / _LOST, np.maximum(needed, -pressed) > _UNLOADED
        share = np.where(is_lost, _LOST * is_loaded, needed / np.where(is_lost, 1.0, pressed))
        return np.maximum(share, np.abs(along) / s) if s else share

    def cones(self, share: float) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
        """A (3, 6), b (3) and c: a wrench w and a further normal force e use at most a share, if
        the first entry of A w + b + [c e, 0, 0] is at least the norm of the others, for each.
        """
        (n, *across), zero, s = self.axes, np.zeros(3), self.squeeze
        about, along = np.r_[n, zero], np.r_[zero, n]
        tilting = [np.r_[each, zero] for each in across]
        sliding = [np.r_[zero, each] for each in across]
        for sign in _SIGNS if s else (-1.0,):
            pressed, least = -share * sign * along, 2.0 * share * s
            for turn in _SIGNS:
                first = self.coefficient * (pressed - turn / self.torsion * about)
                given = self.coefficient * np.array([least, share])
                yield np.array([first, *sliding]), np.r_[given[0], 0.0, 0.0], float(given[1])
            yield (
                self.radius * np.array([pressed, *(each / self.radius for each in tilting)]),
                np.r_[self.radius * least, 0.0, 0.0],
                self.radius * share,
            )
            if s:
                yield (
                    np.array([-sign * along, about * 0.0, about * 0.0]),
                    np.r_[share * s, 0.0, 0.0],
                    1.0,
                )


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Hand:
    """What a hand bears in a motion: ``load`` + ``map`` P with the preload P (m)."""

    name: str
    load: np.ndarray  # (n, 6) on the target, in the axes of its place
    map: np.ndarray  # (6, m)
    cone: Cone | None
    limit: np.ndarray  # (6) N m and N; infinite: none

    def wrench(self, preload: np.ndarray) -> np.ndarray:
        """The wrench (n, 6) with a preload (m)."""
        return self.load + self.map @ preload


def least_preload(
    hands: Sequence[Hand],
    torque: np.ndarray,
    jacobians: np.ndarray,
    limit: np.ndarray,
    *,
    share: float,
) -> np.ndarray:
    """Return the preload P (m) of the least norm, 1 N m counted as 1 N, with which no hand uses
    more than a share of its friction, within the limits of hands and joints.

    If there is none, return the preload that needs the least further normal force at all hands; and
    zeros if the limits allow none. Raises ScenarioError: the solver fails.

    Args: the hands; torques tau (n, nv) without preload, which adds A' P; A (n, m, nv); the limits
      of torques (nv); the share.
    """
    size = jacobians.shape[1]
    for is_strict in (True, False):
        program = MathematicalProgram()
        x = program.NewContinuousVariables(size + 1)  # P, and its norm or the further force
        program.AddLinearCost(x[-1])
        if is_strict:
            program.AddLorentzConeConstraint(
                np.roll(np.eye(size + 1), 1, axis=0), np.zeros(size + 1), x
            )
        else:
            program.AddBoundingBoxConstraint(0.0, np.inf, x[-1:])
        for hand in hands:
            _bound(program, x[:-1], hand.map, hand.load, hand.limit)
            cones = () if hand.cone is None else hand.cone.cones(_WITHIN * share)
            for (A, b, further), load in itertools.product(cones, hand.load):
                column = np.array([[0.0 if is_strict else further], [0.0], [0.0]])
                program.AddLorentzConeConstraint(np.hstack([A @ hand.map, column]), A @ load + b, x)
        for A, own in zip(jacobians, torque, strict=True):
            _bound(program, x[:-1], A.T, own[None], limit)
        found = ClarabelSolver().Solve(program)
        if found.is_success():
            preload: np.ndarray = found.GetSolution(x[:-1])
            return preload if np.linalg.norm(preload) > _NONE else np.zeros(size)
        if found.get_solution_result() not in _IMPOSSIBLE:
            reason = f"null: the search fails ({found.get_solution_result().name[1:]}); give one"
            raise ScenarioError("chain.force.preload", reason)
    return np.zeros(size)


def _bound(
    program: MathematicalProgram,
    x: np.ndarray,
    A: np.ndarray,
    values: np.ndarray,
    limit: np.ndarray,
) -> None:
    """Keep values (n, k) + A x within limits (k)."""
    own = (limit < _MOST) & A.any(axis=1)
    if own.any():
        lower, upper = (-limit - values).max(axis=0), (limit - values).min(axis=0)
        program.AddLinearConstraint(A[own], lower[own], upper[own], x)
