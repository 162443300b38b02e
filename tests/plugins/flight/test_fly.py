"""Missions flown over UDP by the C process of a kit are those of ``ffsm run``."""

import contextlib
import signal
import socket
import time

import numpy as np
import pytest
from children import PIPE, child
from drawn_laws import frame_of
from flight_kit import exported, make, need, run

from ffsm_drake import load_scenario, simulate
from ffsm_drake.plugins.udp.external import External
from ffsm_drake.plugins.udp.fly import Pilot
from ffsm_drake.plugins.udp.packets import HAS_FRAME, HAS_NEW, HOLDS, IS_FIRST, Packet, read

EXTERNAL = "ffsm_drake.plugins.udp.external:External"
DIFFERENCE = 1e-9  # of figures and series, as a share of their size


class Framed(External):
    """It gets the path of a frame."""

    tracks_frame = True


def built(folder, scenario, *settings, **options):
    """The program that flies an exported law."""
    need("gcc", "make")
    make(exported(folder, scenario, *settings, **options), "fly")
    return folder / "build" / "fly"


@contextlib.contextmanager
def flying(program):
    """A program that flies a law, and its port."""
    with child([str(program), "--port", "0"], stdout=PIPE, text=True) as process:
        words = process.stdout.readline()
        assert words.startswith("listening on 127.0.0.1:"), words
        yield process, int(words.rpartition(":")[2])


def ended(process, number=signal.SIGTERM):
    """What a program prints at a signal, which ends it within a second."""
    before = time.monotonic()
    process.send_signal(number)
    text = process.stdout.read()
    assert process.wait() == 0
    assert time.monotonic() - before < 1.0
    return text


def figures(metrics, place=""):
    """The numbers in nested metrics, by their place."""
    for key, value in metrics.items():
        if isinstance(value, dict):
            yield from figures(value, f"{place}.{key}")
        elif isinstance(value, float | int) and value is not None:
            yield f"{place}.{key}", float(value)


def differences(record, own):
    """The largest relative difference of metrics, and of each series."""
    assert record.outcome.status == own.outcome.status == "completed"
    ours = dict(figures(own.metrics))
    theirs = {key: value for key, value in figures(record.metrics) if key in ours}
    assert len(theirs) > 10
    found = {}
    for key, value in theirs.items():
        # residuals are rounding errors of momenta of the order of one
        size = 1.0 if "residual" in key else abs(ours[key])
        found[key] = abs(value - ours[key]) / max(size, 1e-6)
    for name in ("position", "velocity", "generalized_force", "applied_force", "error"):
        wanted = own.dataset[name].values
        found[name] = np.abs(record.dataset[name].values - wanted).max() / np.abs(wanted).max()
    return found


def flown(program, scenario, *settings, external=EXTERNAL):
    """The largest relative difference between a flown run and the run with the law itself."""
    own = simulate(load_scenario(scenario, list(settings)), check_stability=False)
    with flying(program) as (process, port):
        name = external.rpartition(":")[2]
        given = [f"controller={external}", f"controllers.{name}={{port: {port}, timeout: 20}}"]
        record = simulate(load_scenario(scenario, [*settings, *given]), check_stability=False)
        text = ended(process)
    assert f"answered {len(record.dataset.time)} requests, refused 0" in text
    assert not record.dataset["link_faults"].values.any()
    found = differences(record, own)
    worst = max(found, key=lambda key: found[key])
    print(f"{scenario} {settings}: largest relative difference {found[worst]:.2g} of {worst}")
    assert found[worst] < DIFFERENCE, worst
    return found[worst]


@pytest.mark.slow
def test_a_short_run_flown_in_c_is_the_run_with_the_law(tmp_path):
    settings = ("controller=tde_aismc", "duration=0.5")
    flown(built(tmp_path, "postcapture", *settings), "postcapture", *settings)


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["postcapture", "tumbling_capture"])
def test_missions_flown_in_c_are_those_of_the_law(tmp_path, scenario):
    flown(built(tmp_path, scenario), scenario)


@pytest.mark.long
def test_flags_of_measurements_and_the_path_of_a_frame_arrive(tmp_path):
    settings = ("controller=tdc", "duration=2")
    program = built(tmp_path, "slow_navigation", *settings)
    assert "#define LAW_READS_IS_NEW 1" in (tmp_path / "law.h").read_text()
    flown(program, "slow_navigation", *settings)
    framed = ("controller=task_computed_torque", "duration=2", *frame_of("postcapture"))
    (tmp_path / "framed").mkdir()
    program = built(tmp_path / "framed", "postcapture", *framed)
    assert "#define LAW_READS_FRAME 1" in (tmp_path / "framed" / "law.h").read_text()
    flown(program, "postcapture", *framed, external=f"{__name__}:Framed")


def request(sample, random, *, run=1, flags=HOLDS, **changes):
    """A request of small motions."""
    state = np.concatenate([[1.0], np.zeros(22)])
    values = np.concatenate([state, state, 1e-4 * random.normal(size=22)])
    given = {"run": run, "sample": sample, "time": 0.01 * sample, "flags": flags}
    return Packet(**{**given, "values": values, **changes})


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return built(
        tmp_path_factory.mktemp("fly"), "postcapture", "controller=tde_aismc", "duration=0.1"
    )


