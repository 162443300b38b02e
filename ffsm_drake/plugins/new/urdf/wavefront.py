"""Wavefront files, which can be drawn, from polygons and from STL files."""

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ffsm_drake.common.files import check_regular

_MOST = 200_000_000  # bytes
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_CORNER = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")


def wavefront(points: np.ndarray, faces: Iterable[Iterable[int]]) -> str:
    """The text of a Wavefront file: points (n, 3), and the corners of its polygons, from 0."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in points.tolist()]
    return "".join([*lines, *(f"f {' '.join(str(1 + k) for k in face)}\n" for face in faces)])


def of_stl(file: Path) -> str | None:
    """The text of a Wavefront file with the triangles of an STL file; None if it has none.

    Raises OSError: it cannot be read.
    """
    check_regular(file, limit=_MOST)
    content = file.read_bytes()
    count = int.from_bytes(content[80:84], "little")
    if len(content) == 84 + count * _TRIANGLE.itemsize:
        corners = np.frombuffer(content, _TRIANGLE, offset=84)["corners"].reshape(-1, 3)
    else:
        try:
            corners = np.array(_CORNER.findall(content), dtype=float).reshape(-1, 3)
        except ValueError:
            return None
    if not len(corners) or len(corners) % 3 or not np.isfinite(corners).all():
        return None
    vertices, order = np.unique(corners, axis=0, return_inverse=True)
    return wavefront(vertices, order.reshape(-1, 3).tolist())
