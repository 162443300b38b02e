"""Mass matrices of a free base with joints, by MuJoCo and by Drake, in Drake's order."""

from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def by_mujoco(
    text: str,
    joints: Mapping[str, float],
    *,
    turned: object = UPRIGHT,
    held: Mapping[str, float] | None = None,
) -> np.ndarray:
    """H of an MJCF text (6 + n, 6 + n).

    Args:
      joints: name -> rad or m from the reference configuration.
      turned: quaternion of the base, the first body.
      held: name -> rad or m, of joints that do not count.
    """
    model = mujoco.MjModel.from_xml_string(text)
    data, matrix = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[3:7] = turned
    # MuJoCo's order of v is position, rotation (body axes), joints; Drake's rotation (world) first.
    change, turn = np.zeros((model.nv, 6 + len(joints))), np.zeros(9)
    mujoco.mju_quat2Mat(turn, data.qpos[3:7])
    change[:3, 3:6], change[3:6, :3] = np.eye(3), turn.reshape(3, 3).T
    for k, (name, value) in enumerate(joints.items()):
        joint = model.joint(name)
        data.qpos[joint.qposadr[0]] = model.qpos0[joint.qposadr[0]] + value
        change[joint.dofadr[0], 6 + k] = 1.0
    for name, value in (held or {}).items():
        data.qpos[model.joint(name).qposadr[0]] = value
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, matrix)
    return change.T @ matrix @ change


def by_drake(
    plant: MultibodyPlant, joints: Mapping[str, float], *, turned: object = UPRIGHT
) -> np.ndarray:
    """H of a plant; see ``by_mujoco``. Its joints are those given."""
    context = plant.CreateDefaultContext()
    positions, rows = plant.GetPositions(context), [*range(6)]
    positions[:4] = turned
    for name, value in joints.items():
        joint = plant.GetJointByName(name)
        positions[joint.position_start()] = value
        rows.append(joint.velocity_start())
    assert len(rows) == plant.num_velocities()
    plant.SetPositions(context, positions)
    return plant.CalcMassMatrix(context)[np.ix_(rows, rows)]


def plant_of(file: Path | str, kind: str = "", *, strict: bool = False) -> MultibodyPlant:
    """The plant of a file, or of a text of a kind, as Drake alone reads it."""
    plant = MultibodyPlant(time_step=0.0)
    parser = Parser(plant)
    if strict:
        parser.SetStrictParsing()
    if kind:
        parser.AddModelsFromString(str(file), kind)
    else:
        parser.AddModels(str(file))
    plant.Finalize()
    return plant
