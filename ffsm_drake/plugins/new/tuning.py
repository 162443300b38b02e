"""Gains of a new scenario.

The bandwidth is limited by sensor noise, which may use what the motion leaves of the force of the
actuators. If the mission does not settle, the bandwidth is reduced.
"""

import math
from typing import Any

import numpy as np

from ffsm_drake.common.steps import step
from ffsm_drake.plugins.design.rounding import rounded_by_group
from ffsm_drake.plugins.design.stability import stability
from ffsm_drake.plugins.design.stability.mission import linear_verdict
from ffsm_drake.plugins.new.draft import Draft
from ffsm_drake.plugins.new.pacing import LEAST_LEFT, effective_inertia
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import EMPTY
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES
from ffsm_drake.systems.registry import CORE_LAWS, find_factory

BY_AXIS = ("tdc", "asmc", "aismc", "tde_aismc")
# Natural frequencies to start from, rad/s, and what shrinks them.
_OMEGA = {"base_rotation": 15.0, "base_position": 10.0, "joints": 20.0}
_SHRINK, _TRIES = 0.7, 8
_NOISES = 3.0  # standard deviations of the noise, times I omega^2, that the actuators give
_K_S, _SWITCHING = 0.1, 2e-4  # K_s as a share of omega; bound of G


class Tuning:
    """The gains of a draft."""

    def __init__(self, draft: Draft) -> None:
        self._data, self._asked, self._coordinates = draft.data, draft.asked, draft.coordinates
        self._draft = draft

    def tune(self) -> None:
        """Choose natural frequencies and gains.

        The frequencies start at the values of the sensors' scenario, or lower if noise would exceed
        the reserve of the actuators. They are equal within a group, and shrink until the mission
        settles.
        """
        coordinates, source = self._coordinates, self._asked.source
        planned, limit = self._draft.planned(), self._draft.limit
        times = map(planned.motion.part, np.linspace(0.0, 1.0, 9))
        matrices = np.array([planned.mass_matrices(time)[0] for time in times])
        usual: Any = _OMEGA
        if source.estimator.kind != "one_sample":
            stiffness: Any = source.controllers["tdc"]["k_p"]
            usual = {group: math.sqrt(k) for group, k in stiffness.items()}
        omega = coordinates.vector(usual, key="omega")
        deviation = self._draft.scenario.sensing.position_noise
        noise = coordinates.vector(deviation, key="noise", default=0.0)
        left = np.maximum(limit - self._draft.peaks, LEAST_LEFT * limit)
        with np.errstate(divide="ignore"):
            most = np.sqrt(left / effective_inertia(matrices).max(axis=0) / noise / _NOISES)
        for part in coordinates.groups.values():
            omega[part] = np.minimum(omega[part], most[part].min(initial=np.inf))
        alone = [] if self._asked.capture is None else list(self._draft.at_postures(EMPTY))
        for k in range(_TRIES):
            with step(f"bandwidth {k + 1} of at most {_TRIES}"):
                self._put_gains(omega, np.array([*matrices, *alone]))
                fast = self._too_fast()
            if not fast:
                return
            omega[:fast] *= _SHRINK
        found = "no bandwidth tried is stable and settles"
        if not self._asked.is_paper and make_rollout(self._draft.scenario).run().ending.is_settled:
            found = "the linear loop is unstable at each bandwidth tried, yet the mission settles"
        self._draft.remarks.append(f"{found}; see 'ffsm stability'")

    def _put_gains(self, omega: np.ndarray, matrices: np.ndarray) -> None:
        """Set the gains of every law of the package.

        With real sensors, laws that are not designed by axis have half the frequencies, because
        they may be stiffer.

        Args:
          omega: natural frequencies (nv), rad/s.
          matrices: mass matrices (m, nv, nv) along the motion.
        """
        found = self._data["controllers"]
        for name in CORE_LAWS if self._asked.tips is None else (self._data["controller"],):
            law: Any = find_factory("controller", name)
            if self._asked.is_paper:
                gains = law.starting_gains(omega, matrices)
            elif name in BY_AXIS:
                gains = law.gains_for(omega, _K_S * omega)
                if "g_max" in law.__dataclass_fields__:
                    gains |= {"g_initial": _SWITCHING, "g_max": _SWITCHING}
            else:
                gains = law.starting_gains(0.5 * omega, matrices)
            if gains:
                found[name] = {
                    key: value
                    if np.ndim(value) == 0
                    else rounded_by_group(value, self._coordinates)
                    for key, value in gains.items()
                }

    def _too_fast(self) -> int:
        """Return how many coordinates, from the first one, have too large a bandwidth: none, the
        six of the base, or all.
        """
        if self._asked.is_paper:
            for name in BY_AXIS:
                with step(f"checking the stability of {name}"):
                    scenario = self._draft.with_sections(controller=name)
                    self._draft.margins[name] = stability(scenario, postures=9)
            stable = all(
                each.verdict == "stable for small errors" for each in self._draft.margins.values()
            )
            return 0 if stable else self._draft.peaks.size
        if linear_verdict(self._draft.scenario).is_alarm:
            return self._draft.peaks.size
        return (
            0 if make_rollout(self._draft.scenario).run().ending.is_settled else NUM_BASE_VELOCITIES
        )
