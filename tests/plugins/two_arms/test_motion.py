"""The motion of the closed chain: closed at every instant, exact rates, and refusals."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from drawn_arms import ARMS, two_arms
from numpy.testing import assert_allclose

from ffsm_drake import Scenario, ScenarioError, load_scenario, make_nominal_plant, simulate
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.two_arms.chain import ClosedChain
from ffsm_drake.systems.reference import make_motion


@pytest.fixture(params=ARMS, ids="{}_joints".format)
def drawn(request: pytest.FixtureRequest, tmp_path: Path) -> Scenario:
    axes, lengths, joints, place = ARMS[request.param]
    moved = -0.1 if axes == "zzz" else 0.15
    return two_arms(tmp_path, axes, lengths, joints, place=place, moved=moved)


@pytest.mark.smoke
def test_loops_are_closed_along_the_motion_with_exact_rates(drawn: Scenario) -> None:
    model = make_nominal_plant(drawn)
    motion, chain = make_motion(make_mission(drawn)), ClosedChain(model, drawn, true=False)
    nq, nv = len(model.coordinates.position_names), len(model.coordinates.names)
    step, times = 1e-4, np.linspace(0.0, motion.end, 23)
    rows = motion.rows(times)
    for row in rows:
        q, v, a = np.split(row, [nq, nq + nv])
        assert_allclose(chain.gap(q), 0.0, atol=1e-9)
        assert_allclose(chain.jacobian(q) @ v, 0.0, atol=1e-8)
        assert_allclose(chain.jacobian(q) @ a + chain.bias(q, v), 0.0, atol=1e-6)
    inside = times[1:-1]
    before, after = motion.rows(inside - step), motion.rows(inside + step)
    joints = slice(7, nq), slice(nq + 6, nq + nv), slice(nq + nv + 6, None)
    for low, high in itertools.pairwise(joints):
        slope = (after[:, low] - before[:, low]) / (2 * step)
        assert_allclose(slope, rows[1:-1, high], atol=1e-6)
    assert np.abs(rows[-1, 7:nq] - rows[0, 7:nq]).max() > 0.05
    assert not rows[[0, -1], nq:].any()


@pytest.mark.long
def test_every_pair_of_arms_settles_with_a_small_internal_force(drawn: Scenario) -> None:
    run = simulate(drawn.replace(duration=8.0, reference={"duration": 6.0}), check_stability=False)
    contacts = run.metrics["contacts"]
    assert run.outcome.status == "completed"
    assert max(run.metrics["final_error"].values()) < 1e-4
    assert contacts["force"] < 5.0
    assert contacts["gap"] < 1e-9


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["contacts.right.effector=servicer::left_hand"], "is also the hand of 'left'"),
        (["contacts.right.effector=servicer::base"], "effector: 'servicer::base' is on no arm"),
        (["contacts.right.frame=servicer::base"], "frame: .* is not fixed to the target"),
        (["contacts.right.frame=servicer::right_hand"], "frame: .* is not fixed to the target"),
        (["contacts.right.frame=servicer::left_link_4"], "frame: .* is not fixed to the target"),
        (["contacts.right.frame=debris::left_grasp"], "its hand does not reach"),
        (["contacts.left.kind=compliant"], "must be rigid"),
        (["contacts.left.effector=servicer::right_link_6"], "no contact has model.end_effector"),
        (["initial_posture.joints.left_2=-1.2"], "its hand does not reach"),
        (["target_posture.joints.left_1=3.0"], "at .* % of the path its hand does not reach"),
        (["target_posture.joints.left_5=0.0"], "at .* % of the path the arm of .* is singular"),
        (["chain.force.preload=[1]"], "must hold 6 values"),
    ],
)
def test_refusals_are_one_line(overrides: list[str], words: str) -> None:
    with pytest.raises(ScenarioError, match=words) as caught:
        simulate(load_scenario("two_arms", [*overrides, "duration=0.1"]), check_stability=False)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("link", range(1, 7))
def test_a_second_hand_on_any_link_is_refused_unless_it_has_enough_joints(link: int) -> None:
    """On the first arm always; on the second, up to its last link."""
    for side, words in (
        ("left", "is on the arm of contact 'left' too"),
        ("right", f"{link} joints? and {link} of the 6"),
    ):
        if (side, link) == ("right", 6):
            continue
        changed = f"contacts.right.effector=servicer::{side}_link_{link}"
        with pytest.raises(ScenarioError, match=words) as caught:
            simulate(load_scenario("two_arms", [changed, "duration=0.1"]), check_stability=False)
        assert "\n" not in str(caught.value)


def test_an_arm_with_too_few_joints_is_refused(tmp_path: Path) -> None:
    axes, lengths, joints, place = ARMS[6]
    short = two_arms(tmp_path, axes, lengths, joints, place=place, right=axes[:4])
    with pytest.raises(ScenarioError, match=r"contacts.right: its arm has 4 joints and 4 of the 6"):
        simulate(short, check_stability=False)
