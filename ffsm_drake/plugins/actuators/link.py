"""A lossy link between the controller and the actuators.

The actuators read their receiver at control samples. A packet that is sent at the sample k with a
delay d acts from the sample k + ceil(d / L) on, with the control period L. The draws depend on the
seed and the number of the sample only, so runs on Drake and compiled runs have the same ones.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from ffsm_drake.loop.blocks import TOLD
from ffsm_drake.plugins.actuators.link_settings import Link
from ffsm_drake.plugins.actuators.packets import Channel, packets_of
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.faults import samples_of
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.faults import FOREVER
from ffsm_drake.systems.parts.metrics import Figure, Metric, by_key
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import STEPS, Signal
from ffsm_drake.systems.sampled import Arrays, Now, Sampled
from ffsm_drake.systems.setup import BlockSetup

_KEY = "effects.link"
AGE, LOST = "command_age", "command_lost"


def link_of(scenario: Scenario) -> Link | None:
    """Return the link of a scenario; None: there is none."""
    found: Link | None = getattr(scenario.effects, "link", None)
    return found


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class LossyLink(Sampled):
    """Holds the force of the packet that is in use.

    Input: ``command`` (nv), N m and N. Outputs, which change at control samples only: ``received``
    (nv), N m and N; ``command_age`` (1), the time since the force that acts was sent, s, 0 before
    the first packet; ``command_lost`` (1), whether the packet of the sample is lost; ``told_force``
    (nv), the command, if the applied force is not reported. Memory: commands that may still arrive,
    the newest first, and the force in use. Phase: the weight of each command among those, the
    weight of the force in use, and the two outputs of size 1.
    """

    channel: Channel
    sent: np.ndarray  # (nv) 1: the force is sent, 0: it acts as commanded
    reported: bool
    sample_time: float
    acts = True
    in_phase: ClassVar = ("channel",)

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return {"command": self.sent.size}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        told = {} if self.reported else {TOLD: self.sent.size}
        return {"received": self.sent.size, AGE: 1, LOST: 1, **told}

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled: no packet has been sent."""
        made = {"in_use": np.zeros(self.sent.size)}
        if self.channel.slots:
            made["waiting"] = np.zeros(self.channel.slots * self.sent.size)
        return made

    def phase(self, sample: Any) -> Sequence[Any]:
        """See Sampled."""
        samples = np.atleast_1d(sample)
        packets = packets_of(self.channel, int(samples.max(initial=0)) + 1)
        slots = np.arange(self.channel.slots + 1)
        weights = (packets.slot[samples] == slots[:, None]) * 1.0
        rest = packets.keeps, packets.age * self.sample_time, packets.lost
        columns = [*weights, *(each[samples] * 1.0 for each in rest)]
        return columns if np.ndim(sample) else [float(column[0]) for column in columns]

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        command, count = inputs["command"], self.sent.size
        weights, (keeps, age, lost) = now.phase[:-3], now.phase[-3:]
        line = np.concatenate([command, memory["waiting"]]) if "waiting" in memory else command
        received = memory["in_use"] * keeps
        for at, weight in enumerate(weights):
            received = received + line[at * count : (at + 1) * count] * weight
        force = np.where(self.sent > 0.0, received, command)
        outputs = {"received": force, AGE: np.stack([age]), LOST: np.stack([lost])}
        if not self.reported:
            outputs[TOLD] = command
        after = {"in_use": received}
        if "waiting" in memory:
            after["waiting"] = line[:-count]
        return outputs, after


def lossy_link(
    settings: Link, coordinates: Coordinates, *, sample_time: float, seed: int
) -> LossyLink:
    """Return the block of a link.

    Args: the settings; the coordinates of the forces; the control period, s; the seed of the
    scenario.

    Raises ScenarioError: an unknown coordinate.
    """
    duration, period = (
        FOREVER if given is None else samples_of(given, sample_time)
        for given in (settings.duration, settings.period)
    )
    hold = 0.0 if settings.without == "zero" else np.inf
    if settings.hold_time is not None:
        hold = settings.hold_time / sample_time
    channel = Channel(
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
    )
    key = f"{_KEY}.coordinates"
    sent = coordinates.vector(dict.fromkeys(settings.coordinates, 1.0), key=key, default=0.0)
    return LossyLink(
        channel=channel, sent=sent, reported=settings.reported, sample_time=sample_time
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class CommandLink(Part):
    """Signals and metrics of the link of a scenario."""

    title = "Link"
    section = "Actuators"
    about = ""
    settings: Link

    @classmethod
    def of(cls, scenario: Scenario) -> "CommandLink | None":
        """See Part."""
        settings = link_of(scenario)
        return None if settings is None else cls(settings=settings)

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """See Part."""
        of_link = functools.partial(Signal, chart=STEPS)
        return (
            of_link(
                name=AGE, unit="s", heading="Link: age of the force that acts",
                meaning="time since the force that acts was sent",
            ),
            of_link(
                name=LOST, unit="1", heading="Link: lost packets",
                meaning="whether the packet of this sample is lost",
            ),
        )  # fmt: skip

    def metrics(self) -> Sequence[Metric]:
        """Share of lost packets, and mean and largest age of the force that acts."""

        def of(key: str, unit: str, calc: Any) -> Metric:
            return Metric(key=f"link.{key}", unit=unit, of=calc)

        return (
            of("lost", "1", lambda run: float(run[LOST].mean())),
            of("mean_age", "s", lambda run: float(run[AGE].mean())),
            of("largest_age", "s", lambda run: float(run[AGE].max())),
        )

    def sentence(self, figures: Sequence[Figure]) -> str:
        """See Part."""
        found = by_key(figures)
        return (
            f"link: {100.0 * found['link.lost']:.3g} % of the packets lost, forces up to "
            f"{found['link.largest_age']:.3g} s old"
        )
