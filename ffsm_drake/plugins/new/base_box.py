"""The box of a base, for the places of thrusters and panels, and the parts that overlap them."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from pydrake.geometry import Role
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder

from ffsm_drake.scenario import Model
from ffsm_drake.spacecraft.clearance import INVENTED
from ffsm_drake.spacecraft.plant import add_combined_plant, find_body

_SLAB = 0.5  # volume of a shape that belongs to the box, as a share of the largest shape's
_NEAR = 0.02  # m; a point nearer to a shape overlaps it


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Shape:
    """A shape of the base, replaced with the box around it."""

    body: str
    place: RigidTransform  # its centre and axes, in a frame of the base
    half: np.ndarray  # (3) half its sides, m
    is_drawn: bool  # in the user's model

    @property
    def span(self) -> np.ndarray:
        """Half the sides (3), m, of the box around it along the axes of the frame."""
        return np.abs(self.place.rotation().matrix()) @ self.half


@dataclasses.dataclass(frozen=True, kw_only=True)
class BaseBox:
    """The box around the largest shape of a base and around large shapes centred in it.

    Its axes are the axes of one of the bodies of the base. Lengths are in m.
    """

    centre: np.ndarray  # (3)
    half: np.ndarray  # (3) half its sides
    others: tuple[_Shape, ...]  # shapes outside the box

    @classmethod
    def of(cls, model: Model, links: Sequence[str], body: str, *, side: float) -> "BaseBox":
        """Find the box of a base.

        Args:
          model: model whose base is drawn, or is replaced with the box of its inertia.
          links: names of the bodies of the base.
          body: body whose frame the box has.
          side: half the side (m) of a cube about the origin, for a base without visuals.
        """
        shapes = _shapes(model, links, body)
        if not shapes:
            return cls(centre=np.zeros(3), half=np.full(3, side), others=())
        volumes = [float(np.prod(each.half)) for each in shapes]
        largest = shapes[int(np.argmax(volumes))]
        middle, span = largest.place.translation(), largest.span
        own = [
            each
            for each, volume in zip(shapes, volumes, strict=True)
            if volume >= _SLAB * max(volumes)
            and (np.abs(each.place.translation() - middle) < span).all()
        ]
        low = np.min([each.place.translation() - each.span for each in own], axis=0)
        high = np.max([each.place.translation() + each.span for each in own], axis=0)
        others = tuple(
            each for each in shapes if each.is_drawn and not any(each is mine for mine in own)
        )
        return cls(centre=0.5 * (low + high), half=0.5 * (high - low), others=others)

    def overlapped(self, points: np.ndarray) -> list[str]:
        """Return the bodies, outside the box, whose shapes contain one of the points (n, 3)."""
        found = set[str]()
        for each in self.others:
            local = np.abs(each.place.inverse().multiply(points.T).T)
            if (local < each.half + _NEAR).all(axis=1).any():
                found.add(each.body)
        return sorted(found)


def _shapes(model: Model, links: Sequence[str], body: str) -> list[_Shape]:
    """Return the drawn shapes of the links of a base."""
    builder = DiagramBuilder()
    plant = add_combined_plant(builder, model)
    inspector = builder.GetSubsystemByName("scene_graph").model_inspector()
    context = plant.CreateDefaultContext()
    here, *bodies = (
        find_body(plant, f"servicer::{name}", key="model.servicer") for name in (body, *links)
    )
    found = list[_Shape]()
    for each in bodies:
        pose = each.body_frame().CalcPose(context, here.body_frame())
        for shape in inspector.GetGeometries(
            plant.GetBodyFrameIdOrThrow(each.index()), Role.kIllustration
        ):
            if (box := inspector.GetObbInGeometryFrame(shape)) is not None:
                place = pose @ inspector.GetPoseInFrame(shape) @ box.pose()
                label = inspector.GetName(shape).rpartition("::")[2]
                found.append(
                    _Shape(
                        body=each.name(),
                        place=place,
                        half=np.array(box.half_width()),
                        is_drawn=not label.startswith(INVENTED),
                    )
                )
    return found
