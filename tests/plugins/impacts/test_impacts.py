"""Repeated impacts: the law of contact, momentum of both, and the published figures."""

import dataclasses

import numpy as np
import pytest

from ffsm_drake.plugins.impacts.contact import Surface, depth_in_square
from ffsm_drake.plugins.impacts.robot import JOINTS, TARGET, TIP, WIDTH, Scene, arm_joints
from ffsm_drake.plugins.impacts.strikes import START, Cage, Strikes, run

MOST, SLOW = 5.0, 0.5  # N, rad/s: published limits of a success


def test_a_contact_only_pushes_and_drags_within_its_cone():
    surface, random = Surface(), np.random.default_rng(0)
    for _ in range(200):
        angle, depth = random.uniform(0.0, 2.0 * np.pi), random.uniform(0.0, 5e-3)
        normal = np.array([np.cos(angle), np.sin(angle)])
        velocity = random.normal(size=2)
        force = surface.force(depth=depth, normal=normal, velocity=velocity)
        push, along = -force @ normal, force + (force @ -normal) * normal
        expected = max(0.0, 800.0 * depth - 2.0 * normal @ velocity)
        assert push == pytest.approx(expected, abs=1e-12)
        assert np.linalg.norm(along) <= 0.3 * push * (1.0 + 1e-12)
        sliding = velocity - (velocity @ normal) * normal
        assert along @ sliding >= 0.0
        if np.linalg.norm(sliding) > 0.05:  # well beyond the layer
            assert np.linalg.norm(along) == pytest.approx(0.3 * push, rel=1e-6)


def test_depth_is_the_distance_from_the_square():
    random, side = np.random.default_rng(1), np.linspace(-0.5 * WIDTH, 0.5 * WIDTH, 20001)
    half = np.full_like(side, 0.5 * WIDTH)
    edges = np.hstack([[side, half], [side, -half], [half, side], [-half, side]]).T
    for p in random.uniform(-0.12, 0.12, (60, 2)):
        depth, normal = depth_in_square(p, width=WIDTH, radius=TIP)
        distance = np.linalg.norm(edges - p, axis=1).min()
        inside = (np.abs(p) < 0.5 * WIDTH).all()
        assert depth == pytest.approx(TIP + distance if inside else TIP - distance, abs=1e-6)
        assert np.linalg.norm(normal) == pytest.approx(1.0)
        deeper, _ = depth_in_square(p - 1e-5 * normal, width=WIDTH, radius=TIP)
        assert deeper - depth == pytest.approx(1e-5, rel=1e-3)


@pytest.mark.smoke
def test_forces_on_robot_and_target_are_opposite():
    """Each tip in turn is put into the target: what the contact gives to the robot's momentum, it
    takes from the target's.
    """
    scene, random = Scene(Surface()), np.random.default_rng(2)
    for hand in range(2):
        for tip in range(2):
            q, v = np.concatenate([START, np.zeros(3)]), 0.01 * random.normal(size=12)
            scene.place(q, v)
            at = scene.hands[hand].EvalPoseInWorld(scene.context) @ scene.tips[tip]
            q[TARGET] = [at[0] + 0.5 * WIDTH + 0.9 * TIP, at[1], 0.0]
            scene.place(q, v)
            force, on_tips = scene.contacts(q, v)
            assert on_tips[hand, tip].any()
            np.testing.assert_allclose(force[:2], on_tips.sum(axis=(0, 1)), atol=1e-12)
            np.testing.assert_allclose(force[:2] + force[9:11], 0.0, atol=1e-12)
            # moments about the world's origin
            about = force[2] - q[1] * force[0] + q[0] * force[1]
            about += force[11] - q[10] * force[9] + q[9] * force[10]
            assert about == pytest.approx(0.0, abs=1e-12)


@pytest.mark.long
def test_impacts_with_admittance_slow_the_target():
    mission = Strikes(duration=4.5, step=2e-3)
    found = run(mission)
    spins = np.abs([mission.spin, *found.strikes[:, 2]])
    assert len(spins) >= 3  # more than one impact
    assert (np.diff(spins) < 0.0).all()
    assert spins[-1] < SLOW <= spins[-2]
    assert np.linalg.norm(found.v[-1, 9:11]) < 0.1
    # no more than the spring of the contact gives to the two masses at the speed of closing
    off = 0.5 * WIDTH * mission.off_middle
    mass = 1.0 / (1.0 / 0.2 + 1.0 / 2.34844 + off**2 / 0.00932724)
    bound = mission.speed * np.sqrt(800.0 * mass)
    assert 0.8 * bound < found.force.max() < 1.02 * bound < MOST
    drift = np.abs(found.momentum - found.momentum[0]).max(axis=0)
    assert (drift < 1e-6).all()
    spread = np.abs(found.v[:, TARGET] * [2.34844, 2.34844, 0.00932724]).max()
    assert spread > 1e3 * drift.max()  # what the contacts move from one to the other


@pytest.mark.slow
def test_without_admittance_the_first_impact_is_too_hard():
    found = run(dataclasses.replace(Strikes(), duration=1.75, step=2e-3, admittance=None))
    assert found.force.max() > MOST
    drift = np.abs(found.momentum - found.momentum[0]).max(axis=0)
    assert (drift < 1e-5).all()


def test_joints_of_a_wrist_are_those_of_its_place():
    scene, random = Scene(Surface()), np.random.default_rng(3)
    for _ in range(20):
        q = np.concatenate([0.3 * random.normal(size=3), START[3:], np.zeros(3)])
        q[JOINTS] += random.uniform(-0.3, 0.3, 6)
        scene.place(q, np.zeros(12))
        for i, hand in enumerate(scene.hands):
            own = q[3 + 3 * i : 6 + 3 * i]
            place = hand.EvalPoseInWorld(scene.context).translation()[:2]
            goal = np.array([*place, q[2] + own.sum()])
            np.testing.assert_allclose(arm_joints(i, q[:3], goal), own, atol=1e-9)
            assert np.isnan(arm_joints(i, q[:3], goal * 5.0)).any()


def test_base_goes_where_momentum_takes_it():
    """Against velocities without momentum, integrated here in small steps."""
    scene, random = Scene(Surface()), np.random.default_rng(4)
    q = np.concatenate([START, [0.0, 2.0, 0.0]])
    joints = q[JOINTS] + random.uniform(-0.5, 0.5, 6)
    at, steps = q.copy(), 4000
    v = np.zeros(12)
    v[JOINTS] = joints - q[JOINTS]
    for _ in range(steps):
        columns = [scene.momentum(at, unit) for unit in np.eye(12)[:3]]
        v[:3] = 0.0
        v[:3] = -np.linalg.solve(np.transpose(columns), scene.momentum(at, v))
        at = at + v / steps
    np.testing.assert_allclose(scene.base_after(q, joints), at[:3], atol=2e-4)


@pytest.mark.long
def test_a_slow_target_is_caged():
    found = run(Strikes(spin=-0.45, cage=Cage(), duration=7.0, step=2e-3))
    last = found.time > 6.0
    assert (found.force[last] > 0.0).all()  # all four tips press
    assert found.force.max() < MOST
    # target and base turn together: the stack has what momentum there was
    together = found.spin[last] - found.v[last, 2]
    assert abs(together.mean()) < 0.02
    assert np.abs(found.spin[last]).max() < 0.1 * SLOW
    assert np.linalg.norm(found.v[last, 9:11], axis=1).max() < 0.01
    drift = np.abs(found.momentum - found.momentum[0]).max(axis=0)
    assert (drift < 1e-5).all()
