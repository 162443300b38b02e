"""simulate, simulate_many and compare: runs of scenarios, and their records."""

import contextlib
import dataclasses
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pydrake.geometry import Meshcat

from ffsm_drake.common.errors import BlockError, FfsmError, spared
from ffsm_drake.common.files import same_folder
from ffsm_drake.common.guard import guarded, is_user_supplied
from ffsm_drake.common.settings import settings_of
from ffsm_drake.common.steps import step
from ffsm_drake.loop.blocks import block_sources
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.runs.batches import run_many
from ffsm_drake.runs.dataset import make_table
from ffsm_drake.runs.engine import DRAKE, Engine, NotCovered, find_engine, on_drake
from ffsm_drake.runs.judge import JUDGES
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.runs.record import RunRecord, software_versions
from ffsm_drake.runs.rollout import user_supplied
from ffsm_drake.scenario import Block, Scenario, as_dict, checked
from ffsm_drake.systems.controllers import PAPER_LAWS, complete_gains
from ffsm_drake.systems.grasping import GRASPINGS
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.reference import timed
from ffsm_drake.systems.registry import Factory, address_of, module_folder


class LimitWarning(UserWarning):
    """A plan leaves the limits of the model."""


class StabilityWarning(UserWarning):
    """The sampled loop of a scenario is unstable, or adaptation may make it so."""


def simulate(
    scenario: Scenario | Mission,
    *,
    blocks: Mapping[str, Factory] | None = None,
    meshcat: Meshcat | None = None,
    progress: Callable[[float, float], None] | None = None,
    check_stability: bool = True,
    engine: str = DRAKE,
) -> RunRecord:
    """Run a scenario and return its record.

    The run ends early if it diverges (a velocity exceeds ``divergence_speed``, or is not finite) or
    if you interrupt it from the keyboard. ``record.outcome`` has the reason. For many runs,
    ``Rollout`` is faster.

    Args:
      scenario: the scenario to run, or its mission.
      blocks: block -> factory, which replaces a block of the scenario, such as ``{"sensing": Vicon,
        "forces.friction": Friction}``. A factory is a function of a BlockSetup that returns a Drake
        system, or for the controller a control law. The scenario of the record names importable
        factories, so that the record can repeat the run. The diagram is freed after the run: you
        can read the attributes of a system that a factory keeps, but not its place in the diagram.
      meshcat: shows the motion during the run. Set ``simulator_config.target_realtime_rate`` to
        run at the speed of real time.
      progress: function of the simulated time and the duration in s, called once per simulated
        second.
      check_stability: True: check the mission before the run, see ``prepare``.
      engine: ``drake``, or ``compiled`` for machine code, which does not cover ``blocks`` and
        ``meshcat`` (docs/many_runs.md). A run that diverges is repeated with Drake. The record has
        the name of its engine.

    Returns: the record of the run, also of a run that ended early.

    Raises:
      FfsmError: the engine is unknown, or does not cover the run.
      ModelError, ScenarioError: the model or a value of the scenario cannot be used.
      BlockError: a user-supplied block cannot be loaded, built, wired or run. The original
        exception is its cause, and its ``record`` has the samples before the failure.

    Example:
      >>> from ffsm_drake import load_scenario, simulate
      >>> record = simulate(load_scenario("postcapture", ["duration=0.5"]))
      >>> record.outcome.status, record.dataset["error"].dims
      ('completed', ('time', 'coordinate'))
    """
    start, own = time.perf_counter(), find_engine(engine)
    if own is not None:
        own.check(_checked(scenario).scenario)
        if others := [*(blocks or {}), *(["a live view"] if meshcat is not None else [])]:
            raise NotCovered(", ".join(others))
    rollout = prepare(scenario, blocks=blocks, meshcat=meshcat, check_stability=check_stability)
    try:
        with guarded:
            log = None if own is None else _computed(own, rollout.loop.mission)
            log = log or rollout.run(progress=progress)
            if own is not None and log.engine == DRAKE:
                log = dataclasses.replace(log, engine=on_drake(None))
            return make_record(log, blocks=blocks, start=start)
    except BlockError as error:
        if error.log is not None:
            with contextlib.suppress(FfsmError), guarded:
                error.record = make_record(error.log, blocks=blocks, start=start)
        raise
    finally:
        rollout.release()


