"""Plants with a payload, for computations outside a simulation: the nominal one (the controller's) and the true one."""

import dataclasses
import math

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from ffsm_drake.scenario import MassProperties, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.mass_properties import set_payload, set_wheels
from ffsm_drake.spacecraft.plant import coordinates_of, make_plant


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlantModel:
    """A plant with a payload, for computations outside any simulation.

    ``context`` is a scratch pad owned by this object; every method sets what it reads.
    """

    plant: MultibodyPlant
    context: Context
    coordinates: Coordinates

    def calc_mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """The mass matrix H (..., nv, nv) in configurations q (..., nq)."""
        if q.ndim > 1:
            return np.stack([self.calc_mass_matrix(one) for one in q])
        self._set_positions(q)
        return self.plant.CalcMassMatrix(self.context)

    def calc_bias(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """The Coriolis and centrifugal term C (..., nv) of H dv/dt + C = tau + tau_d, N m and N."""
        if q.ndim > 1:
            return np.stack([self.calc_bias(*one) for one in zip(q, v, strict=True)])
        self._set_positions(q)
        if not math.isfinite(v.dot(v)):
            raise ValueError("the velocity v is not finite")
        self.plant.SetVelocities(self.context, v)
        return self.plant.CalcBiasTerm(self.context)

    def calc_inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """The force H a + C (..., nv) that gives accelerations a (..., nv), N m and N."""
        return (self.calc_mass_matrix(q) @ a[..., None])[..., 0] + self.calc_bias(q, v)

    def calc_tracking_force(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """The force (..., nv) that actuators give along a motion: inverse dynamics and the joints' damping."""
        damping = np.zeros(v.shape[-1])
        for joint in map(self.plant.get_joint, self.plant.GetJointIndices()):
            if joint.num_velocities() == 1:
                damping[joint.velocity_start()] = joint.default_damping()
        return self.calc_inverse_dynamics(q, v, a) + damping * v

    def _set_positions(self, q: np.ndarray) -> None:
        if not math.isfinite(q.dot(q)):  # on which Drake ends the process
            raise ValueError("the configuration q is not finite")
        self.plant.SetPositions(self.context, q)


def make_nominal_plant(scenario: Scenario) -> PlantModel:
    """The plant with the nominal payload (``payload.nominal``): its mass matrix is the paper's H with a hat."""
    return _make_plant_model(scenario, scenario.payload.nominal)


def make_true_plant(scenario: Scenario) -> PlantModel:
    """The plant as it is (``payload.truth``)."""
    return _make_plant_model(scenario, scenario.payload.truth)


def _make_plant_model(scenario: Scenario, payload: MassProperties) -> PlantModel:
    plant = make_plant(scenario.model)
    context = plant.CreateDefaultContext()
    set_payload(plant, context, body=scenario.payload.body, properties=payload)
    set_wheels(plant, context, scenario.wheels)
    return PlantModel(plant=plant, context=context, coordinates=coordinates_of(plant))
