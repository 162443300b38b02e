"""Mass properties set in one context of a plant: payload, wheels and drives."""

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import Context

from ffsm_drake.common.errors import ModelError, ScenarioError
from ffsm_drake.scenario import Drives, MassProperties, Wheels, inertia_matrix
from ffsm_drake.spacecraft.inertia import rotational_inertia, spatial_inertia_about
from ffsm_drake.spacecraft.plant import (
    DRAKE_ERRORS,
    base_body,
    cause_of,
    coordinates_of,
    find_body,
    split_of,
)

_SINGULAR = 1e-12  # ratio of the mass matrix's eigenvalues: above rounding, below any spacecraft's


def spatial_inertia(properties: MassProperties) -> SpatialInertia:
    """M_PPo_P of a payload: spatial inertia about its frame's origin, in its own axes; zero for a
    mass of zero.
    """
    if properties.mass == 0.0:
        return SpatialInertia.Zero()
    return SpatialInertia.MakeFromCentralInertia(
        mass=properties.mass,
        p_PScm_E=properties.center_of_mass,
        I_SScm_E=rotational_inertia(inertia_matrix(properties)),
    )


def set_wheels(plant: MultibodyPlant, context: Context, wheels: Wheels | None) -> None:
    """Subtract the wheels' axial inertia, which does not turn with the base, in one context, from
    the heaviest of the base's bodies.

    Call it once for a context. Raises ScenarioError if the base has less inertia than the wheels.
    """
    if wheels is None:
        return
    base = base_body(plant)
    body = max(plant.GetBodiesWeldedTo(base), key=lambda each: float(each.get_mass(context)))
    R_CB = base.body_frame().CalcRotationMatrix(context, body.body_frame()).matrix()
    M_CCo_C = body.CalcSpatialInertiaInBodyFrame(context)
    inertia = M_CCo_C.CalcRotationalInertia().CopyToFullMatrix3()
    for unit in wheels.units.values():
        axis = R_CB @ (np.array(unit.axis, dtype=float) / np.linalg.norm(unit.axis))
        inertia -= unit.inertia * np.outer(axis, axis)
    try:
        rest = spatial_inertia_about(M_CCo_C.get_mass(), M_CCo_C.get_com(), inertia)
        body.SetSpatialInertiaInBodyFrame(context, rest)
    except DRAKE_ERRORS as error:
        least = M_CCo_C.Shift(M_CCo_C.get_com()).CalcRotationalInertia().get_moments().min()
        largest = max(unit.inertia for unit in wheels.units.values())
        raise ScenarioError(
            "actuation.wheels",
            f"their inertia (up to {largest:.3g} kg m^2 each) does not fit into the base's (least "
            f"moment {least:.3g} kg m^2); give smaller wheels",
        ) from error


def set_drives(
    plant: MultibodyPlant, context: Context, drives: Drives | None, *, nominal: bool = False
) -> None:
    """Set the joints' reflected rotor inertia in one context: gear ratio squared times the motor's.

    Drake adds it to the mass matrix's diagonal: the rotor's spin about its axis, without its
    gyroscopic torque.

    Args:
      nominal: use the values of the controller's model.

    Raises ScenarioError: a value is given for an unknown joint.
    """
    if drives is None:
        return
    coordinates, inertia, name = coordinates_of(plant), drives.rotor_inertia, "rotor_inertia"
    if nominal and drives.nominal_rotor_inertia is not None:
        inertia, name = drives.nominal_rotor_inertia, "nominal_rotor_inertia"
    key = "actuation.drives"
    rotors = coordinates.joint_vector(inertia or {}, key=f"{key}.{name}", default=np.nan)
    ratios = coordinates.joint_vector(drives.gear_ratio, key=f"{key}.gear_ratio", default=1.0)
    of = dict(zip(coordinates.joints, zip(rotors, ratios, strict=True), strict=True))
    for actuator in map(plant.get_joint_actuator, plant.GetJointActuatorIndices()):
        rotor, ratio = of.get(actuator.joint().name(), (np.nan, 1.0))
        if not np.isnan(rotor):  # else the URDF's value stays
            actuator.SetRotorInertia(context, rotor)
            actuator.SetGearRatio(context, ratio)


def set_payload(
    plant: MultibodyPlant, context: Context, *, body: str, properties: MassProperties
) -> None:
    """Set the payload body's mass properties in one context; the parsed model does not change.

    Raises ModelError if there is no such body, or if the mass matrix becomes singular.
    """
    held = find_body(plant, body, key="payload.body")
    if held.index() == plant.world_body().index():
        raise ModelError(
            "payload.body: 'WorldModelInstance::world' has no mass; name a body of the spacecraft"
        )
    try:
        held.SetSpatialInertiaInBodyFrame(context, spatial_inertia(properties))
        eigenvalues, directions = np.linalg.eigh(plant.CalcMassMatrix(context))
    except (*DRAKE_ERRORS, np.linalg.LinAlgError) as error:
        raise ModelError(
            f"payload: Drake refuses the mass properties: {cause_of(error)}"
        ) from error
    if not eigenvalues[0] > _SINGULAR * eigenvalues[-1]:
        coordinates = coordinates_of(plant)
        names = split_of(plant).whole_names(coordinates.names)
        weakest = names[int(np.argmax(np.abs(directions[:, 0])))]
        what = f"joint '{weakest}'" if weakest in coordinates.joints else weakest
        if weakest in split_of(plant).names:
            raise ModelError(
                f"model.flexible: '{weakest}' moves a negligible inertia, so the mass matrix is "
                "singular; give the part more mass or size, or remove it"
            )
        raise ModelError(
            f"payload.body: the mass matrix is singular, because {what} moves a negligible "
            f"inertia; use heavier links or less than {properties.mass:g} kg on {body}"
        )
