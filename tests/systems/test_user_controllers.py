"""User-supplied controllers: how they are found, the conformance kit, and what a bad one is
told.
"""

import dataclasses
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
    ControlLaw,
    RunRecord,
    ScenarioError,
    gain,
    load_scenario,
    make_nominal_plant,
    simulate,
)
from ffsm_drake.cli import main
from ffsm_drake.mission import make_mission
from ffsm_drake.systems.controllers import (
    OPTIONAL_OUTPUTS,
    controller_names,
    gain_vectors,
    make_controller,
)
from ffsm_drake.testing import ConformanceError, check_controller

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("own_law", EXAMPLES / "own_law.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["own_law"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["own_law"]


def test_the_example_is_short_and_conforms(example):
    assert len(inspect.getsource(example.MyPdPlus).splitlines()) <= 25
    passed = check_controller(example.MyPdPlus)
    assert len(passed.checks) == 5
    assert 0 < passed.update_time < 0.01
    assert "no state outside the context" in str(passed)


def test_the_example_agrees_with_the_shipped_one(example):
    gains = (
        "{k_p: {base_position: 900, base_rotation: 300, joints: 20}, k_d: {all: 250, joints: 25}}"
    )
    common = ["duration=0.3"]
    ours, theirs = (
        simulate(
            load_scenario(
                "postcapture", [*common, f"controller={name}", f"controllers.{key}={gains}"]
            ),
            check_stability=False,
        )
        for key, name in (("pd_plus", "pd_plus"), ("MyPdPlus", "own_law:MyPdPlus"))
    )
    assert np.array_equal(ours.dataset["generalized_force"], theirs.dataset["generalized_force"])
    assert np.abs(ours.dataset["generalized_force"]).max() > 0


@pytest.mark.parametrize("name", controller_names())
def test_shipped_controllers_conform(name):
    check_controller(name)


def test_computed_torque_needs_a_true_model():
    exact = "payload.nominal={mass: 100, inertia: [16.7, 16.7, 16.7]}"
    quiet = [
        "duration=3",
        "sensing.velocity_noise=0",
        "disturbance.amplitude_scale=0",
        "controller=computed_torque",
    ]
    wrong, right = (
        simulate(load_scenario("postcapture", overrides), check_stability=False).metrics["itae"]
        for overrides in (quiet, [*quiet, exact])
    )
    assert right < 0.02 * wrong  # what is left is that the force is held over the period


@dataclasses.dataclass(frozen=True)
class HidesState(ControlLaw):
    integral: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(1))

    def step(self, sample, state):
        self.integral[0] += sample.e[0]
        return 10 * sample.e_dot + self.integral[0], state


class Random(ControlLaw):
    def step(self, sample, state):
        return sample.e + 1e-9 * np.random.default_rng().standard_normal(sample.e.size), state


class ByIndex(ControlLaw):
    def step(self, sample, state):
        return np.arange(1.0, 1.0 + sample.e.size) * sample.e, state


class DividesByError(ControlLaw):
    def step(self, sample, state):
        with np.errstate(all="ignore"):
            return sample.e_dot / np.linalg.norm(sample.e), state


class Constant(ControlLaw):
    def step(self, sample, state):
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
        state, desired = (
            self.GetInputPort(name).Eval(context) for name in ("estimated_state", "desired_state")
        )
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


class Breaks(Peeks):
    """Drake calls its own code, which fails."""

    def calc(self, context, output):
        raise ZeroDivisionError("nothing to divide by")


class Plain(Ports):
    """A sampled controller without a law."""

    def __init__(self, setup):
        super().__init__(setup)
        self.DeclareStateOutputPort("generalized_force", self.DeclareDiscreteState(self.size))
        self.DeclarePeriodicDiscreteUpdateEvent(setup.sample_time, 0.0, self.update)

    def update(self, context, values):
        values.set_value(self.velocity_error(context))


class Forgets(ControlLaw):
    def initial_state(self):
        return {"memory": np.zeros(2)}

    def step(self, sample, state):
        return sample.e, {}


class WritesIntoState(Forgets):
    def step(self, sample, state):
        state["memory"][:] = 1.0
        return sample.e, state


class DividesByZero(ControlLaw):
    def step(self, sample, state):
        return 1 / 0


@dataclasses.dataclass(frozen=True)
class OddField(DividesByZero):
    speed: float


