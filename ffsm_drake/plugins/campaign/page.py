"""The report of a campaign: one page that opens offline, and all runs as CSV and Parquet."""

import dataclasses
import datetime
import importlib.util
import math
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ffsm_drake.common.errors import CampaignError
from ffsm_drake.common.files import published, write_text
from ffsm_drake.common.numbers import NONE, number, percent
from ffsm_drake.common.steps import step
from ffsm_drake.plugins.campaign.charts import chart_views, limits_of
from ffsm_drake.plugins.campaign.rows import OUTCOMES, metric_tables
from ffsm_drake.plugins.campaign.spec import Spec
from ffsm_drake.plugins.campaign.statistics import (
    CONFIDENCE,
    FEWEST_PAIRS,
    GRID_METRICS,
    Findings,
    Interval,
    agreed,
    find,
    quantiles,
    worst_runs,
)
from ffsm_drake.plugins.campaign.store import Store
from ffsm_drake.show.page import render
from ffsm_drake.show.table_files import Column
from ffsm_drake.show.tables import aligned

_PAGE = "report.html"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Written:
    """The files, the summary and the table of a report."""

    files: list[Path]
    summary: str
    table: list[Column]


def write_report(
    store: Store,
    directory: Path,
    *,
    axes: tuple[str, str] | None = None,
    boundary: float = 0.0,
    progress: Callable[[int, int], None] | None = None,
) -> Written:
    """Evaluate a campaign, finished or not, also while it runs, and write its report.

    Args:
      store: the database.
      directory: where the files go.
      axes: the map's two values; None for the two that matter most.
      boundary: time for the predicted boundary on the map, s; what is found is added to the page,
        with what earlier reports have found.
      progress: called with (done, total) controllers of the map.

    Raises:
      CampaignError: the database holds no result, or an axis is no sampled number.
      RecordError: the directory cannot be written.
    """
    if store.num_results() == 0:
        raise CampaignError(
            f"{store.path}: holds no result yet; wait for the first runs of 'ffsm campaign run', "
            f"or type 'ffsm campaign resume {store.path}'"
        )
    tables = ["runs.csv"] + ["runs.parquet"] * bool(importlib.util.find_spec("pyarrow"))
    with store.snapshot(), published(directory) as folder:
        findings = find(store, axes=axes, boundary=0.0)
        write_text(folder / _PAGE, _page(store, findings))
        for name in tables:
            with step(f"writing {name}"):
                store.export(folder / name)
    if boundary and findings.map is not None:
        grid = find(store, axes=axes, boundary=boundary, progress=progress).map
        findings = dataclasses.replace(findings, map=grid)
        write_text(directory / _PAGE, _page(store, findings))
    files = [directory / name for name in (_PAGE, *tables)]
    return Written(files=files, summary=summary_text(findings), table=_columns(findings))


def _columns(findings: Findings) -> list[Column]:
    """Return a row for each controller: success in percent, and the medians of the settled runs."""
    runs_of, rates = findings.table.runs, findings.success.values()
    columns = [
        Column(name="controller", cells=[findings.spec.label(name) for name in runs_of]),
        Column(name="runs", cells=[len(runs) for runs in runs_of.values()]),
    ]
    for name, key in (("settled", "value"), ("at least", "low"), ("at most", "high")):
        cells = [100.0 * getattr(rate, key) for rate in rates]
        columns.append(Column(name=name, unit="%", cells=cells))
    for table in _metric_tables(findings.spec):
        for metric, heading in table.items():
            name, _, unit = heading.rstrip("]").partition(" [")
            cells = [quantiles(runs, metric)[1] for runs in runs_of.values()]
            columns.append(Column(name=name, unit=unit, cells=cells))
    return columns


def summary_text(findings: Findings) -> str:
    """Success rates, the prediction's agreement and interactions, as plain text."""
    rates = [["controller", "settled", "95 % interval", "predicted correctly"]]
    for name, counts in findings.agreement.items():
        rate = findings.success[name]
        predicted = f"{percent(agreed(counts))} of {counts.sum()}"
        rates.append([findings.spec.label(name), percent(rate.value), _between(rate), predicted])
    names = (
        ("stable", "unstable")
        if findings.spec.base["capture"] is None
        else ("to settle", "to fail")
    )
    totals = np.sum([*findings.agreement.values()], axis=0).astype(str)
    outcomes = [["", "settled", "not settled"]]
    outcomes += [[f"predicted {name}", *row] for name, row in zip(names, totals, strict=True)]
    together = [
        f"{findings.spec.label(s.controller)}: {s.first} and {s.second} together explain "
        f"{percent(s.share)} of the failures beyond each alone (chance {percent(s.chance)}); "
        f"{percent(s.observed)} fail with these values {s.sides}"
        for s in findings.pairs.itertuples()
    ]
    return "\n".join([*aligned(rates), "", *aligned(outcomes), *findings.unpredicted, *together])


