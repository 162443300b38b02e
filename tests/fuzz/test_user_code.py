"""User-supplied code that fails in drawn ways: one line that names it and an exit status, the run
up to then kept; never a traceback, an abort, success, or an exit that looks like Ctrl-C.

The quick suite tries 50 faults, the slow one 150, the exhaustive one 5000 (``pytest -m exhaustive
tests/fuzz``).
They run in forked batches, so that a process that dies is seen, and its fault known.
"""

import contextlib
import json
import os
import shutil
import sys
import time
import traceback
import warnings
from functools import partial
from pathlib import Path

import faulty
import pytest
from alone import run_alone
from children import forked
from click.testing import CliRunner
from faulty import BLOCKS, ERRORS, HARMLESS, VALUES, Fault
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from ffsm_drake import FfsmError, RunRecord, load_scenario, simulate
from ffsm_drake.cli import main
from ffsm_drake.common.errors import BlockError
from ffsm_drake.common.interrupts import handle_signals

LONGEST = 120.0  # s for one fault, after which it hangs
BATCH = 100
LAWS = ("tdc", "asmc", "aismc", "tde_aismc", "pd_plus", "computed_torque")
SETTINGS = ["duration=0.1", "sensing.velocity_noise=1e-6"]

WARM = set()
whats = st.sampled_from([*ERRORS, *VALUES, *HARMLESS, "mutate"])
faults = st.one_of(
    st.builds(
        Fault,
        block=st.sampled_from([f"controller {name}" for name in LAWS]),
        method=st.sampled_from([*faulty.LAW_METHODS, *3 * ("step",), *2 * ("initial_state",)]),
        at=st.sampled_from([0, 0, 1, 2, 5, 20]),
        what=whats,
        part=st.integers(0, 5),
    ),
    st.builds(
        Fault,
        block=st.sampled_from(sorted(BLOCKS)),
        method=st.sampled_from([*faulty.BLOCK_METHODS, *2 * ("calc",)]),
        at=st.sampled_from([0, 0, 1, 5, 20]),
        what=whats,
        part=st.just(0),
    ),
    st.builds(
        Fault,
        block=st.sampled_from(["part actuation", "part forces"]),
        method=st.sampled_from(faulty.PART_METHODS),
        at=st.sampled_from([0, 0, 1, 2]),
        what=whats,
        part=st.just(0),
    ),
)
COMMANDS = [
    *8 * ("run",), *4 * ("simulate",), "report", *2 * ("validate",), "verdict", "compare",
    "campaign", "stability", "diagram",
]  # fmt: skip
LONG = ["campaign run", "design", "plan"]  # seconds each


def problem_of(fault, command):
    """What is wrong with how a command takes a fault; empty: nothing."""
    faulty.FIRED.clear()
    shutil.rmtree("out", ignore_errors=True)
    Path("users_own.py").write_text(
        f"from faulty import Fault, make\n\nFaulty = make(Fault{tuple(fault)!r})\n"
    )
    sys.modules.pop("users_own", None)
    if command == "simulate":
        return of_simulate(fault)
    words, good = words_of(fault, command)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        result = CliRunner().invoke(main, words)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        return f"unclean: {result.exception!r}: {last_place(result.exception)}"
    if "Traceback" in result.output:
        return f"a traceback: {result.output[-500:]}"
    if result.exit_code not in (*good, 2):
        return f"exit status {result.exit_code}: {result.output[-500:]}"
    if result.exit_code == 2:
        return of_error_lines(result.stderr) or of_record(fault, command, result.stderr)
    said = any(word in result.output for word in ("failed", "cannot be", "error: "))
    if faulty.FIRED and must_fail(fault, command) and not said:
        return f"exit status {result.exit_code} in spite of it: {result.output[-500:]}"
    return ""


