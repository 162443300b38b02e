"""What counts of a run: the errors of what its controller tracks, and the pose error of a frame."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ffsm_drake.runs.table import driven_of
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import BASE_POSITION, BASE_ROTATION, position_errors
from ffsm_drake.spacecraft.free_floating import TASK_ROWS
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.frame_path import goal_frame

if TYPE_CHECKING:
    from ffsm_drake.runs.table import Labelled

# Rotation vector from R_WF to its reference, then the position's difference; world axes.
FRAME_COORDINATES = tuple(
    name.replace("base", "frame") for name in (*BASE_ROTATION, *BASE_POSITION)
)
FRAME_UNITS = ("rad", "rad", "rad", "m", "m", "m")
_FRAME_GROUPS = ("base_rotation",) * 3 + ("base_position",) * 3  # whose tolerance holds for a frame


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Tracked:
    """The errors (n, k) that count, rad and m; of each its name, the group whose tolerance it has,
    and its unit.
    """

    error: np.ndarray
    names: tuple[str, ...]
    groups: tuple[str, ...]
    units: tuple[str, ...]


def frame_rows(scenario: Scenario) -> np.ndarray:
    """Which of FRAME_COORDINATES (6) are prescribed; of a frame that follows the plan of the
    coordinates, all.
    """
    goal, rows = scenario.reference.frame, np.zeros(6, dtype=bool)
    rows[TASK_ROWS["pose" if goal is None or goal.task == "none" else goal.task]] = True
    return rows


def frame_error(
    scenario: Scenario,
    model: PlantModel,
    q: np.ndarray,
    *,
    q_d: np.ndarray,
    desired: np.ndarray | None,
) -> np.ndarray:
    """The pose error (n, 6) of the scenario's frame, of FRAME_COORDINATES; NaN where q is not
    finite.

    Args:
      scenario: whose frame it is.
      model: the true plant, flexible parts included.
      q: its configurations (n, nq).
      q_d: planned ones (n, nq), by which the frame is judged where there is nothing else.
      desired: rows of FramePath (n, 19); None: no path is prescribed.
    """
    frame = goal_frame(scenario, model.plant)

    def poses(positions: np.ndarray) -> np.ndarray:
        result = np.full((len(positions), 7), np.nan)
        finite = np.isfinite(positions).all(axis=1)
        if finite.any():
            result[finite] = model.calc_frame_pose(positions[finite], frame)
        return result

    return position_errors(poses(q_d) if desired is None else desired[:, :7], poses(q))


def tracked(
    *,
    error: np.ndarray,
    names: tuple[str, ...],
    groups: tuple[str, ...],
    units: tuple[str, ...],
    driven: np.ndarray,
    frame: np.ndarray | None,
    rows: np.ndarray,
) -> Tracked:
    """What counts: the driven coordinates; where a frame is tracked, in the place of the joints,
    the frame.

    Args:
      error: e of all coordinates (n, nv).
      names, groups, units: of each.
      driven: which are driven (nv).
      frame: the frame's pose error (n, 6); None: there is none.
      rows: which of its entries the controller is after (6); none where it tracks coordinates.
    """
    counted = driven.copy()
    if frame is None or not rows.any():
        rows, frame = np.zeros(6, dtype=bool), np.zeros((len(error), 6))
    else:
        counted &= np.array([group != "joints" for group in groups])

    def of(coordinates: tuple[str, ...], others: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(
            str(each) for each in (*np.array(coordinates)[counted], *np.array(others)[rows])
        )

    return Tracked(
        error=np.hstack([error[:, counted], frame[:, rows]]) if rows.any() else error[:, counted],
        names=of(names, FRAME_COORDINATES),
        groups=of(groups, _FRAME_GROUPS),
        units=of(units, FRAME_UNITS),
    )


def tracked_of(dataset: "Labelled") -> Tracked:
    """What counts of a recorded run."""
    has_frame = "frame_error" in dataset
    names, groups, units = (
        tuple(map(str, dataset[name].values)) for name in ("coordinate", "group", "unit")
    )
    return tracked(
        error=dataset["error"].values,
        names=names,
        groups=groups,
        units=units,
        driven=driven_of(dataset),
        frame=dataset["frame_error"].values if has_frame else None,
        rows=dataset["frame_tracked"].values.astype(bool) if has_frame else np.zeros(6, dtype=bool),
    )


def frame_metrics(error: np.ndarray, rows: np.ndarray) -> dict[str, dict[str, float]]:
    """``largest`` and ``final`` size of a frame's pose error (n, 6): ``rotation`` (angle, rad),
    ``position`` (m).

    Of what is prescribed, which ``rows`` (6) says.
    """
    parts = {"rotation": slice(0, 3), "position": slice(3, 6)}
    return largest_and_final(
        {name: error[:, part] for name, part in parts.items() if rows[part].any()}
    )


def largest_and_final(parts: Mapping[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """``largest`` and ``final`` norm of vectors (n, 3), by name."""
    sizes = {name: np.linalg.norm(part, axis=1) for name, part in parts.items()}
    return {
        "largest": {name: float(size.max()) for name, size in sizes.items()},
        "final": {name: float(size[-1]) for name, size in sizes.items()},
    }
