"""The benchmark of verdicts: its missions can be repeated, and it tells how a run ends."""

import json
import shlex
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ffsm_drake import load_scenario
from ffsm_drake.runs.record import Outcome
from ffsm_drake.scenario import scenario_to_dict

TIME = np.arange(0.0, 20.0, 0.01)


@pytest.fixture(scope="module")
def verdicts():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[3] / "benchmarks"))
        import verdicts

        yield verdicts


def log_of(error, *, overrides=(), status="completed", grasp=None):
    """A run's log as far as its end is looked at: the error (rad) of the first joint."""
    tracked = SimpleNamespace(
        error=error[:, None], names=("joint_1",), groups=("joints",), units=("rad",)
    )
    outcome = Outcome(status=status, time=float(TIME[-1]), message="as told")
    return SimpleNamespace(
        scenario=load_scenario("postcapture", overrides),
        time=TIME,
        coordinates=SimpleNamespace(joints=("joint_1",)),
        tracked=tracked,
        outcome=outcome,
        grasp=grasp,
    )


def grasped(*offset):
    return SimpleNamespace(contact=object(), offset=np.array(offset))


SLOW = 5e-3 * np.sin(0.1 * (TIME - 17.0))  # of a disturbance, through zero near the end


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (1e-4 + 0.0 * TIME, "settled"),
        (np.exp(-TIME), "settled"),
        (np.where(TIME > 19.2, 2e-3, 1e-4), "growing"),
        (1e-7 * np.exp(0.45 * TIME), "growing"),
        (1e-12 * np.exp(TIME), "growing"),
        (np.where(TIME > 16.0, 2e-3, 1e-4), "not settled"),  # and stays so
        (1e-14 * np.exp(TIME), "settled"),  # too small to matter yet
        (2e-3 * np.sin(3.0 * TIME), "not settled"),
        (SLOW, "not settled"),
    ],
)
def test_the_end_of_a_run_by_its_errors(verdicts, error, kind):
    end = verdicts.end_of(log_of(error))
    assert end.kind == kind
    assert end.worst == "joint_1"


def test_a_biased_sensor_is_not_the_loop(verdicts):
    error = 0.03 + 0.0 * TIME
    bias = "sensing.position_bias={joint_1: -0.03}"
    assert verdicts.end_of(log_of(error)).kind == "not settled"
    assert verdicts.end_of(log_of(error, overrides=[bias])).kind == "settled"


def test_ends_that_errors_do_not_tell(verdicts):
    error = 0.0 * TIME
    assert verdicts.end_of(log_of(error, status="diverged")).message == "as told"
    near, far = grasped(0.0, 0.0, 0.1, 0.0, 0.0, 0.05), grasped(0.0, 0.0, 0.0, 0.97, 0.0, 0.0)
    assert verdicts.end_of(log_of(error, grasp=near)).kind == "settled"
    assert verdicts.end_of(log_of(error, grasp=far, status="diverged")).kind == "missed"
    turned = grasped(0.0, 0.3, 0.0, 0.0, 0.0, 0.0)
    assert verdicts.end_of(log_of(error, grasp=turned)).kind == "missed"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mission", "capture"])
def test_the_same_seed_draws_the_same_mission(verdicts, kind):
    mission, scenario, _ = verdicts.drawn(kind, 3, 5)
    assert verdicts.drawn(kind, 3, 5)[0] == mission
    assert verdicts.drawn(kind, 4, 5)[0] != mission
    words = shlex.split(verdicts.command({"base": mission.base, "overrides": mission.overrides}))
    assert words[:2] == ["ffsm", "run"]
    again = load_scenario(words[2], words[4::2])
    assert scenario_to_dict(again) == scenario_to_dict(scenario)


def test_a_mission_that_takes_too_long_is_a_result(verdicts, monkeypatch):
    monkeypatch.setattr(verdicts, "drawn", lambda *which: time.sleep(60.0))
    result = verdicts.evaluate("mission", 0, 0, 0.05)
    assert result["end"]["kind"] == "interrupted"
    assert "time_limit" in result["end"]["message"]
    assert json.loads(json.dumps(result)) == result


def test_misses_and_false_alarms_are_named(verdicts):
    def result(warnings, kind, unknown=""):
        predicted = verdicts.Predicted(warnings=warnings, unknown=unknown, cpu={"validate": 1.0})
        end = verdicts.End(kind=kind, time=2.0)
        found = {"base": "postcapture", "overrides": ["duration=2"], "refused": ["no"]}
        return verdicts.make_result(found, predicted=predicted, end=end, cpu=4.0)

    printed = verdicts.table({
        "mission 0": result([], "settled"),
        "mission 1": result([], "diverged"),
        "mission 2": result(["unstable"], "settled"),
        "mission 3": result(["unstable"], "growing"),
        "mission 4": result([], "missed", unknown="an error"),
    })  # fmt: skip
    assert "miss: 2 of 5 (40.0 %)\n- mission 1: diverged" in printed
    assert "false alarm: 1 of 5 (20.0 %)\n- mission 2: settled" in printed
    assert "ffsm run postcapture --set duration=2" in printed
    assert "refused and drawn again: 5" in printed
    assert "validate: 0.25 of a complete run" in printed


@pytest.mark.long
def test_it_goes_on_where_it_stopped(verdicts, tmp_path, capsys):
    out = tmp_path / "verdicts.json"
    verdicts.main(["--number", "1", "--captures", "0", "--out", str(out)])
    assert "mission 0: " in capsys.readouterr().out
    verdicts.main(["--number", "2", "--captures", "1", "--out", str(out)])
    printed = capsys.readouterr().out
    assert printed.startswith("mission 1: ")
    assert "2 random missions" in printed
    stored = json.loads(out.read_text())
    assert set(stored["results"]) == {"mission 0", "mission 1", "capture 0"}
