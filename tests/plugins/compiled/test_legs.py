"""A compiled run in legs, each of which goes on where the last one ended."""

import os

import numpy as np
import pytest
from compared_runs import of_seeds

from ffsm_drake.common.errors import BlockError
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.compiled.called import Laws
from ffsm_drake.plugins.compiled.case import case_of
from ffsm_drake.plugins.compiled.engine import _kernel
from ffsm_drake.plugins.compiled.kernel import LaneState
from ffsm_drake.plugins.compiled.missions import Lane, advance
from ffsm_drake.plugins.compiled.plans import plans_of
from ffsm_drake.plugins.compiled.run import run_of
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.rollout import Leg, Rollout

DRAWS = int(os.environ.get("FFSM_DRAWS", "1"))
LANES = 3
VARIANTS = {
    "postcapture": ["sensing.position_noise=0.001", "sensing.velocity_bias_walk=0.001"],
    "flight_sensors": ["sensing.delay=2", "actuation.delay=1"],
    "slow_navigation": [],
    "thrusters_only": [],
    "envisat": [
        "supervisor={saturated_time: 0.03, end_share: 0.9, end_time: 0.02}",
        "actuation.limit=0.05",
        "controller=tde_aismc",
    ],
}


def compiled(name, given, *, called=False):
    """The kernel and runs of a scenario with several seeds."""
    scenarios = of_seeds(name, ["duration=0.2", *given], LANES * [[]])
    runs = [run_of(case_of(each), each) for each in map(Mission, scenarios)]
    if called:
        runs = [run.with_called_law("a test") for run in runs]
    return _kernel(runs[0], alone=False), runs


def called_of(kernel, runs):
    """What the kernel calls."""
    called = kernel.blocks.called
    laws = Laws(kernel.blocks, [run.controller for run in runs]) if called else None
    return {"laws": laws, "plans": plans_of(runs)}


def in_legs(kernel, runs, lengths):
    """The logs of runs in legs of so many samples, the first of different ones."""
    begin, logs = [LaneState(run.states) for run in runs], [[] for _ in runs]
    first = [1 + i for i in range(len(runs))]  # lanes of a register at different samples
    ends = []
    for run, state, samples in zip(runs, begin, first, strict=True):
        ends += kernel.leg(
            [run.parameters], [state], [run.rows], samples, **called_of(kernel, [run])
        )
    for i, end in enumerate(ends):
        logs[i].append(end.log)
    left = runs[0].samples - 1 - len(runs)
    for samples in [*lengths, left - sum(lengths)]:
        ends = kernel.leg(
            [run.parameters for run in runs], [end.state for end in ends],
            [run.rows for run in runs], samples, **called_of(kernel, runs),
        )  # fmt: skip
        for i, end in enumerate(ends):
            logs[i].append(end.log)
    return [{name: np.concatenate([log[name] for log in own]) for name in own[0]} for own in logs]


def check_legs(name, given, seed, *, called=False):
    kernel, runs = compiled(name, given, called=called)
    random = np.random.default_rng(seed)
    whole = kernel.leg(
        [run.parameters for run in runs], [LaneState(run.states) for run in runs],
        [run.rows for run in runs], runs[0].samples - 1, **called_of(kernel, runs), ends=True,
    )  # fmt: skip
    for one, end in zip(
        in_legs(kernel, runs, random.integers(1, 6, 2).tolist()), whole, strict=True
    ):
        assert end.left is None
        if "mode_cause" in one:  # a plan goes on in the next leg
            assert {4.0} < {*one["mode"].ravel().tolist()}
            assert one["mode_cause"].any()
        for key, values in one.items():
            assert len(values) >= runs[0].samples - len(runs)
            assert np.array_equal(values, end.log[key][: len(values)]), key


