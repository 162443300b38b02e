"""The files of a model, checked before Drake opens them: it would read a device or FIFO forever,
and abort on some numbers of a URDF.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree

from ffsm_drake.common.errors import ModelError, one_line
from ffsm_drake.common.files import check_regular
from ffsm_drake.common.memo import memoized
from ffsm_drake.spacecraft.checked_urdf import check_directives, check_poses, parse

DRAWABLE = (".obj", ".gltf", ".dae")  # meshes that Meshcat and the recording can draw
_TEXTS = (".urdf", ".sdf", ".xml", ".yaml", ".yml", ".gltf", ".obj", ".mtl")
_PLACES = {".yaml": check_directives, ".yml": check_directives, ".sdf": check_poses}
_MAX_SIZE = 500_000_000  # bytes
_MAX_READ = 5_000_000  # characters searched for names of further files
# A file name in XML, JSON or YAML, or at the end of a line of a Wavefront file.
_NAMES = re.compile(
    r"""\b(?:filename|file|uri|url)["']?\s*[=:]\s*(?:"([^"\n]*)"|'([^'\n]*)'|([^\s"'<>,}]+))"""
    r"""|<uri>\s*([^<\s]+)"""
    r"""|^\s*(?:mtllib|map_\w+|bump|disp|refl|norm)\s.*?(\S+)\s*$""",
    re.MULTILINE,
)


def files_of(address: str, place: str, packages: Mapping[str, str]) -> tuple[Path, ...]:
    """The file of a model with all files named in it, regular and not too large.

    Drake reports missing files.

    Args:
      address: a path, or a package:// or file:// address.
      place: names the file in the error.
      packages: package:// name -> folder.

    Raises:
      ModelError: one of them is a device, a FIFO, a folder, too large, or an unusable URDF;
        directives or an SDF with other than UTF-8 text, or places that cannot be used.
    """
    first = next(_resolved(address, Path(), packages), None)
    try:
        if first is None or not first.exists():
            return ()
    except (OSError, ValueError):
        return ()
    problem, files = _checked(first, packages)
    if problem:
        raise ModelError(f"{place}: {problem}")
    return files


@memoized(maxsize=64)  # plants are made many times
def _checked(first: Path, packages: Mapping[str, str]) -> tuple[str, tuple[Path, ...]]:
    """The first problem of a file and the files that it names, or "", and the files."""
    pending = [first]
    for path in pending:  # grows during the loop
        try:
            check_regular(path, limit=_MAX_SIZE)
            if path.suffix.lower() == ".urdf":
                parse(path)
            if path.suffix.lower() in _TEXTS:
                checks = _PLACES.get(path.suffix.lower())
                with path.open(encoding="utf-8", errors="strict" if checks else "replace") as file:
                    text = file.read(_MAX_READ)
                if checks:
                    checks(text)
                for found in _NAMES.finditer(text):
                    name = next(filter(None, found.groups()), "")
                    further = _resolved(name, path.parent, packages)
                    pending += [other for other in further if other not in pending]
        except FileNotFoundError:
            continue
        except (ModelError, OSError, ValueError) as error:
            named = "" if path == pending[0] else f"{path}: "
            if isinstance(error, UnicodeDecodeError):
                return f"{named}is not UTF-8 text; save it as UTF-8", ()
            remedy = "" if isinstance(error, ModelError) else "; give a file"
            return f"{named}{one_line(error)}{remedy}", ()
    return "", tuple(pending)


def _resolved(name: str, folder: Path, packages: Mapping[str, str]) -> Iterator[Path]:
    """The path of a file that is named in a file of ``folder``, if it has one."""
    scheme, separator, rest = name.rpartition("://")
    if not separator and not name.startswith("data:"):
        yield folder / name
    elif scheme == "file":
        yield Path(rest)
    elif scheme == "package":
        package, _, inside = rest.partition("/")
        if package in packages:
            yield Path(packages[package]) / inside


def check_collada(path: Path) -> None:
    """Raise ValueError unless a file is COLLADA, which only browsers read."""
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise ValueError(one_line(error)) from error
    if not root.tag.endswith("COLLADA"):
        raise ValueError(f"its root element is <{root.tag}>, not <COLLADA>")
