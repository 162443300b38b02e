"""A trained policy as a control law: a linear one is a PD law, and a bad file has its line."""

import json
import shutil
import sys

import numpy as np
import pytest

from ffsm_drake import BlockError, ScenarioError, load_scenario, simulate, stability
from ffsm_drake.plugins.campaign.spec import load_spec, spec_from_json
from ffsm_drake.runs.batches import run_many
from ffsm_drake.systems.controllers import make_controller
from ffsm_drake.systems.registry import find_factory

onnx = pytest.importorskip("onnx", reason="needs onnx, of the extra test")
pytest.importorskip("onnxruntime", reason="needs onnxruntime, an extra")

from c_code import needs_llvm  # noqa: E402
from entry_points import needs  # noqa: E402
from networks import linear_policy, metadata_of, network  # noqa: E402

from ffsm_drake.mission import Mission, make_mission  # noqa: E402
from ffsm_drake.spacecraft.craft import make_nominal_plant  # noqa: E402

GAINS = {"base_rotation": (300.0, 600.0), "base_position": (300.0, 600.0), "joints": (30.0, 60.0)}
SCALE = 1000.0


PD_LAW = f"""
import dataclasses
import numpy as np
from ffsm_drake import ControlLaw, gain

@dataclasses.dataclass(frozen=True, kw_only=True)
class Pd(ControlLaw):
    k_p: np.ndarray = gain({ {name: values[0] for name, values in GAINS.items()} })
    k_d: np.ndarray = gain({ {name: values[1] for name, values in GAINS.items()} })

    def step(self, sample, state):
        return self.k_p * sample.e + self.k_d * sample.e_dot, state
"""


def save_policy(path, weights, metadata, size=None):
    onnx.save(linear_policy(weights, metadata, size), path)


@pytest.fixture(scope="module")
def pd(tmp_path_factory, coordinates):
    """A folder with the PD law, ``written_pd:Pd``, and as a policy, ``pd.onnx``."""
    folder, names = tmp_path_factory.mktemp("policy"), coordinates.names
    (folder / "written_pd.py").write_text(PD_LAW)
    weights = np.zeros((len(names), 4 * len(names) + 1))
    for i, group in enumerate(coordinates.group_of):
        weights[i, [i, len(names) + i]] = np.array(GAINS[group]) / SCALE
    scenario = load_scenario("postcapture")
    save_policy(folder / "pd.onnx", weights, metadata_of(scenario, coordinates))
    return folder


@pytest.fixture(scope="module")
def coordinates():
    return make_nominal_plant(load_scenario("postcapture")).coordinates


def flown(folder, *changes):
    given = ["controller=policy:pd.onnx", f"python_path=[{folder}]", *changes]
    return load_scenario("postcapture", given)


def test_a_linear_policy_runs_and_is_judged_as_the_pd_law(pd):
    scenario = flown(pd, "duration=2")
    written = scenario.replace(controller="written_pd:Pd")
    run, same = (simulate(each, check_stability=False) for each in (scenario, written))
    for name in ("position", "velocity", "generalized_force"):
        np.testing.assert_allclose(
            run.dataset[name].values, same.dataset[name].values, rtol=0.0, atol=1e-6
        )
    own, other = stability(scenario), stability(written)
    np.testing.assert_allclose(own.eta, other.eta, atol=1e-6)
    for loop, wanted in zip(own.loops, other.loops, strict=True):
        np.testing.assert_allclose(loop.samples[0].c, wanted.samples[0].c, atol=1e-2)
        assert loop.spectral_radius == pytest.approx(wanted.spectral_radius, abs=1e-6)


def test_the_record_of_a_policy_can_be_repeated(pd, tmp_path, monkeypatch):
    monkeypatch.chdir(pd)
    scenario = load_scenario("postcapture", ["controller=policy:pd.onnx", "duration=0.2"])
    run = simulate(scenario, check_stability=False)
    monkeypatch.chdir(tmp_path)
    again = simulate(run.scenario, check_stability=False)
    np.testing.assert_array_equal(again.dataset.position.values, run.dataset.position.values)


@pytest.mark.parametrize(
    "engine", ["drake", pytest.param("compiled", marks=[needs_llvm, needs("compiled")])]
)
def test_a_policy_that_is_saved_again_is_read_again(engine, tmp_path, coordinates):
    scenario, size = flown(tmp_path, "duration=0.1"), len(coordinates.names)
    metadata = metadata_of(scenario.replace(controller="tdc"), coordinates)
    forces = list[np.ndarray]()
    for factor in (1.0, -0.5, 0.25):
        weights = np.zeros((size, 4 * size + 1))
        weights[:, 2 * size] = 1e-4 * factor  # of the quaternion's first number, 1 at the start
        save_policy(tmp_path / "pd.onnx", weights, metadata)
        run = simulate(scenario, engine=engine, check_stability=False)
        assert run.engine.startswith(engine)
        forces.append(run.dataset["generalized_force"].values[0])
        np.testing.assert_allclose(forces[-1], factor * forces[0], rtol=1e-5)
    assert forces[0].any()


