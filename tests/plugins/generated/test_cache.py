"""Compiled code on disk: used again, and made again where it is not what was written."""

import pytest
from drawn_trees import drawn_tree

from ffsm_drake.plugins.compiled import compiling
from ffsm_drake.plugins.equations.tree import Reader
from ffsm_drake.plugins.generated.comparison import Differences
from ffsm_drake.plugins.generated.kernels import Kernels


@pytest.fixture
def plant():
    return drawn_tree(5, 1)


@pytest.fixture
def kept(tmp_path, monkeypatch, plant):
    """The file with the plant's code."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    Kernels(Reader(plant).tree)
    (file,) = (tmp_path / "ffsm_drake" / "compiled").iterdir()
    return file


@pytest.fixture
def compilations(monkeypatch):
    """The number of texts compiled."""
    made, compile_text = [], compiling._compile
    monkeypatch.setattr(compiling, "_compile", lambda text: made.append(1) or compile_text(text))
    return made


def works(plant):
    return Differences(Kernels(Reader(plant).tree), plant).largest < 1e-13


@pytest.mark.smoke
def test_code_is_compiled_once(kept, plant, compilations):
    assert works(plant)
    assert not compilations
    assert not kept.stat().st_mode & 0o077


def truncated(file):
    file.write_bytes(file.read_bytes()[:-100])


def with_another_bit(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def empty(file):
    file.write_bytes(b"")


def another_file(file):
    file.write_text("not code")


@pytest.mark.parametrize("damage", [truncated, with_another_bit, empty, another_file])
def test_damaged_code_is_compiled_again(kept, plant, compilations, damage):
    whole = kept.read_bytes()
    damage(kept)
    assert works(plant)
    assert len(compilations) == 1
    assert kept.read_bytes() == whole


def test_code_that_others_may_write_is_not_used(kept, plant, compilations):
    kept.chmod(0o666)
    assert works(plant)
    assert len(compilations) == 1


@pytest.mark.slow
def test_another_tree_or_version_has_another_file(kept, plant, compilations, monkeypatch):
    Kernels(Reader(drawn_tree(6, 1)).tree)
    monkeypatch.setattr(compiling, "_generator", lambda: b"another")
    Kernels(Reader(plant).tree)
    assert len(compilations) == 2
    assert len(list(kept.parent.iterdir())) == 3


@pytest.mark.parametrize("home", ["/dev/null", "/proc/nowhere"])
def test_a_folder_that_cannot_be_written_does_not_matter(plant, home, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", home)
    assert works(plant)
