"""The options of ``ffsm new`` in addition to the arm: sensors, actuators, panels, a grasp."""

import dataclasses
import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.plugins.design.rounding import rounded
from ffsm_drake.plugins.new.base_box import BaseBox
from ffsm_drake.scenario import Scenario, load_scenario, shipped_scenarios, thruster_layouts
from ffsm_drake.scenario.actuation import DRIVEN, Thruster, Wheel

_CAPTURE = "tumbling_capture"  # the estimator through a grasp
_THRUST = 0.0125  # m/s^2, of a thruster sized for a base, as 5 N on the shipped servicer
_LAYOUT_BOX, _FITS = np.array([0.6, 0.6, 0.95]), 0.01  # m; half the base of the shipped layouts
_SLOWER = (0.5, 0.2)  # shares of a target's tumble
_TOLERANCE = 5e-3  # m, of a base that thrusters hold in place
_NUMBER = r"(\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)"
_POSITIVE = rf"(?=[\d.]*[1-9]){_NUMBER}"
# Option -> the form of its value, in words too, and the value from the form's groups.
_FORMS: dict[str, tuple[str, str, Callable[..., Any]]] = {
    "wheels": (
        rf"([3-8])(?:x{_POSITIVE}Nm)?(?:,{_POSITIVE}Nms)?(?:,{_POSITIVE}rpm)?",
        "3 to 8 wheels, sized, or by data sheet (torque, momentum, largest speed), such as 4, "
        "4x0.5Nm or 3x0.02Nm,0.5Nms,6000rpm",
        lambda count, *given: WheelData(int(count), *(each and float(each) for each in given)),
    ),
    "thrusters": (
        rf"(12|16)(?:x{_POSITIVE}N)?",
        "12 or 16 thrusters, sized for the base, or of a thrust: 12, 12x5N, 16x22N or 12x0.1N",
        lambda count, force: (int(count), force and float(force)),
    ),
    "panels": (
        rf"([1-4])x{_POSITIVE}kg",
        "1 to 4 panels of a mass, such as 2x5kg",
        lambda count, mass: (int(count), float(mass)),
    ),
    "tips": (
        r"([^,]+),([^,]+)",
        "the frames of two hands, such as left_hand,right_hand",
        lambda first, second: (first.strip(), second.strip()),
    ),
    "capture": (
        rf"{_NUMBER}(deg|rad)/s",
        "the rate of the target's tumble, such as 3deg/s",
        lambda rate, unit: float(rate) * (math.pi / 180.0 if unit == "deg" else 1.0),
    ),
}


