"""A published state with all its matrices: Syoris/space-manipulator at 654d943.

The masses and lengths are those of ``models/urdf/SC_2DoF.urdf``, the state, force and results those
of ``test/validation/SC_2DoF_Val.mat`` (no licence; only numbers are used). Velocities there are the
linear one of the base, then the angular one; at this state the base is not turned.
"""

import numpy as np
import pytest
from outside_models import free_floating_scenario
from outside_urdfs import joint, link, robot

from ffsm_drake import make_true_plant

ANGLES = (np.pi / 4.0, -np.pi / 2.0)
Q = np.array([1.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.0, *ANGLES])
V = np.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.03, np.pi / 20.0, -np.pi / 40.0])  # theirs
FORCE = np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
INERTIA_DIAGONAL = [17.5, 17.5, 17.5, 11.228125, 18.330601, 19.658726, 4.50625, 0.25625]
BIAS = [-0.107664, -0.100129, 0.016314, 0.173452, 0.128842, -0.235523, -0.011314, -0.022172]
ACCELERATION = [0.002494, 0.002021, 0.032959, -0.023776, 0.002528, 0.019812, -0.030214, 0.072057]
EXACT = [0.005309, 0.005164, 0.034519, -0.006442, 0.015652, 0.002777, -0.006366, 0.069658]
OURS = np.array([3, 4, 5, 0, 1, 2, 6, 7])  # their order from ours, and back


def urdf():
    return robot(
        link("base", mass=10.0, inertia=(9.3, 9.3, 9.3)),
        joint("joint_1", "base", "link_1", xyz="0.5 0 0"),
        link("link_1", mass=5.0, inertia=(0.5, 0.5, 0.5), com=(0.5, 0.0, 0.0)),
        joint("joint_2", "link_1", "link_2", xyz="1 0 0"),
        link("link_2", mass=2.5, inertia=(0.1, 0.1, 0.1), com=(0.25, 0.0, 0.0)),
    )


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    scenario = free_floating_scenario(
        tmp_path_factory.mktemp("manipulator"), urdf(),
        last=("link_2", 2.5, (0.25, 0, 0), [0.1] * 3),
        joints={f"joint_{k}": float(angle) for k, angle in enumerate(ANGLES, start=1)},
    )  # fmt: skip
    return make_true_plant(scenario)


def test_the_inertia_is_theirs_and_the_acceleration_is_not(model):
    """Equal inertia and joint rows; the bias of the base lacks the transport of its momentum."""
    inertia = model.calc_mass_matrix(Q)[np.ix_(OURS, OURS)]
    assert np.diag(inertia) == pytest.approx(INERTIA_DIAGONAL, abs=2e-6)
    assert inertia @ ACCELERATION + BIAS == pytest.approx(FORCE, abs=2e-5)  # theirs is consistent
    bias = model.calc_bias(Q, V[OURS])[OURS]
    momentum = inertia[:6] @ V
    linear, angular, velocity, rate = momentum[:3], momentum[3:], V[:3], V[3:6]
    transport = np.r_[
        np.cross(rate, linear), np.cross(rate, angular) + np.cross(velocity, linear), 0.0, 0.0
    ]
    assert bias - BIAS == pytest.approx(transport, abs=2e-6)
    assert np.linalg.norm(transport) > 0.2


def test_pinocchio_has_our_acceleration(model, tmp_path):
    pin = pytest.importorskip("pinocchio")
    (tmp_path / "two.urdf").write_text(urdf().replace('type="revolute"', 'type="continuous"'))
    other = pin.buildModelFromUrdf(str(tmp_path / "two.urdf"), pin.JointModelFreeFlyer())
    other.gravity.setZero()
    turned = np.array([[np.cos(angle), np.sin(angle)] for angle in ANGLES]).ravel()
    at = np.r_[Q[4:7], 0.0, 0.0, 0.0, 1.0, turned]
    expected = pin.aba(other, other.createData(), at, V, FORCE)
    # body to world axes: v' gains rate x velocity, which are parallel here
    ours = model.calc_acceleration(Q, V[OURS], FORCE[OURS])[OURS]
    assert ours == pytest.approx(expected, abs=1e-12)
    assert ours == pytest.approx(EXACT, abs=1e-6)
