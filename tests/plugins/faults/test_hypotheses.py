"""Hypotheses on faults of joints and thrusters: solver, payload, votes and decision."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from ffsm_drake import load_scenario
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.faults import features
from ffsm_drake.plugins.faults.box_squares import least_squares
from ffsm_drake.plugins.faults.correction import moved
from ffsm_drake.plugins.faults.decision import decided
from ffsm_drake.plugins.faults.features import Means, Places, rows_of
from ffsm_drake.plugins.faults.hypotheses import ALARM, Hypotheses, Vote, vote, vote_of_chain
from ffsm_drake.plugins.faults.panels import AGO, SIZE, SPANS, PanelBound
from ffsm_drake.plugins.faults.payload_error import force_by_errors, intervals
from ffsm_drake.scenario import MassProperties
from ffsm_drake.spacecraft.plant import find_frame

JOINTS, THRUSTERS = 3, 8
NV = 6 + JOINTS


@settings(max_examples=30, deadline=None)
@given(st.integers(2, 12), st.integers(1, 25), st.integers(0, 10**6))
def test_squares_agree_with_scipy(rows, columns, seed):
    rng = np.random.default_rng(seed)
    matrix, values = rng.normal(size=(4, rows, columns)), 5.0 * rng.normal(size=(4, rows))
    low = rng.uniform(-2.0, 0.5, (4, columns))
    high = low + rng.uniform(0.01, 3.0, (4, columns))
    squares, x = least_squares(matrix, values, low, high)
    assert (x >= low - 1e-12).all()
    assert (x <= high + 1e-12).all()
    left = values - np.einsum("nij,nj->ni", matrix, x)
    assert squares == pytest.approx((left**2).sum(axis=1))
    for each in range(4):
        exact = 2.0 * lsq_linear(matrix[each], values[each], (low[each], high[each])).cost
        assert exact - 1e-6 <= squares[each] <= exact + 1.0


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_squares_are_right_with_unknowns_of_any_size(seed):
    """As a jam's force, which may be 1e9 standard deviations in one feature."""
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(6, 41), rng.integers(3, 45)
    large = rng.integers(1, min(rows, columns) // 2 + 1)
    matrix = rng.normal(size=(4, rows, columns)) * 10.0 ** rng.uniform(-2, 2, (4, 1, columns))
    matrix[:, :, :large] *= 10.0 ** rng.uniform(2, 7, (4, 1, large))
    if seed % 2:  # each in rows of its own
        rows_of = np.arange(rows)[:, None] // 5 == np.arange(large) % (rows // 5 + 1)
        matrix[:, :, :large] *= rows_of
    values, box = rng.normal(size=(4, rows)) * 10.0 ** rng.uniform(0, 3), np.ones((4, columns))
    squares, _ = least_squares(matrix, values, -box, box)
    scale = np.maximum(np.linalg.norm(matrix, axis=1), 1.0)
    for each in range(4):
        alike = matrix[each] / scale[each]
        exact = lsq_linear(alike, values[each], (-scale[each], scale[each]), method="bvls")
        assert squares[each] <= 2.0 * exact.cost + 1.0 + 1e-6 * (values[each] @ values[each])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_squares_that_are_enough_are_reached_by_the_values_returned(seed):
    rng = np.random.default_rng(seed)
    matrix, values = rng.normal(size=(6, 5, 12)), 5.0 * rng.normal(size=(6, 5))
    box = np.full((6, 12), 0.5)
    best, _ = least_squares(matrix, values, -box, box)
    squares, x = least_squares(matrix, values, -box, box, 30.0)
    assert ((squares <= 30.0) == (best <= 30.0)).all()
    assert squares[best > 30.0] == pytest.approx(best[best > 30.0])
    assert (np.abs(x) <= box).all()
    left = values - np.einsum("nij,nj->ni", matrix, x)
    assert squares == pytest.approx((left**2).sum(axis=1))


@pytest.mark.parametrize("name", ["thrusters_and_wheels", "postcapture"])
def test_the_force_of_a_wrong_payload_is_that_of_another_plant(name):
    """H_true a + C_true - H a - C, of plants, against the errors of mass, moment and inertia."""
    rng = np.random.default_rng(3)
    mission = Mission(load_scenario(name))
    payload, model = mission.scenario.payload, mission.craft.nominal()
    nominal, nq = payload.nominal, len(model.coordinates.position_names)
    offset = rng.uniform(-0.1, 0.1, 3)
    centre = np.array(nominal.center_of_mass)
    mass = 1.4 * nominal.mass
    tensor = np.diag(nominal.inertia[:3]).astype(float)
    change = rng.uniform(-0.1, 0.1, (3, 3)) * nominal.inertia[0]
    wanted = 1.4 * tensor + change + change.T
    inertia = [wanted[0, 0], wanted[1, 1], wanted[2, 2], wanted[0, 1], wanted[0, 2], wanted[1, 2]]
    truth = MassProperties(
        mass=mass, center_of_mass=(centre + offset).tolist(), inertia=[float(i) for i in inertia]
    )
    true = mission.craft.loaded(mission.craft.nominal(), truth)
    state = np.concatenate(
        [rng.normal(size=nq), 0.3 * rng.normal(size=len(model.coordinates.names))]
    )
    state[:4] /= np.linalg.norm(state[:4])
    q, v = state[:nq], state[nq:]
    acceleration = rng.normal(size=len(v))
    force = true.calc_mass_matrix(q) @ acceleration + true.calc_bias(q, v)
    force -= model.calc_mass_matrix(q) @ acceleration + model.calc_bias(q, v)
    # about the nominal centre, by the parallel axis theorem
    about = wanted + mass * (offset @ offset * np.eye(3) - np.outer(offset, offset)) - tensor
    pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    errors = [mass - nominal.mass, *(mass * offset), *(about[pair] for pair in pairs)]
    frame = find_frame(model.plant, payload.body, key="payload.body")
    twists, step = list[np.ndarray](), 1e-6
    for way in (-step, step):
        at = model.calc_point_jacobian(
            moved(q, way * (v + 0.5 * way * acceleration)), frame, centre
        )
        twists.append(at @ (v + way * acceleration))
    at = model.calc_point_jacobian(q, frame, centre)
    change = (twists[1] - twists[0]) / (2.0 * step)
    columns = force_by_errors(at[None], (at @ v)[None], change[None])[0]
    assert columns @ np.array(errors) == pytest.approx(force, rel=1e-6, abs=1e-6)


def test_the_intervals_hold_every_payload_within_the_factor():
    held = MassProperties(mass=80.0, center_of_mass=[0.0, 0.0, 0.0], inertia=[12.0, 10.0, 8.0])
    low, high = intervals(held, 2.0)
    for ratio in (0.5, 0.7, 1.5, 2.0):
        errors = (ratio - 1.0) * np.array([80.0, 12.0, 10.0, 8.0])
        assert (errors > low[[0, 4, 5, 6]]).all()
        assert (errors < high[[0, 4, 5, 6]]).all()
    same = intervals(held, 1.0)
    assert (same[0][[0, 4, 5, 6]] == 0.0).all()


def drawn(rng, windows=(8, 16, 32)):
    """A spacecraft: mass matrix, pushes, and slopes with their places."""
    arm = rng.uniform(0.3, 1.0, (NV, NV)) * rng.choice([-1.0, 1.0], (NV, NV))
    mass = np.diag([500.0] * 6 + [5.0] * JOINTS) + 0.5 * arm @ arm.T
    pushes = np.zeros((NV, THRUSTERS))
    pushes[:6] = rng.normal(size=(6, THRUSTERS))
    pushes[:6] /= np.linalg.norm(pushes[:6], axis=0)
    return mass, pushes, np.array(windows)


FORCE, BOUND = np.full(THRUSTERS, 5.0), 0.3  # N; N m or N


def seen(rng, force_of, *, told=None):
    """Features of drawn disturbances within the bound and the force (nv) of a fault."""
    mass, pushes, windows = drawn(rng)
    count = len(windows)
    told = rng.uniform(0.0, 2.0, (count, THRUSTERS)) if told is None else told
    forces = np.array([force_of(pushes, row) for row in told])
    normal = BOUND * np.sin(rng.uniform(0.0, 6.0, (count, NV)))
    noise = np.full((count, NV), 1e-5)
    means = Means(
        window=windows, is_slope=np.ones(count, dtype=bool), middle=windows // 2, ago=0 * windows,
        unexplained=(forces + normal) @ np.linalg.inv(mass) + 1e-5 * rng.normal(size=(count, NV)),
        errors=np.zeros((count, NV, 0)), spread=np.zeros(count), noise=noise, told=told,
    )  # fmt: skip
    at = Places(
        inverse=np.tile(np.linalg.inv(mass), (count, 1, 1)), bound=np.full((count, NV), BOUND),
        pushes=np.tile(pushes, (count, 1, 1)), panels=np.zeros((count, 6)), turned=np.zeros(count),
    )  # fmt: skip
    box = np.zeros(10), np.zeros(10)
    return features.whitened(means, at, box, np.zeros(count, dtype=bool))


def votes_of(found):
    squares, _ = least_squares(found.matrix, found.y, found.low, found.high)
    among = Hypotheses.of(np.arange(JOINTS), np.arange(THRUSTERS))
    each = [rows_of(found, np.array([row])) for row in range(len(found.window))]
    return squares, [vote(of, squares[[row]], FORCE, among) for row, of in enumerate(each)]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_disturbances_within_the_bound_are_no_evidence(seed):
    found = seen(np.random.default_rng(seed), lambda pushes, told: np.zeros(NV))
    squares, votes = votes_of(found)
    assert (squares < ALARM).all()
    enough, _ = least_squares(found.matrix, found.y, found.low, found.high, ALARM)
    assert (enough <= ALARM).all()
    assert votes == [None] * len(votes)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, THRUSTERS - 1), st.booleans(), st.integers(0, 10**6))
