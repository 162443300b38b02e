"""The two-armed spacecraft in MuJoCo and Pinocchio, written from its numbers rather than from our
URDFs.

Configurations q = (quaternion wxyz of R_WB, p_WB, left joints, right joints) and velocities v =
(w_WB, v_WB in world axes, joint rates) are Drake's.
"""

from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

BASE_MASS, BASE_INERTIA = 400.0, 266.0
TARGET_MASS, TARGET_INERTIA, HALF = 100.0, 16.7, 0.5
MASSES = (3.0, 10.0, 10.0, 2.0, 1.5, 1.5)
LENGTHS = (0.18, 0.62, 0.62, 0.12, 0.12, 0.12)
AXES = "ZYYXYX"
RADIUS, SPREAD, HEIGHT = 0.05, 0.6, 1.0  # m: of the rods; the arms' places on the base


def rod(mass: float, length: float) -> tuple[float, float]:
    """Inertia across and along a rod, about its middle."""
    return mass * length**2 / 12 + mass * RADIUS**2 / 4, mass * RADIUS**2 / 2


def grasp(side: int) -> np.ndarray:
    """Rotation of a grasp's frame on the target: its z axis points into the face."""
    return Rotation.from_euler("y", -side * np.pi / 2).as_matrix()


# MuJoCo


