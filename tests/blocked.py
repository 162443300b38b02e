"""Calls that never return, one for each kind, and a control law that makes one of them.

The variable BLOCKED names the kind; the call is told on standard error before it is made.
"""

import asyncio
import atexit
import collections
import contextlib
import ctypes
import dataclasses
import itertools
import multiprocessing
import os
import select
import signal
import socket
import sqlite3
import subprocess
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ALL = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM}


def sleep():
    time.sleep(1000)


def busy():
    while True:
        pass


def native_loop():
    """It holds the interpreter's lock, and looks at no signal."""
    collections.deque(itertools.repeat(0), maxlen=0)


def native_lock(library=ctypes.PyDLL):
    """Without time on the processor; ``PyDLL`` holds the interpreter's lock."""
    mutex = ctypes.create_string_buffer(256)
    for _ in range(2):
        library(None).pthread_mutex_lock(mutex)


def native_lock_beside():
    native_lock(ctypes.CDLL)


def lock():
    once = threading.Lock()
    for _ in range(2):
        once.acquire()


def condition():
    with (waited := threading.Condition()):
        waited.wait()


def fifo():
    with tempfile.TemporaryDirectory() as folder:
        os.mkfifo(Path(folder, "f"))
        Path(folder, "f").read_text()


def pipe():
    os.read(os.pipe()[0], 1)


def child():
    subprocess.run(["sleep", "1000"], check=False)


def deaf_child():
    subprocess.run(["sh", "-c", "trap '' INT TERM HUP; sleep 1000; :"], check=False)


def fork():
    if not (pid := os.fork()):
        time.sleep(1000)
        os._exit(0)
    os.waitpid(pid, 0)


def swallow():
    while True:
        with contextlib.suppress(BaseException):
            time.sleep(0.01)


def swallow_masked():
    signal.pthread_sigmask(signal.SIG_BLOCK, ALL)
    swallow()


def masked():
    signal.pthread_sigmask(signal.SIG_BLOCK, ALL)
    time.sleep(1000)


def other_handler():
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: None)
    swallow()


def thread():
    started = threading.Thread(target=time.sleep, args=(1000,))
    started.start()
    started.join()


def future():
    with ThreadPoolExecutor(1) as pool:
        pool.submit(time.sleep, 1000).result()


def database():
    with tempfile.TemporaryDirectory() as folder:
        first, second = (sqlite3.connect(Path(folder, "d"), timeout=1000) for _ in range(2))
        first.execute("BEGIN EXCLUSIVE")
        second.execute("BEGIN EXCLUSIVE")


def accept():
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.accept()


def queue():
    multiprocessing.get_context("spawn").Queue().get()


def poll():
    select.select([], [], [])


def loop():
    asyncio.run(asyncio.sleep(1000))


def exit_handler():
    atexit.register(time.sleep, 1000)
    sleep()


KINDS = {
    call.__name__: call
    for call in (
        sleep, busy, native_loop, native_lock, native_lock_beside, lock, condition, fifo, pipe,
        child, deaf_child, fork, swallow, swallow_masked, masked, other_handler, thread, future,
        database, accept, queue, poll, loop, exit_handler,
    )
}  # fmt: skip


def block():
    """Make the call that BLOCKED names; nothing without it."""
    if kind := os.environ.get("BLOCKED"):
        os.write(2, b"blocked\n")
        KINDS[kind]()


def law():
    """The class of a control law that blocks at its first sample; without BLOCKED it does not."""
    import numpy as np

    from ffsm_drake import ControlLaw, gain

    @dataclasses.dataclass(frozen=True)
    class Law(ControlLaw):
        k: np.ndarray = gain(1.0)

        def step(self, sample, state):
            block()
            return 0.0 * sample.e, state

    return Law


def __getattr__(name):
    if name == "Law":
        globals()["Law"] = law()
        return globals()["Law"]
    raise AttributeError(name)


def main(place, words):
    """Run a command that blocks where a function is called, ``module:name``; none: in the law."""
    import importlib
    import sys

    if place:
        module, _, path = place.partition(":")
        *owners, name = path.split(".")
        owner = importlib.import_module(module)
        for each in owners:
            owner = getattr(owner, each)
        original = getattr(owner, name)

        def blocking(*arguments, **settings):
            block()
            return original(*arguments, **settings)

        setattr(owner, name, blocking)
    sys.argv = ["ffsm", *words]
    from ffsm_drake.__main__ import main as ffsm

    ffsm()


if __name__ == "__main__":
    import sys

    main(sys.argv[1], sys.argv[2:])
