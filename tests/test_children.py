"""Whatever a child does and however its test ends, nothing is left, and all processes of the tests
start by ``children.py``.
"""

import ast
import contextlib
import os
import secrets
import signal
import sys
import time
from pathlib import Path

import pytest
from alone import run_alone
from children import PIPE, SIGNALS, TimeoutExpired, call, child, finished, forked, left

TESTS = Path(__file__).parent
QUICK_PYTHON = (sys.executable, "-I", "-S", "-c")
needs_proc = pytest.mark.skipif(
    not Path("/proc/self/environ").exists(), reason="finds processes in /proc"
)
# Children that do not end by themselves; each says so when it is ready.
STUBBORN = """
import os, signal, time
for number in (1, 2, 3, 15):
    signal.signal(number, signal.SIG_IGN)
"""
ENDLESS = {
    "deaf": "print('ready', flush=True)\nwhile True: time.sleep(9)",
    "grandchild": "os.fork() or print('ready', flush=True)\nwhile True: time.sleep(9)",
    "orphan": "if os.fork(): os._exit(0)\nprint('ready', flush=True)\nwhile True: time.sleep(9)",
    "daemon": "os.fork() or (os.setsid(), print('ready', flush=True))\nwhile True: time.sleep(9)",
    "silent": "os.close(1)\nwhile True: time.sleep(9)",
}
endless = pytest.mark.parametrize("kind", ENDLESS)


@pytest.fixture
def mark(monkeypatch):
    """A variable that the processes of this test inherit."""
    call(abs, 1)  # guard and fork server of this process are there, and not of the test
    name, value = "TEST_OF_CHILDREN", secrets.token_hex(8)
    monkeypatch.setenv(name, value)
    yield f"{name}={value}"
    assert not [*map(str, left(f"{name}={value}", patience=0.0))]


def endless_child(kind, **settings):
    return child([*QUICK_PYTHON, STUBBORN + ENDLESS[kind]], stdout=PIPE, text=True, **settings)


class Failure(BaseException):
    """A test that fails, or is interrupted."""


@needs_proc
@endless
@pytest.mark.parametrize("error", [None, Failure, KeyboardInterrupt])
@pytest.mark.smoke
def test_nothing_is_left_of_a_child(kind, error, mark):
    with (
        pytest.raises(error) if error else contextlib.nullcontext(),
        endless_child(kind) as process,
    ):
        process.stdout.readline()
        assert left(mark, patience=0.0)
        if error:
            raise error
    assert not left(mark, patience=0.0)
    assert process.returncode is not None


@needs_proc
@endless
def test_a_test_that_waits_for_a_word_goes_on_at_the_bound(kind, mark):
    with endless_child(kind, longest=0.2) as process:
        told = process.stdout.read()
        assert told in ("ready\n", "")
        if kind != "orphan":
            assert process.wait(10.0) == -signal.SIGKILL
        assert not left(mark, patience=2.0)


# A parent of each kind of child, which the test kills; the children come from where it has said so.
PARENTS = {
    "child": """
with children.child([*{python}, {code!r}]) as process:
    process.wait(); time.sleep(900)""",
    "forked": "children.forked(lambda tell: exec({code!r}), silence=900)",
    "call": "children.call(exec, {code!r})",
    "pool": """
with children.pool(1) as pool:
    pool.submit(exec, {code!r}).result()""",
}


