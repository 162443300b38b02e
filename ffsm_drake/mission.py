"""A scenario with its spacecraft, and what is computed from them once."""

import dataclasses
import functools
from collections.abc import Callable, Hashable
from typing import Any, Concatenate, ParamSpec, TypeVar

from ffsm_drake.common.memo import content_of
from ffsm_drake.scenario import Scenario, planned_part
from ffsm_drake.spacecraft.coordinates import Coordinates, StateSplit
from ffsm_drake.spacecraft.craft import Craft

P = ParamSpec("P")
R = TypeVar("R")
Of = Callable[Concatenate["Mission", P], R]
# sections of a scenario that a craft is made from; a block may replace the section ``actuation``
_OF_CRAFT = ("model", "payload", "actuation", "blocks")


class Mission:
    """A scenario and its spacecraft.

    It keeps the results of the functions marked ``kept`` and ``planned``. Files are read when it is
    made, or when they are first needed: a new mission notices their changes.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Raises ModelError: the model of the scenario cannot be loaded."""
        self.scenario, self.craft = scenario, Craft(scenario)
        self.results = dict[Hashable, Any]()
        self.plan = dict[Hashable, Any]()  # results that depend on the planned part alone

    def of(self, scenario: Scenario) -> "Mission":
        """Return the mission of another scenario, with this craft and these plans if the scenario
        does not change them.
        """
        if scenario is self.scenario:
            return self
        other = object.__new__(Mission)
        other.scenario, other.results = scenario, {}
        own = [content_of(getattr(self.scenario, name)) for name in _OF_CRAFT]
        is_same = own == [content_of(getattr(scenario, name)) for name in _OF_CRAFT]
        other.craft = self.craft if is_same else Craft(scenario)
        other.plan = self.plan if _plan_of(scenario) == _plan_of(self.scenario) else {}
        return other

    def flown_by(self, **changes: Any) -> "Mission":
        """``of`` the scenario with other values of some fields."""
        return self.of(dataclasses.replace(self.scenario, **changes))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class OfMission:
    """The closed loop or a run of a mission."""

    mission: Mission

    @property
    def scenario(self) -> Scenario:
        """The scenario of the mission."""
        return self.mission.scenario

    @property
    def coordinates(self) -> Coordinates:
        """Names of the known coordinates."""
        return self.mission.craft.coordinates

    @property
    def split(self) -> StateSplit:
        """Known and hidden coordinates of the true plant."""
        return self.mission.craft.split


def make_mission(given: Scenario | Mission) -> Mission:
    """Return the mission of a scenario; a mission itself. Raises ModelError: see ``Mission``."""
    return given if isinstance(given, Mission) else Mission(given)


def _plan_of(scenario: Scenario) -> Hashable:
    # own phases may read any setting
    whole = planned_part(scenario, with_target=True)
    return content_of(scenario if scenario.blocks.phases else whole)


def kept(function: Of[P, R]) -> Of[P, R]:
    """Decorate a function of a mission, whose results the mission keeps."""
    return _once(function, lambda mission: mission.results)


def planned(function: Of[P, R]) -> Of[P, R]:
    """Decorate a function of the planned part of a mission (``planned_part``), whose results all
    missions with this plan share.
    """
    return _once(function, lambda mission: mission.plan)


def _once(function: Of[P, R], results_of: Callable[[Mission], dict[Hashable, Any]]) -> Of[P, R]:
    @functools.wraps(function)
    def once(mission: Mission, /, *args: P.args, **kwargs: P.kwargs) -> R:
        results, key = results_of(mission), (function, content_of((args, kwargs)))
        if key not in results:
            results[key] = function(mission, *args, **kwargs)
        found: R = results[key]
        return found

    return once
