"""The start of a plan, and its end: a posture, the pose of a frame, or rest anywhere."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator

import numpy as np
from scipy.interpolate import BPoly

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.so3 import rotation_error
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.planning.frame_end import END, FrameEnd
from ffsm_drake.plugins.planning.motion_limits import Margin
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.reference import make_motion, prescribes_frame

# Keys of ``reference.frame`` that are for a polynomial, and their values without effect.
_OF_POLYNOMIAL = {"hold": [], "joints": "least"}


class Ends:
    """Both ends of z, of what is planned."""

    def __init__(
        self, mission: Mission, begun: Mission, start: np.ndarray, rate: np.ndarray,
        planned: np.ndarray,
    ) -> None:  # fmt: skip
        """Args:
          mission: the mission.
          begun: the mission from the beginning of the plan on.
          start, rate: q (nq) and v (nv) there.
          planned: indices in v of what is planned.

        Raises ScenarioError: a key of the frame has no effect on a plan.
        """
        scenario, coordinates = mission.scenario, mission.craft.coordinates
        self._mission, self._coordinates, self._planned = begun, coordinates, planned
        self.start, self.rate = np.r_[np.zeros(3), start[4:]][planned], rate[planned]
        # the posture at the end; None: there is none, or its joints are free
        self.posture: np.ndarray | None = None
        self.goal = np.full(planned.size, np.nan)  # z at the end; NaN: free
        self.frame: FrameEnd | None = None
        self._end_rate = scenario.planning.end_rate
        if frame := scenario.reference.frame:
            for name, value in _OF_POLYNOMIAL.items():
                if getattr(frame, name) != value:
                    problem = "has no effect on a plan, which chooses the motion of the joints"
                    raise ScenarioError(f"reference.frame.{name}", f"{problem}; remove it")
        if scenario.reference.goal == "stop":
            return
        self.posture = configuration(coordinates, scenario.target_posture, key="target_posture")
        z = np.r_[rotation_error(self.posture[:4], start[:4]), self.posture[4:]]
        if prescribes_frame(scenario):
            self.frame, self.posture = (
                FrameEnd(mission, start, rate, planned, scenario.reference.duration or 1.0),
                None,
            )
            z[NUM_BASE_VELOCITIES:] = np.nan
        self.goal = z[planned]

    def polynomial(self, duration: float) -> Callable[[np.ndarray], np.ndarray]:
        """z (n, size) by the shares (n,) of a duration, s, along a fifth-order polynomial."""
        first, last = self.rate * duration, self.goal
        if self.frame is not None:
            last = np.where(np.isnan(last), self._reached, last)
        elif self.posture is None:
            last = self.start + 0.5 * first
        ends = [self.start, first, 0.0 * first], [last, 0.0 * first, 0.0 * first]
        found: Callable[[np.ndarray], np.ndarray] = BPoly.from_derivatives([0.0, 1.0], ends)
        return found

    @functools.cached_property
    def _reached(self) -> np.ndarray:
        """z where the joints follow the frame on the path of a polynomial, or, if they cannot, of
        ``target_posture``.
        """
        own = dataclasses.replace(
            self._mission.scenario.reference, kind="quintic", plan=None, shaper=None
        )
        mission = self._mission.flown_by(reference=own)
        q = configuration(self._coordinates, mission.scenario.target_posture, key="target_posture")
        with contextlib.suppress(ScenarioError):
            motion = make_motion(mission)
            q = motion.rows(np.array([motion.end]))[0, : q.size]
        z: np.ndarray = np.r_[np.zeros(3), q[4:]][self._planned]
        return z

    def margins(self, time: float, q: np.ndarray, v: np.ndarray) -> Iterator[Margin]:
        """Margins of the end, at a time, s, with q (nq) and v (nv).

        They are margins of the distance of the frame, and of the rates if they need not be zero.
        """
        if self.frame is not None:
            off = np.linalg.norm(self.frame.off(q).reshape(2, 3), axis=1)
            for what, unit, row, size in zip(
                ("attitude", "position"), ("rad", "m"), (0, 3), off.tolist(), strict=True
            ):
                if row in range(6)[self.frame.rows]:
                    yield Margin(
                        quantity=f"end {what}", name=self.frame.frame.scoped_name().get_full(),
                        value=size, limit=END, time=time, unit=unit,
                    )  # fmt: skip
        if self._end_rate > 0.0:
            driven = self._coordinates.driven
            k = int(np.argmax(np.abs(v[driven])))
            yield Margin(
                quantity="end rate", name=self._coordinates.names[driven[k]],
                value=float(v[driven[k]]), limit=self._end_rate, time=time,
                unit=f"{self._coordinates.units[driven[k]]}/s",
            )  # fmt: skip
