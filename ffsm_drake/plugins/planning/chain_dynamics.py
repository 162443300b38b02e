"""Inverse dynamics of a closed chain for a plan.

The plan is for the base and those joints that move all others (z_f). The followers in the closing
arms have the positions, rates and accelerations that close the loops, so no plan opens them.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from pydrake.math import RotationMatrix
from scipy.interpolate import BSpline

from ffsm_drake.common.registrations import Registry
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.planning.inverse_dynamics import in_base_axes, in_world_axes
from ffsm_drake.plugins.planning.motion_limits import MotionLimits
from ffsm_drake.spacecraft.coordinates import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    position_errors,
)
from ffsm_drake.spacecraft.nominal import PlantModel, damping_of
from ffsm_drake.systems.plan import DEGREE, Plan
from ffsm_drake.systems.reference import make_motion


class PlannedChains(Protocol):
    """Returns the programs of the chain of a mission."""

    def __call__(self, mission: Mission) -> Any: ...

    def begun(self, mission: Mission) -> Mission:
        """Return the mission from the time on at which a plan of the given one begins."""


PLANNED_CHAINS = Registry[PlannedChains]("planned_chains")
_OPEN = 1e-6  # m, rad; gap that counts as a limit exceeded
_ANY = 1e3  # rad or m; instead of a missing limit of position
_FITTED = 8  # instants per segment at which the followers of a plan are fitted
_JOINTS = slice(NUM_BASE_VELOCITIES, None)


class ChainDynamics:
    """Forces on all velocities for z_f, and what else has limits.

    The rows are the forces, first of z_f; ``extra`` rows that are at most 1 in size: positions,
    rates and gaps of the followers, wrenches of the contacts; and all joints.
    """

    turns = False
    joints: slice | None

    def __init__(
        self, mission: Mission, model: PlantModel, first: RotationMatrix, limits: MotionLimits
    ) -> None:
        """Args: the mission; its nominal plant; the attitude R_0; limits of all coordinates."""
        self.chain = PLANNED_CHAINS.load("contacts", "contacts")(mission)
        self._model = model
        self._first, self._damping = first.matrix(), damping_of(model.plant)[:, None]
        self.order = np.concatenate([self.chain.free, self.chain.following])
        self.planned = np.intersect1d(self.chain.free, model.coordinates.driven)
        own = self.chain.following
        lower, upper = np.maximum(limits.lower[own], -_ANY), np.minimum(limits.upper[own], _ANY)
        self._middle, self._half = 0.5 * (upper + lower)[:, None], 0.5 * (upper - lower)[:, None]
        self._rate, self._wrench = limits.rate[own][:, None], limits.wrench[:, None]
        size = len(self.order)
        self.extra = 3 * own.size + limits.wrench.size
        self.joints = slice(size + self.extra, size + self.extra + size - NUM_BASE_VELOCITIES)

    def calc(self, z: np.ndarray, rate: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        """The rows (n columns) for z_f and its time derivatives (nf, n). Complex arrays pass."""
        every = np.zeros((3, len(self.order), z.shape[1]), dtype=z.dtype)
        every[:, self.chain.free] = z, rate, acceleration
        whole, v, a = every
        joints, gap = self.chain.follow(whole[_JOINTS])
        R_WB, v[:NUM_BASE_VELOCITIES], a[:NUM_BASE_VELOCITIES] = in_base_axes(
            self._first, z, rate, acceleration
        )
        v, a = self.chain.move(joints, v, a)
        force, wrench = self.chain.forces(joints, v, a)
        tau = in_world_axes(R_WB, force + self._damping * v)
        own = self.chain.following
        extra = [
            (joints[own - NUM_BASE_VELOCITIES] - self._middle) / self._half,
            v[own] / self._rate,
            gap / _OPEN,
            wrench / self._wrench,
        ]
        return np.vstack([tau[self.order], *extra, joints])

    def along(
        self, mission: Mission, duration: float, first: np.ndarray
    ) -> Callable[[np.ndarray], np.ndarray]:
        """The driven z_f (n, planned) by the shares (n,) of a duration, s, along a polynomial.

        Args: ..., the first attitude, a quaternion. Raises ScenarioError: no such motion.
        """
        own = dataclasses.replace(
            mission.scenario.reference, kind="quintic", plan=None, duration=duration
        )
        motion = make_motion(mission.flown_by(reference=own))

        def z(share: np.ndarray) -> np.ndarray:
            q = motion.evaluate(motion.begin + share * (motion.end - motion.begin))[0]
            self.chain.learn(q[:, NUM_BASE_POSITIONS:].T)
            turns = position_errors(q, np.concatenate([first, q[0, 4:]])[None])[:, :3]
            return np.hstack([turns, q[:, 4:]])[:, self.planned]

        return z

    def closed(self, plan: Plan) -> Plan:
        """A plan with the followers, which begin the inverse kinematics of its motion."""
        share = np.linspace(0.0, 1.0, _FITTED * len(plan.knots))
        z = plan.curve(share * plan.duration)[0]
        followed = self.chain.follow(z[_JOINTS])[0][self.chain.following - NUM_BASE_VELOCITIES]
        knots = np.r_[np.zeros(DEGREE), plan.knots, np.ones(DEGREE)]
        basis = BSpline.design_matrix(share, knots, DEGREE).toarray()
        points = plan.control_points.copy()
        points[:, self.chain.following] = np.linalg.lstsq(basis, followed.T, rcond=None)[0]
        return dataclasses.replace(plan, control_points=points)
