"""Drift of an undriven base: its outline at the start, and the path of a frame."""

import itertools

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Meshcat, Rgba
from pydrake.math import RigidTransform

from ffsm_drake.plugins.meshcat.solids import draw_over
from ffsm_drake.plugins.meshcat.stage import SpacecraftView, base_bounding_box
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS
from ffsm_drake.systems.frame_path import goal_frame

_START_COLOR, _FRAME_COLOR = Rgba(1.0, 0.35, 0.3, 1.0), Rgba(0.35, 0.95, 0.45, 1.0)
START_LEGEND = "red outline: the base at the start; red line: the path of its origin"


def draw_drift(meshcat: Meshcat, spacecraft: SpacecraftView, positions: np.ndarray) -> None:
    """Draw the box around the base at the start, and the base's path through positions (n, nq)."""
    X_BG, half_width = base_bounding_box(spacecraft.plant, spacecraft.scene_graph.model_inspector())
    first = positions[0, :NUM_BASE_POSITIONS]
    X_WG = RigidTransform(Quaternion(first[:4] / np.linalg.norm(first[:4])), first[4:]) @ X_BG
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    corners = X_WG @ (signs * half_width).T
    edges = [
        (i, j)
        for i, j in itertools.combinations(range(8), 2)
        if np.abs(signs[i] - signs[j]).sum() == 2.0
    ]
    start, end = (np.asfortranarray(corners[:, [edge[side] for edge in edges]]) for side in (0, 1))
    meshcat.SetLineSegments("drift/start", start, end, 3.0, _START_COLOR)
    meshcat.SetLine(
        "drift/path", np.asfortranarray(positions[:, 4:NUM_BASE_POSITIONS].T), 4.0, _START_COLOR
    )
    for path in ("drift/start", "drift/path"):  # else the base would hide them
        draw_over(meshcat, path)


def draw_frame_path(
    meshcat: Meshcat, spacecraft: SpacecraftView, scenario: Scenario, positions: np.ndarray
) -> str:
    """Draw the prescribed frame's path through configurations (n, nq); returns its legend."""
    frame = goal_frame(scenario, spacecraft.plant)
    path = np.empty((3, len(positions)), order="F")
    for i, q in enumerate(positions):
        spacecraft.show(q)
        path[:, i] = spacecraft.position_of(frame, np.zeros(3))
    meshcat.SetLine("frame_path", path, 4.0, _FRAME_COLOR)
    return f"green line: the path of {frame.scoped_name().get_full()}"
