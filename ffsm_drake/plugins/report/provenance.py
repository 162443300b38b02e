"""Provenance of a run, to repeat it: command, scenario and software."""

import base64
import json
import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from ffsm_drake.common.numbers import number
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import Scenario, flatten, portable_scenario, shipped_scenarios
from ffsm_drake.scenario.layers import layers_in, whole_of
from ffsm_drake.show.results import Result

_MOST_OVERRIDES = 8  # in a command that is still read


def provenance(results: Sequence[Result], folder: Path) -> list[dict[str, Any]]:
    """Facts, command and scenario of each run; paths in the scenario start at ``folder``."""
    # a command names the nearest one; what the package ships needs no check
    shipped = {
        name: flatten(whole_of(Scenario, layers_in(path)))
        for name, path in shipped_scenarios().items()
    }
    items = []
    for result in results:
        record = result.record
        scenario, config = record.scenario, record.scenario.simulator_config
        data = portable_scenario(scenario, folder)
        text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True)
        file = f"{scenario.controller.replace(':', '-')}.yaml"
        wall = ", ".join(
            f"{name.replace('_', ' ')} {number(value, 3)} s"
            for name, value in record.wall_time.items()
        )
        facts = [
            ("Outcome", record.outcome.message),
            ("Controller", scenario.controller),
            ("Random seed", str(scenario.random_seed)),
            (
                "Control samples",
                f"{record.dataset.sizes.get('time', 0)}, every {scenario.sample_time:g} s",
            ),
            (
                "Integration",
                f"{config.integration_scheme}, steps of at most {config.max_step_size:g} s",
            ),
            ("Wall time", wall),
        ]
        if record.wall_time.get("advance_to", 0.0) > 0.0:
            facts.append(("Speed", f"{record.realtime_factor:.0f} times real time"))
        if record.identifier:
            facts.append(("SHA-256 of record.nc", record.identifier))
        items.append({
            "result": result, "facts": facts, "scenario": text, "file": file,
            "command": _command(flatten(data), shipped, file),
            "encoded": base64.b64encode(text.encode()).decode("ascii"),
        })  # fmt: skip
    return items


def _command(wanted: Mapping[str, Any], shipped: Mapping[str, Mapping[str, Any]], file: str) -> str:
    """The command that makes a run again: the nearest shipped scenario where few values differ,
    else the saved file.
    """
    candidates = []
    for name, known in shipped.items():
        if set(known) <= set(wanted):
            changed = {
                key: value
                for key, value in wanted.items()
                if key not in known or known[key] != value
            }
            candidates.append((len(changed), name, changed))
    count, name, changed = min(
        candidates, default=(math.inf, "", {}), key=lambda candidate: candidate[:2]
    )
    if count > _MOST_OVERRIDES:
        return shlex.join(["ffsm", "run", file])
    overrides = [
        word for key, value in changed.items() for word in ("--set", f"{key}={json.dumps(value)}")
    ]
    return shlex.join(["ffsm", "run", name, *overrides])


def software(records: Sequence[RunRecord]) -> list[tuple[str, str]]:
    """Versions; all of them if the runs differ."""
    names = dict.fromkeys(name for record in records for name in record.software)
    return [
        (name, " / ".join(dict.fromkeys(record.software.get(name, "?") for record in records)))
        for name in names
    ]
