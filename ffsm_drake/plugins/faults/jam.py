"""Jammed joints: at rest under any force of their drives."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ffsm_drake.common.choice import is_known, may_be
from ffsm_drake.scenario import MassProperties, Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates, halves
from ffsm_drake.spacecraft.nominal import Carrier, PlantModel, make_flexible_plant
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.faults import BreakingPart, first_sample, hits
from ffsm_drake.systems.sampled import Arrays
from ffsm_drake.systems.setup import BlockSetup

_STOPS_IN = 0.02  # s, time constant of the rate as a joint jams


class JammedJoints(BreakingPart):
    """Joints affected by ``faults``."""

    title, hit_as = "Jammed joints", "joints"

    @classmethod
    def known_faults(cls, scenario: Scenario, coordinates: Coordinates) -> Mapping[str, list[str]]:
        """Any joint may jam."""
        return {f"joints.{name}": ["jammed"] for name in coordinates.joints}

    def build(self, setup: BlockSetup) -> "Jam":
        """The force of the jam."""
        scenario, coordinates = setup.scenario, setup.coordinates
        model, since = make_flexible_plant(scenario, setup.grip), dict[str, float]()
        order = coordinates.joints.index
        for name, fault in sorted(hits(scenario, "joints"), key=lambda hit: order(hit[0])):
            time = first_sample(fault, setup.sample_time) * setup.sample_time
            since[name] = min(time, since.get(name, math.inf))
        entries = [NUM_BASE_VELOCITIES + coordinates.joints.index(name) for name in since]
        nv = len(coordinates.names)
        joints = np.array([model.split.whole_velocities(np.eye(nv)[each]) for each in entries]).T
        times = np.array(list(since.values()))
        return Jam(model=model, carrier=Carrier(scenario), joints=joints, since=times)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Jam(Continuous):
    """The exact constraint force on jammed joints: it cancels their part of the plant's
    acceleration under all other forces.

    Inputs: ``state`` (nq + nv), ``hidden_state``, ``other_force`` (nv), ``time``. Output:
    ``generalized_force`` (nv).
    """

    model: PlantModel
    carrier: Carrier
    joints: np.ndarray  # (plant's velocities, n) directions of the joints
    since: np.ndarray  # (n) times of their jams, s

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Continuous."""
        nv, hidden = len(self.model.coordinates.names), len(self.model.split.names)
        sizes = {"state": 2 * nv + 1, "hidden_state": 2 * hidden, "other_force": nv, "time": 1}
        return {name: size for name, size in sizes.items() if size}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Continuous."""
        return {"generalized_force": len(self.model.coordinates.names)}

    def with_payload(self, properties: MassProperties) -> "Jam":
        """See InstantSystem."""
        return dataclasses.replace(self, model=self.carrier.loaded(self.model, properties))

    def flow(self, inputs: Arrays, state: Arrays) -> tuple[Arrays, Arrays]:
        """See Continuous."""
        are_held, force = inputs["time"] > self.since - 1e-9, np.zeros_like(inputs["other_force"])
        if not may_be(are_held):
            return {"generalized_force": force}, {}
        joints = self.joints
        if is_known(are_held):
            joints, are_held = joints[:, are_held], are_held[are_held]
        force = self.model.split.known_velocities(joints @ self._along(inputs, joints, are_held))
        return {"generalized_force": force}, {}

    def _along(self, inputs: Arrays, joints: np.ndarray, are_held: Any) -> np.ndarray:
        """The force (n) along joints that are jammed, or may be."""
        model, split = self.model, self.model.split
        q, v = halves(split.whole(inputs["state"], inputs.get("hidden_state")))
        acceleration = model.calc_acceleration(q, v, split.whole_velocities(inputs["other_force"]))
        inverse = joints.T @ np.linalg.solve(model.calc_mass_matrix(q), joints)
        without = np.eye(len(are_held))
        inverse = np.where(are_held[:, None], np.where(are_held, inverse, without), without)
        stops = -(joints.T @ acceleration) - (joints.T @ v) / _STOPS_IN
        along: np.ndarray = np.linalg.solve(inverse, np.where(are_held, stops, 0.0))
        return along
