"""A bus with our wheels and thrusters, commanded in open loop: what basilisk_oracle.py simulates
too.

The bus is a rigid body, which in one case carries panels and a sloshing mass. The cases are given
in its own axes, as flight software commands them: a torque and a force for each control sample.
Rates are w_WB in those axes, velocities those of the bus's origin in world axes, attitudes modified
Rodrigues parameters.
"""

import functools

import numpy as np
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import Adder, LogVectorOutput, MatrixGain

from ffsm_drake.plugins.actuators.attitude import attitude_ahead
from ffsm_drake.plugins.actuators.row import make_actuation
from ffsm_drake.plugins.flexible.bodies import add_flexible, set_flexible
from ffsm_drake.scenario import (
    Actuation,
    Flexible,
    Model,
    Thruster,
    Thrusters,
    Wheel,
    Wheels,
    thruster_layouts,
)
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.mass_properties import set_wheels
from ffsm_drake.spacecraft.plant import split_of
from ffsm_drake.systems.parts.signals import pulses_of
from ffsm_drake.systems.sampled import Now

PERIOD, DURATION = 0.01, 20.0  # s
MASS = 400.0  # kg
CENTER = np.array([0.05, -0.03, 0.02])  # m, of mass, from the bus's origin
# kg m^2, about it, with all that the bus carries
INERTIA = np.array([[210.0, 4.0, -3.0], [4.0, 250.0, 6.0], [-3.0, 6.0, 180.0]])
RATE = np.array([0.02, -0.03, 0.01])  # rad/s, at the start
AXES = np.array([[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]]) / np.sqrt(3.0)  # of the wheels
SPIN = 0.08  # kg m^2, of a wheel about its axis
WHEEL_RATES = np.array([250.0, -180.0, 120.0, 60.0])  # rad/s, in the bus, at the start
LAYOUT = "12x5N"
COASTING = 5.0  # s
COULOMB, VISCOUS = 5e-3, 1e-4  # N m and N m s
PARTS = {
    "port": Flexible(
        body="spacecraft::bus",
        position=[0.1, 0.9, 0.05],
        direction=[0.0, 1.0, 0.0],
        axis=[1.0, 0.0, 0.0],
        mass=4.0,
        length=3.0,
        width=1.2,
        frequency=0.25,
        damping_ratio=0.005,
    ),
    "starboard": Flexible(
        body="spacecraft::bus",
        position=[0.0, -0.8, -0.1],
        direction=[0.0, -0.8, 0.6],
        axis=[1.0, 0.3, 0.4],
        mass=3.0,
        length=2.5,
        width=0.9,
        frequency=0.4,
        damping_ratio=0.01,
    ),
    "fuel": Flexible(
        kind="mass",
        body="spacecraft::bus",
        position=[0.1, -0.2, -0.4],
        direction=[0.6, 0.0, 0.8],
        mass=12.0,
        frequency=0.3,
        damping_ratio=0.02,
    ),
}
DEFLECTION = {"port": 0.3, "starboard": -0.2, "fuel": 0.05}  # rad and m, at the start, at rest
FRAME, MINIMUM = 0.1, 0.02  # s, of a pulse-width modulator


def stepped(base, commanded, memory):
    """Outputs and memory of ``BaseActuators`` at rest, where a frame begins."""
    inputs = {"commanded_force": commanded, "state": np.eye(1, 7)[0]}
    if base.wheels is not None:
        inputs["stored_momentum"] = base.wheels.axes @ memory["momentum"]
    return base.step(inputs, memory, Now(0.0, [1.0]))


def _sines(size: list[float], frequency: list[float], phase: list[float]) -> np.ndarray:
    """Sines (n, 3), one row for each control sample."""
    time = np.arange(round(DURATION / PERIOD))[:, None] * PERIOD
    return np.array(size) * np.sin(np.array(frequency) * time + np.array(phase))


def torques() -> np.ndarray:
    """Torques (n, 3) on the bus, N m."""
    return _sines([0.6, 0.4, 0.5], [0.5, 0.9, 1.4], [0.3, 1.0, 2.0])


def forces() -> np.ndarray:
    """Forces (n, 3) on the bus, N."""
    return _sines([3.0, 2.0, 1.5], [0.7, 0.4, 1.1], [0.0, 2.0, 4.0])


