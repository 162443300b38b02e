"""A user's part has the rights of ours: one file, seen by every command, record, page and table."""

import dataclasses
import json
import shlex
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from entry_points import needs
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import PassThrough

import ffsm_drake
from ffsm_drake import (
    BlockError,
    Metric,
    Part,
    RunRecord,
    ScenarioError,
    Signal,
    load_scenario,
    setting,
    simulate,
)
from ffsm_drake.cli import main
from ffsm_drake.common.numbers import NONE
from ffsm_drake.runs.metrics import momentum_residual
from ffsm_drake.runs.rollout import Rollout, user_supplied
from ffsm_drake.show.outputs import REPORTS
from ffsm_drake.show.results import results_of
from ffsm_drake.show.tables import results_table
from ffsm_drake.spacecraft.limits import Limit
from ffsm_drake.systems.parts.metrics import by_key
from ffsm_drake.systems.parts.signals import Constant
from ffsm_drake.systems.registry import FACTORIES

EXAMPLES = Path(__file__).parents[2] / "examples"
BLOCK = 'blocks.actuation={system: "own_actuator:Magnetorquers", settings: {largest_dipole: 80}}'
SCENARIO = ("flight_sensors", ["controller=tdc", "duration=0.5"])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A user's folder with the example's file, from which ``ffsm`` is called."""
    (tmp_path / "own_actuator.py").write_text((EXAMPLES / "own_actuator.py").read_text())
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def ffsm(command, code=0):
    result = CliRunner().invoke(main, shlex.split(command), catch_exceptions=False)
    assert result.exit_code == code, result.output
    return result.output


@pytest.mark.slow
@needs("report")
@pytest.mark.usefixtures("rough_pictures")
def test_a_run_holds_its_signals_and_figures(folder):
    shown = ffsm(f"run flight_sensors -c tdc --set duration=0.5 --set '{BLOCK}' --out out")
    assert "Magnetorquers: largest dipole 80.00 A m^2" in shown
    record = RunRecord.load("out")
    dipole = record.dataset["dipole"]
    assert dipole.dims == ("time", "axis")
    assert dipole.attrs["units"] == "A m^2"
    figures = json.loads((folder / "out/metrics.json").read_text())["magnetorquers"]
    assert figures["largest_dipole"] == pytest.approx(np.abs(dipole.values).max())
    assert record.metrics["magnetorquers"] == figures
    page = (folder / "out/report.html").read_text()
    assert "Magnetorquers: magnetic torque" in page
    assert "Largest dipole" in page


def test_its_torque_is_across_the_field_and_within_its_limit(folder):
    import own_actuator

    part = own_actuator.Magnetorquers(largest_dipole=30.0)
    record = simulate(load_scenario(*SCENARIO), blocks={"actuation": part}, check_stability=False)
    torque = record.dataset["magnetic_torque"].values
    assert np.abs(record.dataset["dipole"].values).max() == pytest.approx(30.0)
    assert torque @ np.array(part.field) == pytest.approx(np.zeros(len(torque)), abs=1e-18)
    again = simulate(record.scenario, check_stability=False)  # by its address and settings
    assert again.dataset["dipole"].equals(record.dataset["dipole"])
    assert again.figures == record.figures


@pytest.mark.long
@pytest.mark.usefixtures("folder", "rough_pictures")
def test_it_goes_through_compare_stability_and_validate():
    common = f"flight_sensors --set duration=0.3 --set '{BLOCK}'"
    shown = ffsm(f"compare {common} -c tdc -c asmc --out both")
    assert shown.count("Magnetorquers: largest dipole") == 2
    linear, without = (
        ffsm_drake.stability(load_scenario(SCENARIO[0], [*SCENARIO[1], *more])).loops[0]
        for more in ([BLOCK], [])
    )
    assert linear.spectral_radius == pytest.approx(without.spectral_radius, abs=1e-6)


@pytest.mark.long
@needs("campaign")
def test_a_campaign_has_its_columns(folder):
    (folder / "spec.yaml").write_text(
        """{scenario: flight_sensors, controllers: [tdc], cases: 1,
        overrides: {duration: 0.2, blocks.actuation: {system: "own_actuator:Magnetorquers"}},
        parameters: {payload.truth.mass: {distribution: uniform, low: 80, high: 120}}}"""
    )
    ffsm("campaign run spec.yaml --database c.db --workers 1")
    with sqlite3.connect("c.db") as connection:
        rows = connection.execute("SELECT magnetorquers_largest_dipole FROM runs").fetchall()
    assert len(rows) == 1
    assert rows[0][0] > 0.0


@pytest.mark.slow
@pytest.mark.usefixtures("folder", "rough_pictures")
def test_a_line_of_the_registry_makes_it_a_shipped_one(monkeypatch):
    """Named alone, it is checked, linearised and warned of as the package's own."""
    core = FACTORIES["actuation"].core
    monkeypatch.setitem(core, "magnetorquers", "own_actuator:Magnetorquers")
    assert not user_supplied(load_scenario(*SCENARIO))
    common = "flight_sensors --set duration=0.3 --set blocks.actuation="
    assert "Magnetorquers: largest dipole" in ffsm(f"run {common}magnetorquers -c tdc --out out")
    assert not user_supplied(RunRecord.load(Path("out")).scenario)
    assert "stable" in ffsm(f"stability {common}magnetorquers -c tdc")
    unknown = ffsm(f"run {common}magnetorquer -c tdc", code=2)
    assert "give module:attribute, or choose one of magnetorquers" in unknown
    monkeypatch.delitem(core, "magnetorquers")
    own = load_scenario("flight_sensors", ["blocks.actuation=own_actuator:Magnetorquers"])
    assert user_supplied(own) == {"actuation": "blocks.actuation 'own_actuator:Magnetorquers'"}


