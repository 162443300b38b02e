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
from pydrake.multibody.tree import Frame
from pydrake.systems.framework import DiagramBuilder

from ffsm_drake.plant import add_combined_plant, configuration
from ffsm_drake.scenario import Model, Scenario

_CAMERA, _CAMERA_TARGET = np.array([3.3, -3.5, 2.3]), np.array([0.45, 0.0, 0.45])
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
    """A Meshcat server for this machine only (127.0.0.1)."""
    params = MeshcatParams()
    params.host = "127.0.0.1"
    params.show_stats_plot = False
    return Meshcat(params)


def set_stage(meshcat: Meshcat, scenario: Scenario, *, ghost: bool = True) -> None:
    """A dark background, a camera on the servicer, and the translucent ghost of the target posture."""
    meshcat.SetProperty("/Background/<object>", "top_color", [0.02, 0.03, 0.08])
    meshcat.SetProperty("/Background/<object>", "bottom_color", [0.07, 0.09, 0.16])
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetProperty("/Lights/AmbientLight/<object>", "intensity", 1.2)
    meshcat.SetCameraPose(_CAMERA, _CAMERA_TARGET)
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
