"""Results that are kept: what tells two calls apart, and what one caller can do to another."""

import dataclasses
import importlib
import os
import pkgutil
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig

from ffsm_drake import scenario
from ffsm_drake.common.memo import content_of, memoized
from ffsm_drake.scenario import Scenario, load_scenario, planned_part, shipped_scenarios

SECTIONS = [
    kind
    for module in pkgutil.iter_modules(scenario.__path__, "ffsm_drake.scenario.")
    for kind in vars(importlib.import_module(module.name)).values()
    if isinstance(kind, type) and dataclasses.is_dataclass(kind)
    if kind.__module__ == module.name
    if not module.name.endswith(".layers")  # what a scenario is made of, no part of one
    if kind.__name__ != "FaultKind"  # a part declares it
]


def counted(maxsize=100, **options):
    """A function of anything that is kept, and the calls that it really made."""
    calls = []

    @memoized(maxsize=maxsize, **options)
    def function(*args, **kwargs):
        calls.append((args, kwargs))
        return len(calls)

    return function, calls


@pytest.mark.parametrize("section", SECTIONS, ids=lambda kind: kind.__name__)
def test_every_field_of_a_scenario_is_part_of_the_key(section):
    """Alone and where it stands within a scenario."""
    function, calls = counted()
    plain = section()
    function(plain)
    function(section())
    assert len(calls) == 1
    for number, field in enumerate(dataclasses.fields(section), start=2):
        changed = section()
        object.__setattr__(changed, field.name, ["something", "else"])
        within = dataclasses.replace(Scenario(), blocks={"of": [changed]})
        assert content_of(within) != content_of(
            dataclasses.replace(within, blocks={"of": [plain]})
        ), field.name
        function(changed)
        assert len(calls) == number, field.name


@pytest.mark.parametrize("name", shipped_scenarios())
def test_a_scenario_that_is_read_again_is_the_same(name):
    assert content_of(load_scenario(name)) == content_of(load_scenario(name))


@pytest.mark.smoke
def test_a_setting_of_drake_is_part_of_the_key():
    plain = content_of(SimulatorConfig())
    for field in SimulatorConfig.__fields__:
        changed, value = SimulatorConfig(), getattr(SimulatorConfig(), field.name)
        other = (
            not value
            if isinstance(value, bool)
            else "radau3"
            if isinstance(value, str)
            else value + 1
        )
        setattr(changed, field.name, other)
        assert content_of(changed) != plain, field.name


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (1, 1.0),
        (0, False),
        (0.0, -0.0),
        ("1", 1),
        ([1, 2], (1, 2)),
        ({"a": 1, "b": 2}, {"b": 2, "a": 1}),
        ({"a": {"b": [1]}}, {"a": {"b": [2]}}),
        (np.zeros(2), np.zeros((2, 1))),
        (np.zeros(2), np.zeros(2, dtype=np.float32)),
        (np.zeros(2), np.array([0.0, 1e-300])),
        (np.arange(4.0), np.arange(8.0)[::2]),
    ],
)
def test_what_differs_is_told_apart(one, other):
    function, calls = counted()
    for value in (one, other, one, other):
        function(value)
    assert len(calls) == 2


@pytest.mark.smoke
def test_equal_content_is_found_again():
    function, calls = counted()
    for array in (np.arange(8.0)[::2], np.array([0.0, 2.0, 4.0, 6.0])):
        function({"a": [array, float("nan")]}, key=(Path("none"), None))
    assert len(calls) == 1


def test_what_is_passed_may_change_afterwards():
    function, calls = counted()
    given = Scenario()
    function(given)
    given.sensing.velocity_noise["all"] = 1.0
    function(given)
    assert len(calls) == 2


@pytest.mark.smoke
def test_a_file_counts_with_its_change(tmp_path):
    function, calls = counted()
    file = tmp_path / "model.urdf"
    function(file)  # there is none yet
    file.write_text("one")
    function(file)
    function(file)
    assert len(calls) == 2
    os.utime(file, ns=(1, 1))
    function(file)
    assert len(calls) == 3


@pytest.mark.parametrize(
    "value",
    [object(), np.array([None]), iter([]), lambda: None],
    ids=lambda value: str(type(value)),
)
def test_what_cannot_be_compared_is_refused(value):
    function, calls = counted()
    with pytest.raises(TypeError, match="cannot be part of a cache key"):
        function([value])
    assert calls == []


def test_few_are_kept():
    function, calls = counted(maxsize=2)
    for value in (1, 2, 1, 3, 1, 2):
        function(value)
    assert [args for args, _ in calls] == [(1,), (2,), (3,), (2,)]


@dataclasses.dataclass(frozen=True)
class Found:
    names: list
    by_name: dict
    pairs: tuple
    matrix: np.ndarray


def test_a_caller_cannot_change_what_another_gets():
    kept = np.ones(3)

    @memoized(maxsize=1)
    def find():
        return Found(names=["a"], by_name={"a": {"b": [1]}}, pairs=([1], {2}), matrix=kept)

    for _ in range(2):  # the first computes, the second finds
        found = find()
        found.names.append("b")
        found.by_name["a"]["b"].append(2)
        found.pairs[0].append(2)
        found.pairs[1].add(3)
        with pytest.raises(ValueError, match="read-only"):
            found.matrix[0] = 2.0
        with pytest.raises(ValueError, match="WRITEABLE"):
            found.matrix.flags.writeable = True
        kept[:] = 5.0
    fresh = find()
    assert fresh.names == ["a"]
    assert fresh.by_name == {"a": {"b": [1]}}
    assert fresh.pairs == ([1], {2})
    assert fresh.matrix == pytest.approx(np.ones(3))


def test_controllers_share_a_plan():
    one, other = (
        load_scenario("flight_sensors", [f"controller={name}", "random_seed=3"])
        for name in ("tdc", "asmc")
    )
    assert content_of(planned_part(one)) == content_of(planned_part(other))
    moved = load_scenario("flight_sensors", ["reference.duration=19"])
    assert content_of(planned_part(one)) != content_of(planned_part(moved))
