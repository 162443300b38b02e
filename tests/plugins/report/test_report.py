# ruff: noqa: RUF001 (the page uses mathematical signs)
"""The run report: its numbers, its honesty about runs that did not go well, its safety, and that it
draws.
"""

import base64
import dataclasses
import html
import math
import re
import shlex

import numpy as np
import pytest
from browser import answer_of, needs_chromium
from html_page import Page

from ffsm_drake import FfsmError, RunRecord, load_scenario, simulate
from ffsm_drake.common.numbers import number
from ffsm_drake.plugins.report import comparison, write_report
from ffsm_drake.plugins.report.page import render_report
from ffsm_drake.runs.log import Outcome
from ffsm_drake.runs.metrics import METRICS, itae_of
from ffsm_drake.scenario import scenario_from_dict, scenario_from_yaml, scenario_to_dict
from ffsm_drake.show.curves import thinned
from ffsm_drake.show.results import ranking, results_of
from ffsm_drake.show.style import label_of, labels_of, styles_of
from ffsm_drake.systems.parts.metrics import Metric
from ffsm_drake.systems.parts.record import PartRecord

HOSTILE = (
    "</script><script>document.title='taken'</script><img src=x onerror=alert(1)> & "
    '"quotes" </title>'
)


def page_of(*records, **options):
    return Page(render_report(records, **options))


def shortened(record, samples, status="interrupted"):
    """A record that ended after so many samples."""
    dataset = record.dataset.isel(time=slice(0, samples))
    time = float(dataset["time"].values[-1]) if samples else 0.0
    outcome = Outcome(status=status, time=time, message=f"{status} at t = {time:.2f} s")
    return dataclasses.replace(record, dataset=dataset, outcome=outcome)


def with_scenario(record, **changes):
    return dataclasses.replace(record, scenario=dataclasses.replace(record.scenario, **changes))


@pytest.fixture(scope="module")
def short(run):
    return run("postcapture", "duration=1", "reference.duration=1")


def absent(_):
    raise FfsmError("left out")


@pytest.fixture
def without_stability(monkeypatch):
    """Leave out the stability map, which costs seconds and is not what the test is about."""
    monkeypatch.setattr("ffsm_drake.plugins.design.panels.stability", absent)


@pytest.fixture
def plain(monkeypatch, without_stability, no_remedies):
    """Leave out the analysis too."""
    monkeypatch.setattr("ffsm_drake.plugins.analysis.page.analyze", absent)


@pytest.fixture(scope="module")
def diverged(run):
    return run(
        "postcapture",
        "duration=6",
        "controllers.tde_aismc.k_s_initial=80",
        "controllers.tde_aismc.k_s_max=null",
    )


def table_rows(text):
    """Row label -> cells of the result table, labels of groups with their heading in front."""
    table = re.search(r"<table class=\"numbers.*?</table>", text, re.DOTALL).group()
    rows, head = {}, ""
    for row in re.findall(r"<tr.*?</tr>", table, re.DOTALL):
        strip = [
            html.unescape(re.sub("<[^>]*>", "", cell)).strip()
            for cell in re.findall(r"<t[hd].*?</t[hd]>", row)
        ]
        if 'class="head"' in row:
            head = strip[0]
        else:
            rows[f"{head}: {strip[0]}" if head else strip[0]] = strip[1:]
    return rows


def value(text):
    """The number that ``number`` wrote."""
    digits = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    mantissa, _, power = text.partition("×10")
    return float(mantissa) * 10.0 ** int(power.translate(digits) or 0)


@pytest.fixture(scope="module")
def text(short, tmp_path_factory):
    """The whole page of a run that went well."""
    short.save(tmp_path_factory.mktemp("text"))  # gives it the identifier that the page carries
    return render_report([short])


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


