"""The benchmark: laws ranked, resumed, with a user's law beside the shipped ones; lower bounds and
published figures.
"""

import csv
import dataclasses
import json
import re

import numpy as np
import pytest
from campaign_tools import HERE, sql
from click.testing import CliRunner
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from ffsm_drake.cli import main
from ffsm_drake.common.errors import CampaignError, InterruptedCampaign
from ffsm_drake.common.numbers import NONE
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.benchmark import boards
from ffsm_drake.plugins.benchmark.boards import (
    Place,
    Reproduced,
    board_so_far,
    check_mission,
    comparison,
    run_mission,
)
from ffsm_drake.plugins.benchmark.comparison import (
    comparison_figure,
    comparison_markdown,
    summary_rows,
)
from ffsm_drake.plugins.benchmark.law_figures import FIGURES
from ffsm_drake.plugins.benchmark.missions import (
    BenchmarkMission,
    Published,
    bounds_of,
    compared_missions,
    least_propellant,
    load_mission,
    mission_names,
)
from ffsm_drake.plugins.benchmark.page import (
    benchmark_data,
    benchmark_page,
    board_columns,
    board_text,
)
from ffsm_drake.plugins.capture.contact import planned_contact
from ffsm_drake.scenario import override_scenario, scenario_to_yaml, thrusters_of
from ffsm_drake.show.table_files import write_table
from ffsm_drake.spacecraft.craft import make_nominal_plant
from ffsm_drake.spacecraft.free_floating import free_floating

LAW = """
import dataclasses
from ffsm_drake import ControlLaw

@dataclasses.dataclass(frozen=True)
class Idle(ControlLaw):
    def step(self, sample, state):
        return 0.0 * sample.v, state
"""


@pytest.fixture(scope="module")
def mission():
    short = load_mission("postcapture")
    scenario = override_scenario(short.scenario, ["duration=0.3"])
    checks = (Published(figure="isv", value=1e9, at_most=True, source="a test", controller="tdc"),)
    return dataclasses.replace(short, scenario=scenario, checks=checks)


@pytest.fixture(scope="module")
def folder(mission, tmp_path_factory):
    """The runs of two laws. Not to be written to."""
    folder = tmp_path_factory.mktemp("benchmark")
    run_mission(placed(mission, folder), ["tdc", "asmc"], workers=HERE, margins=True)
    return folder


def placed(mission, folder):
    return Place(mission=mission, folder=folder, seeds=3)


def drawn_rows(rng, seeds, *, settle, median, scatter):
    """Results of a law: ITAE and ISV of some of the seeds are of failed runs, and absurd."""
    rows = []
    for k in range(seeds):
        settled = bool(settle[k])
        itae, isv = median * np.exp(scatter * rng.normal(size=2))
        absurd = {} if settled else {"itae": 1e9, "isv": 1e9}
        outcome = {"outcome": "settled" if settled else "diverged", "message": ""}
        rows.append({"itae": itae, "isv": isv, "engine": "compiled"} | absurd | outcome)
    return rows


