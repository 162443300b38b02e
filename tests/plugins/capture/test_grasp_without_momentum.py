"""``capture.servicer: detumble``: a grasp without impact after which the stack has no spin.

Virgili-Llop and Romano, "Simultaneous capture and detumble of a resident space object by a
free-flying spacecraft-manipulator system", Frontiers in Robotics and AI 6 (2019) 14,
doi:10.3389/frobt.2019.00014. Their tables could not be read: the bounds here follow from momentum.
"""

import numpy as np
import pytest

from ffsm_drake import load_scenario, make_nominal_plant, simulate
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.capture.approach import planned_approach
from ffsm_drake.plugins.capture.contact import planned_contact

IDEAL = (
    "payload.nominal={mass: 100, inertia: [16.7, 16.7, 16.7]}",
    "disturbance.amplitude_scale=0",
    "sensing.position_noise=0",
    "sensing.velocity_noise=0",
)


def scenario(servicer, *overrides, name="tumbling_capture"):
    return load_scenario(name, [*IDEAL, f"capture.servicer={servicer}", *overrides])


def contact(given):
    return planned_contact(make_mission(given), make_nominal_plant(given))


def spin_of_target():
    return np.linalg.norm(contact(scenario("rest")).spin_before)


@pytest.mark.smoke
def test_the_stack_has_no_spin_and_no_impact():
    met = contact(scenario("detumble"))
    assert np.linalg.norm(met.spin_after) < 1e-10 * spin_of_target()
    assert np.abs(met.impulse).max() < 1e-10
    followed = contact(scenario("track_all"))
    assert np.linalg.norm(followed.spin_after) > 0.9 * spin_of_target()


def test_an_arm_of_seven_joints_leaves_no_linear_momentum():
    """Twelve conditions; with five joints eleven coordinates cannot meet them all."""
    motion = ("capture.rate=[0.05, 0.04, 0.06]", "reference.base_rotation=eigenaxis")
    many = contact(scenario("detumble", *motion, name="seven_joint"))
    assert np.linalg.norm(many.spin_after) < 1e-9
    assert np.linalg.norm(many.momentum_after[3:]) < 1e-9
    five = contact(scenario("detumble"))
    assert 1.0 < np.linalg.norm(five.momentum_after[3:]) < 40.0


def test_the_approach_ends_with_the_velocity_of_the_grasp():
    """Its loop knows nothing of the target, whose momentum it nevertheless cancels."""
    given = scenario("detumble")
    motion = planned_approach(make_mission(given))
    np.testing.assert_allclose(
        motion.evaluate(motion.end)[1], contact(given).velocity, rtol=0.0, atol=1e-15
    )


@pytest.mark.parametrize(
    ("servicer", "least", "most"),
    [
        pytest.param("detumble", 0, 1e-9, marks=pytest.mark.slow),
        pytest.param("track_all", 1e-3, 1, marks=pytest.mark.long),
    ],
)
def test_the_joints_alone_bring_the_stack_to_rest(servicer, least, most):
    """No force and no torque on the base after the grasp: its rate (rad/s) at the end."""
    alone = ("capture.approach=null", "actuation.driven=[joints]", "duration=12")
    stop = ("reference.goal=stop", "reference.duration=5", "controller=computed_torque")
    data = simulate(scenario(servicer, *alone, *stop), check_stability=False).dataset
    assert not data["applied_force"].values[:, :6].any()
    assert np.abs(data["velocity"].values[-1, 6:]).max() < 1e-9
    assert least <= np.linalg.norm(data["velocity"].values[-1, :3]) < most


@pytest.mark.long
def test_base_torque_after_the_grasp_takes_no_momentum_out():
    """With the approach flown, the base driven, and the target's mass unknown by none."""
    given = scenario(
        "detumble", "duration=30", "reference.goal=stop", "reference.duration=5",
        "controller=tde_aismc",
    )  # fmt: skip
    record = simulate(given, check_stability=False)
    assert record.ending.status == "settled"
    assert record.grasp is not None
    before = record.grasp["before"]["spin"]
    assert np.linalg.norm(before) < 1e-3 * spin_of_target()
    data = record.dataset.isel(time=record.dataset["phase"].values == "stop")
    arm = np.cross(_center(given, data["position"].values), data["applied_force"].values[:, 3:6])
    torque = data["applied_force"].values[:, :3] - arm
    assert np.linalg.norm(0.01 * torque.sum(axis=0)) < 0.01 * spin_of_target()


def _center(given, positions):
    from ffsm_drake import free_floating

    return free_floating(make_nominal_plant(given), positions).center_of_mass