def words_of(fault, command):
    """A command line with the fault in its scenario, and the exit statuses of success."""
    kind, _, base = fault.block.partition(" ")
    given = [f"--set={each}" for each in SETTINGS]
    if kind == "controller":
        chosen = ["-c", "users_own:Faulty"]
    else:
        place = {"sensing": "sensing.own", "forces": "forces.own", "part": base}.get(kind, kind)
        place = "forces.own" if (kind, base) == ("part", "forces") else place
        given.append(f"--set=blocks.{place}=users_own:Faulty")
        chosen = ["-c", "tdc"]
    scenario = "postcapture"
    if command in ("run", "report"):
        report = [] if command == "report" else ["--no-report"]
        return ["run", scenario, *chosen, *given, *report, "--out", "out"], (0, 3)
    if command == "compare":
        both = chosen if kind == "controller" else ["-c", "tdc"]
        words = ["compare", scenario, *both, "-c", "pd_plus", *given, "--no-report"]
        return [*words, "--out", "out"], (0, 3)
    if command == "campaign":
        Path("c.yaml").write_text(json.dumps(campaign(chosen[1], given)))
        return ["campaign", "plan", "c.yaml"], (0,)
    if command == "campaign run":
        Path("c.yaml").write_text(json.dumps(campaign(chosen[1], given)))
        return [*command.split(), "c.yaml", "--workers", "1", "--database", "out/c.db"], (0,)
    if command == "design":
        return ["design", scenario, *chosen, *given, "--time", "2", "--out", "out"], (0, 3)
    if command == "plan":
        given.append("--set=planning.segments=4")
        return ["plan", "planar_detumble", *chosen, *given, "--out", "out"], (0, 3)
    if command == "diagram":
        return ["diagram", scenario, *chosen, *given, "--out", "out/d.dot"], (0,)
    if command == "validate":
        given.append(f"--set=controller={chosen[1]}")
        return ["validate", "--no-rehearsal", scenario, *given], (0, 3)
    rehearsal = [] if command == "verdict" else ["--no-rehearsal"]
    return ["stability", scenario, *chosen, *given, *rehearsal], (0, 3)


def campaign(controller, given):
    changes = dict(each.removeprefix("--set=").split("=", 1) for each in given)
    return {
        "description": "one fault",
        "scenario": "postcapture",
        "overrides": {
            key: float(value) if value[0].isdigit() else value for key, value in changes.items()
        },
        "controllers": [controller],
        "cases": 2,
        "parameters": {"payload.truth.mass": {"distribution": "uniform", "low": 90, "high": 110}},
    }


def must_fail(fault, command):
    """Whether a fault that has happened cannot go well."""
    if fault.method in ("held", "resume", "starting_gains", "title"):
        return False
    # later than a run, what reads a law's own description may do with less; a loop never
    later = command in ("validate", "compare", "campaign", "report") and fault.at > 0
    later &= fault.method != "linear" or command == "validate"
    return fault.what in ERRORS and command != "diagram" and not later


def of_error_lines(text):
    errors = [line for line in text.splitlines() if line.startswith("error: ")]
    if len(errors) != 1:
        return f"{len(errors)} lines of error: {text[-800:]}"
    if len(errors[0]) > 2000:
        return f"a long line: {len(errors[0])}"
    if not any(word in errors[0] for word in ("Faulty", "faulty", "users_own", "blocks.")):
        return f"names no block: {errors[0]}"
    return ""


def of_record(fault, command, text):
    """The record of a run that failed after some samples is kept."""
    late = fault.at >= 5 and fault.method == "step" and faulty.FIRED
    if command != "run" or not late:
        return ""
    if not Path("out/record.nc").exists():
        return f"no record is kept: {text[-500:]}"
    record = RunRecord.load("out")
    if record.outcome.status != "failed" or not 1 <= record.dataset.sizes["time"] <= fault.at + 1:
        return f"the record is odd: {record.outcome}, {record.dataset.sizes['time']} samples"
    return ""


