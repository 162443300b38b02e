"""Signed distances of convex solids: they are attained, no direction separates them better, and
every search ends. FFSM_DRAWS sets the number of drawn pairs.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Box, Capsule, Cylinder, Ellipsoid, Mesh, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial import ConvexHull

from ffsm_drake.spacecraft.distance import Solids

DRAWS = int(os.environ.get("FFSM_DRAWS", "30"))
SINGLE = 2e-6  # precision of meshes
STILL = np.array([np.eye(3, 4)] * 2)  # poses of two bodies


def rotation(rng) -> RotationMatrix:
    q = rng.normal(size=4)
    return RotationMatrix(Quaternion(q / np.linalg.norm(q)))


def mesh(path: Path, vertices: np.ndarray) -> Mesh:
    lines = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in vertices]
    try:
        faces = ConvexHull(vertices).simplices
    except Exception:  # a flat one
        faces = [[k, k + 1, k + 2] for k in range(len(vertices) - 2)]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(lines))
    return Mesh(str(path))


def draw(rng, path: Path, *, nearly_round: bool = False):
    """A shape, and its support function: the largest n . x in its frame, of directions (m, 3)."""
    least = 0.7 if nearly_round else 0.1
    a, b, c = sizes = 10.0 ** rng.uniform(-1.5, 0.3) * rng.uniform(least, 1.0, 3)
    kind = rng.integers(6)
    if kind == 0:
        return Sphere(a), lambda n: a * np.linalg.norm(n, axis=1)
    if kind == 1:
        return Capsule(a, 2 * b), lambda n: a * np.linalg.norm(n, axis=1) + b * abs(n[:, 2])
    if kind == 2:
        return Cylinder(a, 2 * b), lambda n: a * np.hypot(n[:, 0], n[:, 1]) + b * abs(n[:, 2])
    if kind == 3:
        return Box(*(2 * sizes)), lambda n: abs(n) @ sizes
    if kind == 4:
        return Ellipsoid(a, b, c), lambda n: np.linalg.norm(n * sizes, axis=1)
    vertices = rng.normal(size=(int(rng.integers(4, 40)), 3)) * sizes
    return mesh(path, vertices), lambda n: (n @ vertices.T).max(axis=1)


def measured(first, second):
    """Distance and nearest points of two shapes at poses."""
    solids = Solids([(0, *first), (1, *second)])
    solids.place(STILL)
    pair = np.array([[0, 1]])
    ((_, distance, points),) = solids.within(pair, 1e9)
    assert solids.least(pair)[0] == pytest.approx(distance, abs=1e-9)
    return distance, points


def gap(n, shapes, poses):
    """The gaps between the shadows of two shapes on lines along n (m, 3)."""
    (_, first), (_, second) = shapes
    one, other = (n @ X.rotation().matrix() for X in poses)
    far = n @ (poses[1].translation() - poses[0].translation())
    return far - first(one) - second(-other)


def test_no_direction_separates_better(tmp_path: Path) -> None:
    """A signed distance is the largest gap between the shadows on a line."""
    rng = np.random.default_rng(int(os.environ.get("FFSM_SEED", "3")))
    for k in range(DRAWS):
        shapes = [draw(rng, tmp_path / f"{k}_{i}.obj") for i in range(2)]
        turns = [RotationMatrix() if rng.random() < 0.3 else rotation(rng) for _ in shapes]
        poses = [RigidTransform(R, rng.normal(size=3) * 10 ** rng.uniform(-2, 0.5)) for R in turns]

        distance, points = measured(*((s, X) for (s, _), X in zip(shapes, poses, strict=True)))
        away = (points[1] - points[0]) / distance
        assert gap(away[None], shapes, poses)[0] == pytest.approx(distance, abs=SINGLE)
        n = np.vstack([away, away + 0.01 * rng.normal(size=(200, 3)), rng.normal(size=(800, 3))])
        best = gap(n / np.linalg.norm(n, axis=1)[:, None], shapes, poses).max()
        assert best <= distance + SINGLE, (shapes, distance, best)


def test_depths_of_round_solids_about_one_centre(tmp_path: Path) -> None:
    """Any direction is nearly the best: a depth is at most 2 % too small, and never too large."""
    rng = np.random.default_rng(int(os.environ.get("FFSM_SEED", "3")))
    for k in range(DRAWS):
        shapes = [draw(rng, tmp_path / f"{k}_{i}.obj", nearly_round=True) for i in range(2)]
        poses = [RigidTransform(rotation(rng), 0.002 * rng.normal(size=3)) for _ in shapes]
        distance, points = measured(*((s, X) for (s, _), X in zip(shapes, poses, strict=True)))
        least = gap((points[1:] - points[:1]) / distance, shapes, poses)[0]
        assert -SINGLE <= distance - least <= 0.02 * abs(distance) + SINGLE


def test_capsules_whose_axes_meet(tmp_path: Path) -> None:
    """Links drawn end to end, universal joints, forks: the sum of the radii."""
    rng = np.random.default_rng(4)
    for _ in range(DRAWS):
        radii, halves = 10.0 ** rng.uniform(-2, 0, 2), 10.0 ** rng.uniform(-2, 0.5, 2)
        turns = [rotation(rng) for _ in range(2)]
        along = rng.choice([-1.0, 0.0, 1.0, rng.uniform(-1, 1)], 2)
        ends = [R.matrix()[:, 2] * h * s for R, h, s in zip(turns, halves, along, strict=True)]
        place = rng.normal(size=3)
        shapes = [
            (Capsule(radius, 2 * half), RigidTransform(R, place - end))
            for radius, half, R, end in zip(radii, halves, turns, ends, strict=True)
        ]
        distance, _ = measured(*shapes)
        assert distance == pytest.approx(-radii.sum(), abs=1e-12)


@pytest.mark.parametrize("size", [1e-6, 1e-3, 1.0, 1e3])
def test_odd_shapes_return(size: float, tmp_path: Path) -> None:
    """Flat meshes, a tetrahedron on a box, shapes within or upon each other, and many vertices."""
    rng = np.random.default_rng(5)
    round_ = rng.normal(size=(1000, 3))
    tetrahedron = size * np.array([[0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    shapes = {
        "flat": mesh(tmp_path / "f.obj", size * np.c_[rng.normal(size=(5, 2)), np.zeros(5)]),
        "tetrahedron": mesh(tmp_path / "t.obj", tetrahedron),
        "many": mesh(
            tmp_path / "m.obj", size * round_ / np.linalg.norm(round_, axis=1)[:, None]
        ),
        "box": Box(*3 * [2 * size]),
        "thin": Box(2 * size, 2 * size, 1e-9 * size),
        "capsule": Capsule(size, size),
        "point": Sphere(0.0),
    }  # fmt: skip
    names, known = list(shapes), list(shapes.values())
    solids = Solids([(body, shape, RigidTransform()) for body in (0, 1) for shape in known])
    for shift in (0.0, 1e-9, 0.3, 1.0, 3.0, 100.0):
        away = np.eye(3, 4)
        away[2, 3] = size * shift
        solids.place(np.array([np.eye(3, 4), away]))
        for k in range(len(known) ** 2):
            i, j = divmod(k, len(known))
            distance, _ = solids.least(np.array([[i, len(known) + j]]))
            what = (names[i], names[j], shift, distance)
            assert -4.1 * size - 1e-5 <= distance <= size * max(shift, 1.0) + 1e-5, what
            assert distance >= size * (shift - 4.1) - 1e-5, what
