"""The cases of rigid_bus.py on Basilisk (https://avslab.github.io/basilisk/): its spacecraft and
what that carries.

    python tests/plugins/actuators/basilisk_oracle.py

writes basilisk.json, with which test_basilisk.py compares ours; ``pip install
bsk`` brings Basilisk. Its wheels are the "balanced" ones, whose mass and inertia, about the axis
too, are in the hub's, as ours are in the base's. Thrusters do not lose mass. Masses on springs
stand beside the hub's; ours are part of the bus's.
"""

import json
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rigid_bus as bus
from Basilisk.architecture import messaging, sysModel
from Basilisk.fswAlgorithms import rwMotorTorque, thrFiringSchmitt
from Basilisk.simulation import (
    hingedRigidBodyStateEffector,
    linearSpringMassDamper,
    reactionWheelStateEffector,
    spacecraft,
    svIntegrators,
    thrusterDynamicEffector,
)
from Basilisk.utilities import SimulationBaseClass, fswSetupThrusters, macros

from ffsm_drake.scenario import Flexible

TABLE = Path(__file__).parent / "basilisk.json"


class Commands(sysModel.SysModel):
    """Writes a row of commands into a field of its message at every call."""

    def __init__(self, message, payload, field: str, rows: np.ndarray) -> None:
        super().__init__()
        self.message, self._payload, self._field, self._rows = message, payload, field, rows
        self._sample = 0

    def UpdateState(self, time: int) -> None:
        payload, row = self._payload(), self._rows[min(self._sample, len(self._rows) - 1)]
        setattr(payload, self._field, row.tolist())
        self.message.write(payload, time, self.moduleID)
        self._sample += 1


class Simulation:
    """Modules that all run once a period, in the order in which they are added."""

    def __init__(self, period: float) -> None:
        self.base = SimulationBaseClass.SimBaseClass()
        self._period = macros.sec2nano(period)
        self.base.CreateNewProcess("process").addTask(self.base.CreateNewTask("task", self._period))
        self._modules = []

    def add(self, *modules) -> None:
        for module in modules:
            self.base.AddModelToTask("task", module, ModelPriority=1000 - len(self._modules))
            self._modules.append(module)

    def run(self, periods: int) -> None:
        self.base.InitializeSimulation()
        self.base.ConfigureStopTime(periods * self._period)
        self.base.ExecuteSimulation()


class Part(NamedTuple):
    """What a spacecraft carries; Basilisk keeps no more than its address."""

    effector: object
    mass: float
    center: np.ndarray  # of mass, with the part at rest, in the bus's frame
    inertia: np.ndarray  # about the bus's origin, likewise
    states: tuple[str, str]  # names of deflection and its rate


class Deflections(sysModel.SysModel):
    """Keeps what the parts' states are at every call, as no message holds them: deflections, then
    their rates.
    """

    def __init__(self, body: spacecraft.Spacecraft, parts: list[Part]) -> None:
        super().__init__()
        self._body, self._parts, self.rows = body, parts, []

    def UpdateState(self, time: int) -> None:
        names = [part.states[i] for i in (0, 1) for part in self._parts]
        self.rows.append(
            [self._body.dynManager.getStateObject(name).getState()[0][0] for name in names]
        )


def make_hub(parts: dict[str, Flexible] | None = None) -> tuple[spacecraft.Spacecraft, Deflections]:
    """The bus, which is integrated from call to call, and the log of its parts."""
    body = spacecraft.Spacecraft()
    body.ModelTag = "bus"
    added = [add_part(body, part, bus.DEFLECTION[name]) for name, part in (parts or {}).items()]
    mass, moment = bus.MASS, bus.MASS * bus.CENTER
    inertia = bus.INERTIA + about(bus.CENTER, bus.MASS)  # about the bus's origin
    for each in added:
        mass, moment, inertia = (
            mass - each.mass,
            moment - each.mass * each.center,
            inertia - each.inertia,
        )
    center = moment / mass
    hub = body.hub
    hub.mHub, hub.r_BcB_B, hub.IHubPntBc_B = (
        mass,
        center.tolist(),
        (inertia - about(center, mass)).tolist(),
    )
    hub.r_CN_NInit, hub.v_CN_NInit = bus.CENTER.tolist(), [0.0, 0.0, 0.0]
    hub.sigma_BNInit, hub.omega_BN_BInit = [[0.0]] * 3, bus.RATE[:, None].tolist()
    integrator = svIntegrators.svIntegratorRKF78(body)
    integrator.setRelativeTolerance(1e-13)
    integrator.setAbsoluteTolerance(1e-13)
    body.setIntegrator(integrator)
    return body, Deflections(body, added)


