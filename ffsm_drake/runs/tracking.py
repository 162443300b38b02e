"""Tracked errors of a run, and the pose error of a frame."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.common.numbers import usable
from ffsm_drake.runs.table import driven_of
from ffsm_drake.spacecraft.coordinates import BASE_POSITION, BASE_ROTATION
from ffsm_drake.spacecraft.nominal import PlantModel

if TYPE_CHECKING:
    from ffsm_drake.runs.table import Labelled

# Rotation vector from R_WF to its reference, then the position's difference; world axes.
FRAME_COORDINATES = tuple(
    name.replace("base", "frame") for name in (*BASE_ROTATION, *BASE_POSITION)
)
FRAME_UNITS = ("rad", "rad", "rad", "m", "m", "m")
# groups whose tolerances apply to a frame
FRAME_GROUPS = ("base_rotation",) * 3 + ("base_position",) * 3


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Tracked:
    """Tracked errors (n, k), rad and m, with name, unit, and the group whose tolerance applies."""

    error: np.ndarray
    names: tuple[str, ...]
    groups: tuple[str, ...]
    units: tuple[str, ...]


def frame_poses(model: PlantModel, q: np.ndarray, frame: Frame) -> np.ndarray:
    """Return poses (n, 7; quaternion, position) of a frame in configurations q (n, nq); NaN if q is
    not ``usable``.
    """
    result, finite = np.full((len(q), 7), np.nan), usable(q)
    if finite.any():
        result[finite] = model.calc_frame_pose(q[finite], frame)
    return result


def tracked_of(dataset: "Labelled") -> Tracked:
    """Return tracked errors of a run's time series: driven coordinates; a tracked frame replaces
    the joints.
    """
    error, counted = dataset["error"].values, driven_of(dataset)
    frame, rows = np.empty((len(error), 6)), np.zeros(6, dtype=bool)
    if "frame_error" in dataset:
        frame, rows = dataset["frame_error"].values, dataset["frame_tracked"].values.astype(bool)
    if rows.any():
        counted = counted & (dataset["group"].values.astype(str) != "joints")

    def of(name: str, others: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(map(str, [*dataset[name].values[counted], *np.array(others)[rows]]))

    return Tracked(
        error=np.hstack([error[:, counted], frame[:, rows]]) if rows.any() else error[:, counted],
        names=of("coordinate", FRAME_COORDINATES),
        groups=of("group", FRAME_GROUPS),
        units=of("unit", FRAME_UNITS),
    )