@pytest.mark.parametrize("seed", range(3))
def test_a_comparison_finds_drawn_differences_and_no_failed_run_enters(seed, mission, tmp_path):
    """On the page, in Markdown, as CSV and in the figure; laws of equal size are within noise."""
    rng = np.random.default_rng([64, seed])
    every = np.ones(20)
    some = np.arange(20) < rng.integers(8, 12)
    of_law = {
        "tde_aismc": drawn_rows(rng, 20, settle=every, median=1.0, scatter=0.05),
        "better": drawn_rows(rng, 20, settle=every, median=rng.uniform(0.3, 0.7), scatter=0.05),
        "worse": drawn_rows(rng, 20, settle=some, median=rng.uniform(1.5, 3.0), scatter=0.05),
        "lost": drawn_rows(rng, 20, settle=0 * every, median=1.0, scatter=0.05),
    }
    # as often above the reference as below, by the same factors
    factors = np.exp(np.outer(rng.normal(0.0, 0.1, 10), (1.0, -1.0)).ravel())
    of_law["equal"] = [
        row | {name: row[name] * factor for name in ("itae", "isv")}
        for row, factor in zip(of_law["tde_aismc"], factors, strict=True)
    ]
    standings = [boards._standing(law, rows, tmp_path / "no") for law, rows in of_law.items()]
    board = boards.Board(mission=mission, standings=tuple(standings), bounds={}, motion=20.0)
    found = {law: each for (_, law), each in comparison([board]).items()}
    findings = {law: {key: x.finding for key, x in each.items()} for law, each in found.items()}
    same = "within noise"
    assert findings == {
        "better": {"settled": same, "itae": "smaller", "isv": "smaller"},
        "equal": {"settled": same, "itae": same, "isv": same},
        "worse": {"settled": "smaller", "itae": "larger", "isv": "larger"},
        "lost": {"settled": "smaller"},
    }
    assert found["worse"]["itae"].pairs == some.sum()
    assert all(each.figures["itae"] is None or each.figures["itae"] < 4.0 for each in standings)
    text = comparison_markdown([board], comparison([board]))
    rows = text[text.index("| law |") :].splitlines()
    cells = {line.split("|")[1].strip(" `"): line for line in rows if "`" in line}
    assert cells["lost"].count(NONE) == 4
    assert f"{some.sum()} of 20 [" in cells["worse"]
    assert "↓" in cells["worse"].split("|")[2]
    page = re.sub("<[^>]*>", " ", benchmark_page([board], [], comparison([board])))
    write_table(board_columns([board], comparison([board])), tmp_path / "laws.csv")
    csv_rows = {row["law"]: row for row in csv.DictReader((tmp_path / "laws.csv").open())}
    ratio = found["better"]["itae"].value
    assert float(csv_rows["better"]["ITAE ratio"]) == pytest.approx(ratio.value)
    assert f"{ratio.value:.4f} [{ratio.low:.4f}, {ratio.high:.4f}] ↓" in page
    (panel,) = comparison_figure([board], comparison([board])).axes
    assert [label.get_text() for label in panel.get_yticklabels()] == list(found)
    assert {text.get_text() for text in panel.texts} == {f"{some.sum()}/20", "0/20"}


@pytest.mark.parametrize("seed", range(4))
def test_the_summary_has_each_law_in_one_column(seed, mission, tmp_path):
    """By drawn outcomes; without the reference, unless that did not settle."""
    rng = np.random.default_rng([66, seed])
    itae = {"tde_aismc": 1.0, "best": 0.5, "worse": 2.0, "worst": 3.0, "some": 0.4, "none": 0.3}
    settle = {law: np.ones(20, dtype=bool) for law in itae}
    settle["some"][: rng.integers(1, 14)] = settle["none"][:] = False
    if reference_fails := bool(seed % 2):
        settle["tde_aismc"][rng.integers(0, 15) :] = False
    of_law = {
        law: drawn_rows(rng, 20, settle=settle[law], median=itae[law], scatter=0.02) for law in itae
    }
    of_law["unrun"] = [*of_law["best"][1:], dict(boards._MISSING)]
    standings = [boards._standing(law, rows, tmp_path / "no") for law, rows in of_law.items()]
    unfit = {"outcomes": (), "figures": dict.fromkeys(boards.SHOWN), "message": "no such frame"}
    standings.append(boards.Standing(controller="unfit", **unfit))
    board = boards.Board(mission=mission, standings=tuple(standings), bounds={}, motion=20.0)
    found = comparison([board])
    header, cells = summary_rows([board], found)
    of_column = dict(zip(header, cells, strict=True))
    assert of_column.pop("mission") == "postcapture"
    some = f"some ({settle['some'].sum()} of 20), none"
    unsettled = {"not settled in all runs": some, "not run": "1 law", boards.REFUSED: "unfit"}
    compared = {"smaller ITAE": "best", "within noise": NONE, "larger ITAE": "2 laws"}
    if reference_fails:
        count = settle["tde_aismc"].sum()
        shown = f" ({count} of 20)" if count else ""
        unsettled["not settled in all runs"] = f"tde_aismc{shown}, {some}"
        if count < 6:
            compared = dict.fromkeys(compared, NONE) | {"settled, no ratio": "best, worse, worst"}
    assert of_column == compared | unsettled
    text = comparison_markdown([board], found)
    assert text.index("| `postcapture` |") < text.index("- `postcapture`, `unfit`: no such frame")
    assert text.index("`unfit`: no such frame") < text.index("### `postcapture`")
    page = re.sub("<[^>]*>", " ", benchmark_page([board], [], found))
    assert page.index("smaller ITAE") < page.index("ITAE ratio")


