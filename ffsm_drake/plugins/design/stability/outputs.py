"""What a law controls: the coordinates, or the pose of a frame and the driven base.

Errors of outputs are those of the coordinates (nv), and then, with a law that tracks a frame, the
rotation vector and the position of the frame (6).
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ffsm_drake.mission import Mission
from ffsm_drake.plugins.design.stability.linear_loop import LinearLoop
from ffsm_drake.runs.tracking import frame_poses
from ffsm_drake.scenario import Grip
from ffsm_drake.spacecraft.coordinates import Coordinates, position_errors
from ffsm_drake.spacecraft.free_floating import free_floating
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.frame_path import goal_frame, tracked_rows
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_frame_motion

FRAME_ROWS = 6
_PARTS = {"frame_rotation": slice(0, 3), "frame_position": slice(3, FRAME_ROWS)}
_POSE = slice(0, 7)  # of a row of the path of a frame


class Group(NamedTuple):
    """A group of outputs."""

    errors: slice  # entries among the errors
    forces: slice  # coordinates whose forces move them
    share: float  # share of the effort of these coordinates, so that the shares add up to 1


def groups_of(coordinates: Coordinates) -> Mapping[str, Group]:
    """Return the groups of a law that tracks coordinates."""
    return {name: Group(part, part, 1.0) for name, part in coordinates.driven_groups.items()}


@dataclasses.dataclass(frozen=True, eq=False)
class Outputs:
    """The outputs of a law along a motion."""

    mission: Mission
    motion: PlannedMotion
    grip: Grip
    coordinates: Coordinates
    tracks_frame: bool

    @property
    def size(self) -> int:
        """Number of errors."""
        return self.coordinates.num_velocities + FRAME_ROWS * self.tracks_frame

    @functools.cached_property
    def groups(self) -> Mapping[str, Group]:
        """The groups, by name."""
        own = dict(groups_of(self.coordinates))
        if not self.tracks_frame:
            return own
        joints, first = own.pop("joints").forces, self.coordinates.num_velocities
        rows = range(FRAME_ROWS)[tracked_rows(self.mission.scenario)]
        parts = {name: part for name, part in _PARTS.items() if part.start in rows}
        return {
            **own,
            **{
                name: Group(slice(first + part.start, first + part.stop), joints, 1.0 / len(parts))
                for name, part in parts.items()
            },
        }

    @property
    def controlled(self) -> np.ndarray:
        """Indices of the errors that the law controls."""
        every = np.arange(self.size)
        if not self.tracks_frame:
            return every
        return np.concatenate([every[group.errors] for group in self.groups.values()])

    def errors(self, times: np.ndarray, states: np.ndarray) -> np.ndarray:
        """Errors (n, size) of states that begin with q (n, ...) at times (n,), s."""
        q_d, _, _ = self.motion.evaluate(times)
        q = states[:, : q_d.shape[1]]
        found = position_errors(q_d, q)
        if not self.tracks_frame:
            return found
        path = make_frame_motion(self.mission, self._model, self.motion)
        frame = goal_frame(self.mission.scenario, self._model.plant)
        poses = frame_poses(self._model, q_d, frame) if path is None else path.rows(times)[:, _POSE]
        return np.hstack([found, position_errors(poses, frame_poses(self._model, q, frame))])

    def seen(self, loop: LinearLoop) -> LinearLoop:
        """A loop on the motion with the derivative of the pose of the frame, if one is tracked."""
        if not self.tracks_frame:
            return loop
        return dataclasses.replace(loop, frame_jacobian=self.frame_jacobian(loop.time))

    def frame_jacobian(self, time: float, *, free: bool = False) -> np.ndarray | None:
        """Derivative (6, nv) of the pose of the frame by the coordinates at a time, s; None: the
        law tracks no frame. ``free``: the undriven ones conserve momentum.
        """
        if not self.tracks_frame:
            return None
        model, scenario = self._model, self.mission.scenario
        q = self.motion.row(time)[: self.coordinates.num_positions]
        found = model.calc_jacobian(q, goal_frame(scenario, model.plant))
        if free and scenario.undriven:
            driven, moved = self.coordinates.driven, np.zeros_like(found)
            names = [self.coordinates.names[i] for i in driven]
            moved[:, driven] = free_floating(model, q, names).generalized_jacobian(found)
            return moved
        return found

    @functools.cached_property
    def _model(self) -> PlantModel:
        return self.mission.craft.true(self.grip)
