"""A campaign's case end to end, in a batch on an engine over alone on Drake.

    OPENBLAS_NUM_THREADS=1 python benchmarks/campaign_cases.py [NAME ...] [--repeats 10]
        [--cases 16] [--duration S] [--engine compiled [--compare]]

Processor time of a case as a worker and the driver spend it: its scenario checked, built and run,
predictions, metrics, and its row stored. The same cases run one by one and as one batch, in turns
in one process, because a machine's speed changes from minute to minute; minima of the repeats.
Names of shipped campaigns are those, ``payload_uncertainty`` with its four laws, and ``NAME.yaml``
is a file of one. Shipped scenarios have a seed and payload that differ from case to case.
``--engine`` is the engine of the batch; one by one the cases run on Drake. ``--compare`` measures
no time: it compares their rows with Drake's.
"""

import argparse
import collections
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ffsm_drake import load_scenario
from ffsm_drake.plugins.campaign.cases import Case, make_cases
from ffsm_drake.plugins.campaign.evaluate import Batch, Evaluator, alone
from ffsm_drake.plugins.campaign.rows import FIRST_LIMIT, Row, metrics_of
from ffsm_drake.plugins.campaign.spec import Spec, load_spec, shipped_campaigns, spec_from_data
from ffsm_drake.plugins.campaign.store import create_store
from ffsm_drake.runs.engine import DRAKE
from ffsm_drake.scenario import shipped_scenarios

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
    """A shipped campaign of that name, else one of the scenario, with at least one case more than
    so many: the first may run on two engines.
    """
    own = Path(name) if name.endswith(".yaml") else None
    shipped = own or (None if name in shipped_scenarios() else shipped_campaigns()[name])
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
        settled = data.get("settled", {})
        data["settled"] = {**settled, "hold": min(settled.get("hold", 1.0), duration)}
    file = folder / f"{Path(name).stem}.yaml"
    data["cases"] = max(cases + 1, data.get("cases", 0))
    file.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
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
                raise SystemExit(f"{batch[0][1]}: {failed[0]}")
        seconds = time.process_time() - start
    database.unlink()
    return seconds


def minima(
    spec: Spec, controller: str, cases: Sequence[Case], repeats: int, folder: Path, engine: str
) -> np.ndarray:
    """Of one law, s per case: alone and in a batch."""
    whole = tuple((case, controller) for case in cases)
    drake, other = (spec_from_data({**spec.data, "engine": each}) for each in (DRAKE, engine))
    ways = {
        "alone": (drake, Evaluator(drake), alone(whole)),
        "batched": (other, Evaluator(other), (whole,)),
    }
    seconds = {way: list[float]() for way in ways}
    for _ in range(repeats):
        for way, (own, evaluator, batches) in ways.items():
            took = processor_time(evaluator, own, batches, folder / f"{way}.db")
            seconds[way].append(took / len(cases))
    return np.array([min(seconds[way]) for way in ways])


def compare(spec: Spec, controller: str, cases: Sequence[Case], engine: str) -> str:
    """How far the rows of cases are from those with Drake, in words."""
    whole, rows = tuple((case, controller) for case in cases), list[list[Row]]()
    for each in (DRAKE, engine):
        evaluator = Evaluator(spec_from_data({**spec.data, "engine": each}))
        rows.append(evaluator.evaluate_batch(whole))
    others, largest, where = 0, 0.0, "none"
    for own, other in zip(*rows, strict=True):
        others += any(own.get(name) != other.get(name) for name in ("outcome", FIRST_LIMIT))
        for name in set(metrics_of(spec)) & set(own):
            if isinstance(own[name], float) and isinstance(other[name], float):
                off = abs(own[name] - other[name]) / (abs(own[name]) or 1.0)
                largest, where = max((largest, where), (off, name))
    counts = collections.Counter(own["outcome"] for own in rows[0])
    found = ", ".join(f"{count} {outcome}" for outcome, count in counts.items())
    differ = f"{others} outcomes or first limits differ"
    return f"{found}; {differ}; numbers by {largest:.1e} at most ({where})"


def report(name: str, seconds: np.ndarray) -> None:
    """Print times per case, and their ratio."""
    alone, batched = 1e3 * seconds
    told = f"{alone:.1f} ms alone, {batched:.1f} ms in a batch: {batched / alone:.3f}"
    print(f"{name}: {told}", flush=True)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("names", nargs="*", help=f"default: {', '.join(NAMES)}")
    parser.add_argument("--repeats", type=int, default=10, help="of each (default: 10)")
    parser.add_argument("--cases", type=int, default=16, help="in a batch")
    parser.add_argument("--duration", type=float, help="of a run, s (default: the scenario's)")
    parser.add_argument("--engine", default="compiled", help="of the batch (default: compiled)")
    parser.add_argument("--compare", action="store_true", help="rows with both engines")
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        for name in options.names or NAMES:
            spec = spec_of(name, Path(folder), cases=options.cases, duration=options.duration)
            cases, total = tuple(make_cases(spec))[1 : options.cases + 1], np.zeros(2)
            for controller in spec.controllers:
                if options.compare:
                    told = compare(spec, controller, cases, options.engine)
                    print(f"{name}, {controller}: {told}", flush=True)
                    continue
                given = options.repeats, Path(folder), options.engine
                seconds = minima(spec, controller, cases, *given)
                report(f"{name}, {controller}", seconds)
                total += seconds / len(spec.controllers)
            if len(spec.controllers) > 1 and not options.compare:
                report(f"{name}, mean of its laws", total)


if __name__ == "__main__":
    main()
