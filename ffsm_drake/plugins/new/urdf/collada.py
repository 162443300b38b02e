"""COLLADA meshes as Wavefront ones, which can be drawn and measured."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from ffsm_drake.common.files import check_regular
from ffsm_drake.plugins.new.urdf.wavefront import wavefront

_MOST = 200_000_000  # bytes
_DEPTH = 50  # of nodes within nodes
_MAX_FACES = 5_000_000
_UNREAD = ("instance_controller", "lookat", "skew")
# primitive -> the corners of its k-th triangle
_CORNERS: dict[str, Callable[[int], tuple[int, int, int]]] = {
    "triangles": lambda k: (3 * k, 3 * k + 1, 3 * k + 2),
    "trifans": lambda k: (0, k + 1, k + 2),
    "tristrips": lambda k: (k, k + 1, k + 2),
}
Part = tuple[np.ndarray, list[list[int]]]  # points (n, 3), and the corners of each polygon


def of_collada(file: Path) -> str | None:
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
        unit = root.find("asset/unit")
        scale = 1.0 if unit is None else float(unit.get("meter", "1"))
        _require(root.findtext("asset/up_axis", "").strip() == "Z_UP" and scale > 0.0)
        named = {f"#{each.get('id')}": each for each in root.iter()}
        (shown,) = root.findall("scene/instance_visual_scene")
        parts = [*_parts(named[shown.get("url", "")], named, np.diag([scale, scale, scale, 1.0]))]
        _require(parts and all(np.isfinite(points).all() for points, _ in parts))
    except (ElementTree.ParseError, ValueError, LookupError, TypeError):
        return None
    starts = np.cumsum([0, *(len(points) for points, _ in parts)]).tolist()
    faces = [
        [start + k for k in face]
        for start, (_, own) in zip(starts[:-1], parts, strict=True)
        for face in own
    ]
    return wavefront(np.concatenate([points for points, _ in parts]), faces)


def _require(condition: object) -> None:
    """Raise ValueError for what is not read here."""
    if not condition:
        raise ValueError


def _parts(
    node: Element, named: Mapping[str, Element], pose: np.ndarray, depth: int = 0
) -> Iterator[Part]:
    """The meshes in a node at a pose (4, 4)."""
    _require(depth <= _DEPTH and not any(each.tag in _UNREAD for each in node))
    for each in node:
        pose = pose @ _transform(each)
    for each in node:
        if each.tag in ("node", "instance_node"):
            inner = each if each.tag == "node" else named[each.get("url", "")]
            yield from _parts(inner, named, pose, depth + 1)
        elif each.tag == "instance_geometry":
            points, faces = _mesh(named[each.get("url", "")], named)
            yield points @ pose[:3, :3].T + pose[:3, 3], faces


def _mesh(geometry: Element, named: Mapping[str, Element]) -> Part:
    """The only mesh of a geometry."""
    (source,) = geometry.findall("mesh/vertices/input[@semantic='POSITION']")
    points = _points(named[source.get("source", "")], named)
    faces = [face for each in geometry.iterfind("mesh/*") for face in _faces(each)]
    _require(0 < len(faces) <= _MAX_FACES)
    _require(all(len(face) > 2 and 0 <= min(face) <= max(face) < len(points) for face in faces))
    return points, faces


def _points(source: Element, named: Mapping[str, Element]) -> np.ndarray:
    values = np.array((source.findtext("float_array") or "").split(), dtype=float)
    (accessor,) = source.findall("technique_common/accessor")
    stride, start, count = (int(accessor.get(k, d)) for k, d in
                            (("stride", "1"), ("offset", "0"), ("count", "0")))  # fmt: skip
    names = [each.get("name") for each in accessor.findall("param")]
    _require(accessor.get("source") in named and stride > 2)
    _require(names[:3] in (["X", "Y", "Z"], [None] * 3))
    return values[start : start + count * stride].reshape(count, stride)[:, :3]


def _faces(primitive: Element) -> Iterator[list[int]]:
    """The corners of each polygon of a child of a mesh."""
    if primitive.tag not in (*_CORNERS, "polylist", "polygons"):
        return
    inputs = {each.get("semantic"): int(each.get("offset", "0"))
              for each in primitive.findall("input")}  # fmt: skip
    _require(primitive.find("ph") is None)
    sizes = [int(word) for word in primitive.findtext("vcount", "").split()]
    for p in primitive.findall("p"):
        corners = [int(word) for word in (p.text or "").split()]
        corners = corners[inputs["VERTEX"] :: 1 + max(inputs.values())]
        if primitive.tag == "polylist":
            ends = np.cumsum(sizes).tolist()
            yield from (corners[end - n : end] for n, end in zip(sizes, ends, strict=True))
        elif primitive.tag == "polygons":
            yield corners
        else:
            count = len(corners) // 3 if primitive.tag == "triangles" else len(corners) - 2
            yield from ([corners[i] for i in _CORNERS[primitive.tag](k)] for k in range(count))


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
        x, y, z, angle = values
        axis = np.array([x, y, z]) / np.linalg.norm([x, y, z])
        found[:3, :3] = Rotation.from_rotvec(angle * axis, degrees=True).as_matrix()
    return found
