"""Magnified hidden coordinates of a record: panels bend by invisible milliradians."""

import math
from typing import TYPE_CHECKING

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.common.numbers import magnification
from ffsm_drake.plugins.flexible.bodies import labels_of
from ffsm_drake.scenario import Model
from ffsm_drake.spacecraft.coordinates import HIDDEN, StateSplit
from ffsm_drake.spacecraft.plant import hand_frame

if TYPE_CHECKING:
    import xarray as xr

_LARGEST = {"rad": math.radians(10.0), "m": 0.3}  # largest drawn deflection of a magnified part
_PLURAL = {"mass": "masses"}


class Deflections:
    """The hidden coordinates of a record, magnified by a round factor for each kind of part.

    The largest deflection stays below 10 degrees (a chain's plates together) or 0.3 m. Parts
    that carry the hand are not magnified, to keep the arm on its path.
    """

    def __init__(
        self, dataset: "xr.Dataset", model: Model, plant: MultibodyPlant, hidden: StateSplit
    ) -> None:
        """Args:
        dataset: dataset of a run.
        model: its model.
        plant: the plant in the view.
        hidden: its hidden coordinates.
        """
        self.factors: dict[str, int] = {}  # by kind; those above 1
        self._shown = np.zeros((dataset.sizes["time"], len(hidden.names)))
        if not hidden.names:
            return
        self._shown = (
            dataset["hidden_position"].sel(hidden_coordinate=list(hidden.names)).values.copy()
        )
        tip = hand_frame(plant, model).body()
        columns: dict[str, list[list[int]]] = {}  # kind -> the coordinates of each part
        for name, part in model.flexible.items():
            joints = [
                plant.GetJointByName(f"{HIDDEN}{label}").index() for label in labels_of(name, part)
            ]
            if tip.index() not in plant.GetBodiesKinematicallyAffectedBy(joints):
                columns.setdefault(part.kind, []).append(
                    [hidden.names.index(each) for each in labels_of(name, part)]
                )
        for kind, parts in columns.items():
            largest = max(float(np.abs(self._shown[:, part]).sum(axis=1).max()) for part in parts)
            factor = magnification(largest / _LARGEST[hidden.units[parts[0][0]]])
            self._shown[:, [column for part in parts for column in part]] *= factor
            if factor > 1:
                self.factors[kind] = factor

    def at(self, sample: int) -> np.ndarray:
        """The magnified hidden coordinates of a sample."""
        return self._shown[sample]

    @property
    def legend(self) -> str:
        """The magnifications as text; empty if there are none."""
        factors = [
            f"{_PLURAL.get(kind, f'{kind}s')} x {factor}" for kind, factor in self.factors.items()
        ]
        return f"deflections drawn larger: {', '.join(factors)}" if factors else ""
