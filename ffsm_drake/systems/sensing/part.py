"""The section ``sensing``: its Drake diagram, from the true state to the measurement."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import Adder

from ffsm_drake.scenario import Sensing as SensingSettings
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.part import Part, state_signals
from ffsm_drake.systems.sampled import SampledSystem
from ffsm_drake.systems.sensing.block import measurement_of
from ffsm_drake.systems.sensing.errors import SensorErrors, measurement_times
from ffsm_drake.systems.sensing.noise import drift, white_noise
from ffsm_drake.systems.setup import BlockSetup, CompositeBlock

# Variables of the record.
SIGNALS = state_signals(
    "measurement", "measured_", "measured q, read by the controller",
    "measured v, read by the controller", "1",
)  # fmt: skip


class Sensing(CompositeBlock):
    """Sensors with their noise, from ``state`` to ``estimated_state``; made by ``make_sensing``."""

    def __init__(self, errors: Sequence[SensorErrors]) -> None:
        """Args: the errors of each copy of the spacecraft, alike in kind."""
        super().__init__()
        builder, blocks = DiagramBuilder(), [measurement_of(each) for each in errors]
        # Each draws its seed in turn, so that the white noise does not depend on the drift.
        self._noise = {"white": builder.AddSystem(white_noise(errors))}
        if any(block.drifting for block in blocks):
            self._noise["drift"] = builder.AddSystem(drift(errors))
        if all(block.is_plain for block in blocks):  # no Python is called
            noisy = builder.AddNamedSystem("noisy", Adder(2, sum(block.size for block in blocks)))
            builder.ExportInput(noisy.get_input_port(0), "state")
            builder.Connect(self._noise["white"].get_output_port(), noisy.get_input_port(1))
            builder.ExportOutput(noisy.get_output_port(), "estimated_state")
        else:
            noisy = any(block.noisy for block in blocks)
            alike = [dataclasses.replace(block, noisy=noisy) for block in blocks]
            sensors = builder.AddSystem(
                SampledSystem(alike, name="sensors", sample_time=errors[0].sample_time)
            )
            builder.ExportInput(sensors.GetInputPort("state"), "state")
            for name, source in self._noise.items():
                if sensors.HasInputPort(name):
                    builder.Connect(source.get_output_port(), sensors.GetInputPort(name))
            for name in blocks[0].outputs:
                builder.ExportOutput(sensors.GetOutputPort(name), name)
        builder.BuildInto(self)
        self.set_name("sensing")

    def set_random(self, context: Context, generators: Sequence[RandomGenerator]) -> None:
        """Draw the random state of each of several copies of the spacecraft."""
        for source in self._noise.values():
            source.set_random(self.GetMutableSubsystemContext(source, context), generators)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sensors(Part):
    """The section ``sensing``."""

    def build(self, setup: BlockSetup) -> Sensing:
        """Return the sensors of a scenario."""
        settings = [setup.scenario.sensing]
        return make_sensing(settings, setup.coordinates, sample_time=setup.sample_time)

    def build_wide(self, setups: Sequence[BlockSetup]) -> Sensing | None:
        """Return the sensors of several copies of the spacecraft, see ``systems.side_by_side``;
        None if only some sensors are slow, or drift, or have errors in the base's axes.
        """
        settings, coordinates = [setup.scenario.sensing for setup in setups], setups[0].coordinates
        each = [SensorErrors(of, coordinates, setups[0].sample_time) for of in settings]
        kinds = [
            (
                *measurement_times(of.settings, coordinates),
                *(of.drift_gains() > 0.0),
                of.axes_matter(),
            )
            for of in each
        ]
        if any((np.concatenate(kind) != np.concatenate(kinds[0])).any() for kind in kinds):
            return None
        return make_sensing(settings, coordinates, sample_time=setups[0].sample_time)


def make_sensing(
    settings: Sequence[SensingSettings], coordinates: Coordinates, *, sample_time: float
) -> Sensing:
    """Return a diagram from ``state`` to ``estimated_state``, both [q; v] (nq + nv), of each of the
    settings.

    With a sensor of a longer period than the controller's there is an output ``measurement_is_new``
    (nq + nv): 1 where this control sample brings a measurement that was not there before, 0 where
    it repeats one.

    Raises:
      ScenarioError: a value is given for an unknown coordinate, or cannot be applied to the base's
        rotation.
    """
    errors = [SensorErrors(each, coordinates, sample_time) for each in settings]
    for each in errors:
        each.check_rotation()
    return Sensing(errors)
