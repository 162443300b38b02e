"""Scenarios that extend others: what merges, where errors point, and that results are whole."""

import shutil

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ffsm_drake import RunRecord, ScenarioError, load_scenario, override_scenario, simulate
from ffsm_drake.scenario import (
    differing_keys,
    read_yaml,
    scenario_to_dict,
    scenario_to_yaml,
    shipped_scenarios,
    write_yaml,
)

WHOLE = ("estimator", "flexible", "blocks")  # groups whose kind may change are given at once


def written(folder, *layers, root=None):
    """Files, each of which extends the one before, in folders of their own; the last one."""
    base = root
    for number, layer in enumerate(layers):
        file = folder / str(number) / f"layer_{number}.yaml"
        file.parent.mkdir(exist_ok=True)
        if isinstance(base, str):
            layer = {"extends": base, **layer}
        file.write_text(write_yaml(layer))
        base = f"../{number}/layer_{number}.yaml"
    return file


def dealt(data, deal, path=()):
    """Nested data divided among layers: ``deal(path)`` is the layer of each entry."""
    layers = {}
    for key, value in data.items():
        if isinstance(value, dict) and value and key not in WHOLE:
            for layer, part in dealt(value, deal, (*path, key)).items():
                layers.setdefault(layer, {})[key] = part
        else:
            layers.setdefault(deal((*path, key)), {})[key] = value
    return layers


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("layers")


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(name=st.sampled_from(sorted(shipped_scenarios())), random=st.randoms(use_true_random=False))
def test_a_scenario_is_the_same_however_it_is_divided(folder, name, random):
    data = read_yaml(scenario_to_yaml(load_scenario(name)))
    layers = dealt(data, lambda path: random.randrange(3))
    file = written(folder, *(layers.get(k, {}) for k in range(3)))
    assert scenario_to_dict(load_scenario(file)) == data


CHANGES = st.fixed_dictionaries(
    {},
    optional={
        "duration": st.floats(1, 30),
        "controller": st.sampled_from(["tdc", "asmc"]),
        "payload": st.fixed_dictionaries(
            {"truth": st.fixed_dictionaries({"mass": st.floats(1, 200)})}
        ),
        "sensing": st.fixed_dictionaries(
            {"velocity_noise": st.dictionaries(st.sampled_from(["all", "joints"]), st.floats(0, 1))}
        ),
        "target_posture": st.fixed_dictionaries(
            {"base_position": st.lists(st.floats(-1, 1), min_size=3, max_size=3)}
        ),
    },
)


@settings(max_examples=12, deadline=None)
@given(changes=CHANGES)
def test_a_mapping_changes_a_scenario_as_a_file_that_extends_it(folder, changes):
    base = load_scenario("flight_sensors")
    before = scenario_to_dict(base)
    extended = load_scenario(written(folder, changes, root="flight_sensors"))
    changed = [
        base.replace(**changes),
        load_scenario("flight_sensors", [changes]),
        override_scenario(base, [changes]),
    ]
    assert differing_keys(extended, *changed) == []
    assert scenario_to_dict(base) == before


@pytest.mark.smoke
def test_what_merges_and_what_replaces(tmp_path):
    base = {
        "sensing": {"position_noise": {"base_position": 0.1, "joints": 0.2}},
        "estimator": {"kind": "kalman", "walk": {"all": 0.5}},
        "model": {
            "flexible": {"panel": {"frequency": 0.3}, "tank": {"kind": "mass", "stiffness": 2}}
        },
        "actuation": {"limit": {"all": 5, "joints": 3}},
        "controllers": {"tdc": {"k_d": 10, "k_p": 20}, "aismc": {"k_s_max": 4}},
        "target_posture": {"base_position": [1, 2, 3]},
        "blocks": {"actuation": {"system": "a:b", "settings": {"x": {"y": 1, "z": 2}}}},
    }
    above = {
        "sensing": {"position_noise": {"joints": 0.3}},
        "estimator": {"kind": "coupled"},
        "model": {"flexible": {"panel": {"mass": 7.0}, "tank": None}},
        "actuation": {"limit": 4},
        "controllers": {"tdc": {"k_d": 11}, "aismc": {"k_s_max": None}},
        "target_posture": {"base_position": [4, 5, 6]},
        "blocks": {"actuation": {"settings": {"x": {"y": 3}}}},
    }
    found = load_scenario(written(tmp_path, base, above))
    assert found.sensing.position_noise == {"base_position": 0.1, "joints": 0.3}
    plain = load_scenario(written(tmp_path, {}))
    assert found.estimator.walk == plain.estimator.walk  # another kind: nothing inherited
    assert set(found.model.flexible) == {"panel"}
    panel = found.model.flexible["panel"]
    assert (panel.frequency, panel.mass) == (0.3, 7.0)
    assert found.actuation.limit == {"all": 4.0}
    assert found.controllers["tdc"] == {"k_d": {"all": 11.0}, "k_p": {"all": 20.0}}
    assert found.controllers["aismc"] == {"k_s_max": None}
    assert found.target_posture.base_position == [4.0, 5.0, 6.0]
    assert found.blocks.actuation.settings == {"x": {"y": 3, "z": 2}}
    other = {"blocks": {"actuation": "c:d"}}
    found = load_scenario(written(tmp_path, base, other))
    assert (found.blocks.actuation.system, found.blocks.actuation.settings) == ("c:d", {})


