"""The summary page, as self-contained HTML and as Markdown."""

import base64
import datetime
import math
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pandas as pd  # type: ignore[import-untyped]

from ffsm_drake.common.files import write_text
from ffsm_drake.plugins.paper import paper
from ffsm_drake.plugins.paper.claims import by_topic, counts
from ffsm_drake.plugins.paper.figures import FigureFile
from ffsm_drake.plugins.paper.minor_steps import minor_step_table
from ffsm_drake.plugins.paper.outcome import CHOICES, CHOICES_HEADER, outcome
from ffsm_drake.plugins.paper.robustness import nominal_payload_table
from ffsm_drake.plugins.paper.runs import PROPOSED, SETTINGS, Results, StudyCase
from ffsm_drake.plugins.paper.table import HEADER, markdown_rows, table_csv, table_notes
from ffsm_drake.plugins.paper.verdict import Kind, Verdict
from ffsm_drake.plugins.paper.wording import listed, span, times_span
from ffsm_drake.runs.record import software_versions
from ffsm_drake.show.page import render
from ffsm_drake.systems.controllers import complete_gains

_TALLY: dict[Kind, str] = {
    "holds": "hold", "holds only": "hold only under a condition", "does not hold": "do not hold",
    "not reproduced": "not reproduced", "not tested": "not tested",
}  # fmt: skip
_MINOR_STEPS = (
    "The proposed controller with the published gains, τ_d1, seed 0, in steps of the control "
    "period. The paper does not say how its simulation coupled law and plant: a block diagram in "
    "continuous time evaluates the law in every minor step of the integrator, a digital controller "
    f"holds its force over the period. Table 2's ISV is {paper.TABLE_2['isv']['tau_d1'][PROPOSED]}."
)
_PIXELS = ("fig4", "fig5")  # embedded as PNG; the other figures are small as vectors


def write_table(rows: pd.DataFrame, results: Results, directory: Path) -> Path:
    """Write table2.csv, table2.md and table2.html; returns the last."""
    write_text(directory / "table2.csv", table_csv(rows))
    content = _content("Table 2, the paper's and ours", rows, results)
    return _write(directory / "table2.html", content)


def write_page(
    results: Results,
    rows: pd.DataFrame,
    figures: Sequence[FigureFile],
    verdicts: list[Verdict],
    directory: Path,
) -> Path:
    """Write reproduction.md and reproduction.html; returns the latter."""
    content = _content("How far the paper holds", rows, results, figures, verdicts)
    return _write(directory / "reproduction.html", content)


def _write(path: Path, content: dict[str, Any]) -> Path:
    """Write a page as HTML to ``path`` and as Markdown beside it."""
    for kind in (".md", ".html"):
        text = render(f"reproduction{kind}.j2", content, package="ffsm_drake.plugins.paper")
        write_text(path.with_suffix(kind), text)
    return path


def summary(results: Results, rows: pd.DataFrame) -> list[str]:
    """The outcome in a few sentences, with numbers from the runs."""
    total = len(results.comparisons)
    first = {
        setting: sum(order[0] == PROPOSED for order in results.rankings("itae", setting))
        for setting in SETTINGS
    }
    isv, itae = (
        rows.loc[rows["setting"] == "euler", f"{metric}_ratio"] for metric in ("isv", "itae")
    )
    diverged = results.divergence_times("exact", PROPOSED)
    when = f", after {span(diverged, 2)} s" if diverged else ""
    return [
        f"With explicit Euler at the control period, our effort (ISV) is {times_span(isv)} times "
        f"Table 2's, our ITAE {span(itae, 2)} times; the proposed controller is the most accurate "
        f"in {first['euler']} of {total} comparisons (three disturbances, each with every noise "
        "seed).",
        "On an exactly integrated plant with the published gains, the proposed controller diverges "
        f"in {len(diverged)} of {total} runs{when}. With K_s bounded it is the most accurate in "
        f"{first['bounded']} of {total}.",
    ]