def about(place: np.ndarray, mass: float) -> np.ndarray:
    """The inertia of a point mass about the origin."""
    return mass * (place @ place * np.eye(3) - np.outer(place, place))


def add_part(body: spacecraft.Spacecraft, part: Flexible, deflection: float) -> Part:
    """A panel of one plate, or a mass on a spring; both rest at zero."""
    mass, w, place = part.mass, 2.0 * np.pi * part.frequency, np.array(part.position)
    along = np.array(part.direction) / np.linalg.norm(part.direction)
    if part.kind == "mass":
        slosh = linearSpringMassDamper.LinearSpringMassDamper()
        slosh.r_PB_B, slosh.pHat_B = place[:, None].tolist(), along[:, None].tolist()
        slosh.massInit, slosh.rhoInit, slosh.rhoDotInit = mass, deflection, 0.0
        slosh.k, slosh.c = mass * w**2, 2.0 * part.damping_ratio * mass * w
        body.addStateEffector(slosh)
        return Part(
            slosh, mass, place, about(place, mass), (slosh.nameOfRhoState, slosh.nameOfRhoDotState)
        )
    # Its plate lies along -s1 and turns about s2.
    axis = np.array(part.axis) / np.linalg.norm(part.axis)
    axes, half = np.array([-along, axis, np.cross(axis, along)]), part.length / 2.0
    central = mass / 12.0 * np.diag([part.width**2, part.length**2, part.width**2 + part.length**2])
    about_hinge = mass * part.length**2 / 3.0
    panel = hingedRigidBodyStateEffector.HingedRigidBodyStateEffector()
    panel.mass, panel.d, panel.IPntS_S = mass, half, central.tolist()
    panel.r_HB_B, panel.dcm_HB = place[:, None].tolist(), axes.tolist()
    panel.k, panel.c = about_hinge * w**2, 2.0 * part.damping_ratio * about_hinge * w
    panel.thetaInit, panel.thetaDotInit = deflection, 0.0
    body.addStateEffector(panel)
    center = place + half * along
    inertia = axes.T @ central @ axes + about(center, mass)
    return Part(panel, mass, center, inertia, (panel.nameOfThetaState, panel.nameOfThetaDotState))


def wheels(
    torques: np.ndarray,
    *,
    coulomb: float = 0.0,
    viscous: float = 0.0,
    parts: dict[str, Flexible] | None = None,
) -> dict[str, np.ndarray]:
    """Torques on the bus (n, 3) through Basilisk's mapping to motors: what rigid_bus.wheels gives,
    by its names.
    """
    simulation, (body, log) = Simulation(bus.PERIOD), make_hub(parts)
    effector = reactionWheelStateEffector.ReactionWheelStateEffector()
    body.addStateEffector(effector)
    for axis, speed in zip(bus.AXES, bus.WHEEL_RATES, strict=True):
        wheel = reactionWheelStateEffector.RWConfigPayload()
        wheel.RWModel, wheel.Js, wheel.Omega = messaging.BalancedWheels, bus.SPIN, speed
        wheel.gsHat_B, wheel.rWB_B = axis[:, None].tolist(), [[0.0]] * 3
        # no limits, no static friction
        wheel.u_max = wheel.Omega_max = wheel.P_max = wheel.betaStatic = -1.0
        wheel.fCoulomb, wheel.cViscous = coulomb, viscous
        effector.addReactionWheel(wheel)
    command = Commands(
        messaging.CmdTorqueBodyMsg(),
        messaging.CmdTorqueBodyMsgPayload,
        "torqueRequestBody",
        torques,
    )
    count = len(bus.AXES)
    config = messaging.RWArrayConfigMsgPayload(
        numRW=count,
        GsMatrix_B=bus.AXES.ravel().tolist(),
        JsList=[bus.SPIN] * count,
        uMax=[1e3] * count,
    )
    config = messaging.RWArrayConfigMsg().write(config)
    mapping = rwMotorTorque.rwMotorTorque()
    mapping.controlAxes_B = np.eye(3).ravel().tolist()
    mapping.rwParamsInMsg.subscribeTo(config)
    mapping.vehControlInMsg.subscribeTo(command.message)
    effector.rwMotorCmdInMsg.subscribeTo(mapping.rwMotorTorqueOutMsg)
    recorders = [message.recorder() for message in (body.scStateOutMsg, effector.rwSpeedOutMsg)]
    motors = mapping.rwMotorTorqueOutMsg.recorder()
    simulation.add(body, command, mapping, effector, *recorders, motors, log)
    simulation.run(len(torques))
    found = {
        "rate": np.array(recorders[0].omega_BN_B),
        "wheel_speed": np.array(recorders[1].wheelSpeeds)[:, :count],
        "motor_torque": np.array(motors.motorTorque)[:-1, :count],
    }
    if not parts:
        return found
    deflection, deflection_rate = np.split(np.array(log.rows), 2, axis=1)
    return found | {
        "velocity": np.array(recorders[0].v_BN_N),
        "attitude": np.array(recorders[0].sigma_BN),
        "deflection": deflection,
        "deflection_rate": deflection_rate,
    }