@dataclasses.dataclass(frozen=True)
class WheelData:
    """A number of wheels and the values of their data sheet; None: chosen for the base."""

    count: int
    torque: float | None = None  # N m
    momentum: float | None = None  # N m s
    rpm: float | None = None  # largest speed, 1/min

    def units(self, torque: float, inertia: float | None) -> dict[str, dict[str, Any]]:
        """Return wheels by name.

        Their axes are spread evenly on a cone about z; three of them are at right angles.

        Args:
          torque: N m, if the data sheet has none.
          inertia: kg m^2, if the data sheet has no momentum; None: the default.
        """
        settings = {"torque_limit": self.torque or torque}
        if self.rpm is not None:
            settings["speed_limit"] = rounded(self.rpm * math.pi / 30.0)
        if self.momentum is not None:
            inertia = rounded(self.momentum / settings.get("speed_limit", Wheel().speed_limit))
        if inertia is not None:
            settings["inertia"] = inertia
        turn = math.pi / 4 if self.count == 4 else 0.0
        return {
            f"wheel_{k + 1}": {
                "axis": [
                    *(
                        rounded(math.sqrt(2.0) * f(turn + 2.0 * math.pi * k / self.count))
                        for f in (math.cos, math.sin)
                    ),
                    1.0,
                ],
                **settings,
            }
            for k in range(self.count)
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class Asked:
    """The parts of a new scenario; None: without the part."""

    sensors: str | None = None  # the shipped scenario that has them
    thrusters: tuple[int, float | None] | None = None  # number, thrust (N; None: by the base)
    wheels: WheelData | None = None
    panels: tuple[int, float] | None = None  # number, mass of each, kg
    capture: float | None = None  # rad/s, at which the target tumbles
    tips: tuple[str, str] | None = None  # frames of two hands
    friction: bool = False  # of the joints of the model, in their drives
    driven: tuple[str, ...] = ("all",)  # groups of coordinates

    @classmethod
    def parsed(cls, *, friction: bool = False, **words: str | None) -> "Asked":
        """Return the options of ``ffsm new`` by name; None: the option is not given.

        Raises ScenarioError: a value cannot be used.
        """
        given = {name: word.strip() for name, word in words.items() if word is not None}
        asked = cls(friction=friction, **{name: _value(name, word) for name, word in given.items()})
        for name, group in (("thrusters", "base_position"), ("wheels", "base_rotation")):
            if getattr(asked, name) is not None and not asked.drives(group):
                raise ScenarioError(
                    f"--{name}", f"cannot act with --driven {','.join(asked.driven)}: it leaves "
                    f"out {group}; leave one of them out"
                )  # fmt: skip
        return asked

    @property
    def is_paper(self) -> bool:
        """Whether no option is given, so that the mission is the one of the paper."""
        return self == Asked()

    @property
    def has_approach(self) -> bool:
        """Whether the run begins before the grasp, for a capture with all coordinates driven."""
        return self.capture is not None and self.drives("all")

    def drives(self, group: str) -> bool:
        """Whether a group of coordinates is driven."""
        return "all" in self.driven or group in self.driven

    @property
    def source(self) -> Scenario:
        """The shipped scenario that provides sensors, estimator and bandwidth."""
        found = load_scenario(self.sensors or "paper")
        grasp = load_scenario(_CAPTURE)
        # The inertia of a light wrist grows by orders of magnitude at a grasp: an estimate of
        # force outlasts that, one of acceleration does not.
        return grasp if self.capture is not None and grasp.sensing == found.sensing else found

    def milder(self) -> Iterator[tuple[str, "Asked"]]:
        """Yield requests that need less of the spacecraft, each with the words for its change."""
        if self.thrusters is not None and self.thrusters[1] is not None:
            count = self.thrusters[0]
            yield f"give --thrusters {count}", dataclasses.replace(self, thrusters=(count, None))
        if self.wheels is not None and self.wheels != (sized := WheelData(self.wheels.count)):
            yield f"give --wheels {sized.count}", dataclasses.replace(self, wheels=sized)
        for share in _SLOWER if self.capture else ():
            rate = rounded(math.degrees(share * (self.capture or 0.0)))
            slow = dataclasses.replace(self, capture=math.radians(rate))
            yield f"give --capture {rate:g}deg/s", slow
        if self.panels is not None:
            yield "leave out --panels", dataclasses.replace(self, panels=None)

    def thruster_settings(self, mass: float, box: BaseBox) -> dict[str, Any]:
        """Return the settings of the thrusters for a base of a mass (kg) in a box.

        A shipped layout with the number is scaled to the box, and is moved if the box is not about
        the origin.
        """
        count, force = self.thrusters or (0, None)
        layouts = {name: name for name in thruster_layouts() if name.startswith(f"{count}x")}
        shipped = layouts.get(f"{count}x{force:g}N") if force is not None else None
        layout = shipped or next(iter(layouts))
        force = rounded(_THRUST * mass) if force is None else force
        if np.abs(box.centre).max() <= _FITS:
            given = {"layout": layout} | ({} if shipped else {"force": force})
            fits = np.abs(box.half - _LAYOUT_BOX).max() <= _FITS
            return given | ({} if fits else {"box": [rounded(2.0 * x) for x in box.half.tolist()]})
        like = thruster_layouts()[layout]
        scale, usual = box.half / _LAYOUT_BOX, Thruster()
        units = {
            name: {
                "position": [rounded(x) for x in (box.centre + scale * unit.position).tolist()],
                "direction": [rounded(x / max(map(abs, unit.direction))) for x in unit.direction],
                **({} if force == usual.force else {"force": force}),
                **({"specific_impulse": unit.specific_impulse} if shipped else {}),
            }
            for name, unit in like.items()
        }
        return {"layout": None, "units": units}

    def fill(self, data: dict[str, Any]) -> None:
        """Fill the sections that do not depend on the spacecraft. Empty sections are left out."""
        estimator, tolerance = _own(self.source.estimator), data["tolerance"]
        if estimator or self.thrusters is None:
            data["estimator"] = estimator
        elif self.capture is not None:
            force = load_scenario(_CAPTURE).estimator
            data["estimator"] |= {"kind": force.kind, "force_walk": force.force_walk}
        if self.sensors is not None:
            data["sensing"], tolerance = _own(self.source.sensing), dict(self.source.tolerance)
        if self.thrusters is not None:
            tolerance["base_position"] = max(tolerance.get("base_position", 0.0), _TOLERANCE)
        data["tolerance"] = {} if tolerance == Scenario().tolerance else tolerance
        if not self.drives("all"):
            data["actuation"]["driven"] = list(self.driven)
        for group, key in (("base_position", "base_position"), ("base_rotation", "base_rpy")):
            if not self.drives(group):
                data["target_posture"][key] = list(data["initial_posture"][key])
        if self.wheels is not None:
            data["actuation"]["wheels"] = {"units": self.wheels.units(1.0, 1e-9)}
        if self.capture is None:
            data["capture"] = {}
            return
        data["capture"]["rate"] = [rounded(self.capture * x) for x in data["capture"]["rate"]]
        if not self.has_approach:
            data["capture"] = {"rate": data["capture"]["rate"], "servicer": "rest"}


# Options of ``ffsm new`` that are words for a field.
ASKED = tuple(each.name for each in dataclasses.fields(Asked) if each.name != "friction")


def _own(settings: Any) -> dict[str, Any]:
    """Return the settings of a section that differ from its defaults, as plain data."""
    usual, data = dataclasses.asdict(type(settings)()), dataclasses.asdict(settings)
    return {key: value for key, value in data.items() if value != usual[key]}


def _value(name: str, word: str) -> Any:
    if name in _FORMS:
        form, told, value = _FORMS[name]
        if match := re.fullmatch(form, word):
            return value(*match.groups())
        raise ScenarioError(f"--{name}", f"'{word}' must be {told}")
    driven = {",".join(sorted(groups)): groups for groups in DRIVEN[1:]}
    driven |= dict.fromkeys((",".join(sorted(DRIVEN[0])), "all"), ("all",))
    prefixes: dict[str, list[str]] = {}
    for each in shipped_scenarios():
        prefixes.setdefault(each.partition("_")[0], []).append(each)
    given: dict[str, dict[str, Any]] = {
        "sensors": {each: named for each, (named, *others) in prefixes.items() if not others},
        "driven": driven,
    }
    choices = given[name]
    key = ",".join(sorted(part.strip() for part in word.split(",")))
    if key in choices or word in choices.values():
        return choices.get(key, word)
    raise ScenarioError(f"--{name}", f"'{word}' must be one of {'; '.join(choices)}")