@pytest.mark.smoke
@pytest.mark.parametrize("called", [False, True])
def test_legs_have_the_bits_of_a_whole_run(called):
    check_legs("postcapture", VARIANTS["postcapture"], 0, called=called)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name == "flight_sensors" else pytest.mark.long)
        for name in VARIANTS
    ],
)
def test_drawn_legs_have_the_bits_of_a_whole_run(name):
    for seed in range(DRAWS):
        for called in (False, True):
            check_legs(name, VARIANTS[name], seed, called=called)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name == "flight_sensors" else pytest.mark.long)
        for name in VARIANTS
    ],
)
def test_a_leg_ends_with_the_measurement_and_state_of_drake(name):
    kernel, runs = compiled(name, VARIANTS[name])
    run, found = runs[1], {}

    def end(loop, context):
        found["measured"] = loop.diagram.GetOutputPort("estimated_state").Eval(context).copy()
        found["x"] = loop.whole_state(context)

    rollout = Rollout(run.scenario, grip=run.case.nominal.grip)
    for samples in (1, 7):
        rollout.run(run.scenario, leg=Leg(last=samples, end=end))
        (leg,) = kernel.leg([run.parameters], [LaneState(run.states)], [run.rows], samples)
        assert leg.state.sample == samples
        np.testing.assert_allclose(leg.measured, found["measured"], rtol=0.0, atol=1e-10)
        np.testing.assert_allclose(
            leg.state.cells["x"][: found["x"].size], found["x"], rtol=0.0, atol=1e-10
        )
    rollout.release()


def test_a_first_sample_can_be_any():
    """A law that begins at a sample forgets, traced and called."""
    forces = []
    for called in (False, True):
        kernel, (run, *_) = compiled("postcapture", [], called=called)
        for first_at in (3, 0):
            begin = [LaneState(run.states, 3, first_at)]
            (end,) = kernel.leg([run.parameters], begin, [run.rows], 1, **called_of(kernel, [run]))
            forces.append(end.log["generalized_force"])
    np.testing.assert_allclose(forces[2:], forces[:2], rtol=0.0, atol=1e-9)
    assert np.abs(forces[0] - forces[1]).max() > 1e-3


def test_a_lane_that_leaves_keeps_its_state_before_the_sample():
    kernel, runs = compiled("postcapture", [])
    run = runs[0]
    (whole,) = kernel.leg(
        [run.parameters], [LaneState(run.states)], [run.rows], run.samples - 1, ends=True
    )
    speeds = np.abs(whole.log["state"][:, run.blocks.nq :]).max(axis=1)
    bound = 0.5 * (np.sort(speeds)[-3] + np.sort(speeds)[-4])
    left = int(np.flatnonzero(speeds > bound)[0])
    assert left > 0
    slower = run.parameters | {"bound": np.array([bound])}
    (gone, stays) = kernel.leg(
        [slower, run.parameters], 2 * [LaneState(run.states)], 2 * [run.rows], run.samples - 1
    )
    assert stays.left is None
    assert gone.left == gone.state.sample == left
    assert all(len(values) == left + 1 for values in gone.log.values())
    (before,) = kernel.leg([run.parameters], [LaneState(run.states)], [run.rows], left)
    for name, values in before.state.cells.items():
        assert np.array_equal(gone.state.cells[name], values), name


class Unjudged(Lane):
    """A run whose phase cannot be judged at its end."""

    def note(self, end, spent):
        raise BlockError("no judgement")


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["sizes", "judgement"])
def test_an_error_leaves_only_its_lane_to_drake(kind, seed):
    """With the bits that the others have without it, whatever the number of lanes."""
    kernel, (run, *_) = compiled("postcapture", [])
    rng = np.random.default_rng(seed)
    number = int(rng.integers(2, 2 * kernel.width + 2))
    runs = [run.carrying(run.scenario.payload.truth) for _ in range(number)]
    bad = {*rng.choice(number, int(rng.integers(1, number)), replace=False).tolist()}
    lanes = [Lane(each.mission, each) for each in runs]
    for index in bad:
        if kind == "judgement":
            lanes[index] = Unjudged(runs[index].mission, runs[index])
        else:
            runs[index].parameters |= {"law": np.append(runs[index].parameters["law"], 0.0)}
    alone = Lane(run.mission, run)
    for group in (lanes, [alone]):
        advance(group, lambda runs: kernel)
    for index, lane in enumerate(lanes):
        assert isinstance(lane.result, NotCovered if index in bad else RunLog)
        if index in bad:
            said = "no judgement" if kind == "judgement" else "numbers of law"
            assert said in str(lane.result)
            continue
        for name, values in alone.result.series.items():
            assert np.array_equal(lane.result.series[name], values, equal_nan=True), name
