"""Reading a URDF from outside: what is in it, what stands in the way, and a copy that Drake takes.

URDFs carry much that a free-flying spacecraft in Drake has no use for: controller and simulator settings, collision
shapes, friction, meshes that are somewhere else. The copy leaves that out and says so. What only the author can decide,
such as a missing mass, is refused with one line that says what to change.
"""

import copy
import dataclasses
import json
import math
import re
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from ffsm_drake.common.errors import ModelError, one_line
from ffsm_drake.common.files import write_text, written_whole
from ffsm_drake.spacecraft.coordinates import BASE_POSITION, BASE_ROTATION, GROUPS

DRAKE = "{http://drake.mit.edu}"
WORLD = "world"
MOVING = ("revolute", "continuous", "prismatic")
# What Meshcat, and with it the recording, can draw.
DRAWABLE = (".obj", ".gltf", ".dae")
_RESERVED = ("all", *GROUPS, *BASE_ROTATION, *BASE_POSITION)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Joint:
    """A joint of the URDF."""

    name: str
    kind: str  # revolute, continuous, prismatic, fixed
    parent: str
    child: str
    lower: float  # rad or m; minus infinity where nothing limits it
    upper: float
    effort: float  # N m or N; infinite where the URDF gives none
    velocity: float  # rad/s or m/s; infinite where the URDF gives none
    offset: float  # distance from the parent's origin, m

    @property
    def moves(self) -> bool:
        return self.kind in MOVING

    @property
    def is_limited(self) -> bool:
        """Whether its limits say anything; generators write huge ones where nobody knew."""
        return self.upper - self.lower < 20.0

    @property
    def unit(self) -> str:
        return "m" if self.kind == "prismatic" else "rad"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tip:
    """A frame at the end of a chain that starts at the base."""

    frame: str
    joints: tuple[str, ...]  # that move it, from the base on
    reach: float  # length of the stretched chain from its first joint on, m


@dataclasses.dataclass(frozen=True, kw_only=True)
class Servicer:
    """What a URDF holds, as a free-flying base with joints."""

    source: Path
    base: str
    base_links: tuple[str, ...]  # the base and all that is fixed to it
    base_mass: float  # of those, kg
    total_mass: float  # kg
    joints: tuple[Joint, ...]  # those that move, in the file's order
    tip: Tip
    other_tips: tuple[Tip, ...]
    remarks: tuple[str, ...]  # about the model itself, one line each
    root: Element  # the parsed file
    header: str  # the comments before its root element, where licences stand


def read_urdf(path: Path, *, tip: str | None = None) -> Servicer:
    """Read and judge a URDF.

    Args:
      path: the file.
      tip: name of the link or frame that holds the target; None for the end of the longest chain.

    Raises:
      ModelError: the file is no URDF of a free base with single-degree joints and physical masses.
    """
    root, header = _parse(path)
    try:
        return _Tree(root).servicer(path, tip, header)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from None


def _parse(path: Path) -> tuple[Element, str]:
    """The root element, and the comments before it."""
    if not path.is_file():
        raise ModelError(f"{path}: no such file; give the URDF of base and arm")
    try:
        content = path.read_bytes()
        root = ElementTree.fromstring(content)
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {one_line(error)}") from error
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise ModelError(f"{path}: is not valid XML: {one_line(error)}") from error
    if any("xacro" in str(element.tag) for element in root.iter()):
        raise ModelError(f"{path}: is a xacro file; expand it first: xacro {path.name} > {path.stem}.urdf")
    if root.tag != "robot":
        raise ModelError(f"{path}: is not a URDF: its root element is <{root.tag}>, not <robot>")
    before = content.decode("utf-8", errors="replace").partition("<robot")[0]
    return root, "\n".join(re.findall(r"<!--.*?-->", before, flags=re.DOTALL))


