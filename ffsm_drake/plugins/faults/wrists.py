"""Wrenches measured at the wrists of hands that close loops, as reported forces.

With several hands on the target, the plant's acceleration under the commands is that of the tree
with the measured wrenches F of the contacts,

    H dv/dt + C = tau - J' F,

J v being the twist of a hand in the frame of its grasp. So everything that explains a residual
stays as it is with one hand. What the wrench is off by becomes a part of the bounds.
"""

import numpy as np

from ffsm_drake.scenario.contacts import closing_contacts
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.plant import find_frame
from ffsm_drake.systems.setup import BlockSetup

# of a measured wrench along v: share by which calibration of place and axes, and changes in a
# sample, may be off
_SHARE = 0.01
_NOISES = 5.0  # standard deviations of a mean
FADES = 3.2  # s, in which the largest wrench is forgotten: the longest window


class Wrists:
    """The contacts that close loops of the nominal plant."""

    def __init__(self, setup: BlockSetup) -> None:
        """Args: setup of the detector. Raises ModelError: a frame does not exist."""
        contacts, self._model = closing_contacts(setup.scenario, setup.grip), setup.nominal
        plant = self._model.plant
        self._frames = [
            (
                find_frame(plant, each.effector, key=f"contacts.{name}.effector"),
                find_frame(plant, each.frame, key=f"contacts.{name}.frame"),
            )
            for name, each in contacts.items()
        ]
        deviations = [[each.moment_noise, each.force_noise] for each in contacts.values()]
        self._noise = np.repeat(np.array(deviations).reshape(-1, 2), 3)
        self.size = 6 * len(self._frames)

    def along(self, q: np.ndarray, wrench: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The generalized force (nv) on the plant, and the sum of the sizes of its parts (nv).

        Args: configuration (nq); measured wrenches on the target (6 for each contact).
        """
        J = self._jacobian(q)
        return -wrench @ J, np.abs(wrench) @ np.abs(J)

    def error(self, q: np.ndarray, largest: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """The largest error (F, nv) of mean forces.

        Args: configuration (nq); the largest sum of sizes (nv); root of the sum of the squares of
        the weights of samples in each mean (F).
        """
        noise = self._noise @ np.abs(self._jacobian(q))
        found: np.ndarray = _SHARE * largest + _NOISES * noise * spread[:, None]
        return found

    def _jacobian(self, q: np.ndarray) -> np.ndarray:
        """J (6 for each contact, nv)."""
        found = [self._model.calc_jacobian(q, *frames) for frames in self._frames]
        J = np.concatenate([np.zeros((0, len(q) - 1)), *found])
        J[:, :NUM_BASE_VELOCITIES] = 0.0  # but for rounding
        return J
