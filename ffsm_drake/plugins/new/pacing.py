"""The disturbance of a new scenario, and durations that leave its actuators a reserve.

A motion uses at most a part of the force of the actuators.
"""

import math

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.steps import step
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.design.rounding import rounded
from ffsm_drake.plugins.design.stability.planned_dynamics import PlannedDynamics
from ffsm_drake.plugins.new.draft import Draft
from ffsm_drake.plugins.new.hardware import MOTION, Hardware
from ffsm_drake.spacecraft.coordinates import BASE_POSITION, BASE_ROTATION, NUM_BASE_VELOCITIES

SECONDS = 5.0  # durations are multiples of these
_JOINT, _DISTURBED = 0.3, 0.3  # shares of what the actuators give
LEAST_LEFT = 0.05  # share of the force, if the disturbance uses the rest
_LONGEST, _SETTLE, INSTANTS = 120.0, 1.0, 60  # s; s after a grasp that do not count
# The disturbance accelerates each coordinate, the others free to react, by this much: rad/s^2 or
# m/s^2; its frequencies, rad/s, are taken in turn.
_DISTURBANCE = {"base_rotation": 1.5e-3, "base_position": 8e-4, "rad": 5e-3, "m": 1e-3}
_FREQUENCIES = (0.3, 0.1, 0.5, 1.0, 0.6, 0.8)


class Pacing:
    """The disturbance and the durations of a draft."""

    def __init__(self, draft: Draft, hardware: Hardware) -> None:
        self._data, self._asked, self._coordinates = draft.data, draft.asked, draft.coordinates
        self._draft, self._hardware = draft, hardware

    def disturb(self) -> None:
        """Choose a harmonic disturbance for each driven coordinate.

        Its amplitude is proportional to the effective inertia of the coordinate in the target
        posture, and leaves most of the actuator force to the motion. With two hands, the
        coordinates of a group have the smallest of their amplitudes.
        """
        planned, harmonics = self._draft.planned(capture=None), dict[str, dict[str, float]]()
        inertia = effective_inertia(planned.mass_matrices(planned.motion.end)[0])
        limit = np.full(inertia.size, np.inf) if self._hardware.sizes_wheels else self._draft.limit
        coordinates, out_of_plane = self._coordinates, set[str]()
        if (normal := self._draft.servicer.normal) is not None:
            out_of_plane = {*BASE_ROTATION} - {BASE_ROTATION[normal]} | {BASE_POSITION[normal]}
        for k, (name, group) in enumerate(
            zip(coordinates.names, coordinates.group_of, strict=True)
        ):
            if self._asked.drives(group) and name not in out_of_plane:
                size = _DISTURBANCE[coordinates.units[k] if group == "joints" else group]
                harmonics[name] = {
                    "amplitude": rounded(min(size * inertia[k], _DISTURBED * limit[k])),
                    "frequency": _FREQUENCIES[k % len(_FREQUENCIES)],
                    "phase": 1.571 if k % 3 == 1 else 0.0,
                }
        if self._asked.tips is not None:
            harmonics = {
                group: min((harmonics[name] for name in names), key=lambda each: each["amplitude"])
                for group, part in coordinates.groups.items()
                if (names := [name for name in coordinates.names[part] if name in harmonics])
            }
        self._data["disturbance"]["harmonics"] = harmonics

    def lengthen(self) -> bool:
        """Size the wheels, and lengthen motion and approach until the actuators can follow them.

        Returns: whether a duration was increased.
        """
        reference, longer = self._data["reference"], math.inf
        before = kept = reference["duration"]
        while longer > reference["duration"]:
            if longer < math.inf:
                kept, reference["duration"] = reference["duration"], longer
            try:
                with step(f"trying a motion of {reference['duration']:g} s"):
                    self._draft.peaks = self._motion_peaks() + self._draft.disturbance
            except ScenarioError:
                if longer == math.inf:
                    raise
                reference["duration"] = kept  # in a longer motion, two hands lose their reach
                break
            self._hardware.size_wheels()
            longer = self._longer(
                reference["duration"], self._draft.peaks - self._draft.disturbance
            )
        is_longer = bool(reference["duration"] > before)
        if not self._asked.has_approach:
            return is_longer
        approach = self._data["capture"]["approach"]
        before = approach["duration"]
        approach["duration"] = self._longer(before, self._approach_peaks())
        try:
            self._approach_peaks()
        except ScenarioError:
            approach["duration"] = before  # a longer approach meets a face of the target
        return is_longer or bool(approach["duration"] > before)

    def overloads(self) -> bool:
        """Whether motion or approach are too short for the actuators."""
        timed = [(self._data["reference"]["duration"], self._motion_peaks())]
        if self._asked.has_approach:
            timed.append((self._data["capture"]["approach"]["duration"], self._approach_peaks()))
        return any(self._longer(*each) > each[0] for each in timed)

    def _motion_peaks(self) -> np.ndarray:
        """Return the largest forces (nv) of the motion, N m or N, except just after a grasp."""
        planned = self._draft.planned()
        first = 0.0 if self._asked.capture is None else min(_SETTLE, 0.1 * planned.motion.end)
        return peaks_of(planned, first)

    def _approach_peaks(self) -> np.ndarray:
        """Return the largest forces (nv) of the approach, N m or N, as if the target were held."""
        whole = PlannedDynamics(Mission(self._draft.with_sections(disturbance={})))
        return peaks_of(whole, 0.0, self._data["capture"]["approach"]["duration"])

    def _longer(self, duration: float, peaks: np.ndarray) -> float:
        """Return the duration, a multiple of 5 s, with which a motion leaves the actuators their
        reserve.

        Args:
          duration: s, the present duration.
          peaks: largest forces (nv) with the present duration, N m or N.
        """
        limit, base = self._draft.limit, np.arange(peaks.size) < NUM_BASE_VELOCITIES
        share = np.where(base, MOTION, _JOINT)
        left = np.maximum(share * limit - self._draft.disturbance, LEAST_LEFT * limit)
        driven = np.array([self._asked.drives(group) for group in self._coordinates.group_of])
        ratio = math.sqrt(float((driven * peaks / left).max()))
        whole = math.ceil(max(ratio, 1.0) * duration / SECONDS - 1e-9)
        return min(SECONDS * whole, _LONGEST)


def effective_inertia(mass_matrix: np.ndarray) -> np.ndarray:
    """Return force divided by acceleration of each coordinate (..., nv), the others free."""
    return 1.0 / np.diagonal(np.linalg.inv(mass_matrix), axis1=-2, axis2=-1)


def peaks_of(planned: PlannedDynamics, begin: float = 0.0, end: float | None = None) -> np.ndarray:
    """Return the largest forces (nv) of perfect tracking between two times, s."""
    times = np.linspace(begin, planned.motion.end if end is None else end, INSTANTS)
    return np.abs(planned.perfect_tracking(times)[1]).max(axis=0)
