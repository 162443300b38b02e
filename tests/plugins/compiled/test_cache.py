"""Compiled code on disk: used again, and made again where it is not what was written."""

import os
import time

import numpy as np
import pytest
from compiled_equations import compiled, text_of
from drawn_trees import drawn_tree

from ffsm_drake.plugins.compiled import compiling
from ffsm_drake.plugins.compiled.recent import Recent
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


DAY, MOST, LONGEST = 86400.0, 2**30, 90  # documented bounds: bytes, and days


@pytest.mark.parametrize("seed", range(3))
def test_files_beyond_the_bounds_are_removed(kept, seed):
    """Those used longest ago, as soon as one is added. What is used stays."""
    rng, folder, now = np.random.default_rng(seed), kept.parent, time.time()
    ages = {kept: 0.99 * LONGEST}  # days
    for k, age in enumerate(rng.uniform(0.0, 1.3 * LONGEST, 24)):
        path = folder / f"{k}.o"
        path.touch()
        os.truncate(path, int(rng.uniform(0.0, 0.15) * MOST))  # takes no room
        ages[path] = age
    other = folder / "notes.txt"
    other.touch()
    for path, age in [*ages.items(), (other, 10.0 * LONGEST)]:
        os.utime(path, times=(now - age * DAY,) * 2)
    sizes = {path: path.stat().st_size for path in ages}
    compiled("bias", Reader(drawn_tree(5, 1)).tree)  # used
    assert time.time() - kept.stat().st_mtime < 60.0
    assert set(ages) < {*folder.iterdir()}
    compiled("bias", Reader(drawn_tree(6, 1)).tree)  # added
    (added,) = {*folder.iterdir()} - {*ages, other}
    total, expected = added.stat().st_size, {added, other}
    for path in sorted(ages, key=lambda each: 0.0 if each == kept else ages[each]):
        total += sizes[path]
        if total <= MOST and (path == kept or ages[path] < LONGEST):
            expected.add(path)
    assert {*folder.iterdir()} == expected
    assert kept in expected
    assert len(expected) < 20


@pytest.mark.parametrize("seed", range(5))
def test_the_value_used_longest_ago_is_forgotten(seed):
    """Against a list of all uses."""
    rng, uses, values = np.random.default_rng(seed), list[int](), dict[int, float]()
    most = int(rng.integers(1, 6))
    recent = Recent[float](most)
    for value in rng.uniform(1.0, 2.0, 200):
        key = int(rng.integers(0, 8))
        last = [*dict.fromkeys(reversed(uses))][:most]  # keys by their last use
        assert recent.get(key) == (values[key] if key in last else None)
        if key not in last:
            assert recent.keep(key, value) == value
            values[key] = value
        uses.append(key)