@pytest.mark.slow
def test_table_holds_the_metrics(short, text):
    rows = table_rows(text)
    metrics = short.metrics
    assert value(rows["Accuracy, ITAE"][0]) == pytest.approx(metrics["itae"], rel=5e-4)
    assert value(rows["Effort, ISV"][0]) == pytest.approx(metrics["isv"], rel=5e-5)
    heads = {
        "peak_error": "Peak error",
        "final_error": "Final error",
        "peak_effort": "Peak commanded force or torque",
    }
    units = {"base_rotation": ("rad", "N m"), "base_position": ("m", "N"), "joints": ("rad", "N m")}
    titles = {
        "base_rotation": "Base attitude",
        "base_position": "Base position",
        "joints": "Joints",
    }
    for key, head in heads.items():
        for group, title in titles.items():
            label = f"{head}: {title} [{units[group][key == 'peak_effort']}]"
            assert value(rows[label][0]) == pytest.approx(metrics[key][group], rel=5e-4), label


ADDED = (
    Metric(key="speed", unit="rad/s", label="largest speed", of=lambda run: 0.25),
    Metric(key="mass", unit="kg", label="mass", shown="g", factor=1e3, of=lambda run: 0.002),
    Metric(key="jerk", unit="1", label="jerk", ranked=True, of=lambda run: 3.0),
    Metric(key="gone", unit="1", label="gone", of=lambda run: run["no such variable"]),
    Metric(key="hidden", unit="1", of=lambda run: 5.0),  # without a label, it has no row
)
ROWS = {"Largest speed": "0.2500 rad/s", "Mass": "2.000 g", "Jerk": "3.000 ", "Gone": "– "}


def test_a_new_metric_is_in_the_table_without_a_further_edit(short, monkeypatch):
    monkeypatch.setattr(comparison, "METRICS", (*METRICS, *ADDED))
    results = results_of([short, short])
    rows = {row.label: f"{row.cells[0].text} {row.unit}" for row in comparison.table(results)}
    assert ROWS.items() <= rows.items()
    assert "hidden" not in str(rows).lower()
    titles = [each["title"] for each in comparison.rankings(results)]
    assert titles[:3] == ["By accuracy (ITAE)", "By effort (ISV)", "By jerk"]


@pytest.mark.smoke
def test_numbers_as_text():
    assert [number(x) for x in (0.0, 12.3456, 9.99996, 1.23456e-7, -4.5e9, math.nan, math.inf)] == [
        "0", "12.35", "10.00", "1.235×10⁻⁷", "-4.500×10⁹", "–", "–",
    ]  # fmt: skip


@pytest.mark.long
@pytest.mark.usefixtures("plain")
def test_verdicts_in_words(short, diverged):
    assert results_of([short])[0].status == "settled"
    # A run that ends in the middle of the motion has not settled, however well it tracks.
    assert (
        results_of([with_scenario(short, reference=load_scenario("postcapture").reference)])[
            0
        ].status
        == "not settled"
    )
    off = short.dataset.copy(deep=True)
    off["error"].loc[{"coordinate": "joint_2"}] = 0.0021
    result = results_of([dataclasses.replace(short, dataset=off)])[0]
    assert result.status == "not settled"
    assert "the error of joint_2 reaches 0.00210 rad" in result.verdict
    lenient = with_scenario(
        dataclasses.replace(short, dataset=off), tolerance={"all": 1e-3, "joint_2": 0.003}
    )
    assert results_of([lenient])[0].status == "settled"
    assert diverged.outcome.message in page_of(diverged).text


