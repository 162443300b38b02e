"""Grippers of two hands that close on one target over a time (``capture.closing``)."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_capture import APPROACH

from ffsm_drake import ControlLaw, RunRecord, Scenario, ScenarioError, load_scenario, simulate
from ffsm_drake.common.so3 import composed, matrix_of, quaternion_of
from ffsm_drake.loop.blocks import GRIPPER
from ffsm_drake.plugins.capture.contact_force import Jaws, together
from ffsm_drake.plugins.capture.free_body import Target
from ffsm_drake.plugins.capture.gripper import Gripper
from ffsm_drake.runs.rollout import Leg, Rollout
from ffsm_drake.scenario import EMPTY, Grip, inertia_matrix
from ffsm_drake.scenario.capture import Closing, Compliance

SAMPLES = 40
SHORT = ("capture.approach.duration=5", "duration=9", "capture.closing={time: 0.3, hold: 0.5}")


class Limp(ControlLaw):
    """No force."""

    def step(self, sample, state):
        return 0.0 * sample.e, state


def scenario(*given: str) -> Scenario:
    return load_scenario("two_arms_capture", [*APPROACH, *SHORT, *given])


def drawn(random: np.random.Generator, *more: str) -> Scenario:
    closing = {
        "preload": 10.0 ** random.uniform(0.0, 3.0),
        "friction": random.uniform(0.05, 0.6),
        "axis": random.standard_normal(3).round(3).tolist(),
    }
    given = [f"capture.closing.{name}={value}" for name, value in closing.items()]
    given += [f"payload.truth.mass={random.uniform(30.0, 250.0)}", "disturbance.amplitude_scale=0"]
    given += [f"capture.envelope.{name}=null" for name in ("position", "angle")]
    return scenario(*given, *more)


def rolled(given: Scenario, part: Gripper, grip: Grip, **hooks) -> None:
    """Run some samples without actuators."""
    blocks = {GRIPPER: part, "controller": lambda setup: Limp()}
    rollout = Rollout(given, blocks=blocks, joint_force=np.zeros(12), grip=grip)
    log = rollout.run(given, leg=Leg(last=SAMPLES, **hooks))
    rollout.release()
    assert log.outcome.completed
    assert not log.series["applied_force"].any()
    assert log.series["contact_force"].any()


def momentum_of(model, state: np.ndarray) -> np.ndarray:
    """Of all bodies of the plant (6), about the origin of the world."""
    model.plant.SetPositionsAndVelocities(model.context, state)
    found = model.plant.CalcSpatialMomentumInWorldAboutPoint(model.context, np.zeros(3))
    return found.get_coeffs()


@pytest.mark.parametrize("seed", range(3))
def test_two_grippers_conserve_the_momentum_of_servicer_and_free_target(seed: int) -> None:
    random = np.random.default_rng(seed)
    given = drawn(random)
    properties, found = given.payload.truth, list[np.ndarray]()

    def noted(block, memory, time, state) -> None:
        motion = next(iter(block.met(memory, time, state).values())).motion
        body = Target.from_motion(motion, properties)
        R, p = matrix_of(body.quaternion), properties.mass * body.velocity
        spin = R @ (inertia_matrix(properties) @ body.rate) + np.cross(body.center, p)
        found.append(momentum_of(block.model, state) + np.concatenate([spin, p]))

    def begin(loop, context) -> None:
        system, state = loop.blocks[GRIPPER], loop.whole_state(context)
        block = system.block
        hand = block.hands[0]
        pose = block.model.calc_frame_pose(state[: (state.size + 1) // 2], hand.frame)
        turned = composed(pose[:4], quaternion_of(random.uniform(-0.03, 0.03, 3)))
        q_WP = composed(turned, hand.pose[:4] * [1.0, -1.0, -1.0, -1.0])
        place = pose[4:] + random.uniform(-0.01, 0.01, 3) - matrix_of(q_WP) @ hand.pose[4:]
        target = np.concatenate([q_WP, place, random.uniform(-0.05, 0.05, 6)])
        memory = block.begun(time=0.0, payload=properties, target=target, state=state)
        system.remember(system.GetMyMutableContextFromRoot(context), memory)
        noted(block, memory, 0.0, state)

    def end(loop, context) -> None:
        system = loop.blocks[GRIPPER]
        memory = system.memory(system.GetMyContextFromRoot(context))
        assert (np.abs(memory["force"].reshape(2, 6)).max(axis=1) > 0.0).all()
        noted(system.block, memory, context.get_time(), loop.whole_state(context))

    rolled(given, Gripper.closing(given, 0.0), EMPTY, begin=begin, end=end)
    before, after = found
    assert_allclose(after, before, rtol=0.0, atol=1e-5 * np.abs(before).max())


@pytest.mark.parametrize("seed", range(3))
def test_a_later_gripper_conserves_the_momentum_of_the_stack(seed: int) -> None:
    random = np.random.default_rng(seed)
    given, found = drawn(random, "contacts.right.closes=1"), list[np.ndarray]()
    velocity = {"base_rotation": 0.03, "joints": 0.02 * random.uniform(-1.0, 1.0)}
    given = dataclasses.replace(given, initial_velocity=velocity)

    def begin(loop, context) -> None:
        system, state = loop.blocks[GRIPPER], loop.whole_state(context)
        memory = system.block.begun(time=0.0, payload=given.payload.truth, state=state)
        start = memory["start"].reshape(2, 6)
        start[1] += random.uniform(-0.01, 0.01, 6)
        memory = {**memory, "start": start.ravel()}
        system.remember(system.GetMyMutableContextFromRoot(context), memory)
        found.append(momentum_of(system.block.model, state))

    def end(loop, context) -> None:
        found.append(momentum_of(loop.blocks[GRIPPER].block.model, loop.whole_state(context)))

    rolled(given, Gripper.closing(given, 1.0), Grip(), begin=begin, end=end)
    assert_allclose(found[1], found[0], rtol=0.0, atol=1e-6 * np.abs(found[0]).max())


@pytest.mark.parametrize("seed", range(20))
def test_grippers_that_act_at_once_agree_with_each_other(seed: int) -> None:
    """Each force is what its gripper has beside the motion under those of the others."""
    random, number, step = np.random.default_rng(seed), 2 + seed % 2, 1e-3
    compliance = Compliance(stiffness=10.0 ** random.uniform(3.0, 5.0))
    jaws = Jaws.of(Closing(preload=10.0 ** random.uniform(-1.0, 3.0)), compliance)
    root = random.standard_normal((6 * number, 6 * number)) * 10.0 ** random.uniform(-2.0, -0.5)
    mobility, still = root @ root.T, np.zeros((number, 6))
    rows = {"start": 0.01, "offset": 0.01, "rate": 0.1, "slid": 0.0}
    hands = {name: size * random.standard_normal((number, 6)) for name, size in rows.items()}
    given = {**hands, "force": still, "stays": np.ones(number), "mobility": mobility}
    force, slid = together(jaws, 0.3, step, given)
    pushed = (mobility @ force.ravel()).reshape(number, 6)
    for k in range(number):
        own = slice(6 * k, 6 * k + 6)
        rate = hands["rate"][k] + step * (pushed[k] - mobility[own, own] @ force[k])
        each = {name: hands[name][k] for name in ("start", "offset", "slid")}
        alone, slip = jaws.act(0.3, step, rate=rate, mobility=mobility[own, own], **each)
        assert_allclose(force[k], alone, atol=1e-6 * np.abs(force).max())
        assert_allclose(slid[k], slip, atol=1e-8)


def captured(run: RunRecord) -> None:
    """Both hands have acted and hold the target in a chain without a gap."""
    force = run.dataset["contact_force"].values.reshape(-1, 2, 6)
    largest = np.linalg.norm(force[..., 3:], axis=-1).max(axis=0)
    closing = run.scenario.closing
    assert closing is not None
    assert (largest > 0.01).all()
    assert (largest < 2.0 * closing.friction * closing.preload).all()
    assert run.metrics["contacts"]["gap"] < 1e-9
    for size in run.metrics["momentum_residual"].values():
        assert size < 2e-5
    assert run.grasp is not None
    assert max(run.grasp["miss"].values()) > 1e-5


@pytest.mark.slow
def test_both_hands_close_on_a_free_target() -> None:
    run = simulate(scenario(), check_stability=False)
    assert run.outcome.completed
    captured(run)
    assert run.metrics["gripper"]["closings"] == 1
    assert run.metrics["contacts"]["force"] < 10.0
    phases = run.dataset["phase"].values.tolist()
    assert [phases.count(name) for name in ("approach", "closing")] == [420, 80]


@pytest.mark.slow
@pytest.mark.parametrize("controller", ["tde_aismc", "tdc"])
def test_the_jaws_of_a_later_hand_close_on_a_target_that_is_held(controller: str) -> None:
    given = scenario("contacts.right.closes=1.5", f"controller={controller}")
    run = simulate(given, check_stability=False)
    assert run.outcome.completed
    captured(run)
    assert run.metrics["gripper"]["closings"] == 2
    force = run.dataset["contact_force"].values.reshape(-1, 2, 6)
    assert not force[500:650].any()
    assert force[651:730, 1].any()
    assert not force[650:730, 0].any()
    closed = run.dataset["contact_closing"].values
    assert not closed[:730].any()
    assert closed[-1].all()


def test_a_hand_that_misses_is_named() -> None:
    run = simulate(scenario("sensing.position_bias={right_1: 0.1}"), check_stability=False)
    assert run.outcome.status == "missed"
    assert "at t = 4.2 s the target is missed by contacts.right: " in run.outcome.message


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["capture.closing.joints=controlled"], "slips out of the gripper of contacts."),
        (["contacts.right.closes=1.5", "duration=10"], "the gripper of contacts."),
    ],
)
def test_a_hand_that_slips_is_named(given: list[str], words: str) -> None:
    weak = "capture.closing.preload=0.01", "capture.closing.rest=1e-4"
    run = simulate(scenario(*weak, *given), check_stability=False)
    assert run.outcome.status == "slipped"
    assert words in run.outcome.message


def test_a_later_hand_needs_time_for_its_jaws() -> None:
    with pytest.raises(ScenarioError, match=r"contacts\.right\.closes: must leave time to grasp"):
        scenario("contacts.right.closes=3.5")
