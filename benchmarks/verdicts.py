"""What is said of random missions before they run, against how the runs end.

    python benchmarks/verdicts.py [--number 200] [--captures 60] [--built 0] [--seed 0]
        [--workers 1] [--out out/verdicts.json]

Missions are drawn from all that scenarios can say (``random_missions``), or of spacecraft that are
built at random (``built_missions``); one that cannot be loaded or built is drawn again. Of each the
verdict is asked (``predict``), then it runs. A *miss* is a run that diverges, grows at its end,
misses its target, fails or breaks a limit that nothing enforces (as parts that overlap), of which
no warning was given; a *false alarm* is a warning of a run that settles within its limits. Both are
printed with the command that repeats them.

Results are written as they come; the same command goes on where the last one stopped. A mission
that takes longer than --time-limit, or ends its process, becomes a result like any other.
"""

import argparse
import dataclasses
import functools
import json
import shlex
import statistics
import time
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import built_missions
import numpy as np
import random_missions
from random_missions import DrawnMission

from ffsm_drake import RunLog, Scenario, load_scenario
from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.common.files import write_text
from ffsm_drake.common.time_limit import TimeLimit, time_limit
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.design.remarks import plan_remarks
from ffsm_drake.plugins.design.verdict import verdict
from ffsm_drake.plugins.workers.pool import Runs, WorkerLost, local_workers, stop_on_signals
from ffsm_drake.runs.dataset import make_table
from ffsm_drake.runs.exceeded_limits import broken_limits
from ffsm_drake.runs.simulate import prepare

GOOD, WARNED, UNKNOWN = "no alarm", "alarm", "cannot say"
KINDS: dict[str, Callable[[np.random.Generator], DrawnMission]] = {
    "mission": functools.partial(random_missions.draw, "mission"),
    "capture": functools.partial(random_missions.draw, "capture"),
    "built": built_missions.draw,
}
ENDS = (
    "settled",
    "not settled",
    "growing",
    "beyond",
    "missed",
    "diverged",
    "failed",
    "interrupted",
)
COMPLETED = ("settled", "not settled", "growing")
BAD = ("growing", "beyond", "missed", "diverged", "failed")
_LAST = 2.0  # s, at the end, in which a settled run stays within its tolerance
_REACH, _ANGLE = 0.1, np.deg2rad(10.0)  # m, rad; beyond these a gripper does not close
_LOST = "its process ended every time"
_ATTEMPTS = 200  # draws of one mission


@dataclasses.dataclass(frozen=True, kw_only=True)
class Predicted:
    """What is said before a run."""

    warnings: list[str] = dataclasses.field(default_factory=list)
    beside: list[str] = dataclasses.field(default_factory=list)  # remarks that are no alarm
    unknown: str = ""  # why there is no verdict
    linear: str = ""  # status of the linear loop, without a rehearsal
    cpu: dict[str, float] = dataclasses.field(default_factory=dict)  # processor time by command, s

    @property
    def said(self) -> str:
        """GOOD, WARNED or UNKNOWN."""
        return WARNED if self.warnings else UNKNOWN if self.unknown else GOOD


@dataclasses.dataclass(frozen=True, kw_only=True)
class End:
    """How a run ended."""

    kind: str  # one of ENDS
    time: float  # s
    worst: str = ""  # coordinate that is off most, in tolerances, in the last two seconds
    off: float = 0.0  # by so much, rad or m
    message: str = ""


def predict(scenario: Scenario) -> Predicted:
    """What ``ffsm validate`` says of a scenario: the one place that asks for it.

    Remarks on the plan stand beside the verdict, whether it is an alarm or not.
    """
    start = time.process_time()
    remarks = plan_remarks(scenario)
    found = verdict(scenario, advises=False)
    nothing = found.linear is None and found.run is None
    return Predicted(
        warnings=found.warnings if found.is_alarm else [],
        beside=remarks if found.is_alarm else [*remarks, *found.warnings],
        unknown=found.not_linear if nothing else "",
        linear="" if found.linear is None else found.linear.status,
        cpu={"validate": time.process_time() - start},
    )


