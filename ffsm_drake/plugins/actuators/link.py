"""A lossy link from the controller to the actuators."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence

import numpy as np

from ffsm_drake.loop.blocks import TOLD
from ffsm_drake.plugins.actuators.link_settings import Link
from ffsm_drake.plugins.actuators.packets import STREAM
from ffsm_drake.plugins.actuators.receiver import LinkPart, Receiver, channel_of
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.parts.signals import STEPS, Signal
from ffsm_drake.systems.sampled import Arrays, Now
from ffsm_drake.systems.setup import BlockSetup

_KEY = "effects.link"
AGE, LOST = "command_age", "command_lost"


def link_of(scenario: Scenario) -> Link | None:
    """Return the link of a scenario; None: there is none."""
    found: Link | None = getattr(scenario.effects, "link", None)
    return found


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class LossyLink(Receiver):
    """Holds the force of the packet that is in use.

    Input: ``command`` (nv), N m and N. Outputs, which change at control samples only: ``received``
    (nv), N m and N; ``command_age`` (1), the time since the force that acts was sent, s, 0 before
    the first packet; ``command_lost`` (1), whether the packet of the sample is lost; ``told_force``
    (nv), the command, if the applied force is not reported.
    """

    sent: np.ndarray  # (nv) 1: the force is sent, 0: it acts as commanded
    reported: bool
    acts = True

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
        return self.waiting(np.zeros(self.sent.size))

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        command, weights, (keeps, age, lost) = inputs["command"], now.phase[:-3], now.phase[-3:]
        received, after = self.received(command, memory, weights, keeps)
        force = np.where(self.sent > 0.0, received, command)
        outputs = {"received": force, AGE: np.stack([age]), LOST: np.stack([lost])}
        if not self.reported:
            outputs[TOLD] = command
        return outputs, after


def lossy_link(
    settings: Link, coordinates: Coordinates, *, sample_time: float, seed: int
) -> LossyLink:
    """Return the block of a link.

    Args: the settings; the coordinates of the forces; the control period, s; the seed of the
    scenario.

    Raises ScenarioError: an unknown coordinate.
    """
    hold = 0.0 if settings.without == "zero" else np.inf
    if settings.hold_time is not None:
        hold = settings.hold_time / sample_time
    channel = channel_of(settings, sample_time=sample_time, seed=seed, stream=STREAM, hold=hold)
    key = f"{_KEY}.coordinates"
    sent = coordinates.vector(dict.fromkeys(settings.coordinates, 1.0), key=key, default=0.0)
    return LossyLink(
        channel=channel, sent=sent, reported=settings.reported, sample_time=sample_time
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class CommandLink(LinkPart):
    """Signals and metrics of the link of a scenario."""

    title = "Link"
    section = "Actuators"
    effect, age, lost, carried = "link", AGE, LOST, "forces"

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
