"""Machine code of LLVM text by llvmlite, kept on disk for the next process.

A kept file has the code's checksum before it. It is compiled anew if that does not agree, or if
another user owns it or may write to it. Its name is a hash of the text, or of what the text is made
from by this package, of llvmlite and of the processor. The folder is ``ffsm_drake/compiled`` in
``XDG_CACHE_HOME`` (default: ``~/.cache``); where it cannot be written, nothing is kept. Whenever a
file is added, those that were not used for ``_LONGEST`` are removed, and of the others those used
longest ago beyond ``_MOST`` in all.
"""

import ctypes
import functools
import hashlib
import os
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import ffsm_drake
from ffsm_drake.common.errors import FfsmError, RecordError, one_line
from ffsm_drake.common.files import written_whole
from ffsm_drake.plugins.compiled.registers import Registers

_MAGIC = b"ffsm_drake compiled code\n"
_DIGEST = hashlib.sha256().digest_size
_LARGEST = 2**26  # bytes of a kept file
_MOST, _LONGEST = 2**30, 90 * 86400.0  # bytes of all files; s since a file was used


@functools.cache
def llvm() -> Any:
    """llvmlite's binding of LLVM, which an extra installs. Raises FfsmError: it is missing."""
    try:
        import llvmlite.binding
    except ImportError as error:
        problem = f"engine: compiled: {one_line(error)}; pip install 'ffsm-drake[compiled]'"
        raise FfsmError(problem) from error
    llvmlite.binding.initialize_native_target()
    llvmlite.binding.initialize_native_asmprinter()
    return llvmlite.binding


def registers() -> Registers:
    """The registers of this processor."""
    has = llvm().get_host_cpu_features()
    return Registers(8 if has.get("avx512f") else 4 if has.get("avx") else 2)


class Code:
    """The compiled functions of a module."""

    def __init__(
        self, text: Callable[[], str], key: str | None = None, *, quickly: bool = False
    ) -> None:
        """Args:
        text: makes the module's LLVM text; called unless there is a key whose code is on disk.
        key: what this package makes the text from.
        quickly: compile in a third of the time, to slower code with the same bits.
        """
        made = text() if key is None else None
        path = _folder() / f"{_hash(made or f'{_package()} {key}')}.o"
        code = _read(path)
        if code is None:
            code = _compile(made or text(), quickly=quickly)
            _keep(path, code)
        self._engine = llvm().create_mcjit_compiler(llvm().parse_assembly(""), _machine())
        self._engine.add_object_file(llvm().ObjectFileRef.from_data(code))
        self._engine.finalize_object()

    def function(self, name: str, pointers: int, *others: type) -> Callable[..., None]:
        """A function of so many pointers and numbers of these kinds; it lives as long as this."""
        kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * pointers, *others)
        made: Any = kind(self._engine.get_function_address(name))
        return made


def _compile(text: str, *, quickly: bool) -> bytes:
    module = llvm().parse_assembly(text)
    module.verify()
    code: bytes = _machine(0 if quickly else 2).emit_object(module)
    return code


def _machine(level: int = 2) -> Any:
    """The processor of this process, for code of an optimisation level."""
    return (
        llvm()
        .Target.from_default_triple()
        .create_target_machine(
            cpu=llvm().get_host_cpu_name(),
            features=llvm().get_host_cpu_features().flatten(),
            opt=level,
            reloc="pic",
            codemodel="jitdefault",
            jit=True,
        )
    )


def _hash(key: str) -> str:
    made = hashlib.sha256(f"{version('llvmlite')} {llvm().llvm_version_info}".encode())
    made.update(f"\n{llvm().get_host_cpu_name()}\n".encode())
    made.update(f"{llvm().get_host_cpu_features().flatten()}\n{key}".encode())
    return made.hexdigest()


@functools.cache
def _package() -> str:
    """The version of this package, and sizes and times of its files."""
    folder = Path(ffsm_drake.__file__).parent
    states = ((path, path.stat()) for path in sorted(folder.rglob("*.py")))
    files = [(str(path), state.st_size, state.st_mtime_ns) for path, state in states]
    return hashlib.sha256(f"{version('ffsm_drake')} {files}".encode()).hexdigest()


def _folder() -> Path:
    given = os.environ.get("XDG_CACHE_HOME", "")
    home = Path(given) if Path(given).is_absolute() else Path("~/.cache").expanduser()
    return home / "ffsm_drake" / "compiled"


def _read(path: Path) -> bytes | None:
    """The code of a kept file; None unless it is whole and our own."""
    with suppress(OSError), path.open("rb") as file:
        status = os.fstat(file.fileno())
        own = status.st_uid == os.getuid() and not status.st_mode & 0o022
        if not own or status.st_size > _LARGEST:
            return None
        content = file.read()
        code = content[len(_MAGIC) + _DIGEST :]
        if content == _sealed(code):
            with suppress(OSError):
                os.utime(path)  # it is used
            return code
    return None


def _sealed(code: bytes) -> bytes:
    return _MAGIC + hashlib.sha256(code).digest() + code


def _keep(path: Path, code: bytes) -> None:
    with suppress(RecordError, OSError), written_whole(path) as temporary:
        temporary.touch(mode=0o600)
        temporary.write_bytes(_sealed(code))
    _prune(path.parent)


def _prune(folder: Path) -> None:
    """Remove the files beyond ``_MOST`` and ``_LONGEST``."""
    found = list[tuple[float, int, str]]()
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            with suppress(OSError):
                if entry.name.endswith(".o") and entry.is_file(follow_symlinks=False):
                    status = entry.stat(follow_symlinks=False)
                    found.append((status.st_mtime, status.st_size, entry.path))
    total, since = 0, time.time() - _LONGEST
    for used, size, path in sorted(found, reverse=True):
        total += size
        if used < since or total > _MOST:
            with suppress(OSError):
                os.remove(path)