@pytest.mark.long
@pytest.mark.usefixtures("plain")
def test_diverged_runs_rank_last_and_never_best(short, diverged):
    # A run that diverges at once has the smallest sums of all.
    early = shortened(diverged, 3, status="diverged")
    stopped = shortened(short, 5)
    results = results_of([early, stopped, short])
    sums = [result.figure(itae_of) for result in results]
    assert min(sums) == sums[0]
    for figure in ("itae", "isv"):
        order = ranking(results, lambda result, figure=figure: getattr(result, figure))
        assert [result.record for result in order] == [short, stopped, early]
    text = render_report([early, stopped, short])
    assert len(re.findall(r"plotly\.js v\d", text)) == 1  # however many runs
    assert 'class="best"' not in text  # one completed run is no contest
    assert text.count("diverged at 0.02 s</span>") == 2
    # Both panels and sums say that they belong to a run that ended early.
    assert "In italics" in text
    shown = page_of(early, short).figures["error-1-0"]["layout"]["yaxis"]["range"]
    largest = np.abs(short.dataset["error"].values[:, 0]).max()
    assert shown[1] <= 1.2 * largest


@pytest.mark.parametrize("samples", [0, 1, 2])
def test_interrupted_after_few_samples(short, samples, monkeypatch):
    if samples:  # on which stability does not depend
        monkeypatch.setattr("ffsm_drake.plugins.design.panels.stability", absent)
    page = page_of(shortened(short, samples))
    assert "interrupted" in page.text
    assert {0: "no sample was recorded", 1: "1 sample was", 2: "2 samples were"}[
        samples
    ] in page.text
    if samples == 0:
        assert "The record has no sample to analyse." in page.text
        assert "error-0-0" not in page.figures
    assert "Stability" in page.text
    assert "Base attitude" in page.text


@pytest.mark.usefixtures("without_stability")
def test_missing_variables_cost_only_their_section(short):
    bare = dataclasses.replace(
        short, dataset=short.dataset.drop_vars(["disturbance_force", "error", "base_rpy"])
    )
    text = render_report([bare])
    page, rows = Page(text), table_rows(text)
    assert rows["Accuracy, ITAE"] == ["–"]
    assert value(rows["Effort, ISV"][0]) == pytest.approx(short.metrics["isv"], rel=5e-5)
    assert "error-0-0" not in page.figures
    assert "force-0-0" in page.figures
    assert "force-1-0" not in page.figures  # no disturbance
    assert "The records hold no errors." in page.text
    assert re.search(r"The analysis is not available for this run: there is no '\w+'\.", page.text)


@pytest.mark.slow
def test_a_user_supplied_controller_gets_its_report(short):
    page = page_of(with_scenario(short, controller="lab:MyLqr"), short)
    assert "MyLqr" in page.text
    assert "the stability of the loop is not available" in page.text
    assert "error-0-0" in page.figures
    names = [label_of(name) for name in ("tdc", "lab:MyLqr", "mine")]
    assert names == ["TDC", "MyLqr", "mine"]
    styles = styles_of(["tdc", "lab:MyLqr", "mine", "tdc"])
    assert len({style.color for style in styles}) == 4
    assert all(style.matplotlib["linestyle"] and style.css for style in styles)


def test_failing_sections_leave_the_rest(short, monkeypatch):
    def fail(_):
        raise FfsmError("controller: has no margins; choose another")

    for name in ("analysis.page.analyze", "design.panels.stability"):
        monkeypatch.setattr(f"ffsm_drake.plugins.{name}", fail)
    page = page_of(short)
    assert page.text.count("controller: has no margins; choose another.") == 2
    assert "ITAE" in page.text


@pytest.mark.usefixtures("plain")
def test_what_concerns_the_verdict_stands_beside_it(short, monkeypatch):
    """Warnings, and what the parts say, once each and before the results."""
    sentence = "supervisor: nominal 0.6 s, damping 0.4 s"
    part = PartRecord(
        title="Supervisor", section="Supervisor", about="Its modes.", sentence=sentence, table=(),
        figures=(), drawings=(),
    )  # fmt: skip
    monkeypatch.setattr("ffsm_drake.plugins.report.page.run_remarks", lambda _: ["wheel_x: stuck"])
    text = render_report([dataclasses.replace(short, parts=(part,))])
    first, _, rest = text.partition('id="results"')
    for line in ("Supervisor: nominal 0.6 s, damping 0.4 s.", "wheel_x: stuck."):
        assert f"<li>{line}</li>" in first
        assert line not in rest