@pytest.mark.parametrize(
    "name", ["reach.onnx", "sub/policy-v2.onnx", "a b/ü (1).onnx", "v1.2@x.onnx"]
)
def test_a_policy_stands_beside_the_scenario(name, pd, tmp_path, monkeypatch):
    """Whatever its name; in the scenario, its record, a campaign, and after a move of all."""
    there, away = tmp_path / "there", tmp_path / "away"
    away.mkdir()
    (there / name).parent.mkdir(parents=True)
    shutil.copyfile(pd / "pd.onnx", there / name)
    (there / "s.yaml").write_text(
        json.dumps({"extends": "postcapture", "duration": 0.1, "controller": f"policy:{name}"})
    )
    mass = {"payload.truth.mass": {"distribution": "uniform", "low": 20, "high": 300}}
    spec = {"scenario": "s.yaml", "controllers": [f"policy:{name}"], "cases": 2}
    (there / "c.yaml").write_text(json.dumps({**spec, "parameters": mass}))
    monkeypatch.chdir(away)
    run = simulate(load_scenario(str(there / "s.yaml")), check_stability=False)
    run.save(there / "out" / "run")
    assert load_spec(there / "c.yaml").controllers == [f"policy:{(there / name).resolve()}"]
    text = load_spec(there / "c.yaml").to_json(there)
    there.rename(tmp_path / "moved")
    moved = tmp_path / "moved"
    assert spec_from_json(text, moved).controllers == [f"policy:{(moved / name).resolve()}"]
    again = simulate(load_scenario(str(moved / "out" / "run")), check_stability=False)
    np.testing.assert_array_equal(again.dataset.position.values, run.dataset.position.values)


def test_the_law_of_a_file_is_registered_or_named_beside_it(pd, tmp_path, coordinates):
    """The law by metadata is not imported; the user's word is."""
    scenario = load_scenario("postcapture", ["duration=0.2"])
    metadata = metadata_of(scenario, coordinates, action="residual", law="written_pd:Pd")
    size = len(coordinates.names)
    save_policy(tmp_path / "none.onnx", np.zeros((size, 4 * size + 1)), metadata)
    where = [f"python_path=[{tmp_path}, {pd}]", "duration=0.2"]
    sys.modules.pop("written_pd", None)
    with pytest.raises(BlockError, match=r"law is one of tdc, .*policy:none.onnx@module:attribute"):
        simulate(load_scenario("postcapture", [*where, "controller=policy:none.onnx"]))
    assert "written_pd" not in sys.modules
    gains = ["controllers={Pd: {k_p: 50}}"]
    named = load_scenario(
        "postcapture", [*where, *gains, "controller=policy:none.onnx@written_pd:Pd"]
    )
    own = load_scenario("postcapture", [*where, *gains, "controller=written_pd:Pd"])
    found, wanted = (simulate(each, check_stability=False) for each in (named, own))
    np.testing.assert_array_equal(found.dataset.position.values, wanted.dataset.position.values)


@pytest.mark.smoke
@pytest.mark.parametrize("name", ["policy:", "policy:a\nb.onnx", "policy:\x07.onnx", "policy"])
def test_a_policy_without_a_file_is_refused(name):
    if name == "policy":
        load_scenario("postcapture", [{"controller": name}])  # a name
        return
    with pytest.raises(ScenarioError, match="must be policy:FILE"):
        load_scenario("postcapture", [{"controller": name}])


