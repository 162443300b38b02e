"""Replacing the blocks of the closed loop, from YAML and from Python, and repeating such a run from
its record.
"""

import json
import shutil
import sys

import numpy as np
import pytest
from children import finished
from click.testing import CliRunner
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from ffsm_drake import (
    BlockError,
    ClosedLoop,
    RunRecord,
    ScenarioError,
    add_closed_loop,
    load_scenario,
    simulate,
)
from ffsm_drake.cli import main
from ffsm_drake.loop.blocks import BLOCKS, make_blocks
from ffsm_drake.mission import make_mission
from ffsm_drake.testing import ConformanceError, check_block

pytestmark = pytest.mark.rounding

LAB = {
    "reference": """
class Rest(LeafSystem):
    """
    + '"""Stays at the initial posture."""'
    + """

    def __init__(self, setup):
        super().__init__()
        model, posture = setup.nominal, setup.scenario.initial_posture
        q = configuration(model.coordinates, posture, key="initial_posture")
        nv = len(setup.coordinates.names)
        self.values = {"desired_state": np.r_[q, np.zeros(nv)],
                       "desired_acceleration": np.zeros(nv)}
        for name, value in self.values.items():
            self.DeclareVectorOutputPort(name, value.size, getattr(self, name),
                                         {self.nothing_ticket()})

    def desired_state(self, context, output):
        output.SetFromVector(self.values["desired_state"])

    def desired_acceleration(self, context, output):
        output.SetFromVector(self.values["desired_acceleration"])
""",
    "sensing": """
class Vicon(LeafSystem):
    def __init__(self, setup):
        super().__init__()
        size = 2 * len(setup.coordinates.names) + 1
        self.offset = np.zeros(size)
        self.offset[4:7] = setup.settings["offset"]
        self.state = self.DeclareVectorInputPort("state", size)
        self.DeclareVectorOutputPort("estimated_state", size, self.calc)

    def calc(self, context, output):
        output.SetFromVector(self.state.Eval(context) + self.offset)
""",
    "controller": """
@dataclasses.dataclass(frozen=True, kw_only=True)
class Springs(ControlLaw):
    k_p: np.ndarray = gain(40.0, "N m/rad or N/m", "stiffness")
    k_d: np.ndarray = gain(20.0, "N m s/rad or N s/m", "damping")

    def step(self, sample, state):
        return self.k_p * sample.e + self.k_d * sample.e_dot, state
""",
    "actuation": """
class Half(LeafSystem):
    def __init__(self, setup):
        super().__init__()
        size = len(setup.coordinates.names)
        self.commanded = self.DeclareVectorInputPort("commanded_force", size)
        ticket = {self.input_port_ticket(self.commanded.get_index())}
        self.DeclareVectorOutputPort("applied_force", size, self.calc, ticket)

    def calc(self, context, output):
        output.SetFromVector(0.5 * self.commanded.Eval(context))
""",
    "forces": """
class Friction(LeafSystem):
    def __init__(self, setup):
        super().__init__()
        self.size, self.damping = len(setup.coordinates.names), setup.settings.get("damping", 2.0)
        self.state = self.DeclareVectorInputPort("state", 2 * self.size + 1)
        self.DeclareVectorOutputPort("generalized_force", self.size, self.calc)

    def calc(self, context, output):
        force = np.zeros(self.size)
        force[6:] = -self.damping * self.state.Eval(context)[-self.size + 6 :]
        output.SetFromVector(force)
""",
}
HEAD = """import dataclasses

import numpy as np
from pydrake.systems.framework import LeafSystem

from ffsm_drake import ControlLaw, gain
from ffsm_drake.spacecraft.plant import configuration

"""
SCENARIO = """
duration: 0.3
controller: lab_blocks:Springs
controllers: {Springs: {k_p: {joints: 30}}}
blocks:
  reference: lab_blocks:Rest
  sensing: {system: "lab_blocks:Vicon", settings: {offset: [1e-5, 0.0, -2e-5]}}
  actuation: lab_blocks:Half
  forces:
    friction: {system: "lab_blocks:Friction", settings: {damping: 3}}
python_path: [modules]
"""


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """A folder with a scenario and, beside it, a module that fills every block."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "lab_blocks.py").write_text(HEAD + "\n".join(LAB.values()))
    (tmp_path / "mine.yaml").write_text(SCENARIO)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    return tmp_path


@pytest.mark.smoke
def test_the_blocks_are_short():
    assert set(LAB) == set(BLOCKS) - {"supervisor"}  # which no key of a scenario replaces
    for text in LAB.values():
        assert len(text.strip().splitlines()) <= 20


def test_every_block_is_replaced_from_yaml(lab):
    record = simulate(load_scenario(lab / "mine.yaml"), check_stability=False)
    data = record.dataset
    assert record.outcome.completed
    assert np.ptp(data["desired_position"].values, axis=0).max() == 0.0
    offset = data["measured_position"].values - data["position"].values
    assert offset[:, 4:7] == pytest.approx(np.tile([1e-5, 0.0, -2e-5], (len(offset), 1)), abs=1e-15)
    assert not offset[:, 7:].any()
    commanded, applied = data["generalized_force"].values, data["applied_force"].values
    assert np.abs(commanded).max() > 0
    assert np.array_equal(applied, 0.5 * commanded)
    k_p = np.r_[np.full(6, 40.0), np.full(5, 30.0)]
    measured = data["desired_position"].values[:, 4:] - data["measured_position"].values[:, 4:]
    spring = (
        k_p[3:] * measured
        + 20 * (data["desired_velocity"] - data["measured_velocity"]).values[:, 3:]
    )
    assert commanded[:, 3:] == pytest.approx(spring, abs=1e-12)
    joints = [name for name in data["coordinate"].values if name.startswith("joint")]
    friction = data["force_friction"].sel(coordinate=joints).values
    assert np.array_equal(friction, -3 * data["velocity"].sel(coordinate=joints).values)
    both = data["force_disturbance"].values + data["force_friction"].values
    assert np.array_equal(data["disturbance_force"].values, both)


@pytest.mark.long
def test_it_repeats_from_its_record_in_another_folder_bit_for_bit(lab):
    done = CliRunner().invoke(
        main, ["run", str(lab / "mine.yaml"), "--out", str(lab / "out/mine"), "--no-report"]
    )
    assert done.exit_code == 0, done.output
    manifest = (lab / "out/mine/manifest.json").read_text()
    assert str(lab) not in manifest
    blocks = json.loads(manifest)["blocks"]
    assert blocks["sensing.own"]["system"] == "lab_blocks:Vicon"
    assert (lab / "out/mine" / blocks["sensing.own"]["file"]).samefile(
        lab / "modules/lab_blocks.py"
    )
    assert blocks["forces.disturbance"] == {"system": "scenario: disturbance"}
    moved = lab / "moved"
    moved.mkdir()
    for name in ("modules", "out"):
        shutil.move(lab / name, moved / name)

    def command(source):
        return ["run", str(moved / source), "--out", str(lab / "again"), "--no-report"]

    # a process of its own: the module is found by what the record says
    again = finished([sys.executable, "-m", "ffsm_drake", *command("out/mine")])
    assert again.returncode == 0, again.stderr
    assert (lab / "again/record.nc").read_bytes() == (moved / "out/mine/record.nc").read_bytes()
    assert "same record, bit for bit" in again.stdout
    del sys.modules["lab_blocks"]
    assert (
        "same record, bit for bit"
        in CliRunner().invoke(main, command("out/mine/manifest.json")).stdout
    )


@pytest.mark.long
def test_it_goes_through_a_campaign(lab):
    (lab / "spec.yaml").write_text(
        """{scenario: mine.yaml, controllers: ["lab_blocks:Springs", tdc], cases: 2,
        settled: {hold: 0.1},
        parameters: {payload.truth.mass: {distribution: uniform, low: 80, high: 120}}}"""
    )
    database = lab / "campaign/spec.db"
    arguments = [
        "campaign",
        "run",
        str(lab / "spec.yaml"),
        "--database",
        str(database),
        "--workers",
        "1",
    ]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0, done.output
    assert "4 of 4 runs" in done.stdout
    # Each run of the table is that of the record.
    rerun = [
        "campaign",
        "rerun",
        str(database),
        "--case",
        "1",
        "--controller",
        "lab_blocks:Springs",
    ]
    again = CliRunner().invoke(main, [*rerun, "--out", str(lab / "rerun"), "--no-recording"])
    assert again.exit_code == 0, again.output
    assert (
        RunRecord.load(lab / "rerun/Springs").scenario.blocks.sensing["own"].system
        == "lab_blocks:Vicon"
    )


def pulse(setup):
    """A constant torque on joint 2."""
    amplitude = np.zeros(len(setup.coordinates.names))
    amplitude[setup.coordinates.names.index("joint_2")] = 0.3
    builder = DiagramBuilder()
    source = builder.AddSystem(ConstantVectorSource(amplitude))
    builder.ExportOutput(source.get_output_port(), "generalized_force")
    return builder.Build()


def test_a_factory_in_python_takes_the_place_of_the_disturbance_or_adds_to_it():
    scenario = load_scenario("postcapture", ["duration=0.1"])
    record = simulate(scenario, blocks={"forces.disturbance": pulse})
    force = record.dataset["disturbance_force"]
    assert (force.sel(coordinate="joint_2") == 0.3).all()
    assert float(abs(force).sum()) == pytest.approx(0.3 * force.sizes["time"])
    assert "force_disturbance" not in record.dataset
    assert record.scenario.blocks.forces["disturbance"].system == f"{__name__}:pulse"
    both = simulate(scenario, blocks={"forces.push": pulse}).dataset
    assert (both["force_push"].sel(coordinate="joint_2") == 0.3).all()
    plain = simulate(scenario, check_stability=False).dataset
    assert np.array_equal(both["force_disturbance"], plain["disturbance_force"])


def test_the_loop_is_added_to_a_diagram_of_the_callers():
    builder = DiagramBuilder()
    loop = add_closed_loop(builder, load_scenario("postcapture"))
    assert isinstance(loop, ClosedLoop)
    builder.ExportOutput(loop.output_port("state"), "spacecraft")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    loop.initialize(diagram, context)
    assert diagram.GetOutputPort("spacecraft").Eval(context)[4:7] == pytest.approx([0.1, 0.3, -0.2])


class Fails(LeafSystem):
    def __init__(self, setup):
        super().__init__()
        self.DeclareVectorOutputPort("generalized_force", len(setup.coordinates.names), self.calc)

    def calc(self, context, output):
        output.SetFromVector(np.full(output.size(), np.nan if context.get_time() > 0.02 else 0.0))


@pytest.mark.smoke
def test_a_failing_block_gets_one_line():
    with pytest.raises(
        BlockError,
        match=r"forces.disturbance 'Fails': its generalized_force is not finite; it must be "
        r"finite; at t = 0.0\d s",
    ):
        simulate(
            load_scenario("postcapture", ["duration=0.1"]), blocks={"forces.disturbance": Fails}
        )


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        (
            "blocks.sensing=nowhere:Vicon",
            "blocks.sensing.own 'nowhere:Vicon' cannot be loaded: run from the folder",
        ),
        ("blocks.sensing=vicon", "blocks.sensing.own: 'vicon' is unknown; give module:attribute"),
        (
            "blocks.sensing=two words",
            "blocks.sensing.own.system: 'two words' must be a name or module:attribute",
        ),
        (
            "blocks.sensing.own.settings={a: 1}",
            "blocks.sensing.own.system: '' must be a name or module:attribute",
        ),
        (
            "blocks.sensing=math:pi",
            "blocks.sensing.own 'math:pi' must be a class or function, not float",
        ),
        ("blocks.sensing=math:tau.x", "math has no 'tau.x'"),
        (
            "blocks.forces.drag=builtins:repr",
            "blocks.forces.drag 'builtins:repr' must be a Drake system, not str",
        ),
        (
            "blocks.forces.my drag=builtins:repr",
            "a force's name must be letters, digits and underscores",
        ),
        (
            "blocks.sensor=x:y",
            "blocks.sensor: unknown key; valid here: reference, sensing, actuation, forces",
        ),
        (
            "blocks.sensing={system: 'a:b', settings: [1]}",
            "blocks.sensing.own.settings: must be a mapping, not [1]",
        ),
        (
            "blocks.sensing={system: 'a:b', settings: {x: .nan}}",
            "blocks.sensing.own.settings.x: must be finite",
        ),
    ],
)
def test_bad_ones_get_one_line(override, expected):
    with pytest.raises((ScenarioError, BlockError)) as caught:
        simulate(load_scenario("postcapture", [override]))
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


class WithPorts(LeafSystem):
    """A system with ports as given."""

    def __init__(self, *, inputs=(), outputs=()):
        super().__init__()
        for name, size in inputs:
            self.DeclareVectorInputPort(name, size)
        for name, size in outputs:
            self.DeclareVectorOutputPort(name, size, lambda context, output: None)


@pytest.mark.parametrize(
    ("block", "ports", "expected"),
    [
        ("sensing", {"inputs": [("state", 22)]}, "input port 'state' must have size 23, not 22"),
        (
            "sensing",
            {"inputs": [("state", 23)]},
            "needs an output port 'estimated_state' of size 23",
        ),
        (
            "sensing",
            {"inputs": [("stat", 23)]},
            "unknown input port 'stat'; known: state, true_state, measurement_is_new and 5 "
            "more; did you mean 'state'?",
        ),
        (
            "actuation",
            {"inputs": [("commanded_force", 11)]},
            "needs an output port 'applied_force' of size 11",
        ),
        (
            "reference",
            {"outputs": [("desired_state", 23)]},
            "needs an output port 'desired_acceleration' of size 11",
        ),
        ("forces.wind", {"outputs": [("generalized_force", 6)]}, "must have size 11, not 6"),
    ],
)
def test_the_kit_checks_ports_by_the_table(block, ports, expected):
    with pytest.raises(ConformanceError) as caught:
        check_block(block, lambda setup: WithPorts(**ports))
    assert expected in str(caught.value)


def test_the_kit_passes_good_blocks_and_finds_hidden_memory(lab):
    sys.path.insert(0, str(lab / "modules"))
    try:
        import lab_blocks

        assert "finite signals" in str(
            check_block("sensing", lab_blocks.Vicon, settings={"offset": 0.0})
        )
        check_block("forces.friction", lab_blocks.Friction)
        check_block("actuation", lab_blocks.Half)
        check_block("reference", lab_blocks.Rest)
    finally:
        sys.path.remove(str(lab / "modules"))

    class Counts(LeafSystem):
        def __init__(self, setup):
            super().__init__()
            self.calls = 0
            self.DeclareVectorOutputPort(
                "generalized_force", len(setup.coordinates.names), self.calc
            )

        def calc(self, context, output):
            self.calls += 1
            output.SetFromVector(np.full(output.size(), 1e-6 * self.calls))

    with pytest.raises(
        ConformanceError, match="a second run differs from the first: keep memory in the context"
    ):
        check_block("forces.counts", Counts)


@pytest.mark.smoke
def test_an_unknown_block_is_refused():
    from ffsm_drake import make_nominal_plant

    scenario = load_scenario("postcapture")
    with pytest.raises(
        ScenarioError,
        match=r"blocks.sensors: is not a block; choose reference, "
        r"sensing, controller, ",
    ):
        make_blocks(make_mission(scenario), make_nominal_plant(scenario), {"sensors": pulse})


class Shift(LeafSystem):
    """A stage of sensing that adds to the base's position along x, m."""

    def __init__(self, setup, *, true=False):
        super().__init__()
        size = 2 * len(setup.coordinates.names) + 1
        names = ["state", *(["true_state"] if true else [])]
        self.inputs = [self.DeclareVectorInputPort(name, size) for name in names]
        self.offset = setup.settings.get("offset", 0.5)
        self.DeclareVectorOutputPort("estimated_state", size, self.calc)

    def calc(self, context, output):
        values = self.inputs[-1].Eval(context).copy()
        values[4] += self.offset
        output.SetFromVector(values)


