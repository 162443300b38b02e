"""MJCF, as MuJoCo compiles it: defaults, includes, inertias from shapes and all compiler options
are applied.
"""

import math
import re
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform

from ffsm_drake.common.errors import ModelError, one_line
from ffsm_drake.common.numbers import counted
from ffsm_drake.plugins.new.urdf.elements import WORLD, listed
from ffsm_drake.plugins.new.urdf.formats.building import (
    add_joint,
    add_link,
    add_visual,
    keep_servicer,
    text,
)
from ffsm_drake.spacecraft.checked_urdf import DRAKE, require

_MOST_PARTS = 10_000  # made by counts
_COUNTED = {  # element -> attributes whose product is a number of parts, and the most of it
    "replicate": (("count",), _MOST_PARTS),
    "composite": (("count",), _MOST_PARTS),
    "flexcomp": (("count",), _MOST_PARTS),
    "hfield": (("nrow", "ncol"), 10_000_000),
    "texture": (("width", "height"), 100_000_000),
    "size": (("nkey",), _MOST_PARTS),
    "numeric": (("size",), _MOST_PARTS),
}
_MOST_NUMBERS = 10_000_000  # of other sizes
_MISSING = "ffsm_missing_"  # names of what stands for a mesh without its file begin so
_UNLIMITED = np.array([-np.inf, np.inf])
_DRAWN_GROUPS = 3  # MuJoCo shows the geoms of groups 0 to 2
_PASSED_OVER = {  # number in the compiled model -> what it counts
    "nu": "actuator", "ntendon": "tendon", "ncam": "camera", "nlight": "light",
    "nsensor": "sensor", "nkey": "keyframe", "ntex": "texture", "nskin": "skin",
    "npair": "contact pair", "nmocap": "mocap body", "nhfield": "height field",
}  # fmt: skip


def read_mjcf(path: Path, packages: Mapping[str, Path]) -> tuple[Element, list[str]]:
    """The URDF of an MJCF file, and remarks. Raises ModelError: MuJoCo cannot compile it, or
    parts of it cannot be represented.
    """
    import mujoco  # slow

    check_counts(path)
    usual = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)  # else it writes MUJOCO_LOG.TXT
    try:
        with warnings.catch_warnings(action="ignore"):
            spec = mujoco.MjSpec.from_file(str(path))
            missing = _drop_missing_files(mujoco, spec, path)
            model = spec.compile()
    except (ValueError, RuntimeError, TypeError) as error:
        raise ModelError(f"MuJoCo cannot compile it: {one_line(error)}") from error
    finally:
        mujoco.set_mju_user_warning(usual)
    reader = _Reader(mujoco, model, spec)
    faults = [*reader.faults()]
    require(not faults, "has what cannot be simulated here: " + "; ".join(faults))
    root = reader.root()
    lone = keep_servicer(root)
    passed = [
        *reader.passed_over(),
        *([f"missing files ({listed(missing)})"] if missing else []),
    ]
    remarks = [f"passed over, of no effect in free flight: {', '.join(passed)}"] if passed else []
    remarks += reader.one_sided()
    if lone:
        remarks.append(f"bodies left out, which are not part of the servicer: {listed(lone)}")
    return root, remarks