def test_the_thruster_is_never_excluded(index, gives_more, seed):
    rng = np.random.default_rng(seed)

    def force_of(pushes, told):
        return pushes[:, index] * ((FORCE[index] - told[index]) if gives_more else -told[index])

    for each in votes_of(seen(rng, force_of))[1]:
        assert each is None or each.worse[JOINTS + index] < 14.0


@settings(max_examples=30, deadline=None)
@given(st.integers(0, JOINTS - 1), st.floats(8.0, 60.0), st.booleans(), st.integers(0, 10**6))
def test_a_jam_is_named_and_no_thruster(joint, size, is_back, seed):
    """The force of a jam turns the base as a thruster does: the motion of joints tells."""
    force = np.zeros(NV)
    force[6 + joint] = -size if is_back else size
    _, votes = votes_of(seen(np.random.default_rng(seed), lambda pushes, told: force))
    for each in votes:
        assert each is not None
        assert each.best == joint
        assert (np.delete(each.worse, joint) > 14.0).all()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, JOINTS - 1), st.integers(0, 10**6))
def test_slopes_that_need_different_payloads_show_a_jam(joint, seed):
    """A payload explains each slope, none explains all: one has a large force, the others none."""
    rng = np.random.default_rng(seed)
    force = np.zeros(NV)
    force[6 + joint] = 20.0
    of = seen(rng, lambda pushes, told: force * told[0], told=np.eye(3, THRUSTERS))
    column = (of.white @ force)[:, :, None]
    of = dataclasses.replace(
        of, matrix=np.concatenate([of.matrix, column, np.zeros((3, NV, 9))], axis=2),
        low=np.hstack([of.low, np.full((3, 10), -1.0)]),
        high=np.hstack([of.high, np.ones((3, 10))]),
    )  # fmt: skip
    each, _ = least_squares(of.matrix, of.y, of.low, of.high)
    assert (each < ALARM).all()
    found = vote_of_chain(of, FORCE, Hypotheses.of(np.arange(JOINTS), np.zeros(0, dtype=int)))
    assert found is not None
    assert found.best == joint
    assert found.total > ALARM
    # without the fault, the same payload is enough
    quiet = dataclasses.replace(of, y=of.y - (of.white @ force) * [[1.0], [0.0], [0.0]])
    assert vote_of_chain(quiet, FORCE, Hypotheses.of(np.arange(JOINTS), np.arange(0))) is None


