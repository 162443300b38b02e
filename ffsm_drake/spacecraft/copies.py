"""Several copies of the spacecraft in one plant: they share the overhead of each call of Drake.

The plant (``make_plant`` with ``copies``) has one tree of bodies for each copy, and Drake computes
each tree by itself: a copy moves, to the bit, as it does in a plant of its own. q and v hold copy
after copy, each in the order of the plant of one. Elsewhere states of copies are rows (B, nq + nv).
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    ForceElementIndex,
    Frame,
    JointActuator,
    ModelInstanceIndex,
    RevoluteSpring,
)
from pydrake.systems.framework import Context

from ffsm_drake.common.errors import ModelError
from ffsm_drake.scenario import Model, Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES, joints_of
from ffsm_drake.spacecraft.free_floating import ReducedModel
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import base_body, copy_instance, make_plant


@dataclasses.dataclass(frozen=True, kw_only=True)
class Copies:
    """A plant of several copies, and the plant of one that they are copies of."""

    number: int
    plant: MultibodyPlant  # plant with all copies
    single: MultibodyPlant  # plant with one copy

    @classmethod
    def of(cls, model: Model, number: int, *, flexible: bool = False) -> "Copies":
        """Return the copies of a model. Raises ModelError: it does not load, or Drake orders its
        coordinates in another way.
        """
        copies = cls(
            number=number,
            plant=make_plant(model, flexible=flexible, copies=number),
            single=make_plant(model, flexible=flexible),
        )
        copies._check_order()
        return copies

    @property
    def num_positions(self) -> int:
        """Number of positions of one copy."""
        return int(self.single.num_positions())

    def rows(self, state: np.ndarray) -> np.ndarray:
        """[q; v] of each copy (B, nq + nv) from the plant's."""
        q, v = np.split(state, [self.number * self.num_positions])
        return np.concatenate([q.reshape(self.number, -1), v.reshape(self.number, -1)], axis=1)

    def whole(self, rows: np.ndarray) -> np.ndarray:
        """Return [q; v] of the plant from [q; v] of each copy (B, nq + nv)."""
        split = self.num_positions
        return np.concatenate([rows[:, :split].ravel(), rows[:, split:].ravel()])

    def set_parameters(
        self, context: Context, copy: int, single: MultibodyPlant, source: Context
    ) -> None:
        """Give a copy the masses, rotors, springs and dampers of a plant of one.

        Args:
          context: of the plant of all copies.
          copy: its number.
          single: a plant of one, made as ``self.single``.
          source: its context.
        """
        plant = self.plant
        for index in map(BodyIndex, range(1, single.num_bodies())):
            body = single.get_body(index)
            own = plant.GetBodyByName(body.name(), self._instance(copy, body))
            own.SetSpatialInertiaInBodyFrame(context, body.CalcSpatialInertiaInBodyFrame(source))
        for joint in joints_of(single):
            own = plant.GetJointByName(joint.name(), self._instance(copy, joint))
            own.SetDampingVector(context, joint.GetDampingVector(source))
        for index in single.GetJointActuatorIndices():
            rotor = single.get_joint_actuator(index)
            own = _actuator(plant, rotor.name(), self._instance(copy, rotor))
            own.SetRotorInertia(context, rotor.rotor_inertia(source))
            own.SetGearRatio(context, rotor.gear_ratio(source))
        count = single.num_force_elements() - 1  # the first is gravity
        for i in range(1, count + 1):
            spring = single.get_force_element(ForceElementIndex(i))
            if isinstance(spring, RevoluteSpring):
                own = plant.get_force_element(ForceElementIndex(copy * count + i))
                own.SetStiffness(context, spring.GetStiffness(source))

    def _instance(self, copy: int, element: Any) -> ModelInstanceIndex:
        """Return a copy's model instance of an element of the plant of one."""
        name = self.single.GetModelInstanceName(element.model_instance())
        return self.plant.GetModelInstanceByName(copy_instance(copy, name))

    def _check_order(self) -> None:
        """Raise ModelError unless q and v hold copy after copy, in the order of the plant of
        one.
        """
        base = base_body(self.single)
        nq, nv = self.single.num_positions(), self.single.num_velocities()
        as_expected = nq == NUM_BASE_POSITIONS + nv - NUM_BASE_VELOCITIES
        for copy in range(self.number):
            own = self.plant.GetBodyByName(base.name(), self._instance(copy, base))
            as_expected &= own.floating_positions_start() == copy * nq
            as_expected &= own.floating_velocities_start_in_v() == copy * nv
            for joint in joints_of(self.single):
                other = self.plant.GetJointByName(joint.name(), self._instance(copy, joint))
                as_expected &= other.position_start() == copy * nq + joint.position_start()
                as_expected &= other.velocity_start() == copy * nv + joint.velocity_start()
        if not as_expected:
            raise ModelError("model: its copies do not have contiguous coordinates")