class _Tree:
    """Links and joints of a URDF as a tree from the base, judged as they are read."""

    def __init__(self, root: Element) -> None:
        self.root = root
        elements = [e for e in root if e.tag in ("joint", f"{DRAKE}joint")]
        self.links = {_name(e): e for e in root.findall("link")}
        _refuse_repeated("link", [_name(e) for e in root.findall("link")])
        _refuse_repeated("joint", [_name(e) for e in elements])
        self.frames = {_name(e): e.get("link", "") for e in root.findall("frame")}
        joints = [_read_joint(e) for e in elements]
        self.joints = [joint for joint in joints if joint.parent != WORLD]
        self.links.pop(WORLD, None)
        for joint in joints:
            if joint.parent == WORLD and joint.kind != "floating":
                raise ModelError(
                    f"the base '{joint.child}' is attached to the world; remove joint '{joint.name}' and link "
                    f"'{WORLD}' from the URDF, so that the base can fly"
                )
        for joint in self.joints:
            for role, link in (("parent", joint.parent), ("child", joint.child)):
                if link not in self.links:
                    raise ModelError(f"joint '{joint.name}': its {role} link '{link}' does not exist")
        children = Counter(joint.child for joint in self.joints)
        for name, count in children.items():
            if count > 1:
                raise ModelError(f"link '{name}' is the child of {count} joints; a chain must not close on itself")
        roots = [name for name in self.links if name not in children]
        if len(roots) != 1:
            found = f"{len(roots)} ({', '.join(roots)})" if roots else "none"
            raise ModelError(f"one link must be the base, without a parent, not {found}; join the others to it")
        self.base = roots[0]
        # Only joints that hang on the base, and only after the tree has been found to be one, may be judged by kind.
        self.below: dict[str, list[Joint]] = {name: [] for name in self.links}
        for joint in self.joints:
            self.below[joint.parent].append(joint)
        reached = {joint.child for joint in self.descend(self.base)} | {self.base}
        if len(reached) < len(self.links):
            lost = next(name for name in self.links if name not in reached)
            raise ModelError(f"link '{lost}' does not hang on the base '{self.base}': its joints form a loop")
        self.above = {joint.child: joint for joint in self.joints}
        self.masses = {name: _judged_mass(name, element) for name, element in self.links.items()}

    def descend(self, link: str) -> Iterator[Joint]:
        """All joints below a link."""
        for joint in self.below[link]:
            yield joint
            yield from self.descend(joint.child)

    def mass_below(self, link: str) -> float:
        return self.masses[link] + sum(self.masses[joint.child] for joint in self.descend(link))

    def rigid_group(self, link: str) -> list[str]:
        """The link and all that is fixed to it, outward."""
        fixed = [joint.child for joint in self.below[link] if not joint.moves]
        return [link, *(name for child in fixed for name in self.rigid_group(child))]

    def chain(self, link: str) -> list[Joint]:
        """The joints from the base to a link."""
        joints = []
        while link != self.base:
            joints.append(self.above[link])
            link = self.above[link].parent
        return joints[::-1]

    def tip(self, frame: str) -> Tip:
        chain = self.chain(self.frames.get(frame, frame))
        first = next((k for k, joint in enumerate(chain) if joint.moves), len(chain))
        length = sum(joint.offset for joint in chain[first + 1 :])
        if frame in self.frames:
            element = next(e for e in self.root.findall("frame") if _name(e) == frame)
            length += float(np.linalg.norm(_vector(element, "xyz", f"frame '{frame}'")))
        length += sum(
            max(abs(j.lower), abs(j.upper)) for j in chain if j.kind == "prismatic" and math.isfinite(j.upper)
        )
        return Tip(frame=frame, joints=tuple(joint.name for joint in chain if joint.moves), reach=length)

    def tips(self) -> list[Tip]:
        """Candidates, best first: the ends of chains; of a gripper its palm or what is fixed there, not its fingers."""
        ends = []
        for name in self.links:
            # A rigid group counts once, by the frame of it that lies farthest out.
            if name == self.base or not self.above[name].moves:
                continue
            group = self.rigid_group(name)
            going_on = [joint for member in group for joint in self.below[member] if joint.moves]
            fingers = len(going_on) > 1 and all(self._is_last(joint.child) for joint in going_on)
            if not going_on or fingers:
                frames = [frame for frame, link in self.frames.items() if link in group]
                holding = {joint.parent for joint in going_on}
                named = frames or [member for member in group if not self.below[member]] or sorted(holding)
                ends.append(max(named, key=lambda frame: self.tip(frame).reach))
        found = [self.tip(frame) for frame in ends]
        palms = {joint for tip in found for joint in tip.joints[-1:]}
        # Fingers are what hangs on a palm that is itself a candidate.
        found = [tip for tip in found if not palms & set(tip.joints[:-1])]
        return sorted(found, key=lambda tip: (-len(tip.joints), -tip.reach))

    def _is_last(self, link: str) -> bool:
        return not any(joint.moves for joint in self.descend(link))

    def servicer(self, path: Path, tip: str | None, header: str) -> Servicer:
        for joint in self.joints:
            _judge_kind(joint)
        moving = [joint for joint in self.joints if joint.moves]
        if not moving:
            raise ModelError("has no joint that moves; a servicer needs an arm with revolute or prismatic joints")
        for joint in moving:
            if joint.name in _RESERVED:
                raise ModelError(
                    f"joint '{joint.name}': the name clashes with one that scenarios use for the base; rename the joint"
                )
        for name, link in self.frames.items():
            if link not in self.links:
                raise ModelError(f"frame '{name}': its link '{link}' does not exist")
        clash = next((name for name in self.frames if name in self.links), None)
        if clash is not None:
            raise ModelError(f"frame '{clash}' has the name of a link; rename the frame")
        if tip is not None and tip not in self.links and tip not in self.frames:
            raise ModelError(f"no link or frame '{tip}' for the tip; choose one of {', '.join(self._tip_names())}")
        candidates = self.tips()
        chosen = candidates[0] if tip is None else self.tip(tip)
        if not chosen.joints:
            raise ModelError(
                f"tip '{tip}' does not move against the base; choose one of {', '.join(self._tip_names())}"
            )
        base_links = tuple(self.rigid_group(self.base))
        base_mass = sum(self.masses[name] for name in base_links)
        if base_mass <= 0.0:
            raise ModelError(f"the base '{self.base}' has no mass; give it an <inertial> with mass and inertia")
        held = {joint.child for joint in self.chain(self.frames.get(chosen.frame, chosen.frame))}
        for joint in moving:
            if joint.child not in held and self.mass_below(joint.child) <= 0.0:
                raise ModelError(
                    f"link '{joint.child}' moves but has no mass, and carries none; give it an <inertial>, "
                    f"or make joint '{joint.name}' fixed"
                )
        total = sum(self.masses.values())
        remarks = []
        if base_mass < 0.5 * total:
            remarks.append(
                f"the base '{self.base}' has {base_mass:.3g} of {total:.3g} kg: if it is the arm's foot, join it to a "
                "link for the spacecraft by a fixed joint"
            )
        return Servicer(
            source=path,
            base=self.base,
            base_links=base_links,
            base_mass=base_mass,
            total_mass=total,
            joints=tuple(moving),
            tip=chosen,
            other_tips=tuple(other for other in candidates if other.frame != chosen.frame),
            remarks=tuple(remarks),
            root=self.root,
            header=header,
        )

    def _tip_names(self) -> list[str]:
        return [
            name
            for name in (*self.links, *self.frames)
            if any(j.moves for j in self.chain(self.frames.get(name, name)))
        ]