def memory(units=5):
    return SimpleNamespace(
        against=np.zeros((10, units)), voted=np.zeros(10), agreed=np.zeros(3),
        doubted=np.zeros(2 + units),
    )  # fmt: skip


def of_unit(worse, best=0):
    more, share = np.ones(len(worse), dtype=bool), np.ones(len(worse))
    return Vote(best=best, gives_more=more, share=share, worse=np.array(worse), total=100.0)


ALL = np.ones(5, dtype=bool)


def test_a_unit_is_reported_after_three_looks_that_agree():
    kept, clear = memory(), of_unit([0.0, 50.0, 50.0, 50.0, 50.0])
    found = [decided({0: (4, clear)}, kept, ALL, now) for now in (30.0, 31.0, 32.0)]
    assert found[:2] == [None, None]
    assert (found[2].units.tolist(), found[2].kind) == ([0], "stuck_on")


def test_a_unit_that_no_window_finds_best_has_a_kind():
    """Two windows prefer others, but only this unit is among those that both name."""
    kept, found = memory(), None
    one, other = of_unit([0.0, 3.0, *[50.0] * 3]), of_unit([50.0, 3.0, 0.0, 50.0, 50.0], best=2)
    for now in (30.0, 31.0, 32.0):
        found = decided({0: (4, one), 2: (8, other)}, kept, ALL, now)
    assert (found.units.tolist(), found.kind) == ([1], "stuck_on")


