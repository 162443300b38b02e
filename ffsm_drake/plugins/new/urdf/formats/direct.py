"""Models of other formats that Drake parses by itself, compared with the conversion of this
package.

Drake's parser ignores elements that change the motion.
"""

import logging
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import (
    FlattenModelDirectives,
    LoadModelDirectives,
    PackageMap,
    Parser,
)
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.common.errors import ModelError, one_line
from ffsm_drake.plugins.new.urdf.elements import listed, name_of
from ffsm_drake.plugins.new.urdf.formats.building import without_pictures
from ffsm_drake.plugins.new.urdf.formats.converting import convert
from ffsm_drake.spacecraft.checked_urdf import number, read_limits

_TOLERANCE = 1e-9  # relative, of numbers that two readers compute


def check_direct(address: str, packages: Mapping[str, str]) -> None:
    """Raise ModelError for a file, or a file in model directives, whose motion differs between
    Drake and ``convert``.

    Args:
      address: a path, or a package:// address.
      packages: package:// name -> folder.

    Raises RuntimeError: Drake cannot read the directives.
    """
    package_map = PackageMap.MakeEmpty()
    for name, folder in packages.items():
        package_map.Add(name, folder)
    path = _path(address, package_map)
    models = [path]
    if path.suffix.lower() in (".yaml", ".yml"):
        given = FlattenModelDirectives(LoadModelDirectives(str(path)), package_map).directives
        models = [
            _path(each.add_model.file, package_map) for each in given if each.add_model is not None
        ]
    for model in dict.fromkeys(models):
        if model.suffix.lower() in (".xml", ".sdf") and model.is_file():
            _check(model, packages)


def _path(address: str, package_map: PackageMap) -> Path:
    return Path(package_map.ResolveUrl(address) if "://" in address else address)


def _check(model: Path, packages: Mapping[str, str]) -> None:
    remedy = f"; convert it: ffsm new NAME --model {model.name}"
    try:
        found = convert(str(model), packages, {}, is_xacro=False, trust=False)
    except ModelError as error:
        raise ModelError(f"{model.name}: {error}") from error
    root = ElementTree.fromstring(found["urdf"])
    urdf = without_pictures(root)
    ours = plant_of(packages, lambda parser: parser.AddModelsFromString(urdf, "urdf"))
    try:
        theirs = plant_of(packages, lambda parser: parser.AddModels(str(model)), strict=True)
    except (RuntimeError, ValueError, SystemExit) as error:
        place = re.escape(str(model.absolute()))
        told = re.sub(rf"{place}:(\d+): error: ", r"line \1: ", one_line(error))
        raise ModelError(f"{model.name}: Drake's parser refuses it ({told}){remedy}") from error
    for difference in _differences(root, ours, theirs):
        raise ModelError(f"{model.name}: Drake's parser reads {difference}{remedy}")


def plant_of(
    packages: Mapping[str, str], add: Callable[[Parser], object], *, strict: bool = False
) -> MultibodyPlant:
    """The plant with the models that a function adds."""
    plant = MultibodyPlant(time_step=0.0)
    parser, log = Parser(plant), logging.getLogger("drake")
    for name, folder in packages.items():
        if not parser.package_map().Contains(name):
            parser.package_map().Add(name, folder)
    if strict:
        parser.SetStrictParsing()
    before, log.disabled = log.disabled, True
    try:
        add(parser)
        plant.Finalize()
    finally:
        log.disabled = before
    return plant


def _differences(root: Element, ours: MultibodyPlant, theirs: MultibodyPlant) -> Iterator[str]:
    """Return what Drake reads differently, as text after "reads"."""
    own, other = _joints(ours), _joints(theirs)
    if strange := sorted(own.keys() ^ other.keys()):
        yield f"other joints ({listed(strange)}); name every joint and body"
        return
    for element in root.findall("joint"):
        name = name_of(element)
        if name not in own:  # fixed
            continue
        one, two, place = own[name], other[name], f"joint '{name}'"
        dynamics = element.find("dynamics")
        friction = 0.0 if dynamics is None else number(dynamics, "friction", place, "0")
        lower, upper, effort, velocity = read_limits(element)
        for what, wanted, read in (
            ("friction", friction, 0.0),
            ("damping", one.default_damping(), two.default_damping()),
            ("lower position limit", lower, two.position_lower_limits()[0]),
            ("upper position limit", upper, two.position_upper_limits()[0]),
            ("velocity limit", velocity, two.velocity_upper_limits()[0] or np.inf),
            ("effort limit", effort, _effort(theirs, two)),
        ):
            if not _same(wanted, read):
                yield f"{place} with a {what} of {read:.4g}, not {wanted:.4g}"
    free = [{plant.get_body(k).name() for k in plant.GetFloatingBaseBodies()}
            for plant in (ours, theirs)]  # fmt: skip
    if free[0] != free[1]:
        yield f"the free bodies {', '.join(sorted(free[1])) or 'none'}, not as the file means them"
        return
    rng = np.random.default_rng(0)
    for _ in range(3):
        pose = RigidTransform(RollPitchYaw(rng.uniform(-1.0, 1.0, 3)), rng.normal(size=3))
        angles = dict(zip(own, rng.uniform(-1.0, 1.0, len(own)).tolist(), strict=True))
        mass, found = (_mass_matrix(plant, pose, angles) for plant in (ours, theirs))
        excess = mass - found
        small = np.abs(excess) <= _TOLERANCE * max(np.abs(mass).max(initial=0.0), 1e-12)
        rotors = np.diag(np.where(small, 0.0, excess))[mass.shape[0] - len(own) :]
        if (small | np.eye(len(small), dtype=bool)).all() and rotors.any():
            name = list(own)[int(np.flatnonzero(rotors)[0])]
            unit = "kg" if own[name].type_name() == "prismatic" else "kg m^2"
            lack = float(rotors[rotors != 0.0][0])
            side = "without" if lack > 0.0 else "with an extra"
            yield f"joint '{name}' {side} {abs(lack):.4g} {unit} of armature"
        if not small.all():
            yield "other masses or axes than the file means"


def _joints(plant: MultibodyPlant) -> dict[str, Any]:
    """The joints of one degree of freedom by name."""
    joints = map(plant.get_joint, plant.GetJointIndices())
    return {joint.name(): joint for joint in joints if joint.num_velocities() == 1}


def _effort(plant: MultibodyPlant, joint: Any) -> float:
    drives = map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
    efforts = [drive.effort_limit() for drive in drives if drive.joint().index() == joint.index()]
    return float(sum(efforts)) if efforts else np.inf


def _same(one: float, two: float) -> bool:
    return bool(np.isclose(one, two, rtol=_TOLERANCE, atol=_TOLERANCE))


def _mass_matrix(
    plant: MultibodyPlant, pose: RigidTransform, angles: Mapping[str, float]
) -> np.ndarray:
    """Return H with the free bodies at a pose: free bodies by name first, then the joints."""
    context, joints = plant.CreateDefaultContext(), _joints(plant)
    bodies = sorted(map(plant.get_body, plant.GetFloatingBaseBodies()), key=lambda b: b.name())
    order = list[int]()
    for body in bodies:
        plant.SetFreeBodyPose(context, body, pose)
        start = body.floating_velocities_start_in_v()
        order += range(start, start + 6)
    positions = plant.GetPositions(context)
    for name, angle in angles.items():
        positions[joints[name].position_start()] = angle
        order.append(joints[name].velocity_start())
    plant.SetPositions(context, positions)
    matrix: np.ndarray = plant.CalcMassMatrix(context)[np.ix_(order, order)]
    return matrix
