"""The equations of motion of a joint tree on numbers or symbols.

Coordinates are Drake's: q = [quaternion w x y z of the base in the world, its position, joints],
v = [angular velocity and velocity of the base's origin in world axes, joint rates]. Of each body,
all vectors are in its own axes and about its own origin. Articulated bodies: R. Featherstone, Rigid
Body Dynamics Algorithms (2008), chapter 7; mass matrix: chapter 6.
"""

import dataclasses
from typing import Any

import numpy as np

from ffsm_drake.common.so3 import matrix_of, quaternion_rate, skew
from ffsm_drake.plugins.equations.tree import Link, Tree
from ffsm_drake.spacecraft.inertia import SIX

_ONES = np.eye(3)


def derivative(tree: Tree, q: Any, v: Any, force: Any, own: Any) -> list[Any]:
    """[dq/dt; dv/dt] under a generalized force, N m and N; ``own`` are the parameters."""
    moving = _Motion(tree, q, v, own)
    inertias = [_inertia(own[tree.inertia_rows(i)]) for i in range(len(moving.twists))]
    loads = moving.gyroscopic_forces()
    drives: dict[int, tuple[Any, Any, Any]] = {}
    for body in range(len(tree.links), 0, -1):
        link, joint = tree.links[body - 1], moving.joints[body]
        damping, rotor, stiffness = own[tree.joint_rows(body)]
        applied = force[link.velocity] - damping * v[link.velocity]
        if link.rest is not None:
            applied = applied - stiffness * (q[link.position] - link.rest)
        across = inertias[body] @ joint.axis
        inverse = 1.0 / (joint.axis @ across + rotor)
        free = applied - joint.axis @ loads[body]
        drives[body] = across, inverse, free
        # the inertia without what the free joint takes up
        rest = _symmetric(inertias[body] - across[:, None] * (inverse * across))
        left = loads[body] + rest @ joint.bias + inverse * free * across
        inertias[link.parent] = inertias[link.parent] + joint.pose.inertia_up(rest)
        loads[link.parent] = loads[link.parent] + joint.pose.force_up(left)
    world = _turned(moving.world)
    first = tree.base_velocity
    applied = world.T @ force[first : first + 6]
    accelerations = {0: solved(inertias[0], applied - loads[0])}
    rates: list[Any] = [0.0] * tree.num_velocities
    rates[first : first + 6] = world @ (accelerations[0] + moving.turning_of_base())
    for body, link in enumerate(tree.links, start=1):
        joint, (across, inverse, free) = moving.joints[body], drives[body]
        carried = joint.pose.motion_down(accelerations[link.parent]) + joint.bias
        rates[link.velocity] = rate = inverse * (free - across @ carried)
        accelerations[body] = carried + rate * joint.axis
    return [*_position_rates(tree, q, v), *rates]


def bias(tree: Tree, q: Any, v: Any, own: Any) -> list[Any]:
    """The Coriolis and centrifugal term (nv), N m and N: the force of zero dv/dt."""
    return inverse_dynamics(tree, q, v, np.zeros(tree.num_velocities), own)


def inverse_dynamics(tree: Tree, q: Any, v: Any, a: Any, own: Any) -> list[Any]:
    """The force H a + C (nv), N m and N, of accelerations a (nv), without damping and springs."""
    moving, first = _Motion(tree, q, v, own), tree.base_velocity
    world = _turned(moving.world)
    accelerations = [world.T @ a[first : first + 6] - moving.turning_of_base()]
    loads = moving.gyroscopic_forces()
    for body, link in enumerate(tree.links, start=1):
        joint = moving.joints[body]
        carried = joint.pose.motion_down(accelerations[link.parent]) + joint.bias
        accelerations.append(carried + a[link.velocity] * joint.axis)
    for body, acceleration in enumerate(accelerations):
        loads[body] = loads[body] + _inertia(own[tree.inertia_rows(body)]) @ acceleration
    result: list[Any] = [0.0] * tree.num_velocities
    for body in range(len(tree.links), 0, -1):
        link, joint = tree.links[body - 1], moving.joints[body]
        rotor = own[tree.joint_rows(body)][1]
        result[link.velocity] = joint.axis @ loads[body] + rotor * a[link.velocity]
        loads[link.parent] = loads[link.parent] + joint.pose.force_up(loads[body])
    result[first : first + 6] = world @ loads[0]
    return result


