"""The engine ``compiled``: whole runs in machine code, compared with Drake before the first use."""

import functools
import re
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.compiled.apart import Refused, apart, reason_of
from ffsm_drake.plugins.compiled.called import Trial
from ffsm_drake.plugins.compiled.case import Case, case_of
from ffsm_drake.plugins.compiled.compiling import llvm
from ffsm_drake.plugins.compiled.kernel import Kernel
from ffsm_drake.plugins.compiled.lanes import Lanes
from ffsm_drake.plugins.compiled.logs import COMPILED
from ffsm_drake.plugins.compiled.missions import NUDGE, Lane, advance, refusal
from ffsm_drake.plugins.compiled.recent import Recent
from ffsm_drake.plugins.compiled.run import Run, run_of
from ffsm_drake.plugins.compiled.schemes import SCHEMES
from ffsm_drake.plugins.equations.comparison import held_to_drake
from ffsm_drake.runs.batches import all_but_controller
from ffsm_drake.runs.ending import INTERRUPTED
from ffsm_drake.runs.engine import Engine, NotCovered
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.contacts import closing_times
from ffsm_drake.systems.controllers.law import is_shipped
from ffsm_drake.systems.faults import detects
from ffsm_drake.systems.registry import Factory

# From Drake's run, as a share of a signal's largest value. High gains amplify rounding: where the
# last bits of the initial state change a signal by a share d, it may differ by so many times d.
LARGEST_DIFFERENCE = 1e-7
_OF_LAST_BITS = 1e4
BLOCKS = {"reference", "sensing", "controller", "actuation", "forces.disturbance"}
# with signals
_PARTS = {
    "sensing.detection", "flexible", "actuation.wheels", "actuation.drives",
    "actuation.thrusters", "actuation.link", "geometry", "supervisor", "forces.gripper",
    "controller",
}  # fmt: skip
_OWN = re.compile(r"(sensing|phases)\..*|forces\.(?!disturbance|gripper).*")  # of users
_KEPT = 16  # kernels
_TRIAL = 0.5  # s, of a run under actions that is compared with Drake's


class Compiled(Engine):
    """Runs in machine code, as many at once as a register holds."""

    name = COMPILED

    def __init__(self) -> None:
        """Raises FfsmError: llvmlite is missing."""
        llvm()

    def check(self, scenario: Scenario) -> None:
        """See Engine."""
        config = scenario.simulator_config
        replaced = {each for each in scenario.blocks.choices() if not _OWN.fullmatch(each)}
        own = replaced | {name for name, is_there in (
            ("error control", config.use_error_control),
            ("a real-time clock", config.target_realtime_rate > 0.0),
            (f"integration_scheme {config.integration_scheme}",
             config.integration_scheme not in SCHEMES),
        ) if is_there}  # fmt: skip
        if own:
            raise NotCovered(", ".join(sorted(own)))

    def lanes(self, mission: Mission, factory: Factory, number: int, samples: int) -> Lanes:
        """See Engine."""
        scenario = mission.scenario
        self.check(scenario)
        if scenario.approach is not None or closing_times(scenario)[1:]:
            raise NotCovered("capture.approach or contacts that close later under actions")
        trial = mission.flown_by(duration=min(scenario.duration, _TRIAL))
        run = Run(trial, law=factory)
        if scenario.supervisor is not None or detects(scenario):
            raise NotCovered("a supervisor or fault detection under actions")
        if own := scenario.blocks.choices():
            raise NotCovered(f"the block {min(own)} under actions")
        if not is_shipped(run.law):
            raise NotCovered(f"the law {scenario.controller} under actions")
        (found,) = results_of([run])
        if isinstance(found, NotCovered):
            raise found
        kernel = _kernel_of([run], alone=False)
        run = Run(mission, Case(mission, further=samples), factory)
        if why := kernel.blocks.called:
            run = run.with_called_law(why)
        return Lanes(kernel, run, number, samples)

    def run_all(
        self, missions: Sequence[Mission], signals: Collection[str] | None = None
    ) -> list[RunLog | NotCovered | None]:
        """See Engine."""
        results: list[RunLog | NotCovered | None] = [None] * len(missions)
        cases, lanes = dict[Hashable, Case](), dict[int, Lane]()
        alone = len(missions) == 1
        for index, mission in enumerate(missions):
            scenario = mission.scenario
            try:
                self.check(scenario)
                if scenario.approach is not None or closing_times(scenario)[1:]:
                    lanes[index] = Lane(mission)
                    continue
                if (same := all_but_controller(scenario)) not in cases:
                    cases[same] = case_of(mission)
                run = run_of(cases[same], mission)
                is_known = (run.key, alone) in _judged
                lanes[index] = Lane(mission, run, signals if is_known else None)
            except NotCovered as error:
                results[index] = error
            except FfsmError:  # Drake's run shows it
                pass
        _go(list(lanes.values()), alone=alone)
        for index, lane in lanes.items():
            results[index] = lane.result
        for case in cases.values():
            case.forget_rows()
        return results


_kernels = Recent[Kernel | NotCovered](_KEPT)
# compared with Drake: runs' keys, and pairs of successive phases; those that are refused
_judged, _refused = set[Hashable](), dict[Hashable, NotCovered]()


def results_of(runs: Sequence[Run], *, alone: bool = False) -> list[RunLog | NotCovered | None]:
    """The results of runs of one phase. Args: see ``Kernel``."""
    lanes = [Lane(run.mission, run) for run in runs]
    _go(lanes, alone=alone)
    return [lane.result for lane in lanes]


