"""A gripper that closes, compiled, against Drake."""

import dataclasses
import os

import numpy as np
import pytest
from compiled_equations import of_copies, text_of_traced

from ffsm_drake import load_scenario
from ffsm_drake.common.so3 import composed, cross_of, matrix_of, quaternion_of
from ffsm_drake.loop.blocks import GRIPPER
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture.closing import MOTION
from ffsm_drake.plugins.capture.contact_force import Jaws
from ffsm_drake.plugins.capture.gripper import Gripper
from ffsm_drake.plugins.compiled.case import Case
from ffsm_drake.plugins.compiled.compiling import registers
from ffsm_drake.plugins.compiled.engine import _kernel
from ffsm_drake.plugins.compiled.kernel import LaneState
from ffsm_drake.plugins.compiled.run import Run
from ffsm_drake.plugins.tape.arrays import inputs
from ffsm_drake.plugins.tape.numbers import Tape
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.runs.rollout import Leg, Rollout
from ffsm_drake.scenario import EMPTY
from ffsm_drake.scenario.capture import Compliance

DRAWS = int(os.environ.get("FFSM_DRAWS", "1"))
SAMPLES = 30
VARIANTS = {
    "limp": ("tumbling_capture", []),
    "controlled": (
        "tumbling_capture",
        ["capture.closing.joints=controlled", "controller=computed_torque"],
    ),
    "orbit": ("tumbling_capture", ["environment={altitude: null, mean_motion: 0.01}"]),
    "panels": ("capture_on_thrusters", []),
}


def drawn(random, name, given):
    """A scenario; the compliance."""
    closing = {
        "preload": 10.0 ** random.uniform(0.0, 3.0), "friction": random.uniform(0.05, 0.6),
        "time": 0.01 * random.integers(20, 60), "radius": 10.0 ** random.uniform(-1.5, -0.5),
        "axis": f"[{', '.join(map(str, random.standard_normal(3).round(3)))}]",
        "joint_damping": random.uniform(0.5, 4.0), "hold": 0.5,
    }  # fmt: skip
    settings = [f"capture.closing.{key}={value}" for key, value in closing.items()]
    masses = [f"payload.truth.mass={random.uniform(30.0, 250.0)}"]
    scenario = load_scenario(
        name,
        ["capture.closing={}", *settings, *masses, *given, f"random_seed={random.integers(100)}"],
    )
    stiffness = 10.0 ** random.uniform(3.5, 5.0)
    return scenario, Compliance(
        stiffness=stiffness, damping=0.02 * stiffness,
        rotational_stiffness=0.2 * stiffness, rotational_damping=0.01 * stiffness,
    )  # fmt: skip


