"""Closed chains of arms that hold one target, as a plug-in computes them."""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from ffsm_drake.common.registrations import Registry
from ffsm_drake.mission import Mission
from ffsm_drake.scenario import Grip, Scenario
from ffsm_drake.scenario.capture import Envelope
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.setup import BlockSetup


class ClosedChains(Protocol):
    """The loops that the contacts of a scenario close. Each raises ScenarioError: a hand does not
    reach its place.
    """

    def start(self, mission: Mission, model: PlantModel, state: np.ndarray) -> np.ndarray:
        """Return the plant's own [q; v] with the loops closed, of one with the loops open."""

    def solve(
        self, scenario: Scenario, model: PlantModel, q: np.ndarray, *, stays: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the plant's own q (nq) with the loops closed, and their A (m, nv) with A v = 0.

        ``stays``: q is closed already.
        """

    def law(self, setup: BlockSetup, make: Callable[[BlockSetup], Any]) -> Any:
        """Return a law in the chain (``chain.law``), of one that ``make`` returns for a setup."""

    def growth(self, mission: Mission, law: Any, q: np.ndarray, grip: Grip, poles: int) -> str:
        """Return how the internal force grows at rest in a configuration q (nq) under a law; empty:
        it does not.

        Args: ..., what holds the target, and the number of poles of the linear loop at one.
        """

    def beyond(self, mission: Mission, state: np.ndarray, grip: Grip, envelope: Envelope) -> str:
        """Return the part of the miss of a grip's hands beyond an envelope, in words, at the true
        plant's own [q; v]; empty: they hold.
        """


CLOSED_CHAINS = Registry[ClosedChains]("closed_chains")
