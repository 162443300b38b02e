"""The plain data of a new scenario, and what follows from it."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ffsm_drake.mission import Mission
from ffsm_drake.plugins.design.rounding import readable
from ffsm_drake.plugins.design.stability import Margins
from ffsm_drake.plugins.design.stability.planned_dynamics import PlannedDynamics, from_grasp
from ffsm_drake.plugins.new.asked import Asked
from ffsm_drake.plugins.new.urdf.servicer import Servicer
from ffsm_drake.scenario import Grip, Scenario, scenario_from_dict
from ffsm_drake.spacecraft.craft import Craft
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.mission_limits import actuation_limit

_HOLD, _LONG_HOLD = 5.0, 20.0  # s, the target posture is held; with real sensors or actuators
_RATE, _SHARE_OF_VELOCITY = {"rad": 0.1, "m": 0.05}, 0.2  # rad/s, m/s; of the URDF's limits
_FROM_FILES = ("payload", "limit", "coulomb_friction", "viscous_friction")  # keys


class Draft:
    """The plain data of a scenario, filled step by step; ``remarks`` list what cannot be met."""

    def __init__(
        self, data: dict[str, Any], asked: Asked, servicer: Servicer, source: str, *, seed: int = 0
    ) -> None:
        """See the attributes. Another seed draws other postures."""
        self.data, self.asked, self.servicer, self.source = data, asked, servicer, source
        self.seed = seed
        self.remarks, self.margins = list[str](), dict[str, Margins]()
        self.is_held = True  # by all hands
        self.touching = ""  # the parts that no posture and approach found keeps clear
        if servicer.normal is not None:
            initial = self.data["initial_posture"]
            initial["base_position"][servicer.normal] = 0.0
            for k in {0, 1, 2} - {servicer.normal}:
                initial["base_rpy"][k] = 0.0
        self.peaks = np.zeros(0)  # (nv) forces of motion and disturbance
        craft = Craft(self.scenario)
        self.true, self.coordinates = craft.true(), craft.coordinates

    @property
    def scenario(self) -> Scenario:
        """The present scenario."""
        return self.with_sections()

    @property
    def mission(self) -> Mission:
        """The present scenario with its spacecraft."""
        return Mission(self.scenario)

    def with_sections(self, **changes: Any) -> Scenario:
        """Return the present scenario with other sections, without empty ones."""
        before = self.data["capture"]["approach"]["duration"] if self.asked.has_approach else 0.0
        hold = _HOLD if self.asked.is_paper else _LONG_HOLD
        self.data["duration"] = before + self.data["reference"]["duration"] + hold
        sections = {key: each for key, each in {**self.data, **changes}.items() if each != {}}
        return scenario_from_dict(_written(sections), source=self.source)

    @property
    def written(self) -> dict[str, Any]:
        """The plain data for the file. ``scenario`` is made from the same numbers."""
        return _written(self.data)

    def rate_of(self, name: str) -> float:
        """Return the moderate rate of a joint, rad/s or m/s."""
        joint = next(each for each in self.servicer.joints if each.name == name)
        return min(_RATE[joint.unit], _SHARE_OF_VELOCITY * joint.velocity)

    @property
    def limit(self) -> np.ndarray:
        """Largest forces (nv) of the actuators that are available in every direction, N m or N."""
        return actuation_limit(self.scenario, self.coordinates).upper

    @property
    def disturbance(self) -> np.ndarray:
        """Largest force (nv) of the disturbance, N m or N."""
        harmonics = self.data["disturbance"]["harmonics"].items()
        largest = {name: each["amplitude"] for name, each in harmonics}  # a coordinate or group
        return self.coordinates.vector(largest, key="disturbance", default=0.0)

    def planned(self, **changes: Any) -> PlannedDynamics:
        """Return the motion after the grasp, without disturbance."""
        return PlannedDynamics(*from_grasp(Mission(self.with_sections(disturbance={}, **changes))))

    def at_postures(self, grip: Grip) -> Iterator[np.ndarray]:
        """Yield the mass matrices (nv, nv) in the postures, with the target or without."""
        model = self.mission.craft.true(grip)
        for key, each in self.scenario.postures.items():
            yield model.calc_mass_matrix(configuration(model.coordinates, each, key=key))


def _written(data: dict[str, Any]) -> dict[str, Any]:
    """Data with few digits, except the numbers from model files."""
    found: dict[str, Any] = readable(data, kept=_FROM_FILES)
    return found
