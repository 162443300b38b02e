"""What ``ffsm new`` is asked for beside an arm: sensors, actuators, panels, a grasp."""

import dataclasses
import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.control_design.rounding import rounded
from ffsm_drake.scenario import (
    Scenario,
    load_scenario,
    shipped_scenarios,
    thruster_layouts,
)
from ffsm_drake.scenario.actuation import DRIVEN
from ffsm_drake.spacecraft.urdf import Servicer

_CAPTURE = "tumbling_capture"  # whose grasp, and estimator through a grasp, are taken
_PERFECT = "flexible_panels"  # whose estimator is for the paper's sensors
_NUMBER = r"(\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)"
_WHEELS, _PANELS = (3, 8), (1, 4)  # fewest and most
# Of the whole base's moments of inertia, at most, that panels make up; of their length, m.
_PANEL_SHARE, _PANEL_LENGTH = 0.3, (0.3, 3.0)
_PANEL_SIDES = ([0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0])
_PANEL_FREQUENCY = 0.25  # Hz, of flexible_panels
_TOLERANCE = 5e-3  # m, of a base that thrusters hold in place


@dataclasses.dataclass(frozen=True, kw_only=True)
class Asked:
    """The parts that a new scenario is to have; None: without."""

    sensors: str | None = None  # the shipped scenario that has them
    thrusters: str | None = None  # their layout
    wheels: tuple[int, float | None] | None = None  # number, torque limit (N m; None: by the load)
    panels: tuple[int, float] | None = None  # number, mass of each, kg
    capture: float | None = None  # rad/s, at which the target tumbles
    driven: tuple[str, ...] = ("all",)  # groups of coordinates

    @classmethod
    def parsed(cls, **words: str | None) -> "Asked":
        """From the options of ``ffsm new`` by name; None: not given.

        Raises ScenarioError: one of them cannot be used.
        """
        parse: dict[str, Callable[[str], Any]] = {
            "sensors": _sensors,
            "thrusters": _thrusters,
            "wheels": _wheels,
            "panels": _panels,
            "capture": _capture,
            "driven": _driven,
        }
        given = {name: word.strip() for name, word in words.items() if word is not None}
        values: dict[str, Any] = {name: parse[name](word) for name, word in given.items()}
        asked = cls(**values)
        for name, group in (("thrusters", "base_position"), ("wheels", "base_rotation")):
            if getattr(asked, name) is not None and not asked.drives(group):
                raise ScenarioError(
                    f"--{name}", f"cannot act with --driven {','.join(asked.driven)}: it leaves "
                    f"out {group}; leave one of them out"
                )  # fmt: skip
        return asked

    @property
    def is_paper(self) -> bool:
        """Whether nothing is asked for that the paper's mission does not have."""
        return self == Asked()

    @property
    def has_approach(self) -> bool:
        """Whether the run begins before the grasp: where all coordinates are driven."""
        return self.capture is not None and self.driven == ("all",)

    @property
    def mission(self) -> str:
        """What is done, in words."""
        return "Post-capture stabilization" if self.capture is None else "Capture, to rest,"

    def drives(self, group: str) -> bool:
        """Whether a group of coordinates is driven."""
        return "all" in self.driven or group in self.driven

    @property
    def source(self) -> Scenario | None:
        """The shipped scenario whose sensors, estimator and bandwidth are taken."""
        if self.sensors is None:
            return None
        found = load_scenario(self.sensors)
        grasp = load_scenario(_CAPTURE)
        # The inertia of a light wrist grows by orders of magnitude at a grasp: an estimate of
        # force outlasts that, one of acceleration does not.
        return grasp if self.capture is not None and grasp.sensing == found.sensing else found

    def sections(self) -> dict[str, Any]:
        """Sections of the scenario that do not depend on the spacecraft, as plain data."""
        found: dict[str, Any] = {}
        if self.source is not None:
            for key in ("sensing", "estimator"):
                found[key] = _own(getattr(self.source, key))
        if self.thrusters is not None and "kind" not in found.get("estimator", {}):
            # The one-sample estimate is unstable with thrusters that act for more than a sample.
            found["estimator"] = _own(load_scenario(_PERFECT).estimator)
            if self.capture is not None:
                through = load_scenario(_CAPTURE).estimator
                found["estimator"] |= {"kind": through.kind, "force_walk": through.force_walk}
        tolerance = dict(self.source.tolerance) if self.source is not None else {"all": 1e-3}
        if self.thrusters is not None:
            tolerance["base_position"] = max(tolerance.get("base_position", 0.0), _TOLERANCE)
        if tolerance != Scenario().tolerance:
            found["tolerance"] = tolerance
        actuation: dict[str, Any] = {}
        if self.driven != ("all",):
            actuation["driven"] = list(self.driven)
        if self.thrusters is not None:
            actuation["thrusters"] = {"layout": self.thrusters}
        if self.wheels is not None:
            count, torque = self.wheels
            actuation["wheels"] = {"units": wheel_units(count, torque or 1.0)}
        if actuation:
            found["actuation"] = actuation
        if self.capture is not None:
            shipped = load_scenario(_CAPTURE).capture
            assert shipped is not None
            share = self.capture / float(np.linalg.norm(shipped.rate))
            found["capture"] = {
                "rate": [rounded(share * rate) for rate in shipped.rate],
                "servicer": shipped.servicer if self.has_approach else "rest",
                "tracking_length": shipped.tracking_length,
            }
            if not self.has_approach:
                del found["capture"]["tracking_length"]
        return found

    def flexible(self, servicer: Servicer, plant: MultibodyPlant) -> dict[str, Any]:
        """The section ``model.flexible``: panels on the sides of the base.

        Raises ScenarioError: they outweigh the base.
        """
        if self.panels is None:
            return {}
        count, mass = self.panels
        links = [plant.GetBodyByName(name) for name in servicer.base_links]
        body = max(links, key=lambda link: float(link.default_mass()))
        inertia = body.default_spatial_inertia()
        centre = inertia.get_com()
        moments = inertia.Shift(centre).CalcRotationalInertia().get_moments()
        if count * mass >= 0.5 * inertia.get_mass():
            raise ScenarioError(
                "--panels",
                f"{count} of {mass:g} kg are part of the base's {inertia.get_mass():.4g} kg, and "
                "must be less than half of it",
            )
        side = 0.5 * math.sqrt(6.0 * float(moments.mean()) / inertia.get_mass())
        middle = math.sqrt(_PANEL_SHARE * float(moments.min()) / (count * mass))
        length = min(max(2.0 * (middle - side), _PANEL_LENGTH[0]), _PANEL_LENGTH[1])
        return {
            f"panel_{k + 1}": {
                "body": f"servicer::{body.name()}",
                "position": [rounded(x) for x in (centre + side * np.array(direction)).tolist()],
                "direction": direction,
                **({"axis": [0, 1, 0]} if direction[0] else {}),
                "mass": mass,
                "length": rounded(length),
                "width": rounded(min(1.0, length)),
                "frequency": _PANEL_FREQUENCY,
            }
            for k, direction in enumerate(_PANEL_SIDES[:count])
        }


