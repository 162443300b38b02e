"""The judgement of a campaign: statistics against known answers, and the page as a reader meets
it.
"""

import math
import re
import shlex
import shutil
import time

import numpy as np
import pandas as pd
import pytest
from campaign_tools import invoke, run_here, sql, write_spec
from html_page import Page
from scipy import stats
from steps_seen import steps_seen

from ffsm_drake.common.errors import CampaignError
from ffsm_drake.plugins.campaign import prediction
from ffsm_drake.plugins.campaign.page import write_report
from ffsm_drake.plugins.campaign.plan import plan_text, status_text
from ffsm_drake.plugins.campaign.prediction import predict_map
from ffsm_drake.plugins.campaign.spec import load_spec
from ffsm_drake.plugins.campaign.statistics import (
    Table,
    agreed,
    agreement,
    find,
    most_influential,
    paired_differences,
    sensitivities,
    success_rate,
    worst_runs,
)
from ffsm_drake.plugins.campaign.store import open_store


def make_runs(settled, **columns):
    settled = np.asarray(settled, dtype=bool)
    outcome = np.where(settled, "settled", "diverged")
    return pd.DataFrame({"outcome": outcome, "is_settled": settled, "itae": np.nan, **columns})


def make_table(values=None, **runs):
    return Table(runs=runs, values=pd.DataFrame(values or {}))


@pytest.mark.smoke
def test_success_rate_has_the_exact_interval():
    # Nothing fails in n runs: the lower limit solves p^n = 2.5 %.
    rate = success_rate(make_runs([True] * 20))
    assert rate.value == rate.high == 1.0
    assert rate.low == pytest.approx(0.025 ** (1 / 20))
    # 8 of 10, published: 44.39 % to 97.48 %.
    rate = success_rate(make_runs([True] * 8 + [False] * 2))
    assert (rate.low, rate.high) == (
        pytest.approx(0.4439, abs=1e-4),
        pytest.approx(0.9748, abs=1e-4),
    )


@pytest.mark.smoke
def test_paired_differences_find_a_known_factor():
    generator = np.random.default_rng(0)
    itae = np.exp(generator.normal(size=400))  # cases differ by far more than controllers
    ratio = np.exp(generator.normal(math.log(1.1), 0.05, size=400))
    table = make_table(
        tdc=make_runs([True] * 400, itae=itae * ratio),
        asmc=make_runs([True] * 300 + [False] * 100, itae=itae),
    )
    (found,) = paired_differences(table)
    assert (found.cases, found.both) == (400, 300)
    assert found.success.value == 0.25
    assert found.success.low == pytest.approx(0.25 - 1.96 * math.sqrt(0.25 * 0.75 / 400), abs=0.01)
    assert found.itae_ratio.low < 1.1 < found.itae_ratio.high
    assert found.itae_ratio.high - found.itae_ratio.low < 0.03
    ratios = np.sort(ratio[:300])
    assert found.itae_ratio.low in ratios
    assert found.itae_ratio.high in ratios
    # Binomial: fewer than 2.5 % of samples of 300 have so few values below their median.
    assert stats.binom.cdf(np.searchsorted(ratios, found.itae_ratio.low), 300, 0.5) <= 0.025


@pytest.mark.parametrize(
    ("first", "second", "low", "high"),
    [
        # Discordant 1 and 7 of 21: (2 - 8)/23 and 1.96 sqrt((10/23 - (6/23)^2)/23), by hand.
        ([True] * 2 + [False] * 19, [True] + [False] + [True] * 7 + [False] * 12, -0.5084, -0.0134),
        ([True] * 20, [True] * 20, -0.1260, 0.1260),  # all agree
        ([True] * 20, [False] * 20, 0.7350, 1.0),
    ],
)
def test_success_rates_on_the_same_cases_keep_an_interval_where_all_agree(first, second, low, high):
    table = make_table(tdc=make_runs(first), asmc=make_runs(second))
    (found,) = paired_differences(table)
    assert found.success.value == pytest.approx(np.mean(first) - np.mean(second))
    assert (found.success.low, found.success.high) == (
        pytest.approx(low, abs=1e-4),
        pytest.approx(high, abs=1e-4),
    )
    assert found.itae_ratio is None


def test_sensitivity_tells_the_cause_from_the_bystander():
    generator = np.random.default_rng(3)
    cause, bystander = generator.random(600), generator.random(600)
    table = make_table(
        {"bystander": bystander, "cause": cause},
        tdc=make_runs(cause < 0.8),
        asmc=make_runs(np.abs(cause - 0.5) < 0.4),
    )
    every, _ = sensitivities(table, seed=0)
    found = {(item.name, item.controller): item for item in every.itertuples()}
    # one bin straddles the limit
    assert found["cause", "tdc"].share == pytest.approx(1.0, abs=0.15)
    assert found["cause", "tdc"].correlation > 0.5
    # Failing at both ends: no direction, and yet the cause.
    assert found["cause", "asmc"].share > 0.8
    assert abs(found["cause", "asmc"].correlation) < 0.2
    assert not found["bystander", "tdc"].matters
    assert not found["bystander", "asmc"].matters
    assert most_influential(every) == ["cause", "bystander"]