def _go(lanes: Sequence[Lane], *, alone: bool) -> None:
    """Run lanes. Each phase, after the one before it, is compared with Drake once in a process."""
    kernel_of = functools.partial(_kernel_of, alone=alone)
    advance(lanes, kernel_of)
    for lane in lanes:
        if not isinstance(log := lane.result, RunLog):
            continue
        changes = {(change, alone) for change in lane.changes}
        refused = [_refused[change] for change in changes if change in _refused]
        if not refused and not changes <= _judged:

            def nudged(lane: Lane = lane) -> RunLog | None:
                other = lane.nudged(NUDGE)
                advance([other], kernel_of)
                return other.result if isinstance(other.result, RunLog) else None

            try:
                if _judge(lane, log, nudged):
                    _judged.update(changes)
                else:
                    lane.result = lane.lost
            except FfsmError as error:
                refused = [refusal(error)]
                _refused.update(dict.fromkeys(changes - _judged, refused[0]))
        if refused:
            lane.result = refused[0]


def _kernel_of(runs: Sequence[Run], *, alone: bool) -> Kernel:
    """The code of runs, compiled once in a process. Raises NotCovered."""
    key = runs[0].key, alone
    if key in _refused:
        raise _refused[key]
    made = _kernels.get(key) or _kernels.keep(key, _tried(runs, alone=alone))
    if isinstance(made, NotCovered):
        raise made
    return made


def _tried(runs: Sequence[Run], *, alone: bool) -> Kernel | NotCovered:
    """The code of runs; if they are refused, why."""
    try:
        found = _compiled(runs[0], alone=alone)
        if not is_shipped(runs[0].law):
            _try_calls(found, runs[:2])
    except FfsmError as error:  # Drake's loop, or llvmlite, may refuse it
        return refusal(error)
    return found


def _compiled(run: Run, *, alone: bool) -> Kernel:
    """Trace and compile. Raises NotCovered."""
    held_to_drake(run.blocks.tree, plant=run.case.true.plant)
    rollout = Rollout(run.mission, blocks=run.given, grip=run.case.nominal.grip)
    try:
        blocks = set(rollout.loop.blocks) - run.case.made.built
        blocks -= set() if run.case.made.watch is None else {"supervisor"}
        others = (blocks - BLOCKS) | (set(rollout.loop.parts) - _PARTS - run.case.made.built)
    finally:
        rollout.release()
    if others:
        raise NotCovered(", ".join(sorted(others)))
    return _kernel(run, alone=alone)


def _kernel(run: Run, *, alone: bool) -> Kernel:
    """Compile with the law, or to call it. Raises NotCovered."""
    try:
        return Kernel(run.blocks, steps=run.steps, key=run.key_on_disk, alone=alone)
    except (FfsmError, MemoryError):
        raise
    except Exception as error:  # the law may raise anything on symbols
        why = reason_of(error)
        if run.blocks.called:
            raise NotCovered(f"{run.scenario.controller}: {why}") from error
    return _kernel(run.with_called_law(why), alone=alone)


def _try_calls(kernel: Kernel, runs: Sequence[Run]) -> None:
    """Try a user-supplied law, in copies of this process. Raises NotCovered: equal calls have
    different results.
    """
    trial = Trial(kernel.blocks, [run.controller for run in runs])
    try:
        calls = apart(lambda: trial.calls([run.case.planned for run in runs]))
        if apart(lambda: trial.repeats(calls)) == "true":
            return
        why = "equal calls have different results"
    except Refused as error:
        why = str(error)
    said = filter(None, (kernel.blocks.called, f"called: {why}"))
    raise NotCovered(f"{runs[0].scenario.controller}: {'; '.join(said)}")


def _judge(lane: Lane, log: RunLog, nudged: Callable[[], RunLog | None]) -> bool:
    """Compare a log with Drake's. False: the run ends in another way there. Raises NotCovered: they
    differ by more than rounding; KeyboardInterrupt: Drake's run was interrupted.

    Args: the run; its log; what runs it with other last bits.
    """
    mission, run = lane.mission, lane.run
    rollout = make_rollout(mission, blocks=None if lane.own is None else lane.own.given)
    try:
        expected = rollout.run(mission)
    finally:
        rollout.release()
    if expected.outcome.status == INTERRUPTED:
        raise KeyboardInterrupt
    if (expected.outcome.status, expected.time.size) != (log.outcome.status, log.time.size):
        return False
    own = {*getattr(run.law, "logged", ())} - expected.series.keys()
    if missing := (log.series.keys() - own) ^ expected.series.keys():
        raise NotCovered(f"the signals {', '.join(sorted(missing))}")
    of_rounding: Mapping[str, float] | None = None
    for name, difference in _differences(log, expected).items():
        if difference <= LARGEST_DIFFERENCE:
            continue
        if of_rounding is None:
            other = nudged()
            of_rounding = {} if other is None else _differences(other, log)
        if not difference <= _OF_LAST_BITS * of_rounding.get(name, np.inf):
            raise NotCovered(
                f"{run.scenario.controller}: {name} differs from Drake's by {difference:.1e} of it"
            )
    return True


def _differences(one: RunLog, other: RunLog) -> dict[str, float]:
    """The largest difference of each signal, as a share of its largest value."""
    found = {}
    for name, values in other.series.items():
        scale = float(np.nanmax(np.abs(values), initial=1e-3))
        gap = np.abs(one.series[name] - values)[~(np.isnan(one.series[name]) & np.isnan(values))]
        found[name] = float(gap.max(initial=0.0)) / scale
    return found
