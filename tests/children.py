"""Every process that a test starts: none starts with a signal ignored, lives beyond a bound, or
outlives its test, however the test ends.

``child`` and ``finished`` start a command, ``call`` a function in a process with one thread,
``forked`` one in a fork of this process, ``pool`` workers. A guard, a process beside the tests',
kills what is still there at its bound, or when the tests' process has died.

``python tests/children.py --left NAME=VALUE [SECONDS]`` lists the processes whose environment holds
that after so many seconds, by default 5, and exits with 1 if there are any.
"""

import atexit
import contextlib
import dataclasses
import multiprocessing
import os
import secrets
import select
import signal
import sys
import threading
import time
import traceback
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from subprocess import (  # noqa: F401 (tests import these from here)
    DEVNULL,
    PIPE,
    STDOUT,
    CompletedProcess,
    Popen,
    TimeoutExpired,
)

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
LONGEST = 300.0  # s that a child lives, unless told otherwise
_CONTEXT = multiprocessing.get_context("forkserver")
_PROC = Path("/proc")
_HAS_PROC = (_PROC / "self" / "environ").exists()
_GUARDS = {}  # by the process that they guard; a fork has its own


def heed_signals():
    """Ignore no signal that ends a command, as what ``nohup`` or a shell starts in the background
    does: commands would ignore it too.

    This process heeds SIGINT. Others keep ending nothing here, by a handler: that is not inherited.
    """
    for number in SIGNALS:
        if signal.getsignal(number) == signal.SIG_IGN:
            heeds = number == signal.SIGINT
            signal.signal(number, signal.default_int_handler if heeds else lambda *_: None)


@contextlib.contextmanager
def child(command, *, longest=LONGEST, **settings):
    """A command as a Popen in a session of its own, killed after ``longest`` seconds."""
    heed_signals()
    env = os.environ if settings.get("env") is None else settings["env"]
    with contextlib.ExitStack() as stack, _guarded(longest) as guarded:
        settings["env"] = {**env, guarded.mark: "1"}
        process = Popen(command, start_new_session=True, **settings)
        stack.callback(_reap, process)
        guarded.lead_by(process.pid)
        yield process


def _reap(process):
    process.wait()
    for stream in (process.stdin, process.stdout, process.stderr):
        if stream is not None:
            with contextlib.suppress(BrokenPipeError):
                stream.close()


def finished(command, *, longest=120.0, check=False, **settings):
    """A command that has ended, as of ``subprocess.run``; its streams are captured as text.

    Raises:
      TimeoutExpired: it was not at its end within ``longest`` seconds.
      AssertionError: ``check``, and it failed.
    """
    settings = {"stdout": PIPE, "stderr": PIPE, "text": True} | settings
    with child(command, longest=longest + 10.0, **settings) as process:
        said, errors = process.communicate(timeout=longest)
    assert not (check and process.returncode), f"{command}: {process.returncode}: {errors}"
    return CompletedProcess(command, process.returncode, said, errors)


def preload(*modules):
    """What the processes of ``call`` and ``pool`` have loaded when they start."""
    _CONTEXT.set_forkserver_preload([*modules])


def call(function, *arguments, longest=LONGEST):
    """What a function of a module returns, or raises, in a process with one thread.

    Raises:
      ChildProcessError: the process died, or was killed after ``longest`` seconds.
    """
    heed_signals()
    ours, theirs = _CONTEXT.Pipe()
    process = _CONTEXT.Process(target=_answer, args=(theirs, function, arguments))
    with contextlib.ExitStack() as stack, _guarded(longest) as guarded, ours:
        process.start()
        theirs.close()
        stack.callback(process.join)
        guarded.lead_by(process.pid)
        try:
            ours.send("start")
            result, error, told = ours.recv()
        except (EOFError, OSError):
            process.join()
            raise ChildProcessError(f"the process ended with {process.exitcode}") from None
    if error is not None:
        error.add_note(told)
        raise error
    return result


def _answer(pipe, function, arguments):
    pipe.recv()  # fails if the parent has died
    os.setsid()
    try:
        answer = function(*arguments), None, ""
    except BaseException as error:
        answer = None, error, traceback.format_exc()
    pipe.send(answer)


@dataclasses.dataclass(frozen=True)
class Fork:
    """How a fork ended: what it told, its exit code (-n: by signal n), and whether it hung."""

    told: str
    code: int
    hung: bool

    @property
    def death(self):
        """An end by a signal, in words; else nothing."""
        if self.hung:
            return "hangs"
        return f"ended by {signal.Signals(-self.code).name}" if self.code < 0 else ""


def forked(act, *, silence, longest=1800.0):
    """``act(tell)`` in a fork of this process, which must have one thread (see ``call``); ``tell``
    takes text. A fork that tells nothing for ``silence`` seconds hangs.
    """
    heard, telling = os.pipe()
    waiting, starting = os.pipe()
    told, ends = b"", []
    with contextlib.ExitStack() as stack, _guarded(longest) as guarded:
        pid = os.fork()
        if pid == 0:
            os.close(heard)
            os.close(starting)
            _act(act, waiting, telling)
        stack.callback(lambda: ends.append(os.waitpid(pid, 0)[1]))
        guarded.lead_by(pid)
        os.close(telling)
        os.close(waiting)
        with open(heard, "rb", buffering=0) as pipe, open(starting, "wb", buffering=0) as start:
            start.write(b"s")
            while not (hung := not select.select([pipe], [], [], silence)[0]):
                if not (more := pipe.read(1 << 16)):
                    os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
                    break
                told += more
    return Fork(told.decode(errors="replace"), os.waitstatus_to_exitcode(ends[0]), hung)