class TrueShift(Shift):
    """The same of the true state."""

    def __init__(self, setup):
        super().__init__(setup, true=True)


def measured(overrides=(), blocks=None):
    scenario = load_scenario("flight_sensors", ["controller=tdc", "duration=0.05", *overrides])
    data = simulate(scenario, blocks=blocks, check_stability=False).dataset
    return (
        (data["measured_position"] - data["position"]).sel(position_name="base_position_x").values
    )


def test_a_sensor_of_ones_own_stands_after_the_shipped_ones_whose_noise_stays():
    noise = measured()
    assert noise.std() > 1e-4
    # The state differs as soon as the controller has read another one.
    assert measured(blocks={"sensing.shift": Shift})[0] == pytest.approx(0.5 + noise[0])
    both = measured(blocks={"sensing.shift": Shift, "sensing.again": Shift})
    assert both[0] == pytest.approx(1.0 + noise[0])


def test_a_stage_may_see_the_true_state_or_replace_the_section():
    assert measured(blocks={"sensing.shift": TrueShift})[0] == pytest.approx(0.5, abs=1e-15)
    assert measured(blocks={"sensing": Shift})[0] == pytest.approx(0.5, abs=1e-15)


def test_stages_of_a_file_go_by_name_in_their_order_and_a_run_is_repeated():
    scenario = load_scenario("flight_sensors", ["controller=tdc", "duration=0.05"])
    record = simulate(scenario, blocks={"sensing.a": Shift, "sensing.b": TrueShift})
    assert list(record.scenario.blocks.sensing) == ["a", "b"]
    assert record.blocks["sensing.b"]["system"].endswith(":TrueShift")
    alone = load_scenario("postcapture", ["blocks.sensing=lab:Vicon"]).blocks.sensing
    assert alone["own"].system == "lab:Vicon"
    with pytest.raises(ScenarioError, match="a stage's name must be"):
        load_scenario("postcapture", ["blocks.sensing={a b: lab:Vicon}"])