def test_values_that_fail_together_are_told_with_their_total():
    """Each alone explains nothing; a third does not matter."""
    generator = np.random.default_rng(4)
    values = {name: generator.random(500) for name in ("one", "other", "third")}
    apart = (values["one"] > 0.5) == (values["other"] > 0.5)
    table = make_table(values, tdc=make_runs(apart), asmc=make_runs([True] * 500))
    every, pairs = sensitivities(table, seed=0)
    found = {(item.name, item.controller): item for item in every.itertuples()}
    for name in ("one", "other"):
        assert found[name, "tdc"].share < 0.05
        assert found[name, "tdc"].interacts
        assert 0.6 < found[name, "tdc"].total < 1.1
    assert not found["third", "tdc"].interacts
    assert found["third", "tdc"].total == found["third", "tdc"].share
    assert not any(found[name, "asmc"].interacts for name in values)
    assert set(most_influential(every)[:2]) == {"one", "other"}
    (pair,) = pairs.itertuples()
    assert (pair.controller, {pair.first, pair.second}) == ("tdc", {"one", "other"})


@pytest.mark.smoke
def test_agreement_and_worst_runs():
    runs = make_runs(
        [True, False, True, False],
        predicted=[0.9, 1.1, 1.2, 0.8],
        outcome_time=[20, 7, 20, 3],
        final_error_joints=[1e-6, 5, 1e-5, 4],
    )
    found = agreement(runs)
    assert found.tolist() == [[1, 1], [1, 1]]
    assert agreed(found) == 0.5
    assert worst_runs(runs) == [3, 1, 2, 0]


@pytest.fixture(autouse=True)
def _coarse_map(monkeypatch):
    monkeypatch.setattr("ffsm_drake.plugins.campaign.prediction.POINTS", 3)
    monkeypatch.setattr("ffsm_drake.plugins.campaign.prediction.REFINEMENT", 2)


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    """Short runs with beliefs on both sides of ASMC's limit."""
    folder = tmp_path_factory.mktemp("report")
    spec = write_spec(
        folder / "s.yaml",
        overrides={"duration": 0.6},
        controllers=["tdc", "asmc"],
        cases=12,
        factors={"nominal_error": {"distribution": "uniform", "low": -0.5, "high": 0.6}},
        description="with <angle> brackets & </script>",
    )
    return run_here(spec, folder / "x.db")


@pytest.mark.long
def test_the_predicted_boundary_agrees_with_the_outcomes(database):
    with open_store(database) as store:
        findings = find(store, axes=("nominal_error", "payload.truth.mass"))
    asmc = findings.agreement["asmc"]
    (stable_settled, _), (_, unstable_failed) = asmc
    assert asmc.sum() == 12
    assert unstable_failed > 1
    assert stable_settled > 4
    assert agreed(asmc) >= 0.9
    radius = findings.map.radius["asmc"]
    # No inertia is over-estimated by more than the payload's; one axis bears eta = 4 / (2 + (K_D +
    # K_s) L) = 1.0526.
    assert (radius[:, findings.map.x < 0.0526] < 1.0).all()
    assert (radius[:, findings.map.x > 0.2] > 1.0).all()


@pytest.mark.slow
def test_the_map_wants_two_sampled_numbers(database):
    with (
        open_store(database) as store,
        pytest.raises(CampaignError, match="'sample_time' is not a sampled number"),
    ):
        predict_map(store.spec, ("sample_time", "nominal_error"), {"nominal_error": np.arange(3.0)})


@pytest.mark.slow
def test_the_map_is_kept_with_the_results(database, monkeypatch):
    monkeypatch.setattr(prediction, "POINTS", 2)
    kept = "SELECT * FROM campaign WHERE key LIKE 'points %'"
    with open_store(database) as store:
        before = {key for key, _ in store.query(kept)}
        first = find(store).map
        (key,) = {key for key, _ in store.query(kept)} - before

    def again(*_):
        raise AssertionError

    monkeypatch.setattr(prediction, "predict", again)
    with open_store(database) as store:
        second = find(store).map
        for name, radius in first.radius.items():
            np.testing.assert_array_equal(second.radius[name], radius)
        for damaged in ("", "{", "[1]", '{"tdc": "x"}', '{"tdc": [[1.0]]}', '{"tdc": [[1], 2]}'):
            store.keep(key, damaged)
            with pytest.raises(AssertionError):  # computed again
                find(store)
        monkeypatch.undo()
        monkeypatch.setattr(prediction, "POINTS", 2)
        store.keep(key, "{}")
        assert find(store).map.radius.keys() == first.radius.keys()


