"""Writing the copy of a URDF that Drake loads, with its meshes, and listing the omissions."""

import copy
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from ffsm_drake.common.files import write_text
from ffsm_drake.common.numbers import counted
from ffsm_drake.plugins.new.urdf.collada import of_collada
from ffsm_drake.plugins.new.urdf.drawing import draw_bare_links
from ffsm_drake.plugins.new.urdf.elements import WORLD, found_file, listed, name_of
from ffsm_drake.plugins.new.urdf.formats.building import color_visual
from ffsm_drake.plugins.new.urdf.servicer import Servicer
from ffsm_drake.plugins.new.urdf.target import Target
from ffsm_drake.plugins.new.urdf.wavefront import of_stl
from ffsm_drake.spacecraft.checked_urdf import DRAKE
from ffsm_drake.spacecraft.clearance import INVENTED, UNMEASURED
from ffsm_drake.spacecraft.model_files import DRAWABLE, files_of

_SHAPES = ("box", "sphere", "cylinder", "capsule", "ellipsoid")  # that Drake reads
_CONVERTED = {".stl": of_stl, ".dae": of_collada}
_MISSING, _UNDRAWABLE = "meshes not found", "meshes of an undrawable format"
_UNKNOWN = "shapes that cannot be drawn"
_UNDRAWN = {  # what cannot be drawn -> remedy
    _MISSING: "put them next to {source} to have them drawn",
    _UNDRAWABLE: f"convert them to {', '.join((*DRAWABLE, '.stl'))}",
    _UNKNOWN: "replace them with meshes",
}
_PACKAGED = {_MISSING: "give --package NAME=FOLDER to have them drawn"}
_REASONS = {
    "dynamics": "joint damping and friction left out ({times}): --friction adds them as drives",
    "collision": "collision shapes left out ({times}): contact is not modelled",
    "picture": "collision shapes drawn ({times}), of links without a picture that can be drawn",
}


def write_urdf(
    servicer: Servicer | Target, directory: Path, *, file_name: str, packages: Mapping[str, Path]
) -> tuple[str, ...]:
    """Write the copy for Drake, with its meshes.

    Args:
      servicer: the servicer or target read from the original.
      directory: folder for the URDF and a folder ``meshes``.
      packages: folder of each ROS package in mesh addresses; other packages are searched above the
        URDF.

    Returns: the omissions, one per line.

    Raises:
      RecordError, OSError: the folder cannot be written.
    """
    root = copy.deepcopy(servicer.root)
    left_out = _strip(root)
    _inline_colors(root)
    meshes = _Meshes(servicer.source.resolve(), directory / "meshes", packages)
    for link in root.iter("link"):
        left_out += meshes.draw(link)
    remarks = [*_omissions(left_out), *meshes.remarks()]
    drawn = draw_bare_links(
        root, base_links=servicer.base_links, radius=max(0.02 * servicer.reach, 0.01)
    )
    if drawn:
        boxes = [name for name in drawn if name in servicer.base_links]
        ignored = f" (not counted for clearances: {listed(boxes)})" if boxes else ""
        remarks.append(f"links without a picture drawn as plain bodies: {listed(drawn)}{ignored}")
    root.set("name", root.get("name") or "servicer")
    ElementTree.indent(root)
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
        for tag in ("dynamics", "calibration", "safety_controller"):
            for element in joint.findall(tag):
                joint.remove(element)
                if tag != "dynamics" or any(
                    float(element.get(key, "0")) for key in ("damping", "friction")
                ):
                    left_out[tag] += 1
    for link in root.iter("link"):
        for element in link.findall("visual"):
            if element.get("name", "").startswith((INVENTED, UNMEASURED)):
                del element.attrib["name"]  # which have a meaning below
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
    for parent in (root, *root.iter("visual"), *root.iter("collision")):
        for material in parent.findall("material"):
            parent.remove(material)
            name = material.get("name", "")
            if parent is not root and name in colors:
                color_visual(parent, name, colors[name])


