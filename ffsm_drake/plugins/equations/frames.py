"""Kinematics of a frame on a body of a joint tree, on numbers or symbols; world axes."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.plugins.equations.equations import axis_rotation
from ffsm_drake.plugins.equations.tree import Place, Tree
from ffsm_drake.plugins.tape.numbers import select, signed, square_root


class _Step(NamedTuple):
    """A body on the way from the base to a frame."""

    velocity: int  # index in v of its joint's rate
    slides: bool
    axis: Any  # of the joint
    shift: Any  # of its origin from the body's before, m
    origin: Any  # p_W, m


def pose(tree: Tree, place: Place, q: Any) -> tuple[Any, Any]:
    """R_WF (..., 3, 3) and p_WF (..., 3), m, in configurations q (..., nq)."""
    rotation, *_, origin = _way(tree, place, q)
    return rotation, origin


def quaternion_of(rotation: Any) -> list[Any]:
    """The quaternion w x y z of a rotation, with w >= 0: of the four expressions with a square root
    of 1 + trace, 1 + xx - yy - zz, ..., the one with the largest.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    candidates: list[tuple[Any, Callable[[Any], list[Any]]]] = [
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
    w, x, y, z = best
    factor = signed(1.0, w) / square_root(w * w + x * x + y * y + z * z)
    return [factor * each for each in best]


def twist(tree: Tree, place: Place, q: Any, v: Any) -> Any:
    """[w_WF; v_WF] (6), rad/s, m/s."""
    _, steps, shift, _ = _way(tree, place, q)
    turning, moving = v[tree.base_velocity :][:3], v[tree.base_velocity + 3 :][:3]
    for step in steps:
        moving = moving + np.cross(turning, step.shift)
        moved = v[step.velocity] * step.axis
        if step.slides:
            moving = moving + moved
        else:
            turning = turning + moved
    return np.concatenate([turning, moving + np.cross(turning, shift)])


def point_jacobian(tree: Tree, place: Place, q: Any, point: Any) -> Any:
    """J (6, nv) of a point of F (3; m, F's axes), in F's axes."""
    down = pose(tree, place, q)[0].T
    rows = jacobian(tree, place, q, down.T @ point)
    return np.concatenate([down @ rows[:3], down @ rows[3:]])


def jacobian(tree: Tree, place: Place, q: Any, arm: Any = (0.0, 0.0, 0.0)) -> Any:
    """J (6, nv) with [w_WF; v] = J v, of a point at ``arm`` (3, m) from F's origin."""
    _, steps, _, origin = _way(tree, place, q)
    origin = origin + np.asanyarray(arm)
    columns: list[Any] = [np.zeros(6)] * tree.num_velocities
    arm = origin - q[tree.base_position + 4 :][:3]
    for k, unit in enumerate(np.eye(3)):
        columns[tree.base_velocity + k] = np.concatenate([unit, np.cross(unit, arm)])
        columns[tree.base_velocity + 3 + k] = np.concatenate([np.zeros(3), unit])
    for step in steps:
        turned = [step.axis, np.cross(step.axis, origin - step.origin)]
        columns[step.velocity] = np.concatenate([np.zeros(3), step.axis] if step.slides else turned)
    return np.stack(columns, axis=1)


def bias_acceleration(tree: Tree, place: Place, q: Any, v: Any) -> Any:
    """[alpha_WF; a_WF] (6) at constant v, rad/s^2, m/s^2."""
    _, steps, shift, _ = _way(tree, place, q)
    turning = v[tree.base_velocity :][:3]
    alpha, acceleration = np.zeros(3), np.zeros(3)
    for step in steps:
        acceleration = acceleration + _of_shift(turning, alpha, step.shift)
        moved = v[step.velocity] * step.axis
        if step.slides:
            acceleration = acceleration + 2.0 * np.cross(turning, moved)
        else:
            alpha = alpha + np.cross(turning, moved)
            turning = turning + moved
    return np.concatenate([alpha, acceleration + _of_shift(turning, alpha, shift)])


def relative_jacobian(tree: Tree, place: Place, other: Place, q: Any) -> Any:
    """J (6, nv) of a frame F as another one, G, sees it: [w_GF; v_GF] = J v, in G's axes."""
    (grasp, origin), (_, tip) = (pose(tree, each, q) for each in (other, place))
    (turns, moves), (turns_F, moves_F) = (
        np.split(jacobian(tree, each, q), 2) for each in (other, place)
    )
    across = np.cross(turns.T, tip - origin).T
    return np.concatenate([grasp.T @ (turns_F - turns), grasp.T @ (moves_F - moves - across)])


def relative_bias(tree: Tree, place: Place, other: Place, q: Any, v: Any) -> Any:
    """[alpha_GF; a_GF] (6) at constant v of a frame F as another one, G, sees it, in G's axes."""
    (grasp, origin), (_, tip) = (pose(tree, each, q) for each in (other, place))
    (alpha, a), (alpha_F, a_F) = (
        np.split(bias_acceleration(tree, each, q, v), 2) for each in (other, place)
    )
    (w, u), (w_F, u_F) = (np.split(twist(tree, each, q, v), 2) for each in (other, place))
    arm = tip - origin
    around = np.cross(w, arm)
    turning = alpha_F - alpha - np.cross(w, w_F - w)
    moving = a_F - a - np.cross(alpha, arm) - np.cross(w, around)
    moving = moving - 2.0 * np.cross(w, u_F - u - around)
    return np.concatenate([grasp.T @ turning, grasp.T @ moving])


def _of_shift(turning: Any, alpha: Any, shift: Any) -> Any:
    """The acceleration of a point of a body from its origin's."""
    return np.cross(alpha, shift) + np.cross(turning, np.cross(turning, shift))


def _way(tree: Tree, place: Place, q: Any) -> tuple[Any, list[_Step], Any, Any]:
    """R_WF, the bodies from the base on, the frame's origin from that of the last, and p_WF."""
    first, steps = tree.base_position, list[_Step]()
    rotation, origin = matrix_of(q[..., first : first + 4]), q[..., first + 4 : first + 7]
    for body in reversed(list(_ancestors(tree, place.body))):
        link = tree.links[body - 1]
        own, turned = np.asanyarray(link.place), rotation @ np.asanyarray(link.rotation)
        axis = turned @ np.array(link.axis)
        shift = rotation @ own
        if link.slides:
            shift = shift + q[..., link.position, None] * axis
        else:
            turned = turned @ axis_rotation(link.axis, q[..., link.position, None, None])
        origin = origin + shift
        steps.append(_Step(link.velocity, link.slides, axis, shift, origin))
        rotation = turned
    shift = rotation @ np.asanyarray(place.place)
    return rotation @ np.asanyarray(place.rotation), steps, shift, origin + shift


def _ancestors(tree: Tree, body: int) -> Iterator[int]:
    while body:
        yield body
        body = tree.links[body - 1].parent
