"""A run flown by another process over UDP has the bits of the run with the law itself; packets that
are lost, late or doubled are survived, and written down.
"""

import contextlib
import csv
import dataclasses
import socket
import sys
import threading
import time

import numpy as np
import pytest
from children import PIPE, child

from ffsm_drake import BlockError, load_scenario, simulate
from ffsm_drake.plugins.udp.fly import Pilot
from ffsm_drake.plugins.udp.packets import HAS_NEW, HOLDS, Packet, inputs_of, read

EXTERNAL = "controller=ffsm_drake.plugins.udp.external:External"
LENGTH = "duration=0.6"


@contextlib.contextmanager
def pilot(*arguments):
    """A law in a process of its own; gives its port."""
    command = [sys.executable, "-m", "ffsm_drake.plugins.udp.fly", *arguments, "--port", "0"]
    with child(command, stdout=PIPE, text=True) as process:
        words = process.stdout.readline()
        assert words.startswith("listening on 127.0.0.1:"), words
        yield int(words.rpartition(":")[2])


def flown(port, *settings, scenario="postcapture"):
    given = f"controllers.External={{port: {port}, timeout: 0.2}}"
    overrides = [LENGTH, EXTERNAL, given, *settings]
    return simulate(load_scenario(scenario, overrides), check_stability=False)


@pytest.mark.smoke
def test_packets_come_back_as_they_were():
    values = np.random.default_rng(0).normal(size=80)
    sent = Packet(run=2**63 + 5, sample=7, time=0.07, flags=HAS_NEW, values=values)
    found = read(sent.to_bytes())
    assert found.run == sent.run
    assert (found.sample, found.time, found.flags) == (7, 0.07, HAS_NEW)
    assert np.array_equal(found.values, values)
    assert read(sent.to_bytes()[:-3]) is None
    assert read(b"XXXX" + sent.to_bytes()[4:]) is None
    with pytest.raises(ValueError, match="another spacecraft"):
        inputs_of(found, 12, 11)


@pytest.mark.smoke
def test_a_request_that_comes_again_makes_no_step():
    flying = Pilot(load_scenario("postcapture", ["controller=tde_aismc"]))
    random = np.random.default_rng(0)
    state = np.concatenate([[1.0], np.zeros(22)])

    def request(sample):
        values = np.concatenate([state, state, 1e-4 * random.normal(size=22)])
        return Packet(run=1, sample=sample, time=0.01 * sample, flags=HOLDS, values=values)

    first, second = request(0), request(1)
    one = flying.reply(first)
    assert flying.reply(first) is one
    after = flying.reply(second)
    assert flying.reply(first) is None
    again = Pilot(load_scenario("postcapture", ["controller=tde_aismc"]))
    again.reply(first)
    assert np.array_equal(again.reply(second).values, after.values)
    with pytest.raises(ValueError, match="the mission has no capture"):
        again.reply(dataclasses.replace(request(2), flags=0))


CLOSING = ("capture.closing={joints: controlled}", "duration=9.5")
SHORT = ("capture.approach.duration=8", "duration=8.5", "disturbance.amplitude_scale=0")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenario", "law", "settings"),
    [
        ("postcapture", "tde_aismc", ()),
        ("slow_navigation", "tdc", ()),
        ("tumbling_capture", "tde_aismc", SHORT),
        ("tumbling_capture", "computed_torque", (*SHORT, *CLOSING)),
    ],
)
def test_it_has_the_bits_of_the_run_with_the_law(scenario, law, settings):
    given = [LENGTH, f"controller={law}", *settings]
    own = simulate(load_scenario(scenario, given), check_stability=False)
    if settings:
        assert own.dataset["phase"].values[-1] == "stop"
    with pilot(scenario, "-c", law, *(f"--set={each}" for each in settings)) as port:
        for _ in range(2):  # the second begins anew
            record = flown(port, *settings, scenario=scenario)
            for name in ("position", "velocity", "generalized_force", "error"):
                assert np.array_equal(record.dataset[name], own.dataset[name]), name
            assert record.metrics["itae"] == own.metrics["itae"]


