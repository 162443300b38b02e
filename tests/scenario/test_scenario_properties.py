"""Properties of the scenario loader: it reads back what it wrote, and loads whatever it is given or
says one line.
"""

import copy
import math
import random
import types
import typing

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from ffsm_drake import ScenarioError, load_scenario
from ffsm_drake.common.settings import settings_of
from ffsm_drake.scenario import (
    BASE_ROTATIONS,
    CAPTURE_AXES,
    ESTIMATOR_KINDS,
    GOALS,
    Block,
    FrameGoal,
    Reference,
    Scenario,
    Thrusters,
    override_scenario,
    scenario_from_dict,
    scenario_from_yaml,
    scenario_to_dict,
    scenario_to_yaml,
    schema_fields,
    thruster_layouts,
)
from ffsm_drake.scenario.contacts import CHAIN_LAWS
from ffsm_drake.scenario.sensing import FURTHER, TIMES
from ffsm_drake.spacecraft.coordinates import BASE_POSITION, BASE_ROTATION, GROUPS

SETTINGS = settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=70,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
FEW = settings(SETTINGS, max_examples=15)

COORDINATES = st.sampled_from(
    ("all", *GROUPS, *BASE_ROTATION, *BASE_POSITION, "joint_1", "joint_2")
)
POSITIVE = st.floats(1e-6, 1e6)
SIGNED = st.floats(-1e6, 1e6)
TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=12)
NAME = st.text("abcxyz_", min_size=1, max_size=5)


@st.composite
def moments(draw):
    """Three principal moments within the triangle inequality."""
    a, b, fraction = draw(POSITIVE), draw(POSITIVE), draw(st.floats(0.05, 0.95))
    return [a, b, abs(a - b) + fraction * (a + b - abs(a - b))]


WHOLE = st.integers(1, 1000)

