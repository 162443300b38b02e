"""The linear verdict on a whole motion, against runs."""

import dataclasses

import numpy as np
import pytest

from ffsm_drake import load_scenario, simulate
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.moving import MotionStability, motion_stability
from ffsm_drake.plugins.design.stability.planned_dynamics import PlannedDynamics


def pd_plus_between_postures(*overrides):
    """PD+ with a gain that is too large on the way only, where joint_1 is lightest."""

    def posture(angle):
        named = ", ".join(f"joint_{i}: {angle if i == 2 else 0.0}" for i in range(1, 6))
        return f"joints={{{named}}}"

    gains = "{base_position: 1200, base_rotation: 300, joints: 30, joint_1: 3500}"
    return load_scenario(
        "postcapture",
        [
            "controller=pd_plus",
            f"controllers.pd_plus.k_d={gains}",
            f"initial_posture.{posture(-0.6)}",
            f"target_posture.{posture(1.4)}",
            *overrides,
        ],
    )


@pytest.fixture(scope="module")
def unstable():
    """The loops at five fractions of the motion, and those that are chosen."""
    with Linearizer(pd_plus_between_postures()) as linearizer:
        yield linearizer.along(), motion_stability(linearizer)


@pytest.mark.smoke
def test_a_loop_that_is_unstable_on_the_way_only(unstable):
    fixed, found = unstable
    assert max(loop.spectral_radius for loop in fixed) < 1.0
    assert found.worst.spectral_radius == pytest.approx(1.22, abs=0.01)
    assert found.worst.time == pytest.approx(8.0, abs=0.3)
    assert found.growth > 1e15
    assert len(found.loops) < 40


@pytest.mark.slow
def test_its_run_diverges_there():
    outcome = simulate(pd_plus_between_postures("duration=9"), check_stability=False).outcome
    assert outcome.status == "diverged"
    assert outcome.time == pytest.approx(7.6, abs=0.3)


def test_growth_is_that_of_the_samples_in_the_worst_stretch(unstable):
    """One second of a radius is its hundredth power; stable loops before do not reduce it."""
    fixed, found = unstable
    stable, worst = fixed[0], found.worst
    stretch = tuple(dataclasses.replace(worst, time=time) for time in (5.0, 6.0))
    grown = MotionStability(loops=stretch).growth
    assert grown == pytest.approx(worst.spectral_radius**100, rel=1e-9)
    before = tuple(dataclasses.replace(stable, time=time) for time in (0.0, 4.999))
    assert MotionStability(loops=before + stretch).growth == pytest.approx(grown, rel=0.1)
    assert MotionStability(loops=before).growth == 1.0


def test_fast_modes_are_not_hidden_by_slow_ones(unstable):
    _, found = unstable
    approach = [loop for loop in found.loops if 3.0 < loop.time < 5.9]
    assert all(loop.spectral_radius < 1.0 for loop in approach)
    fast = [loop.fast_radius for loop in approach]
    assert fast == sorted(fast)
    assert fast[-1] > 0.9


def test_an_instant_that_cannot_be_linearised_counts_as_unstable(unstable):
    stable = unstable[0][0]
    unknown = [dataclasses.replace(each, a=np.full_like(each.a, np.nan)) for each in stable.samples]
    failed = dataclasses.replace(stable, time=1.0, samples=tuple(unknown))
    found = MotionStability(loops=(stable, failed))
    assert found.growth == np.inf


def test_the_instant_at_which_a_joint_is_lightest_is_one_of_them(unstable):
    planned = PlannedDynamics(make_mission(pd_plus_between_postures()))
    joint = planned.coordinates.names.index("joint_1")
    times = np.linspace(0.0, 20.0, 401)
    lightness = [np.linalg.inv(planned.mass_matrices(t)[0])[joint, joint] for t in times]
    lightest = times[int(np.argmax(lightness))]
    assert min(abs(loop.time - lightest) for loop in unstable[1].loops) < 0.65
