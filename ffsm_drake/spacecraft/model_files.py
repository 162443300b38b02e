"""The files of a model, checked before Drake opens them: it would read a device or FIFO forever,
and abort on some numbers of a URDF.
"""

import contextlib
import itertools
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree

from ffsm_drake.common.errors import ModelError, one_line
from ffsm_drake.common.files import check_regular
from ffsm_drake.common.memo import memoized
from ffsm_drake.spacecraft.checked_urdf import (
    Faults,
    check,
    check_directives,
    decoded,
    read_xml,
    require,
)
from ffsm_drake.spacecraft.inertia import mend, read_mass

DRAWABLE = (".obj", ".gltf", ".dae")  # meshes that Meshcat and the recording can draw
_TEXTS = (".urdf", ".sdf", ".xml", ".yaml", ".yml", ".gltf", ".dae", ".obj", ".mtl")
_PLACES: dict[str, Callable[[str], object]] = {  # texts in UTF-8, and further checks
    ".yaml": check_directives, ".yml": check_directives, ".sdf": str, ".xml": str,
}  # fmt: skip
MAX_SIZE = 500_000_000  # bytes
_MAX_READ = 5_000_000  # characters searched for names of further files
# A file name in XML, JSON or YAML, or at the end of a line of a Wavefront file.
_NAMES = re.compile(
    r"""\b(?:filename|file|uri|url)["']?\s*[=:]\s*(?:"([^"\n]*)"|'([^'\n]*)'|([^\s"'<>,}]+))"""
    r"""|<(?:uri|init_from)>\s*([^<\n]*[^<\s])"""
    r"""|^\s*(?:mtllib|map_\w+|bump|disp|refl|norm)\s+(.*?(\S+))\s*$""",  # it may follow options
    re.MULTILINE,
)


def files_of(address: str, place: str, packages: Mapping[str, str]) -> tuple[Path, ...]:
    """Return the file of a model with all files named in it, regular and not too large.

    Drake reports missing files.

    Args:
      address: a path, or a package:// or file:// address.
      place: names the file in the error.
      packages: package:// name -> folder.

    Raises:
      ModelError: one of them is a device, a FIFO, a folder, too large, or an unusable URDF;
        directives or an SDF with other than UTF-8 text, or places that cannot be used.
    """
    first = next(resolved(address, Path(), packages), None)
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
    """Return the first problem of a file and the files that it names, or "", and the files."""
    pending = [first]
    for path in pending:  # grows during the loop
        try:
            if model := [*path.glob("model.*")]:  # the folder of a model in SDFormat
                pending += [part for part in model if part not in pending]
                continue
            check_regular(path, limit=MAX_SIZE)
            if path.suffix.lower() in (".urdf", ".xacro"):
                _parsed(path)
            if path.suffix.lower() in _TEXTS:
                if path.suffix.lower() in _PLACES:
                    text = decoded(path.read_bytes())
                    _PLACES[path.suffix.lower()](text)
                else:
                    with path.open(encoding="utf-8", errors="replace") as file:
                        text = file.read(_MAX_READ)
                for found in _NAMES.finditer(text[:_MAX_READ]):
                    folders = path.parent, first.parent  # the latter for MuJoCo
                    for name, folder in itertools.product(filter(None, found.groups()), folders):
                        further = resolved(name, folder, packages)
                        pending += [other for other in further if other not in pending]
        except FileNotFoundError:
            continue
        except (ModelError, OSError, ValueError) as error:
            named = "" if path == pending[0] else f"{path}: "
            remedy = "" if isinstance(error, ModelError) else "; give a file"
            return f"{named}{one_line(error)}{remedy}", ()
    return "", tuple(pending)


@contextlib.contextmanager
def mended(files: Iterable[Path]) -> Iterator[dict[Path, Path]]:
    """Copies of the URDFs whose inertias hold rounding that Drake refuses, without it."""
    texts = {
        file: _mended(file)
        for file in files
        if file.suffix.lower() == ".urdf" and file.is_file()  # which Drake reports
    }
    with contextlib.ExitStack() as stack:
        copies = dict[Path, Path]()
        for file, text in texts.items():
            if text:
                folder = stack.enter_context(tempfile.TemporaryDirectory())
                copies[file] = Path(folder, file.name)
                copies[file].write_text(text, encoding="utf-8")
        yield copies


@memoized(maxsize=64)
def _mended(file: Path) -> str:
    """Return the text of a URDF without the rounding of its inertias; "" if there is none."""
    root = _parsed(file)
    if not mend(root):
        return ""
    for element in root.iter():
        if "://" not in (name := element.get("filename", "://")):
            element.set("filename", str((file.parent / name).absolute()))
    return ElementTree.tostring(root, encoding="unicode")


def _parsed(path: Path) -> ElementTree.Element:
    """Return the root element of a URDF. Raises ModelError: it is none, or its names, numbers or
    inertias cannot be used; it names link or joint, element and attribute.
    """
    root, _ = read_xml(path, "the URDF of base and arm")
    tags = {path.suffix.lower(), *(element.tag for element in root.iter())}
    require(
        not any("xacro" in tag for tag in tags),
        f"is a xacro file; convert it: ffsm new NAME --model {path.name}",
    )
    check(root)
    faults = Faults()
    for link in root.findall("link"):
        with faults:
            read_mass(link)
    faults.raise_all()
    return root


def resolved(name: str, folder: Path, packages: Mapping[str, str]) -> Iterator[Path]:
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
