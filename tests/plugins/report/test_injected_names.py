"""Names and texts of a user that are markup, script, templates, or of no end, on every page."""

import dataclasses
import html
import re

import pytest
from browser import answer_of, needs_chromium
from click.testing import CliRunner
from html_page import Page
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.plugins.meshcat.recording import recording_html
from ffsm_drake.plugins.report.page import render_report

campaign_tools = pytest.importorskip("campaign_tools")
run_here, write_spec = campaign_tools.run_here, campaign_tools.write_spec
campaign = pytest.importorskip("ffsm_drake.plugins.campaign.command").campaign

TAKEN = "document['title']='taken'"
PIECES = (
    f"</script><script>{TAKEN}</script>", f'<img src=x onerror="{TAKEN}">', "</title>", "</pre>",
    f"<svg/onload={TAKEN}>", f'<a href="javascript:{TAKEN}">x</a>', f"';{TAKEN};//", "\\",
    f"${{{TAKEN}}}", "{{ 7 * 7 }}", "{% raw %}", "{0} {x}", "%s%n", "<!--", "-->", "]]>", "&lt;",
    '"', "'", "`", "\n", "\r", "\t", "\u202e", "\u2028", "\u05d0\u05d1", "\U0001f680", "x" * 900,
)  # fmt: skip
NAMES = st.lists(st.sampled_from(PIECES) | st.text(max_size=8), min_size=1, max_size=6).map("".join)
EVERYTHING = "".join(PIECES)
quick = settings(
    deadline=None, suppress_health_check=list(HealthCheck), max_examples=3, phases=[Phase.generate]
)


def safe_page(text):
    """The page, none of whose elements reacts to an event."""
    page = Page(text)
    assert not [name for _, attributes in page.tags for name in attributes if name[:2] == "on"]
    return page


def run_page(record, name):
    """A run's report with a name wherever a user may have put it."""
    coordinates = record.dataset["coordinate"].values.tolist()
    record = dataclasses.replace(
        record,
        scenario=dataclasses.replace(record.scenario, description=name, controller=name),
        outcome=dataclasses.replace(record.outcome, message=name),
        dataset=record.dataset.assign_coords(coordinate=[*coordinates[:7], name, *coordinates[8:]]),
    )
    return render_report([record], recording=name)


def campaign_page(folder, name, factor):
    """The report of a campaign with a description, and a factor's name."""
    folder.mkdir(exist_ok=True)
    (folder / "c.db").unlink(missing_ok=True)
    spec = write_spec(
        folder / "spec.yaml",
        description=name,
        cases=2,
        controllers=["tdc"],
        overrides={"duration": 0.02, "description": as_factor(name)},
        factors={factor: {"distribution": "uniform", "low": -0.5, "high": 0.2}},
        derive={
            "payload.nominal.mass": {
                "rule": "relative",
                "of": "payload.truth.mass",
                "error": factor,
            }
        },
    )
    run_here(spec, folder / "c.db")
    out = folder / "out"
    done = CliRunner().invoke(campaign, ["report", str(folder / "c.db"), "--out", str(out)])
    assert done.exit_code == 0, (done.output, done.exception)
    return (out / "report.html").read_text(encoding="utf-8")


def as_factor(name):
    """The part of a name that a specification takes for a factor."""
    return "factor" + "".join(each for each in name if each.isprintable() and each != ".")


@pytest.fixture
def no_analysis(monkeypatch):
    """Leave out what costs seconds and shows no names."""

    def absent(_):
        raise FfsmError("left out")

    for name in ("analysis.page.analyze", "design.panels.stability"):
        monkeypatch.setattr(f"ffsm_drake.plugins.{name}", absent)


@pytest.fixture
def short(run):
    return run("postcapture", "duration=0.05")


@pytest.mark.slow
@pytest.mark.usefixtures("no_analysis")
@quick
@given(NAMES)
def test_a_run_s_page_has_no_element_more(short, name):
    plain, page = (safe_page(run_page(short, each)) for each in ("harmless", name))
    assert page.names == plain.names
    assert page.figures
    frames = [attributes for tag, attributes in page.tags if tag == "iframe"]
    shown = [(frame["srcdoc"], frame["sandbox"]) for frame in frames]
    assert shown == [(name, "allow-scripts")] * bool(name)


@pytest.fixture
def coarse_map(monkeypatch):
    monkeypatch.setattr("ffsm_drake.plugins.campaign.prediction.POINTS", 3)
    monkeypatch.setattr("ffsm_drake.plugins.campaign.prediction.REFINEMENT", 2)


@pytest.mark.long
@pytest.mark.usefixtures("rough_pictures", "coarse_map")
@quick
@given(NAMES, NAMES.map(as_factor))
def test_a_campaign_s_page_has_no_element_more(tmp_path_factory, name, factor):
    folder = tmp_path_factory.mktemp("campaign")
    plain, page = (
        safe_page(campaign_page(folder, *each))
        for each in (("harmless", "harmless"), (name, factor))
    )
    assert page.names == plain.names
    assert page.figures


def test_a_recording_s_caption_is_text(short):
    record = dataclasses.replace(
        short,
        scenario=dataclasses.replace(short.scenario, description=EVERYTHING, controller=EVERYTHING),
    )
    page = recording_html(record, ghost=False, path=False)
    caption = re.search(r'<div id="caption">(.*?)</div>', page, re.DOTALL)[1]
    assert set(re.findall(r"<.*?>", caption)) == {"<b>", "</b>", "<br>"}
    assert html.unescape(caption).count(TAKEN) == 2 * EVERYTHING.count(TAKEN)


@pytest.mark.long
@needs_chromium
@pytest.mark.usefixtures("no_analysis", "coarse_map")
def test_no_name_runs_in_a_browser(short, tmp_path):
    pages = {
        "run": run_page(short, EVERYTHING),
        "campaign": campaign_page(tmp_path / "campaign", EVERYTHING, as_factor(EVERYTHING)),
    }
    for name, text in pages.items():
        folder = tmp_path / f"browser_{name}"
        folder.mkdir()
        script = (
            'await until(() => document.getElementsByClassName("js-plotly-plot").length > 0);'
            "return [document.title, document.lastElementChild.tagName];"
        )
        (title, last), _ = answer_of(text, script, folder, "--window-size=1400,9000")
        assert title != "taken"
        assert last == "HTML"
