"""Copies of the spacecraft, and models of several copies, on compiled code."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from ffsm_drake.plugins.equations.tree import Reader
from ffsm_drake.plugins.generated.kernels import Kernels
from ffsm_drake.spacecraft.coordinates import tracking_errors
from ffsm_drake.spacecraft.copies import Copies, CopiesModel
from ffsm_drake.spacecraft.free_floating import ReducedModel
from ffsm_drake.spacecraft.nominal import PlantModel


@dataclasses.dataclass(frozen=True, kw_only=True)
class GeneratedCopies(Copies):
    """As Copies; ``plant`` is a GeneratedPlant."""

    reader: Reader  # reads contexts of ``single``

    def set_parameters(
        self, context: Context, copy: int, single: MultibodyPlant, source: Context
    ) -> None:
        """See Copies; ``single`` is that of this object."""
        plant: Any = self.plant
        plant.set_parameters(context, copy, self.reader.parameters(source))


class _Functions:
    """Compiled functions of several copies, with their arrays."""

    def __init__(self, kernels: Kernels, parameters: np.ndarray) -> None:
        """Args: parameters of each copy (B, ``Tree.num_parameters``)."""
        copies, tree = len(parameters), kernels.tree
        size = tree.num_velocities
        self._q, self._v = np.zeros((copies, tree.num_positions)), np.zeros((copies, size))
        self._own, self._bias = parameters.copy(), np.zeros((copies, size))
        # With a row to spare after each matrix they lie as blocks on a diagonal, which
        # ``products.matrix_vector`` takes at once.
        self._matrices = np.zeros((copies, size + 1, size))
        self._calc_matrices = kernels.on("mass_matrix", self._q, self._own, self._matrices)
        state = tree.num_positions + size
        self._desired, self._actual = np.zeros((copies, state)), np.zeros((copies, state))
        self._e, self._e_dot = np.zeros((copies, size)), np.zeros((copies, size))
        arrays = self._desired, self._actual, self._e, self._e_dot
        self._calc_errors = kernels.on("tracking_errors", *arrays)
        self._calc_bias = kernels.on("bias", self._q, self._v, self._own, self._bias)

    def set_parameters(self, copy: int, parameters: np.ndarray) -> None:
        """Other parameters (``Tree.num_parameters``) of a copy."""
        self._own[copy] = parameters

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """Mass matrices (B, nv, nv) in configurations q (B, nq)."""
        self._q[:] = q
        self._calc_matrices()
        return self._matrices.copy()[:, :-1]

    def bias(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Bias (B, nv) in configurations q (B, nq) at velocities v (B, nv)."""
        self._q[:], self._v[:] = q, v
        self._calc_bias()
        return self._bias.copy()

    def tracking_errors(
        self, desired: np.ndarray, actual: np.ndarray, num_positions: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Tracking errors and their rates (B, nv each) from states [q; v] (B, nq + nv)."""
        if num_positions != self._q.shape[1]:  # of a law that knows other coordinates
            return tracking_errors(desired, actual, num_positions)
        self._desired[:], self._actual[:] = desired, actual
        self._calc_errors()
        return self._e.copy(), self._e_dot.copy()


@dataclasses.dataclass(frozen=True, kw_only=True)
class GeneratedModel(CopiesModel):
    """As CopiesModel: mass matrix and bias are those of compiled code."""

    functions: _Functions
    copies: Any = None

    def take(self, copy: int) -> None:
        """Give a copy the masses, rotors and dampers of its own model."""
        own = self.models[copy]
        self.functions.set_parameters(copy, Reader(own.plant).parameters(own.context))

    def calc_tracking_errors(
        self, desired: np.ndarray, actual: np.ndarray, num_positions: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """See PlantModel."""
        return self.functions.tracking_errors(desired, actual, num_positions)

    def calc_mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """The mass matrices (B, nv, nv) in configurations q (B, nq)."""
        return self.functions.mass_matrix(q)

    def calc_bias(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """The Coriolis and centrifugal terms (B, nv), N m and N."""
        return self.functions.bias(q, v)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReducedGeneratedModel(ReducedModel, GeneratedModel):
    """As GeneratedModel, of underactuated plants."""


def model_of(models: Sequence[PlantModel], kernels: Kernels) -> GeneratedModel:
    """The models of several laws as one, which has the first one's plant and context."""
    first = models[0]
    readers = {id(each.plant): Reader(each.plant) for each in models}
    rows = [readers[id(each.plant)].parameters(each.context) for each in models]
    kind = ReducedGeneratedModel if isinstance(first, ReducedModel) else GeneratedModel
    return kind(
        plant=first.plant,
        context=first.context,
        coordinates=first.coordinates,
        split=first.split,
        models=tuple(models),
        functions=_Functions(kernels, np.array(rows)),
    )