def _actuator(plant: MultibodyPlant, name: str, instance: ModelInstanceIndex) -> JointActuator:
    return plant.GetJointActuatorByName(name, instance)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CopiesModel(PlantModel):
    """The models of several copies behind the interface of one: every array has a row for each
    copy (B, ...), and every result the bits of that copy's own model.
    """

    models: Sequence[PlantModel]
    copies: Copies

    def take(self, copy: int) -> None:
        """Give a copy the masses, rotors, springs and dampers of its own model."""
        own = self.models[copy]
        self.copies.set_parameters(self.context, copy, own.plant, own.context)

    def calc_mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """Return the mass matrices (B, nv, nv) in configurations q (B, nq)."""
        if not math.isfinite(np.add.reduce(q, axis=None)):  # Drake would end the process
            raise ValueError("a configuration q is not finite")
        self.plant.SetPositions(self.context, q.reshape(-1))
        whole = self.plant.CalcMassMatrix(self.context)
        # Drake's matrix is stored by columns; its blocks on the diagonal, as a view.
        size, (down, right) = len(whole) // len(q), whole.strides
        strides = ((down + right) * size, down, right)
        return np.ndarray((len(q), size, size), float, whole.T, 0, strides)

    def calc_bias(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the Coriolis and centrifugal terms (B, nv), N m and N."""
        if not math.isfinite(np.add.reduce(q, axis=None) + np.add.reduce(v, axis=None)):
            raise ValueError("a configuration q or a velocity v is not finite")
        self.plant.SetPositions(self.context, q.reshape(-1))
        self.plant.SetVelocities(self.context, v.reshape(-1))
        bias: np.ndarray = self.plant.CalcBiasTerm(self.context).reshape(v.shape)
        return bias

    def calc_jacobian(self, q: np.ndarray, frame: Frame | str) -> np.ndarray:
        """Return the Jacobians (B, 6, nv) of a frame of the plant of one."""
        return np.stack([own.calc_jacobian(*at, frame) for own, *at in self._at(q)])

    def calc_bias_acceleration(
        self, q: np.ndarray, v: np.ndarray, frame: Frame | str
    ) -> np.ndarray:
        """J' v (B, 6) of a frame of the plant of one."""
        return np.stack([own.calc_bias_acceleration(*at, frame) for own, *at in self._at(q, v)])

    def calc_frame_pose(self, q: np.ndarray, frame: Frame | str) -> np.ndarray:
        """Return the poses (B, 7) of a frame of the plant of one."""
        return np.stack([own.calc_frame_pose(*at, frame) for own, *at in self._at(q)])

    def _at(self, *rows: np.ndarray) -> Iterator[tuple[Any, ...]]:
        """Return each copy's own model, with its rows."""
        return zip(self.models, *rows, strict=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReducedCopiesModel(ReducedModel, CopiesModel):
    """As CopiesModel, of underactuated plants."""


def copies_of(models: Sequence[PlantModel], scenario: Scenario) -> CopiesModel:
    """Return the nominal models of several runs as one.

    Args:
      models: of each run (``make_nominal_plant``, ``driven_model``, ``make_flexible_plant``).
      scenario: one of the runs; all have its model.
    """
    first = models[0]
    copies = Copies.of(scenario.model, len(models), flexible=bool(first.split.names))
    kind = ReducedCopiesModel if isinstance(first, ReducedModel) else CopiesModel
    model = kind(
        plant=copies.plant,
        context=copies.plant.CreateDefaultContext(),
        coordinates=first.coordinates,
        split=first.split,
        models=tuple(models),
        copies=copies,
    )
    for copy in range(len(models)):
        model.take(copy)
    return model
