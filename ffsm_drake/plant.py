"""The combined spacecraft: model directives -> MultibodyPlant, its coordinates, and the captured payload."""

import dataclasses
from pathlib import Path

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import Frame, ModelInstanceIndex, RigidBody, RotationalInertia, SpatialInertia
from pydrake.systems.framework import Context, DiagramBuilder

from ffsm_drake.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.errors import ModelError, one_line
from ffsm_drake.scenario import MassProperties, Model, Posture, Scenario, inertia_matrix


def models_dir() -> Path:
    """The folder that ``package://ffsm_drake/`` stands for: beside the package when installed, else the checkout's."""
    package = Path(__file__).parent
    installed = package / "models"
    return installed if installed.is_dir() else package.parent / "models"


def add_combined_plant(builder: DiagramBuilder, model: Model) -> MultibodyPlant:
    """Add the finalized plant (continuous, no gravity, quaternion floating base) and its scene graph to a diagram.

    Raises:
      ModelError: the directives or URDFs do not load, or do not give one floating base with one-degree joints.
    """
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    plant.set_name("plant")
    scene_graph.set_name("scene_graph")
    _load(plant, model)
    return plant


def make_plant(model: Model) -> MultibodyPlant:
    """The finalized plant alone, for computations outside a diagram. Raises ModelError as add_combined_plant does."""
    plant = MultibodyPlant(time_step=0.0)
    _load(plant, model)
    return plant


def _load(plant: MultibodyPlant, model: Model) -> None:
    parser = Parser(plant)
    parser.SetStrictParsing()  # otherwise Drake replaces a non-physical inertia by a solid sphere
    packages = parser.package_map()
    packages.PopulateFromRosPackagePath()
    for name, folder in {"ffsm_drake": str(models_dir()), **model.packages}.items():
        if not Path(folder).is_dir():
            raise ModelError(f"model.packages.{name}: no such folder: {folder}")
        if packages.Contains(name):
            packages.Remove(name)
        packages.Add(name, folder)
    if model.servicer is None:
        source = f"model.directives: {model.directives}"
        _add_models(parser, model.directives or "", source)
    else:
        source = f"model.servicer: {model.servicer}"
        for name, file in (("servicer", model.servicer), ("debris", model.debris)):
            instances = _add_models(parser, file, f"model.{name}: {file}")
            if len(instances) != 1:
                raise ModelError(f"model.{name}: {file}: must hold one model, not {len(instances)}")
            plant.RenameModelInstance(instances[0], name)
        plant.WeldFrames(
            find_frame(plant, model.end_effector, key="model.end_effector"),
            find_frame(plant, model.grasp, key="model.grasp"),
        )
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    try:
        plant.Finalize()
    except RuntimeError as error:
        raise ModelError(f"{source}: {one_line(error)}") from error
    if not plant.GetFloatingBaseBodies():
        raise ModelError(f"{source}: no floating base; the base must not be welded to world")
    coordinates_of(plant)
    find_frame(plant, model.end_effector, key="model.end_effector")


def _add_models(parser: Parser, file: str, place: str) -> list[ModelInstanceIndex]:
    """Parse a file or package:// address; whatever Drake objects to becomes a ModelError."""
    if "://" not in file and not Path(file).is_file():
        raise ModelError(f"{place}: no such file")
    try:
        instances: list[ModelInstanceIndex] = parser.AddModels(url=file) if "://" in file else parser.AddModels(file)
    except (RuntimeError, ValueError) as error:  # the latter for malformed numbers
        raise ModelError(f"{place}: {one_line(error)}") from error
    return instances


def base_body(plant: MultibodyPlant) -> RigidBody:
    """The floating base."""
    (index,) = plant.GetFloatingBaseBodies()
    return plant.get_body(index)


def coordinates_of(plant: MultibodyPlant) -> Coordinates:
    """Names of the plant's generalized velocities. Raises ModelError for a layout that the package cannot control."""
    floating = plant.GetFloatingBaseBodies()
    if len(floating) != 1:
        names = sorted(plant.get_body(index).name() for index in floating)
        raise ModelError(f"the model must have one floating base, not {len(floating)} ({', '.join(names) or 'none'})")
    joints = sorted(
        (
            plant.get_joint(index)
            for index in plant.GetJointIndices()
            if plant.get_joint(index).num_velocities() > 0
            and plant.get_joint(index).velocity_start() >= NUM_BASE_VELOCITIES
        ),
        key=lambda joint: joint.velocity_start(),
    )
    for joint in joints:
        if joint.num_velocities() != 1:
            raise ModelError(
                f"joint '{joint.name()}' has {joint.num_velocities()} degrees of freedom; it must have one"
            )
    names = [joint.name() for joint in joints]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ModelError(f"joint names must differ; more than one is called {', '.join(repeated)}")
    units = tuple("m" if joint.type_name() == "prismatic" else "rad" for joint in joints)
    return Coordinates(tuple(names), units)