class _BusAxes(LeafSystem):
    """Commands (n, 6) in the bus's axes, in world axes as they are when a sample is half over."""

    def __init__(self, commands: np.ndarray, period: float) -> None:
        super().__init__()
        self._commands, self._period = commands, period
        self._state = self.DeclareVectorInputPort("state", 13)
        self._held = self.DeclareDiscreteState(np.zeros(6))
        self.DeclareStateOutputPort("commanded_force", self._held)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context, values):
        sample = round(context.get_time() / self._period)
        wanted = self._commands[sample] if sample < len(self._commands) else np.zeros(6)
        state = self._state.Eval(context)
        rotation = attitude_ahead(state[:4], state[7:10], self._period / 2.0).reshape(3, 3)
        values.set_value(self._held, (wanted.reshape(2, 3) @ rotation.T).ravel())


def simulate(
    actuation: Actuation,
    commands: np.ndarray,
    *,
    period: float = PERIOD,
    carries: dict[str, Flexible] | None = None,
) -> dict[str, np.ndarray]:
    """Our actuators under commands (n, 6), torque and force: their outputs by name at the n samples
    and after the last.

    Beside them ``rate``, ``velocity`` and ``attitude`` (n + 1, 3) each; of the parts ``deflection``
    and its derivative ``deflection_rate``, by their order.
    """
    plant, builder, model = (
        MultibodyPlant(time_step=0.0),
        DiagramBuilder(),
        Model(flexible=carries or {}),
    )
    builder.AddNamedSystem("plant", plant)
    unit = UnitInertia(*(np.diag(INERTIA) / MASS), *(INERTIA[[0, 0, 1], [1, 2, 2]] / MASS))
    about_origin = unit.ShiftFromCenterOfMass(CENTER)
    plant.AddRigidBody(
        "bus", plant.AddModelInstance("spacecraft"), SpatialInertia(MASS, CENTER, about_origin)
    )
    add_flexible(plant, model)
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    plant.Finalize()
    coordinates, hidden = Coordinates((), ()), split_of(plant)
    known = builder.AddSystem(MatrixGain(hidden.known_part(np.eye(plant.num_multibody_states())).T))
    builder.Connect(plant.get_state_output_port(), known.get_input_port())
    actuators = builder.AddSystem(make_actuation(actuation, coordinates, sample_time=period))
    command = builder.AddSystem(_BusAxes(commands, period))
    total = [actuators.GetOutputPort("applied_force")]
    if actuation.wheels is not None:
        total.append(actuators.GetOutputPort("gyroscopic_force"))
    adder = builder.AddSystem(Adder(len(total), 6))
    for index, port in enumerate(total):
        builder.Connect(port, adder.get_input_port(index))
    on_known = builder.AddSystem(
        MatrixGain(hidden.known_velocities(np.eye(plant.num_velocities())))
    )
    builder.Connect(adder.get_output_port(), on_known.get_input_port())
    builder.Connect(on_known.get_output_port(), plant.get_applied_generalized_force_input_port())
    builder.Connect(command.get_output_port(), actuators.GetInputPort("commanded_force"))
    for system in (actuators, command):
        builder.Connect(known.get_output_port(), system.GetInputPort("state"))
    ports = {"state": plant.get_state_output_port()}
    for index in range(actuators.num_output_ports()):
        ports[actuators.get_output_port(index).get_name()] = actuators.get_output_port(index)
    logs = {name: LogVectorOutput(port, builder, period) for name, port in ports.items()}
    simulator = Simulator(builder.Build())
    scheme = "runge_kutta5" if carries else "runge_kutta3"
    config = SimulatorConfig(
        integration_scheme=scheme, max_step_size=period, use_error_control=False
    )
    ApplySimulatorConfig(config, simulator)
    root = simulator.get_mutable_context()
    context = plant.GetMyMutableContextFromRoot(root)
    set_flexible(plant, context, model)
    set_wheels(plant, context, actuation.wheels)
    state = np.concatenate([[1.0, 0, 0, 0], np.zeros(3), RATE, np.zeros(3)])
    deflection = [DEFLECTION[name] for name in hidden.names]
    plant.SetPositionsAndVelocities(
        context, hidden.whole(state, np.r_[deflection, np.zeros(len(deflection))])
    )
    # The centre of mass is at rest.
    state[10:] = -plant.CalcCenterOfMassTranslationalVelocityInWorld(context)
    velocity = SpatialVelocity(state[7:10], state[10:])
    plant.SetFreeBodySpatialVelocity(
        context=context, body=plant.GetBodyByName("bus"), V_JpJc=velocity
    )
    actuators.set_initial_state(actuators.GetMyMutableContextFromRoot(root), state)
    simulator.AdvanceTo((len(commands) + 1) * period)
    found = {name: log.FindLog(root).data().T for name, log in logs.items()}
    whole = found.pop("state")[:-1]
    states = hidden.known_part(whole)
    # What is held from a sample on is logged at the next.
    found = {name: rows[1:] for name, rows in found.items()}
    turned = [attitude_ahead(row[:4], row[7:10], 0.0).reshape(3, 3).T @ row[7:10] for row in states]
    found |= {
        "rate": np.array(turned),
        "velocity": states[:, 10:],
        "attitude": states[:, 1:4] / (1.0 + states[:, :1]),
    }
    order = [hidden.names.index(name) for name in carries or {}]
    deflections = np.split(hidden.hidden_part(whole), 2, axis=1)
    return found | {
        name: rows[:, order]
        for name, rows in zip(("deflection", "deflection_rate"), deflections, strict=True)
    }