@pytest.mark.slow
def test_stored_runs_are_written_without_a_run(mission, folder, tmp_path, monkeypatch):
    """The same files as the benchmark itself; nothing stored is an error."""
    (tmp_path / "short.yaml").write_text(scenario_to_yaml(mission.scenario))
    place = Place(mission=load_mission(str(tmp_path / "short.yaml")), folder=tmp_path / "runs")
    place = dataclasses.replace(place, seeds=3)
    place.folder.mkdir()
    for law in ("tdc", "asmc"):
        source = placed(mission, folder).database(law)
        target = place.database(law)
        target.write_bytes(source.read_bytes())
    monkeypatch.setattr(boards, "resume_campaign", None)
    command = ["benchmark", str(tmp_path / "short.yaml"), "--stored", "--out", str(tmp_path)]
    laws = ["-c", "tdc", "-c", "asmc", "-c", "pd_plus"]
    result = CliRunner().invoke(main, [*command, *laws, "--seeds", "3"])
    assert result.exit_code == 0, result.output
    (data,) = json.loads((tmp_path / "benchmark.json").read_text())["missions"].values()
    outcomes = {law: found["outcomes"] for law, found in data["laws"].items()}
    settled, missing = ["settled"] * 3, [boards.NOT_RUN] * 3
    assert outcomes == {"asmc": settled, "tdc": settled, "pd_plus": missing}
    nothing = CliRunner().invoke(main, [*command, "--seeds", "4"])
    assert "--stored" in str(nothing.output) + str(nothing.exception)
    assert nothing.exit_code == 2


def test_six_missions_are_compared_by_default():
    assert len(compared_missions()) == 6
    assert set(compared_missions()) <= set(mission_names())


def copied(folder, to):
    for path in folder.iterdir():
        (to / path.name).write_bytes(path.read_bytes())
    return to


@pytest.mark.smoke
def test_laws_are_ranked_with_the_same_seeds(mission, folder, monkeypatch):
    """Every law; the mission refuses one that cannot be built."""
    monkeypatch.setattr(boards, "shipped_names", lambda _: ("tdc", "asmc", "no_such_law"))
    board = run_mission(placed(mission, folder), [], workers=HERE)
    ranked = [standing.controller for standing in board.standings]
    assert ranked == ["asmc", "tdc", "no_such_law"]
    assert [standing.settled for standing in board.standings] == [3, 3, 0]
    asmc, tdc, unfit = board.standings
    assert 0.0 < asmc.figures["itae"] < tdc.figures["itae"]
    assert 0.0 < asmc.figures["law_time"] < 0.01
    assert 1.0 < asmc.figures["payload_factor"] < tdc.figures["payload_factor"] < 2.0
    assert asmc.figures["delay_margin"] == 0.0  # a sample's delay is one too many
    assert tdc.figures["error_over_lqg"] > asmc.figures["error_over_lqg"] > 1.0
    assert unfit.outcomes == ()
    assert "no_such_law" in unfit.message
    (found,) = check_mission(board)
    assert found.found == tdc.figures["isv"]
    assert found.holds
    assert re.search("no_such_law +refused by the mission", board_text(board))


def test_an_interrupted_benchmark_goes_on(mission, folder, tmp_path):
    """Only what is missing is run."""
    place = placed(mission, copied(folder, tmp_path))
    sql(place.database("tdc"), "DELETE FROM results WHERE case_index = 1")
    runs = []
    laws = ["tdc", "asmc"]
    board = run_mission(place, laws, workers=HERE, progress=runs.append)
    assert (runs[-1].session, runs[-1].done, runs[-1].total) == (1, 6, 6)
    again = run_mission(placed(mission, folder), laws, workers=HERE)
    for first, second in zip(board.standings, again.standings, strict=True):
        assert first.figures == second.figures


def written(boards, folder):
    """A leaderboard as a table, on the page, as CSV and as LaTeX, without markup."""
    for suffix in ("csv", "tex"):
        write_table(board_columns(boards, {}), folder / f"laws.{suffix}")
        yield (folder / f"laws.{suffix}").read_text()
    yield "".join(map(board_text, boards))
    yield re.sub("<[^>]*>", " ", benchmark_page(boards, [], {}).split("<details>")[0])