# Where a type alone does not make a value valid, by the end of the key.
SPECIAL = {
    "description": TEXT,
    "random_seed": st.integers(0, 2**31 - 1),
    "duration": st.floats(1.0, 100.0),
    "divergence_speed": st.floats(1.0, 1e6),
    "initial_velocity": st.floats(-1.0, 1.0)
    | st.dictionaries(COORDINATES, st.floats(-1.0, 1.0), max_size=3),
    "sample_time": st.floats(1e-3, 1.0),
    "start_time": st.just(0.0),
    "max_step_size": st.floats(1e-3, 1.0),
    "integration_scheme": st.sampled_from(("runge_kutta3", "implicit_euler")),
    "controller": st.sampled_from(("tdc", "pd_plus", "mine:Law", "a.b:c.d")),
    "system": st.sampled_from(("mine", "mine:Block", "a.b:c.d")),
    "forces": st.dictionaries(
        st.sampled_from(("drag", "wind_2")), st.just("mine:Block"), max_size=2
    ),
    "kind": st.sampled_from(ESTIMATOR_KINDS),
    "base_rotation": st.sampled_from(BASE_ROTATIONS),
    "inertia": moments(),
    "delay": st.integers(0, 1000),
    # Their numbers of samples depend on sample_time: tests/systems/test_sensor_units.py.
    **dict.fromkeys((f"{name}_time" for name in TIMES), st.none()),
    "segments": st.integers(4, 100),
    **dict.fromkeys(
        ("velocity_period", "position_period", "velocity_delay", "position_delay"),
        WHOLE | st.dictionaries(COORDINATES, WHOLE, max_size=3),
    ),
    "reserve": st.floats(0.0, 0.99),
    "goal": st.sampled_from(GOALS),
    "driven": st.just(["all"]),
    "contacts": st.just({}),
    "chain": st.fixed_dictionaries(
        {},
        optional={
            "law": st.sampled_from(CHAIN_LAWS),
            "force": st.none()
            | st.fixed_dictionaries(
                {"share": st.floats(0.0, 1.0)},
                optional={"preload": st.none() | st.lists(SIGNED, min_size=6, max_size=6)},
            ),
        },
    ),
    "capture": st.none()
    | st.fixed_dictionaries(
        {"rate": st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3)},
        optional={
            "axes": st.sampled_from(CAPTURE_AXES),
            "servicer": st.sampled_from(("rest", "track_all")),
        },
    ),
    "thrusters": st.none()
    | st.fixed_dictionaries(
        {"layout": st.sampled_from(tuple(thruster_layouts())), "frame": st.integers(20, 1000)},
        optional={
            "modulator": st.sampled_from(settings_of(Thrusters)["modulator"].one_of),
            "rise_time": st.floats(0.0, 1.0),
        },
    ),
    "wheels": st.none()
    | st.fixed_dictionaries(
        {
            "units": st.dictionaries(
                NAME,
                st.fixed_dictionaries({"axis": st.just([0.0, 3.0, 4.0])}),
                min_size=1,
                max_size=3,
            )
        },
        optional={"desaturation_time": st.floats(1.0, 100.0)},
    ),
    "drives": st.none()
    | st.fixed_dictionaries(
        {},
        optional={
            "gear_ratio": st.floats(1.0, 200.0),
            "knee": st.floats(0.0, 0.9),
            "rate_limit": st.none() | POSITIVE,
        },
    ),
    "command_filter": st.fixed_dictionaries(
        {},
        optional={
            "low_pass": st.floats(0.0, 50.0),
            "notch": st.dictionaries(COORDINATES, st.floats(0.0, 50.0)),
        },
    ),
    "environment": st.none()
    | st.fixed_dictionaries(
        {"altitude": st.floats(1.0, 1e9)},
        optional={
            "tidal": st.booleans(),
            "solar_pressure": st.fixed_dictionaries(
                {}, optional={"area": POSITIVE, "sun": st.just([0.0, 3.0, 4.0])}
            ),
        },
    ),
    "supervisor": st.none()
    | st.fixed_dictionaries(
        {"damping": st.floats(0.01, 0.5)},  # of samples up to 1 s
        optional={
            "end_share": st.floats(0.01, 1.0),
            "plan_share": st.floats(0.01, 1.0),
            "retry_factor": st.floats(0.01, 1.0),
            "error": st.none() | POSITIVE,
        },
    ),
    "effects": st.fixed_dictionaries(
        {},
        optional={
            "link": st.none()
            | st.fixed_dictionaries(
                {"drop_rate": st.floats(0.0, 0.9)}, optional={"delay": st.just([0.0, 0.02])}
            ),
            "geometry": st.fixed_dictionaries(
                {}, optional={"joint_offset": SIGNED, "hand_stretch": st.floats(-0.5, 0.5)}
            ),
        },
    ),
    "events": st.dictionaries(
        NAME,
        st.fixed_dictionaries(
            {"unit": TEXT, "kind": TEXT, "time": st.just([0.0])},
            optional={"size": st.none() | POSITIVE},
        ),
        max_size=2,
    ),
    "model": st.fixed_dictionaries(
        {},
        optional={
            "directives": NAME,
            "end_effector": TEXT,
            "packages": st.dictionaries(NAME, NAME, max_size=2),
        },
    )
    | st.fixed_dictionaries({"servicer": NAME}, optional={"debris": NAME, "grasp": TEXT}),
    "phases": st.dictionaries(NAME, st.fixed_dictionaries({"system": NAME}), max_size=2),
    "harmonics": st.dictionaries(
        COORDINATES,
        st.fixed_dictionaries({}, optional={"amplitude": SIGNED, "frequency": SIGNED}),
        max_size=3,
    ),
}

REFERENCES = st.fixed_dictionaries(
    {},
    optional={
        "duration": POSITIVE,
        "base_rotation": st.sampled_from(BASE_ROTATIONS),
        "frame": st.none()
        | st.fixed_dictionaries(
            {},
            optional={
                "frame": TEXT,
                "task": st.sampled_from(settings_of(FrameGoal)["task"].one_of),
                "damping": POSITIVE,
            },
        ),
    },
) | st.fixed_dictionaries({"kind": st.just("optimal"), "plan": NAME})