def _name(element: Element) -> str:
    name = element.get("name")
    if not name:
        raise ModelError(f"a <{element.tag.removeprefix(DRAKE)}> has no name")
    return name


def _refuse_repeated(what: str, names: list[str]) -> None:
    repeated = sorted(name for name, count in Counter(names).items() if count > 1)
    if repeated:
        raise ModelError(f"more than one {what} is called '{repeated[0]}'; rename one of them")


def _number(element: Element, attribute: str, place: str, default: float | None = None) -> float:
    text = element.get(attribute)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise ModelError(f"{place}: <{element.tag} {attribute}> must be a number, not '{text or ''}'")
    return value


def _vector(element: Element, attribute: str, place: str) -> np.ndarray:
    text = element.get(attribute, "0 0 0")
    try:
        values = np.array([float(part) for part in text.split()])
    except ValueError:
        values = np.array([])
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ModelError(f"{place}: {attribute} must be three numbers, not '{text}'")
    return values


def _read_joint(element: Element) -> Joint:
    name = _name(element)
    place = f"joint '{name}'"
    ends = {}
    for role in ("parent", "child"):
        end = element.find(role)
        if end is None or not end.get("link"):
            raise ModelError(f"{place}: has no <{role} link=...>")
        ends[role] = end.get("link", "")
    kind = element.get("type", "")
    origin, limit = element.find("origin"), element.find("limit")
    lower, upper, effort, velocity = -math.inf, math.inf, math.inf, math.inf
    if limit is not None:
        if kind in ("revolute", "prismatic") and (limit.get("lower") or limit.get("upper")):
            lower, upper = (_number(limit, side, place, 0.0) for side in ("lower", "upper"))
            if lower > upper:
                raise ModelError(f"{place}: its lower limit {lower:g} lies above its upper limit {upper:g}")
        # Zero is what generators write where nobody knew.
        effort, velocity = (_number(limit, what, place, 0.0) or math.inf for what in ("effort", "velocity"))
        if min(effort, velocity) < 0.0:
            raise ModelError(f"{place}: its effort and velocity limits must not be negative")
    return Joint(
        name=name,
        kind=kind,
        parent=ends["parent"],
        child=ends["child"],
        lower=lower,
        upper=upper,
        effort=effort,
        velocity=velocity,
        offset=0.0 if origin is None else float(np.linalg.norm(_vector(origin, "xyz", place))),
    )


