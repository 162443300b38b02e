"""A receiver that handles the packets of a link as events."""

import numpy as np

from ffsm_drake.plugins.actuators.packets import Channel

ALWAYS = 2**53
ORDERS = ("kept", "newest", "received")


def channel(seed, **given):
    usual = {
        "drop_rate": 0.0, "mean_burst": None, "least_delay": 0.0, "most_delay": 0.0,
        "order": "kept", "hold": np.inf, "first": 0, "lasts": ALWAYS, "period": ALWAYS,
    }  # fmt: skip
    return Channel(**{"seed": seed, **usual, **given})


def received(commands, lost, delays, order, hold):
    """What a receiver has in use at each sample: it handles packets in the order of their arrival.

    Args: commands (n); whether each is lost; delays in samples; see ``Link``; samples for which the
    last one is held.
    """
    arrivals, latest = list[tuple[int, int]](), 0
    for sent, (is_lost, delay) in enumerate(zip(lost, delays, strict=True)):
        if is_lost:
            continue
        latest = max(latest, sent + int(delay)) if order == "kept" else sent + int(delay)
        arrivals.append((latest, sent))
    found, in_use, used_at, given = [], None, None, None
    for now in range(len(commands)):
        new = [sent for at, sent in arrivals if at == now]
        if order == "newest" and in_use is not None:
            new = [sent for sent in new if sent > in_use]
        if new:
            in_use, used_at, given = max(new), now, commands[max(new)]
        is_held = used_at is not None and now - used_at <= hold
        found.append(given if is_held else 0.0)
    return np.array(found)


def delays_of(link, count):
    """Delays of packets that arrive out of order, from the arrivals of a link that keeps none."""
    share = np.random.default_rng([link.seed, link.stream]).random((count, 2))
    drawn = link.least_delay + share[:, 1] * (link.most_delay - link.least_delay)
    there = (np.arange(count) >= link.first) & (
        (np.arange(count) - link.first) % link.period < link.lasts
    )
    return np.where(there, np.ceil(drawn - 1e-9), 0.0)


def drawn_channel(draw, seed):
    """A channel of a class: rates, bursts, delays, orders, holds and windows."""
    least, most = np.sort(draw.uniform(0.0, 6.0, 2))
    rate = draw.uniform(0.0, 0.6)
    return channel(
        seed,
        drop_rate=rate,
        mean_burst=draw.choice([None, max(1.0, rate / (1.0 - rate)) + draw.uniform(0.0, 5.0)]),
        least_delay=least,
        most_delay=most,
        order=ORDERS[seed % 3],
        hold=draw.choice([0.0, 2.0, np.inf]),
        first=int(draw.integers(0, 40)),
        lasts=int(draw.integers(20, 100)),
        period=int(draw.choice([120, ALWAYS])),
    )
