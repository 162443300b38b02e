"""The equations of motion of a joint tree on numbers or symbols.

Coordinates are Drake's: q = [quaternion w x y z of the base in the world, its position, joints],
v = [angular velocity and velocity of the base's origin in world axes, joint rates]. Of each body,
all vectors are in its own axes and about its own origin. Articulated bodies: R. Featherstone, Rigid
Body Dynamics Algorithms (2008), chapter 7; mass matrix: chapter 6.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

from ffsm_drake.plugins.equations.tree import Link, Tree
from ffsm_drake.plugins.equations.vectors import (
    ZERO,
    Matrix,
    Vector,
    cross,
    diagonal,
    dot,
    minus,
    plus,
    product,
    scaled,
    skew,
    sum_of,
    symmetric,
    times,
    transposed,
)
from ffsm_drake.spacecraft.inertia import SIX
from ffsm_drake.tape.numbers import cosine, sine


def derivative(
    tree: Tree, q: Sequence[Any], v: Sequence[Any], force: Sequence[Any], own: Sequence[Any]
) -> list[Any]:
    """[dq/dt; dv/dt] under a generalized force, N m and N; ``own`` are the parameters."""
    moving = _Motion(tree, q, v, own)
    inertias = [_articulated(own[tree.inertia_rows(i)]) for i in range(len(moving.twists))]
    loads = moving.gyroscopic_forces()
    drives: dict[int, _Drive] = {}
    for body in range(len(tree.links), 0, -1):
        link, joint = tree.links[body - 1], moving.joints[body]
        damping, rotor, stiffness = own[tree.joint_rows(body)]
        applied = force[link.velocity] - damping * v[link.velocity]
        if link.rest is not None:
            applied = applied - stiffness * (q[link.position] - link.rest)
        drives[body] = drive = _Drive(joint, inertias[body], rotor, applied, loads[body])
        rest = drive.inertia_left(inertias[body])
        left = plus(loads[body], rest.times(joint.bias), scaled(drive.share, drive.across))
        inertias[link.parent] = inertias[link.parent].plus(joint.pose.inertia_up(rest))
        loads[link.parent] = plus(loads[link.parent], joint.pose.force_up(left))
    world = quaternion_matrix(q[tree.base_position : tree.base_position + 4])
    first = tree.base_velocity
    torque, push = force[first : first + 3], force[first + 3 : first + 6]
    down = transposed(world)
    applied = [*times(down, torque), *times(down, push)]
    accelerations = {0: solved(inertias[0].matrix(), minus(applied, loads[0]))}
    rates: list[Any] = [0.0] * tree.num_velocities
    turning, sliding = moving.twists[0][:3], moving.twists[0][3:]
    spin, pull = accelerations[0][:3], plus(accelerations[0][3:], cross(turning, sliding))
    rates[first : first + 6] = [*times(world, spin), *times(world, pull)]
    for body, link in enumerate(tree.links, start=1):
        joint, drive = moving.joints[body], drives[body]
        carried = plus(joint.pose.motion_down(accelerations[link.parent]), joint.bias)
        rate = drive.inverse * (drive.free - dot(drive.across, carried))
        rates[link.velocity] = rate
        accelerations[body] = plus(carried, scaled(rate, joint.axis))
    return [*_position_rates(tree, q, v), *rates]


def bias(tree: Tree, q: Sequence[Any], v: Sequence[Any], own: Sequence[Any]) -> list[Any]:
    """The Coriolis and centrifugal term (nv), N m and N: the force of zero dv/dt."""
    return inverse_dynamics(tree, q, v, [0.0] * tree.num_velocities, own)


def inverse_dynamics(
    tree: Tree, q: Sequence[Any], v: Sequence[Any], a: Sequence[Any], own: Sequence[Any]
) -> list[Any]:
    """The force H a + C (nv), N m and N, of accelerations a (nv), without damping and springs.

    Numbers may also be arrays of one shape, for many states at once.
    """
    moving, first = _Motion(tree, q, v, own), tree.base_velocity
    world = quaternion_matrix(q[tree.base_position : tree.base_position + 4])
    down = transposed(world)
    turning, sliding = moving.twists[0][:3], moving.twists[0][3:]
    pull = minus(times(down, a[first + 3 : first + 6]), cross(turning, sliding))
    accelerations = [[*times(down, a[first : first + 3]), *pull]]
    loads = moving.gyroscopic_forces()
    for body, link in enumerate(tree.links, start=1):
        joint = moving.joints[body]
        carried = joint.pose.motion_down(accelerations[link.parent])
        accelerations.append(plus(carried, joint.bias, scaled(a[link.velocity], joint.axis)))
    for body, acceleration in enumerate(accelerations):
        inertia = _articulated(own[tree.inertia_rows(body)])
        loads[body] = plus(loads[body], inertia.times(acceleration))
    result: list[Any] = [0.0] * tree.num_velocities
    for body in range(len(tree.links), 0, -1):
        link, joint = tree.links[body - 1], moving.joints[body]
        rotor = own[tree.joint_rows(body)][1]
        result[link.velocity] = dot(joint.axis, loads[body]) + rotor * a[link.velocity]
        loads[link.parent] = plus(loads[link.parent], joint.pose.force_up(loads[body]))
    result[first : first + 6] = [*times(world, loads[0][:3]), *times(world, loads[0][3:])]
    return result


def mass_matrix(tree: Tree, q: Sequence[Any], own: Sequence[Any]) -> list[list[Any]]:
    """H (nv, nv), symmetric."""
    size, count = tree.num_velocities, len(tree.links)
    poses = {body: _pose(link, q) for body, link in enumerate(tree.links, start=1)}
    whole = [list(own[tree.inertia_rows(body)]) for body in range(count + 1)]
    for body in range(count, 0, -1):
        parent = tree.links[body - 1].parent
        whole[parent] = plus(whole[parent], _moved(whole[body], poses[body]))
    world = quaternion_matrix(q[tree.base_position : tree.base_position + 4])
    H: list[list[Any]] = [[0.0] * size for _ in range(size)]

    def enter(row: int, column: int, value: Any) -> None:
        H[row][column] = H[column][row] = value

    first = tree.base_velocity
    for body in range(count, 0, -1):
        link = tree.links[body - 1]
        axis = _axis(link)
        load = _articulated(whole[body]).times(axis)
        rotor = own[tree.joint_rows(body)][1]
        enter(link.velocity, link.velocity, dot(axis, load) + rotor)
        at = body
        while True:
            load, at = poses[at].force_up(load), tree.links[at - 1].parent
            if at == 0:
                break
            above = tree.links[at - 1]
            enter(above.velocity, link.velocity, dot(_axis(above), load))
        for i, value in enumerate((*times(world, load[:3]), *times(world, load[3:]))):
            enter(first + i, link.velocity, value)
    base = _articulated(whole[0])
    turning = _rotated(base.turning, world)
    across = skew(times(world, whole[0][1:4]))
    for i in range(3):
        for j in range(3):
            enter(first + i, first + j, turning[min(i, j)][max(i, j)])
            enter(first + i, first + 3 + j, across[i][j])
            H[first + 3 + i][first + 3 + j] = base.sliding[i][j]
    return H


class _Motion:
    """Joints, twists and gyroscopic forces of all bodies; 0 is the base."""

    def __init__(self, tree: Tree, q: Sequence[Any], v: Sequence[Any], own: Sequence[Any]) -> None:
        down = transposed(quaternion_matrix(q[tree.base_position : tree.base_position + 4]))
        first = tree.base_velocity
        base = [*times(down, v[first : first + 3]), *times(down, v[first + 3 : first + 6])]
        self.twists: list[Vector] = [base]  # [w; v] of each body
        self.joints: dict[int, _Joint] = {}
        self._rows = [own[tree.inertia_rows(body)] for body in range(len(tree.links) + 1)]
        for body, link in enumerate(tree.links, start=1):
            pose, axis = _pose(link, q), _axis(link)
            moved = scaled(v[link.velocity], axis)
            twist = plus(pose.motion_down(self.twists[link.parent]), moved)
            self.twists.append(twist)
            turning, sliding = twist[:3], twist[3:]
            drift = plus(cross(turning, moved[3:]), cross(sliding, moved[:3]))
            self.joints[body] = _Joint(pose, axis, [*cross(turning, moved[:3]), *drift])

    def gyroscopic_forces(self) -> list[Vector]:
        """The force on each body at constant twist."""
        return [
            _gyroscopic(_articulated(row).times(twist), twist)
            for row, twist in zip(self._rows, self.twists, strict=True)
        ]


def _gyroscopic(momentum: Vector, twist: Vector) -> Vector:
    turning, sliding, spin, push = twist[:3], twist[3:], momentum[:3], momentum[3:]
    return [*plus(cross(turning, spin), cross(sliding, push)), *cross(turning, push)]


@dataclasses.dataclass(frozen=True)
class _Inertia:
    """A symmetric inertia of an articulated body: force [turning, across; across^T, sliding] a."""

    turning: Matrix
    across: Matrix
    sliding: Matrix

    def times(self, motion: Sequence[Any]) -> Vector:
        """The force [torque; force] of a motion [angular; linear]."""
        turning, sliding = motion[:3], motion[3:]
        torque = plus(times(self.turning, turning), times(self.across, sliding))
        push = plus(times(transposed(self.across), turning), times(self.sliding, sliding))
        return [*torque, *push]

    def plus(self, other: "_Inertia") -> "_Inertia":
        return _Inertia(
            sum_of(self.turning, other.turning),
            sum_of(self.across, other.across),
            sum_of(self.sliding, other.sliding),
        )

    def matrix(self) -> Matrix:
        """As one matrix (6, 6)."""
        upper = [[*a, *b] for a, b in zip(self.turning, self.across, strict=True)]
        lower = zip(transposed(self.across), self.sliding, strict=True)
        return upper + [[*a, *b] for a, b in lower]


def _articulated(row: Sequence[Any]) -> _Inertia:
    """Inertia of a rigid body, from its ten parameters."""
    mass, x, y, z, xx, yy, zz, xy, xz, yz = row
    turning = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
    return _Inertia(turning, skew([x, y, z]), diagonal(mass))


@dataclasses.dataclass(frozen=True)
class _Pose:
    """A body's frame in its parent's: turned by the joint, then by a constant rotation."""

    turned: Matrix | None  # None: it slides
    rotation: Sequence[Sequence[float]]
    place: Vector

    def up(self, a: Sequence[Any]) -> Vector:
        """A vector in the parent's axes."""
        return times(self.rotation, list(a) if self.turned is None else times(self.turned, a))

    def down(self, a: Sequence[Any]) -> Vector:
        """A vector in the body's axes."""
        before = times(transposed(self.rotation), a)
        return before if self.turned is None else times(transposed(self.turned), before)

    def matrix_up(self, a: Matrix) -> Matrix:
        return _rotated(a if self.turned is None else _rotated(a, self.turned), self.rotation)

    def motion_down(self, motion: Sequence[Any]) -> Vector:
        """The parent's motion [angular; linear], at the body's origin and in its axes."""
        turning, sliding = motion[:3], motion[3:]
        return [*self.down(turning), *self.down(plus(sliding, cross(turning, self.place)))]

    def force_up(self, load: Sequence[Any]) -> Vector:
        """A force [torque; force], about the parent's origin and in its axes."""
        push = self.up(load[3:])
        return [*plus(self.up(load[:3]), cross(self.place, push)), *push]

    def inertia_up(self, own: _Inertia) -> _Inertia:
        """An inertia about the parent's origin and in its axes."""
        turning, sliding = (symmetric(self.matrix_up(part)) for part in (own.turning, own.sliding))
        across, P = self.matrix_up(own.across), skew(self.place)
        carried, mixed = product(P, sliding), product(P, transposed(across))
        shifted = sum_of(turning, mixed, transposed(mixed), product(carried, transposed(P)))
        return _Inertia(symmetric(shifted), sum_of(across, carried), sliding)


