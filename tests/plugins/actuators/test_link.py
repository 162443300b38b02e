"""A lossy link against a receiver that handles packets as events, and against closed forms."""

import itertools

import numpy as np
import pytest
from c_code import needs_llvm
from compared_runs import check
from entry_points import needs
from event_queue import channel, delays_of, drawn_channel, received
from refusals import assert_refused

from ffsm_drake import load_scenario, simulate
from ffsm_drake.plugins.actuators.packets import packets_of


@pytest.mark.smoke
@pytest.mark.parametrize("seed", range(12))
def test_packets_are_those_of_an_event_queue(seed):
    """Of drawn channels: the force in use, from slots and flags, is that of the event queue."""
    draw, count = np.random.default_rng(seed), 300
    link = drawn_channel(draw, seed)
    packets = packets_of(link, count)
    commands = draw.normal(size=count)
    expected = received(
        commands, packets.lost[:count], delays_of(link, count), link.order, link.hold
    )
    made, in_use = [], 0.0
    for now in range(count):
        slot = packets.slot[now]
        in_use = commands[now - slot] if slot >= 0 else in_use * packets.keeps[now]
        made.append(in_use)
    assert np.array_equal(made, expected)
    assert packets.lost[: link.first].sum() == 0


@pytest.mark.parametrize(("rate", "burst"), [*itertools.product((0.05, 0.3), (None, 2.0, 8.0))])
def test_losses_are_those_of_the_channel(rate, burst):
    """The share of lost packets and the mean burst, within four standard deviations."""
    runs = [
        packets_of(channel(seed, drop_rate=rate, mean_burst=burst), 4096).lost for seed in range(40)
    ]
    shares = [run.mean() for run in runs]
    lengths = [
        len(list(group)) for run in runs for is_lost, group in itertools.groupby(run) if is_lost
    ]
    mean = 1.0 / (1.0 - rate) if burst is None else burst
    assert np.mean(shares) == pytest.approx(rate, abs=4.0 * np.std(shares) / np.sqrt(len(runs)))
    spread = np.std(lengths) / np.sqrt(len(lengths))
    assert np.mean(lengths) == pytest.approx(mean, abs=4.0 * spread)


def test_draws_begin_with_the_same_ones():
    link = channel(3, drop_rate=0.2, mean_burst=3.0, most_delay=4.0)
    short, long = packets_of(link, 10), packets_of(link, 10_000)
    assert all(np.array_equal(a, b[: a.size]) for a, b in zip(short, long, strict=True))


LINKS = {
    "bursts": "{drop_rate: 0.3, mean_burst: 4, delay: [0.0, 0.035]}",
    "newest, zero": "{drop_rate: 0.2, delay: [0.01, 0.03], order: newest, without: zero}",
    "a while": "{drop_rate: 0.5, hold_time: 0.02, time: 0.1, duration: 0.1, seed: 5}",
    "joints": "{drop_rate: 0.4, coordinates: [joints], order: received, delay: [0, 0.02]}",
    "not reported": "{drop_rate: 0.3, reported: false}",
}


def scenarios(link, count=1):
    given = ["duration=0.4", "controller=tdc", f"effects.link={link}"]
    return [load_scenario("postcapture", [*given, f"random_seed={k}"]) for k in range(count)]


@pytest.mark.parametrize("link", LINKS.values(), ids=LINKS.keys())
def test_the_applied_force_is_that_of_the_receiver(link):
    """Of a run, by its recorded commands: the same event queue gives the applied force."""
    (scenario,) = scenarios(link)
    record = simulate(scenario, check_stability=False, engine="drake")
    given, step = scenario.effects.link, scenario.sample_time
    log = record.dataset
    lost = log["command_lost"].values > 0.0
    own = channel(
        scenario.random_seed if given.seed is None else given.seed,
        least_delay=given.delay[0] / step, most_delay=given.delay[-1] / step,
        first=round(given.time / step), lasts=round((given.duration or 1e9) / step),
    )  # fmt: skip
    hold = 0.0 if given.without == "zero" else (given.hold_time or np.inf) / step
    commands, applied = log["generalized_force"].values, log["applied_force"].values
    delays = delays_of(own, lost.size)
    assert lost.any()
    for at, name in enumerate(log["coordinate"].values):
        expected = commands[:, at]
        if "all" in given.coordinates or str(name).startswith("joint"):
            expected = received(commands[:, at], lost, delays, given.order, hold)
        assert np.array_equal(applied[:-1, at], expected[:-1])
    share = record.metrics["link"]["lost"]
    assert share == pytest.approx(lost.mean())


@needs("compiled")
@needs_llvm
@pytest.mark.slow
@pytest.mark.parametrize("link", LINKS.values(), ids=LINKS.keys())
def test_compiled_runs_have_the_draws_of_drake(link):
    check(scenarios(link, 3))


REFUSED = {
    "{drop_rate: 1.1}": "effects.link.drop_rate: must be from 0 to below 1, not 1.1",
    "{delay: [0.02, 0.01]}": "effects.link.delay: must not end before it begins",
    "{delay: 9}": "effects.link.delay: must be at most 2 s (200 control samples), not 9 s",
    "{drop_rate: 0.8, mean_burst: 2}": "effects.link.mean_burst: must be at least",
    "{coordinates: [joint_x]}": "effects.link.coordinates.joint_x: unknown coordinate",
    "{period: 1}": "effects.link.period: must exceed a duration",
    "{hold_time: 1, without: zero}": "effects.link.hold_time: has no effect",
    "{order: fifo}": "effects.link.order: 'fifo' is unknown",
    "{rate: 0.1}": "effects.link.rate: unknown key",
}


@pytest.mark.parametrize(("link", "problem"), REFUSED.items())
def test_a_bad_link_is_refused(link, problem):
    assert_refused(problem, "postcapture", f"effects.link={link}")
