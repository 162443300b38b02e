"""Model-predictive control: a quadratic program about the linear stack at every sample.

With the plant linearised by its inverse dynamics, an error obeys e'' = -u, and the force of the
acceleration a_d + u is H (a_d + u) - H N, with the present nominal H, and the lumped uncertainty N
of the scenario's estimator, which makes the law free of offset. Over N steps of T,

    minimise    sum_k |e_k|^2_Q + |e'_k|^2_Q' + |u_k|^2_R  + terminal cost,
    subject to  force, joint rates, wheel torque and wheel momentum within their limits.

The limits of force and wheel torque at the first step are hard, so that what is commanded keeps to
them. All others are soft, with one slack for each kind: no start is without a solution.

Dual mode (Rossiter, Kouvaritakis, Rice, "A numerically robust state-space approach to stable
predictive control strategies", Automatica 34 (1998) 65):
u_k = -K x_k + c_k with the gain K and the terminal cost of the infinite horizon, and the c_k as
unknowns, whose cost is sum_k |c_k|^2_(R + B^T P B). Where no limit is active every c_k is zero,
the law is the linear-quadratic regulator, and no program is solved. The program is small, dense and
condensed; Clarabel, which comes with Drake, solves it.

The bound on a sample's time is one on Clarabel's iterations, so that the same seed gives the same
bits. Past it, and if the limits allow no force at all, the law falls back on the regulator's force,
cut to the limits of force; ``fallbacks`` counts it.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Self

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.solvers import ClarabelSolver, MathematicalProgram, SolverOptions
from pydrake.systems.controllers import DiscreteTimeLinearQuadraticRegulator

from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.limits import FORCE, RATE, Limit, tightest, urdf_limits
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.estimation import Estimator, make_estimator
from ffsm_drake.systems.controllers.law import (
    ControlLaw,
    Sample,
    State,
    field_values,
    gain,
    step_each,
)
from ffsm_drake.systems.controllers.time_delay import after_grasp
from ffsm_drake.systems.setup import BlockSetup

_STEPS = 5  # predicted steps, each with an unknown c_k
_SLACK = 1e6  # cost of exceeding a limit after the first step by the limit itself


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Limits:
    """The limits of the program; infinite where there is none."""

    force: np.ndarray  # (nv) N m, N
    rate: np.ndarray  # (nv) rad/s, m/s
    # wheels (nw): motor torque per torque on the base, in its axes (nw, 3); N m; N m s
    share: np.ndarray
    torque: np.ndarray
    momentum: np.ndarray
    initial_momentum: np.ndarray

    @classmethod
    def of(cls, scenario: Scenario, coordinates: Coordinates, urdf: list[Limit]) -> Self:
        """The limits of a scenario: ``actuation.limit``, drives, URDFs, wheels."""
        limit, drives, wheels = scenario.actuation.limit, scenario.drives, scenario.wheels
        size = len(coordinates.names)
        force, rate = np.full((2, size), np.inf)
        if limit is not None:
            force = coordinates.vector(limit, key="actuation.limit", default=np.inf)
        if drives is not None and drives.rate_limit is not None:
            key = "actuation.drives.rate_limit"
            joints = coordinates.joint_vector(drives.rate_limit, key=key, default=np.inf)
            rate = np.concatenate([np.full(size - joints.size, np.inf), joints])
        units = () if wheels is None else tuple(wheels.units.values())
        axes = np.array([np.divide(unit.axis, np.linalg.norm(unit.axis)) for unit in units])
        return cls(
            force=np.minimum(force, tightest(urdf, FORCE).upper),
            rate=np.minimum(rate, tightest(urdf, RATE).upper),
            share=-np.linalg.pinv(axes.reshape(-1, 3).T),
            torque=np.array([unit.torque_limit for unit in units]),
            momentum=np.array([unit.inertia * unit.speed_limit for unit in units]),
            initial_momentum=np.array([unit.initial_momentum for unit in units]),
        )


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Rows:
    """Limited quantities along the prediction: map c + offset, within +-bound."""

    map: np.ndarray  # (N, m, N, nv)
    offset: np.ndarray  # (N, m), at c = 0
    bound: np.ndarray  # (m)
    hard: int = 0  # number of first steps at which the limit is hard


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mpc(ControlLaw):
    """tau = H (a_d - K x + c - N), with c of a quadratic program where a limit is active.

    A linearisation about the plan, such as that of ``ffsm stability``, is that of the regulator
    with the estimate, without limits. The memory ``programs`` counts the programs, ``fallbacks``
    those without a solution.
    """

    model: PlantModel
    sample_time: float
    estimator: Estimator
    limits: Limits
    prediction_step: float = gain(
        0.1, "s", "step T of the prediction", scalar=True, positive=True, feedback=False
    )
    error_size: np.ndarray = gain(1e-3, "rad or m", "error that weighs 1", positive=True)
    rate_size: np.ndarray = gain(2e-3, "rad/s or m/s", "error rate that weighs 1", positive=True)
    acceleration_size: np.ndarray = gain(
        0.02, "rad/s^2 or m/s^2", "acceleration u that weighs 1", positive=True
    )
    iterations: float = gain(
        30.0, "", "bound on the iterations of a program, which takes about 10", scalar=True,
        positive=True, feedback=False,
    )  # fmt: skip

    @functools.cached_property
    def regulator(self) -> np.ndarray:
        """K (nv, 2) of u = -K [e; e'], and the weight R + B^T P B (nv) as a third column."""
        T = self.prediction_step
        a, b = np.array([[1.0, T], [0.0, 1.0]]), np.array([[-0.5 * T * T], [-T]])
        rows = []
        for e, rate, u in zip(self.error_size, self.rate_size, self.acceleration_size, strict=True):
            q, r = np.diag([e**-2.0, rate**-2.0]), np.array([[u**-2.0]])
            k, p = DiscreteTimeLinearQuadraticRegulator(a, b, q, r)
            rows.append([*k[0], (r + b.T @ p @ b)[0, 0]])
        return np.array(rows)

    @functools.cached_property
    def prediction(self) -> tuple[np.ndarray, np.ndarray]:
        """[e'_k; u_k] from x_0 (2, N + 1, nv, 2) and from c (2, N + 1, N, nv), k = 0 ... N."""
        T, k = self.prediction_step, self.regulator
        size = len(k)
        e, rate = np.zeros((2, size, 2 + _STEPS))  # rows of [e, e', c_0, ...]
        e[:, 0] = rate[:, 1] = 1.0
        found = np.empty((2, _STEPS + 1, size, 2 + _STEPS))
        for step in range(_STEPS + 1):
            u = -k[:, :1] * e - k[:, 1:2] * rate
            if step < _STEPS:
                u[:, 2 + step] += 1.0
            found[:, step] = rate, u
            e, rate = e + T * rate - 0.5 * T * T * u, rate - T * u
        return found[..., :2], np.moveaxis(found[..., 2:], 3, 2)

    def initial_state(self) -> State:
        return {
            **self.estimator.initial_state(),
            "wheel_momentum": self.limits.initial_momentum,
            "programs": np.zeros(1),
            "fallbacks": np.zeros(1),
        }

    def held(self) -> Mapping[str, float | None]:
        return dict.fromkeys(("wheel_momentum", "programs", "fallbacks"))

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        if sample.v.ndim > 1:
            return step_each(self, sample, state)
        H = self.model.calc_mass_matrix(sample.q)
        estimate, memory = self.estimator.step(sample, H, state)
        known = estimate.base_force + H @ (sample.a_d - estimate.base_acceleration)
        R_WB = RotationMatrix(Quaternion(sample.q[:4] / np.linalg.norm(sample.q[:4]))).matrix()
        motor = self.limits.share @ R_WB.T  # (nw, 3), from the base's torque in world axes
        momentum = state["wheel_momentum"] + self.sample_time * motor @ sample.applied_force[:3]
        x = np.stack([estimate.e, estimate.e_dot], axis=-1)
        c, solved = self._planned(self._rows(sample, x, H, known, motor, momentum))
        force = known + H @ (-(self.regulator[:, :2] * x).sum(axis=-1) + c)
        force = np.clip(force, -self.limits.force, self.limits.force)
        return force, {
            **memory,
            "wheel_momentum": momentum,
            "programs": state["programs"] + float(solved is not None),
            "fallbacks": state["fallbacks"] + float(solved is False),
        }

    def resume(self, state: State, before: ControlLaw, reference: np.ndarray) -> State:
        """See ControlLaw; of the estimator as in ``TimeDelayControl``."""
        if not isinstance(before, Mpc):
            return state
        ratio, v_d = after_grasp(self.model, before.model, reference)
        return {**state, **self.estimator.resume(state, ratio, v_d)}

    def _rows(
        self,
        sample: Sample,
        x: np.ndarray,
        H: np.ndarray,
        known: np.ndarray,
        motor: np.ndarray,
        momentum: np.ndarray,
    ) -> "list[_Rows]":
        """The limited quantities of the prediction, by kind."""
        limits, found = self.limits, list[_Rows]()
        from_x, from_c = self.prediction
        free = (from_x * x).sum(axis=-1)  # (2, N + 1, nv)
        rows = np.flatnonzero(np.isfinite(limits.force))
        if rows.size:
            force = np.einsum("ij,kfj->kifj", H[rows], from_c[1, :-1])
            offset = known[rows] + free[1, :-1] @ H[rows].T
            found.append(_Rows(map=force, offset=offset, bound=limits.force[rows], hard=1))
        rows = np.flatnonzero(np.isfinite(limits.rate))
        if rows.size:
            ahead = self.prediction_step * np.arange(1, _STEPS + 1)[:, None]
            planned = sample.v_d + ahead * sample.a_d
            rates = np.zeros((_STEPS, rows.size, *from_c.shape[2:]))
            rates[:, np.arange(rows.size), :, rows] = -from_c[0, 1:, :, rows]
            offset = (planned - free[0, 1:])[:, rows]
            found.append(_Rows(map=rates, offset=offset, bound=limits.rate[rows]))
        if limits.torque.size:
            share = motor @ H[:3]
            torque = np.einsum("ij,kfj->kifj", share, from_c[1, :-1])
            offset = motor @ known[:3] + free[1, :-1] @ share.T
            found.append(_Rows(map=torque, offset=offset, bound=limits.torque, hard=1))
            stored = self.prediction_step * np.cumsum(torque, axis=0)
            offset = momentum + self.prediction_step * np.cumsum(offset, axis=0)
            found.append(_Rows(map=stored, offset=offset, bound=limits.momentum))
        return found

    def _planned(self, rows: "list[_Rows]") -> tuple[np.ndarray, bool | None]:
        """c_0 (nv), and whether a program was solved; None: none was needed."""
        size = len(self.error_size)
        if all((np.abs(each.offset) <= each.bound).all() for each in rows):
            return np.zeros(size), None
        program = MathematicalProgram()
        c = program.NewContinuousVariables(_STEPS * size)
        slack = program.NewContinuousVariables(len(rows))
        # c in units of its weight, quantities in units of their limits
        scale = np.tile(self.regulator[:, 2], _STEPS) ** -0.5
        program.AddQuadraticCost(np.eye(c.size), np.zeros(c.size), c, is_convex=True)
        program.AddLinearCost(np.full(slack.size, _SLACK), slack)
        program.AddBoundingBoxConstraint(0.0, np.inf, slack)
        for each, own in zip(rows, slack, strict=True):
            matrix = (each.map / each.bound[:, None, None]).reshape(-1, c.size) * scale
            offset, hard = (each.offset / each.bound).ravel(), each.hard * each.bound.size
            if hard:
                program.AddLinearConstraint(
                    matrix[:hard], -1.0 - offset[:hard], 1.0 - offset[:hard], c
                )
            soft, offset = matrix[hard:], offset[hard:]
            endless, variables = np.full(offset.size, np.inf), np.append(c, own)
            for sign in (1.0, -1.0):
                over = np.column_stack([sign * soft, -np.ones(offset.size)])
                program.AddLinearConstraint(over, -endless, 1.0 - sign * offset, variables)
        solver, options = ClarabelSolver(), SolverOptions()
        options.SetOption(solver.solver_id(), "max_iter", max(1, round(self.iterations)))
        result = solver.Solve(program, None, options)
        if not result.is_success():
            return np.zeros(size), False
        return (result.GetSolution(c) * scale)[:size], True

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> Self:
        """See ControlLaw. Raises ModelError also: a URDF's limits cannot be read."""
        urdf = urdf_limits(setup.scenario.model, setup.nominal.plant)
        limits = Limits.of(setup.scenario, setup.coordinates, urdf)
        estimator = make_estimator(setup.scenario, setup.coordinates)
        return cls(**field_values(cls, setup, limits=limits, estimator=estimator))
