"""Labelled time series without xarray, which takes longer to load than a run to compute."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.parts.signals import HELD_FORCE

if TYPE_CHECKING:
    import xarray as xr

    Labelled: TypeAlias = "Table | xr.Dataset"

# Dimensions, or the only one; values; meaning and unit, if they have them.
Given: TypeAlias = tuple[Any, ...]


class Column(NamedTuple):
    """A variable or a coordinate."""

    dims: tuple[str, ...]
    values: np.ndarray
    attrs: Mapping[str, str]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """The part of ``xarray.Dataset`` that metrics need, with the same names and meanings."""

    columns: Mapping[str, Column] = dataclasses.field(default_factory=dict)
    coords: frozenset[str] = frozenset()  # the columns that are coordinates
    attrs: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def __getitem__(self, name: str) -> Column:
        return self.columns[name]

    def assign(self, variables: Mapping[str, Given], coords: Mapping[str, Given]) -> "Table":
        """Return the table with further variables and coordinates, or others in their place."""
        given = {name: _column(*column) for name, column in {**variables, **coords}.items()}
        columns = {**self.columns, **given}
        return dataclasses.replace(self, columns=columns, coords=self.coords.union(coords))

    def isel(self, *, time: Any) -> "Table":
        """Return the table at some of its samples: a slice, a mask or indices."""

        def part(column: Column) -> Column:
            if "time" not in column.dims:
                return column
            place = (slice(None),) * column.dims.index("time")
            return column._replace(values=column.values[(*place, time)])

        columns = {name: part(column) for name, column in self.columns.items()}
        return dataclasses.replace(self, columns=columns)

    def to_dataset(self) -> "xr.Dataset":
        """Return the table as an xarray Dataset."""
        import xarray as xr

        dataset = xr.Dataset(self.columns, attrs=self.attrs)
        return dataset.set_coords(self.coords)


@dataclasses.dataclass(frozen=True, eq=False)
class Values:
    """The values of labelled time series by name, as the ``Signals`` of a part."""

    data: "Labelled"

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the values of a variable."""
        return self.data[name].values


def coordinate_columns(coordinates: Coordinates) -> dict[str, Given]:
    """Return the names of coordinates, positions and axes in a run's time series, and the groups
    and units of the coordinates; which are driven, unless all are.
    """
    columns: dict[str, Given] = {
        "coordinate": ("coordinate", coordinates.names),
        "position_name": ("position_name", coordinates.position_names),
        "axis": ("axis", ("x", "y", "z")),
        "group": ("coordinate", coordinates.group_of),
        "unit": ("coordinate", coordinates.units),
    }
    if coordinates.undriven:
        columns["driven"] = ("coordinate", coordinates.is_driven)
    return columns


def with_role(dataset: "Labelled", role: str) -> list[str]:
    """Return the variables that have a role in the balances of momentum and energy
    (``part.ROLES``).
    """
    return [name for name in str(dataset.attrs.get(role, "")).split() if name in dataset]


def held_force(dataset: "Labelled") -> np.ndarray:
    """Return the force (n, nv) held over each sample: actuators' forces, and external forces with
    that role.
    """
    total: np.ndarray = dataset["applied_force"].values
    for name in with_role(dataset, HELD_FORCE):
        total = total + dataset[name].values
    return total


def driven_of(dataset: "Labelled") -> np.ndarray:
    """Return the mask (nv) of the coordinates that actuators move."""
    everything: np.ndarray = np.ones(len(dataset["coordinate"].values), dtype=bool)
    return dataset["driven"].values.astype(bool) if "driven" in dataset else everything


def _column(dims: str | tuple[str, ...], values: Any, meaning: str = "", unit: str = "") -> Column:
    attrs = {"long_name": meaning, "units": unit} if meaning else {}
    return Column((dims,) if isinstance(dims, str) else dims, np.asarray(values), attrs)