def _act(act, waiting, telling):
    """Be the fork, to the end of the process."""
    code = 1
    try:
        for number in (*SIGNALS, signal.SIGALRM):
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if os.read(waiting, 1):  # else the parent has died
            os.setsid()
            act(lambda text: os.write(telling, text.encode(errors="replace")))
            code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def pool(count, *, longest=3600.0):
    """An executor of processes that start from one thread, and end with this process."""
    heed_signals()
    return ProcessPoolExecutor(
        count, mp_context=_CONTEXT, initializer=_end_with_parent, initargs=(longest,)
    )


def _end_with_parent(longest):
    def wait():
        multiprocessing.parent_process().join(longest)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


class Guarded:
    """What the guard knows of a child: a variable of its environment, from its start its session,
    and how long it may live.
    """

    def __init__(self, longest):
        self.mark, self.lead, self.longest = f"CHILD_{secrets.token_hex(8)}", 0, longest
        self.tell()

    def tell(self):
        _guard().write(f"{self.mark} {self.lead} {self.longest}\n".encode())

    def lead_by(self, pid):
        self.lead = pid
        self.tell()


@contextlib.contextmanager
def _guarded(longest):
    guarded = Guarded(longest)
    try:
        yield guarded
    finally:
        kill(guarded.mark, guarded.lead)
        guarded.longest = 0.0
        guarded.tell()


def _guard():
    """What this process writes to its guard."""
    if os.getpid() not in _GUARDS:
        command = [sys.executable, "-I", "-S", __file__, "--guard"]
        guard = Popen(command, stdin=PIPE, stdout=DEVNULL, bufsize=0, start_new_session=True)
        _GUARDS[os.getpid()] = guard
        atexit.register(_dismiss)
    return _GUARDS[os.getpid()].stdin


def _dismiss():
    for guard in _GUARDS.values():
        guard.stdin.close()
        guard.wait()


def _leave_guards():
    """A fork that kept the pipe would keep the guard from seeing that its process has died."""
    for guard in _GUARDS.values():
        guard.stdin.close()


os.register_at_fork(after_in_child=_leave_guards)


def guard():
    """Kill each child at its bound, and all when nobody is left to tell of them."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    ends, text = {}, b""
    while True:
        wait = max(0.0, min(ends.values()) - time.monotonic()) if ends else None
        if select.select([0], [], [], wait)[0]:
            more = os.read(0, 1 << 16)
            if not more:
                break
            *lines, text = (text + more).split(b"\n")
            for line in lines:
                mark, lead, longest = line.decode().split()
                for known in [known for known in ends if known[0] == mark]:
                    del ends[known]
                if float(longest):
                    ends[mark, int(lead)] = time.monotonic() + float(longest)
        for known in [known for known, end in ends.items() if end <= time.monotonic()]:
            del ends[known]
            kill(*known)
    for known in ends:
        kill(*known)


def kill(mark, lead):
    """Kill the session that ``lead`` leads (0: none), and who has the variable ``mark`` in its
    environment; without /proc the leader's group alone.
    """
    if not _HAS_PROC:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            if lead:
                os.killpg(lead, signal.SIGKILL)
        return
    end = time.monotonic() + 10.0
    while found := [
        one
        for one in processes()
        if (lead and lead in (one.pid, one.session)) or one.has(f"{mark}=1")
    ]:
        assert time.monotonic() < end, f"cannot be killed: {found}"
        for one in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(one.pid, signal.SIGKILL)
        time.sleep(0.002)


@dataclasses.dataclass(frozen=True)
class Process:
    """A process that is alive, as /proc shows it."""

    pid: int
    parent: int
    session: int
    age: float  # s

    def has(self, variable):
        """Whether its environment holds NAME=VALUE."""
        return variable.encode() in self._read("environ").split(b"\0")

    def __str__(self):
        words = self._read("cmdline").replace(b"\0", b" ").decode(errors="replace").split()
        return f"{self.pid} {self.age:.0f} s {' '.join(words)}"

    def _read(self, name):
        try:
            return (_PROC / str(self.pid) / name).read_bytes()
        except OSError:  # another user's, or at its end
            return b""


def processes():
    """Every process of this machine that is no zombie; none without /proc."""
    found = []
    uptime = float((_PROC / "uptime").read_text().split()[0]) if _HAS_PROC else 0.0
    for name in os.listdir(_PROC) if _HAS_PROC else ():
        if name.isdigit():
            try:
                fields = (_PROC / name / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if fields[0] not in "ZX":
                age = uptime - int(fields[19]) / os.sysconf("SC_CLK_TCK")
                found.append(Process(int(name), int(fields[1]), int(fields[3]), age))
    return found


def left(variable, *, patience=5.0):
    """The processes whose environment holds NAME=VALUE after ``patience`` seconds, without this one
    and those that started it.
    """
    end = time.monotonic() + patience
    while True:
        found = {one.pid: one for one in processes()}
        pid = os.getpid()
        own = set()
        while pid in found:
            own.add(pid)
            pid = found[pid].parent
        there = [one for one in found.values() if one.pid not in own and one.has(variable)]
        if not there or time.monotonic() > end:
            return there
        time.sleep(0.05)


def main(words):
    if words == ["--guard"]:
        return guard()
    if len(words) not in (2, 3) or words[0] != "--left" or "=" not in words[1]:
        return "python tests/children.py --left NAME=VALUE [SECONDS]"
    there = left(words[1], patience=float((*words, 5)[2]))
    print(*there, sep="\n", end="\n" if there else "")
    return 1 if there else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
