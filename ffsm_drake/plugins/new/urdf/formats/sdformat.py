"""SDFormat, with links and joints as Drake's parser reads them."""

import logging
import re
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from ffsm_drake.common.errors import one_line
from ffsm_drake.common.numbers import counted
from ffsm_drake.plugins.new.urdf.elements import WORLD, name_of
from ffsm_drake.plugins.new.urdf.formats.building import (
    add_frame,
    add_joint,
    add_link,
    add_mimic,
    keep_servicer,
    passed_over,
)
from ffsm_drake.plugins.new.urdf.formats.located import (
    Lines,
    keep_lines,
    number_faults,
    read_located,
)
from ffsm_drake.plugins.new.urdf.formats.pictures import Pictures, frames_of
from ffsm_drake.spacecraft.checked_urdf import Faults, require
from ffsm_drake.spacecraft.inertia import MOMENTS, mended_moments, read_mass
from ffsm_drake.spacecraft.model_files import files_of

# Without effect on a spacecraft in free flight; Drake reports some of them as unsupported.
_PASSED_OVER = (
    "plugin", "sensor", "light", "physics", "scene", "gui", "wind", "atmosphere", "magnetic_field",
    "gravity", "audio", "actor", "road", "state", "population", "spherical_coordinates",
    "self_collide", "enable_wind", "allow_auto_disable", "kinematic", "velocity_decay",
    "particle_emitter", "projector", "battery", "audio_sink", "audio_source", "gripper",
    "must_be_base_link", "collision", "visual", "auto_inertia_params",
)  # fmt: skip


class _Source:
    """An SDFormat file and those that it includes, without what Drake's parser does not read: that
    is kept here.
    """

    def __init__(self, path: Path, packages: Mapping[str, Path], folder: Path) -> None:
        self._folders = {name: str(root) for name, root in packages.items()}
        self.passed = Counter[str]()  # removed elements by tag
        self.frictions, self.mimics = dict[str, float](), dict[str, Element]()  # by joint
        self.pictures = Pictures(packages, folder, lambda file: self._read(file)[0])
        self.tree, lines = self._read(path)
        self.line = lines[self.tree]  # of the file

    def _read(self, file: Path) -> tuple[Element, Lines]:
        """A file ready for Drake."""
        tree, lines = read_located(file)
        version = tree.get("version", "1.0")
        require(
            re.fullmatch(r"\d{1,3}(\.\d{1,3}){0,2}", version),
            f"<sdf version> must be such as 1.9, not '{version[:40]}'",
        )
        files_of(str(file), "its files", self._folders)
        known = len(self.pictures.visuals)
        self.pictures.take(tree, file)
        self.passed.update(_remove(tree))
        shown = [*self.pictures.visuals.values()][known:]
        Faults(number_faults((tree, *shown), lines)).raise_all()
        added = [*tree.iter("fluid_added_mass")]
        require(not added, "has <fluid_added_mass>, which is no mass in free flight; remove it")
        for joint in tree.iter("joint"):
            self._take_joint(joint)
        _complete(tree, file.resolve().parent)
        keep_lines(tree, lines)
        return tree, lines

    def _take_joint(self, joint: Element) -> None:
        name, friction = name_of(joint), _value(joint, "axis/dynamics/friction")
        # one name in several models: the largest
        self.frictions[name] = max(friction, self.frictions.get(name, 0.0))
        for axis in joint.findall("axis"):
            for mimic in axis.findall("mimic"):  # which Drake refuses in continuous time
                self.mimics[name] = mimic
                axis.remove(mimic)


