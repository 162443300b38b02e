# ruff: noqa: RUF001, RUF002 (the texts use mathematical signs)
"""What a reader wants to know first: how each run ended, its figures of merit, who did best."""

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from ffsm_drake.runs.metrics import isv, itae
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import scenario_to_dict
from ffsm_drake.show.figures.run import LABELS, STYLES

Status = Literal["settled", "unsettled", "interrupted", "diverged"]

# A run has settled when over its last second every error stays within this.
SETTLED_WITHIN = {"rad": 1e-3, "m": 1e-3}
SETTLED_OVER = 1.0  # s
GROUP_TITLES = {"base_rotation": "Base attitude", "base_position": "Base position", "joints": "Joints"}
EFFORT_UNITS = {"rad": "N m", "m": "N"}
# Of runs whose controller has no colour of its own, or whose colour is taken.
SPARE_COLORS = ("#CC79A7", "#E69F00", "#56B4E9", "#8C6BB1", "#B8A800", "#8C510A")
# Matplotlib's line styles in plotly's words.
DASHES = {
    "-": "solid",
    "--": "dash",
    "-.": "dashdot",
    ":": "dot",
    (0, (5, 1)): "longdash",
    (0, (3, 1, 1, 1, 1, 1)): "longdashdot",
}
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Magnitude:
    """The largest values of the coordinates of one group and unit; NaN where the record has none."""

    group: str
    unit: str  # "rad" or "m"
    peak_error: float
    final_error: float
    peak_effort: float  # N m or N


@dataclasses.dataclass(frozen=True, kw_only=True)
class Result:
    """One run, named, judged and in figures; NaN where the record does not hold what a figure needs."""

    record: RunRecord
    label: str
    color: str
    dash: str
    status: Status
    verdict: str  # one sentence
    itae: float
    isv: float
    magnitudes: tuple[Magnitude, ...]

    @property
    def comparable(self) -> bool:
        """Whether the run lasted as long as it was meant to, so that its sums may be compared."""
        return self.record.outcome.completed


def results_of(records: Sequence[RunRecord]) -> list[Result]:
    """Every run with a name and a colour of its own."""
    named, styles = labels_of(records), _styles_of(records)
    return [
        _result(record, label, *style) for record, label, style in zip(records, named, styles, strict=True)
    ]  # fmt: skip


def ranking(results: Sequence[Result], figure: Callable[[Result], float]) -> list[Result]:
    """The best first. Interrupted runs stand behind all completed ones, diverged runs last, whatever their sums."""
    order = {"completed": 0, "interrupted": 1, "diverged": 2}

    def key(result: Result) -> tuple[int, float]:
        value = figure(result) if result.comparable else -result.record.outcome.time
        return order.get(result.record.outcome.status, 3), value if math.isfinite(value) else math.inf

    return sorted(results, key=key)


def labels_of(records: Sequence[RunRecord]) -> list[str]:
    """A name for each run: its controller's, and what sets it apart where controllers repeat."""
    labels = [LABELS.get(record.scenario.controller, record.scenario.controller) for record in records]
    if len(set(labels)) < len(labels):
        flat = [flatten(scenario_to_dict(record.scenario)) for record in records]
        keys = {key for one in flat for key in one} - {"controller", "description"}
        varying = sorted(key for key in keys if len({repr(one.get(key)) for one in flat}) > 1)
        if 1 <= len(varying) <= 2:
            labels = [
                ", ".join([label, *(f"{_short(key)} = {_shown(one.get(key))}" for key in varying)])
                for label, one in zip(labels, flat, strict=True)
            ]
    if len(set(labels)) < len(labels):
        labels = [f"{label}, run {number}" for number, label in enumerate(labels, start=1)]
    return labels


def _short(key: str) -> str:
    """The part of a dotted key that says enough: k_s_max of controllers.tde_aismc.k_s_max.all."""
    return re.sub(r"^controllers\.[^.]*\.", "", key).removesuffix(".all")