def _judge_kind(joint: Joint) -> None:
    if joint.kind in ("floating", "planar", "ball", "universal", "rpy_floating", "quaternion_floating"):
        raise ModelError(
            f"joint '{joint.name}' is {joint.kind} and has more than one degree of freedom; replace it by revolute and "
            "prismatic joints with links without <inertial> between them"
        )
    if joint.kind not in (*MOVING, "fixed"):
        raise ModelError(
            f"joint '{joint.name}': unknown kind '{joint.kind}'; valid are {', '.join((*MOVING, 'fixed'))}"
        )


def _judged_mass(name: str, link: Element) -> float:
    """Mass of a link; zero without <inertial>. Raises ModelError for masses and inertias that no body can have."""
    inertial = link.find("inertial")
    if inertial is None:
        return 0.0
    place = f"link '{name}'"
    mass_element, inertia_element = inertial.find("mass"), inertial.find("inertia")
    mass = 0.0 if mass_element is None else _number(mass_element, "value", place)
    if mass < 0.0 or not math.isfinite(mass):
        raise ModelError(f"{place}: mass {mass:g} kg must be positive")
    values = {
        key: 0.0 if inertia_element is None else _number(inertia_element, key, place, 0.0)
        for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    }
    ixx, iyy, izz, ixy, ixz, iyz = values.values()
    matrix = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    if not np.isfinite(matrix).all():
        raise ModelError(f"{place}: its inertia must be finite")
    if mass == 0.0:
        if matrix.any():
            raise ModelError(f"{place}: has inertia but no mass; give it both, or remove its <inertial>")
        return 0.0
    principal = np.linalg.eigvalsh(matrix)
    slack = 1e-9 * max(abs(principal).max(), 1e-12)
    if principal[0] < -slack or principal[0] + principal[1] < principal[2] - slack:
        raise ModelError(
            f"{place}: no body has the principal moments {', '.join(f'{p:.4g}' for p in principal)} kg m^2; they must "
            "be positive, and the largest at most the sum of the others: correct its <inertia>"
        )
    return mass


def write_flyable(
    servicer: Servicer, directory: Path, *, file_name: str, packages: Mapping[str, Path]
) -> tuple[str, ...]:
    """Write the copy that Drake takes, and its meshes, into a folder. Returns what was left out, a line each.

    Args:
      directory: gets the URDF and a folder ``meshes``.
      packages: folder of each ROS package that mesh addresses name; others are looked for above the URDF.

    Raises:
      RecordError: the folder cannot be written.
    """
    root = copy.deepcopy(servicer.root)
    dropped: Counter[str] = Counter()
    for element in list(root):
        kept = element.tag in ("link", "joint", "material", "frame") or str(element.tag).startswith(DRAKE)
        if not kept or WORLD in (element.get("name"), _parent(element)):
            root.remove(element)
            dropped[f"<{element.tag}>"] += not (kept or not isinstance(element.tag, str))
    for joint in root.iter("joint"):
        for tag in ("dynamics", "mimic", "calibration", "safety_controller"):
            for element in joint.findall(tag):
                joint.remove(element)
                place = f"joint '{joint.get('name')}'"
                if tag != "dynamics" or any(_number(element, key, place, 0.0) for key in ("damping", "friction")):
                    dropped[tag] += 1
    for link in root.iter("link"):
        for element in link.findall("collision"):
            link.remove(element)
            dropped["collision"] += 1
        inertial = link.find("inertial")
        if inertial is not None and not any(float(e.get("value") or 0.0) for e in inertial.findall("mass")):
            link.remove(inertial)
    _unify_materials(root)
    meshes = _Meshes(servicer.source.resolve(), directory / "meshes", packages)
    meshes.place_all(root)
    drawn = _draw_bare_links(root, servicer)
    root.set("name", root.get("name") or "servicer")
    ElementTree.indent(root)
    ElementTree.register_namespace("drake", DRAKE.strip("{}"))
    remarks = (*_left_out(dropped), *meshes.remarks(), *drawn)
    told = "".join(f"\n  - {remark}".replace("--", "- -") for remark in remarks)
    parts = (
        '<?xml version="1.0" encoding="UTF-8"?>',
        *([servicer.header] if servicer.header else []),
        f"<!-- {servicer.source.name} as 'ffsm new' took it over.{told} -->",
        ElementTree.tostring(root, encoding="unicode"),
    )
    write_text(directory / file_name, "\n".join(parts) + "\n")
    return remarks


