"""MJCF, as MuJoCo compiles it: defaults, includes, inertias from shapes and all compiler options
are applied.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform

from ffsm_drake.common.numbers import counted
from ffsm_drake.plugins.new.urdf.elements import WORLD, listed
from ffsm_drake.plugins.new.urdf.formats.building import (
    add_frame,
    add_joint,
    add_link,
    add_mimic,
    add_visual,
    keep_servicer,
    passed_over,
    text,
)
from ffsm_drake.plugins.new.urdf.formats.mjcf_drives import Efforts, rotors
from ffsm_drake.plugins.new.urdf.formats.mjcf_files import MISSING, compiled
from ffsm_drake.plugins.new.urdf.wavefront import wavefront
from ffsm_drake.spacecraft.checked_urdf import DRAKE, require

_DRAWN_GROUPS = 3  # MuJoCo shows the geoms of groups 0 to 2
_HINGE, _SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
_SHAPES: dict[str, tuple[str, tuple[str, ...]]] = {  # geom -> shape of a URDF, and its sizes
    "sphere": ("sphere", ("radius",)),
    "capsule": ("capsule", ("radius", "length")),
    "cylinder": ("cylinder", ("radius", "length")),
    "box": ("box", ("size",)),
    "ellipsoid": (f"{DRAKE}ellipsoid", ("a", "b", "c")),
}
_PASSED_OVER = {  # number in the compiled model -> what it counts
    "nu": "actuator", "ntendon": "tendon", "ncam": "camera", "nlight": "light",
    "nsensor": "sensor", "nkey": "keyframe", "ntex": "texture", "nskin": "skin",
    "npair": "contact pair", "nmocap": "mocap body", "nhfield": "height field",
}  # fmt: skip


def read_mjcf(path: Path, packages: Mapping[str, Path]) -> tuple[Element, list[str]]:
    """The URDF of an MJCF file, and remarks. Raises ModelError: MuJoCo cannot compile it, or
    parts of it cannot be represented.
    """
    spec, model, missing = compiled(path)
    reader = _Reader(model)
    faults = [*reader.faults()]
    require(not faults, "has what cannot be simulated here: " + "; ".join(faults))
    root = reader.root(spec.modelname or "servicer")
    passed = [
        *reader.passed_over(),
        *([f"missing files ({listed(missing)})"] if missing else []),
    ]
    return root, [*passed_over(passed), *reader.one_sided(), *keep_servicer(root)]


class _Reader:
    """A compiled model (its m) as a URDF."""

    def __init__(self, m: Any) -> None:
        self.m, kinds = m, m.jnt_type
        self.single = np.flatnonzero((kinds == _HINGE) | (kinds == _SLIDE)).tolist()
        self.rotors = dict(
            zip(self.single, rotors(m, m.jnt_dofadr[self.single].tolist()), strict=True)
        )
        efforts = Efforts(m)
        self.efforts = {joint: efforts.of(joint) for joint in self.single}
        free = {int(m.jnt_bodyid[k]) for k in self._joints(mujoco.mjtJoint.mjJNT_FREE)}
        self.kept = {int(body) for body in np.flatnonzero(m.body_weldid > 0)}
        for body in sorted(self.kept):  # a mounted arm's fixed foot
            while body and body not in free:
                body = int(m.body_parentid[body])
                self.kept |= {body} - {0}

    def _joints(self, kind: Any) -> list[int]:
        return np.flatnonzero(self.m.jnt_type == kind).tolist()

    def _name(self, kind: str, index: int) -> str:
        type_of = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
        return mujoco.mj_id2name(self.m, type_of, index) or f"{kind}_{index}"

    def faults(self) -> Iterator[str]:
        """Elements that change dynamics and have no counterpart, one text each."""
        m, kinds = self.m, mujoco.mjtJoint
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
        springs = np.column_stack([m.jnt_stiffness, m.jnt_stiffnesspoly])
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
        elif not np.isfinite([*m.dof_armature, *m.actuator_armature]).all():
            yield "an armature is no finite number; give one of 0 or more, or leave it out"
        else:
            yield from self._drive_faults()

    def _drive_faults(self) -> Iterator[str]:
        for joint, (least, most) in self.efforts.items():
            name = self._name("joint", joint)
            if self.rotors[joint] is None:
                yield f"joint '{name}': its actuators' armature couples it with others"
            if least != most and not least < 0.0 < most:
                yield (
                    f"the actuators of joint '{name}' push one way only "
                    f"({least:.4g} to {most:.4g}); add one that pushes back"
                )

    def one_sided(self) -> Iterator[str]:
        """A remark on joints with different limits of force in the two directions."""
        told = [
            f"{self._name('joint', joint)} {min(-least, most):.4g} "
            f"{'N m' if self.m.jnt_type[joint] == _HINGE else 'N'} (of {least:.4g} to {most:.4g})"
            for joint, (least, most) in self.efforts.items()
            if -least != most
        ]
        if told:
            yield f"effort limits hold in both directions, so the smaller counts: {listed(told)}"

    def _follower(self, k: int) -> tuple[int, int, float, float] | None:
        """Follower and leader of an equality of two joints, multiplier and offset; None for other
        kinds.
        """
        m = self.m
        first, second, data = int(m.eq_obj1id[k]), int(m.eq_obj2id[k]), m.eq_data[k]
        is_line = m.eq_type[k] == mujoco.mjtEq.mjEQ_JOINT and not data[2:5].any()
        return (first, second, float(data[1]), float(data[0])) if is_line and second >= 0 else None

    def passed_over(self) -> Iterator[str]:
        """Elements without effect in free flight, with their numbers."""
        m, usual = self.m, mujoco.MjOption()
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

    def root(self, name: str) -> Element:
        """The URDF."""
        root, m = Element("robot", name=name), self.m
        for body in sorted(self.kept):
            self._add_body(root, body)
        for site, body in enumerate(m.site_bodyid.tolist()):
            name = self._name("site", site)
            alone = np.count_nonzero(m.site_bodyid == body) == 1
            taken = {each.get("name") for each in root}
            if body in self.kept and (alone or name != f"site_{site}") and name not in taken:
                pose = _pose(m.site_pos[site], m.site_quat[site])
                add_frame(root, name, self._name("body", body), pose)
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
        if not {*joints} <= {*self.single}:
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
        start, dof = float(m.qpos0[m.jnt_qposadr[joint]]), int(m.jnt_dofadr[joint])
        limits = {"effort": float(np.abs(self.efforts[joint]).min())}
        if m.jnt_limited[joint]:
            limits["lower"], limits["upper"] = (m.jnt_range[joint] - start).tolist()
        turns = "revolute" if "lower" in limits else "continuous"
        element = add_joint(
            root, name, turns if m.jnt_type[joint] == _HINGE else "prismatic", ends, pose,
            axis=m.jnt_axis[joint], limits=limits, rotor=self.rotors[joint] or 0.0,
            damping=m.dof_damping[dof], friction=m.dof_frictionloss[dof],
        )  # fmt: skip
        for k in np.flatnonzero(m.eq_active0).tolist():
            if (tie := self._follower(k)) and tie[0] == joint:
                add_mimic(element, self._name("joint", tie[1]), *tie[2:])

    def _add_shape(self, link: Element, shape: int) -> None:
        m, (radius, half, *_) = self.m, self.m.geom_size[shape]
        pose, size = _pose(m.geom_pos[shape], m.geom_quat[shape]), m.geom_size[shape]
        if (name := self._name("geom", shape)).startswith(MISSING):
            add_visual(link, "mesh", pose, None, filename=name.partition(" ")[2])
            return
        material = m.geom_matid[shape]
        color = m.mat_rgba[material] if material >= 0 else m.geom_rgba[shape]
        kind = mujoco.mjtGeom(int(m.geom_type[shape])).name.removeprefix("mjGEOM_").lower()
        if kind in ("mesh", "sdf"):
            self._add_mesh(link, pose, color, int(m.geom_dataid[shape]))
        elif kind in _SHAPES:
            drawn, keys = _SHAPES[kind]
            sizes = {"size": 2.0 * size, "radius": radius, "length": 2.0 * half}
            sizes |= zip("abc", size, strict=True)
            add_visual(link, drawn, pose, color, **{key: text(sizes[key]) for key in keys})
        else:
            add_visual(link, "unread", pose, None, name=kind)

    def _add_mesh(self, link: Element, pose: RigidTransform, color: Any, mesh: int) -> None:
        """Add a mesh as MuJoCo has compiled it: scaled, moved, of any format and folder."""
        m = self.m
        first, count = int(m.mesh_vertadr[mesh]), int(m.mesh_vertnum[mesh])
        vertices = m.mesh_vert[first:][:count]
        first, count = int(m.mesh_faceadr[mesh]), int(m.mesh_facenum[mesh])
        names = [
            re.sub(r"[^\w.-]", "_", self._name("mesh", k)).removesuffix(".obj")
            for k in range(mesh + 1)
        ]
        name = f"{names[mesh]}_{mesh}" if names[mesh] in names[:mesh] else names[mesh]
        add_visual(link, "mesh", pose, color, filename=f"{name}.obj")
        made = wavefront(vertices, m.mesh_face[first:][:count].tolist())
        link[-1].find("geometry/mesh").text = made  # type: ignore[union-attr]


def _pose(position: object, quaternion: object) -> RigidTransform:
    unit = np.array(quaternion, dtype=float)
    return RigidTransform(Quaternion(unit / np.linalg.norm(unit)), np.array(position, dtype=float))