@pytest.mark.slow
def test_faults_before_the_grasp_stay_written_down(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    flying = pilot("tumbling_capture", *(f"--set={each}" for each in SHORT))
    with flying as port, faulty(port) as through:
        record = flown(through, *SHORT, scenario="tumbling_capture")
    assert record.dataset["phase"].values[-1] == "stop"
    with open("udp_faults.csv") as file:
        rows = [(int(row["sample"]), row["fault"]) for row in csv.DictReader(file)]
    assert rows.count((10, "lost")) == rows.count((20, "lost")) == 1
    assert sorted(fault for _, fault in rows) == ["doubled", "late", "lost", "lost"]


def slow_answers(back, ends):
    """Answers every request, also one that comes again; the first 0.35 s late."""
    back.settimeout(0.1)
    while not ends.is_set():
        with contextlib.suppress(TimeoutError):
            data, sender = back.recvfrom(65_507)
            request = read(data)
            if request.sample == 0 and not ends.late:
                ends.late = True
                time.sleep(0.35)
            force = np.zeros(11)
            reply = Packet(run=request.run, sample=request.sample, time=0.0, flags=0, values=force)
            back.sendto(reply.to_bytes(), sender)


@pytest.mark.slow
def test_answers_to_requests_sent_again_are_no_faults(tmp_path, monkeypatch):
    """The first request goes out again while nobody answers."""
    monkeypatch.chdir(tmp_path)
    ends = threading.Event()
    ends.late = False
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as back:
        back.bind(("127.0.0.1", 0))
        thread = threading.Thread(target=slow_answers, args=(back, ends), daemon=True)
        thread.start()
        try:
            flown(back.getsockname()[1], "duration=0.2", "controllers.External.timeout=5")
        finally:
            ends.set()
            thread.join()
    assert ends.late
    assert not (tmp_path / "udp_faults.csv").exists()


@contextlib.contextmanager
def faulty(port):
    """A relay that loses the reply to sample 10, delays that to 20, doubles that to 30."""
    front, back = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    front.bind(("127.0.0.1", 0))
    back.connect(("127.0.0.1", port))
    back.settimeout(5.0)
    ends = threading.Event()
    front.settimeout(0.1)

    def relay():
        while not ends.is_set():
            try:
                data, sender = front.recvfrom(65_507)
            except TimeoutError:
                continue
            back.send(data)
            reply = back.recv(65_507)
            sample = read(reply).sample
            if sample == 10:
                continue
            if sample == 20:
                time.sleep(0.3)
            for _ in range(2 if sample == 30 else 1):
                front.sendto(reply, sender)

    thread = threading.Thread(target=relay, daemon=True)
    thread.start()
    try:
        yield front.getsockname()[1]
    finally:
        ends.set()
        thread.join()
        front.close()
        back.close()


@pytest.mark.slow
def test_lost_late_and_doubled_packets_are_survived_and_written_down(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pilot("postcapture", "-c", "tde_aismc") as port, faulty(port) as through:
        record = flown(through)
    assert record.outcome.completed
    force = record.dataset["generalized_force"].values
    same = [k for k in range(1, len(force)) if np.array_equal(force[k], force[k - 1])]
    with open("udp_faults.csv") as file:
        rows = [(int(row["sample"]), row["fault"]) for row in csv.DictReader(file)]
    assert (10, "lost") in rows
    assert (20, "lost") in rows
    faults = [fault for _, fault in rows]
    assert sorted(faults) == ["doubled", "late", "lost", "lost"]
    assert len(same) == 2  # held at those two samples
    assert np.abs(record.dataset["error"].values).max() < 1e-3


@pytest.mark.smoke
def test_nobody_answers():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    with pytest.raises(BlockError, match=f"no external controller answers at 127.0.0.1:{port}"):
        flown(port, "controllers.External.connect=0.2")


@pytest.mark.smoke
def test_a_misspelt_setting():
    with pytest.raises(BlockError, match=r"controllers\.External\.prt: unknown; there are connect"):
        flown(1, "controllers.External.prt=5")
