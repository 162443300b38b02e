# ruff: noqa: RUF001 (the texts use mathematical signs)
"""The page: gathers results, plots, findings, stability and provenance of the runs, and renders them as one file."""

import base64
import dataclasses
import functools
import json
import math
import operator
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from ffsm_drake.analysis import Finding, analyze
from ffsm_drake.common.errors import FfsmError, RecordError, one_line
from ffsm_drake.common.files import write_text
from ffsm_drake.control_design.stability import Margins, stability
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import load_scenario, scenario_to_dict, shipped_scenarios
from ffsm_drake.show.report import plots
from ffsm_drake.show.report.results import (
    EFFORT_UNITS,
    GROUP_TITLES,
    SETTLED_OVER,
    SETTLED_WITHIN,
    Magnitude,
    Result,
    flatten,
    number,
    ranking,
    results_of,
)

TEMPLATE = "report.html.j2"
_SYMBOL = re.compile(r"(?<![\w.])(K|G|s|N\*|beta)_(si|s|i|D)\b")
_STATUS_WORDS = {
    "settled": "settled",
    "unsettled": "not settled",
    "interrupted": "interrupted",
    "diverged": "diverged",
}
_STATUS_TONES = {"settled": "good", "unsettled": "warn", "interrupted": "warn", "diverged": "bad"}
_FINDING_TONES = {"holds": "good", "does not hold": "bad", "measured": "mute", "not applicable": "mute"}
_CSS_DASHES = {
    "solid": "solid",
    "dash": "dashed",
    "longdash": "dashed",
    "dashdot": "dashed",
    "longdashdot": "dashed",
    "dot": "dotted",
}
# Section key -> title, text, and the sentence that stands where the records have nothing to draw.
_SECTIONS = {
    "error": ("Tracking error", "Reference minus truth, e = q_d − q, by coordinate.", "The records hold no errors."),
    "force": (
        "Forces and torques",
        "What the controller asks of base and joints, and the disturbance that acts besides.",
        "The records hold no forces.",
    ),
    "sliding": (
        "Sliding variable and gains",
        "The sliding variable s, and the gains Kₛ and G where the controller adapts them.",
        "These controllers record no sliding variable and no adaptive gains.",
    ),
    "end_effector": (
        "End effector",
        "Where the end effector went, and how far from where it was to be. Drag to turn, scroll to zoom.",
        "The records hold no path of the end effector.",
    ),
    "motion": (
        "Motion",
        "Attitude of the base, its position, and the joints; the reference dotted.",
        "The records hold no motion.",
    ),
}