def mass_matrix(tree: Tree, q: Any, own: Any) -> list[list[Any]]:
    """H (nv, nv), symmetric."""
    size, count, tree = tree.num_velocities, len(tree.links), tree.placed(own)
    poses = {body: _Pose.of(link, q) for body, link in enumerate(tree.links, start=1)}
    whole = [own[tree.inertia_rows(body)] for body in range(count + 1)]
    for body in range(count, 0, -1):
        parent = tree.links[body - 1].parent
        whole[parent] = whole[parent] + poses[body].rigid_up(whole[body])
    world = matrix_of(q[tree.base_position :][:4])
    H: list[list[Any]] = [[0.0] * size for _ in range(size)]

    def enter(row: int, column: int, value: Any) -> None:
        H[row][column] = H[column][row] = value

    first = tree.base_velocity
    for body in range(count, 0, -1):
        link = tree.links[body - 1]
        axis = _axis(link)
        load = _inertia(whole[body]) @ axis
        rotor = own[tree.joint_rows(body)][1]
        enter(link.velocity, link.velocity, axis @ load + rotor)
        at = body
        while True:
            load, at = poses[at].force_up(load), tree.links[at - 1].parent
            if at == 0:
                break
            above = tree.links[at - 1]
            enter(above.velocity, link.velocity, _axis(above) @ load)
        for i, value in enumerate(_turned(world) @ load):
            enter(first + i, link.velocity, value)
    turning = _symmetric(world @ _inertia(whole[0])[:3, :3] @ world.T)
    across, mass = skew(world @ whole[0][1:4]), whole[0][0] * _ONES
    base = np.block([[turning, across], [across.T, mass]])
    for i, row in enumerate(base):
        H[first + i][first : first + 6] = row
    return H


class _Motion:
    """Joints, twists and gyroscopic forces of all bodies; 0 is the base."""

    def __init__(self, tree: Tree, q: Any, v: Any, own: Any) -> None:
        self.world = matrix_of(q[tree.base_position :][:4])
        self.twists = [_turned(self.world).T @ v[tree.base_velocity :][:6]]  # [w; v] of each body
        self.joints: dict[int, _Joint] = {}
        self._rows = [own[tree.inertia_rows(body)] for body in range(len(tree.links) + 1)]
        for body, link in enumerate(tree.placed(own).links, start=1):
            pose, axis = _Pose.of(link, q), _axis(link)
            moved = v[link.velocity] * axis
            twist = pose.motion_down(self.twists[link.parent]) + moved
            self.twists.append(twist)
            turning, sliding = twist[:3], twist[3:]
            drift = np.cross(turning, moved[3:]) + np.cross(sliding, moved[:3])
            drift = np.concatenate([np.cross(turning, moved[:3]), drift])
            self.joints[body] = _Joint(pose, axis, drift)

    def turning_of_base(self) -> Any:
        """The acceleration of the base's origin at constant twist (6), in the base's axes."""
        turning, sliding = self.twists[0][:3], self.twists[0][3:]
        return np.concatenate([np.zeros(3), np.cross(turning, sliding)])

    def gyroscopic_forces(self) -> list[Any]:
        """The force on each body at constant twist."""
        found = []
        for row, twist in zip(self._rows, self.twists, strict=True):
            momentum = _inertia(row) @ twist
            turning, sliding, spin, push = twist[:3], twist[3:], momentum[:3], momentum[3:]
            torque = np.cross(turning, spin) + np.cross(sliding, push)
            found.append(np.concatenate([torque, np.cross(turning, push)]))
        return found


def _inertia(row: Any) -> Any:
    """Inertia (6, 6) of a rigid body, from its ten parameters: the force of a motion."""
    mass, x, y, z, xx, yy, zz, xy, xz, yz = row
    return np.array([
        [xx, xy, xz, 0.0, -z, y],
        [xy, yy, yz, z, 0.0, -x],
        [xz, yz, zz, -y, x, 0.0],
        [0.0, z, -y, mass, 0.0, 0.0],
        [-z, 0.0, x, 0.0, mass, 0.0],
        [y, -x, 0.0, 0.0, 0.0, mass],
    ])  # fmt: skip


