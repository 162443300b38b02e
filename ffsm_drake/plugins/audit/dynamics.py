"""Momentum, and the joints' equations of motion, of the samples of a log."""

import dataclasses

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from scipy.interpolate import CubicSpline

from ffsm_drake.plugins.audit.log import Array, Log, every, only
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.plant import base_body, coordinates_of

MOST = 4000  # samples at which the plant is evaluated
_STEP = 1e-4  # rad or m; step of a numerical derivative


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Bodies:
    """Motion of the bodies relative to the base, in its axes (n, bodies, ...)."""

    mass: Array  # (bodies), kg
    center: Array  # (n, bodies, 3) centres of mass from the base's origin, m
    velocity: Array  # (n, bodies, 3) of the centres of mass
    spin: Array  # (n, bodies, 3) angular velocities
    inertia: Array  # (n, bodies, 3, 3) about the centres of mass
    turn: Array  # (n, bodies, 3, 3) from a body's own axes

    def shifted(self, body: int, by: Array) -> "Bodies":
        """The bodies with one centre of mass moved by a vector (3) in its own axes, m."""
        arm = np.zeros_like(self.center)
        arm[:, body] = self.turn[:, body] @ by
        return dataclasses.replace(
            self, center=self.center + arm, velocity=self.velocity + np.cross(self.spin, arm)
        )

    def momenta(self, log: Log) -> tuple[Array, Array]:
        """Momenta of each body (n, bodies, 6) with the base's motion from a log.

        The first array is the momentum of the mass, the second the momentum of the rotation about
        the body's own centre of mass. Both are [angular; linear] about the origin, world axes.
        """
        turn, linear, position = log.attitude.as_matrix(), log.linear, log.position
        w = log.attitude.inv().apply(log.angular)[:, None]
        arm = np.einsum("nij,nbj->nbi", turn, self.center)
        relative = np.einsum("nij,nbj->nbi", turn, np.cross(w, self.center) + self.velocity)
        push = self.mass[:, None] * (linear[:, None] + relative)
        moment = np.cross(position[:, None] + arm, push)
        own = np.einsum("nij,nbjk,nbk->nbi", turn, self.inertia, w + self.spin)
        return (
            np.concatenate([moment, push], axis=2),
            np.concatenate([own, np.zeros_like(own)], axis=2),
        )


class Dynamics:
    """Momentum and equations of motion of the bodies of a plant, for the samples of a log."""

    def __init__(self, plant: MultibodyPlant) -> None:
        self.plant = plant
        self.context = plant.CreateDefaultContext()
        self.names = coordinates_of(plant, jointless=True).joints
        bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
        self.bodies = [body for body in bodies if body.default_mass() > 0.0]
        inertias = [b.CalcSpatialInertiaInBodyFrame(self.context) for b in self.bodies]
        self.masses = np.array([inertia.get_mass() for inertia in inertias])
        self.mass = float(self.masses.sum())
        self._centers = np.array([inertia.get_com() for inertia in inertias])
        self._inertias = np.array(
            [
                inertia.Shift(inertia.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
                for inertia in inertias
            ]
        )

    def bodies_of(self, log: Log) -> Bodies:
        """Motion of the bodies relative to the base."""
        count = len(log.time), len(self.bodies)
        poses, twists = np.zeros((*count, 3, 4)), np.zeros((*count, 6))
        state = np.zeros(self.plant.num_positions() + self.plant.num_velocities())
        state[0] = 1.0
        for k, joints in enumerate(zip(log.angles, log.rates, strict=True)):
            state[7 : 7 + len(self.names)], state[len(state) - len(self.names) :] = joints
            self.plant.SetPositionsAndVelocities(self.context, state)
            for i, body in enumerate(self.bodies):
                poses[k, i] = body.EvalPoseInWorld(self.context).GetAsMatrix34()
                twists[k, i] = body.EvalSpatialVelocityInWorld(self.context).get_coeffs()
        turns, spins = poses[..., :3], twists[..., :3]
        arm = np.einsum("nbij,bj->nbi", turns, self._centers)
        return Bodies(
            mass=self.masses,
            center=poses[..., 3] + arm,
            velocity=twists[..., 3:] + np.cross(spins, arm),
            spin=spins,
            inertia=np.einsum("nbij,bjk,nblk->nbil", turns, self._inertias, turns),
            turn=turns,
        )

    def points(self, log: Log) -> dict[str, tuple[Array, Array]]:
        """Points that are often logged in place of the base's origin: positions from the origin
        (n, 3), m, and velocities relative to it (n, 3), m/s, world axes.
        """
        w = log.attitude.inv().apply(log.angular)
        base = base_body(self.plant).CalcCenterOfMassInBodyFrame(self.context)
        rows = every(len(log.time), most=MOST)
        bodies = self.bodies_of(only(log, rows))
        shares = self.masses / self.mass
        whole = np.einsum("b,nbi->ni", shares, bodies.center)
        moves = np.einsum("b,nbi->ni", shares, bodies.velocity)
        if len(rows) < len(log.time):
            whole, moves = (CubicSpline(log.time[rows], x)(log.time) for x in (whole, moves))
        still = np.zeros_like(whole)
        return {
            point: (
                log.attitude.apply(arm),
                log.attitude.apply(np.cross(w, arm) + speed),
            )
            for point, arm, speed in (
                ("the base's centre of mass", still + base, still),
                ("the spacecraft's centre of mass", whole, moves),
            )
        }

    def joint_terms(self, log: Log) -> tuple[Array, Array]:
        """Generalized momentum of each joint p = (M v)_i and its rate without efforts dT/dq_i.

        Both are (n, joints), with dp/dt = effort + dT/dq.
        """
        nv, plant, context = self.plant.num_velocities(), self.plant, self.context
        momenta, rates = np.zeros((len(log.time), nv)), np.zeros((len(log.time), nv))
        place = log.position - log.position[0]
        q = np.hstack([log.quaternion, place, log.angles])
        v = np.hstack([log.angular, log.linear, log.rates])
        for k, (place, speed) in enumerate(zip(q, v, strict=True)):
            plant.SetPositions(context, place)
            plant.SetVelocities(context, speed)
            momenta[k] = plant.CalcMassMatrix(context) @ speed
            bias = plant.CalcBiasTerm(context)
            step = _STEP / max(float(np.abs(speed).max()), 1e-9)
            along = step * plant.MapVelocityToQDot(context, speed)
            sides = []
            for side in (1.0, -1.0):
                plant.SetPositions(context, place + side * along)
                sides.append(plant.CalcMassMatrix(context) @ speed)
            rates[k] = (sides[0] - sides[1]) / (2.0 * step) - bias
        return momenta[:, NUM_BASE_VELOCITIES:], rates[:, NUM_BASE_VELOCITIES:]