@dataclasses.dataclass(frozen=True)
class _Joint:
    """A joint in motion."""

    pose: _Pose
    axis: Vector  # (6) the body's motion at unit rate
    bias: Vector  # (6) its acceleration at constant rates


class _Drive:
    """An articulated body seen from its joint."""

    def __init__(
        self, joint: _Joint, inertia: _Inertia, rotor: Any, applied: Any, load: Sequence[Any]
    ) -> None:
        self.across = inertia.times(joint.axis)
        self.inverse = 1.0 / (dot(joint.axis, self.across) + rotor)
        self.free = applied - dot(joint.axis, load)
        self.share = self.inverse * self.free

    def inertia_left(self, whole: _Inertia) -> _Inertia:
        """The inertia without what the free joint takes up."""
        share = scaled(self.inverse, self.across)
        turning, sliding = self.across[:3], self.across[3:]

        def less(own: Matrix, rows: Vector, columns: Vector) -> Matrix:
            return [minus(row, scaled(x, columns)) for row, x in zip(own, rows, strict=True)]

        return _Inertia(
            symmetric(less(whole.turning, turning, share[:3])),
            less(whole.across, turning, share[3:]),
            symmetric(less(whole.sliding, sliding, share[3:])),
        )


def _axis(link: Link) -> Vector:
    return [*ZERO, *link.axis] if link.slides else [*link.axis, *ZERO]