def mujoco_model(step: float) -> mujoco.MjModel:
    """The model, its second grasp a stiff weld, with RK4."""
    arms = ""
    held = Rotation.from_matrix(grasp(-1).T).as_quat()[[3, 0, 1, 2]]
    at = grasp(-1).T @ np.array([HALF, 0.0, 0.0])
    for side in (-1, 1):
        place, end = f"{side * SPREAD} 0 {HEIGHT}", ""
        for k, (mass, length, axis) in enumerate(zip(MASSES, LENGTHS, AXES, strict=True)):
            across, along = rod(mass, length)
            unit = " ".join("1" if axis == each else "0" for each in "XYZ")
            arms += (
                f'<body name="arm{side}_{k}" pos="{place}"><joint axis="{unit}"/>'
                f'<inertial pos="0 0 {length / 2}" mass="{mass}" '
                f'diaginertia="{across} {across} {along}"/>'
            )
            place, end = f"0 0 {length}", end + "</body>"
        if side < 0:
            quat = " ".join(map(str, held))
            where = " ".join(map(str, np.array([0, 0, LENGTHS[-1]]) + at))
            arms += (
                f'<body name="target" pos="{where}" quat="{quat}"><inertial pos="0 0 0" '
                f'mass="{TARGET_MASS}" diaginertia="{" ".join([str(TARGET_INERTIA)] * 3)}"/></body>'
            )
        arms += end
    turn = Rotation.from_matrix(grasp(1).T).as_quat()[[3, 0, 1, 2]]
    relative = np.array([0, 0, LENGTHS[-1]]) + grasp(1).T @ np.array([-HALF, 0.0, 0.0])
    pose = " ".join(map(str, [*relative, *turn]))
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><compiler angle="radian"/>
        <option timestep="{step}" integrator="RK4" gravity="0 0 0" tolerance="1e-15"
          iterations="500" solver="Newton" cone="elliptic"/>
        <worldbody><body name="base"><freejoint/><inertial pos="0 0 0" mass="{BASE_MASS}"
          diaginertia="{BASE_INERTIA} {BASE_INERTIA} {BASE_INERTIA}"/>{arms}</body></worldbody>
        <equality><weld body1="arm1_5" body2="target" relpose="{pose}" anchor="0 0 0"
          solref="{2 * step} 1" solimp="0.9999 0.9999 0.001 0.5 2"/></equality></mujoco>"""
    )


def mujoco_run(q: np.ndarray, v: np.ndarray, force: np.ndarray, *, time: float, step: float) -> Any:
    """[q; v] after a time under constant joint forces (12)."""
    model = mujoco_model(step)
    data = mujoco.MjData(model)
    rotation = Rotation.from_quat(q[[1, 2, 3, 0]])
    data.qpos[:] = np.concatenate([q[4:7], q[:4], q[7:]])
    data.qvel[:] = np.concatenate([v[3:6], rotation.inv().apply(v[:3]), v[6:]])
    data.qfrc_applied[6:] = force
    for _ in range(round(time / step)):
        mujoco.mj_step(model, data)
    rotation = Rotation.from_quat(data.qpos[[4, 5, 6, 3]])
    return np.concatenate(
        [data.qpos[3:7], data.qpos[:3], data.qpos[7:], rotation.apply(data.qvel[3:6]),
         data.qvel[:3], data.qvel[6:]]
    )  # fmt: skip


# Pinocchio


def pinocchio_acceleration(pin: Any, jammed: dict[int, float] | None = None) -> Any:
    """A function of q, v and force (nv) that gives dv/dt (nv) with the loop closed exactly.

    ``jammed``: joint (0 to 11) -> angle at which it is a rigid part of its arm; the function reads
    no rate of it and gives the acceleration zero.
    """
    jammed = jammed or {}

    def at(z: float, turn: np.ndarray | None = None, x: float = 0.0) -> Any:
        return pin.SE3(np.eye(3) if turn is None else turn, np.array([x, 0.0, z]))

    model = pin.Model()
    model.gravity = pin.Motion.Zero()
    base = model.addJoint(0, pin.JointModelFreeFlyer(), at(0.0), "base")
    inertia = pin.Inertia(BASE_MASS, np.zeros(3), BASE_INERTIA * np.eye(3))
    model.appendBodyToJoint(base, inertia, at(0.0))
    tips, hands = {}, {}
    for side in (-1, 1):
        body, place = base, at(HEIGHT, x=side * SPREAD)
        for k, (mass, length, axis) in enumerate(zip(MASSES, LENGTHS, AXES, strict=True)):
            joint = k + 6 * (side > 0)
            if joint in jammed:
                turn = Rotation.from_euler(axis.lower(), jammed[joint]).as_matrix()
                place = place * at(0.0, turn)
            else:
                kind = getattr(pin, f"JointModelR{axis}")()
                body, place = model.addJoint(body, kind, place, f"{side}_{k}"), at(0.0)
            across, along = rod(mass, length)
            link = pin.Inertia(mass, np.zeros(3), np.diag([across, across, along]))
            model.appendBodyToJoint(body, link, place * at(length / 2))
            place = place * at(length)
        tips[side], hands[side] = body, place
    hand = hands[-1]
    grasps = {s: pin.SE3(grasp(s), np.array([s * HALF, 0.0, 0.0])) for s in (-1, 1)}
    target = hand * grasps[-1].inverse()
    held = pin.Inertia(TARGET_MASS, np.zeros(3), TARGET_INERTIA * np.eye(3))
    model.appendBodyToJoint(tips[-1], held, target)
    weld = pin.RigidConstraintModel(
        pin.ContactType.CONTACT_6D, model, tips[1], hands[1], tips[-1], target * grasps[1],
        pin.ReferenceFrame.LOCAL,
    )  # fmt: skip
    data, welds = model.createData(), pin.StdVec_RigidConstraintModel()
    weld_data = pin.StdVec_RigidConstraintData()
    welds.append(weld)
    weld_data.append(weld.createData())
    pin.initConstraintDynamics(model, data, welds, weld_data)
    accurate = pin.ProximalSettings(1e-14, 0.0, 1)
    free = np.setdiff1d(np.arange(18), [6 + joint for joint in jammed])

    def acceleration(q: np.ndarray, v: np.ndarray, force: np.ndarray) -> np.ndarray:
        rotation = Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix()
        to_pin = np.zeros((18, 18))  # without jams
        to_pin[0:3, 3:6] = to_pin[3:6, 0:3] = rotation.T
        to_pin[6:, 6:] = np.eye(12)
        rest = np.zeros(18)
        rest[0:3] = -rotation.T @ np.cross(v[0:3], v[3:6])
        q_pin = np.concatenate([q[4:7], q[[1, 2, 3, 0]], q[1 + free[6:]]])
        found = pin.constraintDynamics(
            model, data, q_pin, (to_pin @ v)[free], np.linalg.solve(to_pin.T, force)[free], welds,
            weld_data, accurate,
        )  # fmt: skip
        whole = np.zeros(18)
        whole[free] = found
        return np.linalg.solve(to_pin, whole - rest)

    return acceleration
