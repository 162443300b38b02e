"""Laws that are called at each sample of a compiled run, because they cannot be traced."""

import dataclasses
import signal
import sys
import time
from typing import ClassVar

import numpy as np
import pytest
from click.testing import CliRunner
from compared_runs import check, of_seeds
from test_scenarios import captures, flexible_parts, late_sensors, undriven_bases

from ffsm_drake import ControlLaw, RunRecord, gain, simulate_many
from ffsm_drake.cli import main
from ffsm_drake.common.errors import BlockError
from ffsm_drake.common.time_limit import TimeLimit, time_limit
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.compiled.sample import TracedSample
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.spacecraft.nominal import PlantModel

CALLS, HEAVY = [], 600.0  # kg


@dataclasses.dataclass(frozen=True, kw_only=True)
class Switched(ControlLaw):
    """PD control with a branch for each coordinate."""

    k_p: np.ndarray = gain(20.0)
    k_d: np.ndarray = gain(60.0)
    model: PlantModel

    def initial_state(self):
        return {"sliding_variable": np.zeros(len(self.k_p)), "samples": np.zeros(1)}

    def step(self, sample, state):
        force = self.k_p * sample.e + self.k_d * sample.e_dot
        for i in range(force.size):
            if state["sliding_variable"][i] * sample.e_dot[i] > 0.0:
                force[i] *= 1.5
        return force, {"sliding_variable": sample.e_dot, "samples": state["samples"] + 1.0}


class Fails(Switched):
    """It refuses a heavy payload after some samples."""

    def step(self, sample, state):
        if self.model.plant.CalcTotalMass(self.model.context) > HEAVY and state["samples"] > 3.0:
            raise ValueError("too heavy")
        return super().step(sample, state)


class Interrupts(Switched):
    last: ClassVar = 20  # call

    def step(self, sample, state):
        CALLS.append(sample)
        if len(CALLS) == self.last:
            signal.raise_signal(signal.SIGINT)
        return super().step(sample, state)


class Sleeps(Switched):
    def step(self, sample, state):
        CALLS.append(sample)
        time.sleep(0.003)
        return super().step(sample, state)


class Exits(Switched):
    def step(self, sample, state):
        sys.exit("enough" if state["samples"] > 3.0 else 0)


def runs_of(law, monkeypatch, name="postcapture", given=(), each=3 * ([],)):
    monkeypatch.setitem(sys.modules, "called_laws", sys.modules[__name__])
    CALLS.clear()
    words = [f"controller=called_laws:{law.__name__}", "duration=0.2", *given]
    return of_seeds(name, words, each)


def test_a_law_with_branches_has_the_runs_of_drake(monkeypatch):
    scenarios = runs_of(Switched, monkeypatch)
    found = check(scenarios, called=True)
    assert " test_called_laws.py:" in found[0].engine
    with pytest.raises(NotCovered, match=r"test_called_laws\.py:"):
        TracedSample(*[make_mission(scenarios[0])] * 2)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["mpc", "nmpc"])
@pytest.mark.parametrize(
    ("name", "limit"),
    [("postcapture", "{joints: 0.02}"), ("flight_sensors", "{base_position: 0.5}"), ("paper", "")],
)
def test_laws_that_solve_programs_have_the_runs_of_drake(name, law, limit):
    given = [f"controller={law}", "duration=0.3", *([f"actuation.limit={limit}"] if limit else [])]
    check(of_seeds(name, given, 3 * [[]]), called=True)


@pytest.mark.slow
@pytest.mark.parametrize("draw", [late_sensors, flexible_parts, captures, undriven_bases])
def test_drawn_scenarios_have_the_runs_of_drake(draw, monkeypatch):
    check(runs_of(Switched, monkeypatch, *draw(np.random.default_rng(0))), called=True)


def test_a_law_that_fails_in_one_run_leaves_the_others(monkeypatch):
    each = [[f"payload.nominal.mass={mass}"] for mass in (50, 300, 60)]
    scenarios = runs_of(Fails, monkeypatch, each=each)
    one, failed, other = simulate_many(scenarios, engine="compiled", keep_errors=True)
    assert one.engine == other.engine
    assert one.engine.startswith("compiled (law called: ")
    (expected,) = simulate_many(scenarios[1:2], keep_errors=True)
    assert isinstance(failed, BlockError)
    assert "too heavy" in str(failed)
    assert str(failed) == str(expected)


@pytest.mark.parametrize(
    ("engine", "last"),
    [("compiled", 20), pytest.param("compiled", 80, id="comparison with Drake"), ("drake", 20)],
)
def test_an_interrupt_ends_all_runs_at_once(engine, last, monkeypatch):
    """The three compiled runs call the law 63 times."""
    monkeypatch.setattr(Interrupts, "last", last)
    with pytest.raises(KeyboardInterrupt):
        simulate_many(runs_of(Interrupts, monkeypatch), engine=engine)
    assert len(CALLS) == last


@pytest.mark.slow
def test_a_time_limit_ends_them_too(monkeypatch):
    scenarios = runs_of(Sleeps, monkeypatch, given=["duration=60", "reference.duration=20"])
    simulate_many(runs_of(Sleeps, monkeypatch, each=[[]]), engine="compiled")  # code and judge
    with pytest.raises(TimeLimit), time_limit(0.5):
        simulate_many(scenarios, engine="compiled")
    assert len(CALLS) < 1000


@pytest.mark.slow
def test_an_exit_of_a_law_is_an_error_of_its_run(monkeypatch):
    for error in simulate_many(runs_of(Exits, monkeypatch), engine="compiled", keep_errors=True):
        assert isinstance(error, BlockError)
        assert "SystemExit" in str(error)


@pytest.mark.slow
def test_a_record_is_repeated_to_the_bit(tmp_path):
    words = ["--no-report", "--out", str(tmp_path / "run"), "--engine", "compiled", "--set"]
    words += ["tolerance={joints: 1}", "--set", "duration=0.1", "--controller", "mpc"]
    assert CliRunner().invoke(main, ["run", *words]).exit_code == 0
    again = ["--no-report", "--out", str(tmp_path / "again")]
    result = CliRunner().invoke(main, ["run", str(tmp_path / "run"), *again])
    assert "same record, bit for bit" in result.output
    engines = {RunRecord.load(tmp_path / name).engine for name in ("run", "again")}
    (engine,) = engines
    assert engine.startswith("compiled (law called: mpc.py:")


@pytest.mark.slow
def test_a_class_with_the_name_of_another_has_code_of_its_own(monkeypatch):
    """As of a notebook's cell that runs again."""

    def law(factor):
        class Again(Switched):
            def step(self, sample, state):
                return factor * self.k_d * sample.e_dot, state

        return dataclasses.dataclass(frozen=True, kw_only=True)(Again)

    for factor in (1.0, -1.0):
        made = law(factor)
        monkeypatch.setattr(sys.modules[__name__], "Again", made, raising=False)
        check(runs_of(made, monkeypatch, each=[[], []]))
