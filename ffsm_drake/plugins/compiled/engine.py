"""The engine ``compiled``: whole runs in machine code, compared with Drake before the first use."""

import collections
from collections.abc import Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.plugins.compiled.apart import reason_of
from ffsm_drake.plugins.compiled.compiling import llvm
from ffsm_drake.plugins.compiled.kernel import Kernel
from ffsm_drake.plugins.compiled.logs import COMPILED, logs_of
from ffsm_drake.plugins.compiled.loop import SCHEMES, steps_of
from ffsm_drake.plugins.compiled.run import Case, Run
from ffsm_drake.plugins.equations.comparison import held_to_drake
from ffsm_drake.runs.batches import all_but_controller
from ffsm_drake.runs.ending import COMPLETED
from ffsm_drake.runs.engine import Engine, NotCovered
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.rollout import make_rollout
from ffsm_drake.scenario import Scenario

# From Drake's run, as a share of a signal's largest value. Rounding is amplified by high gains.
LARGEST_DIFFERENCE = 1e-7
_UNCLEAR = 1e-5  # less may be rounding in a loop that is nearly unstable for a while
_BLOCKS = {"reference", "sensing", "controller", "actuation", "forces.disturbance"}
_PARTS = {"flexible"}  # with signals
_KEPT = 16  # kernels
_TRIED = 3  # runs for a comparison with Drake; if all of them diverge, Drake runs all


class Diverges(NotCovered):
    """Nothing can be said of the code by this run."""


class Compiled(Engine):
    """Runs in machine code, as many at once as a register holds."""

    name = COMPILED

    def __init__(self) -> None:
        """Raises FfsmError: llvmlite is missing."""
        llvm()

    def check(self, scenario: Scenario) -> None:
        """See Engine."""
        config = scenario.simulator_config
        steps = steps_of(scenario.sample_time, config.max_step_size)
        own = set(scenario.blocks.choices()) | {name for name, is_there in (
            ("capture.approach", scenario.approach is not None),
            ("contacts", scenario.contacts),
            ("supervisor", scenario.supervisor is not None),
            ("faults", scenario.faults),
            ("actuation.thrusters", scenario.actuation.thrusters is not None),
            ("actuation.wheels", scenario.actuation.wheels is not None),
            ("actuation.drives", scenario.actuation.drives is not None),
            ("error control", config.use_error_control),
            ("a real-time clock", config.target_realtime_rate > 0.0),
            (f"integration_scheme {config.integration_scheme}",
             config.integration_scheme not in SCHEMES),
            ("steps that do not divide a sample", not steps),
        ) if is_there}  # fmt: skip
        if own:
            raise NotCovered(", ".join(sorted(own)))

    def run_all(self, scenarios: Sequence[Scenario]) -> list[RunLog | NotCovered | None]:
        """See Engine."""
        results: list[RunLog | NotCovered | None] = [None] * len(scenarios)
        groups: dict[Any, list[tuple[int, Run]]] = {}
        cases = dict[Any, Case]()
        for index, scenario in enumerate(scenarios):
            try:
                self.check(scenario)
                if (same := all_but_controller(scenario)) not in cases:
                    cases[same] = Case(scenario)
                run = Run(scenario, cases[same])
                groups.setdefault((run.key, run.samples), []).append((index, run))
            except NotCovered as error:
                results[index] = error
            except FfsmError:  # Drake's run shows it
                pass
        rows = dict[Any, np.ndarray]()
        for group in groups.values():
            runs = [run for _, run in group]
            found = results_of(runs, rows, alone=len(scenarios) == 1)
            for (index, _), result in zip(group, found, strict=True):
                results[index] = result
        return results


_kernels: collections.OrderedDict[Any, Kernel | NotCovered] = collections.OrderedDict()
_judged = set[Any]()  # keys of kernels that were compared with Drake


def _kernel(run: Run, *, alone: bool) -> Kernel:
    """The compiled code of a run, compared with Drake once in a process. Raises NotCovered."""
    key = run.key, alone
    found = _kernels.get(key)
    try:
        if found is None:
            found = _compiled(run, alone=alone)
        if isinstance(found, Kernel) and key not in _judged:
            _kernels[key] = found  # a run that diverges leaves it there
            _judge(run, found)
            _judged.add(key)
    except Diverges:
        raise
    except NotCovered as error:
        found = error
    except FfsmError as error:  # Drake's run, or llvmlite, refuses it
        found = NotCovered(one_line(error))
    _kernels[key] = found
    if len(_kernels) > _KEPT:
        oldest, _ = _kernels.popitem(last=False)
        _judged.discard(oldest)
    if isinstance(found, NotCovered):
        raise found
    return found


def results_of(
    runs: Sequence[Run], rows: dict[Any, np.ndarray], *, alone: bool = False
) -> list[RunLog | NotCovered | None]:
    """The results of runs with the same code.

    Args:
      rows: see ``logs_of``.
      alone: see ``Kernel``.
    """
    kernel = None
    for run in runs[:_TRIED]:
        try:
            kernel = _kernel(run, alone=alone)
            break
        except Diverges:  # the next one may tell more of the code
            continue
        except NotCovered as error:
            return [error] * len(runs)
    if kernel is None:
        return [None] * len(runs)
    parts = [runs[at : at + kernel.width] for at in range(0, len(runs), kernel.width)]
    return [log for part in parts for log in logs_of(kernel, part, rows)]


def _compiled(run: Run, *, alone: bool) -> Kernel:
    """Trace and compile. Raises NotCovered."""
    held_to_drake(run.blocks.tree, plant=run.case.true.plant)
    try:
        kernel = Kernel(run.blocks, steps=run.steps, key=run.key_on_disk, alone=alone)
    except (FfsmError, MemoryError):
        raise
    except Exception as error:  # the law may raise anything on symbols
        raise NotCovered(f"{run.scenario.controller}: {reason_of(error)}") from error
    return kernel


def _judge(run: Run, kernel: Kernel) -> None:
    """Compare a run with Drake's. Raises NotCovered: they differ, or Drake's cannot tell."""
    rollout = make_rollout(run.scenario)
    try:
        others = (set(rollout.loop.blocks) - _BLOCKS) | (set(rollout.loop.parts) - _PARTS)
        if others:
            raise NotCovered(", ".join(sorted(others)))
        kernel.parts = rollout.loop.parts
        expected = rollout.run(run.scenario)
    finally:
        rollout.release()
    (found,) = logs_of(kernel, [run], {})
    if found is None or expected.outcome.status != COMPLETED:
        raise Diverges("the run diverges")
    if set(found.series) != set(expected.series):
        missing = set(expected.series) ^ set(found.series)
        raise NotCovered(f"the signals {', '.join(sorted(missing))}")
    for name, values in expected.series.items():
        scale = max(float(np.abs(values).max()), 1e-3)
        difference = float(np.abs(found.series[name] - values).max()) / scale
        if not difference <= LARGEST_DIFFERENCE:
            kind = Diverges if difference <= _UNCLEAR else NotCovered
            raise kind(
                f"{run.scenario.controller}: {name} differs from Drake's by {difference:.1e} of it"
            )
