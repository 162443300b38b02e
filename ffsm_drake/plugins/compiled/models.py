"""Models of a spacecraft on symbols, and in many configurations, for laws."""

import dataclasses

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.plugins.compiled.parameters import UNKNOWN, reader_of
from ffsm_drake.plugins.equations import frames
from ffsm_drake.plugins.equations.frames import quaternion_of
from ffsm_drake.plugins.equations.models import TracedModel
from ffsm_drake.spacecraft.free_floating import ReducedModel
from ffsm_drake.spacecraft.nominal import PlantModel


class PosedModel(PlantModel):
    """A model that computes a frame's poses in many configurations at once."""

    def calc_frame_pose(
        self, q: np.ndarray, frame: Frame | str, seen_from: Frame | None = None
    ) -> np.ndarray:
        """See PlantModel."""
        if q.ndim == 1 or isinstance(frame, str):
            return super().calc_frame_pose(q, frame, seen_from)
        reader = reader_of(self)
        own = reader.parameters(self.context)
        place = reader.tree.place_in(reader.place_of(frame), own)
        rotation, origin = frames.pose(reader.tree.placed(own), place, q)
        quaternion = np.stack(quaternion_of(np.moveaxis(rotation, (-2, -1), (0, 1))), axis=-1)
        return np.concatenate([quaternion, origin], axis=-1)


def traced_model(model: PlantModel, own: np.ndarray) -> TracedModel:
    """Return a model with symbols as its parameters."""
    kind = TracedModel.reduced if isinstance(model, ReducedModel) else TracedModel
    return kind(
        plant=UNKNOWN, context=UNKNOWN, coordinates=model.coordinates, split=model.split,
        own=own, tree=reader_of(model).tree.placed(own),
    )  # fmt: skip


def posed_model(made: PlantModel) -> PosedModel:
    """Return a model for many configurations at once."""
    return PosedModel(**{each.name: getattr(made, each.name) for each in dataclasses.fields(made)})