def find_body(plant: MultibodyPlant, name: str, *, key: str) -> RigidBody:
    """The body with a scoped name such as ``debris::debris``. Raises ModelError naming the valid ones."""
    bodies = {
        str(plant.get_body(index).scoped_name()): plant.get_body(index)
        for instance in map(ModelInstanceIndex, range(plant.num_model_instances()))
        for index in plant.GetBodyIndices(instance)
    }
    if name not in bodies:
        raise ModelError(f"{key}: no body '{name}'; choose one of {', '.join(bodies)}")
    return bodies[name]


def find_frame(plant: MultibodyPlant, name: str, *, key: str) -> Frame:
    """The frame with a scoped name such as ``servicer::end_effector``. Raises ModelError naming the valid ones."""
    frames = {
        str(plant.get_frame(index).scoped_name()): plant.get_frame(index)
        for instance in map(ModelInstanceIndex, range(plant.num_model_instances()))
        for index in plant.GetFrameIndices(instance)
    }
    if name not in frames:
        raise ModelError(f"{key}: no frame '{name}'; choose one of {', '.join(frames)}")
    return frames[name]


def configuration(plant: MultibodyPlant, posture: Posture, *, key: str) -> np.ndarray:
    """Generalized positions q (nq) of a posture; ``key`` is its place in the scenario, for errors."""
    coordinates = coordinates_of(plant)
    joints = coordinates.vector(posture.joints, key=f"{key}.joints", default=0.0)[NUM_BASE_VELOCITIES:]
    quaternion = RollPitchYaw(posture.base_rpy).ToQuaternion()
    return np.concatenate([quaternion.wxyz(), posture.base_position, joints])


def base_rpy(q: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw (3) of the base in configuration q, rad."""
    return RollPitchYaw(Quaternion(q[:4] / np.linalg.norm(q[:4]))).vector()


def spatial_inertia(properties: MassProperties) -> SpatialInertia:
    """M_PPo_P of a payload: spatial inertia about its frame's origin, in its own axes."""
    inertia = inertia_matrix(properties)
    central = RotationalInertia(
        Ixx=inertia[0, 0], Iyy=inertia[1, 1], Izz=inertia[2, 2], Ixy=inertia[0, 1], Ixz=inertia[0, 2], Iyz=inertia[1, 2]
    )
    return SpatialInertia.MakeFromCentralInertia(
        mass=properties.mass, p_PScm_E=properties.center_of_mass, I_SScm_E=central
    )


def set_payload(plant: MultibodyPlant, context: Context, *, body: str, properties: MassProperties) -> None:
    """Give the payload body its mass properties in one context; the parsed model stays as it is."""
    find_body(plant, body, key="payload.body").SetSpatialInertiaInBodyFrame(context, spatial_inertia(properties))


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlantModel:
    """A plant with a payload, for computations outside any simulation.

    ``context`` is a scratch pad owned by this object; every method sets what it reads.
    """

    plant: MultibodyPlant
    context: Context
    coordinates: Coordinates

    def calc_mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """The mass matrix H (nv, nv) in configuration q (nq)."""
        self.plant.SetPositions(self.context, q)
        return self.plant.CalcMassMatrix(self.context)

    def calc_bias(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """The Coriolis and centrifugal term C (nv) of H dv/dt + C = tau + tau_d, N m and N."""
        self.plant.SetPositions(self.context, q)
        self.plant.SetVelocities(self.context, v)
        return self.plant.CalcBiasTerm(self.context)


def make_nominal_plant(scenario: Scenario) -> PlantModel:
    """The plant as the controller believes it (``payload.belief``): its mass matrix is the paper's H with a hat."""
    return _make_plant_model(scenario, scenario.payload.belief)


def make_true_plant(scenario: Scenario) -> PlantModel:
    """The plant as it is (``payload.truth``)."""
    return _make_plant_model(scenario, scenario.payload.truth)


def _make_plant_model(scenario: Scenario, payload: MassProperties) -> PlantModel:
    plant = make_plant(scenario.model)
    context = plant.CreateDefaultContext()
    set_payload(plant, context, body=scenario.payload.body, properties=payload)
    return PlantModel(plant=plant, context=context, coordinates=coordinates_of(plant))