def _pose(link: Link, q: Sequence[Any]) -> _Pose:
    if link.slides:
        slid = times(link.rotation, scaled(q[link.position], link.axis))
        return _Pose(None, link.rotation, plus(link.place, slid))
    return _Pose(axis_rotation(link.axis, q[link.position]), link.rotation, list(link.place))


def axis_rotation(axis: Sequence[float], angle: Any) -> Matrix:
    """The rotation by an angle about a unit vector."""
    c, s = cosine(angle), sine(angle)
    along = [[x * y for y in axis] for x in axis]
    across = [[(1.0 if i == j else 0.0) - along[i][j] for j in range(3)] for i in range(3)]
    return sum_of(along, [scaled(c, row) for row in across], [scaled(s, row) for row in skew(axis)])


def quaternion_matrix(quaternion: Sequence[Any]) -> Matrix:
    """The rotation of a quaternion w x y z of any length."""
    w, x, y, z = quaternion
    two = 2.0 * (1.0 / dot(quaternion, quaternion))
    xx, xy, xz, xw = scaled(two * x, (x, y, z, w))
    yy, yz, yw = scaled(two * y, (y, z, w))
    zz, zw = scaled(two * z, (z, w))
    return [
        [1.0 - (yy + zz), xy - zw, xz + yw],
        [xy + zw, 1.0 - (xx + zz), yz - xw],
        [xz - yw, yz + xw, 1.0 - (xx + yy)],
    ]