def asked(own, data, longest=0.3):
    """The reply to a packet; None: none comes."""
    own.settimeout(longest)
    own.send(data)
    try:
        return own.recv(65_507)
    except TimeoutError:
        return None


@contextlib.contextmanager
def connected(port):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.connect(("127.0.0.1", port))
        yield own


@pytest.mark.slow
def test_it_replies_as_the_pilot_does(program):
    """Runs with their own memory, requests that come again, late ones, jumps of velocities."""
    random, pilot = np.random.default_rng(3), Pilot(load_scenario("postcapture"))
    flags = [HOLDS | IS_FIRST, *(HOLDS,) * 8, HOLDS | IS_FIRST, HOLDS, HOLDS]
    plan = [request(k, random, run=run, flags=flags[k]) for k in range(12) for run in (7, 2**63)]
    plan.insert(9, plan[8])  # again
    with flying(program) as (process, port), connected(port) as own:
        for each in plan:
            reply, expected = read(asked(own, each.to_bytes(), 5.0)), pilot.reply(each)
            assert (reply.run, reply.sample, reply.flags) == (each.run, each.sample, 0)
            assert reply.time == each.time
            np.testing.assert_allclose(reply.values, expected.values, rtol=1e-9, atol=1e-9)
        assert asked(own, plan[0].to_bytes()) is None  # older than the last one
        text = ended(process, signal.SIGINT)
    assert "answered 25 requests, refused 0" in text


@pytest.mark.slow
def test_it_passes_over_packets_that_are_none(program):
    random = np.random.default_rng(4)
    good = [request(k, random) for k in range(3)]
    data = bytearray(good[1].to_bytes())
    bad = good[1].values.copy()
    bad[12] = np.nan
    turned = good[1].values.copy()
    turned[0] = 0.5
    hostile = {
        "what is no packet of this version": [
            b"", b"x", bytes(data[:-1]), b"XXXX" + bytes(data[4:]), bytes(data[:4]) + b"\2\0"
            + bytes(data[6:]), bytes(data[:6]) + b"\x18\0" + bytes(data[8:]), random.bytes(500),
        ],
        "another spacecraft": [
            bytes(data) + bytes(8), bytes(data[:32]), bytes(data[:32]) + bytes(8 * 8000),
            request(1, random, flags=HOLDS | HAS_NEW).to_bytes(),
            request(1, random, flags=HOLDS | HAS_FRAME).to_bytes(),
        ],
        "not finite, or beyond 1e9": [request(1, random, values=bad).to_bytes()],
        "not its sample times": [
            request(1, random, time=0.02).to_bytes(), request(1, random, time=np.nan).to_bytes(),
            request(2**32, random).to_bytes(),
        ],
        "the mission has no capture": [request(1, random, flags=0).to_bytes()],
        "not LAW_OK": [request(3, random, values=turned).to_bytes()],
    }  # fmt: skip
    with flying(program) as (process, port), connected(port) as own:
        undisturbed = [asked(own, each.to_bytes(), 5.0) for each in good]
        others = [request(k, np.random.default_rng(k), run=9) for k in range(3)]
        replies = [asked(own, others[0].to_bytes(), 5.0)]
        for each in (packet for packets in hostile.values() for packet in packets):
            own.send(each)
        replies += [asked(own, each.to_bytes(), 5.0) for each in others[1:]]
        assert all(undisturbed)
        assert all(replies)
        text = ended(process)
    number = sum(map(len, hostile.values()))
    assert f"answered 6 requests, refused {number}" in text
    for reason, packets in hostile.items():
        (line,) = (each for each in text.splitlines()
                   if each.startswith("refused ") and reason in each and "times:" in each
                   and not each.startswith("refused: "))  # fmt: skip
        assert line.startswith(f"refused {len(packets)} times: ")


@pytest.mark.slow
def test_a_refused_request_changes_no_memory(program):
    random = np.random.default_rng(5)
    good = [request(k, random, run=1) for k in range(4)]
    bad = good[2].values.copy()
    bad[0] = 0.1
    with flying(program) as (_, port), connected(port) as own:
        expected = [asked(own, each.to_bytes(), 5.0) for each in good]
        for k, each in enumerate(good):
            own.send(request(k, random, run=2, values=bad).to_bytes())
            again = Packet(run=2, sample=k, time=each.time, flags=each.flags, values=each.values)
            assert asked(own, again.to_bytes(), 5.0)[32:] == expected[k][32:]


def test_wrong_arguments_are_refused_in_one_line(program):
    for wrong in (["--port", "70000"], ["--port", "x"], ["--port"], ["x"], ["--host", "a.b"]):
        text = run(program.parent, program, *wrong, code=2)
        assert text.count("\n") == 1
        assert text.startswith(("usage: ", "error: --host"))
    with flying(program) as (_, port):
        text = run(program.parent, program, "--port", port, code=2)
    assert f"cannot listen at 127.0.0.1, port {port}" in text
