"""The equations on plain numbers against Drake's plant in random states."""

from collections.abc import Hashable
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    FixedOffsetFrame,
    ForceElementIndex,
    FrameIndex,
    RevoluteSpring,
    SpatialInertia,
)
from pydrake.systems.framework import Context

from ffsm_drake.common.memo import content_of
from ffsm_drake.plugins.equations.equations import bias, derivative, mass_matrix
from ffsm_drake.plugins.equations.errors import tracking_errors
from ffsm_drake.plugins.equations.tree import Reader, Tree
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.spacecraft import coordinates

LARGEST_DIFFERENCE = 1e-11  # from Drake, as a share of the terms of an equation
_STATES = 8
_SEED = 1
_EQUAL = set[Hashable]()  # contents of the trees that were compared in this process


def held_to_drake(tree: Tree, *, plant: MultibodyPlant) -> None:
    """Compare the equations of a plant's tree with the plant. Raises NotCovered: they differ."""
    if (content := content_of(tree)) in _EQUAL:
        return
    found = max(
        differences(plant, tree.displaced).values(), key=lambda each: (np.isnan(each), each)
    )
    if not found <= LARGEST_DIFFERENCE:
        raise NotCovered(f"equations that differ from Drake by {found:.1e}")
    _EQUAL.add(content)


def differences(plant: MultibodyPlant, displaced: tuple[int, ...] = ()) -> dict[str, float]:
    """Return the largest differences in random states, as shares of what is compared.

    Args: the plant; its displaced frames (``Tree.displaced``); those of joints move at random.
    """
    reader, random = Reader(plant, displaced), np.random.default_rng(_SEED)
    context = _varied(plant, random)
    for index in {link.frame for link in reader.tree.links} & {*displaced}:
        frame = plant.get_frame(FrameIndex(index))
        if isinstance(frame, FixedOffsetFrame):
            by = RigidTransform(RollPitchYaw(*random.normal(size=3)), random.normal(size=3))
            frame.SetPoseInParentFrame(context, frame.GetPoseInParentFrame(context) @ by)
    tree, own = reader.tree, reader.parameters(context)
    largest: dict[str, float] = {}

    def note(name: str, found: Any, expected: np.ndarray, scale: np.ndarray) -> None:
        share = float(np.max(np.abs(np.array(found) - expected) / scale))
        largest[name] = float(np.maximum(share, largest.get(name, 0.0)))  # a NaN is the largest

    before = np.zeros(0)
    for q, v, force in zip(*_states(tree, random), strict=True):
        state = np.concatenate([q, v])
        plant.SetPositionsAndVelocities(context, state)
        plant.get_applied_generalized_force_input_port().FixValue(context, force)
        H, C = plant.CalcMassMatrix(context), plant.CalcBiasTerm(context)
        rates = np.array(derivative(tree, q, v, force, own))
        expected = plant.EvalTimeDerivatives(context).CopyToVector()
        (q_rates, v_rates), split = np.split(rates, [q.size]), q.size
        terms = np.abs(H) @ np.abs(v_rates) + np.abs(C) + np.abs(force)  # by row
        note("residual", H @ v_rates, H @ expected[split:], terms)
        note("position_rates", q_rates, expected[:split], np.abs(v).max())
        note("mass_matrix", mass_matrix(tree, q, own), H, np.abs(H).max())
        note("bias", bias(tree, q, v, own), C, np.abs(C).max())
        if before.size:
            errors = np.hstack(tracking_errors(before, state, split))
            known = np.hstack(coordinates.tracking_errors(before, state, split))
            note("errors", errors, known, np.abs(known).max())
        before = state
    return largest


def _varied(plant: MultibodyPlant, random: np.random.Generator) -> Context:
    """A context with random dampers, springs, rotors, and shares of the masses."""
    context = plant.CreateDefaultContext()
    for body in map(plant.get_body, map(BodyIndex, range(1, plant.num_bodies()))):
        own = body.CalcSpatialInertiaInBodyFrame(context)
        scaled = SpatialInertia(
            mass=own.get_mass() * random.uniform(0.5, 2.0),
            p_PScm_E=own.get_com(),
            G_SP_E=own.get_unit_inertia(),
        )
        body.SetSpatialInertiaInBodyFrame(context, scaled if own.get_mass() > 0.0 else own)
    for joint in coordinates.joints_of(plant):
        joint.SetDampingVector(context, random.uniform(0.1, 1.0, size=1))
    for rotor in map(plant.get_joint_actuator, plant.GetJointActuatorIndices()):
        rotor.SetRotorInertia(context, random.uniform(1e-4, 1e-3))
        rotor.SetGearRatio(context, random.uniform(10.0, 100.0))
    for index in range(1, plant.num_force_elements()):
        spring = plant.get_force_element(ForceElementIndex(index))
        if isinstance(spring, RevoluteSpring):
            spring.SetStiffness(context, random.uniform(1.0, 100.0))
    return context


def _states(tree: Tree, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random q, v and forces, a row for each state."""
    q = random.normal(size=(_STATES, tree.num_positions))
    v = 0.3 * random.normal(size=(_STATES, tree.num_velocities))
    return q, v, 10.0 * random.normal(size=v.shape)