@needs_proc
@pytest.mark.parametrize(
    ("parent", "kind"),
    [("child", "daemon"), ("forked", "grandchild"), ("call", "grandchild"), ("pool", "deaf")],
)
def test_nothing_outlives_tests_that_are_killed(parent, kind, mark):
    code = PARENTS[parent].format(python=QUICK_PYTHON, code=STUBBORN + ENDLESS[kind])
    script = f"import sys, time\nsys.path.insert(0, {str(TESTS)!r})\nimport children\n{code}"
    with child([sys.executable, "-c", script], stdout=PIPE, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        assert len(left(mark, patience=0.0)) >= 3  # with the guard
        process.kill()
        assert not [*map(str, left(mark))]


@needs_proc
def test_a_fork_and_a_function_end_at_their_bounds(mark):
    with pytest.raises(ChildProcessError, match="ended with -9"):
        call(time.sleep, 900.0, longest=0.3)
    assert run_alone(_all_forked) == [
        ("hangs", "begun", -9),
        ("ended by SIGKILL", "begun", -9),
        ("", "begun", 1),
        ("", "begun\u20ac", 0),
    ]


def _all_forked():
    return [_forked(kind) for kind in ("hang", "long", "fail", "end")]


def _forked(kind):
    def act(tell):
        tell("begun")
        if kind == "fail":
            os.close(2)
            raise ValueError
        if kind == "end":
            return tell("\u20ac")
        while True:
            time.sleep(0.05)
            if kind == "long":
                tell(" ")

    fork = forked(act, silence=0.3, longest=0.5 if kind == "long" else 9.0)
    return fork.death, fork.told.replace(" ", ""), fork.code


def test_a_function_gives_its_value_or_its_error():
    assert call(divmod, 7, 2) == (3, 1)
    with pytest.raises(ZeroDivisionError) as caught:
        call(divmod, 7, 0)
    assert "in _answer" in caught.value.__notes__[0]


@pytest.mark.smoke
def test_a_command_is_heard_and_bounded():
    assert finished([*QUICK_PYTHON, "print(input())"], stdin=PIPE).returncode == 1
    with pytest.raises(AssertionError, match="no such thing"):
        finished([*QUICK_PYTHON, "exit('no such thing')"], check=True)
    with pytest.raises(TimeoutExpired):
        finished([*QUICK_PYTHON, STUBBORN + ENDLESS["deaf"]], longest=0.1)
    with pytest.raises(FileNotFoundError):
        finished(["no_such_command"])


IGNORED = "import signal; print([signal.getsignal(n) for n in (1, 2, 3, 15)].count(signal.SIG_IGN))"


@pytest.mark.smoke
def test_no_child_ignores_a_signal():
    """Though this process has inherited that all are ignored."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    try:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)
        assert finished([*QUICK_PYTHON, IGNORED]).stdout == "0\n"
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGHUP)  # of nohup
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert _ignored() == 0
    assert run_alone(_ignored) == 0
    assert run_alone(_ignored_in_fork) == "0"


@pytest.mark.long
def test_tests_heed_signals_in_the_background():
    """In xdist's workers too, started as nohup and shells start what runs behind."""
    tests = ("test_children.py::test_no_child_ignores_a_signal",
             "common/test_interrupts.py::test_handlers_are_as_before_afterwards",
             "runs/test_failed_block.py::test_ctrl_c_ends_a_step_that_never_returns")  # fmt: skip
    command = [sys.executable, "-m", "pytest", "-q", "-n", "1", "-p", "no:cacheprovider"]
    command += [str(TESTS / name) for name in tests]
    trap = ["sh", "-c", 'trap "" INT HUP QUIT; exec "$@"', "sh"]
    done = finished([*trap, *command], cwd=TESTS.parent)
    assert done.returncode == 0, done.stdout
    assert "3 passed" in done.stdout


def _ignored():
    return [signal.getsignal(number) for number in SIGNALS].count(signal.SIG_IGN)


def _ignored_in_fork():
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    return forked(lambda tell: tell(str(_ignored())), silence=9.0).told


@needs_proc
def test_what_is_left_is_listed(mark):
    command = [sys.executable, str(TESTS / "children.py"), "--left"]
    with endless_child("deaf") as process:
        process.stdout.readline()
        found = finished([*command, mark, "0.1"])
    assert found.returncode == 1
    (line,) = [line for line in found.stdout.splitlines() if line.startswith(f"{process.pid} ")]
    assert "import os, signal, time" in line
    done = finished([*command, mark])
    assert (done.returncode, done.stdout) == (0, "")  # not itself, nor who asks
    assert finished(command).returncode == 1


MODULES = {"subprocess", "multiprocessing", "pty", "pexpect"}
OF_OS = {"fork", "forkpty", "popen", "posix_spawn", "posix_spawnp", "system"}
CALLS = {
    "Popen",
    "ProcessPoolExecutor",
    "LocalCluster",
    "create_subprocess_exec",
    "create_subprocess_shell",
}


def starts(tree):
    """What starts a process, or could: names of modules and functions, by line."""
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name.partition(".")[0] for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = (node.module or "").partition(".")[0]
            names = [module, *(f"{module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Attribute):
            of = node.value.id if isinstance(node.value, ast.Name) else ""
            names = [f"{of}.{node.attr}"]
        elif isinstance(node, ast.Name):
            names = [f".{node.id}"]
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            names = [str(node.args[0].value)] if "import" in ast.unparse(node.func) else []
        for name in names:
            of, _, function = name.rpartition(".")
            if (
                name in MODULES
                or (of == "os" and (function in OF_OS or function.startswith(("spawn", "exec"))))
                or function in CALLS
            ):
                yield f"line {node.lineno}: {name}"


@pytest.mark.smoke
def test_children_start_in_one_place():
    """children.py starts the tests' processes; blocked.py is user-supplied code within one."""
    exempt = {TESTS / "children.py", TESTS / "blocked.py"}
    assert all([*starts(ast.parse(file.read_text()))] for file in exempt)
    files = {*TESTS.rglob("*.py")} - exempt
    found = {file.name: [*starts(ast.parse(file.read_text()))] for file in files}
    assert {name: lines for name, lines in found.items() if lines} == {}