def check_counts(path: Path) -> None:
    """Raise ModelError for a file, or one that it includes, whose counts make too many parts."""
    pending = [path]
    for file in pending:  # grows during the loop
        require(len(pending) <= _MOST_PARTS, "includes too many files")
        try:
            root = ElementTree.parse(file, ElementTree.XMLParser(encoding="utf-8")).getroot()
        except (OSError, ElementTree.ParseError, ValueError, LookupError):
            continue  # which MuJoCo reports
        for each in root.iter("include"):
            for folder in {path.parent, file.parent}:
                other = folder / each.get("file", "")
                pending += [other] if other.is_file() and other not in pending else []
        inside = f"{file.name}: " if file != path else ""
        for element, parts in _repeated(root):
            require(parts <= _MOST_PARTS, f"{inside}<{element.tag}> would make {parts:.3g} parts; "
                    f"at most {_MOST_PARTS} are read")  # fmt: skip
            keys, most = _COUNTED.get(element.tag, ((), 0))
            product = math.prod(_counts(element, keys))
            require(
                not keys or product <= most,
                f"{inside}<{element.tag} {' '.join(keys)}> is {product:.3g}; at most {most:.3g} "
                "is read",
            )
            if element.tag == "size":
                for key in set(element.keys()) - {"nkey", "memory"}:
                    largest = max(_counts(element, (key,)))
                    require(
                        largest <= _MOST_NUMBERS,
                        f"{inside}<size {key}> is {largest:.3g}; at most {_MOST_NUMBERS:.3g} is "
                        "read",
                    )


def _repeated(root: Element) -> Iterator[tuple[Element, float]]:
    """Every element, and how often <replicate> makes it."""
    pending = [(root, 1.0)]
    for element, times in pending:
        if element.tag == "replicate":
            times *= math.prod(_counts(element, ("count",)))
        yield element, times
        pending += [(child, times) for child in element]


def _counts(element: Element, keys: tuple[str, ...]) -> list[float]:
    """Return the numbers of attributes; 1 if the text is no number."""
    found = [1.0]
    for word in " ".join(element.get(key, "") for key in keys).split():
        try:
            found.append(max(float(word), 1.0))
        except ValueError:
            continue  # which MuJoCo reports
    return found


def _drop_missing_files(mujoco: Any, spec: Any, path: Path) -> list[str]:
    """Remove textures with missing files, and put marks in place of visual meshes; returns the
    names.
    """
    places, names = _places(path), list[str]()
    delete = getattr(spec, "delete", lambda element: element.delete())  # older MuJoCo
    for asset in spec.textures:
        if asset.file and not any((each / asset.file).is_file() for each in places):
            for material in spec.materials:
                material.textures = ["" if t == asset.name else t for t in material.textures]
            names.append(Path(asset.file).name)
            delete(asset)
    for asset in spec.meshes:
        if asset.file and not any((each / asset.file).is_file() for each in places):
            name = asset.name or Path(asset.file).stem
            shapes = [each for each in spec.geoms if each.meshname == name]
            if all(each.parent.explicitinertial for each in shapes):  # else MuJoCo names the file
                names.append(Path(asset.file).name)
                for each in shapes:
                    each.type, each.size, each.meshname = (
                        mujoco.mjtGeom.mjGEOM_SPHERE,
                        [1, 0, 0],
                        "",
                    )
                    each.name = f"{_MISSING}{each.id} {names[-1]}"
                delete(asset)
    return names


def _places(path: Path) -> set[Path]:
    """Return the folders in which the files of a model, and of included models, may be."""
    pending, found = [path], set[Path]()
    for file in pending:  # grows during the loop
        try:
            root = ElementTree.parse(file, ElementTree.XMLParser(encoding="utf-8")).getroot()
        except (OSError, ElementTree.ParseError, ValueError, LookupError):
            continue  # which MuJoCo reports
        folders = {path.parent, file.parent}
        for each in root.iter("compiler"):
            keys = [each.get(key, "") for key in ("assetdir", "meshdir", "texturedir")]
            folders |= {folder / key for folder in folders for key in keys}
        found |= folders
        for each in (*root.iter("include"), *root.iter("model")):
            for folder in folders:
                other = folder / each.get("file", "")
                if other.is_file() and other not in pending and len(pending) < _MOST_PARTS:
                    pending.append(other)
    return found | {above / name for above in {f.parent for f in pending} for name in found}


