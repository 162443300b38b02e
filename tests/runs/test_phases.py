"""Phases without a capture: a run in two phases, and one that ends before the second."""

import dataclasses

import numpy as np
import pytest

from ffsm_drake.mission import Mission
from ffsm_drake.runs.dataset import make_table
from ffsm_drake.runs.ending import DIVERGED
from ffsm_drake.runs.phases import Phase, PhasedRollout, PhaseKind, Phases
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.scenario import EMPTY, HELD, load_scenario, override_scenario
from ffsm_drake.systems.controllers import controller_factory

SCENARIO = load_scenario("postcapture", ["duration=0.6", "reference.duration=10"])


@dataclasses.dataclass(frozen=True)
class Given(PhaseKind):
    """A phase as it is given, with an outcome."""

    phase: Phase
    outcome: str = ""

    def plan(self, now):
        return self.phase, now

    def judge(self, now):
        assert now.sample == self.phase.names[-1][1]
        return self.outcome, now


class TwoPhases(PhasedRollout):
    """A rollout that changes loops after 25 samples."""

    first = Phase(names=(("one", 10), ("two", 25)), grip=HELD)
    second = Phase(names=(("rest", None),), grip=HELD)
    outcome = "done"
    legs = ()

    def phases(self, mission):
        first = Given(self.first, self.outcome)

        def finish(log, now):
            self.legs = now.legs(len(log.time))
            return log

        return Phases(kinds={"": first, "done": Given(self.second)}, finish=finish)


def _of_law(name):
    return override_scenario(SCENARIO, [f"controller={name}"])


@pytest.mark.parametrize("is_kept", [False, True])
def test_a_change_of_loops_keeps_the_bits(is_kept):
    alone, rollout = Rollout(SCENARIO).run(), TwoPhases(Mission(SCENARIO))
    if not is_kept:  # a loop of its own
        rollout.second = dataclasses.replace(rollout.second, plan=Mission(SCENARIO))
    for _ in range(2):
        log = rollout.run()
        assert log.outcome == alone.outcome
        assert np.array_equal(log.time, alone.time)
        assert set(log.series) == set(alone.series)
        for name, values in alone.series.items():
            assert np.array_equal(log.series[name], values), name
    assert rollout.legs == (("one", 10), ("two", 15))
    assert rollout.accepts(SCENARIO)
    rollout.release()


def test_a_run_that_diverges_goes_through_no_further_phase():
    log = TwoPhases(Mission(dataclasses.replace(SCENARIO, divergence_speed=1e-6))).run()
    assert log.outcome.status == DIVERGED
    assert log.time[-1] < 0.25


def test_an_outcome_that_leads_nowhere_ends_the_run():
    rollout = TwoPhases(Mission(SCENARIO))
    rollout.outcome = "lost"
    assert rollout.run().time.size == 25


def test_nothing_in_the_gripper_is_lighter():
    """The first force of a law with a model is that of the phase's own payload."""
    forces = {}
    for grip in (HELD, EMPTY):
        rollout = TwoPhases(motion := Mission(_of_law("computed_torque")))
        rollout.first = Phase(names=(("only", None),), plan=motion, grip=grip)
        forces[grip] = np.abs(rollout.run().series["generalized_force"][5:]).max(axis=0)
    assert (forces[EMPTY][6:] < 0.7 * forces[HELD][6:]).all()


@pytest.mark.parametrize("laws", [("tde_aismc", "pd_plus"), ("pd_plus", "tde_aismc")])
def test_series_of_one_phase_are_nan_in_the_other(laws):
    rollout = TwoPhases(Mission(_of_law(laws[0])))
    own = {"controller": controller_factory(_of_law(laws[1]))}
    rollout.second = dataclasses.replace(rollout.second, blocks=own, afresh=("controller",))
    log = rollout.run()
    there = slice(0, 25) if laws[0] == "tde_aismc" else slice(25, None)
    for name in ("sliding_variable", "reaching_gain", "switching_gain"):
        values = make_table(log)[name].values
        assert np.isfinite(values[there]).all()
        rest = np.delete(values, there, axis=0)
        assert len(rest) in (25, 36)
        assert np.isnan(rest).all()
