"""Captures side by side, with closing grippers and supervisors: each has the bits that it has
alone.
"""

import dataclasses
import functools

import numpy as np
import pytest
from pydrake.systems.framework import LeafSystem

from ffsm_drake import load_scenario, override_scenario
from ffsm_drake.loop.closed_loop import make_closed_loop
from ffsm_drake.plugins.capture.supervisor import Mode
from ffsm_drake.runs.batches import batches_of, run_many
from ffsm_drake.runs.rollout import make_rollout
from ffsm_drake.systems.side_by_side import NotAlike, SideBySide

# From a posture near that at the grasp, so that little time is enough.
NEAR = "{joint_1: 0.15, joint_2: 0.33, joint_3: 1.1, joint_4: 0.5, joint_5: -0.75}"
CLOSING = (
    "duration=2",
    "reference.duration=3",
    f"capture.approach={{duration: 1.2, posture: "
    f"{{base_position: [0.1, 0.3, -0.2], joints: {NEAR}}}}}",
    "capture.approach.posture.base_rpy=[0.11, 0.08, -0.1]",
    "capture.closing={time: 0.4, hold: 0.4}",
    "supervisor={}",
)
# The last is missed; whether the others are held depends on ``closing.joints`` and ``rest``.
DIFFERENT = (
    ("random_seed=3", "payload.truth.mass=80"),
    ("capture.closing.friction=0.25", "capture.rate=[0.02, 0.01, 0.03]"),
    ("capture.closing.friction=1e-4",),
    ("capture.envelope.velocity=1e-6",),
)
BEYOND = (  # the first spins faster than the limits let the law stop it at once
    "capture.approach=null",
    "duration=1.2",
    "supervisor={}",
)
RATES = ("[0.2, 0.17, 0.22]", "[0.02, 0.01, 0.03]", "[0.01, 0.02, 0.01]")


def assert_same(log, alone):
    assert log.outcome == alone.outcome
    assert set(log.series) == set(alone.series)
    for name, values in alone.series.items():
        np.testing.assert_array_equal(log.series[name], values, err_msg=name)


def test_gripper_and_supervisor_are_one_block_for_all():
    base = load_scenario("tumbling_capture", CLOSING)
    scenarios = [override_scenario(base, list(each)) for each in DIFFERENT]
    loop = make_closed_loop([dataclasses.replace(each, holds=False) for each in scenarios])
    assert {"supervisor", "forces.gripper"} <= set(loop.blocks)
    assert not [n for n, block in loop.blocks.items() if isinstance(block, SideBySide)]


@pytest.mark.long
@pytest.mark.parametrize(
    ("joints", "rest", "ends"),
    [
        ("limp", 0.05, ["completed", "completed", "slipped", "missed"]),
        ("controlled", 0.15, ["slipped", "completed", "completed", "missed"]),
    ],
)
def test_first_tries_that_hold_go_on_side_by_side(joints, rest, ends):
    given = f"capture.closing.joints={joints}", f"capture.closing.rest={rest}"
    base = load_scenario("tumbling_capture", [*CLOSING, *given])
    scenarios = [override_scenario(base, list(each)) for each in DIFFERENT]
    assert batches_of(scenarios, 4) == [[0, 1, 2, 3]]
    rollout = make_rollout(scenarios)
    together = rollout.run_all()
    rollout.release()
    alone = [make_rollout(each).run() for each in scenarios]
    assert [log.outcome.status for log in alone] == ends
    assert [log is not None for log in together] == [end == "completed" for end in ends]
    for log, own in zip(together, alone, strict=True):
        if log is not None:
            assert_same(log, own)
            assert log.grasp.legs == own.grasp.legs
            assert np.array_equal(log.grasp.target, own.grasp.target)
    for index, log in run_many(scenarios):
        assert_same(log, alone[index])


@pytest.mark.long
def test_runs_that_diverge_while_the_gripper_closes_keep_their_logs():
    base = load_scenario("tumbling_capture", [*CLOSING, "disturbance.amplitude_scale=0"])
    bounds = (1e6, 0.1)  # the second is exceeded as the target turns the limp arm
    scenarios = [override_scenario(base, [f"divergence_speed={each}"]) for each in bounds]
    logs = dict(run_many(scenarios))
    for index, scenario in enumerate(scenarios):
        own = make_rollout(scenario).run()
        assert_same(logs[index], own)
        assert logs[index].grasp.legs == own.grasp.legs
        assert np.array_equal(logs[index].grasp.target, own.grasp.target)
    assert [log.outcome.status for log in (logs[0], logs[1])] == ["completed", "diverged"]
    assert logs[1].grasp.legs[-1][0] == "closing"


@pytest.mark.slow
@pytest.mark.parametrize("controller", ["tde_aismc", "slotine_li"])
def test_a_law_restarts_in_its_own_copy_only(controller):
    base = load_scenario("tumbling_capture", [*BEYOND, f"controller={controller}"])
    scenarios = [override_scenario(base, [f"capture.rate={rate}"]) for rate in RATES]
    rollout = make_rollout(scenarios)
    logs = rollout.run_all()
    rollout.release()
    for log, scenario in zip(logs, scenarios, strict=True):
        assert_same(log, make_rollout(scenario).run())
    damped = [Mode.RATE_DAMPING in log.series["mode"] for log in logs]
    assert damped == [True, False, False]


class Asking(LeafSystem):
    """A force that asks the supervisor to act."""

    def __init__(self, setup):
        super().__init__()
        size = len(setup.coordinates.names)
        self.DeclareVectorOutputPort("generalized_force", size, lambda context, output: None)
        self.DeclareVectorOutputPort("abort_request", 1, lambda context, output: None)


def test_what_asks_the_supervisor_runs_alone():
    scenario = load_scenario("tumbling_capture", BEYOND)
    make = functools.partial(make_rollout, blocks={"forces.asking": Asking})
    make(scenario).release()
    with pytest.raises(NotAlike, match="supervisor"):
        make([scenario, scenario])
