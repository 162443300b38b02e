"""Boxes around shapes of a model."""

import itertools

import numpy as np
from pydrake.geometry import GeometryId, Obb, SceneGraphInspector


def box_around(inspector: SceneGraphInspector, geometry: GeometryId) -> Obb | None:
    """Return the box around a geometry, in its frame; None if it is unbounded or COLLADA."""
    try:
        return inspector.GetObbInGeometryFrame(geometry)
    except RuntimeError:
        return None


def box_corners(inspector: SceneGraphInspector, geometry: GeometryId) -> np.ndarray | None:
    """Return the corners (8, 3) of that box in the geometry's body, m."""
    box = box_around(inspector, geometry)
    if box is None:
        return None
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * box.half_width()
    return (inspector.GetPoseInFrame(geometry) @ box.pose() @ corners.T).T
