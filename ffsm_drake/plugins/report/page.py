"""The page: gathers results, panels, findings, stability and provenance of the runs, and renders
them as one file.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from ffsm_drake.common.errors import RecordError
from ffsm_drake.common.files import write_text
from ffsm_drake.common.registrations import Registry
from ffsm_drake.common.steps import step
from ffsm_drake.plugins.report.comparison import rankings, table, table_notes
from ffsm_drake.plugins.report.part_panels import part_sections, part_tables, part_text, part_views
from ffsm_drake.plugins.report.provenance import provenance, software
from ffsm_drake.plugins.report.time_panels import run_views
from ffsm_drake.runs.ending import (
    DIVERGED,
    FAILED,
    GROWING,
    INTERRUPTED,
    NOT_CAPTURED,
    NOT_SETTLED,
    SETTLED,
    SETTLED_OVER,
)
from ffsm_drake.runs.exceeded_limits import broken_limits, run_remarks
from ffsm_drake.runs.judge import JUDGES
from ffsm_drake.runs.reading import IDENTIFIER
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import Scenario
from ffsm_drake.show.chart import Curve
from ffsm_drake.show.page import Section, lines_of, render
from ffsm_drake.show.results import Result, attempt, results_of
from ffsm_drake.show.style import GROUP_TITLES

_STATUS_TONES = {
    SETTLED: "good",
    NOT_SETTLED: "warn",
    INTERRUPTED: "warn",
    GROWING: "bad",
    **dict.fromkeys(NOT_CAPTURED, "bad"),
    DIVERGED: "bad",
    FAILED: "bad",
}
# Section key -> title, text, and the sentence for records without data for it.
_SECTIONS = {
    "motion": (
        "Motion",
        "Attitude of the base, its position, and the joints; the reference dotted.",
        "The records hold no motion.",
    ),
    "end_effector": (
        "End effector",
        "Path of the end effector, and its distance from the reference. Drag to turn, scroll "
        "to zoom.",
        "The records hold no path of the end effector.",
    ),
    "error": (
        "Tracking error",
        "Reference minus truth, e = q_d - q, by coordinate.",
        "The records hold no errors.",
    ),
    "force": (
        "Forces and torques",
        "Commanded forces of base and joints, and the disturbance.",
        "The records hold no forces.",
    ),
    "sliding": (
        "Sliding variable and gains",
        "The sliding variable s, and the gains K_s and G where the controller adapts them.",
        "These controllers record no sliding variable and no adaptive gains.",
    ),
}


class ReportSection(Protocol):
    """Makes a section of the report of some runs; None: the section has no content."""

    def __call__(self, results: Sequence[Result]) -> Section | None: ...


REPORT_SECTIONS = Registry[ReportSection]("report_sections")
_FROM_PLUGINS = ("grasp", "findings", "stability")  # in this order

Json = dict[str, Any]


@step("writing the report")
def write_report(
    records: Sequence[RunRecord],
    path: Path,
    *,
    title: str | None = None,
    recording: str | None = None,
    distances: Sequence[float] | None = None,
) -> Path:
    """Write one self-contained HTML page about one or several runs; it opens from disk, without a
    network.

    A section that does not apply to a run contains a note. The same records give the same bytes.
    Returns the path.

    Args:
      records: the runs to show and compare, in the order of the table's columns.
      path: the file to write.
      title: the page's heading; default: the scenario's description.
      recording: the text of a self-contained Meshcat page, to be played within this one.
      distances: each run's controller's distance to the LQG limit (service ``lqg_limit``), for
        the table.

    Raises:
      RecordError: there is no record, or the file cannot be written.
    """
    path = Path(path)
    if not records:
        raise RecordError(f"{path}: a report needs at least one record, none was given")
    page = render_report(
        records, folder=path.parent, title=title, recording=recording, distances=distances
    )
    write_text(path, page)
    return path


def render_report(
    records: Sequence[RunRecord],
    *,
    folder: Path = Path(),
    title: str | None = None,
    recording: str | None = None,
    distances: Sequence[float] | None = None,
) -> str:
    """The page of ``write_report`` as text; ``records`` holds at least one, and paths start at
    ``folder``.
    """
    results = results_of(records)
    given = _given(results)
    views = run_views(results)
    of_parts = {
        f"part_{re.sub(r'[^a-z0-9]+', '_', title.lower())}": (title, part.about)
        for title, part in part_sections(results).items()
    }
    views |= {key: part_views(results, title) for key, (title, _) in of_parts.items()}
    views |= {name: list(section.views) for name, section in given.items()}
    sections = _SECTIONS | {
        key: (heading, part_text(results, heading, about), "")
        for key, (heading, about) in of_parts.items()
    }
    content: Json = {
        **_heading(records, title),
        "results": results,
        "summary": _summary(results),
        "remarks": [_remarks(result, folder) for result in results],
        "settled_rule": _settled_rule(records[0].scenario),
        "table": table(results, distances),
        "table_notes": table_notes(results, distances),
        "rankings": rankings(results) if len(results) > 1 else [],
        "recording": recording,
        "sections": [
            {"key": key, "title": heading, "text": text if key in views else nothing}
            for key, (heading, text, nothing) in sections.items()
        ],
        "part_tables": {
            key: part_tables(results, heading) for key, (heading, _) in of_parts.items()
        },
        "given": given,
        "thinning": _thinning(*lines_of(views)),
        "provenance": provenance(results, folder),
        "software": software(records),
        "tones": _STATUS_TONES,
    }
    package = "ffsm_drake.plugins.report"
    return render("report.html.j2", content, package=package, views=views)


def _given(results: Sequence[Result]) -> dict[str, Section]:
    """The sections of plug-ins that have something to show, by name."""
    return {
        name: section
        for name in _FROM_PLUGINS
        if (make := REPORT_SECTIONS.find(name)) is not None
        and (section := make(results)) is not None
    }


def _heading(records: Sequence[RunRecord], title: str | None) -> Json:
    """Titles of the page, and which records it shows."""
    descriptions = list(dict.fromkeys(record.scenario.description for record in records))
    named = title or len(descriptions) > 1
    return {
        "title": title or descriptions[0] or "Run report",
        "kicker": "; ".join(descriptions) if named else "free-flying space manipulator",
        "identifier": IDENTIFIER,
        "shown": [
            (record.scenario.controller_key, record.identifier)
            for record in records
            if record.identifier
        ],
        "version": records[0].software.get("ffsm-drake", ""),
    }


def _settled_rule(scenario: Scenario) -> str:
    within = dict.fromkeys(
        f"{1e3 * scenario.tolerance_of(group):g} m{'m' if group == 'base_position' else 'rad'}"
        for group in GROUP_TITLES
    )
    return (
        f"Settled means: over the last {SETTLED_OVER:g} s every error stays within "
        f"{' and '.join(within)}."
    )


def _summary(results: Sequence[Result]) -> str:
    if len(results) == 1:
        return f"One run of {results[0].label}, {results[0].record.outcome.time:g} s of flight."
    counted = {
        status: sum(result.status == status for result in results) for status in _STATUS_TONES
    }
    return f"{len(results)} runs compared: {_tally(counted)}."


def _remarks(result: Result, folder: Path) -> Json:
    """Limits exceeded in a run; what its parts say (modes of the supervisor, noticed faults); its
    warnings; remedies for a failed run or saturated actuators, and the first of them as a file.
    """
    record = result.record
    if not record.dataset.sizes.get("time", 0):
        return {"broken": [], "said": []}
    broken, _ = attempt("limits", result, broken_limits, record.mission, record.dataset)
    lines: list[str | None] = [part.sentence for part in record.parts]
    lines += attempt("warnings", result, run_remarks, record)[0] or ()
    judge = JUDGES.first()
    if judge and (helps := attempt("advice", result, judge.advice, record)[0]):
        lines += helps
        if file := attempt("remedy", result, judge.remedy, record, folder)[0]:
            lines.append(f"a changed scenario is in {file}; run it with: ffsm run {file}")
    said = dict.fromkeys(line for line in lines if line and line not in (broken or ()))
    return {"broken": broken or [], "said": [f"{_begun(line)}." for line in said]}


def _begun(line: str) -> str:
    """A line with a capital, unless it begins with a name."""
    begins = line.partition(" ")[0].rstrip(":").isalpha()
    return f"{line[:1].upper()}{line[1:]}" if begins else line


def _tally(counted: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {word}" for word, count in counted.items() if count)


def _thinning(lines: Sequence[Curve], points: int) -> str:
    longest = max((line.x.size for line in lines), default=0)
    if longest <= points:
        return "The plots show every control sample."
    return (
        f"Curves of more than {points} samples are thinned for display (the longest has "
        f"{longest}). The smallest and the largest value of each short interval are drawn, so "
        "all peaks remain. The numbers on this page are computed from all samples."
    )
