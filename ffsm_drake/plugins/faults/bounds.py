"""Bounds of the forces that have normal causes: disturbance, orbit and friction."""

import numpy as np

from ffsm_drake.plugins.actuators.drives import DriveSet
from ffsm_drake.plugins.actuators.plume import allocated
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.spacecraft.orbit import Orbit
from ffsm_drake.systems.setup import BlockSetup


class Bounds:
    """The largest forces without a fault, as functions of a state."""

    def __init__(self, setup: BlockSetup) -> None:
        """Args: setup of the detector."""
        scenario, coordinates = setup.scenario, setup.coordinates
        self._nq, self._nv = len(coordinates.position_names), len(coordinates.names)
        self._read_disturbance(scenario, coordinates)
        nothing = np.zeros(self._nv)
        self._friction, self._viscous = nothing, nothing
        actuation = allocated(scenario)
        if actuation.drives is not None:
            drives = DriveSet(actuation.drives, actuation.limit, coordinates)
            base = np.zeros(NUM_BASE_VELOCITIES)
            self._friction = np.concatenate([base, drives.static])
            self._viscous = np.concatenate([base, drives.viscous])

    def _read_disturbance(self, scenario: Scenario, coordinates: Coordinates) -> None:
        """The largest external force (nv), and twice that of an orbit by inertia, 1/s^2."""
        assert scenario.faults is not None
        assert scenario.faults.detection is not None
        given, of = scenario.faults.detection.disturbance, scenario.disturbance
        self._orbital = 0.0
        if given is not None:
            key = "faults.detection.disturbance"
            self._disturbance = coordinates.vector(given, key=key, default=0.0)
            return
        largest = {
            name: abs(of.amplitude_scale) * (abs(each.amplitude) + abs(each.bias))
            for name, each in of.harmonics.items()
        }
        self._disturbance = coordinates.vector(largest, key="disturbance.harmonics", default=0.0)
        if scenario.environment is not None:
            self._orbital = 3.0 * float(Orbit.of(scenario.environment).rate) ** 2

    def of_force(self, mass: np.ndarray, state: np.ndarray) -> np.ndarray:
        """The largest force (nv) that is neither reported nor a fault, friction included."""
        inertia = 0.5 * np.trace(mass[:3, :3]) + mass[3, 3] * (state[4:7] @ state[4:7])
        orbital = self._orbital * np.sqrt(np.diag(mass) * inertia)
        rates = np.abs(state[self._nq :])
        bound: np.ndarray = self._disturbance + orbital + self._friction + self._viscous * rates
        return bound
