"""The first mission of a new servicer: its choices, one after the other."""

from typing import Any

import numpy as np

from ffsm_drake.common.steps import step
from ffsm_drake.plugins.new.approach import SHORTER, Approach
from ffsm_drake.plugins.new.asked import Asked
from ffsm_drake.plugins.new.draft import Draft
from ffsm_drake.plugins.new.hands import Hands
from ffsm_drake.plugins.new.hardware import Hardware
from ffsm_drake.plugins.new.pacing import Pacing, peaks_of
from ffsm_drake.plugins.new.tuning import Tuning
from ffsm_drake.plugins.new.urdf.servicer import Servicer
from ffsm_drake.plugins.new.urdf.target import Target

_ROUNDS = 3  # of durations, then postures


class FirstMission(Draft):
    """A draft, and the steps that complete it: ``place``, ``pace`` and ``fill``."""

    def __init__(
        self, data: dict[str, Any], asked: Asked, servicer: Servicer, source: str, *, seed: int = 0
    ) -> None:
        """See Draft."""
        super().__init__(data, asked, servicer, source, seed=seed)
        self._outside = ""  # the joints that leave their limits in every motion tried
        self._hardware = Hardware(self)
        self._pacing = Pacing(self, self._hardware)
        self._approach = Approach(self, self._pacing)

    @step("searching for postures without contact")
    def place(self, target: Target) -> None:
        """Choose thrusters, panels, postures, the approach, and the frame of a second hand."""
        self._hardware.place_thrusters()
        self._hardware.place_panels()
        if self.servicer.second is not None:
            self.is_held = Hands(self, target).place()
            return
        self._approach.choose_postures()
        if self.asked.has_approach:
            self._approach.choose(SHORTER[:1])

    @step("choosing wheels and durations")
    def pace(self) -> None:
        """Choose disturbance, durations and wheels, after ``place``."""
        self._pacing.disturb()
        moves = bool(self._approach.starts) and self.asked.capture is not None
        for _ in range(_ROUNDS):
            is_done = not self._pacing.lengthen() and self._approach.used(self.mission)[0] <= 1.0
            if is_done or not moves:
                break
            self._approach.choose(SHORTER)
        else:
            self._pacing.lengthen()
        used, told = self._approach.used(self.mission)
        self._outside = told if used > 1.0 else ""

    @property
    def faults(self) -> list[str]:
        """Faults of the plan that other postures may avoid."""
        return [*filter(None, (self.touching, self._outside))]

    @step("choosing gains")
    def fill(self) -> None:
        """Choose integrator steps for friction, then gains, after ``pace``."""
        self._hardware.resolve_friction()
        self.remarks += [*self.faults, *filter(None, (self._hardware.weak,))]
        Tuning(self).tune()

    def motion_forces(self) -> np.ndarray:
        """Return the largest forces (nv) of perfect tracking of the planned motion, N m or N."""
        return peaks_of(self.planned())
