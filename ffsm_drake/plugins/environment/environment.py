"""Orbital forces on all bodies as one generalized force: gravity gradient, tide, solar pressure.

The world frame W falls freely with a point of a circular orbit, its origin; its axes do not turn. A
mass at p_W then feels the difference of gravity, to first order in p over the orbit's radius

  a(p) = n^2 (3 r r' - 1) p,

with the mean motion n and the unit vector r away from the attracting body; r turns at n about
the orbit's normal h. With Hill's axes r, t = h x r and h, and c_u(p) = u x (u x p), the
acceleration of p in a uniform rotation at 1 rad/s about an axis u through the origin, that is n^2
(2 c_r - c_t - c_h). So the generalized force of all bodies, with their extent, is the same sum of
three inverse dynamics (``PlantModel``).
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from ffsm_drake.common.products import applied
from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.scenario import Environment, MassProperties, Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS
from ffsm_drake.spacecraft.craft import Craft
from ffsm_drake.spacecraft.free_floating import center_of_mass
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.orbit import Orbit, turned_axes
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.registry import base_actuators
from ffsm_drake.systems.sampled import NEXT, Arrays, Now, Sampled
from ffsm_drake.systems.setup import BlockSetup

_POSITION = slice(4, NUM_BASE_POSITIONS)  # p_WB in q
_SHARES = np.array([2.0, -1.0, -1.0])  # weights of the rotations about r, t, h
# a -> the matrix of a x (.), its rows one after another
_CROSS = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0],
        [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    ]
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class OrbitalForce:
    """The generalized force of the environment on a plant, as a function of configuration and time;
    ``orbital_force`` makes it.
    """

    model: PlantModel  # the plant with its masses; every call sets its context
    rate: np.ndarray  # () mean motion, rad/s
    axes: np.ndarray  # (3, 3) Hill's axes at the start
    gravity_gradient: bool
    tidal: bool
    lit: bool  # by the sun
    pressure: np.ndarray  # (3) force of sunlight, N
    arm: np.ndarray  # (3) the centre of pressure from the base's origin, its axes, m

    def calc(self, q: np.ndarray, time: Any) -> np.ndarray:
        """Generalized force (nv) in a configuration q (nq) at a time in s, N m and N.

        Raises ValueError: q is not finite.
        """
        H = self.model.calc_mass_matrix(q)
        if self.gravity_gradient:
            force = self._gravity_gradient(q, H, time)
        elif self.tidal:
            force = self._tide(q, H, time)
        else:
            force = np.zeros_like(H[0])
        if self.lit:
            torque = np.cross(matrix_of(q[:4]) @ self.arm, self.pressure)
            rest = np.zeros_like(force[6:])
            force = force + np.concatenate([torque, self.pressure, rest])
        return force

    def _gravity_gradient(self, q: np.ndarray, H: np.ndarray, time: Any) -> np.ndarray:
        """About the centre of mass; with the tide about the origin, which gives both."""
        axes = turned_axes(self.axes, self.rate, time)
        arm = q[_POSITION] if self.tidal else -center_of_mass(H)
        across = applied((axes @ _CROSS).reshape(9, 3), arm)  # axis x arm, one after another
        force, rest = np.zeros_like(H[0]), np.zeros_like(H[0, 6:])
        for i, share in enumerate(_SHARES):
            velocity = np.concatenate([axes[i], across[3 * i : 3 * i + 3], rest])
            force = force + share * self.model.calc_bias(q, velocity)
        acceleration = applied((axes.T * _SHARES) @ axes, arm)
        return self.rate * self.rate * (force + applied(H[:, 3:6], acceleration))

    def _tide(self, q: np.ndarray, H: np.ndarray, time: Any) -> np.ndarray:
        """On the centre of mass, as if the mass stood there."""
        radial = turned_axes(self.axes, self.rate, time)[0]
        center = q[_POSITION] + center_of_mass(H)
        acceleration = applied(3.0 * np.outer(radial, radial) - np.eye(3), center)
        return self.rate * self.rate * applied(H[:, 3:6], acceleration)


def orbital_force(settings: Environment, model: PlantModel) -> OrbitalForce:
    """Return the force of an environment on a plant."""
    orbit, solar, pressure, arm = (
        Orbit.of(settings),
        settings.solar_pressure,
        np.zeros(3),
        np.zeros(3),
    )
    if solar is not None:
        sun = np.array(solar.sun, dtype=float)
        pressure = -solar.pressure * solar.coefficient * solar.area / np.linalg.norm(sun) * sun
        arm = np.array(solar.center_of_pressure, dtype=float)
    return OrbitalForce(
        model=model, rate=orbit.rate, axes=orbit.first, tidal=settings.tidal,
        gravity_gradient=settings.gravity_gradient, lit=solar is not None, pressure=pressure,
        arm=arm,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvironmentForce(Sampled):
    """The environment's force in the closed loop, held over each control sample.

    Inputs: ``state``, known [q; v] (nq + nv) of the plant, and ``hidden_state``, if there are
    hidden coordinates. Outputs: ``generalized_force`` (nv), to be held, and
    ``next_generalized_force``, the force at this instant; likewise ``hidden_force``. The held force
    is that at the middle of the sample, extrapolated linearly from the sample's start and the one
    before: it is off by 3/8 of its second difference. Memory: the whole force at the last sample.
    """

    force: OrbitalForce
    craft: Craft

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        nv, hidden = self._sizes
        return {"state": 2 * nv + 1} | ({"hidden_state": 2 * hidden} if hidden else {})

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        sizes = dict(zip(("generalized_force", "hidden_force"), self._sizes, strict=True))
        each = [(name, size) for name, size in sizes.items() if size]
        return dict(each) | {NEXT + name: size for name, size in each}

    @property
    def _sizes(self) -> tuple[int, int]:
        """Numbers of known and hidden velocities."""
        return len(self.force.model.coordinates.names), len(self.force.model.split.names)

    def with_payload(self, properties: MassProperties) -> "EnvironmentForce":
        """See Sampled."""
        model = self.craft.loaded(self.force.model, properties)
        return dataclasses.replace(self, force=dataclasses.replace(self.force, model=model))

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled; before the start the force was that of the state."""
        split = self.force.model.split
        if state is None:
            return {"last": np.zeros(sum(self._sizes))}
        return {"last": self._calc(split.whole(state), 0.0)}

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        split = self.force.model.split
        whole = split.whole(inputs["state"], inputs.get("hidden_state"))
        force = self._calc(whole, now.time)
        held, outputs = force + 0.5 * (force - memory["last"]), dict[str, Any]()
        for before, values in (("", held), (NEXT, force)):
            outputs[f"{before}generalized_force"] = split.known_velocities(values)
            outputs[f"{before}hidden_force"] = values[split.hidden]
        return {name: outputs[name] for name in self.outputs}, {"last": force}

    def _calc(self, state: np.ndarray, time: Any) -> np.ndarray:
        return self.force.calc(state[: sum(self._sizes) + 1], time)


class OrbitalEnvironment(Part):
    """The section ``environment`` of a scenario."""

    title = "Environment"

    @classmethod
    def of(cls, scenario: Scenario) -> "OrbitalEnvironment | None":
        """The orbital environment of a scenario."""
        return None if scenario.environment is None else cls()

    def build(self, setup: BlockSetup) -> EnvironmentForce:
        """The force on all that has mass."""
        locked = setup.scenario
        for part in base_actuators(locked).values():
            locked = part.locked(locked)
        craft = setup.mission.of(locked).craft
        force = orbital_force(locked.environment or Environment(), craft.flexible(setup.grip))
        return EnvironmentForce(force=force, craft=craft)
