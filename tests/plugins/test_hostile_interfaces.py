"""What other programs give to the interfaces, drawn from each kind: policies, actions, steps of an
FMU, who connects to Foxglove's server, programs at one folder, a Slurm step's variables, and how an
interpreter ends while a run is under way.

An input ends cleanly with a result, or with an ``FfsmError`` of one line; each check says what the
result must be.
"""

import atexit
import collections
import contextlib
import ctypes
import functools
import gc
import importlib
import json
import os
import shutil
import sys
import tempfile
import threading
import time
import weakref
from pathlib import Path

import numpy as np
import pytest
from alone import run_alone
from children import forked
from fuzz.forked import drawn, unclean
from fuzz.fuzz_inputs import mutated_bytes
from hypothesis import strategies as st

from ffsm_drake import FfsmError, load_scenario
from ffsm_drake.mission import make_mission
from ffsm_drake.scenario import controller_key
from ffsm_drake.spacecraft.craft import make_nominal_plant

SENTINEL = "sentinel_of_a_policy"  # a module that no file may import
SHORT = ("duration=0.3",)


# Policies: files that are only looked at

LAWS = [
    f"{SENTINEL}:make",
    "os:system",
    "os:abort",
    "tdc",
    "",
    "policy:p.onnx",
    "no_law",
    "../x:y",
    "\0",
]
NAMES = ["p", "sub/policy-v2", "a b", "x.y", "p'q\"", "é", "..", "sub/../p", "a@b", "p:q"]


def mostly(good, *bad):
    """What is good, but in one of six draws."""
    return st.integers(0, 5).flatmap(lambda k: st.sampled_from(bad) if k == 5 else st.just(good))


POLICIES = st.fixed_dictionaries(
    {
        "name": st.sampled_from(NAMES),
        "metadata": st.fixed_dictionaries(
            {
                "action": mostly("residual", "setpoint", "force", "torque"),
                "law": st.sampled_from(LAWS) | st.text(max_size=20),
                "scale": mostly("good", "[1e999]", "{}", "[" * 3000, "null"),
                "samples_per_step": mostly("1", "4", "0", "-1", "1e9", "9" * 5000),
            }
        ),
        "data": mostly("", "w.bin", "../w.bin", "/etc/passwd", "link"),
        "spoil": mostly(False, True),
        "at": mostly("", "@tdc", f"@{SENTINEL}:make", "@none", "@policy:p.onnx"),
    }
)


@functools.cache
def nominal():

    return make_nominal_plant(load_scenario("postcapture"))


@functools.cache
def model():
    """A network as ONNX, with metadata that fit, and their scale."""
    from networks import linear_policy, metadata_of

    coordinates = nominal().coordinates
    metadata = metadata_of(load_scenario("postcapture"), coordinates)
    size = len(coordinates.names)
    return linear_policy(np.zeros((size, 4 * size + 1)), metadata), metadata


def look_at_policy(given):
    """Data import nothing; a law of the user's own is the user's to name."""
    import onnx

    made, own = model()
    made = type(made).FromString(made.SerializeToString())
    scale = given["metadata"]["scale"].replace("good", own["scale"])
    onnx.helper.set_model_props(made, own | given["metadata"] | {"scale": scale})
    folder = Path("policies").resolve()
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "sub").mkdir(parents=True)
    file = folder / f"{given['name']}.onnx"
    size = 4 * int(np.prod(made.graph.initializer[0].dims))
    Path("w.bin").write_bytes(bytes(size))
    (file.parent / "w.bin").write_bytes(bytes(size))
    (file.parent / "link").symlink_to("../w.bin")
    if given["data"]:
        tensor = made.graph.initializer[0]
        tensor.ClearField("raw_data")
        tensor.data_location = 1
        for key, value in {"location": given["data"], "offset": "0", "length": str(size)}.items():
            entry = tensor.external_data.add()
            entry.key, entry.value = key, value
    content = made.SerializeToString()
    if given["spoil"]:
        content = drawn(mutated_bytes(content), 1, start=len(given["name"]))[0]
    file.write_bytes(content)
    (folder / "s.yaml").write_text(
        json.dumps(
            {"extends": "postcapture", "controller": f"policy:{given['name']}.onnx{given['at']}"}
        )
    )
    (folder / f"{SENTINEL}.py").write_text("def make(setup): raise RuntimeError")
    sys.path.append(str(folder))  # as the folder of a user is
    try:
        from ffsm_drake.systems.controllers import make_controller

        scenario = load_scenario(str(folder / "s.yaml"))
        assert set(controller_key(scenario.controller)).isdisjoint("/\\.:@'\" ")
        make_controller(make_mission(scenario), nominal())
        assert given["spoil"] or given["data"] in ("", "w.bin"), "a file outside was read"
    finally:
        sys.path.remove(str(folder))
        # here, since most policies are refused
        imported = sys.modules.pop(SENTINEL, None)
        assert imported is None or given["at"] == f"@{SENTINEL}:make", "a file imported a module"


