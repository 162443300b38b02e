"""A model of a spacecraft on symbols."""

import dataclasses
from typing import ClassVar

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.plugins.equations import equations, frames
from ffsm_drake.plugins.equations.errors import tracking_errors
from ffsm_drake.plugins.equations.frames import quaternion_of
from ffsm_drake.plugins.equations.tree import Place, Tree
from ffsm_drake.plugins.tape.arrays import traced
from ffsm_drake.plugins.tape.numbers import NotTraceable
from ffsm_drake.spacecraft.free_floating import ReducedModel
from ffsm_drake.spacecraft.nominal import PlantModel


@dataclasses.dataclass(frozen=True, kw_only=True)
class TracedModel(PlantModel):
    """A nominal model on symbols: its equations, tracking errors, and frames at a ``Place``."""

    reduced: ClassVar[type]  # of an underactuated plant, see ``driven_model``
    own: np.ndarray  # the parameters of the tree
    tree: Tree

    def calc_mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """See PlantModel."""
        return traced(equations.mass_matrix(self.tree, q, self.own))

    def calc_bias(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """See PlantModel."""
        return traced(equations.bias(self.tree, q, v, self.own))

    def calc_tracking_errors(
        self, desired: np.ndarray, actual: np.ndarray, num_positions: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """See PlantModel."""
        return tracking_errors(desired, actual, num_positions)

    def calc_acceleration(self, q: np.ndarray, v: np.ndarray, force: np.ndarray) -> np.ndarray:
        """See PlantModel."""
        return traced(equations.derivative(self.tree, q, v, force, self.own)[len(q) :])

    def calc_jacobian(
        self, q: np.ndarray, frame: Frame | str, seen_from: Frame | None = None
    ) -> np.ndarray:
        """See PlantModel."""
        if seen_from is not None:
            return frames.relative_jacobian(
                self.tree, self._known(frame), self._known(seen_from), q
            )
        return frames.jacobian(self.tree, self._known(frame), q)

    def calc_bias_acceleration(
        self, q: np.ndarray, v: np.ndarray, frame: Frame | str, seen_from: Frame | None = None
    ) -> np.ndarray:
        """See PlantModel."""
        if seen_from is not None:
            return frames.relative_bias(self.tree, self._known(frame), self._known(seen_from), q, v)
        return frames.bias_acceleration(self.tree, self._known(frame), q, v)

    def calc_frame_pose(
        self, q: np.ndarray, frame: Frame | str, seen_from: Frame | None = None
    ) -> np.ndarray:
        """See PlantModel."""
        rotation, origin = frames.pose(self.tree, self._known(frame), q)
        if seen_from is not None:
            own, from_there = frames.pose(self.tree, self._known(seen_from), q)
            rotation, origin = own.T @ rotation, own.T @ (origin - from_there)
        return traced([*quaternion_of(rotation), *origin])

    def calc_frame_rotation(self, q: np.ndarray, frame: Frame | str) -> np.ndarray:
        """See PlantModel."""
        return frames.pose(self.tree, self._known(frame), q)[0]

    def calc_frame_twist(self, q: np.ndarray, v: np.ndarray, frame: Frame | str) -> np.ndarray:
        """See PlantModel."""
        return frames.twist(self.tree, self._known(frame), q, v)

    def calc_point_jacobian(
        self, q: np.ndarray, frame: Frame | str, point: np.ndarray
    ) -> np.ndarray:
        """See PlantModel."""
        return frames.point_jacobian(self.tree, self._known(frame), q, point)

    def _set_state(self, q: np.ndarray, v: np.ndarray | None = None) -> None:
        raise NotTraceable("the law asks its model for more than its equations and frames")

    def _known(self, frame: Frame | str) -> Place:
        if not isinstance(frame, Place):
            raise NotTraceable("the law takes a frame by its name; keep the frame in a field")
        return self.tree.place_in(frame, self.own)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _TracedReduced(ReducedModel, TracedModel):
    """As TracedModel, of an underactuated plant."""


TracedModel.reduced = _TracedReduced
