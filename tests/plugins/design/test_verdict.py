"""The verdict on a mission: its lines say what they cover, and where they disagree."""

import dataclasses
import itertools
import json
import random
import re

import pytest
from click.testing import CliRunner

from ffsm_drake import load_scenario
from ffsm_drake.cli import main
from ffsm_drake.plugins.design.verdict import Verdict, verdict
from ffsm_drake.runs.ending import DIVERGED, MISSED, NOT_SETTLED, SETTLED

UNSTABLE_AT_START = ["controllers.tde_aismc.k_s_initial=150", "duration=21"]
# Words on how a mission ends, and "stable" without its scope.
ENDS = re.compile(
    r"(?<!not )expected to|settles|bounded|(?<!moving )(?<!expected to go )as planned"
)
UNSCOPED = re.compile(r"(?<!un)(?<!loop )stable(?! for small errors| at rest)")
LAWS = ("tde_aismc", "asmc", "tdc", "computed_torque", "pd_plus", "slotine_li", "coordinated")
MISSIONS = ("postcapture", "flight_sensors", "tumbling_capture", "seven_joint", "free_floating")
DRAWN = random.Random(51).sample(list(itertools.product(MISSIONS, LAWS)), 4)
MISSING = ("tumbling_capture", "computed_torque")  # stable for small errors; the run misses


@pytest.fixture(scope="module")
def settling():
    return verdict(load_scenario("postcapture"))


@pytest.mark.smoke
def test_each_line_says_what_it_covers(settling):
    linear, run = settling.lines
    assert linear.startswith("linear: motion: stable for small errors, spectral radius 0.98")
    assert linear.endswith("moving as planned, without limits and noise)")
    assert run.startswith("rehearsed (one run with limits and noise): Settled")
    assert settling.conclusion.startswith(
        "expected to go as planned (checked: linear loop of every leg; one run"
    )
    assert settling.warnings == []
    assert not settling.is_alarm


def test_without_a_rehearsal_no_run_is_spoken_of():
    found = verdict(load_scenario("postcapture"), rehearsal=False)
    assert found.run is None
    assert len(found.lines) == 1
    assert "run" not in found.conclusion


@pytest.mark.parametrize("load", [None, 0.2, 1.5])
@pytest.mark.parametrize("status", [None, "stable", "errors grow", "cannot say", "unstable"])
@pytest.mark.parametrize("end", [None, SETTLED, NOT_SETTLED, DIVERGED, MISSED])
def test_success_is_said_of_a_run_alone(settling, load, status, end):
    """A verdict with any parts; ``end``: of the rehearsed run, None: no run was looked at."""
    linear, run = settling.linear, settling.run
    legs = tuple(dataclasses.replace(leg, status=status) for leg in linear.legs)
    ending = dataclasses.replace(run.ending, status=end or SETTLED)
    found = dataclasses.replace(
        settling, load=load, linear=status and dataclasses.replace(linear, legs=legs),
        run=end and dataclasses.replace(run, ending=ending),
    )  # fmt: skip
    said = found.conclusion
    if end is None:
        assert not ENDS.search(said)
        assert said.startswith(
            ("no alarm, but the mission was not", "not expected", "no prediction")
        )
    elif end != SETTLED:
        assert not re.search(r"(?<!not )expected to (settle|go)", said)
    else:
        assert ENDS.search(said) or found.is_alarm


@pytest.mark.long
@pytest.mark.parametrize(("name", "law"), [MISSING, *DRAWN])
def test_without_a_run_no_command_speaks_of_success(name, law):
    for command in ("validate", "stability"):
        result = CliRunner().invoke(
            main, [command, name, "--set", f"controller={law}", "--no-rehearsal"]
        )
        assert result.exit_code in (0, 3), result.output
        for line in result.output.splitlines():
            assert not ENDS.search(line), line
            assert not UNSCOPED.search(line), line
        assert "not rehearsed" in result.output or "not expected to go as planned" in result.output


@pytest.mark.slow
def test_a_disagreement_is_the_finding():
    found = verdict(load_scenario("postcapture", UNSTABLE_AT_START))
    assert found.is_linearly_unstable
    assert found.run.ending.is_settled
    assert any(line.startswith("linear and rehearsed disagree: ") for line in found.lines)
    assert found.conclusion.startswith("expected to settle, but the linear loop is unstable")
    alone = verdict(load_scenario("postcapture", UNSTABLE_AT_START), rehearsal=False)
    (warning,) = alone.warnings
    assert "unstable" in warning


@pytest.mark.parametrize(
    ("load", "said"),
    [
        (float("inf"), "the force grows without bound"),
        (1.5, "the force reaches 150 % of its limit"),
    ],
)
def test_a_load_beyond_the_limit_is_told_as_a_number_or_in_words(load, said):
    found = Verdict(
        linear=None, not_linear="", load=load, noises=None, run=None, planned=(), margins=None,
        not_margins="",
    )  # fmt: skip
    assert f"after the grasp {said}" in "; ".join(found.warnings)


def test_a_run_that_ends_before_its_motion_is_not_expected_to_settle():
    found = verdict(load_scenario("postcapture", ["duration=3"]))
    assert found.conclusion.startswith("not expected to settle: ")
    assert not found.is_alarm


@pytest.mark.parametrize(
    ("name", "controller"),
    [
        pytest.param("Rare", "tdc", marks=pytest.mark.slow),
        pytest.param("Irregular", "tdc", marks=pytest.mark.long),
        pytest.param("Irregular", "pd_plus", marks=pytest.mark.long),
    ],
)
def test_nothing_is_concluded_from_a_loop_that_cannot_be_linearised(name, controller):
    given = [f'blocks.sensing={{tracker: "slow_tracker:{name}"}}', f"controller={controller}"]
    scenario = load_scenario("flight_sensors", given)
    found = verdict(scenario, rehearsal=False, margins=True)
    assert found.linear.status == "cannot say"
    assert found.conclusion.startswith("no prediction; ")
    assert not found.is_alarm
    assert (found.margins is None) is bool(found.not_margins)
    told = [line for line in found.lines if line.startswith("margins")]
    assert len(told) == 1
    if found.margins is None:
        assert told[0].startswith("margins: cannot say: ")
        assert "tracker" in told[0]
    given = ["--set", given[0], "--set", given[1], "--no-rehearsal", "--limits"]
    result = CliRunner().invoke(main, ["stability", "flight_sensors", *given])
    assert not result.exception or isinstance(result.exception, SystemExit), result.output
    assert "cannot say" in result.output


@pytest.mark.parametrize("command", ["validate", "stability"])
def test_the_commands_give_it_as_data(command):
    overrides = ["--set", "duration=3", "--set", "controller=tdc"]
    result = CliRunner().invoke(main, [command, "postcapture", *overrides, "--json"])
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    mission = (data["postcapture"] if command == "validate" else data)["mission"]
    assert mission["linear"][0]["leg"] == "motion"
    assert mission["run"]["status"] == "not settled"
    assert mission["alarm"] is False
