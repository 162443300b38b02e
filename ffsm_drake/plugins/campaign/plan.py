"""The plan and the status of a campaign, as plain text."""

import collections
import itertools
import re
import statistics
from collections.abc import Mapping, Sequence

from ffsm_drake.common.numbers import counted
from ffsm_drake.common.steps import step
from ffsm_drake.plugins.campaign.cases import Case, make_cases
from ffsm_drake.plugins.campaign.evaluate import Evaluator
from ffsm_drake.plugins.campaign.rows import (
    COMPLETED,
    DRAKE_DIFFERENCE,
    DRAKE_OUTCOME,
    ENGINE,
    NO_PREDICTION,
    OUTCOMES,
    Row,
    engine_columns,
)
from ffsm_drake.plugins.campaign.run import MEMORY_LIMIT, check_cases, duration_text
from ffsm_drake.plugins.campaign.spec import Spec
from ffsm_drake.plugins.campaign.store import Store
from ffsm_drake.runs.engine import DRAKE

_SHOWN = 5
_WINDOW = 1000  # runs over which memory is averaged
_NUMBER = re.compile(r"[-+]?\d[\d.]*(e[-+]?\d+)?|\b(nan|inf)\b")
_IMPORTS = 10.0  # s, many times what a first run takes to load modules


def plan_text(spec: Spec, *, workers: int) -> str:
    """Return a summary of the cases and an estimate of the duration, for which cases are run until
    one reaches its end.

    Raises:
      CampaignError, ModelError, ScenarioError: a value cannot be used.
    """
    check_cases(spec)
    first = list(itertools.islice(make_cases(spec), _SHOWN))
    rows, problems = _first_runs(spec, first)
    lines = _case_lines(spec, first)
    seconds = [row["wall_time"] for row in rows.values()]
    total = statistics.fmean(seconds) * spec.runs / workers
    per_run = ", ".join(
        f"{spec.label(name)} {value:.2f} s"
        for name, value in zip(spec.controllers, seconds, strict=True)
    )
    lines += [
        "",
        f"one run: {per_run}; all of them with {counted(workers, 'worker')}: about "
        f"{duration_text(total)}",
    ]
    if engine_columns(spec):
        engines = collections.Counter(filter(None, (row[ENGINE] for row in rows.values())))
        lines += _engine_lines(spec, {name: n * spec.cases for name, n in engines.items()})
    lines += problems.values()
    if early := [name for name, row in rows.items() if row["outcome"] not in COMPLETED]:
        lines.append(
            f"{', '.join(early)}: none of {counted(len(first), 'case')} reached its end, so a run "
            "that does takes longer"
        )
    lines += [
        f"{name}: {row['message']}"
        for name, row in rows.items()
        if NO_PREDICTION in row["message"] and row["outcome"] != "error"
    ]
    return "\n".join(lines)


def _first_runs(spec: Spec, first: Sequence[Case]) -> tuple[dict[str, Row], dict[str, str]]:
    """Run some cases with each controller, the last one first, until one reaches its end.

    Returns: by controller, the row of the last run, and what the first one that failed says.
    """
    evaluator = Evaluator(spec)
    rows, problems = dict[str, Row](), dict[str, str]()

    def evaluate(case: Case, name: str) -> Row:
        with step(f"case {case.index} with {name}"):
            return evaluator.evaluate(case, name)

    for name in spec.controllers:
        rows[name] = row = evaluate(first[-1], name)
        if row["outcome"] in COMPLETED and row["wall_time"] > _IMPORTS:
            continue
        for case in reversed(first):
            rows[name] = row = evaluate(case, name)
            if row["outcome"] in COMPLETED:
                break
            said = f"case {case.index} with {spec.label(name)}: {row['outcome']}: {row['message']}"
            problems.setdefault(name, said)
    return rows, problems


def _case_lines(spec: Spec, first: Sequence[Case]) -> list[str]:
    """What a campaign runs, and the values of its first cases."""
    width = max(map(len, spec.names)) + 2
    tolerance = ", ".join(f"{group} {value:g}" for group, value in spec.settled.tolerance.items())
    return [
        spec.description or "campaign",
        f"{counted(spec.cases, 'case')} ({spec.sampling}, seed {spec.seed}), each with "
        f"{', '.join(map(spec.label, spec.controllers))}: {counted(spec.runs, 'run')}",
        f"settled: |e| within {tolerance} (rad, m) throughout the last {spec.settled.hold:g} s",
        "",
        f"{'value':<{width}}" + "".join(f"{f'case {case.index}':>14}" for case in first),
        *(
            f"{name:<{width}}" + "".join(f"{_short(spec, name, case):>14}" for case in first)
            for name in spec.names
        ),
    ]


