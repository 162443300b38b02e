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

from collections.abc import Iterable, Sequence
from functools import partial

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from ffsm_drake.common.lifetime import weak_callback
from ffsm_drake.common.products import applied
from ffsm_drake.scenario import Environment, MassProperties, Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS
from ffsm_drake.spacecraft.copies import CopiesModel, copies_of
from ffsm_drake.spacecraft.free_floating import FreeFloating
from ffsm_drake.spacecraft.nominal import PlantModel, change_payload, make_flexible_plant
from ffsm_drake.spacecraft.orbit import Orbit
from ffsm_drake.systems.part import Part
from ffsm_drake.systems.registry import own_actuators
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


class OrbitalForce:
    """The generalized force of the environment on a plant, or on several copies of it, as a
    function of configuration and time.
    """

    def __init__(self, settings: Environment, model: PlantModel) -> None:
        """Args:
        settings: the environment.
        model: the plant with its masses; every call sets its context.
        """
        self._settings, self._model = settings, model
        self._orbit = Orbit(settings)
        self._rate = self._orbit.rate
        self._velocity = np.zeros(model.plant.num_velocities())  # scratch pad: v of rotations
        solar = settings.solar_pressure
        self._pressure, self._arm = np.zeros(3), np.zeros(3)
        if solar is not None:
            sun = np.array(solar.sun, dtype=float)
            self._pressure = (
                -solar.pressure * solar.coefficient * solar.area / np.linalg.norm(sun) * sun
            )
            self._arm = np.array(solar.center_of_pressure, dtype=float)

    def calc(self, q: np.ndarray, time: float) -> np.ndarray:
        """Generalized force (..., nv) in configurations q (..., nq) at a time in s, N m and N.

        Raises ValueError: q is not finite.
        """
        H, settings = self._model.calc_mass_matrix(q), self._settings
        if settings.gravity_gradient:
            force = self._gravity_gradient(q, H, time)
        elif settings.tidal:
            force = self._tide(q, H, time)
        else:
            force = np.zeros(H.shape[:-1])
        if settings.solar_pressure is not None:
            arm = np.array([self._turned_arm(each) for each in q.reshape(-1, q.shape[-1])])
            force[..., :3] += np.cross(arm, self._pressure).reshape(force[..., :3].shape)
            force[..., 3:6] += self._pressure
        return force

    def _turned_arm(self, q: np.ndarray) -> np.ndarray:
        """The centre of pressure (3) from the base's origin, world axes, m."""
        R_WB = RotationMatrix(Quaternion(q[:4] / np.linalg.norm(q[:4]))).matrix()
        turned: np.ndarray = R_WB @ self._arm
        return turned

    def _gravity_gradient(self, q: np.ndarray, H: np.ndarray, time: float) -> np.ndarray:
        """About the centre of mass; with the tide about the origin, which gives both."""
        plant, context, axes = self._model.plant, self._model.context, self._orbit.axes(time)
        arm = q[..., _POSITION] if self._settings.tidal else -_center_of_mass(H)
        across = applied((axes @ _CROSS).reshape(9, 3), arm)  # axis x arm, one after another
        velocity, force = self._velocity.reshape(H.shape[:-1]), np.zeros(H.shape[:-1])
        for i, share in enumerate(_SHARES):
            velocity[..., :3], velocity[..., 3:6] = axes[i], across[..., 3 * i : 3 * i + 3]
            plant.SetVelocities(context, self._velocity)
            force += share * plant.CalcBiasTerm(context).reshape(force.shape)
        acceleration = applied((axes.T * _SHARES) @ axes, arm)
        return self._rate * self._rate * (force + applied(H[..., 3:6], acceleration))

    def _tide(self, q: np.ndarray, H: np.ndarray, time: float) -> np.ndarray:
        """On the centre of mass, as if the mass stood there."""
        radial, center = self._orbit.axes(time)[0], q[..., _POSITION] + _center_of_mass(H)
        acceleration = applied(3.0 * np.outer(radial, radial) - np.eye(3), center)
        return self._rate * self._rate * applied(H[..., 3:6], acceleration)


def _center_of_mass(mass_matrix: np.ndarray) -> np.ndarray:
    """Vector from the base's origin to the centre of mass (..., 3), world axes, m."""
    spacecraft = FreeFloating(
        mass_matrix=mass_matrix, base_position=np.empty(0), driven=np.empty(0, dtype=int)
    )
    return spacecraft.center_of_mass


