"""The coordinated law: momentum splits as its theory says, and its energy falls."""

import numpy as np
import pytest
from own_loop import EXACT, FIRST, SWING, flown, resting

from ffsm_drake import load_scenario, make_nominal_plant
from ffsm_drake.mission import make_mission
from ffsm_drake.spacecraft.free_floating import free_floating
from ffsm_drake.systems.controllers import make_law


def scenario(*overrides):
    return load_scenario("postcapture", [EXACT, "controller=coordinated", *overrides])


@pytest.mark.smoke
def test_the_mass_matrix_has_two_blocks():
    given = scenario()
    model, law = make_nominal_plant(given), make_law(make_mission(given), make_nominal_plant(given))
    random = np.random.default_rng(0)
    q = np.concatenate([[1.0, 0.0, 0.0, 0.0], random.normal(size=8)])
    H = model.calc_mass_matrix(q)
    T = np.eye(11)
    T[3:6] = H[3:6] / H[3, 3]
    found = np.linalg.inv(T).T @ H @ np.linalg.inv(T)
    internal = np.r_[0:3, 6:11]
    assert np.abs(found[3:6][:, internal]).max() < 1e-10
    np.testing.assert_allclose(found[3:6, 3:6], H[3, 3] * np.eye(3), atol=1e-10)
    reduced = law.internal.calc_mass_matrix(q)
    np.testing.assert_allclose(
        found[np.ix_(internal, internal)], reduced[np.ix_(internal, internal)], atol=1e-10
    )


@pytest.mark.smoke
def test_arm_and_attitude_move_without_thrust():
    """From errors of attitude and joints with the centre of mass where it is wanted: the base's
    force stays zero, the linear momentum too, while PD+ on the base's position pushes.
    """
    given = scenario()
    model = make_nominal_plant(given)

    def center(q):
        return free_floating(model, q).center_of_mass + q[4:7]

    q = FIRST.copy()
    q[:4] = [np.cos(0.05), np.sin(0.05), 0.0, 0.0]
    q[7:] += 0.1
    q[4:7] += center(FIRST) - center(q)
    start = np.concatenate([q, np.zeros(11)])
    course = flown(given, resting, 6.0, start=start)
    pushed = flown(
        load_scenario("postcapture", [EXACT, "controller=pd_plus"]), resting, 3.0, start=start
    )
    assert np.abs(pushed.force[:, 3:6]).max() > 10.0
    assert np.abs(course.force[:, 3:6]).max() < 1e-5 * np.abs(pushed.force[:, 3:6]).max()
    last = course.state[-1]
    assert np.abs(free_floating(model, last[:12]).momentum(last[12:])[3:]).max() < 1e-4
    assert np.abs(course.error[-1, :3]).max() < 0.2 * 0.1
    assert np.linalg.norm(center(last[:12]) - center(FIRST)) < 1e-6


def test_a_push_on_the_centre_of_mass_moves_no_joint():
    """The centre of mass has no way into attitude and joints."""
    start = np.concatenate([FIRST, np.zeros(11)])
    start[4:7] += [0.1, -0.05, 0.2]
    course = flown(scenario(), resting, 6.0, start=start)
    internal = np.r_[0:3, 6:11]
    assert np.abs(course.error[:, internal]).max() < 1e-7
    assert np.abs(course.error[0, 3:6]).max() > 0.1 > 3 * np.abs(course.error[-1, 3:6]).max()


@pytest.mark.slow
@pytest.mark.parametrize("moving", [False, True])
def test_its_energy_falls(moving):
    """e'^T H* e' / 2 + m |e_c'|^2 / 2 + the springs' energy, also about a moving reference."""
    given = scenario(
        "sample_time=0.002",
        "controllers.coordinated={k_p: {all: 60, base_position: 400}, "
        "k_d: {all: 20, base_position: 300}}",
    )
    model = make_nominal_plant(given)
    law = make_law(make_mission(given), model)
    reference = SWING if moving else resting
    start = np.concatenate([FIRST, np.full(11, 0.05)])
    course = flown(given, reference, 3.0, start=start)
    internal, energies = np.r_[0:3, 6:11], []
    for t, state, error in zip(course.time, course.state, course.error, strict=True):
        q, v = state[:12], state[12:]
        q_d, v_d, _ = reference(t)
        rate = (v_d - v)[internal]
        H, H_d = model.calc_mass_matrix(q), model.calc_mass_matrix(q_d)
        reduced = law.internal.calc_mass_matrix(q)[np.ix_(internal, internal)]
        centers = [free_floating(model, each).center_of_mass + each[4:7] for each in (q_d, q)]
        e_c, mass = centers[0] - centers[1], H[3, 3]
        e_c_rate = (H_d[3:6] @ v_d - H[3:6] @ v) / mass
        energies.append(
            0.5 * rate @ reduced @ rate
            + 0.5 * mass * e_c_rate @ e_c_rate
            + 0.5 * law.k_p[internal] @ error[internal] ** 2
            + 0.5 * law.k_p[3:6] @ e_c**2
        )
    energies = np.array(energies)
    assert np.diff(energies).max() < 2e-5 * energies[0]
    assert energies[-1] < 0.7 * energies[0]
