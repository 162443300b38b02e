"""The limits that a plan keeps, and how near a motion comes to them."""

import dataclasses

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.limits import FORCE, POSITION, RATE, tightest
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.limits import limits_of

_ACCURACY = 1e-3  # m; of Drake's distances between cylinders
# relative; by which a solved plan may pass a limit between the instants that the solver looks at
_SLACK = 1e-3


@dataclasses.dataclass(frozen=True, kw_only=True)
class MotionLimits:
    """Limits by coordinate, in the order of v (nv); infinite where there are none."""

    force: np.ndarray  # N m or N, either way
    rate: np.ndarray  # rad/s or m/s, either way
    lower: np.ndarray  # rad or m
    upper: np.ndarray
    impulse: np.ndarray  # N m s or N s; integral of the force's size

    def of(self, indices: np.ndarray) -> "MotionLimits":
        """Of some coordinates alone."""
        return MotionLimits(
            **{field.name: getattr(self, field.name)[indices] for field in dataclasses.fields(self)}
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Margin:
    """How near a motion comes to a limit."""

    quantity: str  # "force", "rate", "position", "turn", "impulse" or "clearance"
    name: str  # of the coordinate, or of the two bodies
    value: float  # the nearest to the limit
    limit: float
    time: float  # s; when
    unit: str

    @property
    def kept(self) -> bool:
        """Whether the limit is kept, but for what interpolation may add."""
        slack = _SLACK * max(abs(self.limit), 1e-3)
        if self.quantity == "clearance":
            return self.value >= self.limit - _ACCURACY
        return abs(self.value) <= abs(self.limit) + slack

    def __str__(self) -> str:
        side = "below" if self.quantity == "clearance" else "beyond"
        what = f"{self.name}: {self.quantity} {self.value:.4g} {self.unit}"
        return f"{what} at t = {self.time:.3g} s, {side} {self.limit:.4g}"


def motion_limits(scenario: Scenario, model: PlantModel) -> MotionLimits:
    """The limits of a scenario: of its actuators, its URDFs and drives, and of ``planning``; none
    where nothing drives.

    Raises ScenarioError for a coordinate that does not exist or is undriven, ModelError for a URDF
    that cannot be read.
    """
    coordinates, planning = model.coordinates, scenario.planning

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

    limits = limits_of(scenario, model.plant)
    force, rate, position = (tightest(limits, each) for each in (FORCE, RATE, POSITION))
    return MotionLimits(
        force=np.where(coordinates.is_driven, force.upper, np.inf),
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
) -> list[Margin]:
    """How near a motion comes to each finite limit, by quantity and coordinate.

    Args:
      limits: of force, rate, position and impulse.
      model: gives the coordinates.
      times: instants (n,), s.
      rows: [q; v; dv/dt] (n, nq + 2 nv).
      force: (n, nv).
    """
    coordinates = model.coordinates
    num_positions = len(coordinates.position_names)
    units = np.array(coordinates.units)
    rate = rows[:, num_positions : num_positions + len(coordinates.names)]
    found = []
    for i, name in enumerate(coordinates.names):
        force_unit = "N m" if units[i] == "rad" else "N"
        for quantity, values, limit, unit in (
            ("force", force[:, i], limits.force[i], force_unit),
            ("rate", rate[:, i], limits.rate[i], f"{units[i]}/s"),
        ):
            if np.isfinite(limit):
                k = int(np.argmax(np.abs(values)))
                found.append(
                    _margin(quantity, name, float(values[k]), float(limit), float(times[k]), unit)
                )
        if i >= NUM_BASE_VELOCITIES:
            position = rows[:, NUM_BASE_POSITIONS + i - NUM_BASE_VELOCITIES]
            for bound, k in (
                (limits.lower[i], int(np.argmin(position))),
                (limits.upper[i], int(np.argmax(position))),
            ):
                if np.isfinite(bound):
                    found.append(
                        _margin(
                            "position",
                            name,
                            float(position[k]),
                            float(bound),
                            float(times[k]),
                            units[i],
                        )
                    )
        if np.isfinite(limits.impulse[i]):
            impulse = float(np.trapezoid(np.abs(force[:, i]), times))
            limit = float(limits.impulse[i])
            found.append(
                _margin("impulse", name, impulse, limit, float(times[-1]), f"{force_unit} s")
            )
    return found


def _margin(quantity: str, name: str, value: float, limit: float, time: float, unit: str) -> Margin:
    return Margin(quantity=quantity, name=name, value=value, limit=limit, time=time, unit=unit)
