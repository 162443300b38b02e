"""Nothing that a user reads of a run moves unnoticed. Meant changes: ``python
tests/golden/golden.py``, and review.
"""

import copy
import json
import os
import sys

import golden
import numpy as np
import pytest
import sensitivity
from children import finished
from entry_points import needs

pytestmark = pytest.mark.rounding

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


@pytest.mark.smoke
def test_a_rewritten_part_changes_only_where_more_than_rounding_moved():
    stored = {"a": [[1.0, 2.0], [3.0, 4.0]], "b": {"itae": 1.0, "title": "x"}, "gone": 1}
    moved = {"a": [1e-6, 0.0], "b": {"itae": 1e-9}}
    found = copy.deepcopy(stored) | {"new": [0.5]}
    del found["gone"]
    found["a"][0][1] += 1e-5  # within a hundred times what rounding moves
    found["b"]["itae"] += 1e-8
    found = dict(reversed(found.items())) | {"b": dict(reversed(found["b"].items()))}
    kept = golden.as_stored(found, stored, moved)
    assert golden.text(kept) == golden.text({"a": stored["a"], "b": stored["b"], "new": [0.5]})
    found["a"][1][0] += 1e-5
    found["b"] = {"itae": 1.1, "title": "y"}
    assert golden.as_stored(found, stored, moved) == found


# One scenario of each kind: a plain run, pulses, hands whose force has no inertia to smooth it.
@pytest.mark.long
@pytest.mark.parametrize("name", ["postcapture", "thrusters_only", "two_arms"])
def test_fresh_last_bits_move_a_hundredth_of_what_they_may(name):
    """On the instructions of another processor, with draws that the measurement did not have."""
    command = [sys.executable, sensitivity.__file__, "--seeds", "1000", "1001", "--", name]
    environment = {**os.environ, **sensitivity.PROCESSORS["Haswell"]}
    moved = json.loads(finished(command, env=environment, check=True, longest=600).stdout)
    known = golden.read(golden.sensitivity_of(name))["runs"]
    beyond = list(further(moved, known, share=0.1))
    assert moved
    assert not beyond, "\n".join(beyond[:20])


def further(moved, known, place="", *, share):
    """Moves beyond a share of what the known ones allow."""
    if isinstance(moved, dict):
        for key, move in moved.items():
            of_key = known.get(key) if isinstance(known, dict) else known
            yield from further(move, of_key, f"{place}.{key}", share=share)
    elif isinstance(moved, list):
        for index, move in enumerate(moved):
            of_row = known[index] if isinstance(known, list) else known
            yield from further(move, of_row, f"{place}[{index}]", share=share)
    elif moved is None or known == golden.ANY:
        return
    elif moved == golden.ANY or moved > share * golden.FACTOR * (known or 0.0) + LAST_BITS:
        yield f"{place}: {moved} beyond {known}"


LAST_BITS = 1e-12  # of numbers that no draw of the measurement moved


def test_most_is_compared():
    """What rounding moves too far to be compared is little, and next to nothing at the start."""
    for name in golden.names():
        runs = golden.read(golden.RUNS / f"{name}.json")["runs"]
        moved = golden.read(golden.sensitivity_of(name))["runs"]
        for law, run in sensitivity.with_all(runs).items():
            of_law = (moved or {}).get(law) or {}
            counted = list(compared(run.get("samples", {}), of_law.get("samples", {})))
            early = [is_compared for row, is_compared in counted if row == 0]
            every = [is_compared for _, is_compared in counted]
            assert np.mean(early or [1.0]) > 0.95, (name, law)
            assert np.mean(every or [1.0]) > 0.7, (name, law)


def compared(samples, moved):
    """Index and whether it is compared, of each row of each variable."""
    for name, rows in samples.items():
        largest = max(map(abs, golden.numbers(rows)), default=0.0)
        for index in range(len(rows)):
            of_row = moved.get(name)
            of_row = of_row[index] if isinstance(of_row, list) else of_row
            allowed, scale = golden.allowance(0.0, 0.0 if of_row == golden.ANY else of_row, largest)
            yield index, of_row != golden.ANY and allowed <= golden.COARSE * scale


@pytest.mark.smoke
def test_it_is_all_there_and_nothing_else():
    moved = {golden.sensitivity_of(name) for name in golden.names()}
    assert set(golden.FOLDER.glob("**/*.json")) == {*PARTS, *moved}
    assert sum(path.stat().st_size for path in {*PARTS, *moved}) < 2_500_000


@pytest.mark.smoke
def test_every_kind_of_change_is_seen():
    expected = golden.read(golden.RUNS / "postcapture.json")
    moved = golden.read(golden.sensitivity_of("postcapture"))

    def seen(*keys, to):
        found = copy.deepcopy(expected)
        *way, last = keys
        place = found
        for key in way:
            place = place[key]
        place[last] = to(place[last]) if callable(to) else to
        return list(golden.differences(found, expected, moved))

    samples = ("runs", "tde_aismc", "samples")
    assert seen("outline", "variables", "error", 2, "units", to="deg") != []
    assert seen("outline", "report", "panels", to=lambda panels: panels[1:]) != []
    assert seen("runs", "tdc", "metrics", "itae", to=lambda itae: itae * (1 + 1e-8)) != []
    assert seen(*samples, "generalized_force", 3, 0, to=lambda force: force + 1e-6) != []
    assert seen(*samples, "error", to=lambda rows: [row[:-1] for row in rows]) != []
    assert seen(*samples, to=lambda variables: variables | {"further": []}) != []
    assert seen(*samples, "position", 3, 0, to=float("nan")) != []
    assert seen(*samples, "position", 3, 0, to=lambda value: value * (1 + 1e-13)) == []
