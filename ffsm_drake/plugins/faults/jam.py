"""Jammed joints: at rest under any force of their drives."""

from collections.abc import Mapping, Sequence

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.scenario import Fault, MassProperties, Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.spacecraft.nominal import change_payload, make_flexible_plant
from ffsm_drake.systems.faults import BreakingPart, first_sample, hits
from ffsm_drake.systems.setup import BlockSetup

_STOPS_IN = 0.02  # s, time constant of the rate as a joint jams


class JammedJoints(BreakingPart):
    """Joints affected by ``faults``."""

    title, hit_as = "Jammed joints", "joints"

    @classmethod
    def known_faults(cls, scenario: Scenario, coordinates: Coordinates) -> Mapping[str, list[str]]:
        """Any joint may jam."""
        return {f"joints.{name}": ["jammed"] for name in coordinates.joints}

    def build(self, setup: BlockSetup) -> LeafSystem:
        """The force of the jam."""
        return _Jam(setup)


class _Jam(LeafSystem):
    """The exact constraint force on jammed joints: it cancels their part of the plant's
    acceleration under all other forces.

    Inputs: ``state`` (nq + nv), ``hidden_state``, ``other_force`` (nv). Output:
    ``generalized_force`` (nv). Parameter: mass, centre of mass, inertia of the payload.
    """

    def __init__(self, setup: BlockSetup) -> None:
        super().__init__()
        self._scenario, self._model = setup.scenario, make_flexible_plant(setup.scenario)
        coordinates, split = setup.coordinates, self._model.split
        nv, nq = len(coordinates.names), len(coordinates.position_names)
        self._hits = [
            (NUM_BASE_VELOCITIES + coordinates.joints.index(name), self._time(setup, fault))
            for name, fault in hits(setup.scenario, "joints")
        ]
        self._state = self.DeclareVectorInputPort("state", nq + nv)
        self._other = self.DeclareVectorInputPort("other_force", nv)
        hidden = 2 * len(split.names)
        self._hidden = self.DeclareVectorInputPort("hidden_state", hidden) if hidden else None
        self.DeclareVectorOutputPort("generalized_force", nv, weak_callback(self._calc))
        untie(self)

    @staticmethod
    def _time(setup: BlockSetup, fault: Fault) -> float:
        return first_sample(fault, setup.sample_time) * setup.sample_time

    def set_payload(self, context: Context, properties: MassProperties) -> None:
        """Give the payload other mass properties."""
        change_payload(self._model.plant, self._model.context, self._scenario, properties)

    def _calc(self, context: Context, output: BasicVector) -> None:
        time, force = context.get_time(), np.zeros(output.size())
        held = sorted({index for index, since in self._hits if time > since - 1e-9})
        if held:
            force[held] = self._holding(context, held)
        output.SetFromVector(force)

    def _holding(self, context: Context, held: Sequence[int]) -> np.ndarray:
        """The force (j) along jammed joints."""
        model, split = self._model, self._model.split
        plant, own = model.plant, model.context
        hidden = None if self._hidden is None else self._hidden.Eval(context)
        state = split.whole(self._state.Eval(context), hidden)
        plant.SetPositionsAndVelocities(own, state)
        whole = np.zeros(plant.num_velocities())
        known = split.known if split.names else slice(None)
        whole[known] = self._other.Eval(context)
        plant.get_applied_generalized_force_input_port().FixValue(own, whole)
        acceleration = plant.get_generalized_acceleration_output_port().Eval(own)
        entries = (np.arange(whole.size)[known])[list(held)]
        inverse = np.linalg.solve(plant.CalcMassMatrix(own), np.eye(whole.size)[:, entries])
        rate = state[plant.num_positions() :][entries]
        answer: np.ndarray = np.linalg.solve(
            inverse[entries], -acceleration[entries] - rate / _STOPS_IN
        )
        return answer
