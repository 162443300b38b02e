"""SPART's three example models: inertia matrices, bias, end effector's Jacobian, resolved motion.

``spart.json`` holds what SPART's functions (NPS-SRL/SPART at 1365c7e, run in Octave 7) give for its
examples ResolvedMotion, DH_Tutorial and SC_3DoF: bodies as published; H = [H0 H0m; H0m' Hm], C u
and J in one state. SPART's u is [w_WB in the base's axes; v_WB in the world's; joints], its links'
frames stand in their centres of mass.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from outside_urdfs import joint, link, robot
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.spacecraft.free_floating import free_floating
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import coordinates_of

MODELS = json.loads((Path(__file__).parent / "spart.json").read_text())
PLANAR = [2, 3, 4]  # of the base: w_z, v_x, v_y; the other inertias of ResolvedMotion are 0


def pose_of(matrix):
    """Translation and roll, pitch, yaw of a homogeneous matrix, as a URDF writes them."""
    X = RigidTransform(np.array(matrix, dtype=float))
    texts = X.translation(), RollPitchYaw(X.rotation()).vector()
    return [" ".join(map(repr, map(float, each))) for each in texts]


def inertial(mass, inertia, matrix):
    xyz, rpy = pose_of(matrix)
    x, y, z = np.diag(inertia).tolist()
    if x == y == 0.0:
        x = y = 0.5 * z  # the least that a body can have
    moments = f'ixx="{x!r}" iyy="{y!r}" izz="{z!r}" ixy="0" ixz="0" iyz="0"'
    body = f'<inertial><origin xyz="{xyz}" rpy="{rpy}"/><mass value="{mass}"/><inertia {moments}/>'
    return f"{body}</inertial>"


def urdf_of(given):
    parts = [link("base", extra=inertial(given["base_mass"], given["base_inertia"], np.eye(4)))]
    centers = [np.eye(4)]
    for k, each in enumerate(given["joints"], start=1):
        centers.append(np.array(each["to_center"], dtype=float))
        body = inertial(each["mass"], each["inertia"], centers[k])
        xyz, rpy = pose_of(centers[each["parent"]] @ each["placed"])
        parent = f"link_{each['parent']}" if each["parent"] else "base"
        kind = "continuous" if each["revolute"] else "fixed"
        axis = " ".join(map(str, each["axis"]))
        parts.append(link(f"link_{k}", extra=body))
        parts.append(
            joint(f"joint_{k}", parent, f"link_{k}", kind=kind, axis=axis, xyz=xyz, rpy=rpy)
        )
    xyz, rpy = pose_of(centers[-1] @ given["end_effector"])
    last = f"link_{len(given['joints'])}"
    parts += [link("hand"), joint("grip", last, "hand", kind="fixed", xyz=xyz, rpy=rpy)]
    return robot(*parts, name="spart")


@pytest.mark.parametrize("name", MODELS)
def test_matrices_are_those_of_spart(name):
    given = MODELS[name]
    plant = MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    Parser(plant).AddModelsFromString(urdf_of(given), "urdf")
    plant.Finalize()
    model = PlantModel(
        plant=plant, context=plant.CreateDefaultContext(), coordinates=coordinates_of(plant)
    )
    rotation = np.array(given["rotation"])
    quaternion = RotationMatrix(rotation).ToQuaternion().wxyz()
    q = np.concatenate([quaternion, given["position"], given["q"]])
    # from SPART's velocities to ours: the base's rate in world axes
    P = np.eye(plant.num_velocities())
    P[:3, :3] = rotation
    u = np.concatenate([given["u0"], given["um"]])
    kept = [*(PLANAR if name == "resolved_motion" else range(6)), *range(6, len(u))]
    H, bias = (np.array(given[key]) for key in ("H", "Cu"))
    found_H = P.T @ model.calc_mass_matrix(q) @ P
    np.testing.assert_allclose(
        found_H[np.ix_(kept, kept)], H[np.ix_(kept, kept)], atol=1e-12 * np.abs(H).max()
    )
    found_bias = P.T @ model.calc_bias(q, P @ u)
    np.testing.assert_allclose(found_bias[kept], bias[kept], atol=1e-12 * np.abs(bias).max())
    J = np.array(given["J"])
    found_J = model.calc_jacobian(q, "spart::hand")
    np.testing.assert_allclose((found_J @ P)[:, kept], J[:, kept], atol=1e-14)
    # resolved motion: the hand's twist by the joints' rates, with the momentum at rest
    base = kept[: -len(given["um"])]
    hand = J[:, 6:] - J[:, base] @ np.linalg.solve(H[np.ix_(base, base)], H[base, 6:])
    found_hand = free_floating(model, q).generalized_jacobian(found_J)
    rows = PLANAR if name == "resolved_motion" else range(6)
    np.testing.assert_allclose(found_hand[rows], hand[rows], atol=1e-12)