def values(kind, key=""):
    """Valid plain data of a type of the schema; every key of a group may be left out."""
    if kind is Reference:
        return REFERENCES
    if key in SPECIAL:
        return SPECIAL[key]
    if kind is Block:
        return st.fixed_dictionaries(
            {"system": values(str, "system")}, optional={"settings": values(dict[str, typing.Any])}
        )
    if kind is typing.Any:
        return st.none() | st.booleans() | SIGNED | TEXT | st.lists(SIGNED, max_size=3)
    fields = schema_fields(kind)
    if fields is not None:
        return st.fixed_dictionaries(
            {}, optional={name: values(inner, name) for name, inner in fields.items()}
        )
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return st.none() | values(args[0])
    if origin is dict:
        names = COORDINATES if args[1] is float else NAME
        by_name = st.dictionaries(names, values(args[1]), max_size=3)
        return POSITIVE | by_name if args[1] is float else by_name
    if origin is list:
        return st.lists(NAME if args[0] is str else SIGNED, min_size=3, max_size=3)
    return {float: POSITIVE, int: WHOLE, bool: st.booleans(), str: TEXT}[kind]


def consistent(data):
    """With a capture the base turns about an eigenaxis; a supervisor plans postures; faults are of
    the scenario's own blocks; phases take whole samples and come before an approach, and their
    list is not free; effects are of own blocks and held targets; sensors have a density or time, or
    a value per sample.
    """
    if (data.get("blocks") or {}).get("actuation") is not None:
        data.get("effects", {}).pop("link", None)
    if data.get("capture") is not None:
        data.get("effects", {}).pop("geometry", None)
    sensing = data.get("sensing") or {}
    for name, further in FURTHER.items():
        if sensing.get(further) is not None:
            sensing.pop(name, None)
    data.pop("phases", None)
    phases = (data.get("blocks") or {}).get("phases", {})
    if (data.get("capture") or {}).get("approach") is None:
        phases.clear()
    for phase in phases.values():
        phase["duration"] = 3.0 * data.get("sample_time", Scenario().sample_time)
    if data.get("capture") is not None:
        data.setdefault("reference", {})["base_rotation"] = "eigenaxis"
    if data.get("supervisor") is not None:
        data.get("reference", {}).pop("frame", None)
    if (data.get("faults") or {}).get("events"):
        data.pop("blocks", None)
    return data


SCENARIOS = values(Scenario).map(consistent).map(scenario_from_dict)

JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from((0, -1, 10**400, -(10**20), 1e300, 5e-324, math.nan, math.inf))
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(("nan", "-inf", "1e999", "tdc", "kalman", "", "\n", "a\u2028b", "\ud800")),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text(max_size=6) | COORDINATES, inner, max_size=4)
    ),
    max_leaves=6,
)
VALID = scenario_to_dict(
    load_scenario(
        "postcapture",
        ["controllers={Law: {k: 1, d: {joints: 2}, m: null}}", "blocks.forces={drag: 'a:b'}"],
    )
)


def places(data, path=()):
    """Paths of every mapping entry and list item in plain data."""
    items = (
        data.items()
        if isinstance(data, dict)
        else enumerate(data)
        if isinstance(data, list)
        else ()
    )
    for key, value in items:
        yield (*path, key)
        yield from places(value, (*path, key))


PLACES = sorted(places(VALID), key=str)


def check_loads_or_says_one_line(load, *args):
    """Any exception but ScenarioError passes through, and fails the test."""
    try:
        scenario, refusal = load(*args), None
    except ScenarioError as error:
        scenario, refusal = None, error
    if refusal is not None:
        text = str(refusal)
        assert len(text.splitlines()) == 1, text
        assert len(text) > 10, text
        assert str(copy.copy(refusal)) == text  # so it comes whole from another process
    else:
        data = scenario_to_dict(scenario)
        assert scenario_to_dict(scenario_from_dict(data)) == data
        assert scenario.num_control_periods >= 1


@FEW
@given(SCENARIOS)
def test_plain_data_round_trip(scenario):
    data = scenario_to_dict(scenario)
    assert scenario_to_dict(scenario_from_dict(data)) == data


@FEW
@given(SCENARIOS)
@example(scenario_from_dict({"description": "1e5"}))
@pytest.mark.smoke
def test_yaml_round_trip(scenario):
    assert scenario_to_dict(scenario_from_yaml(scenario_to_yaml(scenario))) == scenario_to_dict(
        scenario
    )