@pytest.mark.parametrize("seed", range(4))
def test_a_law_that_was_cut_keeps_its_row(seed, mission, folder, tmp_path):
    """By an interruption, or by the time limit of a campaign; and the figures of a law."""
    rng, expected = np.random.default_rng([51, seed]), {}
    place = placed(mission, copied(folder, tmp_path))
    for law in ("tdc", "asmc"):
        kinds = rng.choice(["kept", boards.NOT_RUN, boards.CUT], 3)
        kinds[0] = rng.choice([boards.NOT_RUN, boards.CUT])
        counts = {kind: int((kinds == kind).sum()) for kind in kinds if kind != "kept"}
        expected[law] = [f"{count} {kind}" for kind, count in counts.items()]
        for case, kind in enumerate(kinds):
            row = f"case_index = {case}"
            change = {
                "kept": "SELECT 1",
                boards.NOT_RUN: f"DELETE FROM results WHERE {row}",
                boards.CUT: "UPDATE results SET outcome = 'error', message = 'TimeLimit: took "
                f"longer than 600 s of wall time (time_limit)' WHERE {row}",
            }[kind]
            sql(place.database(law), change)
    place.margins("tdc").write_text(json.dumps(dict.fromkeys(FIGURES, np.nan)))
    board = board_so_far(place, ["tdc", "asmc", "pd_plus"])
    expected["pd_plus"] = ["3 not run"]
    assert {each.controller for each in board.standings} == set(expected)
    for text in written([board], tmp_path):
        for law, words in expected.items():
            (line,) = re.findall(rf"\b{law.replace('_', '.{0,2}_')}\b[^\n]*", text)
            assert all(word in line for word in words), (text, words)
        assert len(re.findall(r"\bcut\b(?! by)", text)) == len(FIGURES)


@pytest.mark.slow
def test_an_interrupted_command_writes_what_it_has(mission, tmp_path, monkeypatch):
    """With a row for every law, also of a mission that was not begun."""

    def interrupted(*_, **__):
        raise InterruptedCampaign(0, 3)

    for name in ("first", "second"):
        (tmp_path / f"{name}.yaml").write_text("extends: postcapture\nduration: 0.2\n")
    monkeypatch.setattr(boards, "resume_campaign", interrupted)
    files = [str(tmp_path / f"{name}.yaml") for name in ("first", "second")]
    result = CliRunner().invoke(
        main,
        ["benchmark", *files, "-c", "tdc", "--seeds", "3", "--workers", "1",
         "--out", str(tmp_path / "o"), "--table", str(tmp_path / "laws.csv")],
    )  # fmt: skip
    assert result.exit_code not in (0, 3)
    assert (tmp_path / "o" / "benchmark.html").read_text().count("0 of 3, 3 not run") == 2
    _, *rows = (tmp_path / "laws.csv").read_text().splitlines()
    assert [row[: row.index(",", 7)] for row in rows] == ["first,tdc", "second,tdc"]
    assert all("3 not run" in row for row in rows)


def test_a_users_law_gets_its_row(mission, folder, tmp_path, monkeypatch):
    (tmp_path / "idle_law.py").write_text(LAW)
    monkeypatch.syspath_prepend(str(tmp_path))
    place = placed(mission, copied(folder, tmp_path))
    board = run_mission(place, ["idle_law:Idle"], workers=HERE)
    assert [each.controller for each in board.standings] == ["asmc", "tdc", "idle_law:Idle"]
    assert "error" not in board.standings[-1].outcomes
    with pytest.raises(Exception, match="no_such_law"):
        run_mission(placed(mission, tmp_path), ["no_such_law:Law"], workers=HERE)


def test_a_law_that_diverges_at_once_does_not_lead(mission, folder, tmp_path, monkeypatch):
    """Its error in the little time that it had is no figure."""
    (tmp_path / "wild_law.py").write_text(LAW.replace("0.0 *", "1e6 + 0.0 *"))
    monkeypatch.syspath_prepend(str(tmp_path))
    board = run_mission(placed(mission, copied(folder, tmp_path)), ["wild_law:Idle"], workers=HERE)
    *_, last = board.standings
    assert (last.controller, last.outcomes) == ("wild_law:Idle", ("diverged",) * 3)
    assert last.figures["itae"] is None
    assert re.search(r"0 of 3 \[0.00, 0.56\], 3 diverged", board_text(board))