def _asked(scenario: Scenario) -> Predicted:
    """As ``predict``; an error is a verdict that cannot be given."""
    try:
        return predict(scenario)
    except Exception as error:
        return Predicted(unknown=f"{type(error).__name__}: {one_line(error)}")


def end_of(log: RunLog) -> End:
    """The class of a run's end.

    Settled: every error that counts within its tolerance (``_tolerance``) over the last two
    seconds. Growing: the largest of the last second exceeds a third of its tolerance, and three
    times that of the four seconds before; or 1.3 times that, and that twice the one of four seconds
    earlier. Missed: the target was out of the gripper's reach. Runs of less than nine seconds, or
    with a grasp that late, are divided likewise.
    """
    last, status = float(log.time[-1]), log.outcome.status
    if missed := _missed(log):
        return End(kind="missed", time=last, message=missed)
    if status in ("diverged", "interrupted"):
        return End(kind=status, time=last, message=log.outcome.message)
    tolerance = _tolerance(log)
    share = np.abs(log.tracked.error) / tolerance
    begin = log.scenario.grasp_time if last > log.scenario.grasp_time else 0.0
    second = min(1.0, (last - begin) / 4.0)

    def largest(first: float, end: float) -> np.ndarray:
        """The largest shares (k) between two times before the end."""
        chosen = (log.time > max(last - first, begin)) & (log.time <= last - end)
        return share[chosen].max(axis=0, initial=0.0)

    spans = np.array([0.0, 1.0, 5.0, 9.0]) * second
    now, before, earlier = (largest(*span) for span in zip(spans[1:], spans[:-1], strict=True))
    sudden = (now > 3.0 * before) & (now > 0.33)
    steady = (now > 1.3 * before) & (before > 2.0 * earlier) & (earlier > 0.0) & (now > 0.33)
    at_end = largest(_LAST * second, 0.0)
    i = int(np.argmax(at_end))
    kind = "settled" if at_end[i] <= 1.0 else "not settled"
    if (sudden | steady).any():
        i, kind = int(np.argmax(np.where(sudden | steady, now, 0.0))), "growing"
    return End(
        kind=kind, time=last, worst=log.tracked.names[i], off=float(at_end[i] * tolerance[i])
    )


def _tolerance(log: RunLog) -> np.ndarray:
    """That of each error that counts, and what the sensors' bias adds, which no controller can
    know.
    """
    bias = log.scenario.sensing.position_bias
    names, groups = log.tracked.names, log.tracked.groups

    def of(name: str, group: str) -> float:
        return next((bias[key] for key in (name, group, "all") if key in bias), 0.0)

    return np.array([
        log.scenario.tolerance_of(name, group) + (
            abs(of(name, group)) if name in log.coordinates.joints
            # of the base's axes, which are not the world's
            else float(np.linalg.norm([of(_seen(name)[:-1] + axis, group) for axis in "xyz"]))
        )
        for name, group in zip(names, groups, strict=True)
    ])  # fmt: skip


def _seen(name: str) -> str:
    """The coordinate whose bias is that of another: a frame goes with the base."""
    return name.replace("frame", "base")


def _missed(log: RunLog) -> str:
    """By how much a target was out of the gripper's reach; empty where it was not."""
    if log.outcome.status == "missed":
        return log.outcome.message
    if log.grasp is None or log.grasp.contact is None:
        return ""
    angle, distance = (float(np.linalg.norm(part)) for part in np.split(log.grasp.offset, 2))
    return "" if distance < _REACH and angle < _ANGLE else f"by {distance:.3g} m, {angle:.3g} rad"


def fly(scenario: Scenario) -> End:
    """Build and run a scenario, with other noise than the verdict's rehearsal had."""
    other = dataclasses.replace(scenario, random_seed=scenario.random_seed + 1)
    rollout = prepare(other, check_stability=False)
    try:
        log = rollout.run()
        end = end_of(log)
        broken = (
            broken_limits(make_mission(other), make_table(log)) if end.kind in COMPLETED else []
        )
        return dataclasses.replace(end, kind="beyond", message=broken[0]) if broken else end
    finally:
        rollout.release()


