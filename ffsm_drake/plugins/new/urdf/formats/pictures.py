"""The visuals of an SDFormat file and of the files that it includes, at the places where Drake's
parser puts them.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from ffsm_drake.plugins.new.urdf.elements import found_file
from ffsm_drake.plugins.new.urdf.formats.building import add_visual
from ffsm_drake.spacecraft.checked_urdf import DRAKE, require

PICTURE = "ffsm_picture_"  # frames whose names begin so stand for visuals
_MOST_FILES = 200
_SHAPES = {  # geometry of SDFormat -> element of a URDF, and its attributes by SDFormat's names
    "box": ("box", {"size": "size"}),
    "sphere": ("sphere", {"radius": "radius"}),
    "cylinder": ("cylinder", {"radius": "radius", "length": "length"}),
    "capsule": ("capsule", {"radius": "radius", "length": "length"}),
    "mesh": ("mesh", {"uri": "filename", "scale": "scale"}),
}


class Pictures:
    """Moves the visuals of files to the bodies of a URDF."""

    def __init__(
        self, packages: Mapping[str, Path], folder: Path, prepare: Callable[[Path], Element]
    ) -> None:
        """Args:
        packages: folders of the packages that the files name.
        folder: folder for the copies of included files.
        prepare: reads an included file, calls ``take``, and makes the file ready for Drake.
        """
        self._packages, self._folder, self._prepare = packages, folder, prepare
        self.visuals = dict[str, Element]()  # by the name of the frame in its place
        self._copies = dict[Path, Path]()

    def take(self, tree: Element, path: Path) -> None:
        """Put a frame in place of each visual of a file, of its collision shapes for a link without
        one, and the copies in place of the files that it includes.
        """
        for model in list(tree.iter()):
            for link in model.findall("link"):
                for visual in link.findall("visual") or link.findall("collision"):
                    self._take(visual, model, link, path)
            for include in model.findall("include"):
                self._include(include, model, path)

    def _take(self, visual: Element, model: Element, link: Element, path: Path) -> None:
        name = f"{PICTURE}{len(self.visuals)}"
        frame = SubElement(model, "frame", {"name": name, "attached_to": link.get("name", "")})
        frame.extend(visual.findall("pose"))
        for uri in visual.iterfind("geometry/mesh/uri"):
            if file := found_file((uri.text or "").strip(), path, self._packages):
                uri.text = str(file)
        self.visuals[name] = visual

    def _include(self, include: Element, model: Element, path: Path) -> None:
        uri = include.find("uri")
        address = "" if uri is None else (uri.text or "").strip()
        file = found_file(address, path, self._packages, is_model=True)
        if uri is None or file is None:
            return  # which Drake reports
        if file.suffix.lower() not in (".sdf", ".world"):
            for link in model.findall("link")[:1]:  # its pictures are not known
                visual = Element("visual")
                SubElement(SubElement(visual, "geometry"), "unread", name=file.name)
                self._take(visual, model, link, path)
            uri.text = str(file)
            return
        if file not in self._copies:
            require(len(self._copies) < _MOST_FILES, f"includes more than {_MOST_FILES} files")
            copy = self._copies[file] = self._folder / f"{len(self._copies)}" / file.name
            copy.parent.mkdir()
            copy.write_bytes(ElementTree.tostring(self._prepare(file), encoding="utf-8"))
        copy = self._copies[file]
        require(copy.is_file(), f"{path.name}: <include> of {file.name} includes itself")
        uri.text = str(copy)

    def add(self, root: Element, plant: MultibodyPlant, name_of: Callable[[Any], str]) -> None:
        """Add the visuals to the links of a URDF, as a plant has their frames.

        Args:
          root: the URDF.
          plant: what Drake read.
          name_of: the name of a body's link.
        """
        links = {link.get("name"): link for link in root.findall("link")}
        for frame in frames_of(plant):
            if (visual := self.visuals.get(frame.name())) is not None:
                link = links.get(name_of(frame.body()))
                if link is not None:
                    _add(link, visual, frame.GetFixedPoseInBodyFrame())


def frames_of(plant: MultibodyPlant) -> Iterator[Any]:
    """The frames of all models."""
    for instance in map(ModelInstanceIndex, range(plant.num_model_instances())):
        yield from map(plant.get_frame, plant.GetFrameIndices(instance))


def _add(link: Element, visual: Element, pose: Any) -> None:
    diffuse = (visual.findtext("material/diffuse") or "").split()
    color = np.array([*map(float, diffuse), 1.0])[:4] if len(diffuse) in (3, 4) else None
    for kind in visual.iterfind("geometry/*"):
        if kind.tag == "empty":
            continue
        if kind.tag == "ellipsoid":
            radii = (kind.findtext("radii") or "1 1 1").split()
            add_visual(
                link, f"{DRAKE}ellipsoid", pose, color, **dict(zip("abc", radii, strict=True))
            )
            continue
        is_part = kind.find("submesh") is not None
        shape, keys = (None, {}) if is_part else _SHAPES.get(kind.tag, (None, {}))
        if shape is None:
            add_visual(link, "unread", pose, None, name=kind.get("name") or kind.tag)
            continue
        sizes = {to: (kind.findtext(key) or "").strip() for key, to in keys.items()}
        add_visual(link, shape, pose, color, **{key: x for key, x in sizes.items() if x})