def read_sdformat(path: Path, packages: Mapping[str, Path]) -> tuple[Element, list[str]]:
    """The URDF of an SDFormat file, and remarks. Raises ModelError: Drake cannot read it, or parts
    of it cannot be represented.
    """
    with tempfile.TemporaryDirectory() as folder:
        source = _Source(path, packages, Path(folder))
        plant = _parsed(source.tree, source.line, path, packages, Path(folder))
    tree, pictures = source.tree, source.pictures
    root = Element("robot", name=next((m.get("name", "") for m in tree.iter("model")), "servicer"))
    frames = {frame.get("name", "") for frame in tree.iter("frame")} - pictures.visuals.keys()
    faults = Faults()
    if springs := plant.num_force_elements() - 1:  # gravity is one
        faults.append(f"{counted(springs, 'spring')} at joints; set spring_stiffness to 0")
    bodies = [plant.get_body(BodyIndex(k)) for k in range(1, plant.num_bodies())]
    names = _unique(plant, bodies)
    for body in bodies:
        _add_body(root, names[_scoped(plant, body)], body)
    pictures.add(root, plant, lambda body: names.get(_scoped(plant, body), ""))
    _add_joints(root, plant, names, source, faults)
    faults.raise_all()
    for frame in frames_of(plant):
        if frame.name() in frames:
            link = names[_scoped(plant, frame.body())]
            add_frame(root, frame.name(), link, frame.GetFixedPoseInBodyFrame())
    told = [
        f"<{tag}> ({counted(count, 'time')})"
        for tag, count in source.passed.items()
        if tag != "visual"
    ]
    return root, [*passed_over(told), *keep_servicer(root)]


def _scoped(plant: MultibodyPlant, element: Any) -> str:
    """The name of a body or joint, after that of its model."""
    return f"{plant.GetModelInstanceName(element.model_instance())}::{element.name()}"


def _unique(plant: MultibodyPlant, elements: list[Any]) -> dict[str, str]:
    """Return names of bodies or joints by scoped name: their own name, or with the name of the
    model if others have the same name.
    """
    taken = Counter(element.name() for element in elements)
    return {
        (scoped := _scoped(plant, element)): (
            element.name() if taken[element.name()] == 1 else scoped.replace("::", "_")
        )
        for element in elements
    }


def _remove(tree: Element) -> Iterator[str]:
    """Remove ignored elements and yield their tags. Shapes with the inertia of a link stay."""
    for element in list(tree.iter()):
        inertial = element.find("inertial")
        weighs = inertial is not None and inertial.get("auto", "").lower() in ("1", "true")
        for child in list(element):
            if weighs and child.tag == "collision":
                for part in list(child):
                    if part.tag not in ("geometry", "pose", "density"):
                        child.remove(part)
            elif child.tag in _PASSED_OVER:
                element.remove(child)
                yield child.tag


def _value(element: Element, path: str, usual: float = 0.0) -> float:
    """Return the number in the text of an element at a path, or the usual one without it."""
    return float((element.findtext(path) or "").strip() or usual)


def _complete(tree: Element, folder: Path) -> None:
    """Add the folder to relative meshes, and the prefix to Drake's elements; remove rounding from
    inertias, and effort limits of 0, which mean unknown. Raises ModelError for inertias.
    """
    faults = Faults()
    for link in tree.iter("link"):
        for inertia in link.findall("inertial/inertia"):
            given = dict.fromkeys(MOMENTS[:3], "1")
            given |= {part.tag: (part.text or "").strip() for part in inertia}
            same = Element("link", name=name_of(link))
            inertial = SubElement(same, "inertial")
            SubElement(inertial, "mass", value="1")
            SubElement(inertial, "inertia", given)
            with faults:
                read_mass(same)
            for key, value in mended_moments(inertial[1], f"link '{name_of(link)}'").items():
                part = inertia.find(key)
                (SubElement(inertia, key) if part is None else part).text = value
    faults.raise_all()
    for mesh in tree.iter("mesh"):
        for uri in mesh.findall("uri"):
            if "://" not in (address := uri.text or ""):
                uri.text = str(folder / address.strip())
    for limit in tree.iter("limit"):
        if _value(limit, "effort") == 0.0:  # with it, the joint has no drive, and no rotor
            for effort in limit.findall("effort"):
                limit.remove(effort)
    for element in tree.iter():
        space, _, tag = element.tag.rpartition("}")
        if space.endswith("drake.mit.edu"):
            element.tag = f"drake:{tag}"
            tree.set("xmlns:drake", "drake.mit.edu")