LABELLED = {
    "cases": 2,
    "overrides": {"duration": 0.1},
    "predictions": False,
    "settled": {"hold": 0.1, "tolerance": {"joints": 1e-9}},
}
MINE = """
import dataclasses, numpy as np
from ffsm_drake import ControlLaw, gain
@dataclasses.dataclass(frozen=True)
class Idle(ControlLaw):
    k: np.ndarray = gain(1.0)
    def step(self, s, state):
        return 0.0 * s.e, state
@dataclasses.dataclass(frozen=True)
class Failing(Idle):
    def step(self, s, state):
        raise ArithmeticError("no")
"""


@pytest.mark.slow
def test_labels_name_controllers_everywhere(tmp_path, monkeypatch):
    """On the page, in its figures and the summary, in LaTeX; and the reason of a run that has not
    settled is said.
    """
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "labelled_law.py").write_text(MINE)
    names, label = ["labelled_law:Idle", "tdc"], "Idle <3>"
    spec = write_spec(tmp_path / "s.yaml", **LABELLED, controllers=names, labels={names[0]: label})
    assert load_spec(spec).label("tdc") == "TDC"
    path = run_here(spec, tmp_path / "x.db")
    with open_store(path) as store:
        rows = [store.result(case, name) for case in range(2) for name in names]
        assert {row["outcome"] for row in rows} == {"not_settled"}
        for row in rows:
            assert re.fullmatch(
                r"\S+: up to \S+ (rad|m) in the last 0.1 s, tolerance \S+", row["message"]
            )
        written = write_report(store, tmp_path / "page")
        assert label in written.summary
        assert label in status_text(store)
    assert written.table[0].cells == [label, "TDC"]
    page = (tmp_path / "page/report.html").read_text()
    shown, figures = page.split('id="figures">')[0], Page(page).script("figures")
    assert "labelled_law:Idle" not in re.sub(
        "<code>.*?</code>|<pre.*?</pre>", "", shown, flags=re.S
    )
    assert "Idle &lt;3&gt;" in shown
    assert "labelled_law" not in figures
    assert not re.search(r"<td>[^<]*\de[-+]\d", page)  # numbers of one form
    with pytest.raises(CampaignError, match="labels: must give controllers of this campaign"):
        load_spec(write_spec(tmp_path / "s.yaml", **LABELLED, labels={"other": "x"}))
    with pytest.raises(CampaignError, match="labels: controllers share a name in tables"):
        load_spec(write_spec(tmp_path / "s.yaml", **LABELLED, labels={"tdc": "ASMC"}))


@pytest.mark.slow
def test_a_plan_is_timed_by_runs_that_reach_their_end(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "planned_law.py").write_text(MINE)
    names = ["planned_law:Failing", "tdc"]
    spec = load_spec(write_spec(tmp_path / "s.yaml", **LABELLED, controllers=names))
    lines = plan_text(spec, workers=1).splitlines()
    assert lines[-2].startswith("case 1 with Failing: error: ")
    assert lines[-1] == (
        "planned_law:Failing: none of 2 cases reached its end, so a run that does takes longer"
    )


@pytest.mark.slow
def test_the_boundary_has_a_budget_and_comes_after_the_page(database, tmp_path, monkeypatch):
    """Points found within any budget are kept; enough of them make the whole boundary."""
    monkeypatch.setattr(prediction, "POINTS", 2)
    value, pages = iter(np.linspace(0.5, 1.5, 400)), []

    def predict(scenario):
        pages.append((tmp_path / "page/report.html").exists())
        time.sleep(0.02)
        return (next(value),)

    monkeypatch.setattr(prediction, "predict", predict)
    with open_store(database) as store:
        for (key,) in list(store.query("SELECT key FROM campaign WHERE key LIKE 'points %'")):
            store.keep(key, "{}")
        write_report(store, tmp_path / "page")
        assert not pages  # no prediction without the option
        assert "is not computed:" in " ".join((tmp_path / "page/report.html").read_text().split())
        rounds = 0
        while not find(store, boundary=0.0).map.whole:
            before = len(pages)
            write_report(store, tmp_path / "page", boundary=0.1)
            assert len(pages) > before
            rounds += 1
        assert rounds > 1
        assert all(pages)
        points = len(pages)
        write_report(store, tmp_path / "page", boundary=5.0)
        assert len(pages) == points
    assert "Shaded:" in (tmp_path / "page/report.html").read_text()


