"""A report beside a record that it does not show is noticed."""

import json
import shlex
import warnings

import pytest
from click.testing import CliRunner

from ffsm_drake import RecordError, RunRecord
from ffsm_drake.cli import main
from ffsm_drake.plugins.report.page import render_report
from ffsm_drake.runs.reading import StaleReportWarning

SHORT = "--set duration=0.05"


def left_out(_):
    raise RecordError("left out")


@pytest.mark.slow
def test_a_report_of_another_run_is_noticed(tmp_path, run, monkeypatch):
    """One in the run's folder that was copied; that of a comparison above, whose runs were made
    anew one by one.
    """
    for section in ("analysis.page.analyze", "design.panels.stability"):  # cost most of it
        monkeypatch.setattr(f"ffsm_drake.plugins.{section}", left_out)
    records = [run("postcapture", "duration=0.1", f"controller={name}") for name in ("tdc", "asmc")]
    folders = [record.save(tmp_path / record.scenario.controller) for record in records]
    page = render_report(records[:1])
    assert f"SHA-256 of record.nc</dt><dd>{records[0].identifier}" in page.replace(
        "</dt>\n", "</dt>"
    )
    for folder in (tmp_path, folders[0]):
        (folder / "report.html").write_text(page)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = [RunRecord.load(folder) for folder in folders]
    for folder, record in zip(folders, loaded, strict=True):
        assert (
            record.identifier == json.loads((folder / "metrics.json").read_text())["record_sha256"]
        )
    (folders[1] / "report.html").write_text(page)
    with pytest.warns(
        StaleReportWarning,
        match=r"asmc/report.html shows another run than the "
        r"record.nc of .*asmc",
    ):
        RunRecord.load(folders[1])
    # removes its own report only
    run("postcapture", "duration=0.05", "controller=tdc").save(folders[0])
    with pytest.warns(StaleReportWarning) as told:
        RunRecord.load(folders[0])
    assert [str(item.message).partition(" shows")[0] for item in told] == [
        str(tmp_path / "report.html")
    ]
    CliRunner().invoke(
        main, shlex.split(f"compare -c tdc --no-report {SHORT} --out {shlex.quote(str(tmp_path))}")
    )
    assert not (tmp_path / "report.html").exists()
