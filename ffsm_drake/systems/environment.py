"""Orbital forces on all bodies as one generalized force: gravity gradient, tide, solar pressure.

The world frame W falls freely with a point of a circular orbit, its origin; its axes do not turn. A
mass at p_W then feels the difference of gravity, to first order in p over the orbit's radius

  a(p) = n^2 (3 r r' - 1) p,

with the mean motion n and the unit vector r away from the attracting body, which turns at n about
the orbit's normal h. With Hill's axes r, t = h x r and h, and c_u(p) = u x (u x p), the
acceleration of p in a uniform rotation at 1 rad/s about an axis u through the origin, that is n^2
(2 c_r - c_t - c_h). So the generalized force of all bodies, with their extent, is the same sum of
three inverse dynamics (``PlantModel``).
"""

import math
from collections.abc import Iterable
from functools import partial

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from ffsm_drake.common.lifetime import weak_callback
from ffsm_drake.scenario import Environment, MassProperties, Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS
from ffsm_drake.spacecraft.nominal import PlantModel, change_payload, make_flexible_plant
from ffsm_drake.systems.actuation import own_parts
from ffsm_drake.systems.part import Part
from ffsm_drake.systems.setup import BlockSetup

EARTH_GRAVITY = 3.986004418e14  # m^3/s^2; gravitational parameter of the Earth (EGM2008)
EARTH_RADIUS = 6378136.3  # m; at the equator (EGM2008)


def mean_motion(settings: Environment) -> float:
    """Angular rate n of the circular orbit, rad/s."""
    if settings.mean_motion is not None:
        return settings.mean_motion
    return math.sqrt(EARTH_GRAVITY / (EARTH_RADIUS + (settings.altitude or 0.0)) ** 3)


class OrbitalForce:
    """The generalized force of the environment on a plant, as a function of configuration and
    time.
    """

    def __init__(self, settings: Environment, model: PlantModel) -> None:
        """Args: the environment; the plant with its masses; every call sets its context."""
        self._settings, self._model = settings, model
        self._rate = mean_motion(settings)
        self._velocity = np.zeros(model.plant.num_velocities())  # scratch pad: v of a rotation
        # R_WH at the start
        self._hill = RollPitchYaw(settings.hill_rpy).ToRotationMatrix().matrix()
        solar = settings.solar_pressure
        self._pressure, self._arm = np.zeros(3), np.zeros(3)
        if solar is not None:
            sun = np.array(solar.sun, dtype=float)
            self._pressure = (
                -solar.pressure * solar.coefficient * solar.area / np.linalg.norm(sun) * sun
            )
            self._arm = np.array(solar.center_of_pressure, dtype=float)

    def axes(self, time: float) -> np.ndarray:
        """Hill's axes in the world frame at a time in s: rows r, t, h (3, 3)."""
        c, s = math.cos(self._rate * time), math.sin(self._rate * time)
        turned: np.ndarray = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ self._hill.T
        return turned

    def calc(self, q: np.ndarray, time: float) -> np.ndarray:
        """Generalized force (nv) in a configuration q (nq) at a time in s, N m and N.

        Raises ValueError: q is not finite.
        """
        H, settings = self._model.calc_mass_matrix(q), self._settings
        if settings.gravity_gradient:
            force = self._gravity_gradient(q, H, time)
        elif settings.tidal:
            force = self._tide(H, time)
        else:
            force = np.zeros(len(H))
        if settings.solar_pressure is not None:
            R_WB = RotationMatrix(Quaternion(q[:4] / np.linalg.norm(q[:4]))).matrix()
            force[:3] += np.cross(R_WB @ self._arm, self._pressure)
            force[3:6] += self._pressure
        return force

    def _center_of_mass(self) -> np.ndarray:
        """In the world frame (3), m."""
        center: np.ndarray = self._model.plant.CalcCenterOfMassPositionInWorld(self._model.context)
        return center

    def _gravity_gradient(self, q: np.ndarray, H: np.ndarray, time: float) -> np.ndarray:
        """About the centre of mass; with the tide about the origin, which gives both."""
        plant, context, axes = self._model.plant, self._model.context, self.axes(time)
        center = np.zeros(3) if self._settings.tidal else self._center_of_mass()
        x, y, z = (q[4:NUM_BASE_POSITIONS] - center).tolist()
        arm = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])  # arm x
        across = -axes @ arm.T  # axis x arm
        force, acceleration = np.zeros(len(H)), np.zeros(3)
        for axis, velocity, share in zip(axes, across, (2.0, -1.0, -1.0), strict=True):
            self._velocity[:3], self._velocity[3:6] = axis, velocity
            plant.SetVelocities(context, self._velocity)
            force += share * plant.CalcBiasTerm(context)
            acceleration += share * (axis * axis.dot((x, y, z)) - (x, y, z))
        return self._rate * self._rate * (force + H[:, 3:6] @ acceleration)

    def _tide(self, H: np.ndarray, time: float) -> np.ndarray:
        """On the centre of mass, as if the mass stood there."""
        axes, center = self.axes(time), self._center_of_mass()
        acceleration = 3.0 * axes[0] * axes[0].dot(center) - center
        return self._rate * self._rate * (H[:, 3:6] @ acceleration)


