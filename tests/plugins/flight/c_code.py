"""C code of tests, compiled and loaded."""

import ctypes
import shutil
from importlib.util import find_spec

import pytest
from children import finished

COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
FLAGS = [
    "-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror", "-ffp-contract=off",
]  # fmt: skip
needs_llvm = pytest.mark.skipif(
    find_spec("llvmlite") is None, reason="needs llvmlite, of the extra compiled"
)
needs_c = pytest.mark.skipif("gcc" not in COMPILERS, reason="needs gcc (apt install gcc)")


def compiled(folder, sources, *options, compiler="gcc", name="made"):
    """The file that a compiler makes of C files in a folder."""
    line = [compiler, *FLAGS, *options, *map(str, sources), "-o", str(folder / name), "-lm"]
    done = finished(line, cwd=folder)
    assert done.returncode == 0, done.stderr[:2000]
    return folder / name


def loaded(folder, text, *options):
    """A library of C text."""
    (folder / "text.c").write_text(text)
    return ctypes.CDLL(str(compiled(folder, ["text.c"], "-shared", "-fPIC", *options)))


def call(function, *arrays):
    """Call a function of arrays of doubles."""
    function(*(ctypes.c_void_p(array.ctypes.data) for array in arrays))
