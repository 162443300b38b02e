"""A lossy link from the sensors to the controller, as the one to the actuators."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

import numpy as np

from ffsm_drake.plugins.actuators.packets import STREAM, Channel, Packets, packets_of
from ffsm_drake.plugins.actuators.receiver import LinkPart, Receiver, channel_of
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.parts.signals import STEPS, Signal, View
from ffsm_drake.systems.sampled import Arrays, Now
from ffsm_drake.systems.sensing.block import IS_NEW
from ffsm_drake.systems.setup import BlockSetup

AGE, LOST = "measurement_age", "measurement_lost"
_KEY = "effects.sensor_link"


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class LossyMeasurement(Receiver):
    """Holds the measurement of the packet that is in use; all vectors are along [q; v] (nq + nv).

    Inputs: ``state``, what the sensors show, and ``measurement_is_new``, if they tell it. Outputs:
    ``estimated_state``, and ``measurement_is_new``: 1 for entries of a packet that begins to act,
    if the sensor made them for it.
    """

    sent: np.ndarray  # (nq + nv) 1: the entry is sent, 0: it is read at once
    optional: ClassVar = (IS_NEW,)

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return {"state": self.sent.size, IS_NEW: self.sent.size}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return {"estimated_state": self.sent.size, IS_NEW: self.sent.size}

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled; before the start the state was measured."""
        shown = np.zeros(self.sent.size) if state is None else state
        return self.waiting(np.concatenate([shown, np.zeros(self.sent.size)]))

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        state, weights, size = inputs["state"], now.phase[:-3], self.sent.size
        new = inputs.get(IS_NEW, np.ones(size))
        arrives = sum(weights[1:], weights[0])
        packet = np.concatenate([state, new])
        received, after = self.received(packet, memory, weights, 1.0 - arrives)
        shown, told = received[:size], received[size:] * arrives
        return {
            "estimated_state": np.where(self.sent > 0.0, shown, state),
            IS_NEW: np.where(self.sent > 0.0, told, new),
        }, after


def lossy_measurement(scenario: Scenario, coordinates: Coordinates) -> LossyMeasurement:
    """Return the block of a scenario with such a link. Raises ScenarioError: an unknown
    coordinate.
    """
    names = dict.fromkeys(scenario.effects.sensor_link.coordinates, 1.0)
    sent = coordinates.vector(names, key=f"{_KEY}.coordinates", default=0.0)
    attitude = np.full(4, sent[:3].max())
    return LossyMeasurement(
        channel=_channel(scenario),
        sent=np.concatenate([attitude, sent[3:], sent]),
        sample_time=scenario.sample_time,
    )


def _channel(scenario: Scenario) -> Channel:
    return channel_of(
        scenario.effects.sensor_link, sample_time=scenario.sample_time,
        seed=scenario.random_seed, stream=STREAM + 1,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class MeasurementLink(LinkPart):
    """The section ``effects.sensor_link``: a stage of sensing, with its signals and metrics."""

    title = "Sensor link"
    section = "Sensors"
    effect, age, lost, carried = "sensor_link", AGE, LOST, "measurements"

    def build(self, setup: BlockSetup) -> LossyMeasurement:
        """The stage."""
        return lossy_measurement(setup.scenario, setup.coordinates)

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """See Part; both follow from the draws."""

        def of(find: Callable[[Packets, float], np.ndarray]) -> Callable[[View], np.ndarray]:
            def values(run: View) -> np.ndarray:
                samples = np.rint(run.time / run.scenario.sample_time).astype(int)
                packets = packets_of(_channel(run.scenario), int(samples.max(initial=0)) + 1)
                return 1.0 * find(packets, run.scenario.sample_time)[samples][:, None]

            return values

        return (
            Signal(
                name=AGE, unit="s", heading="Sensor link: age of the measurement", chart=STEPS,
                meaning="time since the measurement that the controller reads was sent",
                of=of(lambda packets, step: packets.age * step),
            ),
            Signal(
                name=LOST, unit="1", heading="Sensor link: lost packets", chart=STEPS,
                meaning="whether the packet of measurements of this sample is lost",
                of=of(lambda packets, step: packets.lost),
            ),
        )  # fmt: skip