@pytest.mark.parametrize(
    ("factory", "expected"),
    [
        (HidesState, "controller 'HidesState' hides state on self: after a reset"),
        (Random, "two new controllers give different forces"),
        (ByIndex, "depends on the order of the joints in the model; give gains by name"),
        (DividesByError, "the force is not finite at sample 0 with no error at all"),
        (Constant, "the force never changes"),
        (
            Follows,
            "output port 'generalized_force' must not depend directly on an input; use Decl",
        ),
        (
            Peeks,
            "follows its inputs between two samples; output a discrete state",
        ),
        (Breaks, "^user-supplied 'Breaks' failed: ZeroDivisionError: nothing to divide by"),
        (Ports, "needs an output port 'generalized_force' of size 11"),
        (Forgets, "step must return memory memory, not none"),
        (WritesIntoState, "destination is read-only"),
        (OddField, r"field 'speed' must be a gain\(...\), model, sample_time or have a default"),
        (DividesByZero, r"failed at t = 0.00 s: ZeroDivisionError: .*\(in DividesByZero.step: "),
        (lambda: 3, "cannot be built: TypeError"),
        (
            "nowhere:Class",
            "cannot be loaded: run from the folder of the module",
        ),
    ],
)
def test_the_kit_says_what_is_wrong(factory, expected):
    with pytest.raises(ConformanceError, match=expected) as caught:
        check_controller(factory)
    assert "\n" not in str(caught.value)
    assert "ConformanceError" not in str(caught.value)


def test_the_two_armed_model_really_lists_its_joints_in_another_order(tmp_path):
    from ffsm_drake.testing import two_armed

    base = load_scenario("postcapture")
    joints = {
        make_nominal_plant(two_armed(base, names, tmp_path / f"{names[0]}.urdf")).coordinates.joints
        for names in (("left", "right"), ("right", "left"))
    }
    assert joints == {("left", "right"), ("right", "left")}