@pytest.mark.long
def test_other_scenarios_do_not_mix(mission, folder, tmp_path):
    """Runs of a mission that has changed since are left out."""
    changed = dataclasses.replace(
        mission, scenario=override_scenario(mission.scenario, ["duration=0.2"])
    )
    board = run_mission(placed(changed, copied(folder, tmp_path)), ["tdc"], workers=HERE)
    assert [each.controller for each in board.standings] == ["tdc"]


def test_least_times_of_the_published_stop():
    """3.86 N m s against 2.5 N m, and the least time of the shipped plan."""
    mission = load_mission("planar_detumble")
    bounds = bounds_of(mission)
    assert bounds["held"] == pytest.approx(3.86 / 2.5, rel=0.01)
    assert bounds["planner"] == pytest.approx(2.889, abs=0.002)
    assert bounds["momentum"] < bounds["held"] < bounds["planner"]


def test_wheels_and_thrusters_act_together():
    """Each alone takes longer than both, and no torque goes beyond the sum of what they give."""
    scenario = load_mission("capture_on_thrusters").scenario
    both = bounds_of(BenchmarkMission(name="", scenario=scenario))["held"]
    assert both == pytest.approx(0.079, rel=0.01)
    for left in ("wheels", "thrusters"):
        alone = override_scenario(scenario, [f"actuation.{left}=null"])
        assert bounds_of(BenchmarkMission(name="", scenario=alone))["held"] > 1.2 * both


def fastest(mission, rng, *, pieces=8):
    """A time, s, that takes the momentum out: the base turns as it likes, the arm moves the centre
    of mass wherever its length allows, and each piece has the actuators that serve best then.
    """
    scenario = mission.scenario
    model = make_nominal_plant(scenario)
    contact = planned_contact(make_mission(scenario), model)
    stack = free_floating(model, contact.q)
    most = np.linalg.norm(stack.center_of_mass)  # a lever that there is
    momentum = -np.concatenate([contact.spin_after, contact.momentum_after[3:]])
    actuation = scenario.actuation
    columns, least = [], []
    for _ in range(pieces):
        R = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
        lever = most * Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()[0]
        if actuation.thrusters is not None:
            units = thrusters_of(actuation.thrusters).values()
            for unit in units:
                force = R @ (np.array(unit.direction) / np.linalg.norm(unit.direction)) * unit.force
                place = R @ np.array(unit.position) + lever
                columns.append(np.r_[np.cross(place, force), force])
                least.append(0.0)
        for wheel in (actuation.wheels.units if actuation.wheels else {}).values():
            axis = R @ (np.array(wheel.axis) / np.linalg.norm(wheel.axis))
            columns.append(np.r_[wheel.torque_limit * axis, np.zeros(3)])
            least.append(-1.0)
        if actuation.thrusters is None:
            limit = model.coordinates.vector(actuation.limit, key="", default=np.inf)[:6]
            for k, unit in enumerate(np.eye(3)):
                columns.append(np.r_[limit[k] * unit, np.zeros(3)])
                columns.append(limit[3 + k] * np.r_[np.cross(lever, unit), unit])
                least += [-1.0, -1.0]
    shares, unit = np.array(least), np.eye(len(least))
    found = linprog(
        np.r_[np.zeros(len(least)), 1.0],
        A_ub=np.vstack([
            np.column_stack([unit, -np.ones(len(least)) / pieces]),
            np.column_stack([-unit, shares / pieces]),
        ]),
        b_ub=np.zeros(2 * len(least)),
        A_eq=np.column_stack([np.array(columns).T, np.zeros(6)]),
        b_eq=momentum,
        bounds=[*((None, None) for _ in least), (0.0, None)],
    )  # fmt: skip
    return found.x[-1] if found.x is not None else np.inf


@pytest.mark.parametrize(
    "name",
    ["tumbling_capture", "capture_on_thrusters", "envisat", "heavy_stage", "elsa_d", "proba_1"],
)
def test_no_attitude_and_posture_beats_the_bound(name):
    mission, rng = load_mission(name), np.random.default_rng(0)
    bounds = bounds_of(mission)
    tried = [fastest(mission, rng) for _ in range(12)]
    assert min(tried) >= bounds["momentum"]
    assert min(tried) < 20.0 * bounds["momentum"]  # nor is it idle
    assert bounds["momentum"] <= bounds["held"]