def _position_rates(tree: Tree, q: Sequence[Any], v: Sequence[Any]) -> list[Any]:
    first, start = tree.base_position, tree.base_velocity
    w, x, y, z = scaled(0.5, q[first : first + 4])
    turning = v[start : start + 3]
    a, b, c = turning
    rates: list[Any] = [0.0] * tree.num_positions
    rates[first : first + 4] = [
        -dot((x, y, z), turning),
        w * a + z * b - y * c,
        w * b - z * a + x * c,
        w * c + y * a - x * b,
    ]
    rates[first + 4 : first + 7] = v[start + 3 : start + 6]
    for link in tree.links:
        rates[link.position] = v[link.velocity]
    return rates


def _rotated(a: Matrix, rotation: Sequence[Sequence[Any]]) -> Matrix:
    return product(product(rotation, a), transposed(rotation))


def _moved(row: Sequence[Any], pose: _Pose) -> Vector:
    """The ten parameters of a rigid body, in its parent's frame."""
    mass, moment = row[0], pose.up(row[1:4])
    turning = symmetric(pose.matrix_up(_articulated(row).turning))
    P, h = skew(pose.place), skew(moment)
    mixed, square = product(P, h), product(P, P)
    shifted = [
        [turning[i][j] - (mixed[i][j] + mixed[j][i]) - mass * square[i][j] for j in range(3)]
        for i in range(3)
    ]
    center = plus(moment, scaled(mass, pose.place))
    return [mass, *center, *(shifted[i][j] for i, j in zip(*SIX, strict=True))]


def solved(matrix: Matrix, right: Sequence[Any]) -> Vector:
    """The solution of a symmetric positive definite system, by L D L^T."""
    size = len(matrix)
    L: Matrix = [[0.0] * size for _ in range(size)]
    pivots, inverse = list[Any](), list[Any]()
    for j in range(size):
        weighted = [L[j][k] * pivots[k] for k in range(j)]
        pivots.append(matrix[j][j] - dot(L[j][:j], weighted))
        inverse.append(1.0 / pivots[j])
        for i in range(j + 1, size):
            L[i][j] = (matrix[j][i] - dot(L[i][:j], weighted)) * inverse[j]
    x = list(right)
    for i in range(size):
        x[i] = x[i] - dot(L[i][:i], x[:i])
    x = [value * own for value, own in zip(x, inverse, strict=True)]
    for i in reversed(range(size)):
        x[i] = x[i] - dot([L[k][i] for k in range(i + 1, size)], x[i + 1 :])
    return x
