"""COLLADA meshes as Wavefront ones, which can be drawn and measured."""

import math
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from ffsm_drake.common.files import check_regular

_MOST = 200_000_000  # bytes
_DEPTH = 50  # of nodes within nodes
_MAX_FACES = 5_000_000
_FACES = ("triangles", "trifans", "tristrips", "polylist", "polygons")
_UNREAD = ("instance_controller", "lookat", "skew")


class _NotRead(Exception):
    """The file has what is not read here."""


def as_wavefront(file: Path) -> str | None:
    """The text of a Wavefront file with the polygons of a COLLADA file, in metres; None if it has
    none, or what cannot be read with certainty: an up axis other than z, which some readers turn
    up and others do not, skins, or curves.

    Raises OSError: it cannot be read.
    """
    check_regular(file, limit=_MOST)
    try:
        root = ElementTree.fromstring(file.read_bytes())
        for each in root.iter():
            each.tag = each.tag.rpartition("}")[2]
        if root.findtext("asset/up_axis", "").strip() != "Z_UP":
            return None
        unit = root.find("asset/unit")
        scale = 1.0 if unit is None else float(unit.get("meter", "1"))
        parts = [*_Scene(root).parts()]
    except (_NotRead, ElementTree.ParseError, ValueError, LookupError, TypeError):
        return None
    if not parts or not all(np.isfinite(points).all() for points, _ in parts) or scale <= 0.0:
        return None
    lines, first = list[str](), 1
    for points, faces in parts:
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in (scale * points).tolist()]
        lines += [f"f {' '.join(str(first + k) for k in face)}\n" for face in faces]
        first += len(points)
    return "".join(lines)


class _Scene:
    """The scene of a file."""

    def __init__(self, root: Element) -> None:
        self._named = {f"#{each.get('id')}": each for each in root.iter() if each.get("id")}
        self._root = root

    def parts(self) -> Iterator[tuple[np.ndarray, list[list[int]]]]:
        """The points (n, 3) and faces of each mesh in the scene."""
        shown = self._root.find("scene/instance_visual_scene")
        if shown is None:
            raise _NotRead
        yield from self._node(self._of(shown), np.eye(4), 0)

    def _of(self, element: Element) -> Element:
        """What an element names by its url."""
        return self._named[element.get("url", "")]

    def _node(
        self, node: Element, pose: np.ndarray, depth: int
    ) -> Iterator[tuple[np.ndarray, list[list[int]]]]:
        if depth > _DEPTH:
            raise _NotRead
        for each in node:
            if each.tag in _UNREAD:
                raise _NotRead
            pose = pose @ _transform(each)
        for each in node:
            if each.tag == "node":
                yield from self._node(each, pose, depth + 1)
            elif each.tag == "instance_node":
                yield from self._node(self._of(each), pose, depth + 1)
            elif each.tag == "instance_geometry":
                points, faces = self._mesh(self._of(each))
                yield points @ pose[:3, :3].T + pose[:3, 3], faces

    def _mesh(self, geometry: Element) -> tuple[np.ndarray, list[list[int]]]:
        mesh = geometry.find("mesh")
        if mesh is None:
            raise _NotRead
        places = dict[str, np.ndarray]()
        for vertices in mesh.findall("vertices"):
            source = next(
                each.get("source", "")
                for each in vertices.findall("input")
                if each.get("semantic") == "POSITION"
            )
            places[f"#{vertices.get('id')}"] = self._points(source)
        if len(places) != 1:
            raise _NotRead
        points, faces = next(iter(places.values())), list[list[int]]()
        for each in mesh:
            if each.tag in _FACES:
                faces += _faces(each)
        if not faces or len(faces) > _MAX_FACES or max(map(max, faces)) >= len(points):
            raise _NotRead
        return points, faces

    def _points(self, source: str) -> np.ndarray:
        element = self._named[source]
        values = np.array((element.findtext("float_array") or "").split(), dtype=float)
        accessor = element.find("technique_common/accessor")
        if accessor is None or accessor.get("source", "#") not in self._named:
            raise _NotRead
        stride, start = int(accessor.get("stride", "1")), int(accessor.get("offset", "0"))
        names = [each.get("name") for each in accessor.findall("param")]
        if stride < 3 or names[:3] not in (["X", "Y", "Z"], [None] * 3):
            raise _NotRead
        count = int(accessor.get("count", "0"))
        return values[start : start + count * stride].reshape(count, stride)[:, :3]


def _faces(element: Element) -> list[list[int]]:
    """The corners of each polygon of a primitive."""
    inputs = element.findall("input")
    at = next(int(e.get("offset", "0")) for e in inputs if e.get("semantic") == "VERTEX")
    step = 1 + max(int(each.get("offset", "0")) for each in inputs)
    if element.find("ph") is not None:
        raise _NotRead
    found = list[list[int]]()
    sizes = [int(word) for word in element.findtext("vcount", "").split()]
    for p in element.findall("p"):
        corners = [int(word) for word in (p.text or "").split()][at::step]
        if element.tag == "triangles":
            found += [corners[k : k + 3] for k in range(0, len(corners) - 2, 3)]
        elif element.tag == "polylist":
            ends = np.cumsum(sizes).tolist()
            found += [corners[end - n : end] for n, end in zip(sizes, ends, strict=True)]
        elif element.tag == "polygons":
            found.append(corners)
        elif element.tag == "tristrips":
            found += [corners[k : k + 3] for k in range(len(corners) - 2)]
        else:
            found += [[corners[0], *corners[k : k + 2]] for k in range(1, len(corners) - 1)]
    if any(min(face, default=-1) < 0 or len(face) < 3 for face in found):
        raise _NotRead
    return found


def _transform(element: Element) -> np.ndarray:
    """The transform (4, 4) of a child of a node; the unit matrix for others."""
    found = np.eye(4)
    if element.tag not in ("matrix", "translate", "rotate", "scale"):
        return found
    values = np.array((element.text or "").split(), dtype=float)
    if element.tag == "matrix":
        found = values.reshape(4, 4)
    elif element.tag == "translate":
        found[:3, 3] = values
    elif element.tag == "scale":
        found[:3, :3] = np.diag(values.reshape(3))
    else:
        x, y, z = values[:3] / np.linalg.norm(values[:3])
        angle = math.radians(values.reshape(4)[3])
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        found[:3, :3] += math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
    return found
