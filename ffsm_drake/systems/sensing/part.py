"""The section ``sensing``: its Drake diagram, from the true state to the measurement."""

import dataclasses

from pydrake.systems.framework import System
from pydrake.systems.primitives import Adder, Gain

from ffsm_drake.scenario import Sensing as SensingSettings
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import state_signals
from ffsm_drake.systems.sampled import SampledSystem
from ffsm_drake.systems.sensing.block import measurement_of
from ffsm_drake.systems.sensing.errors import SensorErrors
from ffsm_drake.systems.sensing.noise import Noise, drift
from ffsm_drake.systems.setup import BlockSetup, CompositeBlock

# Variables of the record.
MEASUREMENT_SIGNALS = state_signals(
    "measurement", "measured_", "measured q, read by the controller",
    "measured v, read by the controller", "1",
)  # fmt: skip


class Sensing(CompositeBlock):
    """Sensors with their noise, from ``state`` to ``estimated_state``, both [q; v] (nq + nv).

    With a sensor of a longer period than the controller's there is an output ``measurement_is_new``
    (nq + nv): 1 where this control sample brings a measurement that was not there before, 0 where
    it repeats one.
    """

    def __init__(
        self, settings: SensingSettings, coordinates: Coordinates, *, sample_time: float
    ) -> None:
        """Raises ScenarioError: a value is for an unknown coordinate, or cannot be applied to the
        rotation of the base.
        """
        errors = SensorErrors(settings, coordinates, sample_time)
        errors.check_rotation()
        block = measurement_of(errors)
        # Each draws its seed in turn, so that the white noise does not depend on the drift.
        systems: dict[str, System] = {
            "white_noise": Noise("white_noise", Gain(errors.deviation), sample_time=sample_time)
        }
        signals = {"white_noise": {"noise": "white"}, "drift": {"noise": "drift"}}
        if block.drifting:
            systems["drift"] = Noise("drift", drift(errors), sample_time=sample_time)
        if block.is_plain:  # no Python is called
            systems["noisy"] = Adder(2, block.size)
            signals["noisy"] = {"u0": "state", "u1": "white", "sum": "estimated_state"}
        else:
            systems["sensors"] = SampledSystem(block, name="sensors", sample_time=sample_time)
        super().__init__(
            "sensing", systems, inputs=("state",), outputs=block.outputs, signals=signals
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sensors(Part):
    """The section ``sensing``."""

    def build(self, setup: BlockSetup) -> Sensing:
        """Return the sensors of a scenario."""
        return Sensing(setup.scenario.sensing, setup.coordinates, sample_time=setup.sample_time)
