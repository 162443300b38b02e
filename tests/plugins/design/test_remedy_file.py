"""What helps as a file: ``remedy.yaml`` beside a run extends it, runs, and helps."""

import re
import shlex

import pytest
from click.testing import CliRunner

from ffsm_drake import RunRecord, load_scenario, simulate
from ffsm_drake.cli import main
from ffsm_drake.plugins.design.remedy_file import REMEDY_FILE, write_remedied, write_remedy
from ffsm_drake.scenario import differing_keys, override_scenario
from ffsm_drake.systems.parts.advice import Advice


def ffsm(line):
    found = CliRunner().invoke(main, shlex.split(line))
    return found.exit_code, found.stderr


@pytest.mark.long
def test_a_failed_run_leaves_a_scenario_that_settles(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, said = ffsm("run --set payload.nominal.mass=130 --out out/heavy --no-report")
    assert code == 3
    told = re.search(r"a changed scenario is in \S+; run it with: ffsm (run (\S+))", said)
    assert told[2] == f"out/heavy/{REMEDY_FILE}"
    assert ffsm(f"{told[1]} --require settled --no-report")[0] == 0
    before, after = (load_scenario(each) for each in ("out/heavy", "out/remedy"))
    assert differing_keys(before, after) == ["payload.nominal.mass"]
    assert ffsm("run --out out/heavy --no-report --set duration=0.1")[0] == 0
    assert not (tmp_path / "out" / "heavy" / REMEDY_FILE).exists()


@pytest.mark.long
@pytest.mark.parametrize("place", ["", "tde_aismc"])
def test_the_page_names_the_file(place, tmp_path, monkeypatch):
    from ffsm_drake.plugins.report import write_report

    monkeypatch.chdir(tmp_path)
    heavy = load_scenario("postcapture", ["payload.nominal.mass=130", "duration=1"])
    record = simulate(heavy, check_stability=False)
    record.save(tmp_path / place)
    write_report([record], tmp_path / "report.html")
    head = (tmp_path / "report.html").read_text().partition('id="results"')[0]
    assert f"ffsm run {tmp_path / place / REMEDY_FILE}" in head
    text = (tmp_path / place / REMEDY_FILE).read_text()
    assert text.startswith("# Applied: a lighter nominal payload")
    assert "\n# In place of it: a smaller K_s." in text


def test_no_file_without_the_run_in_the_folder(tmp_path):
    heavy = load_scenario("postcapture", ["payload.nominal.mass=130", "duration=0.5"])
    record = simulate(heavy, check_stability=False)
    assert write_remedy(record, tmp_path) is None
    simulate(load_scenario("postcapture", ["duration=0.1"])).save(tmp_path)
    assert write_remedy(record, tmp_path) is None
    assert not (tmp_path / REMEDY_FILE).exists()


@pytest.mark.smoke
def test_a_run_that_settles_leaves_none(tmp_path):
    simulate(load_scenario("postcapture", ["duration=0.1"])).save(tmp_path)
    assert write_remedy(RunRecord.load(tmp_path), tmp_path) is None


LIGHTER = Advice(changes={"payload.nominal.mass": 70.0}, reason="a lighter nominal payload")
KNOWN = Advice(changes={"estimator.delay": None, "sensing.delay": 2}, reason="less: delay")
SLOWER = Advice(changes={"reference.duration": 30.0, "duration": 35.0}, reason="longer")
SOFTER = Advice(changes={"controllers.tde_aismc.k_d": {"all": 9.0, "joint_2": 7.0}}, reason="soft")
OTHER = Advice(changes={"controller": "tdc"}, reason="or this law, without an integral")


@pytest.mark.parametrize(
    ("together", "alone", "applied"),
    [
        ((), (LIGHTER, KNOWN), [LIGHTER]),
        ((), (KNOWN,), [KNOWN]),
        ((SLOWER, SOFTER, OTHER), (), [SLOWER, SOFTER]),
        ((OTHER,), (), [OTHER]),
        ((SLOWER,), (LIGHTER,), [LIGHTER]),
    ],
)
def test_changes_that_help_together_are_applied_together(together, alone, applied, tmp_path):
    scenario = load_scenario("flight_sensors", ["controller=tde_aismc"])
    file = write_remedied(scenario, together, alone, tmp_path)
    expected = override_scenario(scenario, [each.changes for each in applied])
    assert differing_keys(load_scenario(file), expected) == []
    commented = [line for line in file.read_text().splitlines() if line.startswith("# In place")]
    assert len(commented) == len(together) + len(alone) - len(applied)


@pytest.mark.long
def test_saturated_wheels_settle_by_the_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    asked = "run thrusters_and_wheels --set reference.duration=9 --out out/fast --no-report"
    code, said = ffsm(f"{asked} --require settled")
    assert code == 3
    assert re.search(r"wheels in [\d.]+ %", said), said
    assert ffsm(f"run out/fast/{REMEDY_FILE} --require settled --no-report")[0] == 0
