"""The limits of a plan, and the margins of a motion to them."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.mission import Mission
from ffsm_drake.scenario.contacts import ALL_HANDS, WRENCH, closing_contacts
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.limits import FORCE, POSITION, RATE, tightest
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.mission_limits import limits_of

_ACCURACY = 1e-3  # m; of Drake's distances between cylinders
_OF_CONTACTS = ("contacts", "wrench")
_SLACK = 1e-3  # relative; allowed excess over a limit between the solver's instants


@dataclasses.dataclass(frozen=True, kw_only=True)
class MotionLimits:
    """Limits by coordinate, in the order of v (nv); infinite where there are none."""

    force: np.ndarray  # N m or N, either way; without ``planning.reserve``
    rate: np.ndarray  # rad/s or m/s, either way
    lower: np.ndarray  # rad or m
    upper: np.ndarray
    impulse: np.ndarray  # N m s or N s; integral of the force's size
    contacts: tuple[str, ...]  # names of those that close a loop
    # (6 for each contact that closes a loop), N m and N; without ``planning.reserve``
    wrench: np.ndarray

    def of(self, indices: np.ndarray) -> "MotionLimits":
        """Limits of a subset of coordinates."""
        fields = {field.name for field in dataclasses.fields(self)} - {*_OF_CONTACTS}
        return dataclasses.replace(self, **{name: getattr(self, name)[indices] for name in fields})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Margin:
    """Margin of a motion to a limit."""

    # "force", "rate", "end rate", "position", "turn", "impulse" or "clearance"
    quantity: str
    name: str  # name of the coordinate, or of the two bodies
    value: float  # the nearest to the limit
    limit: float  # for force: without ``planning.reserve``
    time: float  # s; when
    unit: str
    at_least: bool = False  # the limit is a lower one

    @property
    def excess(self) -> float:
        """Excess over the limit; negative if the limit is kept."""
        if self.at_least:
            return self.limit - self.value
        return (self.value if self.quantity == "position" else abs(self.value)) - self.limit

    @property
    def kept(self) -> bool:
        """Whether the limit is kept, but for what interpolation may add."""
        slack = _SLACK * max(abs(self.limit), 1e-3)
        return self.excess <= (_ACCURACY if self.quantity == "clearance" else slack)

    def __str__(self) -> str:
        reserve = " (reserve included)" if self.quantity in ("force", "wrench") else ""
        return (
            f"{self.name}: {self.quantity} {self.value:.4g} {self.unit} at t = {self.time:.3g} s, "
            f"{'below' if self.at_least else 'beyond'} {self.limit:.4g}{reserve}"
        )


def motion_limits(mission: Mission) -> MotionLimits:
    """Return the limits of a mission: its actuators, URDFs, drives, and ``planning``; none for
    undriven coordinates.

    Raises ScenarioError for a missing or undriven coordinate, ModelError for an unreadable URDF.
    """
    coordinates, planning = mission.craft.coordinates, mission.scenario.planning

    def vector(values: dict[str, float] | None, key: str) -> np.ndarray:
        found = coordinates.vector(values or {}, key=key, default=np.inf)
        for name in (
            *coordinates.undriven,
            *np.array(coordinates.names)[~coordinates.is_driven].tolist(),
        ):
            if name in (values or {}):
                raise ScenarioError(
                    f"{key}.{name}", "is undriven (actuation.driven), which a plan does not limit"
                )
        return np.where(coordinates.is_driven, found, np.inf)

    limits = limits_of(mission)
    force, rate, position = (tightest(limits, each) for each in (FORCE, RATE, POSITION))
    usable = 1.0 - planning.reserve
    contacts = closing_contacts(mission.scenario, ALL_HANDS)
    most = [part for each in contacts.values() for part in (each.moment_limit, each.force_limit)]
    return MotionLimits(
        contacts=tuple(contacts),
        wrench=np.repeat([np.inf if each is None else usable * each for each in most], 3),
        force=np.where(coordinates.is_driven, usable * force.upper, np.inf),
        rate=np.minimum(vector(planning.velocity_limit, "planning.velocity_limit"), rate.upper),
        lower=position.lower,
        upper=position.upper,
        impulse=vector(planning.impulse_limit, "planning.impulse_limit"),
    )


def margins(
    limits: MotionLimits,
    model: PlantModel,
    times: np.ndarray,
    rows: np.ndarray,
    force: np.ndarray,
    impulse: np.ndarray,
) -> list[Margin]:
    """Margins of a motion to each finite limit, by coordinate and quantity.

    Args:
      limits: of force, rate, position and impulse.
      model: gives the coordinates.
      times: instants (n,), s.
      rows: [q; v; dv/dt] (n, nq + 2 nv).
      force: (n, nv).
      impulse: (nv,).
    """
    coordinates = model.coordinates
    num_positions = coordinates.num_positions
    found = []
    for i, (name, unit) in enumerate(zip(coordinates.names, coordinates.units, strict=True)):
        force_unit = "N m" if unit == "rad" else "N"
        rate = rows[:, num_positions + i]
        quantities = [
            ("force", force[:, i], limits.force[i], force_unit, False),
            ("rate", rate, limits.rate[i], f"{unit}/s", False),
            ("impulse", impulse[[i]], limits.impulse[i], f"{force_unit} s", False),
        ]
        if i >= NUM_BASE_VELOCITIES:
            position = rows[:, NUM_BASE_POSITIONS + i - NUM_BASE_VELOCITIES]
            quantities += [
                ("position", position, limits.lower[i], unit, True),
                ("position", position, limits.upper[i], unit, False),
            ]
        for quantity, values, limit, given_unit, at_least in quantities:
            if not np.isfinite(limit):
                continue
            size = values if quantity == "position" else np.abs(values)
            k = int(np.argmin(size) if at_least else np.argmax(size))
            found.append(
                Margin(
                    quantity=quantity, name=name, value=float(values[k]), limit=float(limit),
                    time=float(times[-1] if quantity == "impulse" else times[k]),
                    unit=given_unit, at_least=at_least,
                )
            )  # fmt: skip
    return found


def wrench_margins(limits: MotionLimits, times: np.ndarray, wrench: np.ndarray) -> Iterator[Margin]:
    """Margins of the wrenches (n, 6 for each contact) at times (n,), s, to each finite limit."""
    names = [f"contacts.{name} {axis}" for name in limits.contacts for axis in WRENCH]
    for name, limit, values in zip(names, limits.wrench.tolist(), wrench.T, strict=True):
        if np.isfinite(limit):
            k = int(np.argmax(np.abs(values)))
            yield Margin(
                quantity="wrench", name=name, value=float(values[k]), limit=limit,
                time=float(times[k]), unit="N" if "force" in name else "N m",
            )  # fmt: skip
