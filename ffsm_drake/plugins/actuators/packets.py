"""Packets of a lossy link: which are lost, when the others arrive, and which one is in use.

Losses are those of a Gilbert-Elliott channel whose bad state loses every packet (E. N. Gilbert,
Bell System Technical Journal 39, 1960): with a share p of lost packets and a mean burst b, the
channel becomes good with the probability 1 / b, and bad with p / (b (1 - p)). Independent losses
have b = 1 / (1 - p).
"""

import functools
import math
from typing import NamedTuple

import numpy as np

_NEVER = -1
_FIRST = 4096  # samples that are drawn at first
_ROUNDING = 1e-9  # of a control sample
STREAM = 0x11A2  # draws of the link to the actuators among those with a seed


class Channel(NamedTuple):
    """What packets depend on; times in control samples."""

    seed: int
    drop_rate: float
    mean_burst: float | None
    least_delay: float
    most_delay: float
    order: str
    hold: float  # samples without a packet for which the last one acts
    first: int  # samples with losses and delays: the first one,
    lasts: int  # their number,
    period: int  # and from one beginning to the next
    stream: int = STREAM

    @property
    def slots(self) -> int:
        """Largest delay in control samples."""
        return math.ceil(self.most_delay - _ROUNDING)

    def probabilities(self) -> tuple[float, float]:
        """Probability that a packet is lost after one that was lost, and after one that was not."""
        if self.mean_burst is None:
            return self.drop_rate, self.drop_rate
        becomes_good = 1.0 / self.mean_burst
        return 1.0 - becomes_good, becomes_good * self.drop_rate / (1.0 - self.drop_rate)


class Packets(NamedTuple):
    """Packets by the sample at which they are sent, or received (n)."""

    lost: np.ndarray  # whether the packet of a sample is lost
    slot: np.ndarray  # delay of the packet that begins to act, in samples; -1: none does
    age: np.ndarray  # samples since the force that acts was sent; 0 before the first packet
    keeps: np.ndarray  # whether the last packet acts in a sample without one


def packets_of(channel: Channel, samples: int) -> Packets:
    """Return the packets of at least so many samples; more of them begin with the same ones."""
    count = _FIRST
    while count < samples:
        count *= 2
    return _packets(channel, count)


@functools.lru_cache(maxsize=16)
def _packets(channel: Channel, count: int) -> Packets:
    sent = np.arange(count)
    share = np.random.default_rng([channel.seed, channel.stream]).random((count, 2))
    bad = (sent >= channel.first) & ((sent - channel.first) % channel.period < channel.lasts)
    lost = _lost(channel, share[:, 0]) & bad
    drawn = channel.least_delay + share[:, 1] * (channel.most_delay - channel.least_delay)
    arrives = sent + np.where(bad, np.ceil(drawn - _ROUNDING), 0.0).astype(int)
    arrives = np.where(lost, _NEVER, arrives)
    if channel.order == "kept":
        arrives = np.where(lost, _NEVER, np.maximum.accumulate(arrives))
    begins = np.full(count, _NEVER)
    inside = (arrives >= 0) & (arrives < count)
    np.maximum.at(begins, arrives[inside], sent[inside])
    if channel.order == "newest":
        before = np.maximum.accumulate(np.concatenate([[_NEVER], begins[:-1]]))
        begins = np.where(begins > before, begins, _NEVER)
    is_new = begins >= 0
    received = np.maximum.accumulate(np.where(is_new, sent, _NEVER))
    in_use = np.where(received >= 0, begins[received], sent)
    silent = sent - received
    keeps = ~is_new & (received >= 0) & (silent <= channel.hold + _ROUNDING)
    slot = np.where(is_new, sent - begins, _NEVER)
    return Packets(lost=lost, slot=slot, age=sent - in_use, keeps=keeps)


def _lost(channel: Channel, share: np.ndarray) -> np.ndarray:
    """Whether the channel is bad at each packet, from numbers from 0 to 1; it begins as in the long
    run.
    """
    after_lost, after_received = channel.probabilities()
    # a number below both makes the channel bad, and one above both good
    below_first, below_second = share < after_lost, share < after_received
    if after_lost == after_received:
        return below_first
    found, is_lost = np.empty(share.size, dtype=bool), bool(share[0] < channel.drop_rate)
    found[0] = is_lost
    pairs = zip(below_first[1:].tolist(), below_second[1:].tolist(), strict=True)
    for at, (if_lost, if_received) in enumerate(pairs, start=1):
        found[at] = is_lost = if_lost if is_lost else if_received
    return found