def _turned(rotation: Any) -> Any:
    """Matrix (6, 6) that turns motions and forces."""
    return np.block([[rotation, 0.0 * _ONES], [0.0 * _ONES, rotation]])


@dataclasses.dataclass(frozen=True)
class _Pose:
    """A body's frame in its parent's: turned by the joint, then by a constant rotation."""

    rotations: tuple[Any, ...]  # (3, 3) each
    place: Any  # (3)

    @classmethod
    def of(cls, link: Link, q: Any) -> "_Pose":
        rotation, place = np.asanyarray(link.rotation), np.asanyarray(link.place)
        if link.slides:
            return cls((rotation,), place + rotation @ (q[link.position] * np.array(link.axis)))
        angle = q[link.position : link.position + 1, None]
        return cls((axis_rotation(link.axis, angle), rotation), place)

    def _steps(self) -> list[Any]:
        """Matrices (6, 6) that move forces up, one after another."""
        shift = np.block([[_ONES, skew(self.place)], [0.0 * _ONES, _ONES]])
        return [*map(_turned, self.rotations), shift]

    def motion_down(self, motion: Any) -> Any:
        """The parent's motion [angular; linear], at the body's origin and in its axes."""
        for step in reversed(self._steps()):
            motion = step.T @ motion
        return motion

    def force_up(self, load: Any) -> Any:
        """A force [torque; force], about the parent's origin and in its axes."""
        for step in self._steps():
            load = step @ load
        return load

    def inertia_up(self, own: Any) -> Any:
        """An inertia (6, 6) about the parent's origin and in its axes."""
        for step in self._steps():
            own = _symmetric(step @ own @ step.T)
        return own

    def rigid_up(self, row: Any) -> Any:
        """The ten parameters of a rigid body, in its parent's frame."""
        moment, turning = row[1:4], _inertia(row)[:3, :3]
        for rotation in self.rotations:
            moment, turning = rotation @ moment, _symmetric(rotation @ turning @ rotation.T)
        P = skew(self.place)
        mixed = P @ skew(moment)
        turning = turning - (mixed + mixed.T) - row[0] * (P @ P)
        center = moment + row[0] * self.place
        return np.concatenate([row[:1], center, turning[SIX]])


@dataclasses.dataclass(frozen=True)
class _Joint:
    """A joint in motion."""

    pose: _Pose
    axis: Any  # (6) the body's motion at unit rate
    bias: Any  # (6) its acceleration at constant rates


def _axis(link: Link) -> Any:
    return np.array([0.0, 0.0, 0.0, *link.axis] if link.slides else [*link.axis, 0.0, 0.0, 0.0])


def axis_rotation(axis: Any, angle: Any) -> Any:
    """Rotations (..., 3, 3) by angles (..., 1, 1) about a unit vector."""
    axis = np.array(axis)
    along = axis[:, None] * axis
    return along + np.cos(angle) * (_ONES - along) + np.sin(angle) * skew(axis)


def _symmetric(matrix: Any) -> Any:
    """With the upper half in the lower one, which then needs no computation."""
    size = np.arange(len(matrix))
    return matrix[np.minimum.outer(size, size), np.maximum.outer(size, size)]


def _position_rates(tree: Tree, q: Any, v: Any) -> list[Any]:
    first, start = tree.base_position, tree.base_velocity
    rates: list[Any] = [0.0] * tree.num_positions
    rates[first : first + 4] = quaternion_rate(q[first : first + 4], v[start : start + 3])
    rates[first + 4 : first + 7] = v[start + 3 : start + 6]
    for link in tree.links:
        rates[link.position] = v[link.velocity]
    return rates


def solved(matrix: Any, right: Any) -> Any:
    """The solution of a symmetric positive definite system, by elimination in its upper half."""
    a, x, inverse = np.array(matrix), np.array(right), list[Any]()
    for j in range(len(x)):
        inverse.append(1.0 / a[j, j])
        for i in range(j + 1, len(x)):
            factor = a[j, i] * inverse[j]
            a[i, i:] = a[i, i:] - factor * a[j, i:]
            x[i] = x[i] - factor * x[j]
    for j in reversed(range(len(x))):
        for i in range(j + 1, len(x)):
            x[j] = x[j] - a[j, i] * x[i]
        x[j] = x[j] * inverse[j]
    return x