def provenance(results: Results, what: str) -> list[tuple[str, str]]:
    """Provenance of the numbers: label and text."""
    versions = software_versions() | {name: version(name) for name in ("matplotlib", "jinja2")}
    return [
        ("Paper", paper.CITATION),
        (
            "Seeds",
            f"{listed(str(seed) for seed in range(results.num_seeds))} of the measurement noise",
        ),
        ("Command", f"ffsm reproduce {what} --seeds {results.num_seeds}"),
        ("Date", datetime.datetime.now(datetime.UTC).date().isoformat()),
        *versions.items(),
    ]


def runs_made(results: Results) -> list[str]:
    """Description of the runs, in sentences."""
    table = sum(not case.variant for case in results.runs)
    diverged = sum(not run.outcome.completed for run in results.runs.values())
    scenario = StudyCase(setting="bounded", controller=PROPOSED).scenario(results.overrides)
    gains = complete_gains(scenario).controllers[PROPOSED]
    seconds = math.fsum(run.outcome.time for run in results.runs.values())
    period, noise = (
        1e3 * scenario.sample_time,
        [1e6 * value for value in scenario.sensing.velocity_noise.values()],
    )
    starting, highest = (
        span((gains[name] or {}).values(), 2) for name in ("k_s_initial", "k_s_max")
    )
    lines = [
        f"{len(results.runs)} simulations, {seconds:.0f} s of flight: {table} for Table 2 (four "
        f"controllers, three disturbances, three settings, {results.num_seeds} seeds, shared runs "
        f"made once) and {len(results.runs) - table} for single claims. {diverged} of them "
        "diverged.",
        f"In all settings: control period {period:g} ms, white noise of {span(noise, 1)} µrad/s "
        "and µm/s on the measured velocities, disturbance as an external generalized force, H q̈ + "
        "C = τ + τ_d (with the sign of equation (1) Table 2 cannot be met). Where K_s is bounded "
        f"it starts at {starting} and stays below {highest} 1/s.",
    ]
    if results.overrides:
        lines.append(f"Not the reproduction proper: every run had {', '.join(results.overrides)}.")
    return lines


def _content(
    title: str,
    rows: pd.DataFrame,
    results: Results,
    figures: Sequence[FigureFile] = (),
    verdicts: Sequence[Verdict] = (),
) -> dict[str, Any]:
    """The variables of both templates."""
    by_setting = {setting: rows[rows["setting"] == setting] for setting in SETTINGS}
    return {
        "title": title,
        "rows": {setting: found.to_dict("records") for setting, found in by_setting.items()},
        "header": HEADER,
        "cells": {setting: markdown_rows(found) for setting, found in by_setting.items()},
        "settings": SETTINGS,
        "notes": table_notes(),
        "summary": summary(results, rows),
        "outcome": outcome(rows),
        "choices": (CHOICES_HEADER, CHOICES),
        "overrides": results.overrides,
        "runs_made": runs_made(results),
        "provenance": provenance(results, "all" if verdicts else "table2"),
        "verdicts": by_topic(list(verdicts)),
        "tally": [(kind, number, _TALLY[kind]) for kind, number in counts(list(verdicts)).items()],
        "about_minor_steps": _MINOR_STEPS,
        "figures": {
            figure.key: {"file": figure, "source": _data_address(figure)} for figure in figures
        },
        "minor_steps": minor_step_table(results.overrides) if verdicts else None,
        "nominal_payloads": nominal_payload_table(results) if verdicts else None,
    }


def _data_address(figure: FigureFile) -> str:
    """The figure as a data address, or "" without a file."""
    path = figure.png if figure.svg is None or figure.key.startswith(_PIXELS) else figure.svg
    if path is None:
        return ""
    kind = "image/png" if path.suffix == ".png" else "image/svg+xml"
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"