def _computed(engine: Engine, mission: Mission) -> RunLog | None:
    """The log of a run; None: it fails or diverges. Raises NotCovered."""
    (log,) = engine.run_all([mission])
    if isinstance(log, NotCovered):
        raise log
    return log


def _checked(given: Scenario | Mission) -> Mission:
    if isinstance(given, Mission):
        return make_mission(given).of(checked(given.scenario))
    return make_mission(checked(given))


def prepare(
    scenario: Scenario | Mission,
    *,
    blocks: Mapping[str, Factory] | None = None,
    meshcat: Meshcat | None = None,
    check_stability: bool = True,
) -> Any:
    """Prepare a run of ``simulate``, with the same arguments and errors.

    With ``check_stability`` there are two warnings. StabilityWarning: the mission is not expected
    to go as planned (``Judge.warnings``), or adaptation may make the loop
    unstable. It is not given for user-supplied blocks, which the check would have to run.
    LimitWarning (``Judge.remarks``): a posture or the plan exceeds the joint limits, or the
    scenario changes the mass of the target's model.

    Returns: the loop, ready to run.
    """
    with guarded, same_folder():
        mission = _checked(scenario)
        if "reference" not in (blocks or {}) and mission.scenario.blocks.reference is None:
            mission = timed(mission)
        judge = JUDGES.first() if check_stability else None
        if judge is not None:
            for remark in judge.remarks(mission):
                warnings.warn(remark, LimitWarning, stacklevel=3)
        # before the verdict, which takes longer: what is refused shows at once
        with step("building the loop"):
            rollout = make_rollout(mission, blocks=blocks, meshcat=meshcat)
        try:
            if judge is not None and not user_supplied(mission.scenario, blocks):
                rollout.check()
                for remark in judge.warnings(mission):
                    warnings.warn(remark, StabilityWarning, stacklevel=3)
        except BaseException:
            rollout.release()
            raise
        return rollout


def check_start(scenario: Scenario | Mission) -> ClosedLoop:
    """Build and start a scenario's closed loop, without a run; errors as ``simulate``."""
    rollout = prepare(scenario, check_stability=False)
    try:
        rollout.check()
        loop: ClosedLoop = rollout.loop
    finally:
        rollout.release()
    return loop


@step("making the record")
def make_record(
    log: RunLog, *, start: float, blocks: Mapping[str, Factory] | None = None
) -> RunRecord:
    """The record of a run that began at the wall time ``start`` (``time.perf_counter``), with the
    factories it had.
    """
    mission = log.mission.of(repeatable_scenario(log.scenario, blocks or {}))
    scenario = mission.scenario
    grasp = None if log.grasp is None else log.grasp.ledger(log.time, log.coordinates)
    if grasp is not None and (grasping := GRASPINGS.first()) is not None:
        with spared("momentum_budget"):
            if (budget := grasping.budget(mission)) is not None:
                grasp["momentum_budget"] = budget
    try:
        dataset, parts = make_table(log), log.part_records
    except BlockError as error:  # a user's part; the record of the others is made
        own = {k: v for k, v in log.parts.items() if not is_user_supplied(type(v.part))}
        error.log = dataclasses.replace(log, parts=own)
        raise
    return RunRecord(
        scenario=scenario,
        flown=mission,
        outcome=log.outcome,
        dataset=dataset,
        parts=parts,
        engine=log.engine,
        wall_time=log.wall_time | {"total": time.perf_counter() - start},
        software=software_versions(),
        blocks=block_sources(scenario),
        grasp=grasp,
    )


