"""Mean output of thrusters over their control frame, which replaces pulses in a linearised loop.

Over a frame they give the mean wrench wanted at its start, and in the next frame the remaining
impulse. Wheels counter the torque of pulses and give the commanded torque immediately. Limits are
omitted.
"""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem, System
from pydrake.systems.primitives import PassThrough

from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.plugins.actuators.row import Actuators, make_actuation
from ffsm_drake.scenario import Thrusters
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.setup import BlockSetup


class MeanThrusters(LeafSystem):
    """The base's wrench, with some entries held over a control frame.

    Input: ``commanded_force`` (nv). Output: ``applied_force`` (nv).
    Discrete state, updated every control sample: the held wrench and the owed impulse (12),
    whether a frame begins (1).
    """

    def __init__(
        self,
        settings: Thrusters,
        coordinates: Coordinates,
        *,
        with_wheels: bool,
        sample_time: float,
    ) -> None:
        """Args:
        settings: the thrusters.
        coordinates: coordinates of the applied force.
        with_wheels: whether wheels give the torque.
        sample_time: s.
        """
        super().__init__()
        self.phase_period, self._sample_time, nv = (
            settings.frame,
            sample_time,
            len(coordinates.names),
        )
        self._held = np.repeat([not with_wheels, True], 3)
        self._owes = self._held & (settings.modulator != "pwpf")
        self._commanded = self.DeclareVectorInputPort("commanded_force", nv)
        self._memory = self.DeclareDiscreteState(np.zeros(12))
        self._begins = self.DeclareDiscreteState(np.zeros(1))
        depends = {self.input_port_ticket(self._commanded.get_index()), self.xd_ticket()}
        self.DeclareVectorOutputPort("applied_force", nv, weak_callback(self._calc), depends)
        self.DeclarePeriodicDiscreteUpdateEvent(sample_time, 0.0, weak_callback(self._update))
        untie(self)

    def phase(self, sample: int) -> int:
        """Phase of a control sample: the number of samples since a frame began."""
        return sample % self.phase_period

    def _give(self, context: Context, *, begins: bool) -> tuple[np.ndarray, np.ndarray]:
        """Wrench (6) of a sample, and the impulse (6) that is owed after it."""
        commanded = self._commanded.Eval(context)[:6]
        held, owed = np.split(context.get_discrete_state(self._memory).value(), 2)
        given = commanded + owed / (self.phase_period * self._sample_time)
        if not begins:
            given = np.where(self._held, held, given)
        return given, self._owes * (owed + (commanded - given) * self._sample_time)

    def _calc(self, context: Context, output: BasicVector) -> None:
        applied = self._commanded.Eval(context).copy()
        applied[:6], _ = self._give(
            context, begins=context.get_discrete_state(self._begins).value()[0] > 0.5
        )
        output.SetFromVector(applied)

    def _update(self, context: Context, values: DiscreteValues) -> None:
        sample = round(context.get_time() / self._sample_time)
        values.set_value(
            self._memory, np.concatenate(self._give(context, begins=self.phase(sample - 1) == 0))
        )
        values.set_value(self._begins, [float(self.phase(sample) == 0)])


def make_mean_actuation(setup: BlockSetup) -> Actuators | None:
    """The scenario's actuators with the mean of their pulses; without thrusters the base's wrench
    acts as commanded.
    """
    settings, coordinates, period = setup.scenario.actuation, setup.coordinates, setup.sample_time
    base: System = PassThrough(len(coordinates.names))
    if settings.thrusters is not None:
        base = MeanThrusters(
            settings.thrusters,
            coordinates,
            with_wheels=settings.wheels is not None,
            sample_time=period,
        )
    return make_actuation(settings, coordinates, sample_time=period, base=base)
