"""Writing the copy of a URDF that Drake loads, with its meshes, and listing the omissions."""

import copy
import re
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from ffsm_drake.common.files import write_text
from ffsm_drake.common.numbers import counted
from ffsm_drake.plugins.new.urdf.drawing import color_visual, draw_bare_links
from ffsm_drake.plugins.new.urdf.elements import WORLD, listed, name_of, package_folders
from ffsm_drake.plugins.new.urdf.servicer import Servicer
from ffsm_drake.plugins.new.urdf.stl import as_wavefront
from ffsm_drake.plugins.new.urdf.target import Target
from ffsm_drake.spacecraft.checked_urdf import DRAKE, number
from ffsm_drake.spacecraft.model_files import DRAWABLE

# A file name in a mesh: in quotes, between tags, or at the end of a line of a Wavefront file.
_NAMED_FILE = re.compile(
    r'(?:["\'>]|^\s*\w+\s)([^"\'<>\n]+\.(?:mtl|bin|png|jpe?g|ktx2|webp))', re.MULTILINE | re.I
)
_REASONS = {
    "dynamics": "damping and friction left out ({times}): the equations of motion here have none",
    "collision": "collision shapes left out ({times}): contact is not modelled",
}


def write_urdf(
    servicer: Servicer | Target, directory: Path, *, file_name: str, packages: Mapping[str, Path]
) -> tuple[str, ...]:
    """Write the copy for Drake, with its meshes. Returns the omissions, one per line.

    Args:
      servicer: the servicer or target read from the original.
      directory: gets the URDF and a folder ``meshes``.
      packages: folder of each ROS package in mesh addresses; other packages are searched above the
        URDF.

    Raises:
      RecordError, OSError: the folder cannot be written.
    """
    root = copy.deepcopy(servicer.root)
    left_out = _strip(root)
    _inline_colors(root)
    remarks = [
        *_omissions(left_out),
        *_copy_meshes(root, servicer.source.resolve(), directory / "meshes", packages),
    ]
    drawn = draw_bare_links(
        root, base_links=servicer.base_links, radius=max(0.02 * servicer.reach, 0.01)
    )
    if drawn:
        boxes = [name for name in drawn if name in servicer.base_links]
        ignored = f" (not counted for clearances: {listed(boxes)})" if boxes else ""
        remarks.append(f"links without a picture drawn as plain bodies: {listed(drawn)}{ignored}")
    root.set("name", root.get("name") or "servicer")
    ElementTree.indent(root)
    ElementTree.register_namespace("drake", DRAKE.strip("{}"))
    items = "".join(f"\n  - {remark}" for remark in remarks)
    comment = f"Made from {servicer.source.name} by 'ffsm new'.{items}".replace("--", "- -")
    parts = (
        '<?xml version="1.0" encoding="UTF-8"?>',
        *([servicer.header] if servicer.header else []),
        f"<!-- {comment} -->",
        ElementTree.tostring(root, encoding="unicode"),
    )
    write_text(directory / file_name, "\n".join(parts) + "\n")
    return tuple(remarks)


def _strip(root: Element) -> Counter[str]:
    """Remove unused elements. Returns the number of meaningful ones removed, by kind."""
    left_out: Counter[str] = Counter()
    fixed = {name_of(joint) for joint in root.findall("joint") if joint.get("type") == "fixed"}
    for element in list(root):
        parent = element.find("parent")
        name = element.get("name") if element.tag == "link" else None
        if WORLD in (name, None if parent is None else parent.get("link")):
            root.remove(element)
        elif element.tag == "transmission" and _has_rotor(element):
            # Drake adds its inertia to the joint's; a fixed joint does not turn it.
            if any(joint.get("name") in fixed for joint in element.findall("joint")):
                root.remove(element)
        elif element.tag not in (
            "link",
            "joint",
            "material",
            "frame",
        ) and not element.tag.startswith(DRAKE):
            root.remove(element)
            left_out[element.tag] += 1
    for joint in root.iter("joint"):
        place = f"joint '{name_of(joint)}'"
        for tag in ("dynamics", "calibration", "safety_controller"):
            for element in joint.findall(tag):
                joint.remove(element)
                if tag != "dynamics" or any(
                    number(element, key, place, "0") for key in ("damping", "friction")
                ):
                    left_out[tag] += 1
    for link in root.iter("link"):
        for element in link.findall("collision"):
            link.remove(element)
            left_out["collision"] += 1
        for inertial in link.findall("inertial"):
            if not any(float(mass.get("value") or 0.0) for mass in inertial.findall("mass")):
                link.remove(inertial)
    return left_out