def _parent(element: Element) -> str | None:
    parent = element.find("parent")
    return None if parent is None else parent.get("link")


def _left_out(dropped: Counter[str]) -> Iterator[str]:
    why = {
        "dynamics": "damping and friction left out ({n} times): the equations of motion here have none",
        "mimic": "<mimic> left out ({n} times): such a joint is controlled on its own",
        "collision": "collision shapes left out ({n} times): contact is not modelled",
    }
    others = {tag: n for tag, n in dropped.items() if n and tag not in why}
    for tag, text in why.items():
        if dropped[tag]:
            yield text.format(n=dropped[tag])
    if others:
        shown = ", ".join(f"<{tag.strip('<>')}> ({n} times)" for tag, n in others.items())
        yield f"left out, not used here: {shown}"


def _unify_materials(root: Element) -> None:
    """Let the first definition of a material's name hold, as Drake refuses a second one, and drop textures."""
    known: set[str] = set()
    for material in [*root.findall("material"), *root.iterfind("link/visual/material")]:
        for texture in material.findall("texture"):
            material.remove(texture)
        name = material.get("name", "")
        if name in known:
            for child in list(material):
                material.remove(child)
        elif len(material):
            known.add(name)
    # A name without any definition, or none at all, would be refused too.
    for visual in root.iterfind("link/visual"):
        for material in visual.findall("material"):
            if not len(material) and material.get("name", "") not in known:
                visual.remove(material)
    for material in root.findall("material"):
        if not len(material):
            root.remove(material)


class _Meshes:
    """Brings the drawable meshes of a URDF into one folder."""

    def __init__(self, source: Path, folder: Path, packages: Mapping[str, Path]) -> None:
        self.source, self.folder, self.packages = source, folder, packages
        self.places: dict[Path, str] = {}  # file -> its name in the folder
        self.missing: list[str] = []
        self.undrawable: list[str] = []

    def place_all(self, root: Element) -> None:
        for link in root.iter("link"):
            for visual in link.findall("visual"):
                mesh = visual.find("geometry/mesh")
                if mesh is not None and not self._place(mesh):
                    link.remove(visual)

    def remarks(self) -> tuple[str, ...]:
        lines = []
        if self.missing:
            shown = ", ".join(dict.fromkeys(self.missing[:3]))
            lines.append(
                f"meshes not found ({len(self.missing)} times, {shown}): give --package NAME=FOLDER to have them drawn"
            )
        if self.undrawable:
            shown = ", ".join(dict.fromkeys(self.undrawable[:3]))
            kinds = ", ".join(DRAWABLE)
            lines.append(f"meshes of a kind not drawn ({len(self.undrawable)} times, {shown}): convert them to {kinds}")
        return tuple(lines)

    def _place(self, mesh: Element) -> bool:
        address = mesh.get("filename") or mesh.get("uri") or ""
        file = self._find(address)
        if file is None:
            self.missing.append(address)
            return False
        if file.suffix.lower() not in DRAWABLE:
            self.undrawable.append(file.name)
            return False
        if file not in self.places:
            name, k = file.name, 1
            while name in self.places.values():
                k += 1
                name = f"{file.stem}_{k}{file.suffix}"
            self.places[file] = name
            self._copy(file, self.folder / name)
            for companion in _companions(file):
                self._copy(file.parent / companion, self.folder / companion)
        mesh.attrib.pop("uri", None)
        mesh.set("filename", f"meshes/{self.places[file]}")
        return True

    def _copy(self, file: Path, place: Path) -> None:
        with written_whole(place) as temporary:
            shutil.copyfile(file, temporary)

    def _find(self, address: str) -> Path | None:
        scheme, separator, rest = address.partition("://")
        if not separator:
            candidates = [self.source.parent / address]
        elif scheme == "file":
            candidates = [Path(rest)]
        else:  # package:// and model://
            name, _, inside = rest.partition("/")
            folders = [self.packages[name]] if name in self.packages else []
            for above in self.source.parents:
                folders += [above] if above.name == name else [above / name]
            candidates = [folder / inside for folder in folders]
        return next((file.resolve() for file in candidates if file.is_file()), None)