class _Reader:
    """A compiled model (its m) as a URDF."""

    def __init__(self, mujoco: Any, m: Any, spec: Any) -> None:
        self.mujoco, self.m, self.spec = mujoco, m, spec
        self.rotors = self._rotors()
        moving = m.body_weldid > 0
        free = {int(m.jnt_bodyid[k]) for k in self._joints(mujoco.mjtJoint.mjJNT_FREE)}
        self.kept = {int(body) for body in np.flatnonzero(moving)}
        for body in sorted(self.kept):  # a mounted arm's fixed foot
            while body and body not in free:
                body = int(m.body_parentid[body])
                self.kept |= {body} - {0}

    def _joints(self, kind: Any) -> list[int]:
        return np.flatnonzero(self.m.jnt_type == int(kind)).tolist()

    def _name(self, kind: str, index: int) -> str:
        type_of = getattr(self.mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
        name = self.mujoco.mj_id2name(self.m, type_of, index)
        return name or f"{kind}_{index}"

    def faults(self) -> Iterator[str]:
        """Elements that change dynamics and have no counterpart, one text each."""
        m, kinds = self.m, self.mujoco.mjtJoint
        for joint in self._joints(kinds.mjJNT_BALL):
            yield (
                f"joint '{self._name('joint', joint)}' is a ball joint; replace it by three hinges "
                "(bodies of negligible mass between them)"
            )
        for joint in self._joints(kinds.mjJNT_FREE):
            if m.dof_armature[m.jnt_dofadr[joint] :][:6].any():
                yield (
                    f"the free joint '{self._name('joint', joint)}' has armature, an inertia of no "
                    'body; take <freejoint/>, or armature="0"'
                )
        springs = np.column_stack(
            [m.jnt_stiffness, getattr(m, "jnt_stiffnesspoly", m.jnt_stiffness)]
        )
        if stiff := [self._name("joint", k) for k in range(m.njnt) if springs[k].any()]:
            yield f"springs at joints {', '.join(stiff)}; set stiffness to 0"
        for k in np.flatnonzero(m.eq_active0).tolist():
            if self._follower(k) is None:
                yield (
                    f"the equality constraint '{self._name('equality', k)}', which couples bodies "
                    "or joints; join them by a body, or remove it"
                )
        acts = (m.tendon_stiffness, m.tendon_limited, m.tendon_armature)
        for k in range(m.ntendon):
            if any(np.any(each[k]) for each in acts):
                yield (
                    f"tendon '{self._name('tendon', k)}' with a stiffness, limit or armature; "
                    "remove these"
                )
        if m.nflex:
            yield "flexible bodies (<flex>)"
        if (m.body_plugin >= 0).any():
            yield "plugins of bodies"
        finite = np.isfinite(m.body_mass) & np.isfinite(m.body_inertia).all(axis=1)
        if not finite.all():
            names = ", ".join(self._name("body", int(k)) for k in np.flatnonzero(~finite))
            yield f"mass or inertia of {names} is no finite number; give one"
            return
        rotors = [m.dof_armature, getattr(m, "actuator_armature", np.zeros(0))]
        if not np.isfinite(np.concatenate(rotors)).all():
            yield "an armature is no finite number; give one of 0 or more, or leave it out"
            return
        for name, extra in self.rotors.items():
            if extra is None:
                yield f"joint '{name}': its actuators' armature couples it with others"
        for joint in filter(self._is_single, range(m.njnt)):
            least, most = self._efforts(joint).tolist()
            if least != most and not least < 0.0 < most:
                yield (
                    f"the actuators of joint '{self._name('joint', joint)}' push one way only "
                    f"({least:.4g} to {most:.4g}); add one that pushes back"
                )

    def one_sided(self) -> Iterator[str]:
        """A remark on joints with different limits of force in the two directions."""
        told = list[str]()
        for joint in filter(self._is_single, range(self.m.njnt)):
            least, most = self._efforts(joint).tolist()
            if -least != most:
                unit = "N m" if self._is_hinge(joint) else "N"
                told.append(
                    f"{self._name('joint', joint)} {min(-least, most):.4g} {unit} "
                    f"(of {least:.4g} to {most:.4g})"
                )
        if told:
            yield f"effort limits hold in both directions, so the smaller counts: {listed(told)}"

    def _rotors(self) -> dict[str, float | None]:
        """Return the inertia that drives add to each joint, from the mass matrix with and without
        armature.

        None: the inertia acts on several joints.
        """
        m, found = self.m, dict[str, float | None]()
        fields = ("dof_armature", "actuator_armature")
        arrays = [getattr(m, field) for field in fields if hasattr(m, field)]
        kept, whole = [each.copy() for each in arrays], self._mass_matrix()
        for each in arrays:
            each[:] = 0.0
        extra = whole - self._mass_matrix()
        for each, value in zip(arrays, kept, strict=True):
            each[:] = value
        tolerance = 1e-12 * float(np.abs(whole).max(initial=0.0))
        for joint in filter(self._is_single, range(m.njnt)):
            k, name = int(m.jnt_dofadr[joint]), self._name("joint", joint)
            is_own = np.abs(np.delete(extra[k], k)).max(initial=0.0) <= tolerance
            own = float(m.dof_armature[k])
            size = own if abs(extra[k, k] - own) <= tolerance else float(extra[k, k])
            found[name] = size if is_own else None
        return found

    def _mass_matrix(self) -> np.ndarray:
        """The mass matrix (nv, nv) in the reference configuration."""
        m, data = self.m, self.mujoco.MjData(self.m)
        self.mujoco.mj_forward(m, data)
        columns = np.zeros((m.nv, m.nv))
        for unit, column in zip(np.eye(m.nv), columns, strict=True):
            self.mujoco.mj_mulM(m, data, column, unit)
        return columns.T

    def _is_single(self, joint: int) -> bool:
        kinds = self.mujoco.mjtJoint
        return int(self.m.jnt_type[joint]) in (int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE))

    def _is_hinge(self, joint: int) -> bool:
        return int(self.m.jnt_type[joint]) == int(self.mujoco.mjtJoint.mjJNT_HINGE)

    def _follower(self, k: int) -> tuple[int, int, float, float] | None:
        """Follower and leader of an equality of two joints, multiplier and offset; None for other
        kinds.
        """
        m = self.m
        first, second, data = int(m.eq_obj1id[k]), int(m.eq_obj2id[k]), m.eq_data[k]
        is_line = m.eq_type[k] == int(self.mujoco.mjtEq.mjEQ_JOINT) and not data[2:5].any()
        return (first, second, float(data[1]), float(data[0])) if is_line and second >= 0 else None

    def passed_over(self) -> Iterator[str]:
        """Elements without effect in free flight, with their numbers."""
        m, usual = self.m, self.mujoco.MjOption()
        names = [name for name in dir(usual) if not name.startswith("_")]
        other = [
            name
            for name in names
            if not callable(getattr(usual, name))
            and np.any(getattr(m.opt, name) != getattr(usual, name))
        ]
        if other:
            yield f"options ({', '.join(other)})"
        for key, what in _PASSED_OVER.items():
            if number := int(getattr(m, key)):
                kept = " (but for their limits)" if key == "nu" else ""
                yield f"{counted(number, what)}{kept}"
        fixed = [self._name("body", k) for k in range(1, m.nbody) if k not in self.kept]
        if fixed:
            yield f"bodies fixed to the world ({listed(fixed)})"

    def root(self) -> Element:
        """The URDF."""
        root = Element("robot", name=self.spec.modelname or "servicer")
        for body in sorted(self.kept):
            self._add_body(root, body)
        for site in range(self.m.nsite):
            body = int(self.m.site_bodyid[site])
            name = self._name("site", site)
            alone = np.count_nonzero(self.m.site_bodyid == body) == 1
            taken = {each.get("name") for each in root}
            if body in self.kept and (alone or name != f"site_{site}") and name not in taken:
                pose = _pose(self.m.site_pos[site], self.m.site_quat[site])
                rpy = pose.rotation().ToRollPitchYaw().vector()
                SubElement(
                    root, "frame", name=name, link=self._name("body", body),
                    xyz=text(pose.translation()), rpy=text(rpy),
                )  # fmt: skip
        return root

    def _add_body(self, root: Element, body: int) -> None:
        m, name = self.m, self._name("body", body)
        turn = _pose((0, 0, 0), m.body_iquat[body]).rotation().matrix()
        inertia = turn @ np.diag(m.body_inertia[body]) @ turn.T
        link = add_link(root, name, float(m.body_mass[body]), m.body_ipos[body], inertia)
        shapes = np.flatnonzero(m.geom_bodyid == body)
        drawn = shapes[m.geom_group[shapes] < _DRAWN_GROUPS]
        for shape in (drawn if drawn.size else shapes).tolist():
            self._add_shape(link, shape)
        joints = range(m.body_jntadr[body], m.body_jntadr[body] + m.body_jntnum[body])
        if not all(map(self._is_single, joints)):
            return
        above = int(m.body_parentid[body])
        parent = WORLD if above == 0 else self._name("body", above)
        pose = _pose(m.body_pos[body], m.body_quat[body])
        for k in joints:
            here = m.jnt_pos[k]
            pose = pose @ RigidTransform(here)
            last = k == joints[-1] and not here.any()
            child = name if last else f"{self._name('joint', k)}_axis"
            if not last:
                SubElement(root, "link", name=child)
            self._add_joint(root, k, (parent, child), pose)
            parent, pose = child, RigidTransform(-here)
            if last:
                return
        add_joint(root, f"{name}_fixed", "fixed", (parent, name), pose)

    def _add_joint(
        self, root: Element, joint: int, ends: tuple[str, str], pose: RigidTransform
    ) -> None:
        m, name = self.m, self._name("joint", joint)
        hinge = self._is_hinge(joint)
        start, dof = float(m.qpos0[m.jnt_qposadr[joint]]), int(m.jnt_dofadr[joint])
        limits = {"effort": float(np.abs(self._efforts(joint)).min())}
        if m.jnt_limited[joint]:
            limits["lower"], limits["upper"] = (m.jnt_range[joint] - start).tolist()
        kind = ("revolute" if "lower" in limits else "continuous") if hinge else "prismatic"
        element = add_joint(
            root, name, kind, ends, pose,
            axis=m.jnt_axis[joint], limits=limits, rotor=self.rotors[name] or 0.0,
        )  # fmt: skip
        if m.dof_damping[dof] or m.dof_frictionloss[dof]:
            damping, friction = text(m.dof_damping[dof]), text(m.dof_frictionloss[dof])
            SubElement(element, "dynamics", damping=damping, friction=friction)
        for k in np.flatnonzero(m.eq_active0).tolist():
            if (tie := self._follower(k)) and tie[0] == joint:
                _, leader, multiplier, offset = tie
                SubElement(
                    element, "mimic", joint=self._name("joint", leader),
                    multiplier=text(multiplier), offset=text(offset),
                )  # fmt: skip

    def _efforts(self, joint: int) -> np.ndarray:
        """Return the least and the greatest force (2) of the actuators of a joint, N m or N.

        It is their sum, within the range of the joint. Infinite: not limited, or no actuator acts.
        """
        m, total = self.m, np.zeros(2)
        tendons = dict[int, list[tuple[float, np.ndarray]]]()
        for k in range(len(m.actuator_trntype)):
            if arm := self._arm(k, joint):
                force = self._force(k) if np.isfinite(arm) else _UNLIMITED
                if m.actuator_trntype[k] == int(self.mujoco.mjtTrn.mjTRN_TENDON):
                    tendons.setdefault(int(m.actuator_trnid[k][0]), []).append((arm, force))
                else:
                    total = total + np.sort(arm * force)
        for tendon, acting in tendons.items():
            pull = np.sum([np.sort(arm * force) for arm, force in acting], axis=0)
            if m.tendon_actfrclimited[tendon]:  # which limits the sum before the joint's lever
                most = max((arm for arm, _ in acting), key=abs) * m.tendon_actfrcrange[tendon]
                pull = np.clip(pull, *np.sort(most))
            total = total + pull
        if not total.any():
            total = _UNLIMITED
        return np.clip(total, *m.jnt_actfrcrange[joint]) if m.jnt_actfrclimited[joint] else total

    def _arm(self, actuator: int, joint: int) -> float:
        """Return the force of a joint per force of an actuator. 0: the actuator does not move the
        joint; NaN: the ratio varies.
        """
        m, kinds = self.m, self.mujoco.mjtTrn
        kind, (first, second) = int(m.actuator_trntype[actuator]), m.actuator_trnid[actuator][:2]
        gear = float(np.ravel(m.actuator_gear[actuator])[0])
        if kind in (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT)):
            return gear if first == joint else 0.0
        sites = [int(site) for site in (first, second) if site >= 0]
        if kind == int(kinds.mjTRN_TENDON):
            wraps = range(m.tendon_adr[first], m.tendon_adr[first] + m.tendon_num[first])
            of = [(int(m.wrap_type[w]), int(m.wrap_objid[w]), float(m.wrap_prm[w])) for w in wraps]
            if any(each == int(self.mujoco.mjtWrap.mjWRAP_JOINT) for each, *_ in of):
                return gear * sum(lever for _, moved, lever in of if moved == joint)
            sites = [at for each, at, _ in of if each == int(self.mujoco.mjtWrap.mjWRAP_SITE)]
        elif kind not in (int(kinds.mjTRN_SITE), int(kinds.mjTRN_SLIDERCRANK)):
            return 0.0
        moved = [self._carries(joint, int(m.site_bodyid[site])) for site in sites]
        return np.nan if any(moved) and (len(moved) == 1 or not all(moved)) else 0.0

    def _carries(self, joint: int, body: int) -> bool:
        """Whether a joint moves a body."""
        while body and body != self.m.jnt_bodyid[joint]:
            body = int(self.m.body_parentid[body])
        return bool(body)

    def _force(self, actuator: int) -> np.ndarray:
        """Return the least and greatest force (2) of an actuator; infinite: depends on motion."""
        m, mj, k = self.m, self.mujoco, actuator
        off = int(mj.mjtDisableBit.mjDSBL_ACTUATION)
        if (
            m.opt.disableflags & off
            or m.opt.disableactuator >> max(int(m.actuator_group[k]), 0) & 1
        ):
            return np.zeros(2)
        at = int(m.actuator_ctrladr[k]) if hasattr(m, "actuator_ctrladr") else k
        gain, bias, dynamics = m.actuator_gainprm[k], m.actuator_biasprm[k], m.actuator_dyntype[k]
        fixed, plain = int(mj.mjtGain.mjGAIN_FIXED), int(mj.mjtBias.mjBIAS_NONE)
        lags = (mj.mjtDyn.mjDYN_FILTER, mj.mjtDyn.mjDYN_FILTEREXACT)
        integrates = dynamics == int(mj.mjtDyn.mjDYN_INTEGRATOR)
        is_constant = (
            (m.actuator_gaintype[k] == fixed or _is_affine(m.actuator_gaintype[k], gain))
            and (m.actuator_biastype[k] == plain or _is_affine(m.actuator_biastype[k], bias))
            and (dynamics == 0 or integrates or dynamics in map(int, lags))
        )
        force = _UNLIMITED
        if is_constant:
            control = _UNLIMITED
            clamps = not m.opt.disableflags & int(mj.mjtDisableBit.mjDSBL_CLAMPCTRL)
            if m.actuator_ctrllimited[at] and clamps and not integrates:
                control = m.actuator_ctrlrange[at]
            if dynamics and m.actuator_actlimited[k]:
                control = np.clip(control, *m.actuator_actrange[k])
            force = np.sort(gain[0] * control) if gain[0] else np.zeros(2)
            if m.actuator_biastype[k] != plain:
                force = force + bias[0]
        at = int(m.actuator_outadr[k]) if hasattr(m, "actuator_outadr") else k
        if m.actuator_forcelimited[at]:
            force = np.clip(force, *m.actuator_forcerange[at])
        return force

    def _add_shape(self, link: Element, shape: int) -> None:
        m, kinds = self.m, self.mujoco.mjtGeom
        pose, size = _pose(m.geom_pos[shape], m.geom_quat[shape]), m.geom_size[shape]
        if (name := self._name("geom", shape)).startswith(_MISSING):
            add_visual(link, "mesh", pose, None, filename=name.partition(" ")[2])
            return
        kind, color = int(m.geom_type[shape]), m.geom_rgba[shape]
        if m.geom_matid[shape] >= 0:
            color = m.mat_rgba[m.geom_matid[shape]]
        shapes: dict[int, tuple[str, dict[str, Any]]] = {
            int(kinds.mjGEOM_SPHERE): ("sphere", {"radius": size[0]}),
            int(kinds.mjGEOM_CAPSULE): ("capsule", {"radius": size[0], "length": 2.0 * size[1]}),
            int(kinds.mjGEOM_CYLINDER): ("cylinder", {"radius": size[0], "length": 2.0 * size[1]}),
            int(kinds.mjGEOM_BOX): ("box", {"size": 2.0 * size}),
            int(kinds.mjGEOM_ELLIPSOID): (
                f"{DRAKE}ellipsoid", dict(zip("abc", size, strict=True))
            ),
        }  # fmt: skip
        if kind in shapes:
            name, sizes = shapes[kind]
            add_visual(
                link, name, pose, color, **{key: text(value) for key, value in sizes.items()}
            )
        elif kind in (int(kinds.mjGEOM_MESH), int(kinds.mjGEOM_SDF)):
            self._add_mesh(link, pose, color, int(m.geom_dataid[shape]))
        else:
            name = kinds(kind).name.removeprefix("mjGEOM_").lower()
            add_visual(link, "unread", pose, None, name=name)

    def _add_mesh(self, link: Element, pose: RigidTransform, color: Any, mesh: int) -> None:
        """Add a mesh as MuJoCo has compiled it: scaled, moved, of any format and folder."""
        m = self.m
        first, count = int(m.mesh_vertadr[mesh]), int(m.mesh_vertnum[mesh])
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in m.mesh_vert[first:][:count].tolist()]
        first, count = int(m.mesh_faceadr[mesh]), int(m.mesh_facenum[mesh])
        lines += [f"f {a} {b} {c}" for a, b, c in (1 + m.mesh_face[first:][:count]).tolist()]
        name = re.sub(r"[^\w.-]", "_", self._name("mesh", mesh)).removesuffix(".obj")
        if any(name == re.sub(r"[^\w.-]", "_", self._name("mesh", k)) for k in range(mesh)):
            name = f"{name}_{mesh}"
        add_visual(link, "mesh", pose, color, filename=f"{name}.obj")
        link[-1].find("geometry/mesh").text = "\n".join(lines)  # type: ignore[union-attr]


def _is_affine(kind: int, parameters: np.ndarray) -> bool:
    """Whether a gain or bias (1: affine) depends neither on length nor on velocity."""
    return kind == 1 and not parameters[1:3].any()


def _pose(position: object, quaternion: object) -> RigidTransform:
    unit = np.array(quaternion, dtype=float)
    return RigidTransform(Quaternion(unit / np.linalg.norm(unit)), np.array(position, dtype=float))
