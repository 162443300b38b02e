"""Reading of model files in a separate process, because third-party parsers may hang, crash or use
up memory.

The process ends with its parent, or after a time limit, by signals of the system. A parser in
compiled code does not return to Python, so Python cannot stop it. The process reads one line of
JSON and writes one.
"""

import contextlib
import fcntl
import json
import os
import pkgutil
import resource
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from ffsm_drake.common.errors import FfsmError, ModelError, one_line
from ffsm_drake.common.memo import memoized
from ffsm_drake.common.threads import ONE_THREAD

DEADLINE = 60.0  # s
_PROCESSOR = 30  # s of processor time
MEMORY = 3_000_000_000  # bytes
_LONGEST = 200_000_000  # bytes of an answer
_START = "from ffsm_drake.plugins.new.apart import serve; serve()"
_SAID = 300  # characters of what a library wrote last


def answer(task: Callable[..., Any], **question: Any) -> Any:
    """Return the result of a function of a module for arguments of plain data, from a separate
    process.

    Raises ModelError: the error of the function, or how the process ended.
    """
    name = f"{task.__module__}:{task.__name__}"
    request = {"task": name, "deadline": DEADLINE, "memory": MEMORY, "question": question}
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", _START],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said,
            env=os.environ | ONE_THREAD,
        )  # fmt: skip
        with process:
            assert process.stdin is not None
            assert process.stdout is not None
            try:
                with contextlib.suppress(BrokenPipeError):
                    process.stdin.write(json.dumps(request).encode() + b"\n")
                    process.stdin.flush()
                found = process.stdout.read(_LONGEST)
            finally:
                process.kill()
                with contextlib.suppress(BrokenPipeError):
                    process.stdin.close()
                process.stdin = None
        if found.endswith(b"\n"):
            told = json.loads(found)
            if "error" in told:
                raise ModelError(told["error"])
            return told["answer"]
        said.seek(0)
        last = said.read()[-_SAID:].decode(errors="replace").strip().splitlines()
    raise ModelError(_ended(process.returncode, last[-1] if last else ""))


def _ended(code: int, said: str) -> str:
    """Return how a process without an answer ended."""
    name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    if name in ("SIGALRM", "SIGXCPU"):
        return (
            f"is not read within {DEADLINE:g} s; does it repeat parts without end, or name a FIFO?"
        )
    if name == "SIGKILL":
        return f"takes more than {MEMORY / 1e9:g} GB of memory to read, or its reader was killed"
    more = f" ({said})" if said else ""
    return f"its parser crashed ({name}); does a file include itself, or need all memory?{more}"


def serve() -> None:
    """Answer one question, in the separate process."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGIO, signal.SIGALRM):
        signal.signal(number, signal.SIG_DFL)
    out = os.dup(1)
    os.dup2(2, 1)  # what libraries print
    request = json.loads(sys.stdin.buffer.readline() or b"null")
    if request is None:
        return
    # The end of the parent closes the pipe: the system then sends SIGIO, which ends this process.
    fcntl.fcntl(0, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(0, fcntl.F_SETFL, fcntl.fcntl(0, fcntl.F_GETFL) | os.O_ASYNC)
    if select.select([0], [], [], 0.0)[0]:
        return
    signal.setitimer(signal.ITIMER_REAL, request["deadline"])
    for kind, most in (
        (resource.RLIMIT_CPU, _PROCESSOR),
        (resource.RLIMIT_AS, request["memory"]),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(kind)[1]
        with contextlib.suppress(OSError, ValueError):  # a system may lack one of them
            resource.setrlimit(kind, (most if hard < 0 else min(most, hard), hard))
    told: dict[str, Any]
    try:
        told = {"answer": pkgutil.resolve_name(request["task"])(**request["question"])}
    except FfsmError as error:
        told = {"error": str(error)}
    except MemoryError:
        told = {"error": f"takes more than {request['memory'] / 1e9:g} GB of memory to read"}
    except RecursionError:
        told = {"error": "its elements nest too deeply"}
    except Exception as error:  # whatever a parser raises
        told = {"error": f"cannot be read: {type(error).__name__}: {one_line(error)}"}
    line = json.dumps(told).encode() + b"\n"
    while line:
        line = line[os.write(out, line) :]
    os._exit(0)  # nothing of a library's own at its end


def _try(file: str, packages: Mapping[str, str]) -> None:
    """Parse a file with Drake. Parser errors are ignored, because the file is parsed again later.

    Raises ModelError: Drake drops a part of the file that changes the motion.
    """
    from ffsm_drake.plugins.new.urdf.formats.direct import check_direct, plant_of

    failures = RuntimeError, ValueError, SystemExit
    with contextlib.suppress(*failures):  # first, as Drake aborts on some numbers
        check_direct(file, packages)
    with contextlib.suppress(*failures):
        plant_of(
            packages,
            lambda parser: parser.AddModels(url=file) if "://" in file else parser.AddModels(file),
        )


def check_by_trial(
    address: str, place: str, files: tuple[Path, ...], packages: Mapping[str, str]
) -> None:
    """Raise ModelError for a model on which Drake's parser hangs or crashes, or whose motion it
    changes.

    Args:
      address: address that Drake parses.
      place: name of the model in the error.
      files: files of the model. URDFs, and directives of URDFs only, are checked elsewhere.
      packages: package:// name -> folder.
    """
    if files and not _is_plain(files[0]):
        problem = _trial(address, files, packages)
        if problem:
            raise ModelError(f"{place}: {problem}")


@memoized(maxsize=64)
def _is_plain(file: Path) -> bool:
    if file.suffix.lower() not in (".yaml", ".yml"):
        return file.suffix.lower() == ".urdf"
    try:
        given = yaml.safe_load(file.read_bytes())["directives"]
        models = [each["add_model"]["file"] for each in given if "add_model" in each]
        nested = any("add_directives" in each for each in given)
        return not nested and all(name.lower().endswith(".urdf") for name in models)
    except (yaml.YAMLError, OSError, LookupError, TypeError, AttributeError, RecursionError):
        return False


@memoized(maxsize=64)  # plants are made many times
def _trial(address: str, files: tuple[Path, ...], packages: Mapping[str, str]) -> str:
    try:
        answer(_try, file=address, packages=dict(packages))
    except ModelError as error:
        return str(error)
    return ""