class Through(LeafSystem):
    """What is commanded acts; with output ports of given sizes."""

    def __init__(self, nv, **sizes):
        super().__init__()
        commanded = self.DeclareVectorInputPort("commanded_force", nv)
        ready = {self.input_port_ticket(commanded.get_index())}
        self.DeclareVectorOutputPort("applied_force", nv, self._pass, ready)
        for name, size in sizes.items():
            self.DeclareVectorOutputPort(name, size, self._ones, {self.nothing_ticket()})

    def _pass(self, context, output):
        output.SetFromVector(self.get_input_port().Eval(context))

    def _ones(self, context, output):
        output.SetFromVector(np.ones(output.size()))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Faulty(Part):
    """A part that says of itself what is given here."""

    said: tuple = ()
    ports: tuple = ()
    figures: tuple = ()
    amount: float = setting(1.0, "kg", "of it", above=0)

    def build(self, setup):
        return Through(len(setup.coordinates.names), **dict(self.ports))

    def signals(self, setup):
        return self.said

    def metrics(self):
        return self.figures


def signal(name, **rest):
    return Signal(name=name, unit="1", meaning="of a test", **rest)


def metric(of, key="test.figure", **rest):
    return Metric(**{"key": key, "unit": "1", "label": "A figure", "of": of} | rest)


@pytest.mark.parametrize(
    ("part", "words"),
    [
        (Faulty(said=(signal("here"),)), "signal 'here' needs an output port of that name"),
        (
            Faulty(said=(signal("here", components=("a", "b")),), ports=(("here", 3),)),
            "output port 'here' must have size 2, as its signal has components, not 3",
        ),
        (Faulty(said=(signal("two words"),)), "must be an identifier, not 'two words'"),
        (Faulty(said=(signal("state"),), ports=(("state", 1),)), "has the name of another"),
        (Faulty(said=(signal("error", of=lambda run: run.time),)), "has the name of another"),
        (Faulty(figures=(metric(lambda run: 1 / 0),)), "metric 'test.figure' failed: ZeroDiv"),
        (Faulty(figures=(metric(lambda run: run["nothing"]),)), "no signal 'nothing'; there are:"),
        (Faulty(figures=(metric(lambda run: "much"),)), "metric 'test.figure' failed: ValueError"),
        (Faulty(figures=(metric(lambda run: {"a": 1.0}),)), "by name, which no column holds: say"),
        (Faulty(said=(signal("here", role="any"),), ports=(("here", 1),)), "role must be one of"),
        (Faulty(said=(signal("here", chart="pie"),), ports=(("here", 1),)), "chart one of linear"),
        (
            Faulty(said=(signal("here", role="stored_momentum"),), ports=(("here", 1),)),
            "signal 'here' must have 3 components for its role",
        ),
        (Faulty(amount=-1.0), "must be > 0 kg, not -1"),
    ],
)
def test_a_part_that_contradicts_itself_is_told_so(part, words):
    with pytest.raises((BlockError, ScenarioError)) as raised:
        simulate(load_scenario(*SCENARIO), blocks={"actuation": part}, check_stability=False)
    assert words in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.slow
