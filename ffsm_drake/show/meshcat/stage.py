"""Meshcat: the server, the stage, and the spacecraft on it."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from pydrake.geometry import (
    IllustrationProperties,
    Meshcat,
    MeshcatParams,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Rgba,
    Role,
    RoleAssign,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame
from pydrake.systems.framework import DiagramBuilder

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.scenario import Model, Scenario
from ffsm_drake.spacecraft.plant import add_combined_plant, base_body, configuration, make_plant

_VIEW = np.array([0.5843, -0.7176, 0.3793])  # unit vector from what the camera looks at to the camera
_CAMERA_TARGET = np.array([0.2106, 0.0, 0.2106])  # per metre of the spacecraft's extent
_CAMERA_CLEARANCE = 2.74  # m beyond the extent: the camera stands in front of whatever the arm swings towards it
_GHOST_COLOR = Rgba(0.45, 0.85, 1.0, 0.10)


@contextmanager
def quiet_drake() -> Iterator[None]:
    """Hold back Drake's log messages below errors."""
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def start_meshcat() -> Meshcat:
    """A Meshcat server for this machine only (127.0.0.1). Raises FfsmError when no port is free."""
    params = MeshcatParams()
    params.host = "127.0.0.1"
    params.show_stats_plot = False
    try:
        return Meshcat(params)
    except RuntimeError as error:
        raise FfsmError(f"Meshcat cannot start: {one_line(error)}; free a port from 7000 to 7999") from error


def set_stage(meshcat: Meshcat, scenario: Scenario, *, ghost: bool = True) -> None:
    """A dark background, a camera on the servicer, and the translucent ghost of the target posture."""
    meshcat.SetProperty("/Background/<object>", "top_color", [0.02, 0.03, 0.08])
    meshcat.SetProperty("/Background/<object>", "bottom_color", [0.07, 0.09, 0.16])
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetProperty("/Lights/AmbientLight/<object>", "intensity", 1.2)
    meshcat.SetCameraPose(*camera_pose(make_plant(scenario.model), scenario))
    if ghost:
        _show_target_posture(meshcat, scenario)


def _show_target_posture(meshcat: Meshcat, scenario: Scenario) -> None:
    builder = DiagramBuilder()
    plant = add_combined_plant(builder, scenario.model)
    scene_graph = builder.GetSubsystemByName("scene_graph")
    inspector = scene_graph.model_inspector()
    for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
        properties = IllustrationProperties(inspector.GetIllustrationProperties(geometry))
        properties.UpdateProperty("phong", "diffuse", _GHOST_COLOR)
        with quiet_drake():  # warns that a visualizer might have started before; none has
            scene_graph.AssignRole(plant.get_source_id(), geometry, properties, RoleAssign.kReplace)
    params = MeshcatVisualizerParams()
    params.prefix = "target_posture"
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, params)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    target = configuration(plant, scenario.target_posture, key="target_posture")
    plant.SetPositions(plant.GetMyMutableContextFromRoot(context), target)
    diagram.ForcedPublish(context)


def camera_pose(plant: MultibodyPlant, scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Where the camera stands and the point that it looks at (3 each), world frame, m.

    Both follow the spacecraft's extent: how far its farthest body is from the base in either posture.
    """
    context = plant.CreateDefaultContext()
    base = base_body(plant).body_frame()
    bodies = [plant.get_body(BodyIndex(k)).body_frame() for k in range(1, plant.num_bodies())]  # 0 is the world
    extent = 0.0
    for name in ("initial_posture", "target_posture"):
        plant.SetPositions(context, configuration(plant, getattr(scenario, name), key=name))
        for body in bodies:
            p_BaseBody = plant.CalcRelativeTransform(context, base, body).translation()
            extent = max(extent, float(np.linalg.norm(p_BaseBody)))
    center = extent * _CAMERA_TARGET
    return center + (extent + _CAMERA_CLEARANCE) * _VIEW, center


class SpacecraftView:
    """The spacecraft in Meshcat, in any configuration, without a simulation."""

    def __init__(self, meshcat: Meshcat, model: Model, *, frames_per_second: float = 25.0) -> None:
        """Show the spacecraft in its default configuration.

        Args:
          meshcat: where.
          model: what.
          frames_per_second: of an animation that ``visualizer`` records.

        Raises:
          ModelError: the model does not load.
        """
        builder = DiagramBuilder()
        self.plant = add_combined_plant(builder, model)
        self.scene_graph = builder.GetSubsystemByName("scene_graph")
        params = MeshcatVisualizerParams()
        params.publish_period = 1.0 / frames_per_second
        self.visualizer = MeshcatVisualizer.AddToBuilder(builder, self.scene_graph, meshcat, params)
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._plant_context = self.plant.GetMyMutableContextFromRoot(self._context)
        self._diagram.ForcedPublish(self._context)

    def show(self, q: np.ndarray, *, time: float = 0.0) -> None:
        """Show configuration q (nq); ``time`` (s) is its place in an animation being recorded."""
        self._context.SetTime(time)
        self.plant.SetPositions(self._plant_context, q)
        self._diagram.ForcedPublish(self._context)

    def position_of(self, frame: Frame, point: np.ndarray) -> np.ndarray:
        """A point (3) of a frame of ``plant``, in world (3), in the configuration that is shown, m."""
        world = self.plant.world_frame()
        return self.plant.CalcPointsPositions(self._plant_context, frame, point, world)[:, 0]
