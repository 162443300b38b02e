"""Meshcat: the server, the stage, and the spacecraft on it."""

import gc
import logging
import math
import secrets
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np
from pydrake.geometry import (
    FrameId,
    IllustrationProperties,
    Meshcat,
    MeshcatParams,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Rgba,
    Role,
    RoleAssign,
    SceneGraph,
    SceneGraphInspector,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame
from pydrake.systems.framework import Context, DiagramBuilder

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.loopback import HOST, random_loopback
from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.plugins.meshcat.solids import draw_over, draw_solids, solids_of
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.boxes import box_around, box_corners
from ffsm_drake.spacecraft.plant import (
    add_combined_plant,
    base_body,
    configuration,
    find_body,
    split_of,
)
from ffsm_drake.systems.reference import make_motion

# unit vector from the camera's target to the camera
_VIEW = np.array([0.5843, -0.7176, 0.3793])
# Meshcat's vertical half angle is 37.5 degrees; this leaves a margin
_TANGENT = 0.85 * math.tan(math.radians(37.5))
_ASPECT = 4.0 / 3.0  # width over height of the views; a narrower page zooms out (recording.py)
_TRIES = 4  # at random addresses, then at 127.0.0.1
_TO_TARGET = (
    "quintic",
    "target_posture",
)  # kind and goal of a motion to the target posture
_WITHIN = ("mass", "pendulum")  # flexible parts inside their carrying bodies
_GHOST_COLOR = Rgba(0.45, 0.85, 1.0, 0.22)


@contextmanager
def quiet_drake() -> Iterator[None]:
    """Suppress Drake's log messages below errors."""
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


class _Started(threading.local):
    """The servers started by a thread, as long as they may be in use.

    Drake ends the process if another thread frees a server, and Python collects garbage in any
    allocating thread. Servers held here are freed by their own thread only.
    """

    def __init__(self) -> None:
        self._servers: list[Meshcat] = []

    def keep(self, server: Meshcat) -> None:
        self._servers.append(server)

    def free_unused(self) -> None:
        gc.collect()  # the diagrams that drew on them
        unused = 3  # references: the list, the name below, the argument of getrefcount
        self._servers = [server for server in self._servers if sys.getrefcount(server) > unused]


_STARTED = _Started()


def start_meshcat() -> Meshcat:
    """Return a Meshcat server for this machine only, at a random address and port.

    It lives until nothing uses it and its thread ends, or starts another.

    Drake's server obeys every page of this machine's browsers, whatever its origin, and some of
    their frames end it. So it listens on a random loopback address, 127.x.y.z (127.0.0.1 if the
    system has no others), and a random port, which other pages cannot guess; ``door.live_server``
    lets pages in. Raises FfsmError if no port is free.
    """
    _STARTED.free_unused()
    params = MeshcatParams()
    params.show_stats_plot = False
    for attempt in range(2 * _TRIES):
        if attempt < _TRIES:
            params.host = random_loopback()
        else:
            params.host = HOST
        params.port = 10_000 + secrets.randbelow(50_000)
        with suppress(RuntimeError), quiet_drake():  # keeps the address off the terminal
            meshcat = Meshcat(params)
            _STARTED.keep(meshcat)
            return meshcat
    raise FfsmError("Meshcat cannot start: no port of this machine is free for it")


def set_stage(meshcat: Meshcat, scenario: Scenario | Mission, *, ghost: bool = True) -> None:
    """Set a dark background, the camera and the translucent ghost of the target posture."""
    meshcat.SetProperty("/Background/<object>", "top_color", [0.06, 0.08, 0.14])
    meshcat.SetProperty("/Background/<object>", "bottom_color", [0.16, 0.20, 0.29])
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetProperty("/Lights/AmbientLight/<object>", "intensity", 1.6)
    builder, mission = DiagramBuilder(), make_mission(scenario)
    plant = add_combined_plant(builder, mission.craft.model, flexible=True)
    scene_graph = builder.GetSubsystemByName("scene_graph")
    camera, center = camera_pose(plant, mission, scene_graph.model_inspector())
    meshcat.SetCameraPose(camera, center)
    if ghost:
        _show_target_posture(meshcat, mission, builder, plant, scene_graph)


def _show_target_posture(
    meshcat: Meshcat,
    mission: Mission,
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
) -> None:
    inspector = scene_graph.model_inspector()
    for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
        properties = IllustrationProperties(inspector.GetIllustrationProperties(geometry))
        properties.UpdateProperty("phong", "diffuse", _GHOST_COLOR)
        with quiet_drake():  # warns that a visualizer may be running; none is
            scene_graph.AssignRole(plant.get_source_id(), geometry, properties, RoleAssign.kReplace)
    params = MeshcatVisualizerParams()
    params.prefix = "target_posture"
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, params)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    q = mission.craft.split.whole_positions(_last_configuration(mission))
    plant.SetPositions(plant.GetMyMutableContextFromRoot(context), q)
    diagram.ForcedPublish(context)


