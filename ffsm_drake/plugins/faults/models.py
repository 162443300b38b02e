"""The nominal model in states of the last blocks."""

import math
from typing import TypeVar

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.plugins.faults.bounds import Bounds
from ffsm_drake.spacecraft.nominal import PlantModel

Kept = TypeVar("Kept")
_MOST, _FEW = 40, 8  # states: twice those of the longest window; of the last blocks


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
        self._dynamics = dict[bytes, tuple[np.ndarray, ...]]()

    def at(self, states: np.ndarray) -> tuple[np.ndarray, ...]:
        """Mass matrices (m, nv, nv), their inverses, bounds of forces (m, nv), and generalized
        forces of unit forces of thrusters (m, nv, n).

        Args: states (m, nq + nv).
        """
        count, nv = len(states), len(self._model.coordinates.names)
        rows = np.array([self._row(state) for state in states])
        ends = np.cumsum([nv * nv, nv * nv, nv])
        mass, inverse, bound, pushes = np.split(rows, ends, axis=1)
        square = count, nv, nv
        of_thrusters = pushes.reshape(count, nv, self._wrenches.shape[1])
        return mass.reshape(square), inverse.reshape(square), bound, of_thrusters

    def dynamics(self, state: np.ndarray) -> tuple[np.ndarray, ...]:
        """Mass matrix (nv, nv), its inverse, and bias (nv) in a state, and the Jacobian of the
        payload's centre of mass, in the axes of its body (6, nv), zero without a payload; those of
        the last states are kept.

        Raises ValueError: the state is not finite.
        """
        key, plant, context = state.tobytes(), self._model.plant, self._model.context
        if key not in self._dynamics:
            if not math.isfinite(state.dot(state)):  # Drake would end the process
                raise ValueError("the state is not finite")
            plant.SetPositionsAndVelocities(context, state)
            mass = plant.CalcMassMatrix(context)
            bias, moves = plant.CalcBiasTerm(context), np.zeros((6, len(mass)))
            if self._payload is not None:
                moves = self._model.calc_point_jacobian(state[: len(mass) + 1], *self._payload)
            _keep(self._dynamics, key, (mass, np.linalg.inv(mass), bias, moves), _FEW)
        return self._dynamics[key]

    def _row(self, state: np.ndarray) -> np.ndarray:
        """``at`` of one state, in a row."""
        key = state.tobytes()
        row = self._kept.get(key)
        if row is None:
            mass, inverse, *_ = self.dynamics(state)
            pushes = np.zeros((len(mass), self._wrenches.shape[1]))
            pairs = self._wrenches.reshape(2, 3, -1)
            pushes[:6] = (matrix_of(state[:4]) @ pairs).reshape(6, -1)
            bound = self._bounds.of_force(mass, state)
            parts = mass, inverse, bound, pushes
            row = np.concatenate([each.ravel() for each in parts])
            _keep(self._kept, key, row, _MOST)
        return row


def _keep(kept: dict[bytes, Kept], key: bytes, value: Kept, most: int) -> None:
    """Add to what is kept, in place of the oldest if that is too much."""
    if len(kept) >= most:
        kept.pop(next(iter(kept)))
    kept[key] = value