T = TypeVar("T")
Json = dict[str, Any]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cell:
    """One figure of the result table."""

    text: str
    kind: str = ""  # "best", "partial" or nothing


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the result table, a cell for each run."""

    label: str
    cells: list[Cell]
    unit: str = ""
    head: str = ""  # a heading above the line


def write_report(
    records: Sequence[RunRecord], path: Path, *, title: str | None = None, recording: str | None = None
) -> Path:
    """Write one self-contained HTML page about one or several runs; it opens from disk, without a network.

    Sections that do not apply to a run (the analysis of a foreign controller, a variable that it does not record) say
    so in a sentence. The same records give the same bytes.

    Args:
      records: the runs to show and compare, in the order of the table's columns.
      path: the file to write.
      title: the page's heading; default: the scenario's description.
      recording: the text of a self-contained Meshcat page, to be played within this one.

    Returns:
      The path.

    Raises:
      RecordError: there is no record, or the file cannot be written.
    """
    path = Path(path)
    if not records:
        raise RecordError(f"{path}: a report needs at least one record, none was given")
    write_text(path, render_report(records, title=title, recording=recording))
    return path


def render_report(records: Sequence[RunRecord], *, title: str | None = None, recording: str | None = None) -> str:
    """The page of ``write_report`` as text; ``records`` holds at least one."""
    from plotly.offline import get_plotlyjs  # type: ignore[import-untyped]

    results = results_of(records)
    curves = plots.Curves(points=plots.points_per_curve(results))
    drawn = plots.time_plots(results, curves)
    findings = [_findings(result) for result in results]
    margins = [_attempt(functools.partial(stability, result.record.scenario)) for result in results]
    stability = plots.stability_plots(results, [margin for margin, _ in margins], curves)
    if stability is not None:
        drawn["stability"] = stability
    descriptions = list(dict.fromkeys(record.scenario.description for record in records))
    description = descriptions[0] or "Run report"
    content: Json = {
        "title": title or description,
        "kicker": "; ".join(descriptions) if title or len(descriptions) > 1 else "free-flying space manipulator",
        "results": results,
        "summary": _summary(results),
        "settled_rule": "Settled means: over the last "
        + f"{SETTLED_OVER:g} s every error stays within "
        + " and ".join(f"{1e3 * bound:g} m{unit}" for unit, bound in SETTLED_WITHIN.items())
        + ".",
        "table": _table(results),
        "table_notes": _table_notes(results),
        "rankings": _rankings(results) if len(results) > 1 else [],
        "recording": None if recording is None else _script_json(recording),
        "sections": [
            {"key": key, "title": heading, "text": text if key in drawn else nothing}
            for key, (heading, text, nothing) in _SECTIONS.items()
        ],
        "plots": drawn,
        "thinning": _thinning(curves),
        "findings": findings,
        "stability": [_stability(result, *margin) for result, margin in zip(results, margins, strict=True)],
        "stability_head": ("η", "spectral radius", "expected", "Kₛ / limit [1/s]", "L / limit [ms]"),
        "stability_rows": [_stability_row(result, margin) for result, (margin, _) in zip(results, margins, strict=True)
                           if margin is not None],
        "limits_head": ("Kₛ start [1/s]", "expected [1/s]", "bound [1/s]", "limit [1/s]", "L limit [ms]",
                        "η tolerated"),
        "provenance": _provenance(results),
        "software": _software(records),
        "footer": f"Written by ffsm_drake {records[0].software.get('ffsm-drake', '')}. This file needs no network.",
        "words": _STATUS_WORDS,
        "tones": _STATUS_TONES,
        "finding_tones": _FINDING_TONES,
        "css_dashes": _CSS_DASHES,
        "plotly": Markup(get_plotlyjs()),
        "plot_data": _script_json({
            "runs": [{"label": result.label, "color": result.color} for result in results],
            "plots": drawn,
            "arrays": curves.arrays,
        }),
    }  # fmt: skip
    environment = Environment(
        loader=PackageLoader("ffsm_drake.show.report", ""), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["symbols"] = _symbols
    return environment.get_template(TEMPLATE).render(content)


def _symbols(text: str) -> Markup:
    """Text with its symbols' subscripts as HTML."""
    return Markup(_SYMBOL.sub(r"\1<sub>\2</sub>", str(escape(text))))


