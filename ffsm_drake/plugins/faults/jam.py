"""Jammed joints: at rest under any force of their drives."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ffsm_drake.common.choice import is_known, may_be
from ffsm_drake.loop.blocks import JAM
from ffsm_drake.scenario import FaultKind, MassProperties, Scenario
from ffsm_drake.scenario.contacts import closing_contacts
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates, halves
from ffsm_drake.spacecraft.craft import Craft
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.faults import BreakingPart, hits
from ffsm_drake.systems.sampled import Arrays
from ffsm_drake.systems.setup import BlockSetup

_STOPS_IN = 0.02  # s, time constant of the rate as a joint jams
_ROUNDING = 1e-9  # s, of the times of samples
JAMMED = FaultKind(
    name="jammed",
    effect="the joint stops within about 0.02 s and stays at rest under any torque",
)


class JammedJoints(BreakingPart):
    """Joints affected by ``faults``."""

    title, fails_as, fault_kinds = "Jammed joints", "joints", (JAMMED,)

    @classmethod
    def failing_units(cls, scenario: Scenario, coordinates: Coordinates) -> Iterable[str]:
        """Every joint."""
        return coordinates.joints

    def build(self, setup: BlockSetup) -> "Jam | SolvedJam":
        """The force of the jam. Contacts that close loops compute it with their own."""
        if closing_contacts(setup.scenario, setup.grip):
            return SolvedJam(size=len(setup.coordinates.names), hidden=len(setup.split.names))
        model = setup.craft.flexible(setup.grip)
        return Jam(model=model, craft=setup.craft, joints=self.joints(setup))

    @staticmethod
    def joints(setup: BlockSetup) -> "Jammed":
        """The joints, and when they jam."""
        scenario, coordinates, step = setup.scenario, setup.coordinates, setup.sample_time
        found = hits(scenario, JammedJoints.fails_as)
        jammed = [name for name in coordinates.joints if name in {hit.unit for hit in found}]
        split, nv = setup.craft.split, len(coordinates.names)
        entries = [NUM_BASE_VELOCITIES + coordinates.joints.index(name) for name in jammed]
        joints = np.array([split.whole_velocities(np.eye(nv)[each]) for each in entries]).T
        return Jammed(
            directions=joints,
            of=np.array([[float(name == hit.unit) for hit in found] for name in jammed]),
            since=step * np.array([float(hit.occurs.first) for hit in found]),
            lasts=step * np.array([float(hit.occurs.samples) for hit in found]),
            period=step * np.array([float(hit.occurs.period) for hit in found]),
        )


def jammed_joints(setup: BlockSetup) -> "Jammed | None":
    """Return the joints that jam, for the contacts that close loops; None: none does."""
    return None if JammedJoints.of(setup.scenario) is None else JammedJoints.joints(setup)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Jammed:
    """The joints that jam, and when. A jammed joint's rate decays with a time constant of 0.02 s:
    J dv/dt = -J v / T.
    """

    directions: np.ndarray  # (plant's velocities, n) J' of the joints
    of: np.ndarray  # (n, m) 1: the fault is of the joint
    since: np.ndarray  # (m) first times of the faults, s
    lasts: np.ndarray  # (m) how long each lasts, s
    period: np.ndarray  # (m) time from one beginning to the next, s

    def at(self, time: np.ndarray) -> tuple[np.ndarray, Any]:
        """J' of the joints that may be jammed at a time (1), s, and whether they are."""
        elapsed = time - self.since + _ROUNDING
        are_there = (elapsed > 0.0) & (np.remainder(elapsed, self.period) < self.lasts)
        held: Any = (self.of * np.where(are_there, 1.0, 0.0)).sum(axis=1) > 0.0
        if is_known(held):
            return self.directions[:, held], held[held]
        return self.directions, held

    @staticmethod
    def stop(rates: np.ndarray) -> np.ndarray:
        """The accelerations that stop joints with these rates."""
        return -rates / _STOPS_IN


@dataclasses.dataclass(frozen=True, kw_only=True)
class SolvedJam(Continuous):
    """The force on jammed joints where contacts close loops: one solve gives both.

    Inputs: ``other_force`` (plant's nv), ``jam_force`` (nv). Output: ``generalized_force`` (nv).
    """

    size: int  # nv
    hidden: int  # number of hidden coordinates

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Continuous."""
        return {"other_force": self.size + self.hidden, JAM: self.size}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Continuous."""
        return {"generalized_force": self.size}

    def flow(self, inputs: Arrays, state: Arrays) -> tuple[Arrays, Arrays]:
        """See Continuous."""
        return {"generalized_force": inputs[JAM]}, {}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Jam(Continuous):
    """The exact constraint force on jammed joints: it cancels their part of the plant's
    acceleration under all other forces.

    It acts between two links and is finite, so the total momentum is conserved as a jam begins,
    lasts and ends, and no velocity jumps. The joint is at rest as a jam ends.

    Inputs: ``state`` (nq + nv), ``hidden_state``, ``other_force`` (plant's nv),
    ``time``. Output: ``generalized_force`` (nv).
    """

    model: PlantModel
    craft: Craft
    joints: Jammed

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Continuous."""
        nv, hidden = len(self.model.coordinates.names), len(self.model.split.names)
        sizes = {"state": 2 * nv + 1, "hidden_state": 2 * hidden, "time": 1}
        sizes["other_force"] = nv + hidden
        return {name: size for name, size in sizes.items() if size}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Continuous."""
        return {"generalized_force": len(self.model.coordinates.names)}

    def with_payload(self, properties: MassProperties) -> "Jam":
        """See InstantSystem."""
        return dataclasses.replace(self, model=self.craft.loaded(self.model, properties))

    def flow(self, inputs: Arrays, state: Arrays) -> tuple[Arrays, Arrays]:
        """See Continuous."""
        joints, are_held = self.joints.at(inputs["time"])
        force = 0.0 * inputs["other_force"]
        if may_be(are_held):
            force = joints @ self._along(inputs, joints, are_held)
        return {"generalized_force": self.model.split.known_velocities(force)}, {}

    def _along(self, inputs: Arrays, joints: np.ndarray, are_held: Any) -> np.ndarray:
        """The force (n) along joints that are jammed, or may be."""
        model, split = self.model, self.model.split
        q, v = halves(split.whole(inputs["state"], inputs.get("hidden_state")))
        acceleration = model.calc_acceleration(q, v, inputs["other_force"])
        inverse = joints.T @ np.linalg.solve(model.calc_mass_matrix(q), joints)
        without = np.eye(len(are_held))
        inverse = np.where(are_held[:, None], np.where(are_held, inverse, without), without)
        stops = -(joints.T @ acceleration) + self.joints.stop(joints.T @ v)
        along: np.ndarray = np.linalg.solve(inverse, np.where(are_held, stops, 0.0))
        return along
