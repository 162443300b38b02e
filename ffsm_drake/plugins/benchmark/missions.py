"""The benchmark's missions: where they come from, what is published, and lower bounds."""

import dataclasses
import functools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ffsm_drake.common.errors import CampaignError, choices
from ffsm_drake.common.so3 import in_body_axes
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.actuators.thrusters import STANDARD_GRAVITY, ThrusterSet
from ffsm_drake.plugins.benchmark.least_time import least_times
from ffsm_drake.plugins.capture.contact import planned_contact
from ffsm_drake.scenario import Scenario, load_scenario, thrusters_of
from ffsm_drake.scenario.strict_yaml import read_yaml
from ffsm_drake.spacecraft.free_floating import free_floating
from ffsm_drake.systems.plan import load_plan
from ffsm_drake.systems.reference import make_motion


@dataclasses.dataclass(frozen=True, kw_only=True)
class Published:
    """A published figure."""

    figure: str  # column of a campaign's results, angular_momentum or planned_time
    value: float
    source: str
    controller: str = ""  # controller of a campaign's column
    within: float = 0.0  # share of the value
    at_most: bool = False  # the figure may be anything below


@dataclasses.dataclass(frozen=True, kw_only=True)
class BenchmarkMission:
    """A scenario with its source."""

    name: str
    scenario: Scenario
    source: str = ""
    published: str = ""
    assumed: tuple[str, ...] = ()
    checks: tuple[Published, ...] = ()

    @property
    def checked_laws(self) -> tuple[str, ...]:
        """Laws with published figures; without one, the scenario's."""
        laws = dict.fromkeys(filter(None, (each.controller for each in self.checks)))
        return tuple(laws) or (self.scenario.controller,)


@functools.cache
def _listed() -> dict[str, Any]:
    text = (Path(__file__).parent / "missions.yaml").read_text(encoding="utf-8")
    return read_yaml(text)


def mission_names() -> tuple[str, ...]:
    """The missions of the benchmark."""
    return tuple(_listed())


def compared_missions() -> tuple[str, ...]:
    """The missions on which all laws are compared by default."""
    return tuple(name for name, data in _listed().items() if data.get("compared"))


def load_mission(name: str) -> BenchmarkMission:
    """A mission by name, or one of the user's own by the file of its scenario.

    Raises:
      CampaignError, ScenarioError: there is none of that name, or the scenario cannot be used.
    """
    if name in _listed():
        data = _listed()[name]
        return BenchmarkMission(
            name=name,
            scenario=load_scenario(data.get("scenario", name), data.get("overrides", ())),
            source=data["source"],
            published=data["published"],
            assumed=tuple(data["assumed"]),
            checks=tuple(Published(**each) for each in data.get("checks", ())),
        )
    if Path(name).suffix not in (".yaml", ".yml"):
        raise CampaignError(
            f"{name}: no such mission; give a scenario's file, or choose one of "
            f"{choices(name, mission_names())}"
        )
    return BenchmarkMission(name=Path(name).stem, scenario=load_scenario(name), source=name)


def bounds_of(mission: BenchmarkMission) -> dict[str, float]:
    """Least times of a mission, s (``least_times``): the bound from momentum and the actuators'
    limits, the least time at the start's posture, and the duration of an optimal plan, if there is
    one.
    """
    scenario, bounds = mission.scenario, dict[str, float]()
    flown = make_mission(scenario)
    model, start = flown.craft.nominal(), at_start(scenario)
    least = least_times(
        scenario,
        model,
        start.q,
        spin=start.momenta["base_rotation"],
        linear=start.momenta["base_position"],
    )
    if least.bound > 0.0:
        bounds["momentum"] = least.bound
    if 0.0 < least.held < math.inf:
        bounds["held"] = least.held
    if scenario.reference.kind == "optimal":
        bounds["planner"] = planned_time(scenario)
    return bounds


def planned_time(scenario: Scenario) -> float:
    """Time of the planned motion, s; of an optimal one without what its small rates take."""
    mission = make_mission(scenario)
    if scenario.reference.kind == "optimal":
        return load_plan(scenario.reference.plan or "", mission.craft.coordinates).duration
    motion = make_motion(mission)
    return float(motion.end - motion.begin)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Start:
    """Momentum to be removed, at the start or after the planned grasp."""

    # by group of the base: angular about the centre of mass, N m s, and linear, N s
    momenta: Mapping[str, np.ndarray]
    q: np.ndarray  # (nq)
    center_of_mass: np.ndarray  # (3) in the base's frame, m


def at_start(scenario: Scenario) -> _Start:
    mission = make_mission(scenario)
    model = mission.craft.nominal()
    if scenario.capture is not None:
        contact = planned_contact(mission, model)
        q, spin, linear = contact.q, contact.spin_after, contact.momentum_after[3:]
        base = free_floating(model, q)
    else:
        motion = make_motion(mission)
        q, v, _ = motion.evaluate(0.0)
        base = free_floating(model, q)
        spin, linear = base.spin_map @ v, base.momentum(v)[3:]
    return _Start(
        momenta={"base_rotation": spin, "base_position": linear},
        q=q,
        center_of_mass=in_body_axes(q[None, :4], base.center_of_mass[None])[0],
    )


def least_propellant(scenario: Scenario) -> float | None:
    """Lower bound of the propellant, kg, for thrusters to remove a mission's momentum, each in its
    best direction, about the centre of mass at the start; wheels take the angular momentum at no
    cost. None without thrusters or momentum.
    """
    settings = scenario.actuation.thrusters
    if settings is None:
        return None
    thrusters, start = ThrusterSet(settings, sample_time=scenario.sample_time), at_start(scenario)
    torques, forces = np.split(thrusters.wrenches, 2)
    torques = torques - np.cross(start.center_of_mass, forces.T).T
    exhaust = STANDARD_GRAVITY * np.array(
        [unit.specific_impulse for unit in thrusters_of(settings).values()]
    )
    least = np.linalg.norm(start.momenta["base_position"]) / exhaust.max()
    if scenario.actuation.wheels is None:
        lever = (np.linalg.norm(torques, axis=0) * exhaust).max()
        least = max(least, np.linalg.norm(start.momenta["base_rotation"]) / lever)
    return float(least) or None