def _has_rotor(transmission: Element) -> bool:
    return any(element.tag.endswith("rotor_inertia") for element in transmission.iter())


def _omissions(left_out: Counter[str]) -> Iterator[str]:
    for tag, reason in _REASONS.items():
        if left_out[tag]:
            yield reason.format(times=counted(left_out[tag], "time"))
    others = [
        f"<{tag}> ({counted(n, 'time')})"
        for tag, n in left_out.items()
        if tag not in _REASONS and n
    ]
    if others:
        yield f"left out, not used here: {', '.join(others)}"


def _inline_colors(root: Element) -> None:
    """Define every visual's colour in place, as Drake refuses repeated names; drop textures."""
    colors: dict[str, str] = {}
    for material in root.iter("material"):
        rgba = next((color.get("rgba", "") for color in material.findall("color")), "")
        if not material.get("name"):
            material.set("name", rgba)
        if rgba:
            colors.setdefault(material.get("name", ""), rgba)
    for parent in (root, *root.iter("visual")):
        for material in parent.findall("material"):
            parent.remove(material)
            name = material.get("name", "")
            if parent is not root and name in colors:
                color_visual(parent, name, colors[name])


def _copy_meshes(
    root: Element, source: Path, folder: Path, packages: Mapping[str, Path]
) -> Iterator[str]:
    """Copy the drawable meshes, STL as Wavefront, and address the copies; drop other visuals.

    Yields remarks.
    """
    missing: list[str] = []
    undrawable: list[str] = []
    places: dict[Path, str] = {}  # folder of meshes -> the name of its copy
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            mesh = visual.find("geometry/mesh")
            if mesh is None:
                continue
            address = mesh.attrib.pop("uri", "")
            address = mesh.get("filename") or address
            file = _find_mesh(address, source, packages)
            is_stl = file is not None and file.suffix.lower() == ".stl"
            converted = as_wavefront(file) if file is not None and is_stl else None
            if file is None or (converted is None and file.suffix.lower() not in DRAWABLE):
                link.remove(visual)
                (missing if file is None else undrawable).append(address)
                continue
            place = places.setdefault(file.parent, f"{len(places) + 1}")
            if converted is not None:
                (folder / place).mkdir(parents=True, exist_ok=True)
                write_text(folder / place / f"{file.name}.obj", converted)
                mesh.set("filename", f"{folder.name}/{place}/{file.name}.obj")
                continue
            for each in _with_companions(file):
                target = folder / place / each.relative_to(file.parent)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(each, target)
            mesh.set("filename", f"{folder.name}/{place}/{file.name}")
    is_package = any(address.startswith(("package:", "model:")) for address in missing)
    found_by = "give --package NAME=FOLDER" if is_package else f"put them beside {source.name}"
    for addresses, problem, remedy in (
        (missing, "not found", f"{found_by} to have them drawn"),
        (undrawable, "of an undrawable format",
         f"convert them to {', '.join((*DRAWABLE, '.stl'))}"),
    ):  # fmt: skip
        if addresses:
            # Only the name of an absolute path: the copy should not reveal its author's folders.
            shown = [
                Path(each).name if each.startswith(("/", "file:")) else each
                for each in dict.fromkeys(addresses)
            ]
            times = counted(len(addresses), "time")
            yield f"meshes {problem} ({times}, {', '.join(shown[:3])}): {remedy}"


def _find_mesh(address: str, source: Path, packages: Mapping[str, Path]) -> Path | None:
    """The file of a mesh address: a path relative to the URDF ``source``, or a URL."""
    scheme, _, rest = address.rpartition("://")
    if scheme in ("", "file"):
        candidates = [source.parent / rest]
    else:
        package, _, inside = rest.partition("/")
        candidates = [folder / inside for folder in package_folders(package, source, packages)]
    return next((file.resolve() for file in candidates if file.is_file()), None)


def _with_companions(mesh: Path) -> list[Path]:
    """A mesh and the files in its folder that it names: materials, textures, buffers."""
    files = [mesh]
    for file in files:  # grows during the loop
        if file.suffix.lower() not in (*DRAWABLE, ".mtl"):
            continue
        for named in _NAMED_FILE.findall(file.read_text(encoding="utf-8", errors="replace")):
            for name in (named.strip(), named.split()[-1]):  # a texture may follow options
                other = (mesh.parent / name).resolve()
                if other not in files and other.is_relative_to(mesh.parent) and other.is_file():
                    files.append(other)
    return files
