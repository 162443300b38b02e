"""Star trackers that look at every second control sample and hold the attitude in between: further
stages of sensing.
"""

import numpy as np
from pydrake.systems.framework import LeafSystem


class Held(LeafSystem):
    """One that updates with its own period, as Drake's blocks do."""

    every = 2  # control samples from one update to the next

    def __init__(self, setup):
        super().__init__()
        size = 2 * len(setup.coordinates.names) + 1
        self._state = self.DeclareVectorInputPort("state", size)
        self._attitude = self.DeclareDiscreteState([1.0, 0.0, 0.0, 0.0])
        self._samples = self.DeclareDiscreteState(1)
        period = self.every * setup.sample_time
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclareVectorOutputPort("estimated_state", size, self._give)

    def set_initial_state(self, context, state):
        context.SetDiscreteState(self._attitude, state[:4])

    def _is_due(self, context):
        return True

    def _update(self, context, values):
        if self._is_due(context):
            values.set_value(self._attitude, self._state.Eval(context)[:4])
        values.set_value(self._samples, context.get_discrete_state(self._samples).value() + 1.0)

    def _give(self, context, output):
        state = self._state.Eval(context).copy()
        state[:4] = context.get_discrete_state(self._attitude).value()
        output.SetFromVector(state)


class Counting(Held):
    """One that runs at every control sample and counts for itself when to look."""

    every = 1

    def _is_due(self, context):
        return context.get_discrete_state(self._samples).value()[0] % 2 == 0


class HeldThird(Held):
    """One that looks at every third sample; its period differs from three samples by rounding."""

    every = 3


class Third(Counting):
    """The same, which counts for itself."""

    def _is_due(self, context):
        return context.get_discrete_state(self._samples).value()[0] % 3 == 0


class Rare(Counting):
    """One whose looks are too far apart to be noticed in a few samples."""

    def _is_due(self, context):
        return context.get_discrete_state(self._samples).value()[0] % 50 == 0


class Irregular(Counting):
    """One without a period."""

    def _is_due(self, context):
        sample = int(context.get_discrete_state(self._samples).value()[0])
        return np.random.default_rng(sample).random() < 0.3
