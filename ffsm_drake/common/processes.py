"""The processes that a process has started. It imports next to nothing, as ``interrupts``."""

import contextlib
import os
import signal

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterable


def kill_below(pid: int, *, but: "Iterable[int]" = (), itself: bool = False) -> None:
    """Kill the processes of this session that descend from one, with exceptions.

    They are stopped before they are killed: one that runs starts another in the meantime, and a
    killed one no longer says whose child that is. ``itself``: kill that one too.
    """
    session, found, new = os.getsid(0), set[int](), {pid}
    spared = set[int]() if itself else {pid}
    while new:
        found |= new
        _send(signal.SIGSTOP, new - spared, session)
        below, more, parents = set[int](), {pid}, _parents()
        while more:
            below |= more
            children = {each for each, parent in parents.items() if parent in more}
            more = children - below - {*but}
        new = below - found
    _send(signal.SIGKILL, found - spared, session)


def _send(number: int, pids: "Iterable[int]", session: int) -> None:
    for each in pids:
        with contextlib.suppress(OSError):
            if os.getsid(each) == session:  # a browser, say, has its own
                os.kill(each, number)


def _parents() -> dict[int, int]:
    """Return the parent of every process."""
    if not os.path.exists("/proc/self/stat"):
        import subprocess

        command = ["ps", "-A", "-o", "pid=", "-o", "ppid="]
        lines = subprocess.run(command, capture_output=True, check=False).stdout.splitlines()
        return {int(pid): int(parent) for pid, parent in map(bytes.split, lines)}
    found = {}
    for name in filter(str.isdigit, os.listdir("/proc")):
        with contextlib.suppress(OSError), open(f"/proc/{name}/stat", "rb") as file:
            found[int(name)] = int(file.read().rpartition(b")")[2].split()[1])
    return found