MODULE = """
import dataclasses
import numpy as np
from ffsm_drake import ControlLaw, gain

@dataclasses.dataclass(frozen=True, kw_only=True)
class Integral(ControlLaw):
    sample_time: float
    k_p: np.ndarray = gain(50.0)
    k_d: np.ndarray = gain(200.0)
    k_i: np.ndarray = gain({"all": 0.0, "joints": 5.0})

    def initial_state(self):
        return {"integral": np.zeros_like(self.k_i), "sliding_variable": np.zeros_like(self.k_i)}

    def step(self, sample, state):
        integral = state["integral"] + self.sample_time * sample.e
        surface = self.k_d * sample.e_dot + self.k_p * sample.e + self.k_i * integral
        return surface, {"integral": integral, "sliding_variable": surface}
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A user's folder with a module in it, as the current directory."""
    (tmp_path / "users_own.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return tmp_path


def test_from_the_command_line(module):
    arguments = [
        "run",
        "--controller",
        "users_own:Integral",
        "--set",
        "duration=0.2",
        "--no-report",
        "--out",
        "mine",
    ]
    result = CliRunner().invoke(main, [*arguments, "--set", "controllers.Integral.k_i.joints=7"])
    assert result.exit_code == 0, result.output
    record = RunRecord.load("mine")
    assert record.scenario.controller == "users_own:Integral"
    assert record.scenario.controllers["Integral"] == {
        "k_p": {"all": 50.0}, "k_d": {"all": 200.0}, "k_i": {"all": 0.0, "joints": 7.0},
    }  # fmt: skip
    assert set(OPTIONAL_OUTPUTS) & set(record.dataset) == {"sliding_variable"}
    assert np.array_equal(record.dataset["sliding_variable"], record.dataset["generalized_force"])


@pytest.mark.slow
def test_compare_takes_any(module):
    result = CliRunner().invoke(
        main,
        [
            "compare",
            "-c",
            "users_own:Integral",
            "-c",
            "tdc",
            "--set",
            "duration=0.1",
            "--no-report",
            "--out",
            "duel",
        ],
    )
    assert result.exit_code == 0, result.output
    assert {path.name for path in (module / "duel").iterdir()} == {"Integral", "tdc"}


def test_the_closed_loop_takes_a_plain_leaf_system(module):
    """Without a law, with the ports alone."""
    text = inspect.getsource(Ports) + "\n\n" + inspect.getsource(Plain)
    (module / "plain.py").write_text(
        f"from pydrake.systems.framework import LeafSystem\n\n\n{text}"
    )
    sys.path.append(str(module))
    scenario = load_scenario(
        "postcapture", ["controller=plain:Plain", "duration=0.1", "sensing.velocity_noise=0"]
    )
    record = simulate(scenario)
    assert record.outcome.completed
    assert np.allclose(
        record.dataset["generalized_force"], record.dataset["error_rate"], atol=1e-12
    )
    check_controller(Plain)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gains(ControlLaw):
    k: np.ndarray = gain({"all": 1.0, "joints": 2.0})
    limit: np.ndarray = gain(5.0, bound=True)
    scale: float = gain(1.0, scalar=True, positive=True)

    def step(self, sample, state):
        return self.k * sample.e, state


@pytest.mark.smoke
def test_gains_default_and_override():
    coordinates = make_nominal_plant(load_scenario("postcapture")).coordinates

    def gains(*overrides):
        scenario = load_scenario("postcapture", [f"controller={__name__}:Gains", *overrides])
        return gain_vectors(scenario, coordinates)

    assert gains()["k"].tolist() == [1.0] * 6 + [2.0] * 5
    assert gains("controllers.Gains.k.joint_2=5")["k"].tolist() == [1.0] * 6 + [
        2.0,
        5.0,
        2.0,
        2.0,
        2.0,
    ]
    assert gains("controllers.Gains.k=3")["k"].tolist() == [3.0] * 11
    assert gains("controllers.Gains.k={all: 3, joints: 4}")["k"].tolist() == [3.0] * 6 + [4.0] * 5
    assert gains()["limit"].tolist() == [5.0] * 11
    assert np.isinf(gains("controllers.Gains.limit=null")["limit"]).all()
    assert gains("controllers.Gains.scale=2")["scale"] == 2.0
    for override, problem in (
        (
            "controllers.Gains.k=null",
            "controllers.Gains.k: must be a number, or numbers by coordinate, not null",
        ),
        ("controllers.Gains.k.joints=-1", "controllers.Gains.k.joints: must be >= 0, not -1"),
        ("controllers.Gains.scale=0", "controllers.Gains.scale: must be > 0, not 0"),
        (
            "controllers.Gains.scale.joints=1",
            "controllers.Gains.scale: must be one number for all coordinates",
        ),
        ("controllers.Gains.k.elbow=1", "controllers.Gains.k.elbow: unknown coordinate"),
        ("controllers.Gains.q=1", "controllers.Gains.q: unknown gain; Gains has k, limit, scale"),
    ):
        with pytest.raises(ScenarioError) as caught:
            gains(override)
        assert problem in str(caught.value)


def test_every_controller_runs_on_every_shipped_scenario(shipped_scenario, any_controller):
    given = load_scenario(shipped_scenario)
    closing = max((each.closes for each in given.contacts.values()), default=0.0)
    short = [f"controller={any_controller}", f"duration={closing + 0.1}"]
    if given.capture is not None:
        short.append("capture.approach=null")
    if given.faults is not None:  # they may begin later
        short.append("faults=null")
    # some laws, and some motions, look at all of it beforehand
    if given.reference.plan is None and not closing:
        short.append("reference.duration=5")
    # a frame is not measured by sensors with delays of their own
    if any_controller == "task_time_delay":
        short.append("estimator.kind=one_sample")
    if given.contacts:  # some laws need the velocities of all joints, and say so
        scenario = load_scenario(shipped_scenario, short)
        try:
            make_controller(make_mission(scenario), make_nominal_plant(scenario))
        except BlockError as error:
            if "set chain.law: plain" not in str(error):
                raise
            short.append("chain.law=plain")
    record = simulate(load_scenario(shipped_scenario, short), check_stability=False)
    assert record.outcome.completed
    assert np.isfinite(record.dataset["generalized_force"].values).all()


def pytest_generate_tests(metafunc):
    from ffsm_drake.scenario import shipped_scenarios

    if "shipped_scenario" not in metafunc.fixturenames:
        if "any_controller" in metafunc.fixturenames:
            metafunc.parametrize("any_controller", controller_names())
        return
    # Every scenario and every controller in each run of the tests, every pair among the long ones.
    pairs = [
        pytest.param(
            name, law, marks=() if law == "tdc" or name == "postcapture" else pytest.mark.long
        )
        for name in sorted(shipped_scenarios())
        for law in controller_names()
    ]
    metafunc.parametrize(("shipped_scenario", "any_controller"), pairs)
