"""Meshcat: the live view, and the recording made from a run's record."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import DiagramBuilder

from ffsm_drake.files import write_text
from ffsm_drake.plant import add_combined_plant, base_body, configuration
from ffsm_drake.record import RunRecord
from ffsm_drake.scenario import Scenario

FRAMES_PER_SECOND = 25.0
_VIEW = np.array([0.5843, -0.7176, 0.3793])  # unit vector from what the camera looks at to the camera
_CAMERA_TARGET = np.array([0.2106, 0.0, 0.2106])  # per metre of the spacecraft's extent
_CAMERA_CLEARANCE = (
    2.74  # m, how far beyond the extent the camera stands: in front of whatever the arm swings towards it
)
_GHOST_COLOR = Rgba(0.45, 0.85, 1.0, 0.10)
_PATH_COLOR = Rgba(1.0, 0.62, 0.1, 1.0)


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


def set_stage(meshcat: Meshcat, scenario: Scenario) -> None:
    """A dark background, a camera on the servicer, and the translucent ghost of the target posture."""
    meshcat.SetProperty("/Background", "top_color", [0.02, 0.03, 0.08])
    meshcat.SetProperty("/Background", "bottom_color", [0.07, 0.09, 0.16])
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetProperty("/Lights/AmbientLight/<object>", "intensity", 1.2)

    builder = DiagramBuilder()
    plant = add_combined_plant(builder, scenario.model)
    meshcat.SetCameraPose(*camera_pose(plant, scenario))
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


def write_recording(record: RunRecord, path: Path) -> None:
    """Write a self-contained HTML page that plays the run back: no simulation, only the record.

    It shows the motion, the ghost of the target posture and the end effector's path.

    Raises:
      RecordError: the file cannot be written.
    """
    with quiet_drake():  # the server is only a means to the page; nobody should open its address
        meshcat = start_meshcat()
    set_stage(meshcat, record.scenario)
    dataset = record.dataset
    path_vertices = dataset["end_effector_position"].values[:: max(1, dataset.sizes["time"] // 400)]
    meshcat.SetLine("end_effector_path", path_vertices.T, 4.0, _PATH_COLOR)

    builder = DiagramBuilder()
    plant = add_combined_plant(builder, record.scenario.model)
    params = MeshcatVisualizerParams()
    params.publish_period = 1.0 / FRAMES_PER_SECOND
    visualizer = MeshcatVisualizer.AddToBuilder(builder, builder.GetSubsystemByName("scene_graph"), meshcat, params)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant_context = plant.GetMyMutableContextFromRoot(context)
    visualizer.StartRecording(set_transforms_while_recording=False)
    times, positions = dataset["time"].values, dataset["position"].values
    frames = np.arange(0.0, times[-1] + 0.5 / FRAMES_PER_SECOND, 1.0 / FRAMES_PER_SECOND)
    for time, sample in zip(frames, np.searchsorted(times, frames - 1e-9).clip(max=times.size - 1), strict=True):
        context.SetTime(time)
        plant.SetPositions(plant_context, positions[sample])
        diagram.ForcedPublish(context)
    visualizer.StopRecording()
    visualizer.PublishRecording()
    write_text(path, meshcat.StaticHtml())
