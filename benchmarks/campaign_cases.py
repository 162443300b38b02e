"""A campaign's case end to end, side by side over alone.

    OPENBLAS_NUM_THREADS=1 python benchmarks/campaign_cases.py [NAME ...] [--repeats 10]
        [--cases 16] [--duration S] [--dynamics generated]

Processor time of a case as a worker and the driver spend it: its scenario checked, built and run,
predictions, metrics, and its row stored. The same cases run one by one and as one batch, in turns
in one process, because a machine's speed changes from minute to minute; minima of the repeats.
Names of shipped campaigns are those, ``payload_uncertainty`` with its four laws; shipped scenarios
have a seed and payload that differ from case to case. Other dynamics than Drake's are the
batch's; one by one the cases run with Drake's.
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ffsm_drake import load_scenario
from ffsm_drake.plugins.campaign.cases import Case, make_cases
from ffsm_drake.plugins.campaign.evaluate import Batch, Evaluator
from ffsm_drake.plugins.campaign.spec import Spec, load_spec, shipped_campaigns, spec_from_data
from ffsm_drake.plugins.campaign.store import create_store
from ffsm_drake.runs.batches import usual_batch
from ffsm_drake.scenario import shipped_scenarios
from ffsm_drake.spacecraft.dynamics import DRAKE

NAMES = (
    "payload_uncertainty",
    "flight_sensors",
    "flexible_panels",
    "thrusters_and_wheels",
    "tumbling_capture",
    "free_floating",
)
SPREAD = 0.05  # of the payload's masses, true and nominal


def spec_of(name: str, folder: Path, *, cases: int, duration: float | None) -> Spec:
    """A shipped campaign of that name, else one of the scenario, with one case more than so many:
    the first may run with two dynamics.
    """
    shipped = None if name in shipped_scenarios() else shipped_campaigns()[name]
    data: dict[str, Any] = {} if shipped is None else yaml.safe_load(shipped.read_text("utf-8"))
    if shipped is None:
        payload = load_scenario(name).payload
        data["parameters"] = {
            f"payload.{kind}.mass": {
                "distribution": "uniform",
                "low": (1.0 - SPREAD) * properties.mass,
                "high": (1.0 + SPREAD) * properties.mass,
            }
            for kind, properties in (("truth", payload.truth), ("nominal", payload.nominal))
        }
        data["scenario"] = name
    if duration is not None:
        data["overrides"] = {**data.get("overrides", {}), "duration": duration}
        data["settled"] = {**data.get("settled", {}), "hold": min(1.0, duration)}
    file = folder / f"{name}.yaml"
    file.write_text(yaml.safe_dump(data | {"cases": cases + 1}, sort_keys=False), encoding="utf-8")
    return load_spec(file)


def processor_time(
    evaluator: Evaluator, spec: Spec, batches: Sequence[Batch], database: Path
) -> float:
    """Seconds to run batches and store their rows in a new database.

    Raises SystemExit: a run failed.
    """
    with create_store(database, spec, make_cases(spec)) as store:
        start = time.process_time()
        for batch in batches:
            rows = evaluator.evaluate_batch(batch)
            store.add(batch, rows)
            failed = [row["message"] for row in rows if row["outcome"] == "error"]
            if failed:
                raise SystemExit(f"{batch.controller}: {failed[0]}")
        seconds = time.process_time() - start
    database.unlink()
    return seconds


def minima(
    spec: Spec, controller: str, cases: Sequence[Case], repeats: int, folder: Path, dynamics: str
) -> np.ndarray:
    """Of one law, s per case: alone and side by side."""
    whole = Batch(tuple(cases), controller)
    other = spec_from_data({**spec.data, "dynamics": dynamics})
    ways = {
        "alone": (spec, Evaluator(spec), whole.parts),
        "batched": (other, Evaluator(other), (whole,)),
    }
    seconds = {way: list[float]() for way in ways}
    for _ in range(repeats):
        for way, (own, evaluator, batches) in ways.items():
            took = processor_time(evaluator, own, batches, folder / f"{way}.db")
            seconds[way].append(took / len(cases))
    return np.array([min(seconds[way]) for way in ways])


def report(name: str, seconds: np.ndarray) -> None:
    """Print times per case, and their ratio."""
    alone, batched = 1e3 * seconds
    told = f"{alone:.1f} ms alone, {batched:.1f} ms side by side: {batched / alone:.3f}"
    print(f"{name}: {told}", flush=True)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("names", nargs="*", help=f"default: {', '.join(NAMES)}")
    parser.add_argument("--repeats", type=int, default=10, help="of each (default: 10)")
    parser.add_argument("--cases", type=int, default=usual_batch(), help="in a batch")
    parser.add_argument("--duration", type=float, help="of a run, s (default: the scenario's)")
    parser.add_argument("--dynamics", default=DRAKE, help="of the batch (default: drake)")
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        for name in options.names or NAMES:
            spec = spec_of(name, Path(folder), cases=options.cases, duration=options.duration)
            cases, total = tuple(make_cases(spec))[1:], np.zeros(2)
            for controller in spec.controllers:
                given = options.repeats, Path(folder), options.dynamics
                seconds = minima(spec, controller, cases, *given)
                report(f"{name}, {controller}", seconds)
                total += seconds / len(spec.controllers)
            if len(spec.controllers) > 1:
                report(f"{name}, mean of its laws", total)


if __name__ == "__main__":
    main()
