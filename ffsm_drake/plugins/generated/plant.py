"""The system that takes the place of Drake's plant of several copies in the closed loop."""

from typing import Any

import numpy as np
from pydrake.systems.framework import BasicVector, Context, ContinuousState, LeafSystem

from ffsm_drake.plugins.generated.kernels import Kernels


class GeneratedPlant(LeafSystem):
    """Copies of a spacecraft, moved by compiled code.

    It has the ports, the state and, of their use in the loop, the methods of a MultibodyPlant.

    Inputs:
      applied_generalized_force: (B nv), copy after copy.
    Outputs:
      state: [q; v] (B nq + B nv), q of copy after copy, then v.
    Parameter: those of ``tree`` (B, ``Tree.num_parameters``). A copy whose numbers are not finite
    does not affect the others.
    """

    def __init__(self, kernels: Kernels, copies: int) -> None:
        super().__init__()
        tree = kernels.tree
        self._copies, self._q_size = copies, copies * tree.num_positions
        self._v_size, self._num_own = copies * tree.num_velocities, tree.num_parameters
        state = self.DeclareContinuousState(self._q_size, self._v_size, 0)
        self.DeclareStateOutputPort("state", state)
        self._force = self.DeclareVectorInputPort("applied_generalized_force", self._v_size)
        self._own = self.DeclareNumericParameter(BasicVector(copies * self._num_own))
        # [q; v], its rates, forces and parameters, for the compiled function
        self._given, self._rates = (np.zeros(self._q_size + self._v_size) for _ in range(2))
        self._applied = np.zeros(self._v_size)
        self._parameters = np.zeros(copies * self._num_own)
        arrays = (
            *self._split(self._given), self._applied, self._parameters, *self._split(self._rates),
        )  # fmt: skip
        self._calculate = kernels.on("derivative", *(each.reshape(copies, -1) for each in arrays))

    def _split(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return state[: self._q_size], state[self._q_size :]

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        """Called by Drake: [dq/dt; dv/dt]."""
        self._given[:] = context.get_continuous_state_vector().value()
        self._applied[:] = self._force.Eval(context)
        self._parameters[:] = context.get_numeric_parameter(self._own).value()
        self._calculate()
        derivatives.get_mutable_vector().SetFromVector(self._rates)

    def set_parameters(self, context: Context, copy: int, values: np.ndarray) -> None:
        """Give a copy its parameters."""
        own = np.array(context.get_numeric_parameter(self._own).value())
        own.reshape(self._copies, -1)[copy] = values
        context.get_mutable_numeric_parameter(self._own).SetFromVector(own)

    def get_applied_generalized_force_input_port(self) -> Any:
        """As of a MultibodyPlant."""
        return self._force

    def get_state_output_port(self) -> Any:
        """As of a MultibodyPlant."""
        return self.GetOutputPort("state")

    def num_multibody_states(self) -> int:
        """As of a MultibodyPlant."""
        return self._q_size + self._v_size

    def num_positions(self) -> int:
        """As of a MultibodyPlant."""
        return self._q_size

    def num_velocities(self) -> int:
        """As of a MultibodyPlant."""
        return self._v_size

    def GetPositionsAndVelocities(self, context: Context) -> np.ndarray:
        """As of a MultibodyPlant."""
        state: np.ndarray = context.get_continuous_state_vector().CopyToVector()
        return state

    def GetVelocities(self, context: Context) -> np.ndarray:
        """As of a MultibodyPlant."""
        return self.GetPositionsAndVelocities(context)[self._q_size :]

    def SetPositionsAndVelocities(self, context: Context, state: np.ndarray) -> None:
        """As of a MultibodyPlant."""
        context.SetContinuousState(state)
