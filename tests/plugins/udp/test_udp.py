"""A run flown by another process over UDP has the bits of the run with the law itself; packets that
are lost, late, doubled or hostile are survived, and counted in the record.
"""

import contextlib
import dataclasses
import os
import signal
import socket
import struct
import sys
import threading
import time

import numpy as np
import pytest
from children import PIPE, child

from ffsm_drake import BlockError, FfsmError, load_scenario, simulate
from ffsm_drake.plugins.udp.external import FAULTS, External
from ffsm_drake.plugins.udp.fly import Pilot, main
from ffsm_drake.plugins.udp.packets import HAS_NEW, HOLDS, Packet, inputs_of, read
from ffsm_drake.systems.controllers import ControlLaw

EXTERNAL = "controller=ffsm_drake.plugins.udp.external:External"
LENGTH = "duration=0.6"
NO_FORCE = np.zeros(11)


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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sized(ControlLaw):
    """Its memory has another size with the target."""

    size: int

    @classmethod
    def from_setup(cls, setup):
        return cls(size=1 + setup.grip.holds)

    def initial_state(self):
        return {"kept": np.zeros(self.size), "count": np.zeros(1)}

    def step(self, sample, state):
        after = {"kept": np.ones(self.size), "count": state["count"] + 1.0}
        return np.full(11, 10.0 * state["kept"].sum()) + state["count"], after


def test_memory_of_another_size_begins_anew_with_the_target():
    flying = Pilot(load_scenario("tumbling_capture", [f"controller={__name__}:Sized"]))
    state = np.concatenate([[1.0], np.zeros(22)])
    values = np.concatenate([state, state, np.zeros(22)])
    forces = [
        flying.reply(Packet(run=1, sample=k, time=0.01 * k, flags=flags, values=values)).values[0]
        for k, flags in enumerate((0, 0, HOLDS, HOLDS))
    ]
    assert forces == [0.0, 11.0, 2.0, 23.0]


CLOSING = ("capture.closing={joints: controlled}", "duration=9.5")
SHORT = ("capture.approach.duration=8", "duration=8.5", "disturbance.amplitude_scale=0")


@pytest.mark.long
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


def faults_of(record):
    """The samples with a fault, by kind."""
    counts = record.dataset["link_faults"].values
    found = {name: np.flatnonzero(counts[:, i]).tolist() for i, name in enumerate(FAULTS)}
    assert record.metrics["link"] == {
        **{name: counts[:, i].sum() for i, name in enumerate(FAULTS)},
        "samples": len(counts),
    }
    return found


@pytest.mark.long
def test_faults_before_the_grasp_stay_in_the_record():
    flying = pilot("tumbling_capture", *(f"--set={each}" for each in SHORT))
    with flying as port, faulty(port) as through:
        record = flown(through, *SHORT, scenario="tumbling_capture")
    assert record.dataset["phase"].values[-1] == "stop"
    found = faults_of(record)
    assert found["lost"] == [10, 20]
    assert len(found["late"]) == len(found["doubled"]) == 1
    assert found["refused"] == []


@contextlib.contextmanager
def between(handle, port=None):
    """A socket whose packets a thread hands to a function, with a socket that is connected to a
    pilot's port, and an event that ends it. Gives the socket's port.
    """
    front, back = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    front.bind(("127.0.0.1", 0))
    if port is not None:
        back.connect(("127.0.0.1", port))
    for each in (front, back):
        each.settimeout(0.1)
    ends = threading.Event()

    def relay():
        while not ends.is_set():
            with contextlib.suppress(TimeoutError):
                data, sender = front.recvfrom(65_507)
                handle(data, lambda packet, to=sender: front.sendto(packet, to), back, ends)

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
def test_answers_to_requests_sent_again_are_no_faults():
    """The first request goes out again while nobody answers."""
    late = []

    def answer(data, send, *_):
        """Answer every request, also one that comes again; the first 0.35 s late."""
        request = read(data)
        if request.sample == 0 and not late:
            late.append(request)
            time.sleep(0.35)
        reply = Packet(run=request.run, sample=request.sample, time=0.0, flags=0, values=NO_FORCE)
        send(reply.to_bytes())

    with between(answer) as port:
        record = flown(port, "duration=0.2", "controllers.External.timeout=5")
    assert late
    assert not any(faults_of(record).values())
    assert not any("External" in each.sentence for each in record.parts)


def faulty(port):
    """A relay that loses the reply to sample 10, delays that to 20, doubles that to 30."""

    def relay(data, send, back, _):
        back.settimeout(5.0)
        back.send(data)
        reply = back.recv(65_507)
        sample = read(reply).sample
        if sample == 20:
            time.sleep(0.3)
        for _ in range({10: 0, 30: 2}.get(sample, 1)):
            send(reply)

    return between(relay, port)