def test_compiled_runs_call_a_policy(pd):
    pytest.importorskip("llvmlite", reason="needs llvmlite, an extra")
    scenarios = [flown(pd, "duration=0.5").replace(random_seed=seed) for seed in (1, 2)]
    found, expected = (
        dict(run_many([*map(Mission, scenarios)], engine=name)) for name in ("compiled", "drake")
    )
    for index, log in found.items():
        assert log.engine.startswith("compiled (law called: ")
        state = expected[index].series["state"]
        # the network has seven digits
        np.testing.assert_allclose(log.series["state"], state, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("steps", [1, 4])
def test_a_residual_of_zero_is_the_law_that_it_changes(steps, tmp_path, coordinates):
    scenario = load_scenario("postcapture", ["duration=0.3", "controller=tdc"])
    metadata = metadata_of(
        scenario, coordinates, action="residual", law="tdc", samples_per_step=str(steps)
    )
    size = len(coordinates.names)
    save_policy(tmp_path / "none.onnx", np.zeros((size, 4 * size + 1)), metadata)
    own = scenario.replace(
        controller="policy:none.onnx", python_path=[str(tmp_path)], controllers=scenario.controllers
    )
    found, wanted = (simulate(each, check_stability=False) for each in (own, scenario))
    np.testing.assert_array_equal(found.dataset.position.values, wanted.dataset.position.values)


def assert_refused(folder, name, line):
    with pytest.raises(BlockError) as raised:
        find_factory("controller", f"policy:{name}", python_path=[str(folder)])
    assert line in str(raised.value)
    assert "\n" not in str(raised.value)
    assert "ONNXRuntimeError" not in str(raised.value)


@pytest.mark.parametrize(
    ("metadata", "size", "line"),
    [
        ({"action_names": '["joint_9"]', "scale": "[1]"}, None, "its output has the shape"),
        ({"scale": "[1, 2]"}, None, "scale a number for each action"),
        ({"action": "torque"}, None, "action is one of force"),
        ({"scale": "1 2"}, None, "metadata"),
        ({}, 50, "its input has the shape (1, 50); must be (1, 45)"),
    ],
)
def test_a_bad_file_has_one_clear_line(metadata, size, line, tmp_path, coordinates):
    given = metadata_of(load_scenario("postcapture"), coordinates, **metadata)
    save_policy(tmp_path / "bad.onnx", np.zeros((11, 45)), given, size)
    assert_refused(tmp_path, "bad.onnx", line)


FLOAT, DOUBLE, INT = (onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE, onnx.TensorProto.INT64)


@pytest.mark.parametrize(
    ("inputs", "outputs", "nodes", "line"),
    [
        (
            {"x": (FLOAT, [1, 45]), "h": (FLOAT, [1, 11])},
            {"y": (FLOAT, [1, 11])},
            [("MatMul", ["x", "w"], ["m"]), ("Add", ["m", "h"], ["y"])],
            "must have one input and an output, not the inputs x, h; a recurrent network",
        ),
        (
            {"x": (DOUBLE, [1, 45])},
            {"y": (FLOAT, [1, 11])},
            [("Cast", ["x"], ["f"], {"to": FLOAT}), ("MatMul", ["f", "w"], ["y"])],
            "its input has the type tensor(double); must be tensor(float)",
        ),
        (
            {"x": (FLOAT, [1, 45])},
            {"y": (INT, [1, 11])},
            [("MatMul", ["x", "w"], ["m"]), ("Cast", ["m"], ["y"], {"to": INT})],
            "its output has the type tensor(int64); must be tensor(float)",
        ),
        (
            {"x": (FLOAT, ["batch", "time", 45])},
            {"y": (FLOAT, ["batch", "time", 11])},
            [("MatMul", ["x", "w"], ["y"])],
            "its input has the shape ('batch', 'time', 45); must be (1, 45)",
        ),
        (
            {"x": (FLOAT, ["batch", "width"])},
            {"y": (FLOAT, ["batch", "actions"])},
            [("Concat", ["x", "x"], ["y"], {"axis": 1})],
            "gives actions of the shape (1, 90), not (1, 11)",
        ),
        (
            {"x": (FLOAT, ["batch", "width"])},
            {"y": (FLOAT, ["batch", 11])},
            [("Slice", ["x", "s", "s"], ["c"]), ("MatMul", ["c", "w"], ["y"])],
            "the network cannot be run: ",
        ),
    ],
)
def test_a_network_with_other_ports_is_refused_as_it_is_loaded(
    inputs, outputs, nodes, line, tmp_path, coordinates
):
    constants = {"w": np.zeros((45, 11), np.float32), "s": np.array([3, 5], np.int64)}
    metadata = metadata_of(load_scenario("postcapture"), coordinates)
    model = network(nodes, inputs, outputs, constants, metadata)
    onnx.save(model, tmp_path / "bad.onnx")
    assert_refused(tmp_path, "bad.onnx", line)


def test_a_file_that_is_none_is_named(tmp_path, coordinates):
    (tmp_path / "text.onnx").write_text("no network")
    save_policy(tmp_path / "bare.onnx", np.zeros((11, 45)), {})
    for name, line in {
        "text.onnx": "text.onnx is no ONNX model",
        "none.onnx": "no such file",
        "bare.onnx": "lacks metadata 'observation_names'",
    }.items():
        assert_refused(tmp_path, name, line)


def test_a_policy_of_another_task_is_refused(pd):
    changes = ["controller=policy:pd.onnx", f"python_path=[{pd}]"]
    scenario = load_scenario("free_floating", changes)
    with pytest.raises(BlockError, match="number 1 of its actions is 'base_rotation_x'"):
        make_controller(make_mission(scenario), make_nominal_plant(scenario))
