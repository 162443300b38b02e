"""Compiled code against Drake's plant in random states."""

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, ForceElementIndex, RevoluteSpring, SpatialInertia
from pydrake.systems.framework import Context

from ffsm_drake.plugins.equations.tree import Reader, Tree
from ffsm_drake.plugins.generated.kernels import Kernels
from ffsm_drake.spacecraft.coordinates import joints_of, tracking_errors

STATES = 8
_SEED = 1


class Differences:
    """The largest differences in random states, as shares of what is compared."""

    def __init__(self, kernels: Kernels, plant: MultibodyPlant) -> None:
        """Args: the code of a plant of one spacecraft, and the plant."""
        tree, reader, random = kernels.tree, Reader(plant), np.random.default_rng(_SEED)
        context = _varied(plant, random)
        q, v, force = _states(tree, random)
        own = np.repeat(reader.parameters(context)[None], STATES, axis=0)
        rates = kernels.calculated("derivative", q, v, force, own)
        matrices = kernels.calculated("mass_matrix", q, own).reshape(STATES, -1, v.shape[1])
        biases = kernels.calculated("bias", q, v, own)
        self.mass_matrix = self.residual = self.bias = self.position_rates = self.errors = 0.0
        self._note_errors(kernels, np.hstack([q, v]), np.hstack([q, v])[::-1])
        for i in range(STATES):
            plant.SetPositionsAndVelocities(context, np.concatenate([q[i], v[i]]))
            plant.get_applied_generalized_force_input_port().FixValue(context, force[i])
            H, C = plant.CalcMassMatrix(context), plant.CalcBiasTerm(context)
            expected = plant.EvalTimeDerivatives(context).CopyToVector()
            q_rates, v_rates = np.split(rates[i], [q.shape[1]])
            terms = np.abs(H) @ np.abs(v_rates) + np.abs(C) + np.abs(force[i])  # by row
            residual = H @ (v_rates - expected[q.shape[1] :])
            self._note("residual", residual, terms)
            self._note("mass_matrix", matrices[i, :-1] - H, np.abs(H).max())
            self._note("bias", biases[i] - C, np.abs(C).max())
            self._note("position_rates", q_rates - expected[: q.shape[1]], np.abs(v[i]).max())

    def _note(self, name: str, difference: np.ndarray, scale: np.ndarray | float) -> None:
        # a NaN is the largest
        found = float(np.max(np.abs(difference) / scale))
        setattr(self, name, found if not found <= getattr(self, name) else getattr(self, name))

    def _note_errors(self, kernels: Kernels, desired: np.ndarray, actual: np.ndarray) -> None:
        """Tracking errors against the ones that NumPy computes."""
        found = kernels.calculated("tracking_errors", desired, actual)
        expected = np.hstack(tracking_errors(desired, actual, kernels.tree.num_positions))
        self._note("errors", found - expected, np.abs(expected).max())

    @property
    def largest(self) -> float:
        """The largest of all."""
        dynamics = self.residual, self.mass_matrix, self.bias, self.position_rates
        return float(np.max([*dynamics, self.errors]))


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
    for joint in joints_of(plant):
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
    q = random.normal(size=(STATES, tree.num_positions))
    v = 0.3 * random.normal(size=(STATES, tree.num_velocities))
    return q, v, 10.0 * random.normal(size=v.shape)
