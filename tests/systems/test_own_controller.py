"""Controllers from elsewhere: the door, the conformance kit, and what a bad one is told."""

import importlib.util
import inspect
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from pydrake.systems.framework import LeafSystem

from ffsm_drake import (
    BlockError,
    ControllerSetup,
    RunRecord,
    SampledController,
    load_scenario,
    make_nominal_plant,
    simulate,
)
from ffsm_drake.cli import main
from ffsm_drake.scenario import CONTROLLER_NAMES
from ffsm_drake.systems.controllers import OPTIONAL_OUTPUTS, controller_names, make_controller
from ffsm_drake.testing import ConformanceError, check_controller

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("own_controller", EXAMPLES / "own_controller.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["own_controller"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["own_controller"]


def test_the_example_is_short_and_conforms(example):
    assert len(inspect.getsource(example.MyPdPlus).splitlines()) <= 25
    passed = check_controller(example.MyPdPlus)
    assert len(passed.checks) == 5
    assert 0 < passed.update_time < 0.01
    assert "no state outside the context" in str(passed)


def test_the_example_agrees_with_the_shipped_one(example):
    gains = "{k_p: {base_position: 900, base_rotation: 300, joints: 20}, k_d: {all: 250, joints: 25}}"
    common = ["duration=0.3"]
    ours = simulate(load_scenario("postcapture", [*common, "controller=pd_plus", f"controllers.own.pd_plus={gains}"]))
    theirs = simulate(
        load_scenario(
            "postcapture", [*common, "controller=own_controller:MyPdPlus", f"controllers.own.MyPdPlus={gains}"]
        )
    )
    assert np.array_equal(ours.dataset["generalized_force"], theirs.dataset["generalized_force"])
    assert np.abs(ours.dataset["generalized_force"]).max() > 0


@pytest.mark.parametrize("name", ["computed_torque", "pd_plus"])
def test_installed_controllers_conform(name):
    assert name in controller_names()
    check_controller(name)


@pytest.mark.parametrize("name", CONTROLLER_NAMES)
def test_the_papers_controllers_conform(name):
    def factory(setup):
        scenario = load_scenario("paper", [f"controller={name}", f"sample_time={setup.sample_time}"])
        return make_controller(scenario, setup.nominal)

    scenario = load_scenario("paper", [f"controller={name}"])
    if name == "tdc":
        check_controller(factory, scenario=scenario)
    else:  # their gains by group serve any model too
        check_controller(factory)


def test_computed_torque_needs_a_true_model():
    exact = "payload.nominal={mass: 100, inertia: [16.7, 16.7, 16.7]}"
    quiet = ["duration=5", "sensing.velocity_noise=0", "disturbance.amplitude_scale=0", "controller=computed_torque"]
    wrong = simulate(load_scenario("postcapture", quiet)).metrics["itae"]
    right = simulate(load_scenario("postcapture", [*quiet, exact])).metrics["itae"]
    assert right < 0.02 * wrong  # what is left is that the force is held over the period


class HidesState(SampledController):
    def __init__(self, setup):
        super().__init__(setup)
        self.integral = np.zeros(len(setup.coordinates.names))

    def law(self, sample, state):
        self.integral += sample.e
        return 10 * sample.e_dot + self.integral, state


class Random(SampledController):
    def law(self, sample, state):
        return sample.e + 1e-9 * np.random.default_rng().standard_normal(sample.e.size), state


class ByIndex(SampledController):
    def law(self, sample, state):
        return np.arange(1.0, 1.0 + sample.e.size) * sample.e, state


class DividesByError(SampledController):
    def law(self, sample, state):
        with np.errstate(all="ignore"):
            return sample.e_dot / np.linalg.norm(sample.e), state


class Constant(SampledController):
    def law(self, sample, state):
        return np.ones_like(sample.e), state


class Ports(LeafSystem):
    """The contract's ports but the force."""

    def __init__(self, setup):
        super().__init__()
        self.size = len(setup.coordinates.names)
        for name in ("estimated_state", "desired_state"):
            self.DeclareVectorInputPort(name, 2 * self.size + 1)
        self.DeclareVectorInputPort("desired_acceleration", self.size)

    def velocity_error(self, context):
        state, desired = (self.GetInputPort(name).Eval(context) for name in ("estimated_state", "desired_state"))
        return (desired - state)[-self.size :]


class Follows(Ports):
    """Its force follows the inputs at once."""

    def __init__(self, setup):
        super().__init__(setup)
        self.DeclareVectorOutputPort("generalized_force", self.size, self.calc)

    def calc(self, context, output):
        output.SetFromVector(self.velocity_error(context))


class Peeks(Follows):
    """The same, but it denies it."""

    def __init__(self, setup):
        Ports.__init__(self, setup)
        prerequisites = {self.all_state_ticket(), self.time_ticket()}
        self.DeclareVectorOutputPort("generalized_force", self.size, self.calc, prerequisites)


class Plain(Ports):
    """A sampled controller without the base class."""

    def __init__(self, setup):
        super().__init__(setup)
        self.DeclareStateOutputPort("generalized_force", self.DeclareDiscreteState(self.size))
        self.DeclarePeriodicDiscreteUpdateEvent(setup.sample_time, 0.0, self.update)

    def update(self, context, values):
        values.set_value(self.velocity_error(context))


class SmallPort(LeafSystem):
    def __init__(self, setup):
        super().__init__()
        self.DeclareVectorInputPort("estimated_state", 6)


class OddPort(LeafSystem):
    def __init__(self, setup):
        super().__init__()
        self.DeclareVectorInputPort("state", 6)


class Forgets(SampledController):
    def initial_state(self):
        return {"memory": np.zeros(2)}

    def law(self, sample, state):
        return sample.e, {}


class WrongSize(SampledController):
    def law(self, sample, state):
        return sample.q, state


class DividesByZero(SampledController):
    def law(self, sample, state):
        return 1 / 0


@pytest.mark.parametrize(
    ("factory", "expected"),
    [
        (HidesState, "HidesState: hides state on self: after a reset"),
        (Random, "two new controllers give different forces"),
        (ByIndex, "changes when the model lists its joints in another order; give gains by name"),
        (DividesByError, "the force is not finite at sample 0 with no error at all"),
        (Constant, "the force never changes"),
        (Follows, "output port 'generalized_force' must not follow an input at once; declare it with Declare"),
        (Peeks, "follows its inputs between two samples; declare it as an output of discrete state"),
        (Ports, "needs an output port 'generalized_force' of size 11"),
        (SmallPort, "input port 'estimated_state' must have size 23, not 6"),
        (OddPort, "unknown input port 'state'; known: estimated_state"),
        (Forgets, "law returned no 'memory'"),
        (WrongSize, r"of shape \(12,\); it must be \(11,\)"),
        (DividesByZero, "the update raises ZeroDivisionError"),
        (lambda setup: 3, "must be a LeafSystem, not int"),
        (lambda: 3, "cannot be built: TypeError"),
        ("nowhere:Class", "cannot be loaded: No module named 'nowhere'; run from the folder that holds it"),
        ("math:pi", "must be a class or function, not float"),
        ("unheard_of", "is unknown; choose one of tdc, asmc, aismc, tde_aismc, computed_torque, pd_plus"),
    ],
)
def test_the_kit_says_what_is_wrong(factory, expected):
    with pytest.raises(ConformanceError, match=expected) as caught:
        check_controller(factory)
    assert "\n" not in str(caught.value)


def test_the_two_armed_model_really_lists_its_joints_in_another_order(tmp_path):
    from ffsm_drake.testing import _two_armed

    base = load_scenario("postcapture")
    joints = {
        make_nominal_plant(_two_armed(base, names, tmp_path / f"{names[0]}.urdf")).coordinates.joints
        for names in (("left", "right"), ("right", "left"))
    }
    assert joints == {("left", "right"), ("right", "left")}


MODULE = """
import numpy as np
from ffsm_drake import SampledController

class Integral(SampledController):
    GAINS = {"k_p": 50.0, "k_d": 200.0, "k_i": {"all": 0.0, "joints": 5.0}}

    def initial_state(self):
        return {"integral": np.zeros_like(self.gains["k_i"]), "sliding_variable": np.zeros_like(self.gains["k_i"])}

    def law(self, sample, state):
        integral = state["integral"] + self.sample_time * sample.e
        surface = self.gains["k_d"] * sample.e_dot + self.gains["k_p"] * sample.e + self.gains["k_i"] * integral
        return surface, {"integral": integral, "sliding_variable": surface}

class Nan(SampledController):
    def law(self, sample, state):
        return sample.e + (np.nan if sample.q_d[4] < 0.0999999 else 0.0), state

class Raises(SampledController):
    def law(self, sample, state):
        raise RuntimeError("no idea")
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A user's folder with a module in it, as the current directory."""
    (tmp_path / "users_own.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield tmp_path
    sys.modules.pop("users_own", None)


def test_from_the_command_line(module):
    arguments = ["run", "--controller", "users_own:Integral", "--set", "duration=0.2", "--no-report", "--out", "mine"]
    result = CliRunner().invoke(main, [*arguments, "--set", "controllers.own.Integral.k_i.joints=7"])
    assert result.exit_code == 0, result.output
    record = RunRecord.load("mine")
    assert record.scenario.controller == "users_own:Integral"
    assert record.scenario.controllers.own == {"Integral": {"k_i": {"joints": 7.0}}}
    assert set(OPTIONAL_OUTPUTS) & set(record.dataset) == {"sliding_variable"}
    assert np.array_equal(record.dataset["sliding_variable"], record.dataset["generalized_force"])


def test_compare_takes_any(module):
    result = CliRunner().invoke(
        main,
        ["compare", "-c", "users_own:Integral", "-c", "tdc", "--set", "duration=0.1", "--no-report", "--out", "duel"],
    )
    assert result.exit_code == 0, result.output
    assert {path.name for path in (module / "duel").iterdir()} == {"Integral", "tdc"}


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (["-c", "users_own:Raises"], 2, "'users_own:Raises' failed at t = 0.00 s: RuntimeError: no idea"),
        (["-c", "users_own:Nan"], 3, "users_own:Nan diverged at t = 0."),
        (["-c", "users_own:Nothing"], 2, "users_own has no 'Nothing'"),
        (["-c", "users_own:Integral", "--set", "controllers.own.Integral.k=1"], 2, "Integral has k_p, k_d, k_i"),
        (["-c", "users_own:Integral", "--set", "controllers.own.Integral.k_p.joint_9=1"], 2, "unknown coordinate"),
    ],
)
def test_bad_ones_get_one_line(module, arguments, code, expected):
    result = CliRunner().invoke(main, ["run", *arguments, "--set", "duration=3", "--no-report", "--out", "mine"])
    assert result.exit_code == code, result.output
    assert expected in result.stderr
    assert "Traceback" not in result.output


