"""Writes docs/tumbling_capture.webp, the animation of the README: ``python docs/animate.py``.

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
from pydrake.systems.sensors import CameraInfo

from ffsm_drake import RunRecord, load_scenario, simulate
from ffsm_drake.common.files import written_whole
from ffsm_drake.show.meshcat.stage import camera_pose
from ffsm_drake.spacecraft.plant import add_combined_plant

FILE = Path(__file__).parent / "tumbling_capture.webp"
WIDTH, HEIGHT, ANGLE = 640, 360, np.radians(54.0)  # pixels; vertical angle of view
EVERY, PAUSE = 0.75, 70  # s of the run between frames, ms of the animation
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


def frames(record: RunRecord):
    """The run's pictures, from a fixed place that shows the start and the end."""
    scenario, data = record.scenario, record.dataset
    held, apart = (Pictures(scenario, apart=apart) for apart in (False, True))
    camera, center = camera_pose(held.plant, scenario, held.scene.model_inspector())
    ahead = (center - camera) / np.linalg.norm(center - camera)
    right = np.cross(ahead, [0.0, 0.0, 1.0]) / np.linalg.norm(ahead[:2])
    X_WC = RigidTransform(
        RotationMatrix(np.array([right, np.cross(ahead, right), ahead]).T), camera
    )
    for sample in range(0, data.sizes["time"], round(EVERY / scenario.sample_time)):
        row = data.isel(time=sample)
        q = row["position"].values
        if row["phase"].item() == "approach":
            target = np.concatenate([row["target_quaternion"], row["target_position"]])
            yield apart.picture(np.concatenate([q, target]), X_WC)
        else:
            yield held.picture(q, X_WC)


if __name__ == "__main__":
    first, *rest = frames(simulate(load_scenario("tumbling_capture")))
    settings = {"duration": [PAUSE] * len(rest) + [1500], "loop": 0, "quality": 70, "method": 6}
    with written_whole(FILE) as file:
        first.save(file, save_all=True, append_images=rest, **settings)
    print(f"{FILE}: {1 + len(rest)} pictures, {FILE.stat().st_size / 1e6:.2f} MB")
