"""The files of an MJCF model: bounds on what they make, and files that are missing."""

import math
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import mujoco

from ffsm_drake.common.errors import ModelError, one_line
from ffsm_drake.spacecraft.checked_urdf import require
from ffsm_drake.spacecraft.model_files import files_of

MISSING = "ffsm_missing_"  # names of what stands for a mesh without its file begin so
_MOST_PARTS = 10_000  # made by counts
_COUNTED = {  # element -> attributes whose product is a number of parts, and the most of it
    "replicate": (("count",), math.inf),  # its product with those around it counts
    "composite": (("count",), _MOST_PARTS),
    "flexcomp": (("count",), _MOST_PARTS),
    "hfield": (("nrow", "ncol"), 10_000_000),
    "texture": (("width", "height"), 100_000_000),
    "numeric": (("size",), _MOST_PARTS),
}
_MOST_NUMBERS = 10_000_000  # of a size, but for keyframes
_UNOPENED = re.compile(r"Error opening file '(.*)'")


def compiled(path: Path) -> tuple[Any, Any, list[str]]:
    """Return the specification and the model of an MJCF file, and the names of missing files.

    Textures without their files are removed; marks stand for meshes that are only drawn.

    Raises ModelError: MuJoCo cannot compile it, or it makes too many parts.
    """
    _check_counts(path)
    usual, missing = mujoco.get_mju_user_warning(), list[str]()
    mujoco.set_mju_user_warning(lambda text: None)  # else it writes MUJOCO_LOG.TXT
    try:
        with warnings.catch_warnings(action="ignore"):
            spec = mujoco.MjSpec.from_file(str(path))
            while True:
                try:
                    return spec, spec.compile(), missing
                except ValueError as error:
                    missing.append(_without(spec, error))
    except (ValueError, RuntimeError, TypeError) as error:
        raise ModelError(f"MuJoCo cannot compile it: {one_line(error)}") from error
    finally:
        mujoco.set_mju_user_warning(usual)


def _without(spec: Any, error: ValueError) -> str:
    """Remove the texture or mesh whose file is missing, and return its name. Raises the error if it
    is of another kind, or if the mesh gives a body its inertia.
    """
    found = _UNOPENED.search(str(error))
    assets = [each for each in (*spec.textures, *spec.meshes)
              if each.file and found and found[1].endswith(each.file)]  # fmt: skip
    if not assets:
        raise error
    asset = max(assets, key=lambda each: len(each.file))
    file = Path(asset.file).name
    if asset in spec.textures:
        for material in spec.materials:
            material.textures = ["" if name == asset.name else name for name in material.textures]
    else:
        mesh = asset.name or Path(asset.file).stem
        for shape in [each for each in spec.geoms if each.meshname == mesh]:
            if not shape.parent.explicitinertial:
                raise error
            shape.type, shape.size, shape.meshname = mujoco.mjtGeom.mjGEOM_SPHERE, [1, 0, 0], ""
            shape.name = f"{MISSING}{shape.id} {file}"
    spec.delete(asset)
    return file


def _check_counts(path: Path) -> None:
    """Raise ModelError for a file, or one that it includes, whose counts make too many parts."""
    for file, root in _files(path):
        inside = f"{file.name}: " if file != path else ""
        pending = [(root, 1.0)]
        for element, times in pending:  # grows during the loop; times: made by <replicate>
            parts = times
            for what, count, most in _counts(element):
                parts *= count if element.tag == "replicate" else 1.0
                require(count <= most,
                        f"{inside}<{what}> is {count:.3g}; at most {most:.3g} is read")  # fmt: skip
            require(parts <= _MOST_PARTS, f"{inside}<{element.tag}> would make {parts:.3g} parts; "
                    f"at most {_MOST_PARTS} are read")  # fmt: skip
            pending += [(child, parts) for child in element]


def _files(path: Path) -> Iterator[tuple[Path, Element]]:
    """An MJCF file and the files that it includes or attaches, with their root elements."""
    for file in files_of(str(path), "its files", {}):
        try:
            yield file, ElementTree.parse(file, ElementTree.XMLParser(encoding="utf-8")).getroot()
        except (OSError, ElementTree.ParseError, ValueError, LookupError):
            continue  # which MuJoCo reports


def _counts(element: Element) -> Iterator[tuple[str, float, float]]:
    """What an element counts, the number, and the most of it."""
    keys, most = _COUNTED.get(element.tag, ((), math.inf))
    groups = {keys: most}
    if element.tag == "size":
        groups = {(key,): _MOST_PARTS if key == "nkey" else _MOST_NUMBERS
                  for key in set(element.keys()) - {"memory"}}  # fmt: skip
    for keys, most in groups.items():
        product = 1.0
        for word in " ".join(element.get(key, "") for key in keys).split():
            try:
                product *= max(float(word), 1.0)
            except ValueError:
                continue  # which MuJoCo reports
        yield " ".join((element.tag, *keys)), product, most