def test_no_record_is_an_error_of_one_line(tmp_path):
    with pytest.raises(FfsmError, match=r"report\.html: a report needs at least one record"):
        write_report([], tmp_path / "report.html")


@pytest.mark.usefixtures("plain")
@pytest.mark.smoke
def test_loads_nothing_from_elsewhere(short):
    page = page_of(short, recording="<!DOCTYPE html><script>let a = '<\\/script>'</script>")
    assert all(address.startswith("#") for address in page.addresses)
    style = next(text for _, text in page.scripts)
    assert "@import" not in style
    assert "url(" not in style


@pytest.mark.slow
def test_same_records_same_bytes(short, text, tmp_path):
    short.save(tmp_path / "run")
    written = write_report([RunRecord.load(tmp_path / "run")], tmp_path / "report.html")
    assert written.read_text(encoding="utf-8") == text


def test_same_controller_twice_is_told_apart(short):
    other = with_scenario(short, random_seed=7)
    assert [label.rpartition(", ")[2] for label in labels_of([short, other])] == [
        "random_seed = 0",
        "random_seed = 7",
    ]
    assert len({result.style.color for result in results_of([short, other, short])}) == 3
    assert len(set(labels_of([short, short, other]))) == 3
    gains = scenario_from_dict(
        scenario_to_dict(short.scenario), ["controllers.tde_aismc.k_s_max.all=65"]
    )
    assert labels_of([short, dataclasses.replace(short, scenario=gains)])[1] == (
        "TDE-AISMC (proposed), k_s_max = 65"
    )


def write_arm(directory, joints):
    """A base with an arm of so many links, every other joint prismatic; names as no program likes
    them.
    """
    inertial = (
        '<inertial><mass value="{0}"/><inertia ixx="{0}" iyy="{0}" izz="{0}" ixy="0" ixz="0" '
        'iyz="0"/></inertial>'
    )
    parts = [f'<link name="link_0">{inertial.format(400)}</link>']
    for k in range(joints):
        kind = ("revolute", "prismatic")[k % 2]
        parts.append(
            f'<link name="link_{k + 1}">{inertial.format(5)}</link>'
            f'<joint name="Gelenk &lt;{k}&gt; é" type="{kind}"><parent link="link_{k}"/><child '
            f'link="link_{k + 1}"/>'
            f'<origin xyz="0 0 0.3"/><axis xyz="{k % 3 == 0:d} {k % 3 == 1:d} {k % 3 == 2:d}"/>'
            '<limit lower="-3" upper="3" effort="1e9" velocity="1e9"/></joint>'
        )
    (directory / "arm.urdf").write_text(f'<robot name="arm">{"".join(parts)}</robot>')
    (directory / "arm.dmd.yaml").write_text(
        f"directives:\n- add_model: {{name: arm, file: 'file://{directory}/arm.urdf'}}\n"
    )
    (directory / "arm.yaml").write_text(
        "duration: 0.2\nreference: {duration: 0.2}\ncontroller: tdc\nmodel: {directives: "
        "arm.dmd.yaml, end_effector: "
        f"'arm::link_{joints}'}}\npayload: {{body: 'arm::link_{joints}'}}\n"
    )
    return directory / "arm.yaml"


@pytest.mark.parametrize("joints", [1, 12])
def test_any_arm(joints, tmp_path):
    record = simulate(load_scenario(write_arm(tmp_path, joints)), check_stability=False)
    page = page_of(record)
    assert page.titles("force-0")[6:] == [f"Gelenk <{k}> é" for k in range(joints)]
    units = [
        page.figures[f"force-0-{k}"]["layout"]["yaxis"]["title"]["text"]
        for k in range(6, 6 + joints)
    ]
    assert units == [("N m", "N")[k % 2] for k in range(joints)]
    assert ("Joints, prismatic" in page.text) == (joints > 1)
    assert "not available" not in page.text


