"""A record on Meshcat's stage, one sample at a time, for the recorded page."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
import xarray as xr
from pydrake.geometry import Meshcat, Rgba
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.registrations import Registry
from ffsm_drake.plugins.meshcat.arrows import ForceArrows
from ffsm_drake.plugins.meshcat.drift import START_LEGEND, draw_drift, draw_frame_path
from ffsm_drake.plugins.meshcat.solids import SwitchedSolids
from ffsm_drake.plugins.meshcat.stage import SpacecraftView, set_stage
from ffsm_drake.runs.dataset import free_target
from ffsm_drake.runs.metrics import usable_start
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import Model
from ffsm_drake.spacecraft.coordinates import StateSplit

FRAMES_PER_SECOND = 25.0
_PATH_COLOR = Rgba(1.0, 0.62, 0.1, 1.0)
_PATH_VERTICES = 400


class Deflections(Protocol):
    """Hidden coordinates of a run as they are drawn; ``legend``: how they are magnified."""

    @property
    def legend(self) -> str: ...

    def at(self, sample: int) -> np.ndarray:
        """Return the drawn hidden coordinates of a sample."""


# Of the dataset of a run, its model, and the plant in the view with its hidden coordinates.
DEFLECTION_VIEWS = Registry[Callable[[xr.Dataset, Model, MultibodyPlant, StateSplit], Deflections]](
    "deflection_views"
)


class ReplayView:
    """Stage and spacecraft; plumes, ghost of the target posture, end effector's path, arrows."""

    def __init__(
        self, meshcat: Meshcat, record: RunRecord, *, ghost: bool, path: bool, forces: bool,
        frames_per_second: float = FRAMES_PER_SECOND, speed: float = 1.0,
    ) -> None:  # fmt: skip
        """Set the scene and show the first sample. Raises ModelError if the model no longer loads.

        A frame covers ``speed / frames_per_second`` s of the run, so that short pulses show.
        """
        shown = [name for name in ("position", "hidden_position") if name in record.dataset]
        dataset = usable_start(record.dataset, shown)
        self.times = dataset["time"].values
        count = self.times.size
        self._positions = dataset["position"].values
        # Before a grasp the target is a separate body.
        self._target, self._payload_body = free_target(dataset), record.scenario.payload.body
        set_stage(meshcat, record.mission, ghost=ghost)
        self.spacecraft = SpacecraftView(
            meshcat, record.scenario, frames_per_second=frames_per_second
        )
        self.magnified = ""  # legend of deflections drawn larger
        self.deflections: Deflections | None = None
        if hidden := self.spacecraft.split.names:
            self.deflections = DEFLECTION_VIEWS.only(", ".join(hidden))(
                dataset, record.scenario.model, self.spacecraft.plant, self.spacecraft.split
            )
            self.magnified = self.deflections.legend
        if path and count > 1:
            every = max(1, count // _PATH_VERTICES)
            vertices = dataset["end_effector_position"].values[::every]
            meshcat.SetLine("end_effector_path", vertices.T, 4.0, _PATH_COLOR)
        self.legend: list[str] = []  # meaning of lines other than the end effector's path
        few = self._positions[:: max(1, count // _PATH_VERTICES)]
        if path and record.scenario.undriven and count > 1:
            draw_drift(meshcat, self.spacecraft, few)
            self.legend.append(START_LEGEND)
        if path and record.scenario.reference.frame is not None and count > 1:
            self.legend.append(draw_frame_path(meshcat, self.spacecraft, record.scenario, few))
        self.arrows: ForceArrows | None = None
        if forces:
            inspector = self.spacecraft.scene_graph.model_inspector()
            self.arrows = ForceArrows(meshcat, dataset, self.spacecraft.plant, inspector)
        self.switched = SwitchedSolids.of(
            meshcat, self.spacecraft.base_path, record, longest=self.spacecraft.longest
        )
        self._per_picture = max(1, round(speed / frames_per_second / record.scenario.sample_time))
        self.show(0.0)

    @property
    def duration(self) -> float:
        """Time of the last sample that can be shown, s."""
        return float(self.times[-1])

    def show(self, time: float, *, time_in_recording: float | None = None) -> None:
        """Show the sample at or next after a time of the run, s."""
        sample = min(int(np.searchsorted(self.times, time - 1e-9)), self.times.size - 1)
        deflection = None if self.deflections is None else self.deflections.at(sample)
        self.spacecraft.show(
            self._positions[sample], deflection=deflection, time=time_in_recording or 0.0
        )
        if (X_WP := self._target.get(sample)) is not None:
            self.spacecraft.place(self._payload_body, X_WP, time_in_recording=time_in_recording)
        if self.arrows is not None:
            self.arrows.show(sample, time_in_recording=time_in_recording)
        self.switched.show(sample, self._per_picture, time_in_recording=time_in_recording)


def check_speed(speed: float) -> None:
    """Raise FfsmError unless a playback speed is positive."""
    if not (np.isfinite(speed) and speed > 0.0):
        raise FfsmError(f"speed: must be > 0, not {speed:g}")
