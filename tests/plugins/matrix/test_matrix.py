"""Capabilities in pairs: every pair of values of two factors (``missions.FACTORS``) occurs in a
mission that settles as predicted, is refused in one line that names both, or is warned of.
"""

import itertools
import re

import pytest
import yaml
from click.testing import CliRunner
from covering import allowed_pairs, covering_array, pairs_of
from missions import FACTORS, PLAIN, REFUSED, ROOT, WARNED, overrides_of, spacecraft_of

from ffsm_drake import ScenarioError, load_scenario
from ffsm_drake.cli import main
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.design.limits_left import CLEARANCE
from ffsm_drake.plugins.design.verdict import verdict
from ffsm_drake.plugins.planning.planner import plan_motion
from ffsm_drake.scenario import scenario_to_yaml

ROWS = covering_array(FACTORS, [*REFUSED, *WARNED])
_QUICK = ("law", "estimator", "start", "driven")
QUICK = covering_array({name: FACTORS[name] for name in _QUICK}, [*REFUSED, *WARNED])[:6]


@pytest.fixture(scope="session")
def workshop(tmp_path_factory):
    """Makes a row's mission; spacecraft and plans are kept."""
    folder, spacecraft, plans = tmp_path_factory.mktemp("matrix"), {}, {}

    def spacecraft_file(row):
        name = row["spacecraft"]
        if name not in spacecraft:
            spacecraft[name] = spacecraft_of(name, folder / name.replace(" ", "_"))
        return spacecraft[name]

    def plan_file(row):
        key = row["spacecraft"], row["start"], row["driven"]
        if row["motion"] == "plan" and key not in plans:
            alike = dict(zip(("spacecraft", "start", "driven"), key, strict=True))
            file = folder / f"{len(plans)}.plan.yaml"
            plan_motion(mission({**PLAIN, **alike})).plan.save(file, title="of the matrix")
            plans[key] = file
        return plans.get(key)

    def mission(row):
        file = spacecraft_file(row)
        plan = plan_file(row)
        return load_scenario(file, overrides_of(row, load_scenario(file), plan))

    return mission


def name_of(row):
    """The values of a row that are not the plain ones."""
    values = (value for factor, value in row.items() if value != PLAIN[factor])
    return ",".join(values).replace(" ", "_") or "plain"


def name_of_combination(combination):
    return name_of({**PLAIN, **dict(combination)})


def ffsm(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def commands(row, file, folder):
    """The command lines of a row's command."""
    out = ("--out", folder / "out")
    run = ("run", file, "--no-report", *out)
    spec = {
        "description": "Two cases", "scenario": str(file), "cases": 2, "seed": 0,
        "controllers": [load_scenario(file).controller],
        "parameters": {"payload.truth.mass": {"distribution": "uniform", "low": 80, "high": 90}},
    }  # fmt: skip
    (folder / "spec.yaml").write_text(yaml.safe_dump(spec))
    return {
        "run": [run],
        "stability": [("stability", file, "--no-rehearsal")],
        "design": [("design", file, "--time", 1, *out)],
        "plan": [("plan", file, *out)],
        "compare": [("compare", file, "-c", "tdc", "-c", "tde_aismc", "--no-report", *out)],
        "campaign": [
            ("campaign", "run", folder / "spec.yaml", "--workers", 1, "--database", folder / "x.db")
        ],
        "replay": [run, ("replay", folder / "out", "--speed", 8)],
    }[row["command"]]


def test_every_pair_is_covered_or_refused():
    """The array holds each allowed pair and no refused combination, in few rows."""
    covered = set().union(*map(pairs_of, ROWS))
    assert covered >= set(allowed_pairs(FACTORS, REFUSED))
    left_out = [*REFUSED, *WARNED]
    assert not any(combination <= row.items() for combination in left_out for row in ROWS)
    most = sorted(map(len, FACTORS.values()))[-2:]
    assert len(ROWS) < 2.0 * most[0] * most[1]


@pytest.mark.parametrize("combination", REFUSED, ids=name_of_combination)
def test_what_is_refused_says_so_in_one_line(combination, workshop, tmp_path):
    row = {**PLAIN, **dict(combination)}
    try:
        scenario = workshop(row)
    except ScenarioError as error:
        said = str(error)
    else:
        file = tmp_path / "mission.yaml"
        file.write_text(scenario_to_yaml(scenario))
        command = "validate" if row["command"] == "run" else row["command"]
        result = ffsm(command, file)
        assert result.exit_code == 2, result.output
        said = result.stderr.strip()
    assert "\n" not in said
    for name in REFUSED[combination]:
        assert name in said


@pytest.mark.parametrize("row", QUICK, ids=name_of_combination)
@pytest.mark.smoke
def test_a_few_missions_are_predicted_without_a_run(row, workshop):
    found = verdict(workshop({**PLAIN, **row}), rehearsal=False)
    assert found.linear is not None
    assert not found.is_linearly_unstable


@pytest.mark.parametrize(
    "row",
    [
        pytest.param(row, marks=pytest.mark.slow if row == PLAIN else pytest.mark.long)
        for row in ROWS
    ],
    ids=name_of,
)
def test_a_mission_settles_as_predicted(row, workshop, tmp_path, monkeypatch):
    """The row's command looks ahead anew only at what is not the row's own mission."""
    scenario = workshop(row)
    found = verdict(scenario)
    assert found.run is not None
    assert found.run.ending.is_settled, found.lines
    # parts of a drawn mission may overlap, of which the verdict warns rightly
    assert not found.is_alarm or CLEARANCE in found.run.limits, found.lines
    file, text = tmp_path / "mission.yaml", scenario_to_yaml(scenario)
    file.write_text(text)

    def known(each, **asked):
        of = each.scenario if isinstance(each, Mission) else each
        return found if scenario_to_yaml(of) == text else verdict(each, **asked)

    for place in ("judge", "verdict"):
        monkeypatch.setattr(f"ffsm_drake.plugins.design.{place}.verdict", known)
    for line in commands(row, file, tmp_path):
        result = ffsm(*line)
        codes = (0, 3) if line[0] == "stability" and found.is_alarm else (0,)
        assert result.exit_code in codes, (line, result.output[-2000:], result.stderr[-2000:])


@pytest.mark.parametrize("combination", WARNED, ids=name_of_combination)
def test_what_is_warned_of_is_predicted_as_unstable(combination, workshop):
    found = verdict(workshop({**PLAIN, **dict(combination)}), rehearsal=False)
    assert found.is_linearly_unstable
    assert found.is_alarm


def test_the_page_tells_what_is_refused_and_warned_of():
    """Each row of the page combines one value of each of its cells, but for the reason."""
    text = (ROOT / "docs/combinations.md").read_text()
    rows = [line.split("|")[1:4] for line in text.splitlines() if line.startswith("| `")]
    cells = [[re.findall(r"`([^`]+)`", cell) for cell in row if cell.strip()] for row in rows]
    told = [frozenset(values) for row in cells for values in itertools.product(*row)]
    assert sorted(map(sorted, told)) == sorted(
        sorted(f"{factor}: {value}" for factor, value in each) for each in [*REFUSED, *WARNED]
    )
