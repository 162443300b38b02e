"""Nothing that a user reads of a run moves unnoticed. Meant changes: ``python
tests/golden/golden.py``, and review.
"""

import copy
import os
import sys

import golden
import pytest
from children import finished
from entry_points import needs

PARTS = golden.files()
EVERY_LAW = ("schema", *golden.WITH_EVERY_LAW)


# Of the parts that have every law.
LAWS = [needs("planning"), needs("task_space")]


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=LAWS if path.stem in EVERY_LAW else ())
        for path in PARTS
    ],
)
def test_what_must_not_move(path):
    changes = golden.changes(path, golden.plain(PARTS[path]()))
    assert not changes, "\n".join([f"{len(changes)} changes in {path.name}", *changes[:20]])


# Names of processors to OpenBLAS, whose products round differently.
@pytest.mark.parametrize(
    "processor",
    [
        pytest.param("Haswell", marks=pytest.mark.long),
        pytest.param("Nehalem", marks=pytest.mark.slow),
    ],
)
def test_rounding_moves_nothing_further(processor):
    command = [sys.executable, golden.__file__, "--moves"]
    environment = {**os.environ, "OPENBLAS_CORETYPE": processor}
    said = finished(command, env=environment, check=True, longest=600).stdout
    moved = {name: float(share) for name, share in map(str.split, said.splitlines())}
    assert set(moved) == {path.stem for path in PARTS}
    assert max(moved.values()) < 0.4, moved


@pytest.mark.smoke
def test_it_is_all_there_and_nothing_else():
    assert set(golden.FOLDER.glob("**/*.json")) == set(PARTS)
    assert sum(path.stat().st_size for path in PARTS) < 2_000_000


@pytest.mark.smoke
def test_every_kind_of_change_is_seen():
    expected = golden.read(golden.RUNS / "postcapture.json")

    def seen(*keys, to):
        found = copy.deepcopy(expected)
        *way, last = keys
        place = found
        for key in way:
            place = place[key]
        place[last] = to(place[last]) if callable(to) else to
        allowed = golden.moves("postcapture")
        return list(
            golden.differences(found, expected, relative=allowed.relative, scale=allowed.scale)
        )

    samples = ("runs", "tde_aismc", "samples")
    assert seen("outline", "variables", "error", 2, "units", to="deg") != []
    assert seen("outline", "report", "panels", to=lambda panels: panels[1:]) != []
    assert seen("runs", "tdc", "metrics", "itae", to=lambda itae: itae * (1 + 1e-9)) != []
    assert seen(*samples, "generalized_force", 3, 0, to=lambda force: force + 1e-6) != []
    assert seen(*samples, "error", to=lambda rows: [row[:-1] for row in rows]) != []
    assert seen(*samples, to=lambda variables: variables | {"further": []}) != []
    assert seen(*samples, "position", 3, 0, to=float("nan")) != []
    assert seen(*samples, "position", 3, 0, to=lambda value: value * (1 + 1e-13)) == []
