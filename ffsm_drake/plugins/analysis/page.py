"""The report's section of findings."""

from collections.abc import Sequence
from typing import Any

from ffsm_drake.plugins.analysis import Finding, analyze
from ffsm_drake.show.page import Section, render
from ffsm_drake.show.results import Result, attempt

_TONES = {
    "holds": "good",
    "does not hold": "bad",
    "measured": "mute",
    "not tested": "mute",
    "not applicable": "mute",
}


def findings_section(results: Sequence[Result]) -> Section:
    """Claims and balances, checked on every run."""
    content = {"findings": [_findings(result) for result in results], "tones": _TONES}
    html = render("findings.html.j2", content, package="ffsm_drake.plugins.analysis")
    return Section(html=html)


def _findings(result: Result) -> dict[str, Any]:
    findings: tuple[Finding, ...] = ()
    excuse = "The record has no sample to analyse."
    if result.record.dataset.sizes.get("time", 0):
        analysis, problem = attempt("analysis", result, analyze, result.record)
        findings = () if analysis is None else analysis.findings
        excuse = problem and f"The analysis is not available for this run: {problem}."
    counted = {
        verdict: sum(finding.verdict == verdict for finding in findings) for verdict in _TONES
    }
    tally = ", ".join(f"{count} {word}" for word, count in counted.items() if count)
    return {"result": result, "findings": findings, "excuse": excuse, "tally": tally}