def test_signals_that_are_computed_and_figures_that_are_no_numbers(tmp_path):
    part = Faulty(
        said=(signal("twice", of=lambda run: 2.0 * run["here"]), signal("here")),
        ports=(("here", 1),),
        figures=(metric(lambda run: float("nan")),),
    )
    record = simulate(load_scenario(*SCENARIO), blocks={"actuation": part}, check_stability=False)
    assert (record.dataset["twice"].values == 2.0).all()
    assert record.figures[0].value is None
    record.save(tmp_path / "run")
    loaded = RunRecord.load(tmp_path / "run")
    assert loaded.figures == record.figures
    page = REPORTS.only("the test")([loaded], tmp_path / "report.html")
    assert page.stat().st_size > 0


class Drag(LeafSystem):
    """A force against the base's velocity, and how much it is."""

    def __init__(self, nv, coefficient):
        super().__init__()
        self._state = self.DeclareVectorInputPort("state", 2 * nv + 1)
        self._nv, self._coefficient = nv, coefficient
        self.DeclareVectorOutputPort("generalized_force", nv, self._force)
        self.DeclareVectorOutputPort("drag", 3, self._drag)

    def _drag(self, context, output):
        velocity = self._state.Eval(context)[-self._nv :][3:6]
        output.SetFromVector(-self._coefficient * velocity)

    def _force(self, context, output):
        force = np.zeros(self._nv)
        force[3:6] = self.GetOutputPort("drag").Eval(context)
        output.SetFromVector(force)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Atmosphere(Part):
    """A force as a part."""

    title = "Drag"
    coefficient: float = setting(2.0, "N s/m", "force per velocity", least=0)

    def build(self, setup):
        return Drag(len(setup.coordinates.names), self.coefficient)

    def signals(self, setup):
        axes = {"components": ("x", "y", "z"), "dimension": "axis", "held": False}
        return (Signal(name="drag", unit="N", meaning="force against the velocity", **axes),)

    def metrics(self):
        def largest(run):
            return np.linalg.norm(run["drag"], axis=1).max()

        return (Metric(key="drag.largest", unit="N", label="Largest drag", of=largest),)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tracker(Part):
    """A stage of sensing as a part: it shows what it reads."""

    def build(self, setup):
        return Stage(2 * len(setup.coordinates.names) + 1)

    def signals(self, setup):
        return (Signal(name="seen", unit="1", meaning="scalar of the quaternion", held=False),)


class Stage(LeafSystem):
    def __init__(self, size):
        super().__init__()
        self._state = self.DeclareVectorInputPort("state", size)
        self.DeclareVectorOutputPort("estimated_state", size, self._pass)
        self.DeclareVectorOutputPort("seen", 1, self._see)

    def _pass(self, context, output):
        output.SetFromVector(self._state.Eval(context))

    def _see(self, context, output):
        output.SetFromVector(self._state.Eval(context)[:1])


def test_forces_and_sensors_are_parts_too():
    blocks = {"forces.drag": Atmosphere(coefficient=3.0), "sensing.tracker": Tracker()}
    record = simulate(load_scenario(*SCENARIO), blocks=blocks, check_stability=False)
    data = record.dataset
    velocity = data["velocity"].sel(coordinate=[f"base_position_{axis}" for axis in "xyz"]).values
    assert data["drag"].values == pytest.approx(-3.0 * velocity, abs=1e-15)
    assert data["force_drag"].values[:, 3:6] == pytest.approx(data["drag"].values, abs=1e-15)
    assert record.metrics["drag"]["largest"] == pytest.approx(
        3.0 * np.linalg.norm(velocity, axis=1).max()
    )
    assert data["seen"].values == pytest.approx(data["measured_position"].values[:, 0], abs=1e-15)
    assert [figure.part for figure in record.figures] == ["Drag"]


