"""A planned motion whose closing arms close the loops at every instant."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.two_arms.chain import ClosedChain
from ffsm_drake.plugins.two_arms.following import SINGULAR
from ffsm_drake.plugins.two_arms.loads import Loads
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.planned_motion import PlannedMotion

_CHECKED = 201  # instants at which a given motion is checked


class ClosedMotion(PlannedMotion):
    """A given motion, with the joints of the closing arms that its others move.

    A motion whose loops are nearly closed begins the inverse kinematics of each instant. Its rates
    and accelerations follow from A v = 0.
    """

    def __init__(self, motion: PlannedMotion, mission: Mission, nominal: PlantModel) -> None:
        """Args: the motion; its mission; the plant with the nominal payload, in the hands."""
        super().__init__(
            coordinates=motion.coordinates,
            sample_time=mission.scenario.sample_time,
            begin=motion.begin,
            end=motion.end,
        )
        self._motion, self.path = motion, motion.path
        self._loads = Loads(mission.scenario, nominal, {0.0: 0.0})
        self._chain = chain = ClosedChain(nominal, mission.scenario, true=False)
        followers = chain.followers(motion.evaluate(0.0)[0])
        self._following = np.concatenate(followers)
        self._loops = [
            dataclasses.replace(loop, joints=joints)
            for loop, joints in zip(chain.loops, followers, strict=True)
        ]
        self._check()

    def _check(self) -> None:
        """Raise ScenarioError where the followers are near a singularity, or do not reach."""
        for time in np.linspace(self.begin, self.end, _CHECKED):
            jacobian = self._chain.jacobian(self.evaluate(time)[0])[:, self._following]
            found = np.linalg.svd(jacobian, compute_uv=False)[-1]
            if found < SINGULAR:
                raise ScenarioError(
                    "contacts",
                    f"the closing arm is singular at t = {time:.3g} s of the plan (smallest "
                    f"singular value {found:.2g}, at least {SINGULAR:g}); plan to another posture",
                )

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        return np.array([self._closed(row) for row in self._motion.rows(times)])

    def remarks(self) -> list[str]:
        """See PlannedMotion."""
        return self._motion.remarks()

    def shared(
        self, times: np.ndarray, found: dict[str, np.ndarray], state: Sequence[np.ndarray]
    ) -> dict[str, np.ndarray]:
        """See PlannedMotion."""
        return self._loads.shared(self, times, found, state)

    def _closed(self, row: np.ndarray) -> np.ndarray:
        nq, nv = self.coordinates.num_positions, self.coordinates.num_velocities
        q, v, a = np.split(row, [nq, nq + nv])
        q, own = self._chain.closed(q, self._loops), self._following
        jacobian = self._chain.jacobian(q)
        v[own] = a[own] = 0.0
        v[own] = np.linalg.solve(jacobian[:, own], -(jacobian @ v))
        drift = jacobian @ a + self._chain.bias(q, v)
        a[own] = np.linalg.solve(jacobian[:, own], -drift)
        return np.concatenate([q, v, a])