def test_thinning_keeps_ends_and_extremes():
    rng = np.random.default_rng(1)
    values = rng.normal(size=100_003)
    values[[17, 99_999]] = 50.0, -60.0
    kept = thinned(values, 1000)
    assert len(kept) <= 1000
    assert {0, 17, 99_999, values.size - 1} <= set(kept.tolist())
    assert np.all(np.diff(kept) > 0)
    # No value is more than two pixels of a thousand from one that is drawn and at least as large,
    # or as small.
    for k in rng.integers(0, values.size, 300):
        near = values[kept[np.abs(kept - k) <= 2 * values.size // 1000]]
        assert near.min() <= values[k] <= near.max()
    assert thinned(values[:10], 1000).tolist() == list(range(10))


def decoded(array):
    """The numbers of an array as Plotly embeds them."""
    return np.frombuffer(base64.b64decode(array["bdata"]), dtype=f"<{array['dtype']}")


def test_curves_are_the_record(short, page):
    assert page.captions["error-0-7"] == "joint 2"
    x, y = (decoded(page.figures["error-0-7"]["data"][0][axis]) for axis in "xy")
    np.testing.assert_allclose(x, short.dataset["time"].values, rtol=1e-6)
    np.testing.assert_allclose(
        y, short.dataset["error"].sel(coordinate="joint_2").values, rtol=1e-6
    )


@pytest.mark.usefixtures("plain")
def test_long_runs_are_thinned_and_the_page_says_so(short):
    times = 60
    dataset = short.dataset.isel(time=np.tile(np.arange(100), times))
    dataset = dataset.assign_coords(
        time=("time", 0.01 * np.arange(100 * times), dataset["time"].attrs)
    )
    page = page_of(dataclasses.replace(short, dataset=dataset))
    assert "(the longest has 6000)" in page.text
    assert decoded(page.figures["error-0-0"]["data"][0]["y"]).size <= 4000


def test_command_and_scenario_make_the_same_run(short, text):
    command = html.unescape(
        re.search(
            r"<pre "
            r'class="command">(.*?)</pre>',
            text,
            re.DOTALL,
        ).group(1)
    )
    words = shlex.split(command)
    assert words[:3] == ["ffsm", "run", "postcapture"]
    overrides = [
        word for flag, word in zip(words[3::2], words[4::2], strict=True) if flag == "--set"
    ]
    assert scenario_to_dict(load_scenario("postcapture", overrides)) == scenario_to_dict(
        short.scenario
    )
    saved = re.search(r'href="data:application/yaml;base64,([^"]*)"', text).group(1)
    again = scenario_from_yaml(base64.b64decode(saved).decode())
    assert scenario_to_dict(again) == scenario_to_dict(short.scenario)


@pytest.mark.slow
@needs_chromium
def test_draws_in_a_browser_without_complaint(short, tmp_path):
    records = [with_scenario(short, description=HOSTILE), shortened(short, 1)]
    # Of each section the first view is in sight: of its panels all are drawn, one of them by WebGL.
    open_panels = sum(key.split("-")[1] == "0" for key in page_of(*records).figures)
    assert open_panels > 30
    page = write_report(records, tmp_path / "report.html").read_text(encoding="utf-8")
    answer, complaints = answer_of(
        page,
        "const count = (name) => document.getElementsByClassName(name).length;"
        f'await until(() => count("js-plotly-plot") >= {open_panels}'
        ' && count("scatterlayer") >= count("js-plotly-plot") - 1);'
        "return document.title;",
        tmp_path,
        "--window-size=1400,9000",
        "--force-device-scale-factor=0.25",
    )
    assert not [line for line in complaints if "willReadFrequently" not in line]
    assert "taken" not in answer.partition("<")[0]
