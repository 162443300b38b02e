"""Kinematics of a frame on a body of a joint tree, on numbers or symbols; world axes."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from ffsm_drake.plugins.equations.equations import axis_rotation, quaternion_matrix
from ffsm_drake.plugins.equations.tree import Place, Tree
from ffsm_drake.plugins.equations.vectors import (
    ZERO,
    Matrix,
    Vector,
    cross,
    dot,
    minus,
    plus,
    product,
    scaled,
    times,
    transposed,
)
from ffsm_drake.tape.numbers import select, signed, square_root


class _Step(NamedTuple):
    """A body on the way from the base to a frame."""

    velocity: int  # index in v of its joint's rate
    slides: bool
    axis: Vector  # of the joint
    shift: Vector  # of its origin from the body's before, m
    origin: Vector  # p_W, m


def pose(tree: Tree, place: Place, q: Sequence[Any]) -> tuple[Matrix, Vector]:
    """R_WF (3, 3) and p_WF (3), m."""
    rotation, *_, origin = _way(tree, place, q)
    return rotation, origin


def quaternion_of(rotation: Matrix) -> Vector:
    """The quaternion w x y z of a rotation, with w >= 0: of the four expressions with a square root
    of 1 + trace, 1 + xx - yy - zz, ..., the one with the largest.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    candidates: list[tuple[Any, Callable[[Any], Vector]]] = [
        (xx + yy + zz, lambda s: [s, zy - yz, xz - zx, yx - xy]),
        (xx - yy - zz, lambda s: [zy - yz, s, xy + yx, xz + zx]),
        (yy - xx - zz, lambda s: [xz - zx, xy + yx, s, yz + zy]),
        (zz - xx - yy, lambda s: [yx - xy, xz + zx, yz + zy, s]),
    ]
    size, first = candidates[0]
    best = first(1.0 + size)
    for other, made in candidates[1:]:
        is_larger = other > size
        size = select(is_larger, other, size)
        best = [select(is_larger, *both) for both in zip(made(1.0 + other), best, strict=True)]
    length = square_root(dot(best, best))
    return scaled(signed(1.0, best[0]) / length, best)


def twist(tree: Tree, place: Place, q: Sequence[Any], v: Sequence[Any]) -> Vector:
    """[w_WF; v_WF] (6), rad/s, m/s."""
    _, steps, shift, _ = _way(tree, place, q)
    first = tree.base_velocity
    turning, moving = list(v[first : first + 3]), list(v[first + 3 : first + 6])
    for step in steps:
        moving = plus(moving, cross(turning, step.shift))
        moved = scaled(v[step.velocity], step.axis)
        if step.slides:
            moving = plus(moving, moved)
        else:
            turning = plus(turning, moved)
    return [*turning, *plus(moving, cross(turning, shift))]


def point_jacobian(tree: Tree, place: Place, q: Sequence[Any], point: Sequence[Any]) -> Matrix:
    """J (6, nv) of a point of F (3; m, F's axes), in F's axes."""
    rotation, *_ = _way(tree, place, q)
    rows, down = jacobian(tree, place, q, times(rotation, point)), transposed(rotation)
    return [*product(down, rows[:3]), *product(down, rows[3:])]


def jacobian(tree: Tree, place: Place, q: Sequence[Any], arm: Sequence[Any] = ZERO) -> Matrix:
    """J (6, nv) with [w_WF; v] = J v, of a point at ``arm`` (3, m) from F's origin."""
    _, steps, _, origin = _way(tree, place, q)
    origin = plus(origin, arm)
    columns: Matrix = [[0.0] * 6 for _ in range(tree.num_velocities)]
    arm = minus(origin, q[tree.base_position + 4 : tree.base_position + 7])
    for k in range(3):
        unit = [float(i == k) for i in range(3)]
        columns[tree.base_velocity + k] = [*unit, *cross(unit, arm)]
        columns[tree.base_velocity + 3 + k] = [*ZERO, *unit]
    for step in steps:
        turned = [*step.axis, *cross(step.axis, minus(origin, step.origin))]
        columns[step.velocity] = [*ZERO, *step.axis] if step.slides else turned
    return [list(row) for row in zip(*columns, strict=True)]


def bias_acceleration(tree: Tree, place: Place, q: Sequence[Any], v: Sequence[Any]) -> Vector:
    """[alpha_WF; a_WF] (6) at constant v, rad/s^2, m/s^2."""
    _, steps, shift, _ = _way(tree, place, q)
    turning = list(v[tree.base_velocity : tree.base_velocity + 3])
    alpha, acceleration = list(ZERO), list(ZERO)
    for step in steps:
        acceleration = plus(acceleration, _of_shift(turning, alpha, step.shift))
        moved = scaled(v[step.velocity], step.axis)
        if step.slides:
            acceleration = plus(acceleration, scaled(2.0, cross(turning, moved)))
        else:
            alpha = plus(alpha, cross(turning, moved))
            turning = plus(turning, moved)
    return [*alpha, *plus(acceleration, _of_shift(turning, alpha, shift))]


def _of_shift(turning: Vector, alpha: Vector, shift: Vector) -> Vector:
    """The acceleration of a point of a body from its origin's."""
    return plus(cross(alpha, shift), cross(turning, cross(turning, shift)))


def _way(tree: Tree, place: Place, q: Sequence[Any]) -> tuple[Matrix, list[_Step], Vector, Vector]:
    """R_WF, the bodies from the base on, the frame's origin from that of the last, and p_WF."""
    first, steps = tree.base_position, list[_Step]()
    rotation, origin = quaternion_matrix(q[first : first + 4]), list(q[first + 4 : first + 7])
    for body in reversed(list(_ancestors(tree, place.body))):
        link = tree.links[body - 1]
        own = list(link.place)
        turned = product(rotation, link.rotation)
        if link.slides:
            own = plus(own, times(link.rotation, scaled(q[link.position], link.axis)))
        shift = times(rotation, own)
        origin = plus(origin, shift)
        axis = times(turned, link.axis)
        if not link.slides:
            turned = product(turned, axis_rotation(link.axis, q[link.position]))
        steps.append(_Step(link.velocity, link.slides, axis, shift, origin))
        rotation = turned
    shift = times(rotation, place.place)
    return product(rotation, place.rotation), steps, shift, plus(origin, shift)


def _ancestors(tree: Tree, body: int) -> Iterator[int]:
    while body:
        yield body
        body = tree.links[body - 1].parent
