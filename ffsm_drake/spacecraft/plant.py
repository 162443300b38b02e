"""The combined spacecraft: model directives -> MultibodyPlant, coordinates, captured payload."""

import functools
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import CollisionFilterDeclaration, Convex, Mesh, Role, SceneGraph
from pydrake.math import RollPitchYaw
from pydrake.multibody.parsing import (
    FlattenModelDirectives,
    LoadModelDirectives,
    PackageMap,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame, ModelInstanceIndex, RigidBody
from pydrake.systems.framework import DiagramBuilder

from ffsm_drake.common.errors import ModelError, choices, one_line
from ffsm_drake.common.files import check_regular
from ffsm_drake.common.memo import memoized
from ffsm_drake.common.so3 import rpy_of
from ffsm_drake.scenario import Model, Posture
from ffsm_drake.spacecraft.coordinates import (
    BASE_POSITION,
    BASE_ROTATION,
    GROUPS,
    HIDDEN,
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    Coordinates,
    StateSplit,
    joints_of,
)
from ffsm_drake.spacecraft.extensions import FLEXIBLE_PARTS, MODEL_FORMATS, FlexibleParts
from ffsm_drake.spacecraft.model_files import (
    DRAWABLE,
    MAX_SIZE,
    check_collada,
    files_of,
    mended,
    resolved,
)

# C++ exceptions as they arrive in Python; a violated condition arrives as SystemExit.
DRAKE_ERRORS = (RuntimeError, ValueError, IndexError, TypeError, SystemExit)

OWN_PACKAGE = "package://ffsm_drake/"

_CONDITIONS = {  # Drake's C++ text -> plain words
    "pos_lower_limits.array() <=": "a joint's lower limit lies above its upper limit",
    "in set_velocity_limits()": "a joint's velocity limit is negative",
    "in set_acceleration_limits()": "a joint's acceleration limit is negative",
}


@functools.cache
def models_dir() -> Path:
    """Return the folder of ``package://ffsm_drake/``: inside the package when installed, else the
    checkout's.
    """
    package = Path(__file__).parents[1]
    installed = package / "models"
    return installed if installed.is_dir() else package.parent / "models"


def resolve_package(address: str) -> Path:
    """Return the file at a path or ``package://ffsm_drake/`` address."""
    return (
        models_dir() / address.removeprefix(OWN_PACKAGE)
        if address.startswith(OWN_PACKAGE)
        else Path(address)
    )


def model_files(model: Model) -> tuple[Path, ...]:
    """Return the files that a model is made from. Raises ModelError: one of them cannot be read."""
    folders = _package_folders(model)
    addresses = [model.directives] if model.servicer is None else [model.servicer, model.debris]
    return tuple(
        dict.fromkeys(
            path for address in addresses for path in files_of(address or "", "model", folders)
        )
    )


def _package_folders(model: Model) -> dict[str, str]:
    """Return the folder of each package:// name, except Drake's own, whose files come over the
    network.
    """
    found = PackageMap.MakeEmpty()
    found.PopulateFromRosPackagePath()
    for name, folder in model.packages.items():
        if not name:
            raise ModelError("model.packages: a package's name must not be empty")
        if not Path(folder).is_dir():
            raise ModelError(f"model.packages.{name}: no such folder: {folder}")
    found_by_ros = {name: found.GetPath(name) for name in found.GetPackageNames()}
    return found_by_ros | {"ffsm_drake": str(models_dir())} | model.packages


def add_combined_plant(
    builder: DiagramBuilder, model: Model, *, flexible: bool = False
) -> MultibodyPlant:
    """Add the finalized plant (continuous, no gravity, quaternion floating base) and its scene
    graph to a diagram.

    Contact is not simulated. A ``flexible`` plant has the hidden coordinates too (``flexible.py``).

    Raises:
      ModelError: the directives or URDFs do not load, or do not give one floating base with
        one-degree joints.
    """
    plant, scene_graph = (each.Clone() for each in drawn_plant(model, flexible=flexible))
    builder.AddNamedSystem("plant", plant)
    builder.AddNamedSystem("scene_graph", scene_graph)
    builder.Connect(
        plant.get_geometry_pose_output_port(),
        scene_graph.get_source_pose_port(plant.get_source_id()),
    )
    builder.Connect(scene_graph.get_query_output_port(), plant.get_geometry_query_input_port())
    return plant


def _files_if_readable(model: Model) -> tuple[Path, ...]:
    """``model_files``; none if one cannot be read, because loading the model says more."""
    try:
        return model_files(model)
    except ModelError:
        return ()


def drawn_plant(model: Model, *, flexible: bool = False) -> tuple[MultibodyPlant, SceneGraph]:
    """Return the plant and the scene graph of ``add_combined_plant``, shared: clone them to
    change them.
    """
    return _drawn(model, flexible=flexible and bool(model.flexible))


# loading shapes takes ten times as long as the rest
@memoized(maxsize=8, files=_files_if_readable)
def _drawn(model: Model, *, flexible: bool) -> tuple[MultibodyPlant, SceneGraph]:
    plant, scene_graph = MultibodyPlant(time_step=0.0), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    load_model(plant, model, flexible=flexible)
    if flexible:
        flexible_parts().draw_on_plates(plant, scene_graph, model)
    bodies = [plant.get_body(BodyIndex(index)) for index in range(plant.num_bodies())]
    nothing_touches = CollisionFilterDeclaration().ExcludeWithin(
        plant.CollectRegisteredGeometries(bodies)
    )
    scene_graph.collision_filter_manager().Apply(nothing_touches)
    return plant, scene_graph


def flexible_parts() -> FlexibleParts:
    """Return the plug-in that adds the parts of ``model.flexible``. Raises BlockError without
    it.
    """
    return FLEXIBLE_PARTS.only("model.flexible")


def check_pictures(model: Model) -> None:
    """Raise ModelError unless the model's visual geometry loads, which a run does not need."""
    builder = DiagramBuilder()
    add_combined_plant(builder, model, flexible=True)
    inspector = builder.GetSubsystemByName("scene_graph").model_inspector()
    for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
        shape = inspector.GetShape(geometry)
        if not isinstance(shape, (Mesh, Convex)):
            continue
        path = Path(shape.source().description())
        if path.suffix.lower() not in DRAWABLE:
            raise ModelError(
                f"model: mesh {path}: this format cannot be drawn; convert it to "
                f"{', '.join(DRAWABLE)}"
            )
        try:
            if path.suffix.lower() == ".dae":
                check_collada(path)
            else:
                inspector.GetObbInGeometryFrame(geometry)
        except DRAKE_ERRORS as error:
            raise ModelError(f"model: mesh {path}: cannot be drawn: {cause_of(error)}") from error


def make_plant(
    model: Model, *, apart: str | None = None, flexible: bool = False, jointless: bool = False
) -> MultibodyPlant:
    """Return the finalized plant without a diagram, for computations. Arguments and errors: see
    ``load_model``.
    """
    plant = MultibodyPlant(time_step=0.0)
    load_model(plant, model, apart=apart, flexible=flexible, jointless=jointless)
    return plant


def parsed_plant(
    model: Model, *, apart: str | None = None, flexible: bool = False
) -> MultibodyPlant:
    """Return the plant of ``make_plant``, shared by all that have a context of their own. It is
    parsed again after a change of its files.
    """
    return _parsed_once(model, apart=apart, flexible=flexible and bool(model.flexible))


@memoized(maxsize=8, files=_files_if_readable)
def _parsed_once(model: Model, *, apart: str | None, flexible: bool) -> MultibodyPlant:
    return make_plant(model, apart=apart, flexible=flexible)


def load_model(
    plant: MultibodyPlant,
    model: Model,
    *,
    apart: str | None = None,
    flexible: bool = False,
    jointless: bool = False,
) -> None:
    """Parse the model into an empty plant, finalize and check it; see ``add_combined_plant``.

    A body ``apart`` (scoped name) is free: its pose, as a quaternion and a position, follows the
    spacecraft's configuration. A ``jointless`` plant may lack moving joints.
    """
    source = _parse(plant, model)
    if apart is not None:
        _free(plant, apart, model)
    try:
        if model.flexible:
            parts = flexible_parts()
            (parts.add_flexible if flexible else parts.lock_joints)(plant, model)
    except DRAKE_ERRORS as error:
        raise ModelError(f"model.flexible: {cause_of(error)}") from error
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    try:
        _add_drives(plant)
        plant.Finalize()
    except DRAKE_ERRORS as error:
        raise ModelError(f"{source}: {cause_of(error)}") from error
    if plant.num_constraints():
        raise ModelError(
            f"{source}: joints or bodies are coupled by <mimic> or a constraint; remove it: each "
            "joint is controlled on its own"
        )
    if not plant.GetFloatingBaseBodies():
        raise ModelError(f"{source}: no floating base; the base must not be welded to world")
    if apart is None:
        try:
            coordinates_of(plant, jointless=jointless)
        except ModelError as error:
            raise ModelError(f"{source}: {error}") from None
    hand_frame(plant, model)


def _parse(plant: MultibodyPlant, model: Model) -> str:
    """Parse the model's files. Returns the main file with its key, for errors."""
    parser = Parser(plant)
    parser.SetStrictParsing()  # else Drake replaces a non-physical inertia by a solid sphere
    folders = _package_folders(model)
    packages = parser.package_map()
    for name, folder in folders.items():
        if packages.Contains(name):
            packages.Remove(name)
        packages.Add(name, folder)
    if model.servicer is None:
        source = f"model.directives: {model.directives}"
        _add_models(parser, model.directives or "", source, folders)
        return source
    for name, file in (("servicer", model.servicer), ("debris", model.debris)):
        instances = _add_models(parser, file, f"model.{name}: {file}", folders)
        if len(instances) != 1:
            raise ModelError(f"model.{name}: {file}: must hold one model, not {len(instances)}")
        plant.RenameModelInstance(instances[0], name)
    _weld(plant, model)
    return f"model.servicer: {model.servicer}"


def _weld(plant: MultibodyPlant, model: Model) -> None:
    """Weld the grasp frame of the debris to the end effector of the servicer."""
    frames = []
    for key, name, instance in (
        ("end_effector", model.end_effector, "servicer"),
        ("grasp", model.grasp, "debris"),
    ):
        frame = find_frame(plant, name, key=f"model.{key}")
        if frame.model_instance() != plant.GetModelInstanceByName(instance):
            raise ModelError(
                f"model.{key}: '{frame.scoped_name()}' is not a frame of the {instance}; name one "
                "that is"
            )
        frames.append(frame)
    try:
        plant.WeldFrames(*frames)
    except DRAKE_ERRORS as error:
        raise ModelError(f"model.grasp: {model.grasp}: {cause_of(error)}") from error


def _free(plant: MultibodyPlant, name: str, model: Model) -> None:
    """Remove the joints between a body (scoped name) and the hand; other bodies fixed to it stay
    fixed.
    """
    body = find_body(plant, name, key="payload.body").index()
    gripper = hand_frame(plant, model).body().index()
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    ends = {joint: {joint.parent_body().index(), joint.child_body().index()} for joint in joints}
    side, grown = set[BodyIndex](), {gripper}
    while grown > side:
        side = set(grown)
        for pair in ends.values():
            if body not in pair and pair & side:
                grown |= pair
    for joint, pair in ends.items():
        if body in pair and pair & side:
            plant.RemoveJoint(joint)


def _add_drives(plant: MultibodyPlant) -> None:
    """Give each joint an actuator, only for its rotor's inertia; forces are applied elsewhere."""
    driven = {
        plant.get_joint_actuator(index).joint().index() for index in plant.GetJointActuatorIndices()
    }
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        hidden = joint.name().startswith(HIDDEN)
        if joint.num_velocities() == 1 and index not in driven and not hidden:
            plant.AddJointActuator(f"{joint.name()}_drive", joint)


def urdfs_of(model: Model) -> tuple[Path, ...]:
    """Return the URDFs among ``model_files``; errors as there."""
    return tuple(path for path in model_files(model) if path.suffix.lower() == ".urdf")


# Parts of Drake's texts that help nobody: a second "error: ", and long explanations at the end.
_NOISE = r"(?i)\berror: | (\(valid names in|while accepting|this is typically).*"


def cause_of(error: BaseException) -> str:
    """Drake's error text without its place in Drake's source; a condition names its function."""
    text = re.sub(_NOISE, "", one_line(error))
    for condition, meaning in _CONDITIONS.items():
        if condition in text:
            return meaning
    return re.sub(
        r"Failure at \S+ in (\S+)\(\): ", r"\1: " if isinstance(error, SystemExit) else "", text
    )


def _add_models(
    parser: Parser, file: str, place: str, packages: Mapping[str, str]
) -> list[ModelInstanceIndex]:
    """Parse a file or package:// address. Raises ModelError for anything rejected by Drake."""
    if "://" not in file:
        remedy = "give a file or a package:// address"
        try:
            check_regular(Path(file), limit=MAX_SIZE)
        except FileNotFoundError as error:
            raise ModelError(f"{place}: no such file; {remedy}") from error
        except (OSError, ValueError) as error:  # too long, no permission, a folder, ...
            raise ModelError(f"{place}: cannot be read: {one_line(error)}; {remedy}") from error
    files = files_of(file, place, packages)
    if (formats := MODEL_FORMATS.first()) is not None:
        formats.check(file, place, files, packages)
    with mended(files) as copies:
        try:
            return _added(parser, file, packages, copies)
        except DRAKE_ERRORS as error:
            # Drake's text begins with the file and line.
            cause = cause_of(error)
            for original, copied in copies.items():
                cause = cause.replace(str(copied), str(original))
            cause = cause.removeprefix(file) if cause.startswith(f"{file}:") else f": {cause}"
            raise ModelError(place + cause) from error


def _added(
    parser: Parser, file: str, packages: Mapping[str, str], copies: Mapping[Path, Path]
) -> list[ModelInstanceIndex]:
    """Add the models of a file, with copies in place of some files."""
    found: list[ModelInstanceIndex]
    path = next(resolved(file, Path(), packages), Path(file))
    if not copies or path in copies:
        file = str(copies.get(path, file))
        found = parser.AddModels(url=file) if "://" in file else parser.AddModels(file)
        return found
    flat = FlattenModelDirectives(LoadModelDirectives(str(path)), parser.package_map())
    for each in flat.directives:
        if each.add_model is not None:
            model = next(resolved(each.add_model.file, path.parent, packages), path)
            if model in copies:
                each.add_model.file = f"file://{copies[model]}"
    return [info.model_instance for info in ProcessModelDirectives(flat, parser)]


def base_body(plant: MultibodyPlant) -> RigidBody:
    """Return the floating base."""
    (index,) = plant.GetFloatingBaseBodies()
    return plant.get_body(index)


def coordinates_of(
    plant: MultibodyPlant, *, undriven: tuple[str, ...] = (), jointless: bool = False
) -> Coordinates:
    """Return names of the plant's generalized velocities, with the undriven groups.

    Raises ModelError for a layout that the package cannot control.
    """
    floating = plant.GetFloatingBaseBodies()
    if len(floating) != 1:
        names = sorted(plant.get_body(index).name() for index in floating)
        raise ModelError(
            f"the model must have one floating base, not {len(floating)} "
            f"({', '.join(names) or 'none'})"
        )
    joints = [joint for joint in joints_of(plant) if not joint.name().startswith(HIDDEN)]
    for joint in map(plant.get_joint, plant.GetJointIndices()):
        if joint.num_velocities() > 1 and joint.velocity_start() >= NUM_BASE_VELOCITIES:
            raise ModelError(
                f"joint '{joint.name()}' has {joint.num_velocities()} degrees of freedom; it must "
                "have one"
            )
    if not joints and not jointless:
        raise ModelError("no joint moves; an arm has revolute, continuous or prismatic joints")
    names = [joint.name() for joint in joints]
    reserved = sorted(set(names) & {"all", *GROUPS, *BASE_ROTATION, *BASE_POSITION})
    if reserved:
        raise ModelError(
            "joint names must differ from those of groups and base coordinates; rename "
            f"{', '.join(reserved)}"
        )
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ModelError(f"joint names must differ; more than one is called {', '.join(repeated)}")
    units = tuple("m" if joint.type_name() == "prismatic" else "rad" for joint in joints)
    # Drake names the frame that a model's joint is on after the joint.
    flexible = tuple(
        joint.frame_on_parent().name().removesuffix("_parent")
        for joint in map(plant.get_joint, plant.GetJointIndices())
        if joint.name().startswith(HIDDEN)
    )
    return Coordinates(tuple(names), units, undriven, flexible)


def split_of(plant: MultibodyPlant) -> StateSplit:
    """Return the hidden coordinates of a plant; empty if it was made without them."""
    joints = joints_of(plant)
    hidden = [joint for joint in joints if joint.name().startswith(HIDDEN)]
    if not hidden:
        return StateSplit()
    known = [joint for joint in joints if joint not in hidden]
    nq = plant.num_positions()
    base_q, base_v = list(range(NUM_BASE_POSITIONS)), list(range(NUM_BASE_VELOCITIES))
    known_v = [*base_v, *(joint.velocity_start() for joint in known)]
    hidden_v = [joint.velocity_start() for joint in hidden]
    return StateSplit(
        names=tuple(joint.name().removeprefix(HIDDEN) for joint in hidden),
        units=tuple("m" if joint.type_name() == "prismatic" else "rad" for joint in hidden),
        known_state=np.array(
            [*base_q, *(joint.position_start() for joint in known), *(nq + v for v in known_v)]
        ),
        hidden_state=np.array(
            [*(joint.position_start() for joint in hidden), *(nq + v for v in hidden_v)]
        ),
        known=np.array(known_v),
        hidden=np.array(hidden_v),
    )


def find_body(plant: MultibodyPlant, name: str, *, key: str) -> RigidBody:
    """Return the body with a scoped name such as ``debris::debris``. Raises ModelError naming the
    valid ones.
    """
    return _find("body", plant.GetBodyIndices, plant.get_body, plant, name, key)


def find_frame(plant: MultibodyPlant, name: str, *, key: str) -> Frame:
    """Return the frame with a scoped name such as ``servicer::end_effector``. Raises ModelError
    naming the valid ones.
    """
    return _find("frame", plant.GetFrameIndices, plant.get_frame, plant, name, key)


def hand_frame(plant: MultibodyPlant, model: Model) -> Frame:
    """Return the frame that holds the target, ``model.end_effector``."""
    return find_frame(plant, model.end_effector, key="model.end_effector")


def _find(
    kind: str,
    indices: Callable[..., Any],
    get: Callable[..., Any],
    plant: MultibodyPlant,
    name: str,
    key: str,
) -> Any:
    instances = map(ModelInstanceIndex, range(plant.num_model_instances()))
    found = {
        str(get(index).scoped_name()): get(index)
        for instance in instances
        for index in indices(instance)
    }
    if name not in found:
        # Drake adds unnamed frames to every joint and loop.
        joints = {plant.get_joint(index).name() for index in plant.GetJointIndices()}
        own = [
            each for each in found if each.rpartition("::")[2].removesuffix("_parent") not in joints
        ]
        raise ModelError(f"{key}: no {kind} '{name}'; choose one of {choices(name, own)}")
    return found[name]


def configuration(coordinates: Coordinates, posture: Posture, *, key: str) -> np.ndarray:
    """Return generalized positions q (nq) of a posture; ``key`` is its place in the scenario, for
    errors.
    """
    joints = coordinates.vector(posture.joints, key=f"{key}.joints", default=0.0)[
        NUM_BASE_VELOCITIES:
    ]
    quaternion = RollPitchYaw(posture.base_rpy).ToQuaternion()
    return np.concatenate([quaternion.wxyz(), posture.base_position, joints])


def base_rpy(q: np.ndarray) -> np.ndarray:
    """Return roll, pitch, yaw (..., 3) of the base in configurations q (..., nq), rad."""
    return rpy_of(q[..., :4])