def _script_json(data: Any) -> Markup:
    """JSON that a script element can hold: nothing in it can close the element or open another."""
    text = json.dumps(_finite(data), separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _attempt(make: Callable[[], T]) -> tuple[T | None, str]:
    """What ``make`` returns, or why there is nothing: a section that fails must not take the report with it."""
    try:
        return make(), ""
    except FfsmError as error:
        return None, one_line(error)
    except KeyError as error:  # a variable that the record lacks, a controller that has no law
        return None, f"there is no {one_line(error).strip(chr(34)).removeprefix('No variable named ').split('. ')[0]}"


def _summary(results: Sequence[Result]) -> str:
    if len(results) == 1:
        return f"One run of {results[0].label}, {results[0].record.outcome.time:g} s of flight."
    counted = {word: sum(result.status == status for result in results) for status, word in _STATUS_WORDS.items()}
    parts = ", ".join(f"{count} {word}" for word, count in counted.items() if count)
    return f"{len(results)} runs compared: {parts}."


def _table(results: Sequence[Result]) -> list[Row]:
    rows = [
        Row(label="Accuracy, ITAE", cells=_compared(results, lambda result: result.itae, digits=4)),
        Row(label="Effort, ISV", cells=_compared(results, lambda result: result.isv, digits=5)),
    ]
    kinds = list(dict.fromkeys((part.group, part.unit) for result in results for part in result.magnitudes))
    for head, field in (
        ("Peak error", "peak_error"),
        ("Final error", "final_error"),
        ("Peak control force or torque", "peak_effort"),
    ):
        for k, (group, unit) in enumerate(kinds):
            kind = f", {'revolute' if unit == 'rad' else 'prismatic'}" if (group, _other(unit)) in kinds else ""
            rows.append(
                Row(
                    head="" if k else head,
                    label=GROUP_TITLES.get(group, group) + kind,
                    unit=EFFORT_UNITS.get(unit, unit) if field == "peak_effort" else unit,
                    cells=[Cell(text=number(_magnitude(result, group, unit, field))) for result in results],
                )
            )
    wall = [result.record.wall_time for result in results]
    rows += [
        Row(label="Simulated time", unit="s", head="Computation",
            cells=[Cell(text=f"{result.record.outcome.time:g}") for result in results]),
        Row(label="Wall time, simulation", unit="s",
            cells=[Cell(text=number(one.get("advance_to"), 3)) for one in wall]),
        Row(label="Wall time, all told", unit="s", cells=[Cell(text=number(one.get("total"), 3)) for one in wall]),
    ]  # fmt: skip
    return rows


def _other(unit: str) -> str:
    return "m" if unit == "rad" else "rad"


def _magnitude(result: Result, group: str, unit: str, field: str) -> float:
    found: list[Magnitude] = [part for part in result.magnitudes if (part.group, part.unit) == (group, unit)]
    return float(getattr(found[0], field)) if found else math.nan


def _compared(results: Sequence[Result], figure: Callable[[Result], float], *, digits: int) -> list[Cell]:
    """A sum over each run, the least of the completed ones marked where there are several."""
    completed = [figure(result) for result in results if result.comparable and math.isfinite(figure(result))]
    cells = []
    for result in results:
        value = figure(result)
        best = len(completed) > 1 and result.comparable and value == min(completed)
        cells.append(
            Cell(
                text=number(value, digits), kind="" if result.comparable and not best else "best" if best else "partial"
            )
        )
    return cells


def _table_notes(results: Sequence[Result]) -> list[str]:
    notes = ["ITAE is the sum of t |e|₁ L, ISV the sum of |τ|₂² L over the control samples; less is better."]
    if not all(result.comparable for result in results):
        notes.append(
            "In italics: sums over a run that ended early, up to its end only. They do not compare with those of "
            "completed runs, however small."
        )
    if len({result.record.outcome.time for result in results if result.comparable}) > 1:
        notes.append("The completed runs differ in length, so their sums do not compare directly.")
    return notes


def _rankings(results: Sequence[Result]) -> list[Json]:
    made = []
    for title, figure, digits in (
        ("By accuracy (ITAE)", operator.attrgetter("itae"), 4),
        ("By effort (ISV)", operator.attrgetter("isv"), 5),
    ):
        ranked = ranking(results, figure)
        values = [figure(result) for result in ranked if result.comparable and math.isfinite(figure(result))]
        entries = []
        for place, result in enumerate(ranked, start=1):
            value = figure(result)
            placed = result.comparable and math.isfinite(value)
            text = number(value, digits) if placed else _ending(result)
            share = 100.0 * value / max(values) if placed and max(values) > 0.0 else None
            entries.append({"place": place if placed else "–", "result": result, "text": text, "share": share})
        made.append({"title": title, "entries": entries})
    return made


def _ending(result: Result) -> str:
    outcome = result.record.outcome
    return "not recorded" if result.comparable else f"{outcome.status} at {outcome.time:.2f} s"


def _thinning(curves: plots.Curves) -> str:
    if curves.longest <= curves.points:
        return "The plots show every control sample."
    return (
        f"Curves of more than {curves.points} samples are thinned for display (the longest has {curves.longest}): of "
        "each short interval the smallest and the largest value are drawn, so that no peak is lost. The record itself "
        "is whole, and every figure on this page is computed from all samples."
    )


def _findings(result: Result) -> Json:
    findings: tuple[Finding, ...] = ()
    excuse = "The record has no sample to analyse."
    if result.record.dataset.sizes.get("time", 0):
        analysis, problem = _attempt(functools.partial(analyze, result.record))
        findings = () if analysis is None else analysis.findings
        excuse = problem and f"The analysis is not available for this run: {problem}."
    tally = ", ".join(
        f"{count} {verdict}"
        for verdict in _FINDING_TONES
        if (count := sum(finding.verdict == verdict for finding in findings))
    )
    return {"result": result, "findings": findings, "excuse": excuse, "tally": tally}


def _stability(result: Result, margin: Margins | None, problem: str) -> Json:
    if margin is None:
        return {"result": result, "excuse": f"{result.label}: the stability map is not available: {problem}."}
    has_k_s = bool(_has_k_s(margin))
    rows = []
    for i, name in enumerate(margin.coordinates.names):
        low, high = margin.eta_tolerated[i]
        gains = (margin.law.k_s[i], margin.forecast_k_s[:, i].max(), margin.law.k_s_max[i], margin.k_s_limit[i])
        shown = [number(float(value)) if has_k_s else "–" for value in gains]
        rows.append(
            (name, [*shown, number(1e3 * margin.sample_time_limit[i]), f"{number(low, 3)} to {number(high, 3)}"])
        )
    return {"result": result, "excuse": "", "limits": rows}


def _has_k_s(margin: Margins) -> bool:
    """Whether the law has a K_s at all."""
    return any(math.isfinite(value) for value in margin.k_s_limit.tolist())


def _stability_row(result: Result, margin: Margins) -> Json:
    has_k_s = _has_k_s(margin)
    limits = [value for value in margin.k_s_limit.tolist() if math.isfinite(value)]
    cells = [
        f"{number(float(margin.eta.min()), 3)} to {number(float(margin.eta.max()), 3)}",
        f"{margin.spectral_radius.max():.5f}",
        f"{margin.spectral_radius_expected.max():.5f}" if has_k_s else "–",
        f"{margin.forecast_k_s.max():.3g} / {min(limits):.3g}" if has_k_s else "–",
        f"{1e3 * margin.scenario.sample_time:.3g} / {1e3 * margin.sample_time_limit.min():.3g}",
    ]
    tone = "bad" if not margin.is_stable else "good" if margin.verdict == "stable" else "warn"
    return {"result": result, "cells": cells, "tone": tone, "verdict": margin.verdict}


def _provenance(results: Sequence[Result]) -> list[Json]:
    shipped = {name: scenario_to_dict(load_scenario(name)) for name in shipped_scenarios()}
    items = []
    for result in results:
        record = result.record
        outcome, scenario = record.outcome, scenario_to_dict(record.scenario)
        text = yaml.safe_dump(scenario, sort_keys=False, allow_unicode=True)
        file = f"{record.scenario.controller}.yaml"
        command, note = _command(scenario, shipped, file)
        facts = [
            ("Outcome", f"{outcome.status}, {outcome.message}"),
            ("Controller", record.scenario.controller),
            ("Random seed", str(record.scenario.random_seed)),
            ("Control samples", f"{record.dataset.sizes.get('time', 0)}, every {record.scenario.sample_time:g} s"),
            ("Integration", f"{record.scenario.simulator_config.integration_scheme}, steps of at most "
                            f"{record.scenario.simulator_config.max_step_size:g} s"),
            ("Wall time", ", ".join(f"{name.replace('_', ' ')} {number(value, 3)} s"
                                    for name, value in record.wall_time.items())),
        ]  # fmt: skip
        if record.wall_time.get("advance_to", 0.0) > 0.0:
            facts.append(("Speed", f"{record.realtime_factor:.0f} times real time"))
        items.append({
            "result": result, "facts": facts, "scenario": text, "file": file, "command": command, "command_note": note,
            "encoded": base64.b64encode(text.encode()).decode("ascii"),
        })  # fmt: skip
    return items


def _command(scenario: Json, shipped: Mapping[str, Json], file: str) -> tuple[str, str]:
    """The command that makes a run again, and a remark on it; a shipped scenario is named where few values differ."""
    wanted = flatten(scenario)
    candidates = []
    for name, data in shipped.items():
        known = flatten(data)
        if set(known) <= set(wanted):
            changed = {key: value for key, value in wanted.items() if key not in known or known[key] != value}
            candidates.append((len(changed), name, changed))
    count, name, changed = min(candidates, default=(math.inf, "", {}), key=lambda candidate: candidate[:2])
    if count > 8:
        return shlex.join(["python", "examples/postcapture.py", "--scenario", file]), ", with the scenario saved below"
    words = ["python", "examples/postcapture.py", "--scenario", name]
    for key, value in changed.items():
        words += ["--set", f"{key}={json.dumps(value)}"]
    return shlex.join(words), ""


def _software(records: Sequence[RunRecord]) -> list[tuple[str, str]]:
    names = dict.fromkeys(name for record in records for name in record.software)
    return [(name, " / ".join(dict.fromkeys(record.software.get(name, "?") for record in records))) for name in names]