def status_text(store: Store) -> str:
    """Progress of a campaign, outcomes by controller, run times and memory."""
    spec, counts = store.spec, store.counts()
    done = store.num_results()
    width = max(12, *(len(spec.label(name)) + 1 for name in counts))
    lines = [
        f"{store.path}: {spec.description or 'campaign'}",
        f"{done} of {counted(store.runs, 'run')} ({100.0 * done / max(store.runs, 1):.1f} %)"
        + (f" of shard {store.shard}" if store.shard.count > 1 else ""),
        "",
        f"{'controller':<{width}}"
        + "".join(f"{name.replace('_', ' '):>13}" for name in OUTCOMES)
        + f"{'mean s':>9}",
    ]
    seconds = dict(
        store.query("SELECT controller, avg(wall_time) FROM results GROUP BY controller")
    )
    for controller, outcomes in counts.items():
        mean = f"{seconds[controller]:.2f}" if seconds.get(controller) is not None else "-"
        lines.append(
            f"{spec.label(controller):<{width}}"
            + "".join(f"{outcomes[name]:>13}" for name in OUTCOMES)
            + f"{mean:>9}"
        )
    causes = [f"error in {counted(count, 'run')}, such as: {text}" for count, text in errors(store)]
    lines += (["", *causes] if causes else []) + _engines(store)
    memory = (
        "SELECT avg(rss_mib), max(rss_mib) FROM (SELECT rss_mib FROM results ORDER BY case_index "
        "{} LIMIT ?)"
    )
    if done:
        first, last = (
            next(store.query(memory.format(order), (_WINDOW,))) for order in ("ASC", "DESC")
        )
        if first[0] is not None and last[0] is not None:
            lines += [
                "",
                f"memory of a worker, mean and largest: {first[0]:.0f} and {first[1]:.0f} MiB in "
                f"the first {counted(min(done, _WINDOW), 'run')}, {last[0]:.0f} and {last[1]:.0f} "
                f"MiB in the last (limit {MEMORY_LIMIT:.0f} MiB)",
            ]
    return "\n".join(lines)


def errors(store: Store) -> list[tuple[int, str]]:
    """The most frequent causes of errors: number of runs, and a message. Messages that differ in
    numbers have the same cause.
    """
    causes = dict[str, list[str]]()
    select = "SELECT message FROM results WHERE outcome = 'error' ORDER BY case_index"
    for (message,) in store.query(select):
        causes.setdefault(_NUMBER.sub("", message), []).append(message)
    ranked = sorted(causes.values(), key=len, reverse=True)[:_SHOWN]
    return [(len(each), each[0]) for each in ranked]


def _engines(store: Store) -> list[str]:
    """Number of runs with the engine and with Drake, and how those with both compare."""
    if not (columns := engine_columns(store.spec)):
        return []
    name = columns[0]
    counts = f"SELECT {name}, count(*) FROM results WHERE {name} IS NOT NULL GROUP BY 1"
    lines = _engine_lines(store.spec, dict(store.query(counts)))
    select = (
        f"SELECT count(*), max({DRAKE_DIFFERENCE}), total({DRAKE_OUTCOME} != outcome) FROM results "
        f"WHERE {DRAKE_OUTCOME} IS NOT NULL"
    )
    runs, difference, outcomes = next(store.query(select))
    if runs:
        lines[0] += (
            f"; {counted(runs, 'run')} with Drake too: {outcomes:.0f} with another outcome, errors "
            f"differ by at most {difference:.1e} (rad, m)"
        )
    return ["", *lines]


def _engine_lines(spec: Spec, counts: Mapping[str, int]) -> list[str]:
    """The engine of a campaign, and a line for each reason of runs on Drake, or of calls of laws:
    those that are most frequent.
    """
    own = sum(runs for name, runs in counts.items() if not name.startswith(DRAKE))
    lines = [f"engine: {spec.engine}, {counted(own, 'run')}"]
    ranked = sorted({*counts} - {spec.engine}, key=lambda name: -counts[name])
    lines += [f"engine: {name}, {counted(counts[name], 'run')}" for name in ranked[:_SHOWN]]
    if more := ranked[_SHOWN:]:
        runs = counted(sum(counts[name] for name in more), "run")
        lines.append(f"engine: for {counted(len(more), 'other reason')}: {runs}")
    return lines


def _short(spec: Spec, name: str, case: Case) -> str:
    if name in spec.distributions and spec.distributions[name].levels:
        return spec.level(name, case.index)[:12]
    value = case.values[name]
    if isinstance(value, list):
        return f"[{value[0]:.3g}, …]" if value and isinstance(value[0], float) else str(value)[:12]
    return f"{value:.4g}" if isinstance(value, float) else str(value)[:12]