def drawn(kind: str, number: int, seed: int) -> tuple[DrawnMission, Scenario, list[str]]:
    """The mission of a number, its scenario, and the errors of those drawn before it."""
    rng = np.random.default_rng([seed, number, list(KINDS).index(kind)])
    refused = list[str]()
    for _ in range(_ATTEMPTS):
        try:
            mission = KINDS[kind](rng)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                scenario = load_scenario(mission.base, mission.overrides)
                rollout = prepare(scenario, check_stability=False)
                rollout.check()
                rollout.release()
        except FfsmError as error:
            refused.append(one_line(error))
        else:
            return mission, scenario, refused
    raise RuntimeError(f"{_ATTEMPTS} missions refused, the last: {refused[-1]}")


def evaluate(kind: str, number: int, seed: int, seconds: float) -> dict[str, Any]:
    """The result of one mission, as plain data; errors become part of it."""
    found, predicted = dict[str, Any](), Predicted(unknown="not asked")
    stage, cpu = "draw", 0.0
    try:
        with time_limit(seconds):
            mission, scenario, refused = drawn(kind, number, seed)
            found = {**dataclasses.asdict(mission), "refused": refused}
            stage = "verdict"
            predicted = _asked(scenario)
            stage, start = "run", time.process_time()
            end = fly(scenario)
            cpu = time.process_time() - start
    except TimeLimit as error:
        end = End(kind="interrupted", time=0.0, message=f"{stage}: {error}")
    except Exception as error:
        text = f"{stage}: {type(error).__name__}: {one_line(error)}"
        end = End(kind="failed", time=0.0, message=text)
    return make_result(found, predicted=predicted, end=end, cpu=cpu)


def make_result(
    found: Mapping[str, Any] | None = None,
    *,
    predicted: Predicted | None = None,
    end: End,
    cpu: float = 0.0,
) -> dict[str, Any]:
    """A result as plain data.

    Args: the mission and what was refused before it; what was said; how it ended; what the run
    cost, s.
    """
    predicted = predicted or Predicted(unknown="not asked")
    return {
        "base": "",
        "overrides": [],
        "refused": [],
        **(found or {}),
        "verdict": {"said": predicted.said, **dataclasses.asdict(predicted)},
        "end": dataclasses.asdict(end),
        "cpu": {**predicted.cpu, "run": cpu},
    }


def evaluate_all(
    tasks: Sequence[tuple[str, int]],
    *,
    seed: int,
    workers: int,
    seconds: float,
    keep: Callable[[str, int, dict[str, Any]], None],
) -> None:
    """Evaluate missions, by kind and number, in processes of their own; ``keep`` gets each
    result.
    """
    with stop_on_signals() as stop, local_workers(workers) as crew:
        runs = Runs(evaluate, tasks, lambda task: (*task, seed, seconds), crew, stop)
        for (kind, number), result in runs.results():
            if isinstance(result, WorkerLost):
                result = make_result(end=End(kind="failed", time=0.0, message=_LOST))
            keep(kind, number, result)


def command(result: Mapping[str, Any]) -> str:
    """The command that repeats a mission."""
    overrides = "".join(f" --set {shlex.quote(text)}" for text in result["overrides"])
    return f"ffsm run {result['base']}{overrides}"


def is_miss(result: Mapping[str, Any]) -> bool:
    """A bad end of which nothing was said."""
    return result["end"]["kind"] in BAD and result["verdict"]["said"] != WARNED


def is_false_alarm(result: Mapping[str, Any]) -> bool:
    """A warning of a run that settles."""
    return result["end"]["kind"] == "settled" and result["verdict"]["said"] == WARNED


