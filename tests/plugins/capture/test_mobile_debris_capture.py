"""The task of the Space Robotics Bench: its draws, the planned meetings, the bound on the force."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis, Quaternion
from pydrake.math import RotationMatrix
from scipy.optimize import linprog

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"


@pytest.fixture
def task(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("mobile_debris_capture")


def test_draws_have_the_ranges_of_the_task(task):
    random = np.random.default_rng(0)
    draws = [task.draw(random) for _ in range(2000)]
    degrees = np.rad2deg
    for of, low, high in (
        (lambda each: each.debris.translation(), [7, -1, -1], [9, 1, 1]),
        (lambda each: each.debris_twist[3:], [-2, -0.5, -0.5], [-0.5, 0.5, 0.5]),
        (lambda each: degrees(each.debris_twist[:3]), [-10] * 3, [10] * 3),
        (lambda each: each.base.translation(), [-0.2] * 3, [0.2] * 3),
        (lambda each: each.base_twist[3:], [-0.2] * 3, [0.2] * 3),
        (lambda each: degrees(each.base_twist[:3]), [-10] * 3, [10] * 3),
        (
            lambda each: degrees(each.joints),
            [-5, -5, -5, -95, -5, 85, 40],
            [5, 5, 5, -85, 5, 95, 50],
        ),
    ):
        values, width = np.array([of(each) for each in draws]), np.subtract(high, low)
        assert (values > low).all()
        assert (values < high).all()
        assert (values.min(axis=0) < low + 0.01 * width).all()
        assert (values.max(axis=0) > high - 0.01 * width).all()
        np.testing.assert_allclose(
            values.mean(axis=0), np.add(low, high) / 2, atol=0.03 * width.max()
        )


@pytest.mark.slow
def test_a_meeting_starts_as_drawn_and_ends_with_the_debris(task):
    """Pose and twist of the hand at the end against the debris moved here."""
    planner, random = task.Planner(400.0), np.random.default_rng(1)
    model = planner.model
    for _ in range(3):
        drawn = task.draw(random)
        end, (w, v) = 14.0, np.split(drawn.debris_twist, 2)
        scenario, motion = planner._meeting(drawn, end, task._GRIPS[7])
        start, last = motion.rows(np.array([0.0, end]))
        first = RotationMatrix(Quaternion(start[:4])).matrix()
        np.testing.assert_allclose(first, drawn.base.rotation().matrix(), atol=1e-12)
        np.testing.assert_allclose(start[4:7], drawn.base.translation())
        np.testing.assert_allclose(start[7:14], drawn.joints)
        # seen from the debris
        np.testing.assert_allclose(start[14:20], drawn.base_twist - [0, 0, 0, *v], atol=1e-12)
        moved = model.calc_frame_motion(last[:14], last[14:27], last[27:], "servicer::grip")
        angle = np.linalg.norm(w)
        turned = RotationMatrix(AngleAxis(angle * end, w / angle)) @ drawn.debris.rotation()
        relative = (turned.inverse() @ RotationMatrix(Quaternion(moved[:4]))).matrix()
        np.testing.assert_allclose(np.sort(np.abs(relative), axis=1), [[0, 0, 1]] * 3, atol=1e-9)
        np.testing.assert_allclose(moved[4:7], drawn.debris.translation(), atol=1e-9)
        np.testing.assert_allclose(moved[7:13], [*w, 0.0, 0.0, 0.0], atol=1e-9)
        # between the ends rates are derivatives of positions
        times = np.linspace(1.0, end - 0.5, 5)
        rows, after = motion.rows(times), motion.rows(times + 1e-6)
        rates = (after[:, 4:14] - rows[:, 4:14]) / 1e-6
        np.testing.assert_allclose(rates, rows[:, 17:27], atol=1e-5)
        changes = (after[:, 14:27] - rows[:, 14:27]) / 1e-6
        np.testing.assert_allclose(changes, rows[:, 27:], atol=1e-4)
        assert scenario.approach.duration == end


def test_the_bound_is_the_least_force_along_an_axis(task):
    """Against a linear program over an acceleration that is constant by steps."""
    random, steps = np.random.default_rng(2), 120
    h = task.EPISODE / steps
    for _ in range(5):
        drawn = task.draw(random)
        found = task.least_force(drawn, 1.0, 0.0)
        ahead = task.EPISODE - h * (np.arange(steps) + 0.5)
        needed = []
        for axis in range(3):
            speed = (drawn.debris_twist - drawn.base_twist)[3 + axis]
            way = (drawn.debris.translation() - drawn.base.translation())[axis]
            way += speed * task.EPISODE
            equal = np.vstack([np.append(np.full(steps, h), 0.0), np.append(h * ahead, 0.0)])
            over = np.block(
                [[np.eye(steps), -np.ones((steps, 1))], [-np.eye(steps), -np.ones((steps, 1))]]
            )
            cost = np.append(np.zeros(steps), 1.0)
            solved = linprog(cost, over, np.zeros(2 * steps), equal, [speed, way], (None, None))
            needed.append(solved.fun)
        assert found == pytest.approx(max(needed), rel=0.02)


def test_the_interval_is_that_of_clopper_and_pearson(task):
    assert task.interval(0, 20) == pytest.approx((0.0, 1.0 - 0.025 ** (1.0 / 20.0)))
    assert task.interval(20, 20) == pytest.approx((0.025 ** (1.0 / 20.0), 1.0))
    low, high = task.interval(7, 20)
    binomial = [np.prod([(20 - i) / (i + 1) for i in range(k)]) for k in range(21)]
    tail = sum(binomial[k] * low**k * (1 - low) ** (20 - k) for k in range(7, 21))
    assert tail == pytest.approx(0.025)
    assert sum(binomial[k] * high**k * (1 - high) ** (20 - k) for k in range(8)) == pytest.approx(
        0.025
    )


@pytest.mark.slow
def test_a_draw_is_caught(task):
    planner = task.Planner(400.0)
    plan = planner.plan(task.draw(np.random.default_rng(0)))
    assert task.fly(plan) == "caught"
