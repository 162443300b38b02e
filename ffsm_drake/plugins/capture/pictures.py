"""The live picture of a run up to its grasp: the spacecraft, and the target apart."""

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Demultiplexer, Multiplexer, TrajectorySource
from pydrake.systems.rendering import MultibodyPositionToGeometryPose
from pydrake.trajectories import PiecewisePolynomial

from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.spacecraft.plant import flexible_parts, load_model


def show_apart(target: np.ndarray, builder: DiagramBuilder, loop: ClosedLoop) -> None:
    """Show the spacecraft and a free target, whose poses are given (n, 7)."""
    scenario, plant = loop.scenario, loop.plant
    poses = _add_pictures(builder, loop)
    parts = builder.AddNamedSystem(
        "shown_state", Demultiplexer([plant.num_positions(), plant.num_velocities()])
    )
    times = scenario.sample_time * np.arange(len(target))
    path = builder.AddNamedSystem(
        "shown_target", TrajectorySource(PiecewisePolynomial.FirstOrderHold(times, target.T))
    )
    both = builder.AddNamedSystem("shown", Multiplexer([plant.num_positions(), target.shape[1]]))
    builder.Connect(plant.get_state_output_port(), parts.get_input_port())
    builder.Connect(parts.get_output_port(0), both.get_input_port(0))
    builder.Connect(path.get_output_port(), both.get_input_port(1))
    builder.Connect(both.get_output_port(), poses.get_input_port())


def _add_pictures(builder: DiagramBuilder, loop: ClosedLoop) -> MultibodyPositionToGeometryPose:
    """Add a scene graph in which the payload is free, and the system that poses its bodies: its
    input is the spacecraft's configuration, then the payload's pose (quaternion, position).
    """
    model, body = loop.scenario.model, loop.scenario.payload.body
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    plant = MultibodyPlant(time_step=0.0)
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    load_model(plant, model, apart=body, flexible=True)
    if model.flexible:
        flexible_parts().draw_on_plates(plant, scene_graph, model)
    poses = builder.AddNamedSystem("poses", MultibodyPositionToGeometryPose(plant))
    builder.Connect(
        poses.get_output_port(), scene_graph.get_source_pose_port(plant.get_source_id())
    )
    return poses