def test_the_closed_loop_takes_a_plain_leaf_system(module):
    """Without the base class, with the contract's ports alone."""
    text = inspect.getsource(Ports) + "\n\n" + inspect.getsource(Plain)
    (module / "plain.py").write_text(f"from pydrake.systems.framework import LeafSystem\n\n\n{text}")
    sys.path.append(str(module))
    scenario = load_scenario("postcapture", ["controller=plain:Plain", "duration=0.1", "sensing.velocity_noise=0"])
    record = simulate(scenario)
    assert record.outcome.completed
    assert np.allclose(record.dataset["generalized_force"], record.dataset["error_rate"], atol=1e-12)
    check_controller(Plain)


def test_gains_default_and_override():
    nominal = make_nominal_plant(load_scenario("postcapture"))

    def gains(**given):
        return ControllerSetup(name="x", nominal=nominal, sample_time=0.01, gains=given).gain_vectors(
            {"k": {"all": 1.0, "joints": 2.0}}
        )["k"]

    assert gains().tolist() == [1.0] * 6 + [2.0] * 5
    assert gains(k={"joint_2": 5.0}).tolist() == [1.0] * 6 + [2.0, 5.0, 2.0, 2.0, 2.0]
    assert gains(k={"all": 3.0}).tolist() == [3.0] * 11
    assert gains(k={"all": 3.0, "joints": 4.0}).tolist() == [3.0] * 6 + [4.0] * 5


def test_a_name_that_exists_nowhere():
    scenario = load_scenario("postcapture", ["controller=own_module:Nowhere"])
    with pytest.raises(BlockError, match="No module named 'own_module'"):
        make_controller(scenario, make_nominal_plant(scenario))


def test_every_controller_flies_every_shipped_scenario_briefly(shipped_scenario, any_controller):
    record = simulate(
        load_scenario(shipped_scenario, [f"controller={any_controller}", "duration=0.3"]), check_stability=False
    )
    assert record.outcome.completed
    assert np.isfinite(record.dataset["generalized_force"].values).all()


def pytest_generate_tests(metafunc):
    from ffsm_drake.scenario import shipped_scenarios

    if "shipped_scenario" in metafunc.fixturenames:
        metafunc.parametrize("shipped_scenario", sorted(shipped_scenarios()))
    if "any_controller" in metafunc.fixturenames:
        metafunc.parametrize("any_controller", controller_names())
