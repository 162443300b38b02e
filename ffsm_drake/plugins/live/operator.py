"""A disturbance that an operator scales, with pushes on the payload."""

import dataclasses
from collections.abc import Callable
from functools import partial

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, InputPort, LeafSystem

from ffsm_drake.common.lifetime import weak_callback
from ffsm_drake.loop.blocks import DISTURBANCE, as_system, factory_of
from ffsm_drake.scenario import Block
from ffsm_drake.spacecraft.plant import find_body
from ffsm_drake.systems.registry import call_factory
from ffsm_drake.systems.sampled import NEXT
from ffsm_drake.systems.setup import BlockSetup, CompositeBlock

_AHEAD = f"{NEXT}generalized_force"


def make_operated_disturbance(
    setup: BlockSetup, *, initial: np.ndarray, poll: Callable[[float, np.ndarray], np.ndarray]
) -> CompositeBlock:
    """Return the force ``disturbance`` of a scenario, scaled by an operator, who also adds pushes.

    Args:
      setup: the force's setup.
      initial: [scale, F (3; world frame, N)] before the first ``poll``.
      poll: called with (time, q) at every control sample; returns [scale, F] (4) from the next
        sample on.
    """
    choice = setup.scenario.blocks.choices().get(DISTURBANCE, Block())
    original = dataclasses.replace(setup, settings=choice.settings)
    factory = factory_of(DISTURBANCE, setup.scenario)
    place = f"blocks.{DISTURBANCE}"
    made = call_factory(factory, original, place=place)
    disturbance = as_system(made, original, kind="forces", place=place)
    # a force that is held from sample to sample
    ahead = _AHEAD if disturbance.HasOutputPort(_AHEAD) else "generalized_force"
    operator = OperatorInputs(setup, initial=initial, poll=poll)
    return CompositeBlock(
        "disturbance",
        {"original": disturbance, "operator": operator},
        inputs=("state",),
        outputs=("generalized_force", _AHEAD),
        signals={"operator": {"disturbance": "generalized_force", "next_disturbance": ahead}},
    )


class OperatorInputs(LeafSystem):
    """The disturbance under control of an operator.

    Inputs:
      disturbance, next_disturbance: (nv) now, and just after the update of a control sample.
      state: [q; v] (nq + nv).
    Outputs:
      generalized_force: scale * disturbance + J^T F (nv), with the Jacobian J of the payload's
        centre of mass.
      next_generalized_force: the same just after the update of a control sample, for a logger,
        since loggers see the state before the update of their instant.
    State (discrete, period ``sample_time``): the current [scale, F (3; world frame, N)], and the
    values for the next sample.
    """

    def __init__(
        self,
        setup: BlockSetup,
        *,
        initial: np.ndarray,
        poll: Callable[[float, np.ndarray], np.ndarray],
    ) -> None:
        """See ``make_operated_disturbance`` for the arguments."""
        super().__init__()
        scenario, self._model = setup.scenario, setup.true
        self._payload_frame = find_body(
            self._model.plant, scenario.payload.body, key="payload.body"
        ).body_frame()
        self._center_of_mass = np.array(scenario.payload.truth.center_of_mass)
        self._poll = poll
        num_velocities = self._model.plant.num_velocities()
        num_states = self._model.plant.num_multibody_states()
        self._state = self.DeclareVectorInputPort("state", num_states)
        self._acting = self.DeclareDiscreteState(initial)
        self._next = self.DeclareDiscreteState(initial)
        self.DeclarePeriodicDiscreteUpdateEvent(
            scenario.sample_time, 0.0, weak_callback(self._update)
        )
        for name, of, index in (
            ("generalized_force", "disturbance", self._acting),
            (_AHEAD, "next_disturbance", self._next),
        ):
            disturbance = self.DeclareVectorInputPort(of, num_velocities)
            self.DeclareVectorOutputPort(
                name,
                num_velocities,
                partial(weak_callback(self._calc_force), disturbance, index),
                {
                    self.input_port_ticket(disturbance.get_index()),
                    self.input_port_ticket(self._state.get_index()),
                    self.discrete_state_ticket(index),
                },
            )

    def _update(self, context: Context, values: DiscreteValues) -> None:
        q = self._state.Eval(context)[: self._model.plant.num_positions()]
        values.set_value(self._acting, context.get_discrete_state(self._next).value())
        values.set_value(self._next, self._poll(context.get_time(), q))

    def _calc_force(
        self, disturbance: InputPort, index: int, context: Context, output: BasicVector
    ) -> None:
        scale, *push = context.get_discrete_state(index).value()
        force = scale * disturbance.Eval(context)
        if any(push):
            q = self._state.Eval(context)[: self._model.plant.num_positions()]
            force = force + self._calc_jacobian(q).T @ np.array(push)
        output.SetFromVector(force)

    def _calc_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Jacobian (3, nv) of the velocity of the payload's centre of mass in the world frame."""
        model, frame = self._model, self._payload_frame
        in_frame = model.calc_point_jacobian(q, frame, self._center_of_mass)
        return model.calc_frame_rotation(q, frame) @ in_frame[3:]
