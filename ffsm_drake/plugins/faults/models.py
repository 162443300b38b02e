"""The nominal model in states of the last blocks."""

import math

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.plugins.faults.bounds import Bounds
from ffsm_drake.plugins.faults.payload_error import place
from ffsm_drake.spacecraft.nominal import PlantModel

_MOST = 130  # states, twice those of the longest window


class Models:
    """Functions of a state. Those of the last states are kept, since windows share them."""

    def __init__(
        self,
        model: PlantModel,
        bounds: Bounds,
        wrenches: np.ndarray,
        payload: tuple[Frame, np.ndarray] | None,
    ) -> None:
        """Args: nominal model; bounds of forces; torques and forces (6, n) of unit forces of
        thrusters, base's axes; the payload's frame and centre of mass in it, or None.
        """
        self._model, self._bounds = model, bounds
        self._wrenches, self._payload = wrenches, payload
        self._kept = dict[bytes, np.ndarray]()
        self._last = b"", np.zeros(0), np.zeros(0)

    def at(self, states: np.ndarray) -> tuple[np.ndarray, ...]:
        """Mass matrices (m, nv, nv), their inverses, bounds of forces (m, nv), generalized forces
        of unit forces of thrusters (m, nv, n), and places of the payload (m, 6 nv + 6, or 0).

        Args: states (m, nq + nv).
        """
        count, nv = len(states), len(self._model.coordinates.names)
        rows = np.array([self._row(state) for state in states])
        ends = np.cumsum([nv * nv, nv * nv, nv, nv * self._wrenches.shape[1]])
        mass, inverse, bound, pushes, payload = np.split(rows, ends, axis=1)
        square = count, nv, nv
        of_thrusters = pushes.reshape(count, nv, self._wrenches.shape[1])
        return mass.reshape(square), inverse.reshape(square), bound, of_thrusters, payload

    def dynamics(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mass matrix (nv, nv) and bias (nv) in a state; those of the last state are kept.

        Raises ValueError: the state is not finite.
        """
        key, plant, context = state.tobytes(), self._model.plant, self._model.context
        if key != self._last[0]:
            if not math.isfinite(state.dot(state)):  # Drake would end the process
                raise ValueError("the state is not finite")
            plant.SetPositionsAndVelocities(context, state)
            self._last = key, plant.CalcMassMatrix(context), plant.CalcBiasTerm(context)
        return self._last[1:]

    def pushes(self, state: np.ndarray) -> np.ndarray:
        """Generalized forces (nv, n) of unit forces of thrusters in a state."""
        found = np.zeros((len(self._model.coordinates.names), self._wrenches.shape[1]))
        pairs = self._wrenches.reshape(2, 3, -1)
        found[:6] = (matrix_of(state[:4]) @ pairs).reshape(6, -1)
        return found

    def _row(self, state: np.ndarray) -> np.ndarray:
        """``at`` of one state, in a row."""
        key = state.tobytes()
        row = self._kept.get(key)
        if row is None:
            mass, pushes = self.dynamics(state)[0], self.pushes(state)
            payload = np.zeros(0)
            if self._payload is not None:
                payload = place(self._model, *self._payload, state)
            bound = self._bounds.of_force(mass, state)
            parts = mass, np.linalg.inv(mass), bound, pushes, payload
            row = np.concatenate([each.ravel() for each in parts])
            if len(self._kept) >= _MOST:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = row
        return row