class Telling(Faulty):
    """A part that uses all that a part can say of itself."""

    title = "Heaters"
    section = "Motion & heat"
    about = ""

    def signals(self, setup):
        of_each = {"components": ("left", "right"), "dimension": "heater"}
        return (
            signal("on", heading="Switched on", chart="timeline", panel="Heaters", **of_each),
            signal("turning", components=("x", "y", "z"), role="stored_momentum", heading=""),
            signal("twist", components=("x", "y", "z"), role="internal_torque", heading=""),
            signal("none", of=lambda run: None),
        )

    def constants(self, setup):
        values = (10.0, 20.0)
        return [
            Constant(name="power", unit="W", meaning="of each", dimension="heater", values=values)
        ]

    def metrics(self):
        return (
            metric(lambda run: {"left": 1.0, "right": float("inf")}, "heaters.heat", column=""),
            metric(
                lambda run: 0.25,
                "heaters.energy",
                unit="kJ",
                shown="J",
                factor=1e3,
                ranked=True,
                label="Energy",
            ),
            metric(lambda run: 0.5, "heaters.used", shown="%", heading="share of time"),
            metric(lambda run: 3, "", column="switched", label="Switchings"),
        )

    def table(self, figures):
        return [("heater", "heat [J]"), *by_key(figures)["heaters.heat"].items()]


def test_all_that_a_part_can_say_of_itself(tmp_path):
    part = Telling(ports=(("on", 2), ("turning", 3), ("twist", 3)))
    scenario = load_scenario(*SCENARIO)
    record = simulate(scenario, blocks={"actuation": part}, check_stability=False)
    without = simulate(scenario, check_stability=False)
    data = record.dataset
    assert data["on"].dims == ("time", "heater")
    assert data["power"].sel(heater="right") == 20.0
    assert "none" not in data
    # what a part stores counts, and the torque that it gives from within is none from outside
    stored = data["angular_momentum"].values - without.dataset["angular_momentum"].values
    assert stored == pytest.approx(np.ones_like(stored), abs=1e-9)
    missed = momentum_residual(data)["angular"]
    expected = data["time"].values[:, None] * np.ones(3)
    assert missed == pytest.approx(expected, abs=1e-6)
    assert record.metrics["heaters"] == {"heat": {"left": 1.0, "right": None}, "energy": 0.25} | {
        "used": 0.5
    }
    assert [figure.column_name for figure in record.figures] == [
        "",
        "heaters_energy",
        "heaters_used",
        "switched",
    ]
    assert [figure.column_heading for figure in record.figures[1:]] == [
        "energy [kJ]",
        "share of time",
        "switchings",
    ]
    loaded = RunRecord.load(record.save(tmp_path / "run"))
    assert loaded.figures == record.figures
    assert loaded.parts[0].drawings == record.parts[0].drawings
    shown = results_table([loaded])
    assert shown.splitlines()[0].endswith("energy")
    listed = f"a figure left 1.000, a figure right {NONE}, energy 250.0 J, a figure 50.0 %"
    assert f"Heaters: {listed}, switchings 3" in shown
    results = results_of([loaded, without])
    comparison = pytest.importorskip("ffsm_drake.plugins.report.comparison")
    rows = [
        (row.head, row.label, *(cell.text for cell in row.cells), row.unit)
        for row in comparison.table(results)
    ]
    at = rows.index(("A figure", "left", "1.000", NONE, ""))
    assert rows[at : at + 5] == [
        ("A figure", "left", "1.000", NONE, ""),
        ("", "right", NONE, NONE, ""),
        ("Heaters", "Energy", "250.0", NONE, "J"),
        ("", "A figure", "50.0 %", NONE, ""),
        ("", "Switchings", "3", NONE, ""),
    ]
    assert comparison.rankings(results)[-1]["title"] == "By energy (J)"
    panels = pytest.importorskip("ffsm_drake.plugins.report.part_panels")
    (view,) = panels.part_views(results, "Motion & heat")
    assert view.label == "Switched on"
    assert [trace.name for trace in view.charts[0].curves] == [
        "TDC, run 1, left",
        "TDC, run 1, right",
    ]
    page = REPORTS.only("the test")([loaded], tmp_path / "report.html").read_text()
    for text in (
        ">Motion &amp; heat<",
        "By heater",
        "Base attitude",
        '<td class="text">left</td><td>1.000</td>',
    ):
        assert text in page


