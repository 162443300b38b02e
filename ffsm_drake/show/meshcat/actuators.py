"""Thrusters and wheels on the base, and the plumes of firing thrusters."""

from collections.abc import Mapping

import numpy as np
from pydrake.geometry import Cylinder, Meshcat, MeshcatCone, Rgba
from pydrake.math import RigidTransform, RotationMatrix

from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import Scenario, Thruster, Wheels, own_thrusters

# Lengths as fractions of the base's longest edge.
_NOZZLE, _PLUME, _WHEEL = 0.05, 0.35, 0.06
_NOZZLE_COLOR, _PLUME_COLOR = Rgba(0.55, 0.57, 0.62, 1.0), Rgba(1.0, 0.93, 0.65, 0.65)
_WHEEL_COLOR = Rgba(0.55, 0.95, 0.75, 0.55)


def draw_actuators(meshcat: Meshcat, base: str, scenario: Scenario, *, longest: float) -> None:
    """Add the nozzles of thrusters and the discs of wheels of a scenario's own actuators.

    Args:
      base: path of the base in Meshcat's tree.
      scenario: whose they are.
      longest: the base's longest edge, m.
    """
    _draw_thrusters(meshcat, base, own_thrusters(scenario), longest=longest)
    if scenario.wheels is not None:
        _draw_wheels(meshcat, base, scenario.wheels, longest=longest)


def actuator_legend(scenario: Scenario, *, plumes: bool) -> list[str]:
    """What of it is to be seen, in words."""
    drawn = ["pale cones: open thrusters"] * plumes
    return drawn + ["discs in the base: reaction wheels"] * (scenario.wheels is not None)


def _draw_thrusters(
    meshcat: Meshcat, base: str, thrusters: Mapping[str, Thruster], *, longest: float
) -> None:
    """Nozzles, their mouths along the plumes, of lengths as the cube root of the force."""
    strongest = max((unit.force for unit in thrusters.values()), default=1.0)
    for name, unit in thrusters.items():
        # Drake's cone has its point at the origin and opens along +z.
        length = _NOZZLE * longest * (unit.force / strongest) ** (1.0 / 3.0)
        path, width = f"{base}/thrusters/{name}", 0.45 * length
        meshcat.SetObject(path, MeshcatCone(length, width, width), _NOZZLE_COLOR)
        meshcat.SetTransform(
            path, _along(-np.array(unit.direction, dtype=float), np.array(unit.position))
        )


def _draw_wheels(meshcat: Meshcat, base: str, wheels: Wheels, *, longest: float) -> None:
    """A disc for each wheel on its axis, seen through the base."""
    for name, unit in wheels.units.items():
        path, axis = f"{base}/wheels/{name}", np.array(unit.axis, dtype=float)
        center = 2.0 * _WHEEL * longest * axis / np.linalg.norm(axis)
        meshcat.SetObject(path, Cylinder(_WHEEL * longest, 0.25 * _WHEEL * longest), _WHEEL_COLOR)
        meshcat.SetTransform(path, _along(axis, center))
        meshcat.SetProperty(f"{path}/<object>", "material.depthTest", False)
        meshcat.SetProperty(f"{path}/<object>", "renderOrder", 1.0)  # after the spacecraft


class Plumes:
    """A plume at each nozzle, visible in frames during which its thruster is open."""

    def __init__(
        self,
        meshcat: Meshcat,
        base: str,
        thrusters: Mapping[str, Thruster],
        opened: np.ndarray,
        *,
        longest: float,
    ) -> None:
        """Args as for ``draw_actuators``, the thrusters by name, and the share of each sample for
        which each is open (samples, thrusters).
        """
        self._meshcat, self._open = meshcat, opened > 0.0
        self._paths = [f"{base}/plumes/{name}" for name in thrusters]
        # The plumes shown last; kept apart for a recording, which starts afresh.
        self._last: dict[bool, np.ndarray] = {}
        length = _PLUME * longest
        for path, unit in zip(self._paths, thrusters.values(), strict=True):
            meshcat.SetObject(path, MeshcatCone(length, 0.18 * length, 0.18 * length), _PLUME_COLOR)
            meshcat.SetTransform(
                path, _along(-np.array(unit.direction, dtype=float), np.array(unit.position))
            )

    @classmethod
    def of(
        cls, meshcat: Meshcat, base: str, record: RunRecord, *, longest: float
    ) -> "Plumes | None":
        """Those of a run; None where nothing fires. Arguments as for ``draw_actuators``."""
        units = own_thrusters(record.scenario)
        if not units or "thruster_open" not in record.dataset:
            return None
        return cls(meshcat, base, units, record.dataset["thruster_open"].values, longest=longest)

    def show(self, first: int, count: int, *, time_in_recording: float | None = None) -> None:
        """Show the plumes open in any of ``count`` samples from ``first`` on; send only changes."""
        now = np.atleast_1d(self._open[first : first + count].any(axis=0))
        last = self._last.get(time_in_recording is not None, ~now)
        for i in np.flatnonzero(now != last):
            self._meshcat.SetProperty(self._paths[i], "visible", bool(now[i]), time_in_recording)
        self._last[time_in_recording is not None] = now


def _along(direction: np.ndarray, origin: np.ndarray) -> RigidTransform:
    """The pose in which +z points along a vector."""
    return RigidTransform(RotationMatrix.MakeFromOneVector(direction, 2), origin)
