"""Limits, the share of a limit used by a motion, and the limits in URDFs."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from xml.etree import ElementTree

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.common.errors import ModelError
from ffsm_drake.common.numbers import short
from ffsm_drake.scenario import Model
from ffsm_drake.spacecraft.checked_urdf import read_limits
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.spacecraft.plant import urdfs_of

_DIGITS = range(4, 18)  # of a value that differs from its bound
SLACK = 1e-9  # relative; a plan may end at a limit
POSITION, RATE, FORCE = "position", "rate", "force"  # the quantities of coordinates
_UNITS: dict[str, dict[str, str]] = {
    POSITION: {},
    RATE: {"rad": "rad/s", "m": "m/s"},
    FORCE: {"rad": "N m", "m": "N"},
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Limit:
    """Bounds of one quantity of some components, and who sets them."""

    quantity: str  # POSITION, RATE or FORCE of all coordinates, or a signal of a part
    source: str  # in words, or the key of a setting
    names: tuple[str, ...]  # names of the components (n)
    units: tuple[str, ...]  # units of the quantity
    upper: np.ndarray  # (n); (samples, n) where it depends on the motion; infinite: none
    lower: np.ndarray
    # what a component beyond its bound does, if such a run is no success: "slips"
    fails: str = ""

    @classmethod
    def of_coordinates(
        cls,
        quantity: str,
        source: str,
        coordinates: Coordinates,
        upper: np.ndarray,
        lower: np.ndarray | None = None,
    ) -> "Limit":
        """Return a limit of all coordinates (nv); ``lower`` defaults to -``upper``."""
        units = tuple(_UNITS[quantity].get(unit, unit) for unit in coordinates.units)
        return cls(
            quantity=quantity, source=source, names=coordinates.names, units=units,
            upper=upper, lower=-upper if lower is None else lower,
        )  # fmt: skip

    @property
    def joints(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the joints alone, of a limit of coordinates."""
        return self.lower[NUM_BASE_VELOCITIES:], self.upper[NUM_BASE_VELOCITIES:]

    def told(self, i: int) -> str:
        """What the limit of a component bounds, in words."""
        what = {FORCE: "force on", RATE: "velocity of"}.get(self.quantity, f"{self.quantity} of")
        return f"{what} {self.names[i]}"

    def used(self, values: np.ndarray) -> np.ndarray:
        """Return the used share of values (samples, n): 1 at a bound, more beyond it; -inf for NaN.

        Its unit is half the distance of the bounds, or 1 where only one is finite.
        """
        half = 0.5 * (self.upper - self.lower)
        with np.errstate(invalid="ignore"):
            beyond = np.fmax(values - self.upper, self.lower - values)
            share = 1.0 + beyond / np.where(np.isfinite(half), np.maximum(half, 1e-12), 1.0)
        return np.where(np.isnan(share), -np.inf, share)

    def remark(self, values: np.ndarray, what: str, at: Callable[[int], str]) -> Iterator[str]:
        """A line with the components of values (samples, n) that exceed their bounds."""
        used, parts = self.used(values), []
        lower, upper = (np.broadcast_to(each, used.shape) for each in (self.lower, self.upper))
        for i in np.flatnonzero((used > 1.0 + SLACK).any(axis=0)):
            k, unit = int(np.argmax(used[:, i])), self.units[i]
            value, least, most = values[k, i], lower[k, i], upper[k, i]
            size, near = abs(value), abs(most if value > most else least)
            digits = next(d for d in _DIGITS if d == 17 or f"{size:.{d}g}" != f"{near:.{d}g}")
            parts.append(
                f"{self.names[i]} {short(size, digits)} {unit}{at(k)} (limit {short(most, 4)})"
                if least == -most and self.quantity != POSITION
                else f"{self.names[i]} {value:.{digits}g}{at(k)} "
                f"(limits {least:.4g} to {most:.4g} {unit})"
            )
        if parts:
            yield f"{what} exceeds {self.source}: {', '.join(parts)}"


def tightest(limits: Sequence[Limit], quantity: str) -> Limit:
    """All limits of one quantity of the coordinates as one."""
    own = [limit for limit in limits if limit.quantity == quantity]
    return dataclasses.replace(
        own[0],
        upper=np.minimum.reduce([limit.upper for limit in own]),
        lower=np.maximum.reduce([limit.lower for limit in own]),
    )


def urdf_limits(model: Model, plant: MultibodyPlant, coordinates: Coordinates) -> list[Limit]:
    """Return positions, rates and forces of a model's joints; a zero velocity or effort means
    unknown.

    Drake drops effort limits of joints without a transmission, so all are read from the URDFs.

    Raises:
      ModelError: a URDF cannot be read.
    """
    lower, upper, velocity, effort = np.full((4, coordinates.num_velocities), np.inf)
    lower *= -1.0
    for i, name in enumerate(coordinates.joints, NUM_BASE_VELOCITIES):  # of other formats
        joint = plant.GetJointByName(name)
        lower[i], upper[i] = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
        velocity[i] = joint.velocity_upper_limits()[0] or np.inf
        effort[i] = min(
            drive.effort_limit()
            for drive in map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
            if drive.joint().index() == joint.index()
        )
    for path in urdfs_of(model):
        try:
            elements = list(ElementTree.parse(path).getroot().iter("joint"))
        except (OSError, ElementTree.ParseError):
            # Drake could read it, so the fault is unusual
            continue
        for element in elements:
            if element.get("name") not in coordinates.joints or element.find("limit") is None:
                continue
            i = NUM_BASE_VELOCITIES + coordinates.joints.index(element.get("name", ""))
            try:
                lower[i], upper[i], effort[i], velocity[i] = read_limits(element)
            except ModelError as error:
                raise ModelError(f"model: {path}: {error}") from None
    limit = Limit.of_coordinates
    return [
        limit(POSITION, "the URDF's position limits", coordinates, upper, lower),
        limit(RATE, "the URDF's velocity limits", coordinates, velocity),
        limit(FORCE, "the URDF's effort limits", coordinates, effort),
    ]
