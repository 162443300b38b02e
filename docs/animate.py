"""Writes docs/tumbling_capture.webp, the animation of the README, and docs/second_try.webp:
``python docs/animate.py``.

Drake renders the run's frames with VTK, without a window; Pillow, which Matplotlib brings along,
writes them.
"""

from pathlib import Path

import numpy as np
from PIL import Image
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.systems.sensors import CameraInfo
from pydrake.trajectories import PiecewisePolynomial

from ffsm_drake import RunRecord, load_scenario, simulate
from ffsm_drake.common.files import written_whole
from ffsm_drake.plugins.meshcat.stage import camera_pose
from ffsm_drake.spacecraft.plant import add_combined_plant
from ffsm_drake.systems.setup import BlockSetup

FOLDER = Path(__file__).parent
WIDTH, HEIGHT, ANGLE = 640, 360, np.radians(54.0)  # pixels; vertical angle of view
PAUSE = 70  # ms of the animation, of a frame
GROUND = [0.09, 0.11, 0.18]


class Pictures:
    """Pictures of the spacecraft, with the target held or apart."""

    def __init__(self, scenario, *, apart):
        builder = DiagramBuilder()
        body = scenario.payload.body if apart else None
        self.plant = add_combined_plant(builder, scenario.model, apart=body)
        self.scene = builder.GetSubsystemByName("scene_graph")
        engine = MakeRenderEngineVtk(RenderEngineVtkParams(default_clear_color=GROUND))
        self.scene.AddRenderer("vtk", engine)
        self.diagram = builder.Build()
        self.context = self.diagram.CreateDefaultContext()
        info = CameraInfo(WIDTH, HEIGHT, ANGLE)
        core = RenderCameraCore("vtk", info, ClippingRange(0.1, 100.0), RigidTransform())
        self.camera = ColorRenderCamera(core)

    def picture(self, positions, X_WC):
        self.plant.SetPositions(self.plant.GetMyContextFromRoot(self.context), positions)
        query = self.scene.get_query_output_port().Eval(
            self.scene.GetMyContextFromRoot(self.context)
        )
        image = query.RenderColorImage(self.camera, self.scene.world_frame_id(), X_WC)
        return Image.fromarray(image.data[:, :, :3])


def frames(record: RunRecord, every: float):
    """The run's pictures, ``every`` so many s, from a fixed place that shows the start and the
    end.
    """
    scenario, data = record.scenario, record.dataset
    held, apart = (Pictures(scenario, apart=apart) for apart in (False, True))
    camera, center = camera_pose(held.plant, scenario, held.scene.model_inspector())
    ahead = (center - camera) / np.linalg.norm(center - camera)
    right = np.cross(ahead, [0.0, 0.0, 1.0]) / np.linalg.norm(ahead[:2])
    X_WC = RigidTransform(
        RotationMatrix(np.array([right, np.cross(ahead, right), ahead]).T), camera
    )
    for sample in range(0, data.sizes["time"], round(every / scenario.sample_time)):
        row = data.isel(time=sample)
        q = row["position"].values
        if row["phase"].item() != "stop":
            target = np.concatenate([row["target_quaternion"], row["target_position"]])
            yield apart.picture(np.concatenate([q, target]), X_WC)
        else:
            yield held.picture(q, X_WC)


def push(setup: BlockSetup):
    """A push of 15 N s on the base, shortly before the first contact, of which nobody knows."""
    force = np.zeros((len(setup.coordinates.names), 4))
    force[3, 1] = 30.0  # N, for 0.5 s
    times = [0.0, 18.2, 18.7, 1e4]
    builder = DiagramBuilder()
    source = builder.AddSystem(TrajectorySource(PiecewisePolynomial.ZeroOrderHold(times, force)))
    builder.ExportOutput(source.get_output_port(), "generalized_force")
    return builder.Build()


def missed_at_first(*more: str) -> RunRecord:
    """The pushed arm misses the target; the servicer retreats, waits and tries again.

    Args: further overrides.
    """
    given = [
        "description=A missed grasp, the retreat, and the second try",
        "duration=118",
        "capture.closing={}",
        "capture.retreat={}",
        "capture.envelope.position=0.012",
        *more,
    ]
    scenario = load_scenario("tumbling_capture", given)
    return simulate(scenario, blocks={"forces.push": push}, check_stability=False)


def animate(file: Path, record: RunRecord, every: float) -> None:
    """Write a run's animation."""
    first, *rest = frames(record, every)
    settings = {"duration": [PAUSE] * len(rest) + [1500], "loop": 0, "quality": 70, "method": 6}
    with written_whole(file) as whole:
        first.save(whole, save_all=True, append_images=rest, **settings)
    print(f"{file}: {1 + len(rest)} pictures, {file.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    animate(FOLDER / "tumbling_capture.webp", simulate(load_scenario("tumbling_capture")), 0.75)
    animate(FOLDER / "second_try.webp", missed_at_first(), 1.5)