@pytest.mark.slow
def test_lost_late_and_doubled_packets_are_survived_and_counted():
    with pilot("postcapture", "-c", "tde_aismc") as port, faulty(port) as through:
        record = flown(through)
    assert record.outcome.completed
    force = record.dataset["generalized_force"].values
    found = faults_of(record)
    assert found["lost"] == [10, 20]
    assert len(found["late"]) == len(found["doubled"]) == 1
    # held at those two samples
    assert [k for k in range(1, len(force)) if np.array_equal(force[k], force[k - 1])] == [10, 20]
    assert np.abs(record.dataset["error"].values).max() < 1e-3
    told = [each.sentence for each in record.parts if each.title == "External controller"]
    assert "no reply in time at 2 of 61 samples" in told[0]


KINDS = (
    *("random", "zeros", "cut", "longer", "another size", "nan", "inf", "huge", "quaternion"),
    *("sample", "time", "run", "version", "flags", "replayed", "nothing"),
)
HEAD = 32


def hostile(data, before, random, *, longest=60_000):
    """A packet that is none, made from a good one or one before it (bytes)."""
    kind, damaged = random.choice(KINDS), bytearray(data)
    if kind in ("random", "zeros", "nothing"):
        size = 0 if kind == "nothing" else int(random.integers(1, 500))
        return bytes(size) if kind != "random" else random.bytes(size)
    if kind == "cut":
        return bytes(data[: random.integers(len(data))])
    if kind == "longer":
        return bytes(data) + random.bytes(int(random.integers(1, longest)))
    if kind == "another size":
        return bytes(data[:HEAD]) + bytes(8 * int(random.choice([1, 10, 12, 67, 69, 200])))
    if kind == "replayed":
        return before
    if kind in ("nan", "inf", "huge", "quaternion"):
        values = np.frombuffer(data, "<f8", offset=HEAD).copy()
        if kind == "quaternion":
            values[:4] *= random.choice([0.0, 0.5, 3.0, 1e6])
            values[0] += 1e10 if values.size == 11 else 0.0  # a reply has none
        else:
            value = {"nan": np.nan, "inf": -np.inf, "huge": 10.0 ** random.uniform(10, 308)}[kind]
            values[random.integers(values.size)] = value
        return bytes(data[:HEAD]) + values.tobytes()
    at, form, value = {
        "sample": (16, "<Q", int(random.integers(1000, 2**62))),
        "time": (24, "<d", random.choice([np.nan, np.inf, -1.0, 1e300])),
        "run": (8, "<Q", int(random.integers(2**62))),
        "version": (4, "<H", int(random.integers(2, 2**16))),
        "flags": (6, "<H", int(random.integers(16, 2**16))),
    }[kind]
    damaged[at : at + struct.calcsize(form)] = struct.pack(form, value)
    return bytes(damaged)


NUMBER = int(os.environ.get("FFSM_HOSTILE_PACKETS", "300"))