@step("drawing the page")
def _page(store: Store, findings: Findings) -> str:
    spec, views, found = findings.spec, chart_views(findings), findings.map
    content: dict[str, Any] = {
        "title": spec.description or store.path.stem,
        "spec": spec,
        "laws": [spec.label(name) for name in spec.controllers],
        "runs": findings.runs,
        "complete": findings.runs == spec.runs,
        "fewest_pairs": FEWEST_PAIRS,
        "confidence": f"{100.0 * CONFIDENCE:.0f}",
        "outcomes": [kind.replace("_", " ") for kind in OUTCOMES],
        "has_capture": spec.base["capture"] is not None,
        "any_failed": any(not runs["is_settled"].all() for runs in findings.table.runs.values()),
        **_controller_tables(findings),
        **_grid_table(findings),
        **_comparisons(findings),
        "unpredicted": findings.unpredicted,
        "worst": _worst(store, findings),
        "map": found,
        "has_boundary": found is not None
        and any(np.isfinite(radius).any() for radius in found.radius.values()),
        "fixed": {} if found is None else {key: _plain(x) for key, x in found.fixed.items()},
        "specification": yaml.safe_dump(
            {key: value for key, value in spec.data.items() if key != "base"},
            sort_keys=False,
            allow_unicode=True,
        ),
        "software": [row[0] for row in store.query("SELECT versions FROM software ORDER BY id")],
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "database": store.path.name,
        "boundary_command": ""
        if found is None
        else _command("report", store.path, "--boundary", 300, "--map", found.x_name, found.y_name),
        "fingerprint": spec.fingerprint,
    }
    package = "ffsm_drake.plugins.campaign"
    return render("campaign.html.j2", content, package=package, views=views)


def _metric_tables(spec: Spec) -> list[dict[str, str]]:
    """Columns of the database and their headings, by table."""
    tables = [
        {
            each.column_name: each.column_heading
            for each in table
            if each.column_name and each.column_heading
        }
        for table in metric_tables(spec)
    ]
    return [table for table in tables if table]


def _controller_tables(findings: Findings) -> dict[str, Any]:
    """Success, metrics and limits left, a row or more for each controller."""
    runs_of = {findings.spec.label(name): runs for name, runs in findings.table.runs.items()}
    success = [
        [label, percent(rate.value), _between(rate)]
        + [int((runs["outcome"] == kind).sum()) for kind in OUTCOMES]
        for (label, runs), rate in zip(runs_of.items(), findings.success.values(), strict=True)
    ]
    metrics = [
        (
            list(table.values()),
            [
                [label, *(_spread(quantiles(runs, metric)) for metric in table)]
                for label, runs in runs_of.items()
            ],
        )
        for table in _metric_tables(findings.spec)
    ]
    limits = [
        [label, limit or "none", count]
        for label, runs in runs_of.items()
        for limit, count in limits_of(runs).items()
    ]
    return {"success": success, "metrics": metrics, "limits": limits}


def _grid_table(findings: Findings) -> dict[str, Any]:
    """Return a row for each point of the grid."""
    values = [*findings.spec.distributions]
    rows = [
        [
            *(point[name] for name in values),
            findings.spec.label(point["controller"]),
            point["outcome"],
            *(number(point[name], 3) for name in GRID_METRICS),
        ]
        for point in findings.grid.to_dict("records")
    ]
    header = [*values, "controller", "outcome", *GRID_METRICS.values()]
    return {"grid_header": header, "grid_rows": rows}


def _comparisons(findings: Findings) -> dict[str, Any]:
    """Pairs of controllers, sensitivities, and predictions against outcomes."""
    differences = [
        [
            f"{findings.spec.label(d.first)} against {findings.spec.label(d.second)}",
            *_value_and_interval(d.success, lambda value: f"{100.0 * value:+.1f}"),
            *_value_and_interval(d.itae_ratio, lambda value: number(value, 3)),
            d.both,
        ]
        for d in findings.differences
    ]
    found = findings.sensitivities.set_index("name").loc[findings.drivers]
    sensitivities = [
        (
            [
                s.Index,
                findings.spec.label(s.controller),
                percent(s.share),
                percent(s.chance),
                percent(s.total) if s.interacts else NONE,
                _plain(s.correlation),
            ],
            s.matters or s.interacts,
        )
        for s in found.itertuples()
    ]
    pairs = [
        [
            f"{s.first} and {s.second}",
            findings.spec.label(s.controller),
            percent(s.share),
            percent(s.chance),
            s.sides,
            percent(s.observed),
            percent(min(max(s.additive, 0.0), 1.0)),
        ]
        for s in findings.pairs.itertuples()
    ]
    agreement = [
        [findings.spec.label(name), *counts.ravel(), percent(agreed(counts))]
        for name, counts in findings.agreement.items()
    ]
    return {
        "differences": differences,
        "sensitivities": sensitivities,
        "pairs": pairs,
        "agreement": agreement,
    }


def _command(*words: object) -> str:
    """Return a command of campaigns as a shell takes it."""
    return f"ffsm campaign {shlex.join(map(str, words))}"


def _worst(store: Store, findings: Findings) -> list[tuple[list[Any], str]]:
    """Cells and the command of each controller's worst runs."""
    rows = []
    for name, runs in findings.table.runs.items():
        for case in worst_runs(runs):
            row = store.result(case, name)
            message = (
                row["message"] or f"final joint error {number(row['final_error_joints'], 3)} rad"
            )
            values = ", ".join(f"{key} {_plain(row[key])}" for key in findings.influential)
            command = _command("rerun", store.path, "--case", case, "--controller", name)
            rows.append(
                (
                    [
                        findings.spec.label(name),
                        case,
                        row["outcome"].replace("_", " "),
                        message,
                        values,
                    ],
                    command,
                )
            )
    return rows


def _value_and_interval(interval: Interval | None, form: Callable[[float], str]) -> list[str]:
    if interval is None:
        return [NONE, NONE]
    value, low, high = map(form, (interval.value, interval.low, interval.high))
    return [value, f"{low} … {high}"]


def _between(interval: Interval) -> str:
    return f"{100.0 * interval.low:.1f} … {100.0 * interval.high:.1f} %"


def _spread(values: np.ndarray) -> str:
    low, middle, high = values
    return (
        NONE
        if math.isnan(middle)
        else (f"{number(middle, 3)} ({number(low, 3)} … {number(high, 3)})")
    )


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return number(value, 3)
    return str(value)
