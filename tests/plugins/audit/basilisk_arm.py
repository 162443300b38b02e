"""A free-floating spacecraft with an arm on Basilisk (https://avslab.github.io/basilisk/), logged
as its users would: what ``ffsm audit`` is tested on.

    PYTHONPATH=tests/plugins/actuators python tests/plugins/audit/basilisk_arm.py

writes basilisk_arm.csv; ``pip install bsk`` brings Basilisk (2.12.1 wrote the file).
Its hub and chain of spinning bodies are read from basilisk_arm.urdf, their axes
driven by torques that are held over each period; fourth-order Runge-Kutta, Basilisk's default.
"""

import csv
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from Basilisk.architecture import messaging
from Basilisk.simulation import spacecraft, spinningBodyNDOFStateEffector
from Basilisk.utilities import RigidBodyKinematics
from basilisk_oracle import Commands, Simulation

URDF = Path(__file__).parent / "basilisk_arm.urdf"
PERIOD, SAMPLES = 0.05, 201
ANGLES, RATES = [0.3, -0.8, 0.5], [0.1, -0.15, 0.2]
SIZES, SPEEDS = np.array([6.0, 4.0, 0.6]), np.array([0.8, 1.3, 2.0])  # of the torques: N m, rad/s


def numbers(element, name: str) -> np.ndarray:
    return np.array(element.get(name, "0 0 0").split(), dtype=float)


def inertial(link) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass, inertia about it, in the link's axes."""
    i = {name: float(value) for name, value in link.find("inertial/inertia").attrib.items()}
    inertia = [[i["i" + min(a + b, b + a)] for b in "xyz"] for a in "xyz"]
    mass = float(link.find("inertial/mass").get("value"))
    return mass, numbers(link.find("inertial/origin"), "xyz"), np.array(inertia)


def column(vector: np.ndarray) -> list[list[float]]:
    return vector[:, None].tolist()


def make_arm() -> tuple[spacecraft.Spacecraft, object]:
    """The hub with what it carries, turning past half a turn, where its MRPs are switched."""
    robot, body = ElementTree.parse(URDF).getroot(), spacecraft.Spacecraft()
    links = {link.get("name"): inertial(link) for link in robot.findall("link")}
    mass, center, inertia = links["hub"]
    body.hub.mHub, body.hub.r_BcB_B = mass, column(center)
    body.hub.IHubPntBc_B = inertia.tolist()
    body.hub.r_CN_NInit, body.hub.v_CN_NInit = [3.0, -1.0, 2.0], [0.02, -0.01, 0.03]
    body.hub.sigma_BNInit = column(np.array([0.6, -0.5, 0.55]))
    body.hub.omega_BN_BInit = column(np.array([0.05, -0.06, 0.08]))
    chain = spinningBodyNDOFStateEffector.SpinningBodyNDOFStateEffector()
    for joint, angle, rate in zip(robot.findall("joint"), ANGLES, RATES, strict=True):
        mass, center, inertia = links[joint.find("child").get("link")]
        origin, part = joint.find("origin"), spinningBodyNDOFStateEffector.SpinningBody()
        part.setMass(mass)
        part.setR_ScS_S(column(center))
        part.setISPntSc_S(inertia.tolist())
        part.setR_SP_P(column(numbers(origin, "xyz")))
        part.setDCM_S0P(RigidBodyKinematics.euler3212C(numbers(origin, "rpy")[::-1]).tolist())
        part.setSHat_S(column(numbers(joint.find("axis"), "xyz")))
        part.setThetaInit(angle)
        part.setThetaDotInit(rate)
        part.setK(0.0)
        part.setC(0.0)
        chain.addSpinningBody(part)
    body.addStateEffector(chain)
    return body, chain


def log() -> dict[str, np.ndarray]:
    """Columns by Basilisk's names; time in s."""
    times = PERIOD * np.arange(SAMPLES)
    torques = SIZES * np.cos(np.outer(times, SPEEDS))
    simulation, (body, chain) = Simulation(PERIOD), make_arm()
    payload = messaging.ArrayMotorTorqueMsgPayload
    command = Commands(messaging.ArrayMotorTorqueMsg(), payload, "motorTorque", torques)
    chain.motorTorqueInMsg.subscribeTo(command.message)
    state, motors = body.scStateOutMsg.recorder(), command.message.recorder()
    joints = [message.recorder() for message in chain.spinningBodyOutMsgs]
    simulation.add(body, command, chain, state, motors, *joints)
    simulation.run(SAMPLES - 1)
    columns = {"time": state.times() * 1e-9}
    for name in ("r_BN_N", "v_BN_N", "sigma_BN", "omega_BN_B"):
        columns |= {f"{name}_{i}": row for i, row in enumerate(np.array(getattr(state, name)).T)}
    for name in ("theta", "thetaDot"):
        columns |= {f"{name}_{i}": np.array(getattr(each, name)) for i, each in enumerate(joints)}
    torque = np.array(motors.motorTorque)[:, : len(joints)].T
    return columns | {f"motorTorque_{i}": row for i, row in enumerate(torque)}


if __name__ == "__main__":
    found = log()
    with URDF.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(found)
        rows = zip(*found.values(), strict=True)
        writer.writerows([f"{value:.9g}" for value in row] for row in rows)