def wheel_units(count: int, torque: float) -> dict[str, dict[str, Any]]:
    """Wheels by name: axes evenly on a cone about z, three of them at right angles."""
    turn = math.pi / 4 if count == 4 else 0.0
    axes = [
        [
            rounded(math.sqrt(2.0) * f(turn + 2.0 * math.pi * k / count))
            for f in (math.cos, math.sin)
        ]
        for k in range(count)
    ]
    return {
        f"wheel_{k + 1}": {"axis": [x, y, 1.0], "torque_limit": torque}
        for k, (x, y) in enumerate(axes)
    }


def _own(settings: Any) -> dict[str, Any]:
    """What differs from the defaults in a section, as plain data."""
    usual = {f.name: getattr(type(settings)(), f.name) for f in dataclasses.fields(settings)}
    data: Mapping[str, Any] = dataclasses.asdict(settings)
    return {key: value for key, value in data.items() if getattr(settings, key) != usual[key]}


def _sensors(word: str) -> str:
    names = list(shipped_scenarios())
    found = [name for name in names if word and (name == word or name.startswith(f"{word}_"))]
    if len(found) != 1:
        raise ScenarioError(
            "--sensors",
            f"'{word}' must name a shipped scenario that has them, such as flight "
            "(flight_sensors), slow (slow_navigation) or paper",
        )
    return found[0]


def _thrusters(word: str) -> str:
    if word not in thruster_layouts():
        choices = ", ".join(thruster_layouts())
        raise ScenarioError("--thrusters", f"'{word}' is no layout; choose one of {choices}")
    return word


def _wheels(word: str) -> tuple[int, float | None]:
    match = re.fullmatch(rf"(\d+)(?:x{_NUMBER}Nm)?", word)
    count, torque = (int(match[1]), match[2]) if match else (0, None)
    if not _WHEELS[0] <= count <= _WHEELS[1] or (torque is not None and not float(torque) > 0.0):
        raise ScenarioError(
            "--wheels",
            f"'{word}' must be {_WHEELS[0]} to {_WHEELS[1]} wheels, with a torque limit or without "
            "(then it is sized), such as 4 or 4x0.5Nm",
        )
    return count, None if torque is None else float(torque)


def _panels(word: str) -> tuple[int, float]:
    match = re.fullmatch(rf"(\d+)x{_NUMBER}kg", word)
    if not match or not _PANELS[0] <= int(match[1]) <= _PANELS[1] or not float(match[2]) > 0.0:
        raise ScenarioError(
            "--panels",
            f"'{word}' must be {_PANELS[0]} to {_PANELS[1]} panels of a mass, such as 2x5kg",
        )
    return int(match[1]), float(match[2])


def _capture(word: str) -> float:
    match = re.fullmatch(rf"{_NUMBER}(deg|rad)/s", word)
    if not match:
        raise ScenarioError(
            "--capture", f"'{word}' must be the rate of the target's tumble, such as 3deg/s"
        )
    return float(match[1]) * (math.pi / 180.0 if match[2] == "deg" else 1.0)


def _driven(word: str) -> tuple[str, ...]:
    groups = {part.strip() for part in word.split(",")}
    known = (("all",), *DRIVEN[1:])
    for choice in known:
        if groups == set(choice) or (choice == ("all",) and groups == set(DRIVEN[0])):
            return choice
    choices = " or ".join(",".join(choice) for choice in known)
    raise ScenarioError("--driven", f"must be {choices}, not '{word}'")