def of_simulate(fault):
    """The Python interface: one line, with the cause."""
    words, _ = words_of(fault, "run")
    overrides = [each.removeprefix("--set=") for each in words if each.startswith("--set=")]
    overrides.append(f"controller={words[words.index('-c') + 1]}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            record = simulate(load_scenario("postcapture", overrides))
    except FfsmError as error:
        if "\n" in str(error):
            return f"several lines: {error}"
        said = of_error_lines(f"error: {error}")
        raised = fault.what in ERRORS and isinstance(error, BlockError) and faulty.FIRED
        if raised and error.__cause__ is None and error.__context__ is None:
            return f"without its cause: {error}"
        return said
    except BaseException as error:
        return f"unclean: {error!r}: {last_place(error)}"
    if record.outcome.status == "interrupted":
        return "interrupted"
    if faulty.FIRED and must_fail(fault, "simulate"):
        return f"went well: {record.outcome}"
    return ""


def last_place(error):
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{place.filename}, line {place.lineno}"


def try_all(draws, folder):
    """Each (fault, command) with its problem; forked batches do the work of this process, which
    has one thread.
    """
    warm_up(folder)
    found, waiting = [], list(draws)
    while waiting:
        done, died = run_batch(waiting[:BATCH], folder)
        found += zip(waiting, done, strict=False)
        if died:
            found.append((waiting[len(done)], died))
        waiting = waiting[len(done) + bool(died) :]
    return [(draw, problem) for draw, problem in found if problem]


def warm_up(folder):
    """Import here, once, what each forked process would."""
    with contextlib.chdir(folder):
        sys.path.append(str(folder))
        for command in ("run", "stability") if "stability" not in WARM else ():
            problem_of(Fault("controller tdc", "step", 10**6, "none"), command)
            WARM.add(command)
        sys.path.remove(str(folder))


def run_batch(draws, folder):
    """Problems of the first draws, and how the process died on the next; empty: it did not."""
    fork = forked(partial(report_batch, draws, folder), silence=LONGEST)
    lines = [json.loads(line) for line in fork.told.splitlines()]
    died = "hangs" if fork.hung else f"the process died: {fork.code}"
    return lines, died if len(lines) < len(draws) else ""


def report_batch(draws, folder, tell):
    with contextlib.suppress(BaseException):
        os.chdir(folder)
        sys.path.append(str(folder))
        handle_signals()
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        for draw in draws:
            try:
                problem = problem_of(*draw)
            except BaseException as error:
                problem = f"the test itself: {error!r}: {last_place(error)}"
            tell(json.dumps(problem) + "\n")


def drawn(count, number, commands=(*COMMANDS, *LONG)):
    """So many (fault, command), always the same for a number."""
    draws = []
    limits = settings(
        max_examples=count,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate],
    )

    def keep(draw):
        draws.append(draw)

    seed(number)(limits(given(st.tuples(faults, st.sampled_from(commands)))(keep)))()
    return draws


# What broke once: each is one class of faults.
KNOWN = [
    Fault("controller tdc", "initial_state", 0, "objects"),
    Fault("controller tdc", "held", 0, "odd_keys"),
    Fault("controller pd_plus", "held", 0, "value"),
    Fault("controller pd_plus", "step", 20, "ctrl_c"),
    Fault("controller asmc", "step", 5, "pipe"),
    Fault("controller asmc", "step", 5, "click_exit"),
    Fault("controller tde_aismc", "step", 5, "dates", 1),
    Fault("controller pd_plus", "step", 1, "complex", 1),
    Fault("controller aismc", "reaching_gain", 0, "zero"),
    Fault("reference", "calc", 5, "zeros"),
    Fault("sensing", "calc", 5, "own_end"),
    Fault("forces", "set_payload", 0, "exit"),
    Fault("part forces", "signals", 0, "text"),
    Fault("part forces", "sentence", 1, "stop"),
    Fault("part actuation", "title", 0, "class"),
]


@pytest.mark.smoke
def test_known_faults(tmp_path):
    draws = [(fault, command) for fault in KNOWN for command in ("run", "simulate")]
    assert run_alone(try_all, draws, tmp_path) == []


@pytest.mark.long
def test_what_lacks_a_linear_loop_says_so(tmp_path):
    fault = Fault("part forces", "linear", 0, "value")
    draws = [(fault, each) for each in ("report", "compare", "campaign")]
    assert run_alone(try_all, draws, tmp_path) == []


@pytest.mark.parametrize(
    ("count", "number", "commands"),
    [(50, 0, COMMANDS), pytest.param(150, 1, COMMANDS, marks=pytest.mark.long)]
    + [pytest.param(6, k, LONG, marks=pytest.mark.long) for k in (4, 5)]
    + [pytest.param(500, k, COMMANDS + LONG, marks=pytest.mark.exhaustive) for k in range(10, 20)],
)
def test_faults_of_user_supplied_code(count, number, commands, tmp_path):
    found = run_alone(try_all, drawn(count, number, commands), tmp_path, inputs=count)
    assert not found, "\n".join(f"{draw}: {problem}" for draw, problem in found)


if __name__ == "__main__":  # a count, a number and a folder: prints the problems
    start, folder = time.monotonic(), Path(sys.argv[3])
    folder.mkdir(parents=True, exist_ok=True)
    tried, bad = drawn(int(sys.argv[1]), int(sys.argv[2])), 0
    for first in range(0, len(tried), BATCH):
        for draw, problem in try_all(tried[first : first + BATCH], folder):
            print(draw, problem[:900], sep="\n    ")
            bad += 1
        done = min(first + BATCH, len(tried))
        print(f"{done} faults, {bad} problems, {time.monotonic() - start:.0f} s", flush=True)
