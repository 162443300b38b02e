"""The receiving end of a lossy link, which is read at control samples.

A packet that is sent at the sample k with a delay d acts from the sample k + ceil(d / L) on, with
the control period L. The draws depend on the seed and the number of the sample only, so runs on
Drake and compiled runs have the same ones.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np

from ffsm_drake.plugins.actuators.link_settings import PacketLosses
from ffsm_drake.plugins.actuators.packets import Channel, packets_of
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.faults import samples_of
from ffsm_drake.systems.faults import FOREVER
from ffsm_drake.systems.parts.metrics import Figure, Metric, by_key
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.sampled import Arrays, Sampled


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Receiver(Sampled):
    """A block with the packets that may still arrive, the newest first, and the one in use.

    Phase: the weight of each packet among those, the weight of the one in use, the time since the
    packet in use was sent, s, and whether the packet of the sample is lost.
    """

    channel: Channel
    sample_time: float
    in_phase: ClassVar = ("channel",)

    def phase(self, sample: Any) -> Sequence[Any]:
        """See Sampled."""
        samples = np.atleast_1d(sample)
        packets = packets_of(self.channel, int(samples.max(initial=0)) + 1)
        slots = np.arange(self.channel.slots + 1)
        weights = (packets.slot[samples] == slots[:, None]) * 1.0
        rest = packets.keeps, packets.age * self.sample_time, packets.lost
        columns = [*weights, *(each[samples] * 1.0 for each in rest)]
        return columns if np.ndim(sample) else [float(column[0]) for column in columns]

    def waiting(self, first: np.ndarray) -> Arrays:
        """Return the memory at the start, with the packet (n) that is in use then."""
        made = {"in_use": first}
        if self.channel.slots:
            made["waiting"] = np.zeros(self.channel.slots * first.size)
        return made

    def received(self, packet: Any, memory: Arrays, weights: Any, keeps: Any) -> tuple[Any, Arrays]:
        """Return what is in use at a sample (n), and the memory after it.

        Args: the packet of the sample (n); the memory; the weights of the packets that may arrive;
        the weight of the one in use.
        """
        count = packet.size
        line = np.concatenate([packet, memory["waiting"]]) if "waiting" in memory else packet
        found = memory["in_use"] * keeps
        for at, weight in enumerate(weights):
            found = found + line[at * count : (at + 1) * count] * weight
        after = {"in_use": found}
        if "waiting" in memory:
            after["waiting"] = line[:-count]
        return found, after


def channel_of(
    settings: PacketLosses, *, sample_time: float, seed: int, stream: int, hold: float = np.inf
) -> Channel:
    """Return the channel of a link.

    Args: its settings; the control period, s; the seed of the scenario; the number of its draws
    among those with a seed; samples without a packet for which the last one acts.
    """
    duration, period = (
        FOREVER if given is None else samples_of(given, sample_time)
        for given in (settings.duration, settings.period)
    )
    return Channel(
        seed=seed if settings.seed is None else settings.seed,
        drop_rate=settings.drop_rate,
        mean_burst=settings.mean_burst,
        least_delay=settings.delay[0] / sample_time,
        most_delay=settings.delay[-1] / sample_time,
        order=settings.order,
        hold=hold,
        first=samples_of(settings.time, sample_time),
        lasts=duration,
        period=period,
        stream=stream,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class LinkPart(Part):
    """Metrics of the link of a scenario."""

    about = ""
    effect: ClassVar[str]  # its key in ``effects``, and the first part of the keys of its metrics
    age: ClassVar[str]  # signal of the age of what is in use, s
    lost: ClassVar[str]  # signal of the loss of the packet of a sample
    carried: ClassVar[str]  # in words
    settings: Any

    @classmethod
    def of(cls, scenario: Scenario) -> Self | None:
        """See Part."""
        settings = getattr(scenario.effects, cls.effect, None)
        return None if settings is None else cls(settings=settings)

    def metrics(self) -> Sequence[Metric]:
        """Share of lost packets, and mean and largest age of what is in use."""

        def of(key: str, unit: str, calc: Any) -> Metric:
            return Metric(key=f"{self.effect}.{key}", unit=unit, of=calc)

        return (
            of("lost", "1", lambda run: float(run[self.lost].mean())),
            of("mean_age", "s", lambda run: float(run[self.age].mean())),
            of("largest_age", "s", lambda run: float(run[self.age].max())),
        )

    def sentence(self, figures: Sequence[Figure]) -> str:
        """See Part."""
        found = by_key(figures)
        return (
            f"{self.title.lower()}: {100.0 * found[f'{self.effect}.lost']:.3g} % of the packets "
            f"lost, {self.carried} up to {found[f'{self.effect}.largest_age']:.3g} s old"
        )
