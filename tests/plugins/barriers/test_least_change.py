"""The program of the barriers against other solvers, and on symbols."""

import numpy as np
import pytest
from pydrake.solvers import ClarabelSolver, MathematicalProgram
from scipy.optimize import linprog

from ffsm_drake.plugins.barriers.least_change import least_change


def drawn(random):
    """M, and limits of x and of M x; forces may be unlimited, and the limits may conflict."""
    n = int(random.integers(1, 8))
    root = random.normal(size=(n, n))
    mass = root @ root.T * 10.0 ** random.uniform(-2, 2) + np.diag(10.0 ** random.uniform(-2, 2, n))
    size = 10.0 ** random.uniform(-2, 2)
    low = -random.uniform(-0.5, 3.0, n) * size
    high = low + random.uniform(0.1, 4.0, n) * size
    most = np.diagonal(mass) * size * random.uniform(0.2, 4.0, n)
    if random.random() < 0.3:
        most[:] = np.inf
    if random.random() < 0.5:
        high[0] = np.inf
    shift = np.where(np.isfinite(most), most, 0.0) * random.uniform(-0.9, 1.2)
    return mass, low, high, -most - shift, most - shift, size


def rows_of(mass, low, high, down, up):
    """G x <= g, of finite limits, with the columns of the slack."""
    n = len(mass)
    rows, bounds = np.vstack([np.eye(n), -np.eye(n), mass, -mass]), np.r_[high, -low, up, -down]
    slack, known = np.r_[-np.ones(2 * n), np.zeros(2 * n)], np.isfinite(bounds)
    return rows[known], bounds[known], slack[known]


@pytest.mark.slow
def test_drawn_programs_have_the_solutions_of_other_solvers():
    random = np.random.default_rng(0)
    conflicts = inactive = 0
    for _ in range(200):
        mass, low, high, down, up, size = drawn(random)
        n, (rows, bounds, slack) = len(mass), rows_of(mass, low, high, down, up)
        x, s = least_change(mass, low, high, down, up)
        unit = max(size, -low.min(), np.abs(x).max())
        least = linprog(
            np.r_[np.zeros(n), 1.0], A_ub=np.c_[rows, slack], b_ub=bounds,
            bounds=[(None, None)] * n + [(0, None)],
        )  # fmt: skip
        assert s[0] == pytest.approx(least.fun, abs=1e-6 * unit)
        assert (rows @ x <= bounds - slack * s + 1e-7 * unit * np.abs(rows).sum(axis=1)).all()
        if least.fun > 1e-6 * unit:
            conflicts += 1
            continue
        if (bounds >= 0.0).all():
            inactive += 1
            assert not x.any()
            continue
        program, largest = MathematicalProgram(), np.diagonal(mass).max()
        z = program.NewContinuousVariables(n)
        program.AddQuadraticCost(mass / largest, np.zeros(n), z)
        sizes = np.linalg.norm(rows, axis=1)
        program.AddLinearConstraint(
            rows / sizes[:, None], np.full(len(rows), -np.inf), bounds / sizes / size, z
        )
        exact = size * ClarabelSolver().Solve(program).GetSolution(z)
        off = x - exact
        assert off @ mass @ off < 1e-9 * largest * unit**2
    assert conflicts > 20
    assert inactive > 5


@pytest.mark.smoke
def test_one_joint_is_cut_at_its_limits():
    """By hand: x = high; forces cut it at up / M, and the rest is slack."""
    mass, far = np.array([[4.0]]), np.array([np.inf])
    high = np.array([-2.0])
    x, slack = least_change(mass, -far, high, -far, far)
    np.testing.assert_allclose([x[0], slack[0]], [-2.0, 0.0], atol=1e-8)
    x, slack = least_change(mass, -far, high, np.array([-6.0]), far)
    np.testing.assert_allclose([x[0], slack[0]], [-1.5, 0.5], atol=1e-8)
    x, slack = least_change(mass, -far, -high, -far, far)
    assert (x[0], slack[0]) == (0.0, 0.0)


def test_the_joint_with_less_inertia_gives_way():
    """Two coupled joints: a limit of one moves the other by -M_22^-1 M_21 x_1, without force."""
    mass, far = np.array([[3.0, 1.0], [1.0, 2.0]]), np.full(2, np.inf)
    x, _ = least_change(mass, -far, np.array([-1.0, np.inf]), -far, far)
    np.testing.assert_allclose(x, [-1.0, 0.5], atol=1e-8)
    assert abs((mass @ x)[1]) < 1e-7


@pytest.mark.parametrize("seed", range(3))
def test_a_force_without_room_has_an_answer(seed):
    """Where its lowest and highest value are equal, rounding can make a system singular."""
    random = np.random.default_rng(seed)
    for _ in range(150):
        mass, low, high, down, up, _ = drawn(random)
        scale = 10.0 ** random.uniform(-6, 6)
        down[np.isinf(down)], up[np.isinf(up)] = -np.diagonal(mass)[0], np.diagonal(mass)[0]
        down[0] = up[0]
        given = (each * scale for each in (low, high, down, up))
        change, slack = least_change(mass, *given)
        assert np.isfinite(change).all()
        assert np.isfinite(slack).all()