class EnvironmentForce(LeafSystem):
    """The environment's force in the closed loop, held over each control sample.

    Inputs:
      state: known [q; v] (nq + nv) of the plant.
      hidden_state: state of the hidden coordinates, if there are any.
    Outputs:
      generalized_force: (nv), held.
      next_generalized_force: the force at this instant, for the record.
      hidden_force, next_hidden_force: the same, on hidden coordinates.
    The held force is that at the middle of the sample, extrapolated linearly from the sample's
    start and the one before: it is off by 3/8 of its second difference. State (discrete, period
    ``sample_time``): the held force (nv, then the hidden ones), and the whole force at the last
    sample. Parameter: the payload's mass, centre of mass and inertia (10), as ``MassProperties``.
    """

    def __init__(self, scenario: Scenario, model: PlantModel) -> None:
        """Args: a scenario with an environment; a plant for the system's own use, with the true
        payload.
        """
        super().__init__()
        self._model, self._scenario = model, scenario
        self._force = OrbitalForce(scenario.environment or Environment(), model)
        self._held_payload = _packed(scenario.payload.truth)
        whole, hidden = model.plant.num_velocities(), len(model.split.names)
        self._state = self.DeclareVectorInputPort(
            "state", model.plant.num_multibody_states() - 2 * hidden
        )
        self._hidden_state = (
            self.DeclareVectorInputPort("hidden_state", 2 * hidden) if hidden else None
        )
        self._acting = self.DeclareDiscreteState(np.zeros(whole - hidden))
        self._acting_hidden = self.DeclareDiscreteState(np.zeros(hidden))
        self._last = self.DeclareDiscreteState(np.zeros(whole))
        self._payload = self.DeclareNumericParameter(BasicVector(self._held_payload))
        depends = {self.all_input_ports_ticket(), self.time_ticket(), self.all_parameters_ticket()}
        self._instant = self.DeclareVectorOutputPort(
            "whole_force", whole, weak_callback(self._calc_whole), depends
        )
        now = weak_callback(self._calc_now)
        self.DeclareStateOutputPort("generalized_force", self._acting)
        self.DeclareVectorOutputPort(
            "next_generalized_force", whole - hidden, partial(now, 0), depends
        )
        if hidden:
            self.DeclareStateOutputPort("hidden_force", self._acting_hidden)
            self.DeclareVectorOutputPort("next_hidden_force", hidden, partial(now, 1), depends)
        period = scenario.sample_time
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, weak_callback(self._update))

    def set_payload(self, context: Context, properties: MassProperties) -> None:
        """Give the payload other mass properties."""
        context.get_mutable_numeric_parameter(self._payload).SetFromVector(_packed(properties))

    def set_initial_state(self, context: Context, state: np.ndarray) -> None:
        """Begin at a known state [q; v] (nq + nv) of the plant."""
        force = self._calc(context, self._model.split.whole(state))
        for group, part in self._groups(force, force):
            context.SetDiscreteState(group, part)

    def _groups(self, acting: np.ndarray, last: np.ndarray) -> Iterable[tuple[int, np.ndarray]]:
        """The values of each group of the state."""
        groups = (self._acting, self._acting_hidden, self._last)
        return zip(groups, (*self._split(acting), last), strict=True)

    def _split(self, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hidden = self._model.split
        return hidden.known_velocities(force), force[hidden.hidden]

    def _calc(self, context: Context, state: np.ndarray) -> np.ndarray:
        payload = context.get_numeric_parameter(self._payload).value()
        if not np.array_equal(payload, self._held_payload):
            mass, center, inertia = float(payload[0]), payload[1:4].tolist(), payload[4:].tolist()
            properties = MassProperties(mass=mass, center_of_mass=center, inertia=inertia)
            change_payload(self._model.plant, self._model.context, self._scenario, properties)
            self._held_payload = payload.copy()
        return self._force.calc(state[: self._model.plant.num_positions()], context.get_time())

    def _calc_whole(self, context: Context, output: BasicVector) -> None:
        deflected = None if self._hidden_state is None else self._hidden_state.Eval(context)
        output.SetFromVector(
            self._calc(context, self._model.split.whole(self._state.Eval(context), deflected))
        )

    def _calc_now(self, part: int, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._split(self._instant.Eval(context))[part])

    def _update(self, context: Context, values: DiscreteValues) -> None:
        force = self._instant.Eval(context)
        last = context.get_discrete_state(self._last).value()
        for group, part in self._groups(force + 0.5 * (force - last), force):
            values.set_value(group, part)


class OrbitalEnvironment(Part):
    """The section ``environment`` of a scenario."""

    title = "Environment"

    @classmethod
    def of(cls, scenario: Scenario) -> "OrbitalEnvironment | None":
        """That of a scenario."""
        return None if scenario.environment is None else cls()

    def build(self, setup: BlockSetup) -> EnvironmentForce:
        """The force on all that has mass."""
        locked = setup.scenario
        for part in own_parts(locked):
            locked = part.locked(locked)
        return EnvironmentForce(setup.scenario, make_flexible_plant(locked))


def _packed(properties: MassProperties) -> np.ndarray:
    """[mass, centre of mass, Ixx, Iyy, Izz, Ixy, Ixz, Iyz] (10)."""
    inertia = (*properties.inertia, 0.0, 0.0, 0.0)[:6]
    return np.array([properties.mass, *properties.center_of_mass, *inertia], dtype=float)