def compare(
    scenario: Scenario,
    controllers: Sequence[str] = PAPER_LAWS,
    *,
    progress: Callable[[float, float], None] | None = None,
) -> list[RunRecord]:
    """Run several controllers on one scenario with the same noise.

    Args:
      scenario: the scenario to run. Its ``controller`` is ignored.
      controllers: names, see ``Scenario.controller``; default: the paper's four.
      progress: see ``simulate``.

    Returns: one record for each controller, in the same order.

    Raises:
      ModelError, ScenarioError, BlockError: see ``simulate``.

    Example:
      >>> from ffsm_drake import compare, load_scenario
      >>> records = compare(load_scenario("postcapture", ["duration=0.1"]), ["tdc", "asmc"])
      >>> [record.scenario.controller for record in records]
      ['tdc', 'asmc']
    """
    mission = Mission(scenario)
    chosen = [mission.flown_by(controller=name) for name in controllers]
    for each in chosen:  # before the first run
        check_start(each)
    return [simulate(each, progress=progress) for each in chosen]


def simulate_many(
    scenarios: Sequence[Scenario],
    *,
    batch: int | None = None,
    keep_errors: bool = False,
    engine: str = DRAKE,
) -> list[RunRecord]:
    """Run many scenarios and return their records in the same order.

    On Drake the records have the same bits as with ``simulate``, but missions are not checked
    before the run.

    Args:
      scenarios: the scenarios to run.
      batch: largest number of runs at once on an engine other than Drake.
      keep_errors: True: a failed run has its exception in place of its record.
      engine: ``drake``, or ``compiled`` for machine code, whose results differ by rounding. Drake
        computes the runs that it does not cover (docs/many_runs.md). Each record has the name of
        its engine, with the reason.

    Returns: one record for each scenario.

    Raises: the errors of ``simulate`` for the first scenario that failed, after all have run. With
    ``keep_errors`` nothing is raised.

    Example:
      >>> from ffsm_drake import load_scenario, simulate_many
      >>> given = ("duration=0.1", "random_seed=1"), ("duration=0.1", "random_seed=2")
      >>> records = simulate_many([load_scenario("postcapture", each) for each in given])
      >>> [record.scenario.random_seed for record in records]
      [1, 2]
    """
    start = time.perf_counter()
    results: list[Any] = [None] * len(scenarios)
    ready = dict[int, Mission]()
    with same_folder():
        for index, given in enumerate(scenarios):
            try:
                mission = make_mission(checked(given))
                has_own = mission.scenario.blocks.reference is None
                ready[index] = timed(mission) if has_own else mission
            except Exception as error:
                results[index] = error
        places = list(ready)
        for place, result in run_many(list(ready.values()), batch=batch, engine=engine):
            results[places[place]] = result
            if not isinstance(result, Exception):
                try:
                    results[places[place]] = make_record(result, start=start)
                except FfsmError as error:
                    results[places[place]] = error
    for index, result in enumerate(results):
        if isinstance(result, Exception) and not keep_errors:
            result.add_note(f"in run {index} of {len(results)}")
            raise result
    return results


def repeatable_scenario(scenario: Scenario, blocks: Mapping[str, Factory]) -> Scenario:
    """Return the scenario from which a run can be repeated.

    All gains of its controller are written out, the factories given in Python are named (one
    without an address by its own name), and ``python_path`` leads to their modules.
    """
    if "controller" in blocks:
        scenario = dataclasses.replace(scenario, controller=address_of(blocks["controller"]))
    else:
        scenario = complete_gains(scenario)
    named = dataclasses.replace(
        scenario.blocks,
        forces=dict(scenario.blocks.forces),
        sensing=dict(scenario.blocks.sensing),
    )
    for name, factory in blocks.items():
        block = Block(system=address_of(factory))
        if isinstance(factory, Part):
            own: Any = type(factory)
            settings = {name: as_dict(getattr(factory, name)) for name in settings_of(own)}
            block = Block(system=address_of(own), settings=settings)
        kind, _, label = name.partition(".")
        if kind in ("forces", "sensing"):
            getattr(named, kind)[label or kind] = block
        elif name != "controller":
            setattr(named, name, block)
    scenario = dataclasses.replace(scenario, blocks=named)
    addresses = [
        scenario.controller,
        *(block.system for block in scenario.blocks.choices().values()),
    ]
    folders = [str(folder) for folder in map(module_folder, addresses) if folder is not None]
    return dataclasses.replace(
        scenario, python_path=list(dict.fromkeys([*scenario.python_path, *folders]))
    )
