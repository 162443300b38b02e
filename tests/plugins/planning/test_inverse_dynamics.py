"""Inverse dynamics of many states at once against Drake's, and its derivatives against
differences.
"""

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw
from pydrake.multibody.tree import MultibodyForces
from scipy.spatial.transform import Rotation

from ffsm_drake import load_scenario
from ffsm_drake.common.so3 import attitude_motion
from ffsm_drake.plugins.planning.inverse_dynamics import InverseDynamics, complex_step
from ffsm_drake.spacecraft.craft import make_true_plant

ROTORS = "actuation.drives={gear_ratio: 50, rotor_inertia: 1e-3}"


@pytest.fixture(
    scope="module",
    params=[("postcapture",), ("postcapture", ROTORS), ("seven_joint",), ("planar_detumble",)],
)
def model(request):
    name, *overrides = request.param
    return make_true_plant(load_scenario(name, overrides))


def states(model, count=20):
    rng = np.random.default_rng(3)
    return (
        rng.normal(size=(3, len(model.coordinates.names), count))
        * np.array([0.8, 0.5, 0.5])[:, None, None]
    )


@pytest.mark.smoke
def test_force_is_drakes_with_the_joints_damping(model):
    first = RollPitchYaw([0.3, -0.5, 1.1]).ToRotationMatrix()
    z, rate, acceleration = states(model)
    z[:3, 0] = 1e-6  # where the series takes over
    tau = InverseDynamics(model, first).calc(z, rate, acceleration)
    _, w, alpha = attitude_motion(z[:3], rate[:3], acceleration[:3])
    plant, context = model.plant, model.context
    for k in range(z.shape[1]):
        rotation = Rotation.from_rotvec(z[:3, k]).as_matrix()
        wxyz = Quaternion(rotation @ first.matrix()).wxyz()
        plant.SetPositions(context, np.r_[wxyz, z[3:, k]])
        plant.SetVelocities(context, np.r_[w[:, k], rate[3:, k]])
        damping = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, damping)
        expected = plant.CalcInverseDynamics(
            context, np.r_[alpha[:, k], acceleration[3:, k]], damping
        )
        assert tau[:, k] == pytest.approx(expected, rel=1e-11, abs=1e-10)


def test_derivatives_are_those_of_differences(model):
    dynamics = InverseDynamics(model, RollPitchYaw([0.3, -0.5, 1.1]).ToRotationMatrix())
    given = states(model, count=4)
    tau, derivative = complex_step(dynamics.calc, given)
    assert tau == pytest.approx(dynamics.calc(*given), rel=1e-14)
    step = 1e-6
    for which in range(3):
        for i in range(given.shape[1]):
            sides = []
            for sign in (1, -1):
                moved = given.copy()
                moved[which, i] += sign * step
                sides.append(dynamics.calc(*moved))
            difference = (sides[0] - sides[1]) / (2 * step)
            assert derivative[which, :, i] == pytest.approx(difference, rel=1e-6, abs=1e-6)
