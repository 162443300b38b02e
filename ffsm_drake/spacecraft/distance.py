"""Signed distances between convex solids, by MuJoCo, whose search has a bound on its iterations.

Drake's own search does not end for some pairs (capsules with axes that meet, a tetrahedron on a
box). A mesh is represented by its convex hull, in single precision.
"""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from pydrake.geometry import Box, Capsule, Convex, Cylinder, Ellipsoid, Mesh, Shape, Sphere
from pydrake.math import RigidTransform

_ITERATIONS, _TOLERANCE = 1000, 1e-12  # of a search; m
_LEAST, _MOST = 1e-9, 1e10  # m; of a size, of a distance
_THIN, _GROWN = 1e-4, 1e-6  # a hull thinner than a share of its size grows by a share of it, or m
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def vertices_of(shape: Convex | Mesh) -> np.ndarray:
    """Return the vertices (n, 3) of a mesh's convex hull, m. Raises RuntimeError: it has none."""
    hull = shape.GetConvexHull()
    return np.array([hull.vertex(k) for k in range(hull.num_vertices())])


def measures_of(shape: Shape) -> tuple[str, np.ndarray]:
    """MuJoCo's name for the kind of a shape, and its sizes or vertices, m.

    Raises RuntimeError, ValueError: it cannot be measured.
    """
    match shape:
        case Box():
            return "box", 0.5 * np.array(shape.size())
        case Sphere():
            return "sphere", np.array([shape.radius(), 0.0, 0.0])
        case Capsule() | Cylinder():
            kind = "capsule" if isinstance(shape, Capsule) else "cylinder"
            return kind, np.array([shape.radius(), 0.5 * shape.length(), 0.0])
        case Ellipsoid():
            return "ellipsoid", np.array([shape.a(), shape.b(), shape.c()])
        case Convex() | Mesh():
            return "mesh", vertices_of(shape)
    raise ValueError("is unbounded")


class Solids:
    """Convex solids, each fixed to a body."""

    # MuJoCo's depth of a capsule in a box is inexact; of one in the box's corners it is not.
    boxes_by_corners = True

    def __init__(self, shapes: Sequence[tuple[int, Shape, RigidTransform]]) -> None:
        """Args:
          shapes: of each solid the number of its body, its shape, and its pose X_BG in the body.

        Raises:
          RuntimeError, ValueError: a shape cannot be measured.
        """
        import mujoco  # slow

        spec = mujoco.MjSpec()
        spec.option.ccd_iterations, spec.option.ccd_tolerance = _ITERATIONS, _TOLERANCE
        # The tree that speeds up rays has the solids where they were compiled.
        spec.option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
        made = [(*measures_of(shape), X_BG) for _, shape, X_BG in shapes]
        by_corners = self.boxes_by_corners and any(kind == "capsule" for kind, *_ in made)
        for k, (kind, sizes, X_BG) in enumerate(made):
            if by_corners and kind == "box":
                kind, sizes = "mesh", sizes * _CORNERS
            geom = spec.worldbody.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"))
            if kind == "mesh":
                X_BG = X_BG @ RigidTransform(middle := sizes.mean(axis=0))
                mesh = spec.add_mesh(name=f"{k}", uservert=_thick(sizes - middle).ravel())
                mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
                geom.meshname = mesh.name
            else:
                geom.size = np.maximum(sizes, _LEAST)
            geom.pos, geom.quat = X_BG.translation(), X_BG.rotation().ToQuaternion().wxyz()
        self._model = spec.compile()
        self._data, self._calc = mujoco.MjData(self._model), mujoco.mj_geomDistance
        turns = np.empty((len(made), 9))
        for turn, quaternion in zip(turns, self._model.geom_quat, strict=True):
            mujoco.mju_quat2Mat(turn, quaternion)
        self._bodies = np.array([body for body, _, _ in shapes], dtype=int)
        self._turns = turns.reshape(-1, 3, 3)
        self._box = self._model.geom_aabb.reshape(-1, 2, 3)  # centre, half its sides

    def place(self, poses: np.ndarray) -> None:
        """Put the bodies at poses (bodies, 3, 4) in the world."""
        R, p = np.split(poses.reshape(-1, 3, 4)[self._bodies], [3], axis=2)
        turns = R @ self._turns
        self._data.geom_xmat[:] = turns.reshape(-1, 9)
        self._data.geom_xpos[:] = places = (p + R @ self._model.geom_pos[..., None])[..., 0]
        self._centres = places + (turns @ self._box[:, 0, :, None])[..., 0]
        self._halves = (np.abs(turns) @ self._box[:, 1, :, None])[..., 0]

    def least(self, pairs: np.ndarray, most: float = np.inf) -> tuple[float, int]:
        """Return the smallest distance (m) of pairs (n, 2), if below ``most``, and the pair's
        number; infinity and -1 without one.
        """
        apart, found = self._apart(pairs), -1
        near = np.flatnonzero(apart < most)
        for k in near[np.argsort(apart[near], kind="stable")].tolist():
            if apart[k] >= most:
                break
            distance = self._distance(pairs[k], max(most, _LEAST), None)
            if distance < most:
                most, found = distance, k
        return (most if found >= 0 else np.inf), found

    def within(self, pairs: np.ndarray, most: float) -> Iterator[tuple[int, float, np.ndarray]]:
        """The pairs of pairs (n, 2) nearer than ``most`` (m): number, distance, nearest points
        (2, 3) in the world.
        """
        points = np.zeros(6)
        for k in np.flatnonzero(self._apart(pairs) < most).tolist():
            if (distance := self._distance(pairs[k], most, points)) < most:
                yield k, distance, points.reshape(2, 3).copy()

    def _distance(self, pair: np.ndarray, most: float, points: np.ndarray | None) -> float:
        return float(self._calc(self._model, self._data, *pair, min(most, _MOST), points))

    def _apart(self, pairs: np.ndarray) -> np.ndarray:
        """Return the signed distances (n), m, of the boxes about the solids of pairs, along the
        world's axes; those of the solids are not smaller.
        """
        i, j = pairs.T
        gaps = np.abs(self._centres[i] - self._centres[j]) - self._halves[i] - self._halves[j]
        outside = np.sqrt((np.maximum(gaps, 0.0) ** 2).sum(axis=1))
        return outside + np.minimum(gaps.max(axis=1), 0.0) - _GROWN


def _thick(vertices: np.ndarray) -> np.ndarray:
    """Vertices (n, 3) about the origin that span a volume: a flat, thin or tiny mesh's with corners
    around each.
    """
    spans = np.linalg.svd(vertices, compute_uv=False)
    if len(vertices) > 3 and spans[-1] > max(_THIN * spans[0], _GROWN):
        return vertices
    grown = _GROWN * max(float(np.abs(vertices).max()), 1.0)
    return (vertices[:, None] + grown * _CORNERS).reshape(-1, 3)
