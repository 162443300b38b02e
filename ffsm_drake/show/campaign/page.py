"""The report of a campaign: one page that opens offline, its figures as PNG, all runs as CSV and Parquet."""

import dataclasses
import datetime
import importlib.util
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ffsm_drake.campaign.errors import CampaignError
from ffsm_drake.campaign.evaluate import OUTCOMES
from ffsm_drake.campaign.findings import Findings, find
from ffsm_drake.campaign.statistics import CONFIDENCE, Interval, quantiles, worst_runs
from ffsm_drake.campaign.store import Store
from ffsm_drake.common.errors import RecordError, one_line
from ffsm_drake.common.files import write_text, written_whole
from ffsm_drake.show.campaign import charts_interactive, charts_still
from ffsm_drake.show.figures.run import LABELS

TEMPLATE = "report.html.j2"
_NONE = "-"
_CHARTS = ("success", "accuracy", "difference", "sensitivity", "map")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Written:
    """What a report consists of."""

    files: list[Path]
    summary: str


def write_report(
    store: Store,
    directory: Path,
    *,
    axes: tuple[str, str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Written:
    """Judge a campaign, finished or not, and write what there is to see.

    Args:
      store: the database.
      directory: where the files go.
      axes: the map's two values; None for the two that matter most.
      progress: called with (done, total) controllers of the map.

    Raises:
      CampaignError: the database holds no result, an axis is no sampled number, plotly is missing, or the directory
        cannot be written.
    """
    if store.num_results() == 0:
        raise CampaignError(f"{store.path}: holds no result yet")
    try:
        library: Any = importlib.import_module("plotly.offline")
    except ImportError:
        raise CampaignError("the report needs the extra 'campaign': pip install 'ffsm-drake[campaign]'") from None
    findings = find(store, axes=axes, progress=progress)
    try:
        return _write(store, findings, directory, script=library.get_plotlyjs())
    except RecordError as error:
        raise CampaignError(one_line(error)) from error


def _write(store: Store, findings: Findings, directory: Path, *, script: str) -> Written:
    names = [name for name in _CHARTS if name != "map" or findings.map is not None]
    files = [directory / "report.html"]
    for name in names:
        path = directory / f"{name}.png"
        with written_whole(path) as temporary:
            getattr(charts_still, f"{name}_picture")(findings).savefig(temporary, dpi=130)
        files.append(path)
    charts = {name: _json(getattr(charts_interactive, f"{name}_chart")(findings)) for name in names}
    write_text(files[0], _page(store, findings, charts, script=script))
    tables = [directory / "runs.csv"]
    if importlib.util.find_spec("pyarrow") is not None:
        tables.append(directory / "runs.parquet")
    for path in tables:
        store.export(path)
    return Written(files=[*files, *tables], summary=summary_text(findings))


def summary_text(findings: Findings) -> str:
    """Success rates and the prediction's agreement, as plain text."""
    lines = [f"{'controller':<12}{'settled':>10}{'95 % interval':>20}{'predicted as it ended':>24}"]
    for item in findings.agreement:
        rate = findings.success[item.controller]
        lines.append(
            f"{item.controller:<12}{_percent(rate.value):>10}{_between(rate):>20}"
            f"{f'{_percent(item.share)} of {item.total}':>24}"
        )
    stable = (
        sum(item.stable_settled for item in findings.agreement),
        sum(item.stable_failed for item in findings.agreement),
    )
    unstable = (
        sum(item.unstable_settled for item in findings.agreement),
        sum(item.unstable_failed for item in findings.agreement),
    )
    lines += [
        "",
        f"{'':<22}{'settled':>9}{'not settled':>13}",
        f"{'predicted stable':<22}{stable[0]:>9}{stable[1]:>13}",
        f"{'predicted unstable':<22}{unstable[0]:>9}{unstable[1]:>13}",
    ]
    return "\n".join(lines)


def _page(store: Store, findings: Findings, charts: dict[str, Markup], *, script: str) -> str:
    environment = Environment(
        loader=PackageLoader("ffsm_drake.show.campaign", ""), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    spec, table = findings.spec, findings.table
    content: dict[str, Any] = {
        "title": spec.description or store.path.stem,
        "spec": spec,
        "runs": findings.runs,
        "complete": findings.runs == spec.runs,
        "labels": LABELS,
        "confidence": f"{100.0 * CONFIDENCE:.0f}",
        "success": [
            [
                LABELS[name],
                _percent(rate.value),
                _between(rate),
                *(int((runs.outcome == kind).sum()) for kind in OUTCOMES),
            ]
            for (name, rate), runs in zip(findings.success.items(), table.runs.values(), strict=True)
        ],
        "metrics": [
            [LABELS[name], *(_spread(quantiles(runs, metric)) for metric in _SHOWN)]
            for name, runs in table.runs.items()
        ],
        "metric_names": list(_SHOWN.values()),
        "differences": [
            [
                f"{LABELS[d.first]} against {LABELS[d.second]}",
                f"{100.0 * d.success.value:+.1f}",
                f"{100.0 * d.success.low:+.1f} … {100.0 * d.success.high:+.1f}",
                _NONE if d.itae_ratio is None else f"{d.itae_ratio.value:.3g}",
                _NONE if d.itae_ratio is None else f"{d.itae_ratio.low:.3g} … {d.itae_ratio.high:.3g}",
                d.both,
            ]
            for d in findings.differences
        ],
        "sensitivities": [
            [s.name, LABELS[s.controller], _percent(s.share), _percent(s.chance), _plain(s.correlation), s.matters]
            for name in findings.influential
            for s in findings.sensitivities
            if s.name == name
        ],
        "agreement": findings.agreement,
        "percent": _percent,
        "worst": _worst(store, findings),
        "map": findings.map,
        "fixed": {} if findings.map is None else {name: _plain(value) for name, value in findings.map.fixed.items()},
        "charts": charts,
        "specification": _specification(findings),
        "software": [row[0] for row in store.query("SELECT versions FROM software ORDER BY id")],
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "database": store.path.name,
        "fingerprint": spec.fingerprint,
        "script": Markup(script.replace("</script", "<\\/script")),
    }
    return environment.get_template(TEMPLATE).render(content)


_SHOWN = {
    "itae": "ITAE",
    "isv": "ISV",
    "peak_error_joints": "peak joint error [rad]",
    "peak_effort_base_position": "peak base force [N]",
    "settled_time": "settled after [s]",
}


def _worst(store: Store, findings: Findings) -> list[list[Any]]:
    rows = []
    for name, runs in findings.table.runs.items():
        for place in worst_runs(runs):
            case = int(runs.case[place])
            row = store.result(case, name)
            message = row["message"] or f"final joint error {row['final_error_joints']:.3g} rad"
            values = ", ".join(f"{key} {_plain(row[key])}" for key in findings.influential)
            command = f"ffsm campaign rerun {store.path} --case {case} --controller {name}"
            rows.append([LABELS[name], case, runs.outcome[place].replace("_", " "), message, values, command])
    return rows


def _specification(findings: Findings) -> str:
    import yaml

    written = {key: value for key, value in findings.spec.data.items() if key != "base"}
    text: str = yaml.safe_dump(written, sort_keys=False, allow_unicode=True)
    return text


def _json(chart: dict[str, Any]) -> Markup:
    """Data for a script element."""
    return Markup(json.dumps(chart, allow_nan=False).replace("<", "\\u003c"))


def _percent(value: float) -> str:
    return _NONE if math.isnan(value) else f"{100.0 * value:.1f} %"


def _between(interval: Interval) -> str:
    return f"{100.0 * interval.low:.1f} … {100.0 * interval.high:.1f} %"


def _spread(values: tuple[float, float, float]) -> str:
    low, middle, high = values
    return _NONE if math.isnan(middle) else f"{middle:.3g} ({low:.3g} … {high:.3g})"


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return _NONE if math.isnan(value) else f"{value:.3g}"
    return str(value)