def met(random, block, state):
    """A target in the gripper: off it by some millimetres and degrees, and moving in it."""
    q, v = np.split(state, [(state.size + 1) // 2])
    hand = block.hands[0]
    pose, twist = (
        block.model.calc_frame_pose(q, hand.frame),
        block.model.calc_frame_twist(q, v, hand.frame),
    )
    turn = quaternion_of(random.uniform(-0.05, 0.05, 3))
    q_WE = composed(pose[:4], turn)
    q_WP = composed(q_WE, hand.pose[:4] * [1.0, -1.0, -1.0, -1.0])
    from_P = matrix_of(q_WP) @ hand.pose[4:]
    place = pose[4:] + random.uniform(-0.01, 0.01, 3) - from_P
    w = twist[:3] + random.uniform(-0.1, 0.1, 3)
    velocity = twist[3:] + random.uniform(-0.05, 0.05, 3) - cross_of(w, from_P)
    return np.concatenate([q_WP, place, w, velocity])


def check_closing(variant, seed):
    random = np.random.default_rng(seed)
    scenario, compliance = drawn(random, *VARIANTS[variant])
    part, limp = Gripper(compliance), scenario.closing.joints == "limp"
    joints = random.uniform(-0.1, 0.1, 5) if limp else None
    rollout = Rollout(scenario, blocks={GRIPPER: part}, joint_force=joints, grip=EMPTY)
    found = {}

    def begin(loop, context):
        system = loop.blocks[GRIPPER]
        found["x"] = loop.whole_state(context)
        found["target"] = met(random, system.block, found["x"])
        found["memory"] = system.block.begun(
            time=0.0, payload=scenario.payload.truth, target=found["target"], state=found["x"]
        )
        system.remember(system.GetMyMutableContextFromRoot(context), found["memory"])

    def end(loop, context):
        system = loop.blocks[GRIPPER]
        memory = system.memory(system.GetMyContextFromRoot(context))
        at = memory, context.get_time(), loop.whole_state(context)
        (found["met"],) = system.block.met(*at).values()

    expected = rollout.run(scenario, leg=Leg(last=SAMPLES, begin=begin, end=end))
    rollout.release()
    mission = Mission(scenario)
    case = Case(mission, EMPTY, blocks={GRIPPER: part})
    if limp:
        case.fixed = dataclasses.replace(case.fixed, limp=True)
        case.parameters["joint_force"] = joints
    run = Run(mission, case)
    kernel = _kernel(run, alone=False)
    (block,) = [each for name, each in run.blocks.parts.forces.items() if name == "gripper"]
    memory = np.concatenate([found["memory"][name] for name in block.start()])
    begun = LaneState({**run.states, "touched": memory})
    (leg,) = kernel.leg([run.parameters], [begun], [run.rows], SAMPLES)
    assert expected.outcome.completed
    assert leg.left is None
    for name, values in expected.series.items():
        if name in leg.log:
            scale = max(np.abs(values).max(), 1e-6)
            np.testing.assert_allclose(
                leg.log[name], values, rtol=0.0, atol=1e-9 * scale, err_msg=name
            )
    assert {"contact_force", "gripper_offset", MOTION, "force_gripper"} <= leg.log.keys()
    assert leg.log["contact_force"].any() or np.isfinite(found["met"].left)
    sizes = [each.size for each in block.start().values()]
    parts = np.split(leg.state.cells["touched"], np.cumsum(sizes)[:-1])
    x = leg.state.cells["x"][: found["x"].size]
    memory = dict(zip(block.start(), parts, strict=True))
    (now,) = block.met(memory, SAMPLES * scenario.sample_time, x).values()
    for name in ("motion", "offset", "rate"):
        np.testing.assert_allclose(
            getattr(now, name), getattr(found["met"], name), rtol=0.0, atol=1e-9
        )
    np.testing.assert_allclose(now.left, found["met"].left, rtol=1e-12)


@pytest.mark.slow
def test_a_gripper_that_does_not_close_holds_nothing():
    """The leg after a closing, with what that left in the cells."""
    scenario, _ = drawn(np.random.default_rng(0), *VARIANTS["limp"])
    mission = Mission(scenario)
    run = Run(mission, Case(mission))
    kernel, held = _kernel(run, alone=False), {}
    for name in ("touched", "touch"):
        held[name] = np.ones(run.blocks.states[name])
    begin = [LaneState(run.states), LaneState({**run.states, **held})]
    first, later = kernel.leg(2 * [run.parameters], begin, 2 * [run.rows], 3)
    for name, values in first.log.items():
        assert np.array_equal(later.log[name], values), name
    for name in ("contact_force", "gripper_offset", "force_gripper"):
        assert not later.log[name].any()
    assert MOTION not in later.log
    assert later.state.cells["touched"].all()
    with pytest.raises(NotCovered, match="numbers of x after 3"):
        kernel.cells_of(run.parameters, LaneState({"x": np.zeros(3)}))


@pytest.mark.parametrize(
    "variant",
    [
        pytest.param(name, marks=pytest.mark.slow if name == "limp" else pytest.mark.long)
        for name in VARIANTS
    ],
)
def test_drawn_closings_have_the_force_of_drake(variant):
    for seed in range(DRAWS):
        check_closing(variant, seed)


def contacts(random, count):
    """Jaws, and what they meet, in rows of a function of symbols."""
    given = {name: [] for name in SIZES}
    for _ in range(count):
        axis = random.standard_normal(3)
        root = random.standard_normal((6, 6)) * 10.0 ** random.uniform(-2.0, 1.2, 6)[:, None]
        start = 0.02 * random.standard_normal(6) * random.integers(2)
        made = {
            "K": np.repeat(10.0 ** random.uniform(3.0, 5.0, 2), 3),
            "D": np.repeat(10.0 ** random.uniform(1.0, 3.0, 2), 3),
            "palm": np.concatenate([np.zeros(3), axis / np.linalg.norm(axis)]),
            "numbers": [
                random.uniform(0.1, 1.0), 10.0 ** random.uniform(-1.0, 3.0),
                10.0 ** random.uniform(-2.0, 0.0), random.uniform(0.001, 1.2),
            ],
            "start": start, "offset": start + 0.01 * random.random(6),
            "rate": 0.3 * random.standard_normal(6), "slid": 1e-3 * random.standard_normal(6),
            "mobility": (root @ root.T).ravel(),
        }  # fmt: skip
        for name, values in made.items():
            given[name].append(values)
    return {name: np.array(rows) for name, rows in given.items()}


SIZES = {
    "K": 6, "D": 6, "palm": 6, "numbers": 4, "start": 6, "offset": 6, "rate": 6, "slid": 6,
    "mobility": 36,
}  # fmt: skip


def acted(K, D, palm, numbers, start, offset, rate, slid, mobility):
    closes, load, radius, time = numbers
    jaws = Jaws(stiffness=K, damping=D, palm=palm, time=closes, load=load, radius=radius)
    force, slid = jaws.act(
        time, 1e-3, start=start, offset=offset, rate=rate, slid=slid,
        mobility=mobility.reshape(6, 6),
    )  # fmt: skip
    return np.concatenate([force, slid])


@pytest.mark.parametrize("seed", range(DRAWS))
def test_drawn_contacts_have_the_force_of_numbers(seed):
    given, tape, of = contacts(np.random.default_rng(seed), 200), Tape(), registers()
    symbols = [inputs(tape, name, (size,)) for name, size in SIZES.items()]
    text = text_of_traced(of, tape, SIZES, list(acted(*symbols)))
    found = of_copies(text, of, len(SIZES), 12)(*given.values())
    expected = np.array([acted(*row) for row in zip(*given.values(), strict=True)])
    scale = np.abs(expected[:, :6]).max(axis=1)[:, None]
    assert (np.abs(found - expected)[:, :6] < 1e-9 * scale).all()
    np.testing.assert_allclose(found[:, 6:], expected[:, 6:], rtol=0.0, atol=1e-9)
    assert (np.abs(expected[:, 6:] - given["slid"]).max(axis=1) > 1e-9).sum() > 50  # it slides