def test_models_given_either_way_replace_each_other(tmp_path):
    urdf = {"model": {"servicer": "own.urdf"}}
    found = load_scenario(written(tmp_path, {}, urdf, root="postcapture")).model
    assert (found.directives, found.servicer) == (None, str(tmp_path / "1" / "own.urdf"))
    back = {"model": {"directives": "package://ffsm_drake/postcapture.dmd.yaml"}}
    assert load_scenario(written(tmp_path, urdf, back)).model.servicer is None


def test_relative_paths_start_at_the_file_that_gives_them(tmp_path):
    base = {"python_path": ["blocks"], "model": {"packages": {"own": "meshes"}}}
    above = {"model": {"packages": {"more": "meshes"}}}
    found = load_scenario(written(tmp_path, base, above))
    assert found.python_path == [str(tmp_path / "0" / "blocks")]
    assert found.model.packages == {
        "own": str(tmp_path / "0" / "meshes"),
        "more": str(tmp_path / "1" / "meshes"),
    }


# wrong alone: unknown key, type, range, a condition on several settings
FAULTS = {
    "sensing.delai": {"sensing": {"delai": 1}},
    "payload.truth.mass": {"payload": {"truth": {"mass": "heavy"}}},
    "payload.nominal.mass": {"payload": {"nominal": {"mass": -5}}},
    "payload.truth.inertia": {"payload": {"truth": {"inertia": [1, 1, 9]}}},
    "model.flexible.a.frequency": {"model": {"flexible": {"a": {}}}},
    "estimator.walk.joints": {"estimator": {"walk": {"joints": -1}}},
}


@settings(max_examples=12, deadline=None)
@given(key=st.sampled_from(sorted(FAULTS)), at=st.integers(0, 2), set_beside=st.booleans())
def test_errors_name_the_file_of_the_wrong_value(folder, key, at, set_beside):
    layers = [{"duration": 9.0 + k} for k in range(3)]
    layers[at] |= FAULTS[key]
    file = written(folder, *layers, root="flight_sensors")
    place = f"layer_{at}.yaml: {key}"
    with pytest.raises(ScenarioError, match=place.replace(".", r"\.")) as caught:
        load_scenario(file, ["random_seed=3"] if set_beside else [])
    assert "\n" not in str(caught.value)


def test_a_value_that_a_later_file_makes_wrong_is_that_files(tmp_path):
    file = written(tmp_path, {"sample_time": 1.0}, {"duration": 0.5})
    with pytest.raises(ScenarioError, match=r"layer_1\.yaml: sample_time"):
        load_scenario(file)
    with pytest.raises(ScenarioError, match=r"^--set sample_time"):
        load_scenario(written(tmp_path, {"sample_time": 1.0}, {}), ["duration=0.5"])


@settings(max_examples=10, deadline=None)
@given(length=st.integers(1, 6), before=st.integers(0, 2))
def test_a_circle_is_refused_in_one_line(folder, length, before):
    for k in range(before + length):
        following = k + 1 if k + 1 < before + length else before
        (folder / f"ring_{k}.yaml").write_text(f"extends: ring_{following}.yaml\n")
    with pytest.raises(
        ScenarioError, match=r"extends: leads back to itself: .* -> ring_"
    ) as caught:
        load_scenario(folder / "ring_0.yaml")
    assert "\n" not in str(caught.value)


def test_records_and_printed_scenarios_hold_the_whole(tmp_path):
    changes = {"duration": 0.1, "controller": "tdc"}
    file = written(tmp_path, {"payload": {"truth": {"mass": 70}}}, changes, root="postcapture")
    scenario = load_scenario(file)
    simulate(scenario, check_stability=False).save(tmp_path / "run")
    again = tmp_path / "again.yaml"
    again.write_text(scenario_to_yaml(scenario))
    for k in range(2):
        shutil.rmtree(tmp_path / str(k))
    recorded = RunRecord.load(tmp_path / "run").scenario
    assert differing_keys(scenario, recorded, load_scenario(again)) == []
    (tmp_path / "more.yaml").write_text("extends: run\nrandom_seed: 7\n")  # a run's folder
    assert differing_keys(scenario, load_scenario(tmp_path / "more.yaml")) == ["random_seed"]


@settings(max_examples=20, deadline=None)
@given(changes=CHANGES)
def test_reprs_are_one_short_line(changes):
    text = repr(load_scenario("postcapture").replace(**changes))
    assert text.startswith("Scenario('Post-capture")
    assert len(text) < 120
    assert "\n" not in text


def test_dotted_keys_in_mappings():
    scenario = load_scenario("postcapture", [{"payload.truth.mass": 70, "reference.duration": 9}])
    assert (scenario.payload.truth.mass, scenario.reference.duration) == (70.0, 9.0)
    assert scenario.payload.nominal.mass == 80.0
    with pytest.raises(ScenarioError, match=r"^--set payload\.truth\.mas: unknown key"):
        scenario.replace(payload={"truth": {"mas": 1}})