def thrusters(pulses: list[list[list[int]]]) -> dict[str, np.ndarray]:
    """Thrusters that open in given samples for so many samples: ``rate`` and ``velocity``."""
    simulation, (body, _) = Simulation(bus.PERIOD), make_hub()
    effector = thrusterDynamicEffector.ThrusterDynamicEffector()
    body.addDynamicEffector(effector)
    on_times = np.zeros((round(bus.DURATION / bus.PERIOD), len(pulses)))
    for i, (unit, each) in enumerate(zip(bus.units(), pulses, strict=True)):
        thruster = thrusterDynamicEffector.THRSimConfig()
        thruster.thrLoc_B = np.array(unit.position)[:, None].tolist()
        thruster.thrDir_B = (np.array(unit.direction) / np.linalg.norm(unit.direction))[
            :, None
        ].tolist()
        thruster.MaxThrust, thruster.MinOnTime, thruster.updateOnly = unit.force, 0.0, True
        effector.addThruster(thruster)
        for start, length in each:
            on_times[start : start + length, i] = 1.5 * bus.PERIOD  # the next command ends it
    command = Commands(
        messaging.THRArrayOnTimeCmdMsg(),
        messaging.THRArrayOnTimeCmdMsgPayload,
        "OnTimeRequest",
        on_times,
    )
    effector.cmdsInMsg.subscribeTo(command.message)
    recorder = body.scStateOutMsg.recorder()
    simulation.add(body, command, effector, recorder)
    simulation.run(len(on_times))
    return {"rate": np.array(recorder.omega_BN_B), "velocity": np.array(recorder.v_BN_N)}


def on_times(
    shares: np.ndarray, *, on: float, off: float, minimum: float = bus.MINIMUM
) -> np.ndarray:
    """How long (n, 12) thrusters open for wanted shares (n, 12) of their force: pulse widths with a
    Schmitt trigger.

    Args: the trigger's levels, shares of the shortest pulse; that, s.
    """
    count, force, simulation = shares.shape[1], bus.units()[0].force, Simulation(bus.FRAME)
    # It fires nothing at its first two calls.
    rows = np.r_[np.zeros((2, count)), shares * force]
    command = Commands(
        messaging.THRArrayCmdForceMsg(), messaging.THRArrayCmdForceMsgPayload, "thrForce", rows
    )
    trigger = thrFiringSchmitt.thrFiringSchmitt()
    trigger.thrMinFireTime, trigger.level_on, trigger.level_off = minimum, on, off
    trigger.baseThrustState = 0
    fswSetupThrusters.clearSetup()
    for unit in bus.units():
        fswSetupThrusters.create(unit.position, unit.direction, unit.force)
    config = fswSetupThrusters.writeConfigMessage()
    trigger.thrConfInMsg.subscribeTo(config)
    trigger.thrForceInMsg.subscribeTo(command.message)
    recorder = trigger.onTimeOutMsg.recorder()
    simulation.add(command, trigger, recorder)
    simulation.run(len(rows) - 1)
    return np.array(recorder.OnTimeRequest)[2:, :count]


def results() -> dict[str, object]:
    """What the table holds: states after every second (``rate`` in rad/s, ``velocity`` in m/s)."""
    at_rest, every = np.zeros((round(bus.COASTING / bus.PERIOD), 3)), round(1.0 / bus.PERIOD)
    cases = {
        "wheels": wheels(bus.torques()),
        "parts": wheels(bus.torques(), parts=bus.PARTS),
        "coulomb": wheels(at_rest, coulomb=bus.COULOMB),
        "viscous": wheels(at_rest, viscous=bus.VISCOUS),
        "thrusters": thrusters(bus.pulses()),
    }
    thinned = {
        case: {name: rows[::every].tolist() for name, rows in found.items()}
        for case, found in cases.items()
    }
    return {
        "basilisk": version("bsk"),
        **thinned,
        "pulses": bus.pulses(),
        "on_times": on_times(bus.shares(), on=0.5, off=0.5).tolist(),
        "hysteresis": (on_times(bus.shares(), on=0.75, off=0.25, minimum=bus.FRAME) > 0.0)
        .astype(int)
        .tolist(),
    }


if __name__ == "__main__":
    TABLE.write_text(
        json.dumps(results()).replace("], [[", "],\n[[").replace('], "', '],\n"') + "\n"
    )