class _Meshes:
    """Copies of the drawable meshes of a URDF; STL and COLLADA become Wavefront files.

    Shapes that cannot be drawn become marks, so that clearances name them.
    """

    def __init__(self, source: Path, folder: Path, packages: Mapping[str, Path]) -> None:
        self._source, self._folder, self._packages = source, folder, packages
        self._marked: dict[str, list[str]] = {problem: [] for problem in _UNDRAWN}
        self._places: dict[Path, str] = {}  # folder of meshes -> the name of its copy

    def draw(self, link: Element) -> Counter[str]:
        """Copy the meshes of a link. If no visual can be drawn, its collision shapes are drawn.

        Returns: the numbers of drawn and omitted collision shapes.
        """
        marks = [each for each in link.findall("visual") if not self._copy(each)]
        is_needed = bool(marks) or link.find("visual") is None
        counts = Counter[str]()
        for element in link.findall("collision"):
            element.tag = "visual"
            if is_needed and self._copy(element):
                counts["picture"] += 1
            else:
                counts["collision"] += 1
                if not is_needed:
                    link.remove(element)
        for mark in marks if sum(counts.values()) else ():
            link.remove(mark)
        return counts

    def _copy(self, visual: Element) -> bool:
        """Copy the mesh of a visual, if it has one. Return whether it can be drawn."""
        shape = next(visual.iterfind("geometry/*"), Element("nothing"))
        if shape.tag.removeprefix(DRAKE) in _SHAPES:
            return True
        if (mesh := visual.find("geometry/mesh")) is None:
            self._mark(visual, _UNKNOWN, shape.get("name") or shape.tag)
            return False
        address = mesh.attrib.pop("uri", "")
        address = mesh.get("filename") or address
        file = found_file(address, self._source, self._packages)
        converted = (mesh.text or "").strip()
        mesh.text = None
        if converted:  # a reader's own
            file = self._source.parent / address
        elif file is not None and file.suffix.lower() in _CONVERTED:
            converted = _CONVERTED[file.suffix.lower()](file) or ""
        if file is None or not (converted or file.suffix.lower() in DRAWABLE):
            self._mark(visual, _MISSING if file is None else _UNDRAWABLE, address)
            return False
        place = self._places.setdefault(file.parent, f"{len(self._places) + 1}")
        if converted:
            name = f"{file.name.removesuffix('.obj')}.obj"
            (self._folder / place).mkdir(parents=True, exist_ok=True)
            write_text(self._folder / place / name, f"{converted.rstrip()}\n")
        else:
            name = file.name
            for each in _with_companions(file):
                target = self._folder / place / each.relative_to(file.parent)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(each, target)
        mesh.set("filename", f"{self._folder.name}/{place}/{name}")
        return bool(converted) or file.suffix.lower() != ".dae"

    def remarks(self) -> Iterator[str]:
        """Yield a line for missing meshes, and a line for shapes that cannot be drawn."""
        for problem, addresses in self._marked.items():
            if addresses:
                remedy = _UNDRAWN[problem].format(source=self._source.name)
                if any(each.startswith(("package:", "model:")) for each in addresses):
                    remedy = _PACKAGED.get(problem, remedy)
                # Only the name of an absolute path, which would reveal its author's folders.
                shown = [
                    Path(each).name if each.startswith(("/", "file:")) else each
                    for each in dict.fromkeys(addresses)
                ]
                times = counted(len(addresses), "time")
                yield f"{problem} ({times}, {', '.join(shown[:3])}): {remedy}"

    def _mark(self, visual: Element, problem: str, name: str) -> None:
        """Put a ball in place of a shape that cannot be drawn, so that clearances name it."""
        self._marked[problem].append(name)
        for geometry in visual.findall("geometry"):
            visual.remove(geometry)
        SubElement(SubElement(visual, "geometry"), "sphere", radius="0.01")
        number = sum(map(len, self._marked.values()))
        visual.set("name", f"{UNMEASURED}_{number} {Path(name).name}")


def _with_companions(mesh: Path) -> list[Path]:
    """Return a mesh and the files in its folder that it names: materials, textures, buffers."""
    named = map(Path.resolve, files_of(str(mesh), f"mesh {mesh.name}", {}))
    return [file for file in named if file.is_relative_to(mesh.parent) and file.is_file()]
