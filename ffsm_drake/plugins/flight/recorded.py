"""What a law read and commanded in a run, sample by sample, for the replay of its C code."""

import dataclasses
from collections.abc import Collection, Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.plugins.compiled.engine import Compiled
from ffsm_drake.plugins.flight.traced import FlightLaw
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.simulate import simulate
from ffsm_drake.scenario import HELD, Scenario
from ffsm_drake.systems.controllers import controller_factory
from ffsm_drake.systems.controllers.law import Sample, State, WrappedLaw
from ffsm_drake.systems.registry import call_factory
from ffsm_drake.systems.sampled import Now
from ffsm_drake.systems.sensing.block import IS_NEW, measurement_of
from ffsm_drake.systems.sensing.errors import SensorErrors
from ffsm_drake.systems.setup import BlockSetup


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recorded:
    """The samples of a run (n), for a C law's ``law_in`` and ``law_out``."""

    wholes: np.ndarray  # (n, 3) sample, is_first, holds
    inputs: np.ndarray  # (n, LAW_NUM_INPUTS)
    commanded: np.ndarray  # (n, nv) before limits and quantisation
    exact: bool  # of the compiled loop, whose bits the C law has

    def text(self) -> str:
        """A line for each sample: whole numbers, then numbers as C's hexadecimal ones."""
        rows = zip(self.wholes.tolist(), self.inputs.tolist(), self.commanded.tolist(), strict=True)
        return "".join(
            " ".join((*map(str, wholes), *(each.hex() for each in (*inputs, *commanded)))) + "\n"
            for wholes, inputs, commanded in rows
        )


def recorded(scenario: Scenario, reads: Collection[str]) -> Recorded:
    """Run a scenario, and return the samples of its law.

    Args: the scenario; the inputs that the law reads, of ``LawBlock.inputs``.

    Raises FfsmError: the run fails or diverges.
    """
    law = FlightLaw(scenario, HELD)
    optional = [name for name in OPTIONAL if name in reads]
    plain = scenario.faults is None and scenario.supervisor is None
    if plain and not scenario.blocks.choices():
        with suppress(FfsmError):  # llvmlite is an extra
            (log,) = Compiled().run_all([law.mission])
            if isinstance(log, RunLog):
                return _of_log(log, law, optional)
    if len(scenario.contacts) > 1 and scenario.chain.law != "plain":
        raise FfsmError("the replay of a law in a closed chain needs a run that is compiled")
    return _tapped(scenario, optional)


# Inputs of a law after those that each one has, in their order in ``law_in``.
OPTIONAL = ("measurement_is_new", "desired_frame", "measured_wrench")


def _of_log(log: RunLog, law: FlightLaw, optional: list[str]) -> Recorded:
    """The samples of a compiled run."""
    scenario, series, count = log.scenario, log.series, len(log.time)
    applied = np.vstack([np.zeros((1, law.coordinates.num_velocities)), series["applied_force"]])
    given = [*(series[name] for name in _SERIES), applied[:-1]]
    if IS_NEW in optional:
        given.append(_is_new(scenario, law, count))
    if "desired_frame" in optional:
        given.append(series["desired_frame"])
    if "measured_wrench" in optional:
        given.append(series["contact_wrench"])
    grasp = count if log.grasp is None else log.grasp.sample
    samples = np.arange(count)
    holds = samples >= grasp if log.grasp is not None else np.ones(count)
    first = (samples == 0) | (samples == grasp)
    wholes = np.column_stack([samples, first, holds]).astype(int)
    return Recorded(
        wholes=wholes,
        inputs=np.hstack(given),
        commanded=series["generalized_force"],
        exact=log.grasp is None,  # NumPy's products resume the law after a grasp
    )


_SERIES = ("measurement", "desired_state", "desired_acceleration")


def _is_new(scenario: Scenario, law: FlightLaw, count: int) -> np.ndarray:
    """Which measurements are new at each sample (n, nq + nv)."""
    block = measurement_of(SensorErrors(scenario.sensing, law.coordinates, scenario.sample_time))
    zeros = {name: np.zeros(size) for name, size in block.inputs.items()}
    zeros["state"][0] = 1.0
    memory = block.start(zeros["state"])
    rows = (block.step(zeros, memory, Now(0.0, block.phase(k)))[0] for k in range(count))
    return np.array([row[IS_NEW] for row in rows])


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Tap(WrappedLaw):
    """A law whose samples are kept."""

    kept: list[tuple[Sample, bool]]  # with whether the target is held
    holds: bool

    def initial_state(self) -> State:
        return self.law.initial_state()

    def resume(self, state: State, before: Any, reference: np.ndarray) -> State:
        return self.law.resume(state, before.law, reference)

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        self.kept.append((sample, self.holds))
        return self.law.step(sample, state)


def _tapped(scenario: Scenario, optional: list[str]) -> Recorded:
    """The samples of a run on Drake."""
    kept: list[tuple[Sample, bool]] = []

    def tapped(setup: BlockSetup) -> _Tap:
        own = dataclasses.replace(setup, name=scenario.controller_key, settings=scenario.gains)
        place = f"controller '{scenario.controller}'"
        law = call_factory(controller_factory(scenario), own, place=place)
        return _Tap(law=law, kept=kept, holds=setup.grip.holds)

    record = simulate(scenario, blocks={"controller": tapped}, check_stability=False)
    data = record.dataset
    if record.outcome.status != "completed":
        raise FfsmError(f"the run for the replay does not complete: {record.outcome.message}")
    rows = [np.concatenate(list(_row(sample, optional))) for sample, _ in kept]
    wholes = [(k, int(sample.is_first), int(holds)) for k, (sample, holds) in enumerate(kept)]
    force = data["generalized_force"].values
    return Recorded(wholes=np.array(wholes), inputs=np.array(rows), commanded=force, exact=False)


def _row(sample: Sample, optional: list[str]) -> Iterator[np.ndarray]:
    yield from (sample.q, sample.v, sample.q_d, sample.v_d, sample.a_d, sample.applied_force)
    for name in optional:
        if name == IS_NEW:
            new = np.ones(2 * sample.v.size) if sample.is_new is None else sample.is_new
            yield np.concatenate([new[:1], new]).astype(float)
        elif name == "desired_frame":
            assert sample.desired_frame is not None
            yield sample.desired_frame
        else:
            assert sample.contact_wrench is not None
            yield sample.contact_wrench
