"""Model-predictive control: a quadratic program about the linear stack at every sample.

With the plant linearised by its inverse dynamics, an error obeys e'' = -u, and the force of the
acceleration a_d + u is H (a_d + u) - H N, with the present nominal H, and the lumped uncertainty N
of the scenario's estimator, which makes the law free of offset. Over N steps of T,

    minimise    sum_k |e_k|^2_Q + |e'_k|^2_Q' + |u_k|^2_R  + terminal cost,
    subject to  force, joint rates, wheel torque and wheel momentum within their limits.

The limits of force and wheel torque at the first step are hard, so that what is commanded keeps to
them; so is what thrusters give, each an unknown between closed and open. All others are soft, with
one slack for each kind: no start is without a solution.

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
from typing import ClassVar, Self

import numpy as np
from pydrake.solvers import ClarabelSolver, MathematicalProgram, SolverOptions
from pydrake.systems.controllers import DiscreteTimeLinearQuadraticRegulator
from scipy.optimize import nnls

from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.mission import Mission
from ffsm_drake.scenario import Scenario, thrusters_of
from ffsm_drake.spacecraft.limits import FORCE, RATE, tightest
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.estimation import Estimator, make_estimator
from ffsm_drake.systems.controllers.law import (
    ControlLaw,
    Sample,
    State,
    field_values,
    gain,
)
from ffsm_drake.systems.controllers.time_delay import after_grasp
from ffsm_drake.systems.mission_limits import joint_limits
from ffsm_drake.systems.setup import BlockSetup

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
    # thrusters that work (6, nt): torque and force of each if open, base's axes; wheels beside them
    # take their torque
    jets: np.ndarray

    @classmethod
    def of(cls, mission: Mission) -> Self:
        """The limits of a mission: ``actuation.limit``, drives, URDFs, wheels."""
        scenario, coordinates = mission.scenario, mission.craft.coordinates
        limit, wheels = scenario.actuation.limit or {}, scenario.wheels
        force = coordinates.vector(limit, key="actuation.limit", default=np.inf)
        of_joints = joint_limits(mission)
        units = () if wheels is None else tuple(wheels.units.values())
        axes = np.array([np.divide(unit.axis, np.linalg.norm(unit.axis)) for unit in units])
        return cls(
            force=np.minimum(force, tightest(of_joints, FORCE).upper),
            rate=tightest(of_joints, RATE).upper,
            share=-np.linalg.pinv(axes.reshape(-1, 3).T),
            torque=np.array([unit.torque_limit for unit in units]),
            momentum=np.array([unit.inertia * unit.speed_limit for unit in units]),
            initial_momentum=np.array([unit.initial_momentum for unit in units]),
            jets=_jets(scenario, with_torque=not units),
        )

    @functools.cached_property
    def exist(self) -> bool:
        """Whether there is a limit."""
        given = np.isfinite(np.concatenate([self.force, self.rate])).any()
        return bool(given) or bool(self.torque.size) or bool(self.jets.size)

    @functools.cached_property
    def idle(self) -> np.ndarray:
        """Shares (nt) of the thrusters, all above zero, that give no wrench; empty: there are none,
        or they are not known.
        """
        count = self.jets.shape[1]
        more, rest = nnls(self.jets, -self.jets.sum(axis=1)) if count else (np.zeros(0), np.inf)
        return 1.0 + more if rest < 1e-9 * np.abs(self.jets).sum() else np.zeros(0)

    def jets_give(self, wrench: np.ndarray) -> bool:
        """Whether thrusters give wrenches (n, 6), by their least squares and ``idle``; True without
        thrusters.
        """
        if not self.jets.size:
            return True
        share = wrench @ np.linalg.pinv(self.jets).T
        if not self.idle.size or not np.allclose(share @ self.jets.T, wrench, atol=1e-9):
            return False
        least = (-share / self.idle).max(axis=1)
        most = ((1.0 - share) / self.idle).min(axis=1)
        return bool((np.maximum(least, 0.0) <= most).all())


def _jets(scenario: Scenario, *, with_torque: bool) -> np.ndarray:
    settings = scenario.actuation.thrusters
    units = {} if settings is None else thrusters_of(settings)
    columns = []
    for name, unit in units.items():
        if settings is None or settings.failures.get(name):
            continue
        force = unit.force * np.divide(unit.direction, np.linalg.norm(unit.direction))
        columns.append(np.concatenate([with_torque * np.cross(unit.position, force), force]))
    return np.array(columns).reshape(-1, 6).T


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Rows:
    """Limited quantities along the prediction: map c + offset, within +-bound."""

    map: np.ndarray  # (N, m, N, nv)
    offset: np.ndarray  # (N, m), at c = 0
    bound: np.ndarray  # (m)
    hard: int = 0  # number of first steps at which the limit is hard
    # (m, nt) per open thruster: the quantities are what these give; the bound is a unit only
    given: np.ndarray | None = None

    def is_kept(self, limits: Limits) -> bool:
        """Whether c = 0 keeps to the limits."""
        if self.given is None:
            return bool((np.abs(self.offset) <= self.bound).all())
        used = np.abs(limits.jets).sum(axis=1) > 0.0
        wrench = np.zeros((len(self.offset), 6))
        wrench[:, used] = self.offset
        return limits.jets_give(wrench)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Now:
    """The start of a program."""

    x: np.ndarray  # (nv, 2) estimated error and its rate
    mass_matrix: np.ndarray  # (nv, nv)
    known: np.ndarray  # (nv) force of the planned acceleration, the estimate included
    rotation: np.ndarray  # R_WB
    momentum: np.ndarray  # (nw) of the wheels


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mpc(ControlLaw):
    """Model-predictive control that respects limits, by a quadratic program about the plan.

    tau = H (a_d - K x + c - N). The quadratic program chooses c if a limit is active.

    A linearisation about the plan, for example by ``ffsm stability``, has the regulator and the
    estimate, without limits. The state ``programs`` counts the programs solved, and ``fallbacks``
    the programs without a solution.
    """

    steps: ClassVar[int] = 5  # predicted steps, each with an unknown c_k
    model: PlantModel
    sample_time: float
    estimator: Estimator
    limits: Limits
    prediction_step: float = gain(
        0.1, "s", "step T of the prediction", scalar=True, positive=True, feedback=False
    )
    error_size: np.ndarray = gain(
        1e-3, "rad or m", "size of an error with weight 1 in the cost", positive=True
    )
    rate_size: np.ndarray = gain(
        2e-3, "rad/s or m/s", "size of a rate of error with weight 1 in the cost", positive=True
    )
    acceleration_size: np.ndarray = gain(
        0.02,
        "rad/s^2 or m/s^2",
        "size of an acceleration u with weight 1 in the cost",
        positive=True,
    )
    iterations: float = gain(
        30.0, "", "largest number of iterations of a program, which needs about 10", scalar=True,
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
        """[e'_k; u_k; e_k] from x_0 (3, N + 1, nv, 2) and from c (3, N + 1, N, nv), k = 0 ... N."""
        T, k = self.prediction_step, self.regulator
        size = len(k)
        e, rate = np.zeros((2, size, 2 + self.steps))  # rows of [e, e', c_0, ...]
        e[:, 0] = rate[:, 1] = 1.0
        found = np.empty((3, self.steps + 1, size, 2 + self.steps))
        for step in range(self.steps + 1):
            u = -k[:, :1] * e - k[:, 1:2] * rate
            if step < self.steps:
                u[:, 2 + step] += 1.0
            found[:, step] = rate, u, e
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
        H = self.model.calc_mass_matrix(sample.q)
        estimate, memory = self.estimator.step(sample, H, state)
        known = estimate.base_force + H @ (sample.a_d - estimate.base_acceleration)
        R_WB = matrix_of(sample.q[:4])
        now = _Now(
            x=np.stack([estimate.e, estimate.e_dot], axis=-1),
            mass_matrix=H,
            known=known,
            rotation=R_WB,
            momentum=state["wheel_momentum"]
            + self.sample_time * self.limits.share @ R_WB.T @ sample.applied_force[:3],
        )
        c, counted = self.solve(sample, now, state)
        force = known + H @ (c - (self.regulator[:, :2] * now.x).sum(axis=-1))
        if force.size == self.limits.force.size:  # in a chain, tau is known only later
            force = np.clip(force, -self.limits.force, self.limits.force)
        return force, {**state, **memory, "wheel_momentum": now.momentum, **counted}

    def solve(
        self, sample: Sample, now: "_Now", state: State
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """c_0 (nv), and the memory of the programs."""
        if not self.limits.exist:
            return np.zeros_like(now.known), {}
        _, from_c = self.prediction
        H = now.mass_matrix
        forces = now.known + self.free(now)[1, :-1] @ H.T
        c, solved = self.planned(
            self.rows(sample, now, forces, np.einsum("ij,kfj->kifj", H, from_c[1, :-1]))
        )
        return c[0], {
            "programs": state["programs"] + float(solved is not None),
            "fallbacks": state["fallbacks"] + float(solved is False),
        }

    def free(self, now: "_Now") -> np.ndarray:
        """[e'_k; u_k; e_k] (3, N + 1, nv) of the regulator alone."""
        return (self.prediction[0] * now.x).sum(axis=-1)

    def resume(self, state: State, before: ControlLaw, reference: np.ndarray) -> State:
        """See ControlLaw; of the estimator as in ``TimeDelayControl``."""
        if not isinstance(before, Mpc):
            return state
        ratio, v_d = after_grasp(self.model, before.model, reference)
        return {**state, **self.estimator.resume(state, ratio, v_d)}

    def rows(
        self, sample: Sample, now: "_Now", forces: np.ndarray, change: np.ndarray
    ) -> "list[_Rows]":
        """The limited quantities of the prediction, by kind, from the forces (N, nv) of c = 0 and
        their change (N, nv, N, nv) with c.
        """
        limits, found, steps = self.limits, list[_Rows](), self.steps
        rows = np.flatnonzero(np.isfinite(limits.force))
        if rows.size:
            bound, offset, shared = limits.force[rows], forces, change
            if hasattr(self.model, "calc_force"):  # a closed chain's, linear in what the law gives
                units = np.eye(forces.shape[1])
                taken = np.stack([self.model.calc_force(sample.q, unit) for unit in units])
                offset, shared = forces @ taken, np.einsum("ji,kjfl->kifl", taken, change)
            found.append(_Rows(map=shared[:, rows], offset=offset[:, rows], bound=bound, hard=1))
        rows = np.flatnonzero(np.isfinite(limits.rate))
        if rows.size:
            from_c = self.prediction[1]
            ahead = self.prediction_step * np.arange(1, steps + 1)[:, None]
            planned = sample.v_d + ahead * sample.a_d
            units = np.eye(sample.v_d.size)
            whole = self.model.calc_whole_velocity(sample.q, units)[:, rows]
            rates = -np.einsum("ji,kfj->kifj", whole, from_c[0, 1:])
            offset = (planned - self.free(now)[0, 1:]) @ whole
            found.append(_Rows(map=rates, offset=offset, bound=limits.rate[rows]))
        if limits.torque.size:
            motor = limits.share @ now.rotation.T
            torque = np.einsum("ij,kjfl->kifl", motor, change[:, :3])
            offset = forces[:, :3] @ motor.T
            found.append(_Rows(map=torque, offset=offset, bound=limits.torque, hard=1))
            stored = self.prediction_step * np.cumsum(torque, axis=0)
            offset = now.momentum + self.prediction_step * np.cumsum(offset, axis=0)
            found.append(_Rows(map=stored, offset=offset, bound=limits.momentum))
        if limits.jets.size:
            turn = np.kron(np.eye(2), now.rotation.T)
            turn[:3] *= not limits.torque.size
            wrench = np.einsum("ij,kjfl->kifl", turn, change[:, :6])
            bound = np.abs(limits.jets).sum(axis=1)
            used = bound > 0.0
            found.append(
                _Rows(
                    map=wrench[:, used],
                    offset=(forces[:, :6] @ turn.T)[:, used],
                    bound=bound[used],
                    hard=1,
                    given=limits.jets[used],
                )
            )
        return found

    def planned(self, rows: "list[_Rows]") -> tuple[np.ndarray, bool | None]:
        """c (N, nv), and whether a program was solved; None: none was needed."""
        size = len(self.error_size)
        if all(each.is_kept(self.limits) for each in rows):
            return np.zeros((self.steps, size)), None
        program = MathematicalProgram()
        c = program.NewContinuousVariables(self.steps * size)
        slack = program.NewContinuousVariables(len(rows))
        # c in units of its weight, quantities in units of their limits
        scale = np.tile(self.regulator[:, 2], self.steps) ** -0.5
        program.AddQuadraticCost(np.eye(c.size), np.zeros(c.size), c, is_convex=True)
        program.AddLinearCost(np.full(slack.size, _SLACK), slack)
        program.AddBoundingBoxConstraint(0.0, np.inf, slack)
        for each, own in zip(rows, slack, strict=True):
            matrix = (each.map / each.bound[:, None, None]).reshape(-1, c.size) * scale
            offset, hard = (each.offset / each.bound).ravel(), each.hard * each.bound.size
            variables, bound = c, 1.0
            if each.given is not None:  # the difference from the thrusters' wrench is zero
                shares = program.NewContinuousVariables(self.steps * each.given.shape[1])
                program.AddBoundingBoxConstraint(0.0, 1.0, shares)
                given = np.kron(np.eye(self.steps), each.given / each.bound[:, None])
                matrix, bound = np.hstack([matrix, -given]), 0.0
                variables = np.concatenate([c, shares])
            if hard:
                program.AddLinearConstraint(
                    matrix[:hard], -bound - offset[:hard], bound - offset[:hard], variables
                )
            soft, offset = matrix[hard:], offset[hard:]
            endless, variables = np.full(offset.size, np.inf), np.append(variables, own)
            for sign in (1.0, -1.0):
                over = np.column_stack([sign * soft, -np.ones(offset.size)])
                program.AddLinearConstraint(over, -endless, bound - sign * offset, variables)
        solver, options = ClarabelSolver(), SolverOptions()
        options.SetOption(solver.solver_id(), "max_iter", max(1, round(self.iterations)))
        result = solver.Solve(program, None, options)
        if not result.is_success():
            return np.zeros((self.steps, size)), False
        return (result.GetSolution(c) * scale).reshape(self.steps, size), True

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> Self:
        """See ControlLaw. Raises ModelError also: a URDF's limits cannot be read."""
        limits = Limits.of(setup.mission)
        estimator = make_estimator(setup.mission, setup.coordinates, grip=setup.grip)
        return cls(**field_values(cls, setup, limits=limits, estimator=estimator))
