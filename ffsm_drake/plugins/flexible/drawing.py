"""Visual shapes of panels, moved to the hinged plates that replace them."""

import numpy as np
from pydrake.geometry import GeometryId, Role, SceneGraph, SceneGraphInspector
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody

from ffsm_drake.plugins.flexible.bodies import labels_of
from ffsm_drake.scenario import Flexible, Model
from ffsm_drake.spacecraft.boxes import box_corners

# Allowed excess of a shape beyond its panel, as fractions of width and length.
_ASIDE, _INWARDS, _OUTWARDS, _ABOVE = 0.25, 0.05, 0.25, 0.1
_LEAST = 0.5  # fraction of width and length that the shapes cover; below it they are fittings
_MOST_PLATES = 1.5  # longest shape, in plates; a longer one cannot bend


def draw_on_plates(plant: MultibodyPlant, scene_graph: SceneGraph, model: Model) -> None:
    """Move the visual shapes of panels from their carrying bodies to the plates.

    This concerns shapes within a panel's outline that together make up the panel. Each goes to the
    nearest plate; a plate with a shape is not drawn itself. If a shape is longer than a plate and a
    half, those within the outline are removed and the plates are drawn. Call it once, after
    ``Finalize`` and before a context is made.
    """
    inspector, source = scene_graph.model_inspector(), plant.get_source_id()
    for name, part in model.flexible.items():
        if part.kind != "panel":
            continue
        labels, length = labels_of(name, part), part.length / part.plates
        hinge = plant.GetFrameByName(f"{labels[0]}_place")
        X_BA = hinge.GetFixedPoseInBodyFrame()
        within = {
            geometry: extent
            for geometry in _drawn_of(plant, inspector, hinge.body())
            if (extent := _extent(inspector, geometry, X_BA)) is not None and _is_of(part, *extent)
        }
        if not _is_whole(part, list(within.values())):
            continue
        bends = all(high[1] - low[1] <= _MOST_PLATES * length for low, high in within.values())
        plates = [plant.GetBodyByName(label) for label in labels]
        own = [_drawn_of(plant, inspector, plate) for plate in plates]
        for geometry, (low, high) in within.items():
            if bends:
                index = int(np.clip(0.5 * (low[1] + high[1]) // length, 0, part.plates - 1))
                instance = inspector.CloneGeometryInstance(geometry)
                X_AP = RigidTransform([0.0, index * length, 0.0])
                instance.set_pose(X_AP.inverse() @ X_BA.inverse() @ instance.pose())
                scene_graph.RegisterGeometry(
                    source, plant.GetBodyFrameIdOrThrow(plates[index].index()), instance
                )
                while own[index]:
                    scene_graph.RemoveGeometry(source, own[index].pop())
            scene_graph.RemoveGeometry(source, geometry)


def _drawn_of(
    plant: MultibodyPlant, inspector: SceneGraphInspector, body: RigidBody
) -> list[GeometryId]:
    frame = plant.GetBodyFrameIdIfExists(body.index())
    return [] if frame is None else list(inspector.GetGeometries(frame, Role.kIllustration))


def _extent(
    inspector: SceneGraphInspector, geometry: GeometryId, X_BA: RigidTransform
) -> tuple[np.ndarray, np.ndarray] | None:
    """Smallest and largest coordinates (3 each) of a body's geometry in the panel's axes, m."""
    corners = box_corners(inspector, geometry)
    if corners is None:
        return None
    places = (X_BA.inverse() @ corners.T).T
    return places.min(axis=0), places.max(axis=0)


def _is_of(part: Flexible, low: np.ndarray, high: np.ndarray) -> bool:
    aside, above = (0.5 + _ASIDE) * part.width, _ABOVE * part.length
    least = np.array([-aside, -_INWARDS * part.length, -above])
    most = np.array([aside, (1.0 + _OUTWARDS) * part.length, above])
    return bool((least <= low).all() and (high <= most).all())


def _is_whole(part: Flexible, extents: list[tuple[np.ndarray, np.ndarray]]) -> bool:
    """True if shapes with these extents make up the panel."""
    if not extents:
        return False
    low, high = (
        np.min([low for low, _ in extents], axis=0),
        np.max([high for _, high in extents], axis=0),
    )
    return bool((high[:2] - low[:2] >= _LEAST * np.array([part.width, part.length])).all())