PLAIN = """import dataclasses
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import PassThrough
from ffsm_drake import Part

class Plain(Part):
    def build(self, setup):
        builder = DiagramBuilder()
        stage = builder.AddSystem(PassThrough(2 * len(setup.coordinates.names) + 1))
        builder.ExportInput(stage.get_input_port(), "state")
        builder.ExportOutput(stage.get_output_port(), "estimated_state")
        return builder.Build()

class Forgetful(Part):
    pass

@dataclasses.dataclass(frozen=True, kw_only=True)
class Wanting(Part):
    needed: float

@dataclasses.dataclass(frozen=True, kw_only=True)
class Raising(Part):
    def check(self, key, scenario):
        raise OSError("no table")
"""


@pytest.mark.parametrize(
    ("block", "words"),
    [
        ("plain:Forgetful", "NotImplementedError: Forgetful needs a method build(setup)"),
        ("plain:Wanting", "'Wanting' cannot be built: TypeError: "),
        ("plain:Raising", "'Raising' cannot be built: OSError: no table"),
        ("{system: 'plain:Plain', settings: {a: 1}}", "settings.a: unknown key; valid here: none"),
    ],
)
def test_parts_without_settings_work_and_unsound_ones_get_one_line(block, words, tmp_path):
    (tmp_path / "plain.py").write_text(PLAIN)
    common = [*SCENARIO[1], f"python_path=['{tmp_path}']"]
    good = load_scenario(SCENARIO[0], [*common, "blocks.sensing='plain:Plain'"])
    assert simulate(good, check_stability=False).outcome.completed
    with pytest.raises((BlockError, ScenarioError)) as raised:
        simulate(load_scenario(SCENARIO[0], [*common, f"blocks.sensing={block}"]))
    assert words in str(raised.value)
    assert "\n" not in str(raised.value)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bounded(Part):
    """Passes the force on; its signal is the time, which has a limit."""

    def build(self, setup):
        builder = DiagramBuilder()
        passed = builder.AddSystem(PassThrough(len(setup.coordinates.names)))
        builder.ExportInput(passed.get_input_port(), "commanded_force")
        builder.ExportOutput(passed.get_output_port(), "applied_force")
        return builder.Build()

    def signals(self, setup):
        return [Signal(name="ramp", unit="1", meaning="time", of=lambda run: run.time)]

    def limits(self, coordinates):
        return [
            Limit(
                quantity="ramp", source="Bounded", names=("ramp",), units=("1",),
                upper=np.array([0.1]), lower=np.array([-np.inf]),
            )
        ]  # fmt: skip


def test_a_run_knows_when_it_exceeds_the_limit_of_a_part():
    scenario = load_scenario("flight_sensors", ["controller=tdc", "duration=0.3"])
    limits_left = pytest.importorskip("ffsm_drake.plugins.design.limits_left").limits_left
    left = limits_left(Rollout(scenario, blocks={"actuation": Bounded()}).run())
    assert left == {"ramp of ramp": pytest.approx(0.1 + scenario.sample_time)}


@pytest.mark.long
def test_coils_beside_wheels_take_momentum_out(monkeypatch):
    """One file: no other one knows of them. The balance of momentum counts their impulse."""
    monkeypatch.syspath_prepend(EXAMPLES)
    from own_torquers import Coils

    scenario = load_scenario("thrusters_and_wheels", ["controller=tdc", "duration=15"])
    alone = simulate(scenario).dataset
    record = simulate(scenario, blocks={"forces.coils": Coils(largest_dipole=4000.0)})
    impulse = record.dataset["coil_force"].values[:-1, :3].sum(axis=0) * scenario.sample_time
    change = (record.dataset["stored_momentum"] - alone["stored_momentum"]).values[-1]
    assert np.linalg.norm(impulse) > 0.5
    np.testing.assert_allclose(change, impulse, atol=0.02 * np.linalg.norm(impulse))
    field = np.array(Coils().field)  # along it they give no torque
    across = [np.cross(of["stored_momentum"].values[-1], field) for of in (record.dataset, alone)]
    assert np.linalg.norm(across[0]) < 0.8 * np.linalg.norm(across[1])
    assert record.metrics["momentum_residual"]["angular"] < 1e-7