def test_least_propellant_of_a_capture():
    """Linear momentum over the exhaust's speed; without wheels the angular one by the longest
    lever; none where nothing is to be taken out.
    """
    scenario = load_mission("capture_on_thrusters").scenario
    contact = planned_contact(make_mission(scenario), make_nominal_plant(scenario))
    linear = np.linalg.norm(contact.momentum_after[3:])
    assert least_propellant(scenario) == pytest.approx(linear / (226.1 * 9.80665))
    alone = override_scenario(scenario, ["actuation.wheels=null"])
    # of thrusters at a corner of the bus, about a centre of mass that is no further than the arm
    angular = np.linalg.norm(contact.spin_after)
    assert angular / (226.1 * 9.80665 * 3.0) < least_propellant(alone) < angular / (226.1 * 9.80665)
    assert least_propellant(load_mission("thrusters_only").scenario) is None


def test_published_figures_can_fail():
    figure = Published(figure="isv", value=100.0, within=0.02, source="")
    most = dataclasses.replace(figure, at_most=True)

    def holds(published, found):
        return Reproduced(mission="", published=published, found=found).holds

    assert [holds(figure, x) for x in (99.0, 101.9, 103.0, None)] == [True, True, False, False]
    assert [holds(most, x) for x in (1.0, 100.0, 100.1, None)] == [True, True, False, False]


def test_every_mission_says_its_source_and_what_is_assumed():
    for name in mission_names():
        mission = load_mission(name)
        assert mission.source
        assert mission.published
        assert mission.assumed
    with pytest.raises(CampaignError, match="did you mean 'paper'"):
        load_mission("papre")


def test_the_page_opens_offline_and_holds_every_number(mission, folder):
    board = run_mission(placed(mission, folder), ["tdc", "asmc"], workers=HERE)
    checks = list(check_mission(board))
    page = benchmark_page([board], checks, {})
    assert page.index("<table") < page.index("<dt>Effort</dt>")
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert "1000000000" in page or "10⁹" in page
    data = benchmark_data([board], checks, {})
    assert data["missions"]["postcapture"]["laws"]["tdc"]["outcomes"] == ["settled"] * 3
    assert data["published_figures"][0]["reproduced"] is True
    assert json.loads(json.dumps(data)) == data
    assert np.isfinite(data["missions"]["postcapture"]["laws"]["tdc"]["itae"])


@pytest.mark.long
def test_the_command(tmp_path, monkeypatch):
    scenario = tmp_path / "short.yaml"
    scenario.write_text("extends: postcapture\nduration: 0.2\n")
    words = f"benchmark {scenario} -c tdc --seeds 3 --workers 1 --out o --table laws.csv".split()
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        result = CliRunner().invoke(main, words)
        assert result.exit_code == 0, result.output
        assert "tdc  " in result.output
    assert (tmp_path / "o" / "benchmark.html").is_file()
    header, row = (tmp_path / "laws.csv").read_text().splitlines()
    assert header.startswith("mission,law,settled,runs,")
    names = [each.partition(" [")[0] for each in next(csv.reader([header]))]
    assert len(set(names)) == len(names), names
    assert row.startswith("short,tdc,3,3,")
    assert json.loads((tmp_path / "o" / "benchmark.json").read_text())["missions"]["short"]
    missed = Published(figure="isv", value=1.0, source="a test")
    monkeypatch.setattr(boards, "shipped_names", lambda _: ("tdc",))
    monkeypatch.setattr(
        boards,
        "check_mission",
        lambda board: [Reproduced(mission="short", published=missed, found=2.0)],
    )
    words.remove("-c")
    words.remove("tdc")
    assert CliRunner().invoke(main, words).exit_code == 3


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[" * 100_000,
        "[]",
        "{}",
        "null",
        json.dumps(dict.fromkeys(boards.FIGURES, "<b>")),
        "x" * 200_000,
    ],
)
def test_a_benchmark_takes_no_figures_from_another_file(text, tmp_path):
    """They are then found anew."""
    found = dict.fromkeys(boards.FIGURES, 1.0)
    path = tmp_path / "figures.json"
    path.write_text(json.dumps(found))
    assert boards._read_figures(path) == found
    path.write_text(text)
    assert boards._read_figures(path) is None
