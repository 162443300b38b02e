"""A scenario with its spacecraft, and what is computed from them once."""

import dataclasses
import functools
import threading
from collections.abc import Callable, Hashable
from typing import Any, Concatenate, ParamSpec, TypeVar

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.memo import content_of
from ffsm_drake.scenario import Scenario, planned_part
from ffsm_drake.spacecraft.coordinates import Coordinates, StateSplit
from ffsm_drake.spacecraft.craft import Craft

P = ParamSpec("P")
R = TypeVar("R")
Of = Callable[Concatenate["Mission", P], R]
# sections of a scenario that a craft is made from; a block may replace the section ``actuation``
_OF_CRAFT = ("model", "payload", "actuation", "blocks", "effects")
_MOST = 64  # results kept of a mission, or of a plan
_LAST = threading.local()  # the mission that ``make_mission`` made last


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
        self._contents = _contents_of(scenario)

    def of(self, scenario: Scenario) -> "Mission":
        """Return the mission of another scenario, with this craft and these plans if the scenario
        does not change them.
        """
        if scenario is self.scenario:
            return self
        other = object.__new__(Mission)
        other.scenario, other.results = scenario, {}
        other._contents = (of_craft, of_plan, _) = _contents_of(scenario)
        other.craft = self.craft if of_craft == self._contents[0] else Craft(scenario)
        other.plan = self.plan if of_plan == self._contents[1] else {}
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
    """Return the mission of a scenario; a mission itself.

    It has the plans of the mission made last in this thread, if neither the scenario nor the files
    of its model change them.

    Raises:
      ModelError: see ``Mission``.
      ScenarioError: the scenario of a given mission has been changed.
    """
    if isinstance(given, Mission):
        if content_of(given.scenario) != given._contents[-1]:  # kept results are of the old one
            raise ScenarioError("scenario", "changed after its mission was made; make a new one")
        return given
    mission = Mission(given)
    last = getattr(_LAST, "mission", mission)
    # the file of a plan, or the code of own phases, may have changed
    is_settled = given.reference.kind != "optimal" and not given.blocks.phases
    has_same_files = last.craft.rigid is mission.craft.rigid
    if is_settled and has_same_files and last._contents[1] == mission._contents[1]:
        mission.plan = last.plan
    _LAST.mission = mission
    return mission


def _contents_of(scenario: Scenario) -> tuple[Hashable, Hashable, Hashable]:
    """Return what the craft of a scenario depends on, what its plans do, and all of it."""
    drawn = scenario.effects != type(scenario.effects)() and scenario.random_seed
    of_craft = content_of([*(getattr(scenario, name) for name in _OF_CRAFT), drawn])
    # own phases may read any setting
    part = scenario if scenario.blocks.phases else planned_part(scenario, with_target=True)
    return of_craft, content_of(part), content_of(scenario)


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
            made = function(mission, *args, **kwargs)
            if len(results) >= _MOST:
                del results[next(iter(results))]
            results[key] = made
        found: R = results[key]
        return found

    return once