def _ends(rows: Sequence[Mapping[str, Any]], key: str, values: Sequence[str]) -> list[str]:
    """Lines with the number of runs of each end, for each value of a key of the verdict."""
    counts = Counter((row["verdict"][key], row["end"]["kind"]) for row in rows)
    width = max(len(name) for name in ENDS) + 2
    return [f"{'':12}" + "".join(f"{name:>{width}}" for name in ENDS)] + [
        f"{value or 'none':12}" + "".join(f"{counts[value, end]:{width}d}" for end in ENDS)
        for value in values
    ]


def table(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Counts of ends by verdict, and by the linear check alone; misses and false alarms, and what
    the verdict costs of a complete run.
    """
    rows = list(results.values())
    lines = _ends(rows, "said", (GOOD, WARNED, UNKNOWN))
    linear = sorted({row["verdict"]["linear"] for row in rows})
    lines += ["", "the linear check, without a rehearsal", *_ends(rows, "linear", linear)]
    for title, chosen in (("miss", is_miss), ("false alarm", is_false_alarm)):
        found = {name: row for name, row in results.items() if chosen(row)}
        share = len(found) / max(len(rows), 1)
        lines.append(f"\n{title}: {len(found)} of {len(rows)} ({100.0 * share:.1f} %)")
        for name, row in found.items():
            end = row["end"]
            what = f"{end['kind']} at {end['time']:.4g} s {end['worst']} {end['message']}".strip()
            told = [*row["verdict"]["warnings"], row["verdict"]["unknown"]]
            lines += [f"- {name}: {what}", f"    {command(row)}"]
            lines += [f"    said: {text}" for text in told if text]
    refused = sum(len(row["refused"]) for row in rows)
    lines.append(f"\nrefused and drawn again: {refused}")
    for name in ("validate",):
        ratios = [
            row["cpu"][name] / row["cpu"]["run"]
            for row in rows
            if row["end"]["kind"] in COMPLETED and name in row["cpu"]
        ]
        if ratios:
            middle, most = statistics.median(ratios), max(ratios)
            lines.append(
                f"{name}: {middle:.2f} of a complete run (median), at most {most:.2f} (CPU)"
            )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--number", type=int, default=200, help="random missions (default: 200)")
    parser.add_argument("--captures", type=int, default=60, help="random captures (default: 60)")
    parser.add_argument("--built", type=int, default=0, help="built spacecraft (default: 0)")
    parser.add_argument("--seed", type=int, default=0, help="another seed draws others")
    parser.add_argument("--workers", type=int, default=1, help="processes (default: 1)")
    parser.add_argument(
        "--time-limit", type=float, default=600.0, help="s of wall time for one (default: 600)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/verdicts.json"), help="file of the results"
    )
    options = parser.parse_args(argv)
    stored = json.loads(options.out.read_text(encoding="utf-8")) if options.out.exists() else {}
    results: dict[str, Any] = stored.get("results", {})
    if stored and stored["seed"] != options.seed:
        parser.error(f"{options.out} holds missions of seed {stored['seed']}; give another --out")
    wanted = [("mission", k) for k in range(options.number)]
    wanted += [("capture", k) for k in range(options.captures)]
    wanted += [("built", k) for k in range(options.built)]

    def keep(kind: str, number: int, result: dict[str, Any]) -> None:
        results[f"{kind} {number}"] = result
        write_text(options.out, json.dumps({"seed": options.seed, "results": results}, indent=1))
        end, said = result["end"], result["verdict"]["said"]
        mark = "MISS" if is_miss(result) else "false alarm" if is_false_alarm(result) else ""
        print(f"{kind} {number}: {said}, {end['kind']} {mark}".rstrip(), flush=True)

    missing = [task for task in wanted if "{} {}".format(*task) not in results]
    evaluate_all(
        missing,
        seed=options.seed,
        workers=options.workers,
        seconds=options.time_limit,
        keep=keep,
    )
    for kind in KINDS:
        own = {name: row for name, row in results.items() if name.startswith(kind)}
        if own:
            print(f"\n{len(own)} random {kind}s\n{table(own)}")


if __name__ == "__main__":
    main()