def _shown(value: Any) -> str:
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def flatten(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def values_of(record: RunRecord, name: str) -> np.ndarray | None:
    """A variable of the record; None where it has none or no sample."""
    if name not in record.dataset or record.dataset.sizes.get("time", 0) == 0:
        return None
    values: np.ndarray = record.dataset[name].values
    return values


def number(value: float | None, digits: int = 4) -> str:
    """Such as 12.35 or 1.235×10⁻⁶; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0.0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        exponent = int(f"{abs(value):.{digits - 1}e}".split("e")[1])  # of the rounded value
        return f"{value:.{max(digits - 1 - exponent, 0)}f}"
    mantissa, power = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}×10{str(int(power)).translate(_SUPERSCRIPTS)}"


def _result(record: RunRecord, label: str, color: str, dash: str) -> Result:
    status, verdict = _judge(record)
    period = record.scenario.sample_time
    error, effort = values_of(record, "error"), values_of(record, "generalized_force")
    return Result(
        record=record,
        label=label,
        color=color,
        dash=dash,
        status=status,
        verdict=verdict,
        itae=math.nan if error is None else itae(record.dataset["time"].values[:-1], error[:-1], period),
        isv=math.nan if effort is None else isv(effort[:-1], period),
        magnitudes=tuple(_magnitudes(record, error, effort)),
    )


def _magnitudes(record: RunRecord, error: np.ndarray | None, effort: np.ndarray | None) -> list[Magnitude]:
    groups, units = (record.dataset[name].values.astype(str) for name in ("group", "unit"))

    def largest(values: np.ndarray | None, members: np.ndarray) -> float:
        return math.nan if values is None else float(np.abs(values[..., members]).max())

    return [
        Magnitude(
            group=group,
            unit=unit,
            peak_error=largest(error, members),
            final_error=largest(None if error is None else error[-1], members),
            peak_effort=largest(effort, members),
        )
        for group, unit in dict.fromkeys(zip(groups.tolist(), units.tolist(), strict=True))
        for members in [(groups == group) & (units == unit)]
    ]


def _judge(record: RunRecord) -> tuple[Status, str]:
    outcome, scenario = record.outcome, record.scenario
    samples = record.dataset.sizes.get("time", 0)
    if outcome.status == "diverged":
        return "diverged", _sentence(outcome.message)
    if not outcome.completed:
        counted = "no sample was" if samples == 0 else "1 sample was" if samples == 1 else f"{samples} samples were"
        return "interrupted", _sentence(f"{outcome.message}; {counted} recorded")
    error = values_of(record, "error")
    if error is None:
        return "unsettled", f"Completed {outcome.time:g} s; the record holds no errors to judge by."
    if outcome.time < scenario.reference.duration - 1e-9:
        return "unsettled", (
            f"Completed {outcome.time:g} s, before the planned motion ends at {scenario.reference.duration:g} s."
        )
    late = record.dataset["time"].values >= outcome.time - SETTLED_OVER - 1e-9
    units, names = (record.dataset[name].values.astype(str) for name in ("unit", "coordinate"))
    peaks = np.abs(error[late]).max(axis=0)
    largest = ", ".join(
        f"{number(float(peaks[units == unit].max()), 3)} {unit}" for unit in SETTLED_WITHIN if (units == unit).any()
    )
    excess = peaks / np.array([SETTLED_WITHIN[unit] for unit in units])
    if excess.max() <= 1.0:
        return "settled", f"Settled: over the last second no error exceeds {largest}."
    worst = int(np.argmax(excess))
    return "unsettled", (
        f"Completed {outcome.time:g} s but not settled: over the last second the error of {names[worst]} reaches "
        f"{number(float(peaks[worst]), 3)} {units[worst]}."
    )


def _sentence(text: str) -> str:
    return (
        f"{text[:1].upper()}{text[1:].rstrip('.')}." if not text.startswith(tuple(LABELS)) else f"{text.rstrip('.')}."
    )


def _styles_of(records: Sequence[RunRecord]) -> list[tuple[str, str]]:
    spare = 0
    styles: list[tuple[str, str]] = []
    for record in records:
        style = STYLES.get(record.scenario.controller)
        if style is None or any(color == style["color"] for color, _ in styles):
            styles.append((SPARE_COLORS[spare % len(SPARE_COLORS)], "solid"))
            spare += 1
        else:
            styles.append((style["color"], DASHES[style["linestyle"]]))
    return styles