# Actions: of an environment of several copies

ACTIONS = st.lists(
    st.tuples(
        st.sampled_from([(3, 11), (3, 11), (3, 11), (3, 11), (11,), (), (1, 11), (3, 1), (2, 11)]),
        st.lists(st.tuples(st.integers(0, 2), st.integers(0, 10)), max_size=2),
        st.sampled_from([np.nan, np.nan, np.inf, -np.inf, 1e300]),
    ),
    min_size=1,
    max_size=5,
)


@functools.cache
def environment(kind):
    import gymnasium

    import ffsm_drake.plugins.gymnasium  # noqa: F401

    return gymnasium.make_vec(
        "ffsm/PostCapture-v0", num_envs=3, vectorization_mode="vector_entry_point",
        overrides=SHORT, action=kind, scale=1e-3,
    )  # fmt: skip


def act(given):
    """A wrong shape is refused; a copy ends whose action is no number, and no other."""
    env = environment(("force", "residual", "setpoint")[len(given) % 3])
    env.reset(seed=1)
    anew = np.zeros(3, bool)
    for shape, places, value in given:
        actions = np.zeros(shape)
        if shape != (3, 11):
            with pytest.raises(FfsmError, match="action: must have the shape"):
                env.step(actions)
            continue
        for place in places:
            actions[place] = value
        seen, reward, ended, cut, info = env.step(actions)
        assert np.isfinite(seen).all()
        assert np.isfinite(reward).all()
        lost = np.isnan(actions).any(axis=1) & ~anew
        assert ended.tolist() == lost.tolist(), (ended, lost)
        assert not cut.any()
        if lost.any():
            assert all("is nan" in info["ending"][k] for k in np.flatnonzero(lost))
        anew = ended


# Steps of an FMU

STEPS = st.lists(
    st.tuples(
        st.sampled_from(["due", "due", "due", -1.0, np.nan, np.inf, 77.0, 0.005]),
        st.sampled_from([0.01, 0.01, 0.01, 0.0, -0.01, 0.02, np.nan, np.inf]),
        st.sampled_from([0.0, 0.0, 0.0, np.nan, 1e9]),
    ),
    min_size=1,
    max_size=4,
)


@functools.cache
def fmu_of_plant():
    """An FMU, and the folder for what is in it."""
    from ffsm_drake.plugins.flight.fmu import write_fmu

    folder = Path(tempfile.mkdtemp(dir=Path.cwd()))
    write_fmu(load_scenario("postcapture", SHORT), folder / "plant.fmu")
    return folder / "plant.fmu", folder / "inside"


def step_fmu(given):
    """Only the step that is due is one."""
    from driven_fmu import Driven
    from fmpy.fmi1 import FMICallException

    plant = Driven(*fmu_of_plant())
    forces = plant.of("force")
    done, ended = 0, False
    for when, size, force in given:
        plant.fmu.setFloat64(forces, [force] * len(forces))
        time_is = 0.01 * done if when == "due" else when
        is_right = size == 0.01 and abs(time_is - 0.01 * done) < 1e-5 and not ended
        try:
            _, ended, _, last = plant.fmu.doStep(time_is, size)
        except FMICallException:
            assert not is_right, (when, size, done)
            continue
        done += 1
        assert is_right, (when, size, done)
        assert abs(last - 0.01 * done) < 1e-9
    plant.end()


# Who connects to Foxglove's server

CONNECTIONS = st.fixed_dictionaries(
    {
        "path": st.sampled_from(["right", "right", "/", "", "/x", "/right", "?right"]),
        "host": st.sampled_from(
            ["", "", "", "evil.example", "127.0.0.1.evil.example", "localhost", "[::1]", "0.0.0.0"]
        ),
        "origin": st.sampled_from(["http://evil.example", "null", "https://app.foxglove.dev", ""]),
        "frame": st.sampled_from(
            [
                '{"op":"subscribe"}',
                '{"op":"advertise"}',
                '{"op":"setParameters"}',
                "[]",
                "x",
                b"\1",
                "",
            ]
        )
        | st.text(max_size=20)
        | st.binary(max_size=20),
    }
)