def test_a_report_while_the_campaign_runs(database, tmp_path):
    """Another connection writes between any two reads: the page and the table agree."""
    path = tmp_path / "running.db"
    shutil.copy(database, path)
    with open_store(path, writing=True), open_store(path) as store:
        with store.snapshot():
            before = store.num_results()
            sql(path, "DELETE FROM results WHERE case_index > 3")
            assert store.num_results() == before
        assert store.num_results() < before
        written = write_report(store, tmp_path / "page")
    assert "The campaign is not finished" in (tmp_path / "page/report.html").read_text()
    lines = (tmp_path / "page/runs.csv").read_text().count("\n") - 1
    assert f"{lines} of {before} runs stored" in (tmp_path / "page/report.html").read_text()
    assert written.files[0].exists()


def test_the_report_is_one_page_that_needs_nothing_else(database, tmp_path, monkeypatch):
    monkeypatch.setattr("ffsm_drake.plugins.campaign.prediction.POINTS", 2)
    words = f"report {database} --out {tmp_path} --map nominal_error payload.truth.mass"
    result = invoke(*words.split(), "--table", tmp_path / "table.tex")
    assert result.exit_code == 0, result.output
    table = (tmp_path / "table.tex").read_text()
    assert "TDC & $12$ & $83.3$ & $51.6$ & $97.9$" in table
    assert re.search(r"predicted unstable +\d+ +[1-9]", result.output)
    page = (tmp_path / "report.html").read_text()
    read = Page(page)
    assert read.addresses == []
    assert "with &lt;angle&gt; brackets &amp; &lt;/script&gt;" in page
    figures = read.figures
    assert {key.split("-")[0] for key in figures} == {
        "success",
        "accuracy",
        "difference",
        "map",
    }
    assert "No sampled value explains more of it than chance would" in page  # in 12 cases
    assert set(read.captions) == set(figures)
    assert all(figure["data"] for figure in figures.values())
    assert len(re.findall(r"plotly\.js v\d", page)) == 1
    assert (tmp_path / "runs.csv").read_text().count("\n") == 25
    assert f"ffsm campaign rerun {shlex.quote(str(database))} --case" in page
    report = f"ffsm campaign report {shlex.quote(str(database))} --boundary 300 --map nominal_error"
    assert f"<code>{report} payload.truth.mass</code> goes on." in page
    assert "Every controller ran the same cases." in page
    assert "rad or m (joints)" in page


def test_one_controller_is_not_said_to_run_the_same_cases(tmp_path):
    spec = write_spec(tmp_path / "one.yaml", cases=1, controllers=["tdc"])
    with open_store(run_here(spec, tmp_path / "one.db")) as store:
        write_report(store, tmp_path / "page")
    page = (tmp_path / "page/report.html").read_text()
    assert "each with\nTDC." in page
    assert "the same cases" not in page


def test_what_drives_failure_is_said_where_the_data_say_so(database, tmp_path, monkeypatch):
    monkeypatch.setattr("ffsm_drake.plugins.campaign.prediction.POINTS", 1)
    monkeypatch.setattr("ffsm_drake.plugins.campaign.statistics.BINS", 3)  # enough cases for three
    with open_store(database) as store:
        findings = find(store)
        write_report(store, tmp_path / "page")
    matter = {item.name for item in findings.sensitivities.itertuples() if item.matters}
    assert "nominal_error" in matter
    assert set(findings.drivers) == matter != set(findings.influential)
    page = (tmp_path / "page/report.html").read_text()
    section = page.split("<h2>What drives failure</h2>")[1].split("<h2>")[0]
    assert {name for name in findings.influential if f">{name}</td>" in section} == matter


@pytest.mark.long
def test_every_step_that_takes_time_has_a_name(tmp_path):
    """Also which case, run or point of how many."""
    with steps_seen() as seen:
        path = run_here(write_spec(tmp_path / "small.yaml", cases=6), tmp_path / "small.db")
        with open_store(path) as store:
            write_report(store, tmp_path / "report", boundary=60.0)
    assert seen[""] < 0.25 * seen.total(), seen
    for name in (
        "building case 0 with ",
        r"\d+ of 12 runs",
        r"computing the stability map \((tdc|asmc), controller [12] of 2: point \d+ of at most \d+",
        "drawing the page",
    ):
        assert any(re.match(name, each) for each in seen), (name, seen)


def test_a_report_of_nothing(database, tmp_path):
    path = tmp_path / "empty.db"
    path.write_bytes(database.read_bytes())
    sql(path, "DELETE FROM results")
    result = invoke("report", path)
    assert result.exit_code == 2
    assert "holds no result yet; wait for the first runs" in result.output
    assert f"'ffsm campaign resume {path}'" in result.output