def wheel_settings(
    *, coulomb: float = 0.0, viscous: float = 0.0, torque_limit: float = 10.0
) -> Actuation:
    momenta = SPIN * (WHEEL_RATES + AXES @ RATE)
    units = {
        f"wheel_{i}": Wheel(
            axis=axis.tolist(), inertia=SPIN, torque_limit=torque_limit, initial_momentum=momentum,
            coulomb_friction=coulomb, viscous_friction=viscous,
        )
        for i, (axis, momentum) in enumerate(zip(AXES, momenta, strict=True))
    }  # fmt: skip
    return Actuation(wheels=Wheels(units=units))


def with_wheel_speeds(found: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return found | {"wheel_speed": found["wheel_momentum"] / SPIN - found["rate"] @ AXES.T}


@functools.cache
def wheels() -> dict[str, np.ndarray]:
    """Four wheels in a pyramid, without friction, give the torques."""
    return with_wheel_speeds(simulate(wheel_settings(), np.c_[torques(), np.zeros_like(torques())]))


@functools.cache
def parts() -> dict[str, np.ndarray]:
    """The same with panels and a sloshing mass."""
    return with_wheel_speeds(
        simulate(wheel_settings(), np.c_[torques(), np.zeros_like(torques())], carries=PARTS)
    )


def coasting(
    *, coulomb: float = 0.0, viscous: float = 0.0, period: float = PERIOD
) -> dict[str, np.ndarray]:
    """Friction alone slows the wheels: their motors give as good as nothing."""
    settings = wheel_settings(coulomb=coulomb, viscous=viscous, torque_limit=1e-15)
    return with_wheel_speeds(
        simulate(settings, np.zeros((round(COASTING / period), 6)), period=period)
    )


@functools.cache
def thrusters() -> dict[str, np.ndarray]:
    """The twelve thrusters give the torques and forces in pulses."""
    return simulate(Actuation(thrusters=Thrusters(layout=LAYOUT)), np.c_[torques(), forces()])


def pulses() -> list[list[list[int]]]:
    """Of each thruster the pulses: sample in which it opens, and samples for which it stays
    open.
    """
    result = []
    for column in thrusters()["thruster_open"][:-1].T:
        starts, lengths = pulses_of(column, 1.0)
        result.append(
            [[int(start), round(length)] for start, length in zip(starts, lengths, strict=True)]
        )
    return result


def units() -> list[Thruster]:
    return list(thruster_layouts()[LAYOUT].values())


def shares() -> np.ndarray:
    """Wanted shares (60, 12) of the thrusters' force, most of them near the shortest pulse or
    below.
    """
    random = np.random.default_rng(0)
    return random.uniform(0.0, 0.25, (60, 12)) * random.choice([1.0, 5.0], (60, 12), p=[0.8, 0.2])