@functools.cache
def served():
    """A door, and what the server behind it was told."""
    from websockets.sync.server import serve

    from ffsm_drake.plugins.foxglove.view import FoxgloveDoor

    told = []

    def hear(line):
        line.send("hello")
        for frame in line:
            told.append(frame)

    server = serve(hear, "127.0.0.1", 0, subprotocols=["foxglove.sdk.v1"])
    threading.Thread(target=server.serve_forever, daemon=True).start()
    port = server.socket.getsockname()[1]
    return FoxgloveDoor(f"ws://127.0.0.1:{port}", 0), told


def connect_to_foxglove(given):
    """Let in is who knows the address, at a name of this machine; it can subscribe, and no more."""
    from websockets.exceptions import ConnectionClosed, InvalidStatus
    from websockets.sync.client import ClientConnection, connect

    class Line(ClientConnection):
        """One that tells another host."""

        def handshake(self, *args, **settings):
            make = self.protocol.connect

            def made():
                request = make()
                if given["host"]:
                    del request.headers["Host"]
                    request.headers["Host"] = given["host"]
                return request

            self.protocol.connect = made
            super().handshake(*args, **settings)

    door, told = served()
    told.clear()
    bare, _, right = door.url.rpartition("/")
    path = {"right": f"/{right}", "/right": f"//{right}", "?right": f"/?{right}"}.get(
        given["path"], given["path"]
    )
    is_right = path == f"/{right}" and given["host"] in ("", "localhost")
    try:
        with connect(
            bare + path, subprotocols=["foxglove.sdk.v1"], origin=given["origin"] or None,
            create_connection=Line, close_timeout=1.0,
        ) as line:  # fmt: skip
            assert is_right, "let in"
            assert line.recv(timeout=5) == "hello"
            with contextlib.suppress(ConnectionClosed):  # for a frame that no page sends
                line.send(given["frame"])
                line.send('{"op":"unsubscribe"}')
                until = time.monotonic() + 5
                while not told or "unsub" not in told[-1]:
                    assert time.monotonic() < until, "nothing was passed on"
                    with contextlib.suppress(TimeoutError):
                        line.recv(timeout=0.002)
            assert set(told) <= {'{"op":"subscribe"}', '{"op":"unsubscribe"}'}, told
    except InvalidStatus as refusal:
        status = refusal.response.status_code
    else:
        return
    assert not is_right, "refused"
    assert status == 403


# Programs at one folder

WRITERS = st.fixed_dictionaries(
    {
        "there": st.sampled_from(["", "folder", "notes"]),
        "pauses": st.lists(st.integers(0, 6), min_size=2, max_size=4),
    }
)


def write_together(given):
    """Every record that began when there was none is kept, whole."""
    from ffsm_drake.common.files import published, stamp

    shutil.rmtree("together", ignore_errors=True)
    place = Path("together/out")
    place.parent.mkdir()
    if given["there"]:
        place.mkdir()
    if given["there"] == "notes":
        (place / "notes.txt").write_text("mine")
    problems = []

    def write(number, pause):
        def is_taken():
            return stamp(place / "manifest.json") is not None

        try:
            time.sleep(1e-3 * pause)
            with published(place, is_taken=is_taken, elsewhere=[]) as folder:
                for name in ("manifest.json", "record.nc"):
                    (folder / name).write_text(str(number))
                time.sleep(1e-3 * pause)
        except Exception as error:
            problems.append(error)

    threads = [threading.Thread(target=write, args=each) for each in enumerate(given["pauses"])]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not problems, problems
    found = {
        tuple((folder / name).read_text() for name in ("manifest.json", "record.nc"))
        for folder in place.parent.iterdir()
    }
    assert found == {(str(k), str(k)) for k in range(len(threads))}
    assert given["there"] != "notes" or (place / "notes.txt").read_text() == "mine"


# A Slurm step's variables

NUMBERS = st.sampled_from(["", "4", "4", "7", "1", "-1", "x", "1e3", "²", "9" * 30, "../x", "{a}"])
SLURM = st.fixed_dictionaries(
    {
        f"SLURM_{name}": NUMBERS
        for name in ("NTASKS", "PROCID", "JOB_ID", "STEP_ID", "RESTART_COUNT")
    }
)


def begin_step(given):
    """Refused, or waited for within the bound: no scheduler is there."""
    from ffsm_drake.common.errors import WorkersError
    from ffsm_drake.plugins.workers.cluster import slurm_workers

    for name, value in given.items():
        os.environ.pop(name, None)
        if value:
            os.environ[name] = value
    with pytest.raises(WorkersError, match=r"^--slurm: [^\n]*$"), slurm_workers(patience=0.02):
        pass


# How an interpreter ends

KINDS = ["single", "several"]
ENDINGS = st.fixed_dictionaries(
    {
        "what": st.sampled_from(KINDS),
        "under_way": st.booleans(),
        "held_by": st.sampled_from(["global", "cycle", "thread", "atexit", "nobody"]),
        "raises": st.booleans(),
        "late": st.booleans(),  # a step, or a reset, is asked for when all has ended
    }
)


