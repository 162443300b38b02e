"""A value that cannot be used is blamed on where it was given (the file, an override, or the
Scenario that Python code made), and on its own key.
"""

import dataclasses
import math
import typing
import warnings

import pytest
import yaml
from click.testing import CliRunner
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from ffsm_drake import (
    ScenarioError,
    load_scenario,
    make_closed_loop,
    override_scenario,
    simulate,
    simulate_many,
)
from ffsm_drake.cli import main
from ffsm_drake.common.errors import placed
from ffsm_drake.common.registrations import VERBS
from ffsm_drake.common.settings import Setting, settings_of
from ffsm_drake.mission import make_mission
from ffsm_drake.runs.judge import JUDGES
from ffsm_drake.scenario import Scenario, checked
from ffsm_drake.scenario.resolving import schema_fields, without_null

SETTINGS = settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=100,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)


@dataclasses.dataclass(frozen=True)
class Place:
    """A single value of the schema: its dotted key, its type and its setting."""

    key: str
    kind: typing.Any
    declared: Setting


def leaves(kind, declared, key=""):
    """Every place of the schema that holds a value; entries of mappings are called ``entry``."""
    kind = without_null(kind)
    fields = schema_fields(kind)
    if fields is not None:
        own = settings_of(kind)
        for name, inner in fields.items():
            yield from leaves(inner, own[name], f"{key}.{name}" if key else name)
    elif typing.get_origin(kind) is dict:
        name = "all" if typing.get_args(kind)[1] is float else "entry"
        yield from leaves(typing.get_args(kind)[1], declared, f"{key}.{name}")
    elif kind is not typing.Any:
        yield Place(key, kind, declared)


PLACES = sorted(leaves(Scenario, Setting()), key=lambda place: place.key)
DURATION = next(place for place in PLACES if place.key == "duration")

# A shaper does not do without.
SHAPED = ("reference.shaper.frequencies", [1.0])


def besides(place):
    """Keys and values that a place's group cannot do without."""
    return [SHAPED] if place.key.startswith("reference.shaper.") and place.key != SHAPED[0] else []


def outside(declared):
    """Numbers that a setting does not allow."""
    numbers = st.sampled_from((math.nan, math.inf, -math.inf, 1e21, -1e300))
    if declared.above > -math.inf:
        numbers |= st.floats(max_value=declared.above, min_value=-1e20)
    if declared.least > -math.inf:
        numbers |= st.floats(max_value=declared.least, min_value=-1e20, exclude_max=True)
    if declared.most < math.inf:
        numbers |= st.floats(min_value=declared.most, max_value=1e20, exclude_min=True)
    if declared.below < math.inf:
        numbers |= st.floats(min_value=declared.below, max_value=1e20)
    return numbers


def wrong(place):
    """Values that a place cannot hold."""
    kind, declared = place.kind, place.declared
    if kind is bool:
        return st.sampled_from(("perhaps", 2, [True]))
    if kind is str:
        words = st.sampled_from((3, 0.5, True, ["a"]))
        return words | st.just("no such choice") if declared.one_of else words
    if typing.get_origin(kind) is list:
        of_numbers = typing.get_args(kind)[0] is float
        short = declared.size[0] > 0
        entries = outside(declared) if of_numbers else st.sampled_from((3, True))
        several = entries.map(lambda entry: [entry, *[1.0] * 2])
        return several | st.just("text") | (st.just([]) if short else st.nothing())
    return outside(declared) | st.sampled_from(("text", True, [1.0]))


CASES = st.sampled_from(PLACES).flatmap(lambda place: st.tuples(st.just(place), wrong(place)))


def nested(given):
    """Plain data that holds values at dotted keys."""
    data = {}
    for key, value in given:
        *groups, last = key.split(".")
        target = data
        for name in groups:
            target = target.setdefault(name, {})
        target[last] = value
    return data


def put(scenario, key, value):
    """Set an attribute, or an entry of a mapping, of a Scenario; groups are made on the way."""
    *groups, last = key.split(".")
    target, kind = scenario, Scenario
    for name in groups:
        inside = isinstance(target, dict)
        kind = typing.get_args(kind)[1] if inside else schema_fields(kind)[name]
        kind = without_null(kind)
        found = target.get(name) if inside else getattr(target, name)
        if found is None:
            found = {} if typing.get_origin(kind) is dict else kind()
            target.__setitem__(name, found) if inside else setattr(target, name, found)
        target = found
    target.__setitem__(last, value) if isinstance(target, dict) else setattr(target, last, value)


