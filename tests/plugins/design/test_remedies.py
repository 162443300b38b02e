"""What helps: each change that is told is tried, and helps alone."""

import numpy as np
import pytest

from ffsm_drake import load_scenario
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.design.remarks import plan_limits
from ffsm_drake.plugins.design.remedies import remedies
from ffsm_drake.plugins.design.stability.mission import linear_verdict
from ffsm_drake.plugins.design.verdict import verdict
from ffsm_drake.scenario import override_scenario
from ffsm_drake.spacecraft.craft import Craft, make_true_plant
from ffsm_drake.spacecraft.limits import POSITION, tightest
from ffsm_drake.spacecraft.plant import coordinates_of

# base, overrides, a key that is among what helps
UNSTABLE = {
    "payload": ("postcapture", ["payload.nominal.mass=130"], "payload.nominal.mass"),
    "K_s": (
        "postcapture",
        ["controllers.tde_aismc.k_s_initial=190", "controllers.tde_aismc.k_s_max=190"],
        "controllers.tde_aismc.k_s_max",
    ),
    "period": ("postcapture", ["sample_time=0.05", "controller=tdc"], "sample_time"),
    "delay": (
        "flight_sensors",
        ["sensing.delay=8", "estimator.delay=0", "controller=tdc"],
        "estimator.delay",
    ),
    "gains": ("postcapture", ["controller=pd_plus", "controllers.pd_plus.k_d=3000"], "k_d"),
    "approach": (
        "tumbling_capture",
        ["controllers.tde_aismc.k_s_initial=190", "controllers.tde_aismc.k_s_max=190"],
        "controllers.tde_aismc.k_s_max",
    ),
}


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=pytest.mark.slow if kind == "period" else pytest.mark.long)
        for kind in UNSTABLE
    ],
)
def test_each_change_makes_the_loop_stable(kind):
    base, overrides, key = UNSTABLE[kind]
    scenario = load_scenario(base, overrides)
    assert linear_verdict(scenario).is_alarm
    found = remedies(scenario, fails=True)
    assert any(key in place for each in found for place in each.changes)
    for each in found:
        assert not linear_verdict(override_scenario(scenario, [each.changes])).is_alarm, str(each)
    if kind == "payload":
        assert 80.0 < found[0].changes["payload.nominal.mass"] < 112.0
        assert "eta is up to 1.28, and tde_aismc tolerates 1.11" in found[0].reason


@pytest.mark.long
@pytest.mark.parametrize("seed", range(6))
def test_following_what_helps_settles(seed):
    """Missions of the class, drawn: too heavy, too stiff, or with too little force."""
    rng = np.random.default_rng(seed)
    kind = seed % 3
    base, overrides = (
        ("postcapture", [f"payload.nominal.mass={rng.uniform(125, 300):.4g}"]),
        ("postcapture", [f"controllers.tde_aismc.k_s_initial={rng.uniform(120, 400):.4g}"]),
        ("flight_sensors", [f"actuation.limit.base_rotation={rng.uniform(2.2, 2.5):.4g}"]),
    )[kind]
    scenario = load_scenario(base, overrides)
    found = remedies(scenario, fails=True)
    assert found
    for each in found:
        after = verdict(override_scenario(scenario, [each.changes]), advises=False)
        assert not after.is_alarm, f"{each}: {after.lines}"


def test_a_mission_that_goes_as_planned_needs_none():
    assert remedies(load_scenario("postcapture"), fails=False) == ()


@pytest.mark.slow
def test_unknown_faults_are_to_be_known():
    broken = (
        'faults={"events": {"valve": {"unit": "thrusters.a_x", "kind": "stuck_on", "time": [2]}}}'
    )
    scenario = load_scenario("thrusters_only", [broken])
    found = remedies(scenario, fails=True)
    assert all(each.changes == {"faults.detection": {}} for each in found)
    for each in found:
        assert verdict(
            override_scenario(scenario, [each.changes]), advises=False
        ).run.ending.is_settled


@pytest.mark.parametrize("seed", range(4))
def test_an_angle_in_degrees_is_the_cause_and_no_search_begins(seed, monkeypatch):
    draw = np.random.default_rng(seed)
    plain = load_scenario("envisat")
    plant = make_true_plant(plain).plant
    lower, upper = tightest(Craft(plain).limits, POSITION).joints
    joint, key = draw.integers(upper.size), draw.choice(["initial_posture", "target_posture"])
    name = coordinates_of(plant).joints[joint]
    # in degrees; a little outside; far outside, in degrees too
    angle = draw.choice([-1.0, 1.0]) * draw.uniform(0.2, 0.9) * upper[joint]
    for value in (float(np.degrees(angle)), 1.1 * lower[joint], 200.0 * upper[joint]):
        scenario = override_scenario(plain, [f"{key}.joints.{name}={value}"])
        told = [
            line for line in plan_limits(make_mission(scenario)) if line.startswith(f"{key}.joints")
        ]
        assert f"exceeds the URDF's position limits: {name} " in told[0]
        meant = f"{key}.joints.{name}: {value:.4g} rad looks like degrees: {angle:.3g} rad"
        assert told[1:] == ([meant] if value == float(np.degrees(angle)) else [])
        with monkeypatch.context() as patch:
            patch.setattr("ffsm_drake.plugins.design.remedies._found", None)  # a call would fail
            assert remedies(scenario, fails=True) == ()
