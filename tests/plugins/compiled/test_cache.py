"""Compiled code on disk: used again, and made again where it is not what was written."""

import numpy as np
import pytest
from compiled_equations import compiled, text_of
from drawn_trees import drawn_tree

from ffsm_drake.plugins.compiled import compiling
from ffsm_drake.plugins.equations.equations import bias
from ffsm_drake.plugins.equations.tree import Reader


@pytest.fixture
def tree():
    return Reader(drawn_tree(5, 1)).tree


@pytest.fixture
def kept(tmp_path, monkeypatch, tree):
    """The file with the code."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    compiled("bias", tree)
    (file,) = (tmp_path / "ffsm_drake" / "compiled").iterdir()
    return file


@pytest.fixture
def compilations(monkeypatch):
    """The number of texts compiled."""
    made, compile_text = [], compiling._compile
    monkeypatch.setattr(
        compiling, "_compile", lambda *given, **how: made.append(1) or compile_text(*given, **how)
    )
    return made


def works(tree):
    sizes = tree.num_positions, tree.num_velocities, tree.num_parameters
    q, v, own = (np.full((1, size), 0.5) for size in sizes)
    expected = bias(tree, *(each[0] for each in (q, v, own)))
    return np.allclose(compiled("bias", tree)(q, v, own)[0], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.smoke
def test_code_is_compiled_once(kept, tree, compilations):
    assert works(tree)
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
def test_damaged_code_is_compiled_again(kept, tree, compilations, damage):
    whole = kept.read_bytes()
    damage(kept)
    assert works(tree)
    assert len(compilations) == 1
    assert kept.read_bytes() == whole


def test_code_that_others_may_write_is_not_used(kept, tree, compilations):
    kept.chmod(0o666)
    assert works(tree)
    assert len(compilations) == 1


def test_another_tree_or_version_has_another_file(kept, tree, compilations, monkeypatch):
    compiled("bias", Reader(drawn_tree(6, 1)).tree)
    text = text_of("bias", compiling.registers(), tree)
    for version in ("one", "one", "another"):
        monkeypatch.setattr(compiling, "_package", lambda version=version: version)
        compiling.Code(lambda: text, "the key")
    assert len(compilations) == 3
    assert len(list(kept.parent.iterdir())) == 4


@pytest.mark.parametrize("home", ["/dev/null", "/proc/nowhere"])
def test_a_folder_that_cannot_be_written_does_not_matter(tree, home, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", home)
    assert works(tree)