def test_a_pilot_passes_over_hostile_packets():
    """Replies to the good packets keep their bits, and all others are counted."""
    undisturbed, flying = (Pilot(load_scenario("postcapture")) for _ in range(2))
    random, state = np.random.default_rng(1), np.concatenate([[1.0], np.zeros(22)])
    before, refused = [], 0
    for sample in range(30):
        values = np.concatenate([state, state, 1e-4 * random.normal(size=22)])
        good = Packet(run=7, sample=sample, time=0.01 * sample, flags=HOLDS, values=values)
        data = good.to_bytes()
        for _ in range(NUMBER // 30):
            flying.answer(hostile(data, before[-1] if before else b"", random))
        answer = flying.answer(data)
        assert answer == undisturbed.answer(data)
        assert answer is not None
        before.append(data)
    refused = flying.refused.total()
    # foreign runs and replayed requests are well-formed
    assert 0.7 * NUMBER < refused <= NUMBER
    assert len(flying.refused) <= 21
    assert undisturbed.refused.total() == 0


def attacked(port, number, sent):
    """A relay that puts hostile packets before good ones, to both sides, and counts them."""
    random, before = np.random.default_rng(2), [b"", b""]

    def replies(sample, back, ends):
        """The next reply to a sample; others answer foreign runs, and replayed requests."""
        while not ends.is_set():
            with contextlib.suppress(TimeoutError):
                data = back.recv(65_507)
                if read(data).sample == sample:
                    return data
        return b""

    def relay(data, send, back, ends):
        for _ in range(number):
            damaged = hostile(data, before[0], random, longest=500)
            if read(damaged) is not None and read(damaged).run != read(data).run:
                continue  # the pilot would answer it, and this relay take that for the reply
            back.send(damaged)
            sent[0] += 1
        back.send(data)
        answer = replies(read(data).sample, back, ends)
        for _ in range(number):
            send(hostile(answer or data, before[1], random, longest=500))
            sent[1] += 1
        if answer:
            send(answer)
        before[:] = data, answer

    return between(relay, port)


@pytest.mark.slow
def test_a_run_between_hostile_packets_has_its_bits():
    given = [LENGTH, "controller=tde_aismc"]
    own = simulate(load_scenario("postcapture", given), check_stability=False)
    sent = [0, 0]
    with (
        pilot("postcapture", "-c", "tde_aismc") as port,
        attacked(port, -(-NUMBER // 61), sent) as through,
    ):
        record = flown(through, "controllers.External.timeout=20")
    for name in ("position", "velocity", "generalized_force"):
        assert np.array_equal(record.dataset[name], own.dataset[name]), name
    counted = record.metrics["link"]
    assert sent[0] > 0.8 * NUMBER
    assert sent[1] >= NUMBER
    assert (counted["lost"], counted["late"]) == (0, 0)
    # a reply with other flags, or at another time, is a good one that comes early
    assert counted["refused"] + counted["doubled"] > 0.6 * sent[1]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.slow
def test_a_pilot_ends_on_a_signal_and_tells_its_counts(number):
    command = [sys.executable, "-m", "ffsm_drake.plugins.udp.fly", "postcapture", "--port", "0"]
    with child(command, stdout=PIPE, text=True) as process:
        port = int(process.stdout.readline().rpartition(":")[2])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
            own.sendto(bytes(40), ("127.0.0.1", port))
        assert process.stdout.readline() == "refused: what is no packet of this version\n"
        process.send_signal(number)
        begin = time.monotonic()
        assert process.wait(20) == 0
        assert time.monotonic() - begin < 10.0  # on a quiet machine, much less than one
        assert process.stdout.read().startswith("answered 0 requests, refused 1\n")


@pytest.mark.smoke
def test_nobody_answers():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    with pytest.raises(BlockError, match=f"no external controller answers at 127.0.0.1:{port}"):
        flown(port, "controllers.External.connect=0.2")


@pytest.mark.smoke
@pytest.mark.parametrize(
    ("setting", "problem"),
    [
        ("prt=5", r"prt: unknown gain; External has port, .*; did you mean 'port'"),
        ("port=0", r"port: must be from 1 to 65535, not 0"),
        ("port=1e400", r"port.all: must be finite"),
        ("port=70000", r"port: must be from 1 to 65535, not 70000"),
        ("port=80.5", r"port: must be a whole number, not 80.5"),
        ("port={joints: 5}", r"port: must be one number for all coordinates, not all, joints"),
        ("port=null", r"port: must be a number"),
        ("timeout=0", r"timeout: must be > 0, at most 86400 s, not 0"),
        ("connect=1e9", r"connect: must be > 0, at most 86400 s, not 1000000000"),
        ("real_time=2", r"real_time: must be from 0 to 1, not 2"),
    ],
)
def test_a_wrong_setting(setting, problem):
    with pytest.raises(FfsmError, match=rf"controllers\.External\.{problem}") as caught:
        simulate(
            load_scenario("postcapture", [LENGTH, EXTERNAL, f"controllers.External.{setting}"]),
            check_stability=False,
        )
    assert len(str(caught.value)) < 161


def test_a_host_that_does_not_exist():
    class Far(External):
        host = "no such host"

    with pytest.raises(FfsmError, match="host: cannot connect to 'no such host', port 5020"):
        simulate(
            load_scenario("postcapture", [LENGTH]), blocks={"controller": Far},
            check_stability=False,
        )  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("--port", "70000"), "--port: must be from 0 to 65535, not 70000"),
        (("--host", "no such host"), "--host, --port: cannot bind to 'no such host', port 5020;"),
        (("--port", None), "--host, --port: cannot bind to '127.0.0.1', port "),
        (("--set", "duration=-3"), "duration: must be > 0 s, not -3"),
    ],
)
def test_a_pilot_that_cannot_begin_says_so_in_a_line(arguments, problem, capsys):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as used:
        used.bind(("127.0.0.1", 0))
        port = str(used.getsockname()[1])
        given = [port if each is None else each for each in arguments]
        with pytest.raises(SystemExit) as ended:
            main(["postcapture", *given])
    assert ended.value.code == 2
    line = capsys.readouterr().err
    assert line.startswith("error: ")
    assert problem in line
    assert line.count("\n") == 1
    assert len(line) < 200
