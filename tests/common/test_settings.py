"""Settings: one declaration of a field, and what is derived from it."""

import dataclasses
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ffsm_drake import ScenarioError, load_scenario
from ffsm_drake.common.settings import Setting, problems, setting, settings_of
from ffsm_drake.scenario import Scenario, Thrusters, build_settings, schema_fields, thruster_layouts
from ffsm_drake.scenario.json_schema import scenario_schema


@dataclasses.dataclass(frozen=True, kw_only=True)
class Filter:
    order: int = setting(2, "", "of the low-pass filter", least=1, most=8)
    cut_off: float | None = setting(None, "Hz", "cut-off; null: none", above=0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sensor:
    """A sensor as a user would write one."""

    noise: dict[str, float] = setting({"all": 0.1}, "rad or m", "standard deviation", least=0)
    delay: dict[str, int] = setting({"all": 0}, "control samples", "age", least=0, most=9)
    mode: str = setting("raw", "", "what it gives", one_of=("raw", "filtered"))
    axis: list[float] = setting([0.0, 0.0, 1.0], "", "of any length", size=(3, 3), nonzero=True)
    share: float = setting(0.5, "", "of its range", least=0, below=1)
    filter: Filter = setting(Filter())
    filters: dict[str, Filter] = setting({}, "", "by name", size=(0, 2))
    spare: Filter | None = setting(None)
    extra: Any = setting(None)
    cache: dict[str, int] = dataclasses.field(default_factory=dict)  # no setting

    def check(self, key, scenario):
        if self.share > scenario.sample_time:
            yield f"{key}.share", "is above sample_time"


@dataclasses.dataclass
class Later:
    gain: "float" = setting(1.0, "1/s", "annotated by a text", above=0)


def told(data, cls=Sensor):
    with pytest.raises(ScenarioError) as error:
        build_settings(cls, data, "blocks.sensing.settings")
    text = str(error.value)
    assert "\n" not in text
    return text.removeprefix("blocks.sensing.settings.")


def test_what_is_not_given_keeps_its_default():
    assert build_settings(Sensor, {}, "x") == Sensor()
    given = {
        "noise": 1,
        "delay": {"joints": 3.0},
        "filter": {"order": 3},
        "filters": {"a": {"cut_off": "1e2"}},
        "spare": {},
        "extra": [1, {"a": None}],
    }
    found = build_settings(Sensor, given, "x")
    assert found.noise == {"all": 1.0}
    assert found.delay == {"joints": 3}
    assert found.filter == Filter(order=3)
    assert found.filters == {"a": Filter(cut_off=100.0)}
    assert found.spare == Filter()
    assert found.extra == [1, {"a": None}]
    assert build_settings(Later, {"gain": 2}, "x") == Later(gain=2.0)


def test_instances_share_no_default():
    first, second = Sensor(), Sensor()
    first.axis[0] = 5.0
    assert second.axis == [0.0, 0.0, 1.0]
    assert first.filter is not second.filter


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        ({"noice": 1}, "noice: unknown key; valid here: noise, delay, mode, axis, share, filter"),
        ({"cache": {"a": 1}}, "cache: unknown key"),
        ({"share": 1}, "share: must be from 0 to below 1, not 1"),
        ({"noise": {"joints": -1}}, "noise.joints: must be >= 0, not -1"),
        ({"delay": 10}, "delay.all: must be from 0 to 9 control samples, not 10"),
        ({"axis": [0, 0, 0]}, "axis: must not be zero"),
        ({"filter": {"order": 0}}, "filter.order: must be from 1 to 8, not 0"),
        ({"filters": {key: {} for key in "abc"}}, "filters: must hold at most 2 values, not 3"),
        ({"spare": {"order": 9}}, "spare.order: must be from 1 to 8, not 9"),
    ],
)
def test_errors_are_one_clear_line(data, expected):
    assert expected in told(data)


def test_a_type_that_no_file_holds_is_named():
    @dataclasses.dataclass
    class Odd:
        span: complex = setting(0j)

    assert told({"span": 1}, Odd).startswith("span: its class must declare it as float, int, bool")


def test_what_no_single_setting_can_say_is_checked_with_the_scenario():
    scenario = load_scenario("postcapture")
    assert build_settings(Sensor, {"share": 0.0}, "x", scenario) == Sensor(share=0.0)
    with pytest.raises(ScenarioError, match=r"^x\.share: is above sample_time$"):
        build_settings(Sensor, {}, "x", scenario)


def test_every_problem_is_told_by_key():
    wrong = Sensor(mode="none", share=2.0, filters={"a": Filter(order=0)}, axis=[1.0])
    assert [key for key, _ in problems(wrong)] == ["mode", "axis", "share", "filters.a.order"]


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        ({}, ""),
        ({"above": 0}, "> 0"),
        ({"least": 1}, ">= 1"),
        ({"most": 5}, "at most 5"),
        ({"below": 5}, "below 5"),
        ({"least": 0, "most": 2**31 - 1}, "from 0 to 2147483647"),
        ({"least": 0, "below": 1}, "from 0 to below 1"),
        ({"above": 0, "most": 0.01}, "> 0, at most 0.01"),
        ({"above": 0, "below": 1}, "> 0, below 1"),
    ],
)
def test_a_range_in_words(limits, expected):
    assert Setting(**limits).range == expected


def kinds(cls):
    """The dataclasses that a dataclass is made of, itself among them."""
    found = {cls}
    for kind in (schema_fields(cls) or {}).values():
        for inner in (kind, *getattr(kind, "__args__", ())):
            if dataclasses.is_dataclass(inner):
                found |= kinds(inner)
    return found


def test_every_field_of_a_scenario_is_a_setting():
    found = kinds(Scenario)
    assert len(found) > 20
    for cls in found:
        assert list(settings_of(cls)) == [field.name for field in dataclasses.fields(cls)], cls


def test_the_layouts_that_ship_are_the_choices():
    assert settings_of(Thrusters)["layout"].one_of == tuple(thruster_layouts())


def test_the_schema_has_the_ranges():
    properties = scenario_schema()["properties"]
    assert properties["duration"]["exclusiveMinimum"] == 0
    assert properties["clearance"]["minimum"] == 0
    assert properties["random_seed"]["maximum"] == 2**31 - 1
    assert properties["reference"]["properties"]["goal"]["enum"] == ["target_posture", "stop"]
    reserve = properties["planning"]["properties"]["reserve"]
    assert (reserve["minimum"], reserve["exclusiveMaximum"]) == (0, 1)
    by_coordinate, mapping = properties["tolerance"]["anyOf"]
    assert by_coordinate == mapping["additionalProperties"]
    assert by_coordinate == {"type": "number", "exclusiveMinimum": 0}
    position = properties["initial_posture"]["properties"]["base_position"]
    assert (position["minItems"], position["maxItems"]) == (3, 3)


@settings(derandomize=True, database=None, max_examples=60)
@given(
    st.integers(-(10**400), 10**400) | st.floats(),
    st.sampled_from([{"above": 0}, {"least": 0, "most": 5}, {"below": 1}, {"nonzero": True}]),
)
def test_any_number_is_taken_or_refused_in_words(value, limits):
    for given_value in (value, [value] * 3):
        for _, problem in Setting(**limits).problems(given_value, "key"):
            assert problem.startswith("must ")
            assert len(problem) < 100
