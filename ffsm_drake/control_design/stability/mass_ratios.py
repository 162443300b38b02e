"""How far the nominal mass matrix is from the true one, along the planned motion."""

import functools

import numpy as np

from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.spacecraft.nominal import (
    PlantModel,
    make_flexible_plant,
    make_nominal_plant,
    make_true_plant,
)
from ffsm_drake.systems.reference import make_motion


def inertia_ratios(true_mass_matrix: np.ndarray, nominal_mass_matrix: np.ndarray) -> np.ndarray:
    """Eigenvalues eta of H^-1 Hhat, ascending (nv): free of units, since both matrices have the
    same; > 1 is an over-estimated inertia.
    """
    scale = np.linalg.inv(np.linalg.cholesky(true_mass_matrix))
    return np.linalg.eigvalsh(scale @ nominal_mass_matrix @ scale.T)


class PlannedInertia:
    """Mass matrices of a scenario along its planned motion, undriven coordinates free."""

    def __init__(self, scenario: Scenario) -> None:
        """Raises ModelError or ScenarioError where a model or a value cannot be used."""
        self._scenario = scenario
        self.nominal = driven_model(make_nominal_plant(scenario))
        self.true = driven_model(make_flexible_plant(scenario))
        self.motion = make_motion(scenario, self.nominal.coordinates)
        driven = self.nominal.coordinates.driven
        self._pick = np.ix_(driven, driven)

    @functools.cached_property
    def locked(self) -> PlantModel:
        """The true plant with its flexible parts locked."""
        names = self.true.split.names
        return driven_model(make_true_plant(self._scenario)) if names else self.true

    def at(self, time: float, *, locked: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """H, apparent (``calc_apparent_mass_matrix``), and Hhat (nv, nv) at a time, s."""
        q, _, _ = self.motion.evaluate(time)
        true = self.locked if locked else self.true
        return true.calc_apparent_mass_matrix(q), self.nominal.calc_mass_matrix(q)

    def ratios(self, time: float, *, locked: bool = False) -> np.ndarray:
        """eta (na) of the driven coordinates at a time, s."""
        return inertia_ratios(*(matrix[self._pick] for matrix in self.at(time, locked=locked)))