@FEW
@given(SCENARIOS, st.integers(0, 2**31 - 1))
def test_an_override_changes_its_key_alone(scenario, seed):
    data = scenario_to_dict(scenario)
    assert scenario_to_dict(override_scenario(scenario, [f"random_seed={seed}"])) == data | {
        "random_seed": seed
    }
    assert scenario_to_dict(scenario) == data


def lists_and_mappings(schema, path=""):
    """Keys of lists and mappings that may not be null, within sections that are always there."""
    for name, kind in schema_fields(schema).items():
        if schema_fields(kind) is not None:
            yield from lists_and_mappings(kind, f"{path}{name}.")
        elif typing.get_origin(kind) in (list, dict):
            yield f"{path}{name}"


def test_null_is_no_list_and_no_mapping():
    """Types such as list[float] are equal without being one object, in whatever order they are
    read.
    """
    keys = [*lists_and_mappings(Scenario)]
    assert len(keys) > 30
    for key in random.Random(0).sample(keys, len(keys)):
        with pytest.raises(ScenarioError, match=rf"{key}.*must be .*, not null"):
            override_scenario(Scenario(), [f"{key}=null"])


@pytest.mark.slow
@SETTINGS
@given(
    st.lists(
        st.tuples(st.sampled_from(PLACES), st.sampled_from(("replace", "delete", "add")), JSON),
        min_size=1,
        max_size=3,
    )
)
@example([(("duration",), "replace", 10**400)])
@example([(("duration",), "add", "a\nb")])
@example([(("payload", "truth", "inertia"), "replace", [1e20, 1e-300, 1e20])])
def test_mutated_scenarios(mutations):
    data = copy.deepcopy(VALID)
    for path, action, value in mutations:
        try:
            *parents, last = path
            target = data
            for key in parents:
                target = target[key]
            if action == "replace":
                target[last] = value
            elif action == "delete":
                del target[last]
            elif isinstance(target, dict):
                target[str(value)] = value
            else:
                target.append(value)
        except (KeyError, IndexError, TypeError):
            continue  # an earlier mutation took the place away
    check_loads_or_says_one_line(scenario_from_dict, data)


@SETTINGS
@given(JSON)
def test_anything_as_a_scenario(data):
    check_loads_or_says_one_line(scenario_from_dict, data)


# Separated by blanks, after which come the pieces that hold blanks or control characters
# themselves.
_WORDS = """duration payload truth mass : { } [ ] 1 .nan *a << ' " | > # --- ... 0x 0b
1:30 2020-13-45 ~ = _a"""
_BLANKS = (": ", "\n", "  ", "\n  ", "- ", ", ", "? ", "\t", "%YAML 1.1\n", "\u2028", "\x00", "&a ")
_TAGS = tuple(f"!!{name} " for name in ("int", "float", "timestamp", "binary", "python/none"))
YAML_PIECES = st.lists(st.sampled_from((*_WORDS.split(), *_BLANKS, *_TAGS)), max_size=12).map(
    "".join
)


@SETTINGS
@given(YAML_PIECES | st.text(max_size=20))
@example("!!int ''")
@example("!!timestamp x: 1")
@example("!!bool maybe")
@example("? [1]\n: 2")
@example("<<: 3")
@example("a: &a {<<: *a}")
def test_any_text_as_yaml(text):
    check_loads_or_says_one_line(scenario_from_yaml, text)


@SETTINGS
@given(
    st.sampled_from(PLACES).map(lambda path: ".".join(map(str, path))) | st.text(max_size=8),
    st.sampled_from(("=", "", "==", ".x=", "..=", ".joint_1=")),
    JSON.map(str) | YAML_PIECES | st.text(max_size=10),
)
def test_any_text_as_override(key, equals, value):
    base = scenario_from_dict(VALID)
    check_loads_or_says_one_line(override_scenario, base, [key + equals + value])
    assert scenario_to_dict(base) == VALID


@pytest.mark.parametrize("path", PLACES, ids=lambda path: ".".join(map(str, path)))
@pytest.mark.smoke
def test_nan_is_refused_everywhere(path):
    data = copy.deepcopy(VALID)
    target = data
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = math.nan
    with pytest.raises(ScenarioError, match=path[0]):
        scenario_from_dict(data)