def _companions(file: Path) -> list[str]:
    """Files that a mesh needs beside it, by their addresses in it; those that do not exist are left alone."""
    named: list[str] = []
    try:
        text = file.read_text(encoding="utf-8", errors="replace")
        if file.suffix.lower() == ".obj":
            named = [line.split(maxsplit=1)[1] for line in text.splitlines() if line.startswith("mtllib ")]
            for library in list(named):
                if (file.parent / library).is_file():
                    material = (file.parent / library).read_text(encoding="utf-8", errors="replace")
                    named += [line.split()[-1] for line in material.splitlines() if line.strip().startswith("map_")]
        elif file.suffix.lower() == ".gltf":
            data = json.loads(text)
            named = [item.get("uri", "") for kind in ("buffers", "images") for item in data.get(kind, [])]
    except (OSError, ValueError, AttributeError, IndexError):
        return []
    inside = file.parent.resolve()
    return [
        name for name in dict.fromkeys(named)
        if name and not name.startswith("data:") and (inside / name).is_file()
        and (inside / name).resolve().is_relative_to(inside)
    ]  # fmt: skip


def _draw_bare_links(root: Element, servicer: Servicer) -> tuple[str, ...]:
    """Give links without a picture a plain one: the base a box of its inertia, others a rod to the next joint."""
    links = {_name(link): link for link in root.findall("link")}
    bare = [name for name, link in links.items() if link.find("visual") is None]
    radius = max(0.02 * servicer.tip.reach, 0.01)
    drawn = 0
    for name in bare:
        ends = [
            origin.get("xyz", "0 0 0")
            for joint in root.findall("joint")
            if _parent(joint) == name and (origin := joint.find("origin")) is not None
        ]
        shapes = []
        if name in servicer.base_links:
            shapes = _equivalent_box(links[name])
        else:
            shapes = [shape for end in ends for shape in _rod(np.array(end.split(), dtype=float), radius)]
        for shape in shapes:
            links[name].append(shape)
        drawn += bool(shapes)
    return (f"links without a picture drawn as plain bodies: {drawn}",) if drawn else ()


def _visual(*, xyz: np.ndarray, rpy: tuple[float, float, float], kind: str, **size: str) -> Element:
    visual = Element("visual")
    ElementTree.SubElement(
        visual, "origin", xyz=" ".join(f"{x:.6g}" for x in xyz), rpy=" ".join(f"{x:.6g}" for x in rpy)
    )
    ElementTree.SubElement(ElementTree.SubElement(visual, "geometry"), kind, size)
    return visual


def _rod(end: np.ndarray, radius: float) -> list[Element]:
    length = float(np.linalg.norm(end))
    if length < 2.0 * radius:
        return []
    tilt = math.acos(max(-1.0, min(1.0, end[2] / length)))
    turn = math.atan2(end[1], end[0])
    return [
        _visual(
            xyz=0.5 * end, rpy=(0.0, tilt, turn), kind="cylinder", radius=f"{radius:.4g}", length=f"{length:.6g}"
        )
    ]  # fmt: skip


def _equivalent_box(link: Element) -> list[Element]:
    """The solid box that has a link's moments of inertia."""
    inertia, mass = link.find("inertial/inertia"), link.find("inertial/mass")
    if inertia is None or mass is None or float(mass.get("value", 0.0)) <= 0.0:
        return []
    ixx, iyy, izz = (float(inertia.get(key, 0.0)) for key in ("ixx", "iyy", "izz"))
    squares = [
        6.0 / float(mass.get("value", 0.0)) * value for value in (iyy + izz - ixx, ixx + izz - iyy, ixx + iyy - izz)
    ]
    if min(squares) <= 0.0:
        return []
    origin = link.find("inertial/origin")
    centre = np.zeros(3) if origin is None else _vector(origin, "xyz", f"link '{_name(link)}'")
    size = " ".join(f"{math.sqrt(value):.4g}" for value in squares)
    return [_visual(xyz=centre, rpy=(0.0, 0.0, 0.0), kind="box", size=size)]