def check_blamed(place, source, load, *args, **kwargs):
    """The message names the source, then the key or an entry of it, and nothing is said before."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ScenarioError) as caught:
            load(*args, **kwargs)
    said = str(caught.value)
    start = placed(source, place.key)
    assert said.startswith((f"{start}: ", f"{start}[")), said
    assert len(said.splitlines()) == 1


def as_text(value):
    return yaml.safe_dump(value, default_flow_style=True, width=10**6).removesuffix("...\n").strip()


@pytest.mark.slow
@SETTINGS
@given(CASES)
def test_of_a_file(tmp_path, case):
    place, value = case
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(nested([*besides(place), (place.key, value)])))
    check_blamed(place, str(path), load_scenario, path)
    if place.key != "description":
        check_blamed(place, str(path), load_scenario, path, ["description=another"])


@pytest.mark.slow
@SETTINGS
@given(CASES)
def test_of_an_override(case):
    place, value = case
    given = [("description", "another"), *besides(place), (place.key, value)]
    words = [f"{key}={as_text(value)}" for key, value in given]
    check_blamed(place, "--set", load_scenario, "postcapture", words)
    check_blamed(place, "--set", override_scenario, Scenario(), words)


ENTRIES = {
    "simulate": simulate,
    "simulate_many": lambda scenario: simulate_many([scenario, scenario]),
    "verdict": getattr(JUDGES.first(), "warnings", None),
    "stability": VERBS.find("stability"),
    "design": VERBS.find("design"),
}


@SETTINGS
@given(CASES, st.sampled_from(sorted(ENTRIES)))
@example((DURATION, -1.0), "simulate")
@example((DURATION, "x"), "simulate_many")
@example((DURATION, math.nan), "stability")
def test_of_a_scenario_made_in_python(case, entry):
    place, value = case
    assume(ENTRIES[entry] is not None)  # its plug-in is installed
    if place.key.startswith("simulator_config."):
        assume(isinstance(value, float))  # Drake's own struct refuses or converts others
    scenario = checked(Scenario())
    for key, item in [*besides(place), (place.key, value)]:
        put(scenario, key, item)
    check_blamed(place, "Scenario", ENTRIES[entry], scenario)


@settings(SETTINGS, max_examples=10)
@given(st.sampled_from(("joint_1", "joint_3", "joint_5")), st.booleans())
def test_a_value_of_a_flexible_joint(joint, gains):
    key = "controllers.tde_aismc.k_d" if gains else "target_posture.joints"
    loose = f"model.flexible.loose={{kind: joint, joint: {joint}, frequency: 1}}"
    nothing = [f"{name}_posture.joints={{all: 0}}" for name in ("initial", "target")]
    scenario = load_scenario("postcapture", [loose, *nothing, f"{key}.{joint}=0.5"])
    with pytest.raises(ScenarioError, match=rf"{key}.{joint}: is a flexible joint"):
        make_closed_loop(scenario)


PARTS = {  # what makes a flexible part unusable, by the key that is blamed
    "body": {"frequency": 1.0, "body": "nowhere"},
    "joint": {"frequency": 1.0, "kind": "joint", "joint": "nowhere"},
    "": {"frequency": 1.0, "mass": 1e-9, "length": 1e-9, "width": 1e-9},
}


@pytest.mark.parametrize("key", PARTS)
@pytest.mark.parametrize("way", ["file", "override"])
def test_a_part_that_the_model_cannot_have(tmp_path, monkeypatch, key, way):
    """Whoever gave it is blamed, not the payload, nor a file that does not hold it."""
    monkeypatch.chdir(tmp_path)
    words = ["validate", "postcapture", "--set", f"model.flexible.p={as_text(PARTS[key])}"]
    if way == "file":
        (tmp_path / "mine.yaml").write_text(
            yaml.safe_dump({"model": {"flexible": {"p": PARTS[key]}}})
        )
        words = ["validate", "mine.yaml"]
    said = CliRunner().invoke(main, words).stderr
    source = "mine.yaml: " if way == "file" else "--set "
    place = (
        f"model.flexible.p.{key}: no " if key else "model.flexible: 'p' moves a negligible inertia"
    )
    assert said.startswith(f"error: {source}{place}"), said
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize("text", ["postcapture", "duration=5"])
def test_a_file_that_holds_a_text_is_no_override(tmp_path, text):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ScenarioError, match=rf"mine.yaml: must be a mapping .*, not '{text}'"):
        load_scenario(path)


@SETTINGS
@given(CASES)
def test_of_a_mission_whose_scenario_was_changed(case):
    place, value = case
    if place.key.startswith("simulator_config."):
        assume(isinstance(value, float) and place.kind is float)
    mission = make_mission(checked(Scenario()))
    put(mission.scenario, place.key, value)
    with pytest.raises(ScenarioError, match=r"^scenario: changed after its mission was made"):
        make_closed_loop(mission)
