"""Random joint trees as plants of Drake."""

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PrismaticJoint,
    PrismaticSpring,
    RevoluteJoint,
    RevoluteSpring,
    RotationalInertia,
    SpatialInertia,
)


def drawn_tree(seed: int, joints: int) -> MultibodyPlant:
    """A floating base with so many revolute and prismatic joints, branches, welded bodies, springs
    and rotors.
    """
    random = np.random.default_rng(seed)
    plant = MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    bodies = [plant.AddRigidBody("base", _inertia(random, 100.0))]
    for i in range(joints):
        body = plant.AddRigidBody(f"body_{i}", _inertia(random, random.uniform(0.5, 20.0)))
        parent = bodies[random.integers(len(bodies)) if random.random() < 0.3 else -1]
        frames = [
            plant.AddFrame(FixedOffsetFrame(f"{name}_{i}", of.body_frame(), _pose(random)))
            for name, of in (("on_parent", parent), ("on_child", body))
        ]
        axis = random.normal(size=3)
        if random.random() < 0.5:
            axis = np.eye(3)[random.integers(3)] * random.choice([-1.0, 1.0])
        turns = random.random() < 0.6
        joint = plant.AddJoint(
            (RevoluteJoint if turns else PrismaticJoint)(f"joint_{i}", *frames, axis)
        )
        if random.random() < 0.4:
            spring = RevoluteSpring if turns else PrismaticSpring
            plant.AddForceElement(spring(joint, random.normal(), 3.0))
        if random.random() < 0.5:
            plant.AddJointActuator(f"drive_{i}", joint)
        if random.random() < 0.2:
            welded = plant.AddRigidBody(f"welded_{i}", _inertia(random, 2.0))
            plant.WeldFrames(body.body_frame(), welded.body_frame(), _pose(random))
        bodies.append(body)
    plant.Finalize()
    return plant


def _inertia(random: np.random.Generator, mass: float) -> SpatialInertia:
    return SpatialInertia.MakeFromCentralInertia(
        mass=mass,
        p_PScm_E=0.2 * random.normal(size=3),
        I_SScm_E=RotationalInertia(*(mass * random.uniform(0.1, 0.15, size=3))),
    )


def _pose(random: np.random.Generator) -> RigidTransform:
    turned = random.uniform(-3.0, 3.0, size=3) if random.random() < 0.5 else np.zeros(3)
    return RigidTransform(RollPitchYaw(turned), 0.5 * random.normal(size=3))