def begun(kind):
    """Something with a run under way, what lets its run go on, and what steps it."""
    from ffsm_drake.plugins.gymnasium.environment import MissionEnv
    from ffsm_drake.plugins.gymnasium.vector import MissionVectorEnv

    several = kind == "several"
    env = (
        MissionVectorEnv(1, "postcapture", SHORT, engine="drake")
        if several
        else MissionEnv("postcapture", SHORT)
    )
    env.reset(seed=1)
    first, zeros = env.envs[0] if several else env, np.zeros(env.action_space.shape)
    run, answer = first._exchange.run, np.zeros(first.action_space.shape)
    return env, run, answer, lambda: env.step(zeros)


class Cycle:
    """What only the garbage collector frees."""

    def __init__(self, held):
        self.held, self.own = held, self


def end_interpreter(given):
    """In a fork: exit code 0, or 1 after an exception, whatever holds the run."""
    importlib.import_module("ffsm_drake.plugins.gymnasium.vector")  # once, for all forks
    ended = forked(lambda _: end_this_interpreter(given), silence=60.0)
    assert ended.code == int(given["raises"]), f"{ended.death} exit code {ended.code}"


def end_this_interpreter(given):
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    owner, run, answer, step = begun(given["what"])
    if given["late"]:

        def late():
            with contextlib.suppress(FfsmError):
                step()

        # called after the runs have ended, as what was registered before them
        atexit.unregister(weakref.finalize._exitfunc)
        atexit.register(late)
        atexit.register(weakref.finalize._exitfunc)
    if given["held_by"] == "global":
        sys.modules["__main__"].held = owner
    elif given["held_by"] == "cycle":
        Cycle(owner)
    elif given["held_by"] == "thread":
        kept = owner
        threading.Thread(target=lambda: (kept, time.sleep(60)), daemon=True).start()
    elif given["held_by"] == "atexit":
        atexit.register(lambda kept=owner: None)
    if given["under_way"]:
        run.answer(answer)
    del owner
    if given["raises"]:
        sys.excepthook(ValueError, ValueError("mine"), None)
    ctypes.pythonapi.Py_Exit(int(given["raises"]))


AREAS = {  # inputs, check, how many are quick, and how many are tried once
    "policies": (POLICIES, look_at_policy, 30, 2000),
    "actions": (ACTIONS, act, 20, 2000),
    "FMU steps": (STEPS, step_fmu, 5, 2000),
    "Foxglove": (CONNECTIONS, connect_to_foxglove, 20, 2000),
    "one folder": (WRITERS, write_together, 20, 2000),
    "Slurm": (SLURM, begin_step, 30, 2000),
    "endings": (ENDINGS, end_interpreter, 6, 2000),
}
NEEDS = {
    "policies": ("onnx", "onnxruntime"),
    "actions": ("gymnasium",),
    "FMU steps": ("fmpy",),
    "Foxglove": ("foxglove",),
    "endings": ("gymnasium",),
}


@pytest.mark.parametrize("all_of_them", [False, pytest.param(True, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("area", AREAS)
def test_what_others_give_ends_cleanly(area, all_of_them, tmp_path, monkeypatch):
    for module in NEEDS.get(area, ()):
        pytest.importorskip(module)
    if area == "FMU steps" and shutil.which("cc") is None:
        pytest.skip("needs a C compiler")
    monkeypatch.chdir(tmp_path)
    *_, quick, every = AREAS[area]
    if all_of_them:
        run_alone(inputs_end_cleanly, area, every, inputs=every)
    else:
        run_alone(inputs_end_cleanly, area, quick)


def inputs_end_cleanly(area, count):
    strategy, check, *_ = AREAS[area]
    inputs = drawn(strategy, count)
    found = unclean(inputs, check)
    counts = collections.Counter(found.values())
    examples = {text: inputs[index] for index, text in found.items()}
    assert not found, f"{len(found)} of {len(inputs)}: {counts}; such as {examples}"


def test_a_run_ends_with_its_owner(tmp_path, monkeypatch):
    """Nothing that the run's thread holds keeps an environment alive."""
    for module in NEEDS["endings"]:
        pytest.importorskip(module)
    monkeypatch.chdir(tmp_path)
    for kind in KINDS:
        before = set(threading.enumerate())
        owner, run, _, step = begun(kind)
        (thread,) = set(threading.enumerate()) - before
        del step
        if kind != "single":
            del owner
        else:
            Cycle(owner)
            del owner
        gc.collect()
        assert not thread.is_alive(), kind
        with pytest.raises(FfsmError, match="the run has ended"):
            run.take()