class EnvironmentForce(LeafSystem):
    """The environment's force in the closed loop, held over each control sample, on one spacecraft
    or several copies of it.

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
    Each holds copy after copy.
    """

    def __init__(self, scenarios: Sequence[Scenario], model: PlantModel) -> None:
        """Args:
        scenarios: a scenario of each copy, with the same environment.
        model: a plant for the system's own use, with the true payloads; for several copies a
          CopiesModel.
        """
        super().__init__()
        self._model, self._scenarios, copies = model, tuple(scenarios), len(scenarios)
        self._force = OrbitalForce(scenarios[0].environment or Environment(), model)
        self._held_payloads = np.array([_packed(each.carried.truth) for each in scenarios])
        whole, hidden = model.plant.num_velocities(), copies * len(model.split.names)
        self._state = self.DeclareVectorInputPort(
            "state", model.plant.num_multibody_states() - 2 * hidden
        )
        self._hidden_state = (
            self.DeclareVectorInputPort("hidden_state", 2 * hidden) if hidden else None
        )
        self._acting = self.DeclareDiscreteState(np.zeros(whole - hidden))
        self._acting_hidden = self.DeclareDiscreteState(np.zeros(hidden))
        self._last = self.DeclareDiscreteState(np.zeros(whole))
        self._payload = self.DeclareNumericParameter(BasicVector(self._held_payloads.ravel()))
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
        period = scenarios[0].sample_time
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, weak_callback(self._update))

    def set_payload(
        self, context: Context, properties: MassProperties | Sequence[MassProperties]
    ) -> None:
        """Give the payload, or that of each copy, other mass properties."""
        each = [properties] if isinstance(properties, MassProperties) else properties
        packed = np.concatenate(list(map(_packed, each)))
        context.get_mutable_numeric_parameter(self._payload).SetFromVector(packed)

    def set_initial_state(self, context: Context, state: np.ndarray) -> None:
        """Begin at a known state [q; v] (nq + nv) of the plant, or at that of each copy."""
        force = self._calc(context, self._model.split.whole(state))
        for group, part in self._groups(force, force):
            context.SetDiscreteState(group, part)

    def park(self, context: Context, copy: int) -> None:
        """No force was on a copy."""
        for group in (self._acting, self._acting_hidden, self._last):
            held = np.array(context.get_discrete_state(group).value())
            self._rows(held)[copy] = 0.0
            context.SetDiscreteState(group, held)

    def _rows(self, values: np.ndarray) -> np.ndarray:
        """A port's values, of several copies as rows."""
        copies = len(self._scenarios)
        return values if copies == 1 else values.reshape(copies, -1)

    def _groups(self, acting: np.ndarray, last: np.ndarray) -> Iterable[tuple[int, np.ndarray]]:
        """The values of each group of the state."""
        groups = (self._acting, self._acting_hidden, self._last)
        return zip(groups, map(np.ravel, (*self._split(acting), last)), strict=True)

    def _split(self, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hidden = self._model.split
        return hidden.known_velocities(force), force[..., hidden.hidden]

    def _calc(self, context: Context, state: np.ndarray) -> np.ndarray:
        payloads = context.get_numeric_parameter(self._payload).value().reshape(-1, 10)
        for copy in np.flatnonzero((payloads != self._held_payloads).any(axis=1)).tolist():
            self._change_payload(copy, payloads[copy])
        num_positions = self._model.plant.num_positions() // len(self._scenarios)
        return self._force.calc(state[..., :num_positions], context.get_time())

    def _change_payload(self, copy: int, packed: np.ndarray) -> None:
        """Give the payload of a copy in the system's own plant other mass properties."""
        mass, center, inertia = float(packed[0]), packed[1:4].tolist(), packed[4:].tolist()
        properties = MassProperties(mass=mass, center_of_mass=center, inertia=inertia)
        model, scenario = self._model, self._scenarios[copy]
        own = model.models[copy] if isinstance(model, CopiesModel) else model
        change_payload(own.plant, own.context, scenario, properties)
        if isinstance(model, CopiesModel):
            model.take(copy)
        self._held_payloads[copy] = packed

    def _calc_whole(self, context: Context, output: BasicVector) -> None:
        state, port = self._rows(self._state.Eval(context)), self._hidden_state
        deflected = None if port is None else self._rows(port.Eval(context))
        whole = self._model.split.whole(state, deflected)
        output.SetFromVector(self._calc(context, whole).ravel())

    def _calc_now(self, part: int, context: Context, output: BasicVector) -> None:
        force = self._rows(self._instant.Eval(context))
        output.SetFromVector(self._split(force)[part].ravel())

    def _update(self, context: Context, values: DiscreteValues) -> None:
        force = self._rows(self._instant.Eval(context))
        last = self._rows(context.get_discrete_state(self._last).value())
        for group, part in self._groups(force + 0.5 * (force - last), force):
            values.set_value(group, part)


class OrbitalEnvironment(Part):
    """The section ``environment`` of a scenario."""

    title = "Environment"

    @classmethod
    def of(cls, scenario: Scenario) -> "OrbitalEnvironment | None":
        """The orbital environment of a scenario."""
        return None if scenario.environment is None else cls()

    def build(self, setup: BlockSetup) -> EnvironmentForce:
        """The force on all that has mass."""
        return EnvironmentForce([setup.scenario], make_flexible_plant(_locked(setup.scenario)))

    def build_wide(self, setups: Sequence[BlockSetup]) -> EnvironmentForce | None:
        """The force on several copies, see ``systems.side_by_side``; None in different orbits."""
        scenarios = [setup.scenario for setup in setups]
        if any(each.environment != scenarios[0].environment for each in scenarios):
            return None
        locked = [_locked(scenario) for scenario in scenarios]
        model = copies_of([make_flexible_plant(each) for each in locked], locked[0])
        return EnvironmentForce(scenarios, model)


def _locked(scenario: Scenario) -> Scenario:
    """With what its actuators let move held."""
    for part in own_actuators(scenario):
        scenario = part.locked(scenario)
    return scenario


def _packed(properties: MassProperties) -> np.ndarray:
    """[mass, centre of mass, Ixx, Iyy, Izz, Ixy, Ixz, Iyz] (10)."""
    inertia = (*properties.inertia, 0.0, 0.0, 0.0)[:6]
    return np.array([properties.mass, *properties.center_of_mass, *inertia], dtype=float)
