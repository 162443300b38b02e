"""Remedies as a scenario to run, ``remedy.yaml``.

It applies the first change that helps by itself or, against saturation, all changes that help
together. The other changes are comments.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ffsm_drake.common.files import write_text
from ffsm_drake.plugins.design.remedies import remedies
from ffsm_drake.plugins.design.stability.load import advice, saturated_shares
from ffsm_drake.runs.reading import IDENTIFIER
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import (
    MANIFEST_FILE,
    Scenario,
    override_scenario,
    portable_scenario,
)
from ffsm_drake.scenario.strict_yaml import write_yaml
from ffsm_drake.systems.parts.advice import Advice

REMEDY_FILE = "remedy.yaml"


def run_advice(
    record: RunRecord,
) -> tuple[dict[str, float], tuple[Advice, ...], tuple[Advice, ...]]:
    """Remedies for a finished run.

    Returns: the share of saturated samples by actuator; remedies for saturation; and, of a failed
    run, those for other causes.
    """
    values = {str(name): each.values for name, each in record.dataset.data_vars.items()}
    saturated = saturated_shares(record.scenario, values)
    found = advice(record.mission, saturated, settles=record.ending.is_settled)
    others = remedies(record.mission, fails=True) if record.ending.is_failure else ()
    return saturated, found, others


def write_remedy(record: RunRecord, directory: Path) -> Path | None:
    """Write ``remedy.yaml``, which extends the run's scenario, into the run's folder.

    Args:
      record: the run.
      directory: the run's folder, or the one that holds it.

    Returns: the file; None without a remedy, or if no folder there holds the run.

    Raises:
      RecordError: the file cannot be written.
    """
    places = [directory / MANIFEST_FILE, *sorted(directory.glob(f"*/{MANIFEST_FILE}"))]
    folder = next((x.parent for x in places if record.identifier == _identifier(x)), None)
    _, together, alone = ({}, (), ()) if folder is None else run_advice(record)
    if folder is None or not (together or alone):
        return None
    applied, *others = _ordered(together, alone)
    reason = applied.reason.partition(":")[0]
    described = f"{record.scenario.description}; remedy: {reason}".removeprefix("; ")
    base = {"extends": MANIFEST_FILE, "description": described}
    write_text(folder / REMEDY_FILE, _text(base | _nested(applied.changes), applied, others))
    return folder / REMEDY_FILE


def write_remedied(
    scenario: Scenario, together: Sequence[Advice], alone: Sequence[Advice], folder: Path
) -> Path:
    """Write ``remedy.yaml`` of a scenario without a run, whole, from one or more changes that help
    together or alone. Raises as ``write_remedy``.
    """
    applied, *others = _ordered(together, alone)
    changed = portable_scenario(override_scenario(scenario, [applied.changes]), folder)
    write_text(folder / REMEDY_FILE, _text(changed, applied, others))
    return folder / REMEDY_FILE


def _ordered(together: Sequence[Advice], alone: Sequence[Advice]) -> list[Advice]:
    """The change to apply, then the others; another law is never applied with further changes."""
    joint = [each for each in together if "controller" not in each.changes] or together[:1]
    rest = [each for each in together if each not in joint]
    if joint:
        changes = {key: value for each in joint for key, value in each.changes.items()}
        joint = [Advice(changes=changes, reason="; ".join(each.reason for each in joint))]
    return [*alone, *joint, *rest]


def _identifier(manifest: Path) -> str:
    try:
        return str(json.loads(manifest.read_text(encoding="utf-8"))[IDENTIFIER])
    except (OSError, ValueError, LookupError, TypeError):
        return "none"


def _text(data: Mapping[str, Any], applied: Advice, others: Sequence[Advice]) -> str:
    """The file: the first remedy applied, the others as comments."""
    text = f"# Applied: {applied.reason}.\n{write_yaml(data, allow_unicode=True)}"
    for other in others:
        lines = write_yaml(_nested(other.changes)).splitlines()
        text += f"\n# In place of it: {other.reason}.\n"
        text += "".join(f"# {line}\n" for line in lines)
    return text


def _nested(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Changes by dotted key, as a file nests them."""
    nested = dict[str, Any]()
    for key, value in changes.items():
        *outer, last = key.split(".")
        inner = nested
        for name in outer:
            inner = inner.setdefault(name, {})
        inner[last] = value
    return nested