def _last_configuration(mission: Mission) -> np.ndarray:
    """Final configuration (nq) of the motion, which need not be the target posture."""
    scenario, reference = mission.scenario, mission.scenario.reference
    elsewhere = (
        (reference.kind, reference.goal) != _TO_TARGET
        or reference.frame is not None
        or scenario.undriven
    )
    if scenario.blocks.reference is None and elsewhere:
        with suppress(FfsmError):  # a plan's file may be gone
            motion = make_motion(mission)
            return motion.evaluate(motion.end)[0]
    return configuration(mission.craft.coordinates, scenario.target_posture, key="target_posture")


def camera_pose(
    plant: MultibodyPlant, mission: Mission, inspector: SceneGraphInspector
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions of the camera and of its target point (3 each), world frame, m.

    It looks at the middle of the visible spacecraft at the start and the end, from a distance that
    shows all.
    """
    context = plant.CreateDefaultContext()
    points = []
    for name, posture in mission.scenario.postures.items():
        last = name == "target_posture"
        q = (
            _last_configuration(mission)
            if last
            else configuration(mission.craft.coordinates, posture, key=name)
        )
        plant.SetPositions(context, mission.craft.split.whole_positions(q))
        # not the world
        points += [
            _outline(plant, context, inspector, BodyIndex(k)) for k in range(1, plant.num_bodies())
        ]
    p_WP = np.concatenate(points)
    right = np.cross([0.0, 0.0, 1.0], _VIEW) / np.linalg.norm(_VIEW[:2])
    axes = np.array([right, np.cross(_VIEW, right), _VIEW])
    seen = p_WP @ axes.T
    middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    seen, center = seen - middle, middle @ axes
    across = np.maximum(np.abs(seen[:, 0]) / _ASPECT, np.abs(seen[:, 1]))
    distance = float((seen[:, 2] + across / _TANGENT).max())
    return center + distance * _VIEW, center


def base_bounding_box(
    plant: MultibodyPlant, inspector: SceneGraphInspector
) -> tuple[RigidTransform, np.ndarray]:
    """Return the pose and half width (3), m, of a box around the base's largest visible
    geometry.
    """
    frame = plant.GetBodyFrameIdOrThrow(base_body(plant).index())
    found = (RigidTransform(), np.full(3, 0.5))  # an invisible base: a cube of 1 m
    largest = 0.0
    for geometry in inspector.GetGeometries(frame, Role.kIllustration):
        box = box_around(inspector, geometry)
        if box is not None and (size := float(np.prod(box.half_width()))) > largest:
            largest = size
            found = (inspector.GetPoseInFrame(geometry) @ box.pose(), np.array(box.half_width()))
    return found


def _outline(
    plant: MultibodyPlant, context: Context, inspector: SceneGraphInspector, index: BodyIndex
) -> np.ndarray:
    """Return a body's origin and the corners of its visible geometry's boxes (n, 3), world frame,
    m.
    """
    X_WB = plant.get_body(index).EvalPoseInWorld(context)
    points = [X_WB.translation()[None]]
    frame = plant.GetBodyFrameIdIfExists(index)
    for geometry in inspector.GetGeometries(frame, Role.kIllustration) if frame is not None else ():
        if (corners := box_corners(inspector, geometry)) is not None:
            points.append((X_WB @ corners.T).T)
    return np.concatenate(points)


class SpacecraftView:
    """The spacecraft with its actuators in Meshcat, in any configuration, without a
    simulation.
    """

    def __init__(
        self, meshcat: Meshcat, scenario: Scenario, *, frames_per_second: float = 25.0
    ) -> None:
        """Show the default configuration; ``frames_per_second`` is for ``visualizer``'s animation.

        Raises:
          ModelError: the model does not load.
        """
        builder = DiagramBuilder()
        self.plant = add_combined_plant(builder, scenario.model, flexible=True)
        self.split = split_of(self.plant)
        self.scene_graph = builder.GetSubsystemByName("scene_graph")
        params = MeshcatVisualizerParams()
        params.publish_period = 1.0 / frames_per_second
        self._meshcat, self._prefix = meshcat, params.prefix
        self.visualizer = MeshcatVisualizer.AddToBuilder(builder, self.scene_graph, meshcat, params)
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._plant_context = self.plant.GetMyMutableContextFromRoot(self._context)
        self._diagram.ForcedPublish(self._context)
        for name, part in scenario.model.flexible.items():
            if part.kind in _WITHIN:
                self._show_through(name)
        self.base_path = self._path_of(
            self.plant.GetBodyFrameIdOrThrow(base_body(self.plant).index())
        )
        _, half_width = base_bounding_box(self.plant, self.scene_graph.model_inspector())
        self.longest = 2.0 * float(half_width.max())  # edge of the base, m
        fixed = [solid for solid in solids_of(scenario) if not solid.shown_by]
        draw_solids(meshcat, self.base_path, fixed, longest=self.longest)
        self.legend = list(dict.fromkeys(solid.legend for solid in fixed if solid.legend))

    def show(
        self, q: np.ndarray, *, deflection: np.ndarray | None = None, time: float = 0.0
    ) -> None:
        """Show configuration q (nq), flexible parts, if any, at rest or at ``deflection``.

        ``time`` (s) is its place in an animation being recorded.
        """
        self._context.SetTime(time)
        self.plant.SetPositions(self._plant_context, self.split.whole_positions(q, deflection))
        self._diagram.ForcedPublish(self._context)

    def place(
        self, body: str, X_WB: RigidTransform, *, time_in_recording: float | None = None
    ) -> None:
        """Show a body (scoped name) apart from the rest, until the next ``show``."""
        frame = self.plant.GetBodyFrameIdOrThrow(
            find_body(self.plant, body, key="payload.body").index()
        )
        self._meshcat.SetTransform(self._path_of(frame), X_WB, time_in_recording)

    def _show_through(self, body: str) -> None:
        """Draw a body over everything else."""
        frame = self.plant.GetBodyFrameIdOrThrow(self.plant.GetBodyByName(body).index())
        inspector = self.scene_graph.model_inspector()
        for geometry in inspector.GetGeometries(frame, Role.kIllustration):
            name = inspector.GetName(geometry).replace("::", "/")
            draw_over(self._meshcat, f"{self._path_of(frame)}/{name}")

    def _path_of(self, frame: FrameId) -> str:
        name = self.scene_graph.model_inspector().GetName(frame)
        return f"{self._prefix}/{name.replace('::', '/')}"

    def position_of(self, frame: Frame, point: np.ndarray) -> np.ndarray:
        """Return a point (3) of a frame of ``plant`` in world (3), in the shown configuration,
        m.
        """
        world = self.plant.world_frame()
        return self.plant.CalcPointsPositions(self._plant_context, frame, point, world)[:, 0]
