"""The combined spacecraft in MuJoCo, written from the numbers of the paper rather than from our
URDF.

Coordinates here are the paper's: position first. A configuration is (p_WB, quaternion wxyz of R_WB,
joint angles), which is MuJoCo's qpos; rates are (v_WB, w_WB, joint rates) with both base vectors in
world axes, forces are dual to them. MuJoCo's qvel differs from the rates in the angular velocity
alone, which it takes in body axes. Because the time derivative of R w_B is R times that of w_B, the
two accelerations are related by that same rotation, without a further term. Drake's order is a
permutation: quaternion before position, rotation before position.
"""

import dataclasses

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

# Table 1 of the paper.
BASE_MASS = 400.0  # kg
BASE_INERTIA = 266.0  # kg m^2, about every axis
LINK_MASSES = (3.0, 10.0, 10.0, 1.5, 1.5)  # kg
LINK_LENGTHS = (0.18, 0.62, 0.62, 0.09, 0.09)  # m
# What the paper leaves open: the arm stands on the base's +z face, links along +z at the zero
# posture.
ARM_MOUNT = 1.0  # m, from the base's centre
JOINT_AXES = ((0, 0, 1), (0, 1, 0), (0, 1, 0), (0, 1, 0), (1, 0, 0))
LINK_RADIUS = 0.05  # m
TARGET_OFFSET = 0.5  # m, from the tip of link 5 to the target's centre

# Drake's coordinates from the paper's, and back: drake = paper[..._TO_DRAKE], paper =
# drake[..._FROM_DRAKE].
Q_TO_DRAKE = np.array([3, 4, 5, 6, 0, 1, 2, 7, 8, 9, 10, 11])
V_TO_DRAKE = np.array([3, 4, 5, 0, 1, 2, 6, 7, 8, 9, 10])
Q_FROM_DRAKE = np.argsort(Q_TO_DRAKE)
V_FROM_DRAKE = np.argsort(V_TO_DRAKE)


@dataclasses.dataclass(frozen=True)
class Target:
    """Mass properties of the captured body, in axes parallel to link 5's, TARGET_OFFSET beyond its
    tip.
    """

    mass: float  # kg
    center_of_mass: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m
    # About the centre of mass: Ixx, Iyy, Izz, Ixy, Ixz, Iyz, kg m^2.
    inertia: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


TRUE_TARGET = Target(100.0, inertia=(16.7, 16.7, 16.7, 0.0, 0.0, 0.0))
BELIEVED_TARGET = Target(80.0, inertia=(12.0, 12.0, 12.0, 0.0, 0.0, 0.0))


def inertia_matrix(target: Target) -> np.ndarray:
    """Inertia about the centre of mass (3, 3)."""
    ixx, iyy, izz, ixy, ixz, iyz = target.inertia
    return np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])


def rod_inertia(mass: float, length: float) -> tuple[float, float, float]:
    """Central moments of a link along z: m l^2/12 across, m r^2/2 along, kg m^2."""
    across = mass * length**2 / 12
    return across, across, mass * LINK_RADIUS**2 / 2


def mjcf(target: Target) -> str:
    """The MJCF text of the model."""

    def text(*numbers: float) -> str:
        return " ".join(repr(float(number)) for number in numbers)

    # Principal axes from here: MuJoCo 3.2 finds those of a fullinertia only to about 1e-9 kg m^2.
    moments, axes = np.linalg.eigh(inertia_matrix(target))
    x, y, z, w = Rotation.from_matrix(axes * np.sign(np.linalg.det(axes))).as_quat()
    body = f"""
        <body name="target" pos="{text(0, 0, LINK_LENGTHS[-1] + TARGET_OFFSET)}">
          <inertial pos="{text(*target.center_of_mass)}" quat="{text(w, x, y, z)}"
            mass="{target.mass}"
            diaginertia="{text(*moments)}"/>
        </body>"""
    mounts = (ARM_MOUNT, *LINK_LENGTHS[:-1])
    for i in reversed(range(5)):
        mass, length = LINK_MASSES[i], LINK_LENGTHS[i]
        body = f"""
        <body name="link_{i + 1}" pos="{text(0, 0, mounts[i])}">
          <joint name="joint_{i + 1}" type="hinge" axis="{text(*JOINT_AXES[i])}"/>
          <inertial pos="{text(0, 0, length / 2)}" mass="{mass}"
            diaginertia="{text(*rod_inertia(mass, length))}"/>
          {body}
        </body>"""
    return f"""
    <mujoco>
      <option gravity="0 0 0"/>
      <worldbody>
        <body name="base">
          <freejoint/>
          <inertial pos="0 0 0" mass="{BASE_MASS}" diaginertia="{text(*[BASE_INERTIA] * 3)}"/>
          {body}
        </body>
      </worldbody>
    </mujoco>"""


def rotation_matrix(configuration: np.ndarray) -> np.ndarray:
    """R_WB (3, 3); the quaternion may have any norm."""
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, configuration[3:7] / np.linalg.norm(configuration[3:7]))
    return rotation.reshape(3, 3)


def rates_to_qvel(configuration: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """MuJoCo's qvel (11): the angular velocity turned into body axes. Accelerations turn alike."""
    qvel = np.array(rates)
    qvel[3:6] = rotation_matrix(configuration).T @ rates[3:6]
    return qvel


def qvel_to_rates(configuration: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Rates (11): the angular velocity turned into world axes. Accelerations and forces turn
    alike.
    """
    rates = np.array(qvel)
    rates[3:6] = rotation_matrix(configuration) @ qvel[3:6]
    return rates


class MujocoSpacecraft:
    """Dynamics H dv/dt + c = f of the spacecraft with a given target; arrays in the paper's order
    (see above).
    """

    def __init__(self, target: Target) -> None:
        self.model = mujoco.MjModel.from_xml_string(mjcf(target))
        self.data = mujoco.MjData(self.model)

    def mass_matrix(self, configuration: np.ndarray) -> np.ndarray:
        """H (11, 11)."""
        self._evaluate(configuration, np.zeros(11), np.zeros(11))
        turn, columns = np.eye(11), np.empty((11, 11))
        turn[3:6, 3:6] = rotation_matrix(configuration)  # rates = turn @ qvel
        for unit, column in zip(np.eye(11), columns, strict=True):
            mujoco.mj_mulM(self.model, self.data, column, unit)
        return turn @ columns.T @ turn.T

    def bias(self, configuration: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """c (11): the force that holds dv/dt at zero."""
        self._evaluate(configuration, rates, np.zeros(11))
        return qvel_to_rates(configuration, self.data.qfrc_bias)

    def acceleration(
        self, configuration: np.ndarray, rates: np.ndarray, force: np.ndarray
    ) -> np.ndarray:
        """dv/dt (11) under a generalized force (11)."""
        self._evaluate(configuration, rates, force)
        return qvel_to_rates(configuration, self.data.qacc)

    def _evaluate(self, configuration: np.ndarray, rates: np.ndarray, force: np.ndarray) -> None:
        self.data.qpos[:] = configuration
        self.data.qvel[:] = rates_to_qvel(configuration, rates)
        self.data.qfrc_applied[:] = rates_to_qvel(configuration, force)
        mujoco.mj_forward(self.model, self.data)
