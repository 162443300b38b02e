"""The scenario's own actuators as solids on the base: always visible, or while they act."""

from collections.abc import Iterable, Sequence

import numpy as np
from pydrake.geometry import Cylinder, Meshcat, MeshcatCone, Rgba
from pydrake.math import RigidTransform, RotationMatrix

from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.parts.solid import Solid
from ffsm_drake.systems.registry import section_parts


def solids_of(scenario: Scenario) -> list[Solid]:
    """Return the solids of a scenario's own actuators."""
    return [solid for part in section_parts(scenario).values() for solid in part.solids()]


def draw_over(meshcat: Meshcat, path: str) -> None:
    """Draw an object over everything else."""
    meshcat.SetProperty(f"{path}/<object>", "material.depthTest", False)
    meshcat.SetProperty(f"{path}/<object>", "renderOrder", 1.0)  # after the spacecraft


def draw_solids(meshcat: Meshcat, base: str, solids: Iterable[Solid], *, longest: float) -> None:
    """Add solids to the base.

    Args:
      meshcat: the server.
      base: path of the base in Meshcat's tree.
      solids: the solids to draw.
      longest: the base's longest edge, m.
    """
    for solid in solids:
        path, width = _path(base, solid), longest * solid.radius
        # Drake's cone has its point at the origin and opens along +z.
        shape = (
            MeshcatCone(longest * solid.length, width, width)
            if solid.shape == "cone"
            else Cylinder(width, longest * solid.length)
        )
        meshcat.SetObject(path, shape, Rgba(*solid.color))
        along = solid.axis / np.linalg.norm(solid.axis)
        rotation = RotationMatrix.MakeFromOneVector(along, 2)
        center = solid.position + longest * solid.offset * along
        meshcat.SetTransform(path, RigidTransform(rotation, center))
        if solid.through:
            draw_over(meshcat, path)


def _path(base: str, solid: Solid) -> str:
    return f"{base}/{solid.group}/{solid.name}"


class SwitchedSolids:
    """Solids visible in the frames with their signal above zero."""

    def __init__(
        self, meshcat: Meshcat, base: str, solids: Sequence[Solid], on: np.ndarray, *,
        longest: float,
    ) -> None:  # fmt: skip
        """Args: see ``draw_solids``; ``on`` (samples, solids): whether each is on."""
        self._meshcat, self._on = meshcat, on
        self._paths = [_path(base, solid) for solid in solids]
        # Last visible state; kept apart for a recording, which starts anew.
        self._last: dict[bool, np.ndarray] = {}
        self.legend = list(dict.fromkeys(solid.legend for solid in solids if solid.legend))
        draw_solids(meshcat, base, solids, longest=longest)

    @classmethod
    def of(
        cls, meshcat: Meshcat, base: str, record: RunRecord, *, longest: float
    ) -> "SwitchedSolids":
        """Return the solids of a run with recorded signals. Args: see ``draw_solids``."""
        data = record.dataset
        solids = [each for each in solids_of(record.scenario) if each.shown_by in data]
        columns = []
        for solid in solids:
            signal = data[solid.shown_by]
            names = signal[signal.dims[1]].values.astype(str).tolist()
            columns.append(signal.values[:, names.index(solid.name)] > 0.0)
        on = np.stack(columns, axis=1) if columns else np.zeros((0, 0), dtype=bool)
        return cls(meshcat, base, solids, on, longest=longest)

    def show(self, first: int, count: int, *, time_in_recording: float | None = None) -> None:
        """Show those on in any of ``count`` samples from ``first`` on; send only changes."""
        now = np.atleast_1d(self._on[first : first + count].any(axis=0))
        last = self._last.get(time_in_recording is not None, ~now)
        for i in np.flatnonzero(now != last):
            self._meshcat.SetProperty(self._paths[i], "visible", bool(now[i]), time_in_recording)
        self._last[time_in_recording is not None] = now
