"""Intersections of rays with Drake's shapes."""

import math

import numpy as np
from pydrake.geometry import Box, Capsule, Convex, Cylinder, Ellipsoid, Mesh, Shape, Sphere

from ffsm_drake.spacecraft.distance import vertices_of

_LEAST = 1e-4  # m; rays that begin on a shape or within it do not meet it


def first_meeting(shape: Shape, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distances along rays to their entry into a shape from outside, m (n); infinite without one.

    A mesh is represented by the box of its vertices; a half space is never met.

    Args:
      shape: the shape.
      origins: origins of the rays (n, 3) in the shape's frame.
      directions: unit directions (n, 3) in the shape's frame.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        enters, leaves = _span(shape, origins, directions)
    found: np.ndarray = np.where((enters <= leaves) & (enters > _LEAST), enters, np.inf)
    return found


def reach_of(shape: Shape) -> float:
    """Radius about the origin of its frame within which rays meet a shape, m."""
    if isinstance(shape, (Convex, Mesh)):
        return float(np.linalg.norm(_corners(shape), axis=1).max())
    if isinstance(shape, Box):
        return 0.5 * float(np.linalg.norm(shape.size()))
    if isinstance(shape, Sphere):
        return shape.radius()
    if isinstance(shape, Ellipsoid):
        return max(shape.a(), shape.b(), shape.c())
    if isinstance(shape, Cylinder):
        return math.hypot(shape.radius(), 0.5 * shape.length())
    if isinstance(shape, Capsule):
        return shape.radius() + 0.5 * shape.length()
    return 0.0


def _corners(shape: Convex | Mesh) -> np.ndarray:
    """Least and largest corner (2, 3) of the box of its vertices."""
    vertices = vertices_of(shape)
    return np.stack([vertices.min(axis=0), vertices.max(axis=0)])


def _span(shape: Shape, p: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parameters s at which rays p + s u enter and leave a convex shape."""
    if isinstance(shape, Box):
        return _within(0.5 * np.array(shape.size()), p, u)
    if isinstance(shape, Convex | Mesh):
        low, high = _corners(shape)
        return _within(0.5 * (high - low), p - 0.5 * (high + low), u)
    if isinstance(shape, Sphere | Ellipsoid):
        sphere = isinstance(shape, Sphere)
        axes = shape.radius() if sphere else np.array([shape.a(), shape.b(), shape.c()])
        return _round(p / axes, u / axes)
    if isinstance(shape, Cylinder | Capsule):
        barrel = _barrel(shape.radius(), shape.length(), p, u)
        if isinstance(shape, Cylinder):
            return barrel
        end = np.array([0.0, 0.0, 0.5 * shape.length()])
        balls = (_round((p + each) / shape.radius(), u / shape.radius()) for each in (end, -end))
        enters, leaves = np.array([barrel, *balls]).swapaxes(0, 1)
        known = np.where(enters <= leaves, enters, np.inf)
        return known.min(axis=0), np.where(enters <= leaves, leaves, -np.inf).max(axis=0)
    return np.full(len(p), np.inf), np.full(len(p), -np.inf)


def _within(half: np.ndarray, p: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parameters at which rays enter and leave a box about the origin."""
    sides = np.stack([(-half - p) / u, (half - p) / u])
    sides = np.where(np.isnan(sides), np.array([-np.inf, np.inf])[:, None, None], sides)
    return sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)


def _round(p: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same for the unit ball; with two coordinates, for the unit disc's cylinder."""
    a, b, c = (u * u).sum(axis=1), (p * u).sum(axis=1), (p * p).sum(axis=1) - 1.0
    root = np.sqrt(b * b - a * c)
    enters, leaves = (-b - root) / a, (-b + root) / a
    along = a < 1e-24  # a cylinder's axis
    enters = np.where(along, np.where(c <= 0.0, -np.inf, np.inf), enters)
    leaves = np.where(along, np.where(c <= 0.0, np.inf, -np.inf), leaves)
    missed = np.isnan(root) & ~along
    return np.where(missed, np.inf, enters), np.where(missed, -np.inf, leaves)


def _barrel(
    radius: float, length: float, p: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The same for a cylinder about the z axis."""
    around = _round(p[:, :2] / radius, u[:, :2] / radius)
    ends = _within(np.array([0.5 * length]), p[:, 2:], u[:, 2:])
    return np.maximum(around[0], ends[0]), np.minimum(around[1], ends[1])