def test_windows_that_disagree_report_nothing():
    kept = memory()
    one, other = of_unit([0.0, *[50.0] * 4]), of_unit([50.0, 0.0, *[50.0] * 3], best=1)
    for now in range(30, 90):
        assert decided({0: (4, one), 2: (8, other)}, kept, ALL, float(now)) is None


def test_a_joint_that_moves_is_not_jammed():
    kept, moving = memory(), ALL.copy()
    moving[0] = False
    for now in range(30, 90):
        votes = {0: (4, of_unit([0.0, *[50.0] * 4]))}
        assert decided(votes, kept, moving, float(now)) is None


def test_units_that_cannot_be_told_apart_are_reported_together():
    kept, found = memory(), None
    alike = of_unit([0.0, 50.0, 0.0, 50.0, 50.0])
    for now in range(30, 75):
        found = decided({0: (4, alike)}, kept, ALL, float(now))
        if found is not None:
            break
    assert found is not None
    assert found.units.tolist() == [0, 2]
    assert now >= 69


@pytest.mark.parametrize(("apart", "is_reported"), [(1, True), (17, True), (21, False)])
def test_looks_count_together_only_if_little_time_is_between_them(apart, is_reported):
    kept, alike = memory(), of_unit([0.0, 50.0, 0.0, 50.0, 50.0])
    times = 30.0 + apart * np.arange(60.0)
    found = [decided({0: (4, alike)}, kept, ALL, now) for now in times]
    assert any(each is not None for each in found) == is_reported


def test_a_unit_in_doubt_is_one_that_each_look_names():
    """Two windows name 0 and 1, or 0 and 2, in turn: 0 alone is left."""
    kept, found = memory(), list[object]()
    one, other = of_unit([0.0, 0.0, *[50.0] * 3]), of_unit([0.0, 50.0, 0.0, 50.0, 50.0])
    for now in range(30, 70):
        votes = {0: (4, one)} if now % 2 else {2: (8, other)}
        found.append(decided(votes, kept, ALL, float(now)))
    assert found[:-1] == [None] * 39
    assert (found[-1].units.tolist(), found[-1].kind) == ([0], "stuck_on")


def test_a_new_force_does_not_widen_the_bound_of_panels():
    """Of a force of 2 N on each coordinate, then of 50 N for less than 2 s."""
    step, mass, total = 0.05, np.tile(np.diag(np.arange(10.0, 10.0 + NV)), (65, 1, 1)), 200
    panels = PanelBound(np.zeros((AGO + 1, len(SPANS), SIZE)), np.zeros(len(SPANS)))
    force = np.where(np.arange(total) < total - AGO + 2, 2.0, 50.0)[:, None]
    left = np.cumsum(step * force / np.diag(mass[0]), axis=0)
    for end in range(65, total + 1):
        panels.update(left[end - 65 : end], mass, np.zeros(NV), step)
        if end == 66:
            assert (panels.of(4, is_slope=True) > 20.0).all()
    assert panels.of(4, is_slope=True) == pytest.approx(np.full(SIZE, 6.0))
    assert panels.of(64, is_slope=True) == pytest.approx(np.full(SIZE, 4.0))
