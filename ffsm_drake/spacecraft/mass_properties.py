"""The captured payload: its mass properties, given to a plant in one context."""

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RotationalInertia, SpatialInertia, UnitInertia
from pydrake.systems.framework import Context

from ffsm_drake.common.errors import ModelError, ScenarioError
from ffsm_drake.scenario import MassProperties, Wheels, inertia_matrix
from ffsm_drake.spacecraft.plant import DRAKE_ERRORS, base_body, cause_of, coordinates_of, find_body

_SINGULAR = 1e-12  # ratio of the mass matrix's eigenvalues, between rounding and any spacecraft


def spatial_inertia(properties: MassProperties) -> SpatialInertia:
    """M_PPo_P of a payload: spatial inertia about its frame's origin, in its own axes; zero for a mass of zero."""
    if properties.mass == 0.0:
        return SpatialInertia.Zero()
    inertia = inertia_matrix(properties)
    central = RotationalInertia(
        Ixx=inertia[0, 0], Iyy=inertia[1, 1], Izz=inertia[2, 2], Ixy=inertia[0, 1], Ixz=inertia[0, 2], Iyz=inertia[1, 2]
    )
    return SpatialInertia.MakeFromCentralInertia(
        mass=properties.mass, p_PScm_E=properties.center_of_mass, I_SScm_E=central
    )


def set_wheels(plant: MultibodyPlant, context: Context, wheels: Wheels | None) -> None:
    """Take the wheels' inertia about their axes, which does not turn with the base, out of the base's in one context.

    Raises ScenarioError where the base has less.
    """
    if wheels is None:
        return
    base = base_body(plant)
    M_BBo_B = base.CalcSpatialInertiaInBodyFrame(plant.CreateDefaultContext())
    inertia = M_BBo_B.CalcRotationalInertia().CopyToFullMatrix3()
    for unit in wheels.units.values():
        axis = np.array(unit.axis, dtype=float) / np.linalg.norm(unit.axis)
        inertia -= unit.inertia * np.outer(axis, axis)
    try:
        rest = UnitInertia(RotationalInertia(
            Ixx=inertia[0, 0], Iyy=inertia[1, 1], Izz=inertia[2, 2],
            Ixy=inertia[0, 1], Ixz=inertia[0, 2], Iyz=inertia[1, 2],
        ) / M_BBo_B.get_mass())  # fmt: skip
        base.SetSpatialInertiaInBodyFrame(
            context, SpatialInertia(mass=M_BBo_B.get_mass(), p_PScm_E=M_BBo_B.get_com(), G_SP_E=rest)
        )
    except DRAKE_ERRORS as error:
        raise ScenarioError(
            "actuation.wheels", f"their inertia is part of the base's, which has less: {cause_of(error)}"
        ) from error


def set_payload(plant: MultibodyPlant, context: Context, *, body: str, properties: MassProperties) -> None:
    """Give the payload body its mass properties in one context; the parsed model stays as it is.

    Raises ModelError when there is no such body, or when the spacecraft then has a singular mass matrix.
    """
    held = find_body(plant, body, key="payload.body")
    if held.index() == plant.world_body().index():
        raise ModelError("payload.body: 'WorldModelInstance::world' has no mass; name a body of the spacecraft")
    try:
        held.SetSpatialInertiaInBodyFrame(context, spatial_inertia(properties))
        eigenvalues, directions = np.linalg.eigh(plant.CalcMassMatrix(context))
    except (*DRAKE_ERRORS, np.linalg.LinAlgError) as error:
        raise ModelError(f"payload: mass properties that Drake refuses: {cause_of(error)}") from error
    if not eigenvalues[0] > _SINGULAR * eigenvalues[-1]:
        coordinates = coordinates_of(plant)
        weakest = coordinates.names[int(np.argmax(np.abs(directions[:, 0])))]
        what = f"joint '{weakest}'" if weakest in coordinates.joints else weakest
        raise ModelError(
            f"payload.body: with {properties.mass:g} kg on {body} the mass matrix is singular (eigenvalues "
            f"{eigenvalues[0]:.2g} to {eigenvalues[-1]:.2g}): {what} moves nothing that has inertia beside the rest; "
            "give every link of the URDF and the payload a mass and inertia of the same kind of size, or fix the joint"
        )