def _parsed(
    tree: Element, line: int, path: Path, packages: Mapping[str, Path], folder: Path
) -> MultibodyPlant:
    """Return Drake's reading of a file without its unused elements, with its root on a line."""
    plant, told = MultibodyPlant(time_step=0.0), _Told()
    parser, log = Parser(plant), logging.getLogger("drake")
    for name, root in packages.items():
        parser.package_map().Add(name, str(root))
    log.addHandler(told)
    before, log.propagate = log.propagate, False
    try:
        file = folder / f"{path.stem}.sdf"
        above = b"\n" * (line - 1)
        file.write_bytes(above + ElementTree.tostring(tree, encoding="utf-8"))
        try:
            parser.AddModels(str(file))
        except (RuntimeError, ValueError, SystemExit) as error:
            from ffsm_drake.spacecraft.plant import cause_of

            text, is_placed = cause_of(error), str(file) in one_line(error)
            told.texts.append(text if is_placed else f"Drake cannot read it: {text}")
        given = re.escape(str(folder))
        told.texts = [
            re.sub(f"/?{given}/(\\d+/)?", "", each.replace(str(file), path.name))
            for each in told.texts
        ]
    finally:
        log.removeHandler(told)
        log.propagate = before
    Faults(told.texts).raise_all()
    return plant


class _Told(logging.Handler):
    """Gathers Drake's warnings."""

    def __init__(self) -> None:
        super().__init__()
        self.texts = list[str]()

    def emit(self, record: logging.LogRecord) -> None:
        text = " ".join(record.getMessage().split())
        # The first two have given a link its inertia. The third is of a rod; Drake checks all.
        used = ("element in collision: density", "element in geometry: cone", "invalid inertia.")
        if not text.endswith(used):
            self.texts.append(text)


def _add_body(root: Element, name: str, body: Any) -> None:
    inertia = body.default_spatial_inertia()
    mass, center = float(inertia.get_mass()), inertia.get_com()
    tensor = np.zeros((3, 3))
    if mass:
        tensor = inertia.Shift(center).CalcRotationalInertia().CopyToFullMatrix3()
    add_link(root, name, mass, center, tensor)


def _add_joints(
    root: Element, plant: MultibodyPlant, names: Mapping[str, str], source: _Source, faults: Faults
) -> None:
    """Add the joints, with their friction and the joints that they follow."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    unique = _unique(plant, joints)
    for joint in joints:
        with faults:
            name, scoped = joint.name(), _scoped(plant, joint)
            friction = source.frictions.get(name, 0.0)
            added = _add_joint(root, unique[scoped], plant, joint, names, friction)
            if (mimic := source.mimics.get(name)) is not None:
                leader = scoped.removesuffix(name) + mimic.get("joint", "")
                slope, zero = _value(mimic, "multiplier", 1.0), _value(mimic, "reference")
                offset = _value(mimic, "offset") - slope * zero
                add_mimic(added, unique.get(leader, leader), slope, offset)


def _add_joint(
    root: Element, name: str, plant: MultibodyPlant, joint: Any, names: Mapping[str, str],
    friction: float,
) -> Element:  # fmt: skip
    """Add a joint, with an additional link if its frame is not the frame of the child."""
    kind = joint.type_name()
    known = ("revolute", "prismatic", "weld")
    require(kind in known, f"joint '{name}' is {kind}; replace it by joints of one degree")
    is_standing = joint.parent_body().index() == 0
    parent = WORLD if is_standing else names[_scoped(plant, joint.parent_body())]
    child = names[_scoped(plant, joint.child_body())]
    pose = joint.frame_on_parent().GetFixedPoseInBodyFrame()
    onward = joint.frame_on_child().GetFixedPoseInBodyFrame().inverse()
    if kind == "weld":
        return add_joint(root, name, "fixed", (parent, child), pose @ joint.X_FM() @ onward)
    limits = {
        "lower": float(joint.position_lower_limits()[0]),
        "upper": float(joint.position_upper_limits()[0]),
        "velocity": float(joint.velocity_upper_limits()[0]),
    }
    drives = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    rotor = 0.0
    for drive in drives:
        if drive.joint().index() == joint.index():
            limits["effort"] = float(drive.effort_limit())
            rotor += float(drive.default_rotor_inertia()) * float(drive.default_gear_ratio()) ** 2
    axis = joint.revolute_axis() if kind == "revolute" else joint.translation_axis()
    if kind == "revolute" and not np.isfinite(limits["upper"] - limits["lower"]):
        kind = "continuous"
    between = child if onward.IsNearlyIdentity(1e-12) else f"{name}_axis"
    added = add_joint(
        root, name, kind, (parent, between), pose, axis=axis, limits=limits, rotor=rotor,
        damping=joint.default_damping(), friction=friction,
    )  # fmt: skip
    if between != child:
        SubElement(root, "link", name=between)
        add_joint(root, f"{name}_fixed", "fixed", (between, child), onward)
    return added
