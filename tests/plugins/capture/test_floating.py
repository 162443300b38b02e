"""Approaches of a servicer whose base is not driven: the start follows from momentum, backwards in
time from the grasp.
"""

from pathlib import Path

import numpy as np
import pytest
from c_code import needs_llvm
from entry_points import needs

from ffsm_drake import ScenarioError, load_scenario, simulate
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.capture.approach import approach_posture, planned_approach
from ffsm_drake.plugins.capture.contact import planned_contact
from ffsm_drake.runs.metrics import momentum_residual
from ffsm_drake.scenario import EMPTY
from ffsm_drake.spacecraft.free_floating import free_floating

DRIVEN = [["joints"], ["base_rotation", "joints"]]
PLACE = {"base_position": [0.1, 0.3, -0.2], "base_rpy": [0.11, 0.08, -0.1]}
APPROACH, STOP = 6.0, 14.0  # s
# no momentum comes from outside, and the integrator is accurate
UNDISTURBED = {"disturbance.amplitude_scale": 0.0, "simulator_config.max_step_size": 0.001}


def drawn(seed, *more):
    """A capture with a drawn tumble, start, motion of the servicer and law."""
    random = np.random.default_rng(seed)
    start = {"joint_1": -0.72, "joint_2": 1.2, "joint_3": 0.72, "joint_4": -0.82, "joint_5": 0.0}
    joints = {name: float(angle + random.uniform(-0.3, 0.3)) for name, angle in start.items()}
    servicer = str(random.choice(["rest", "track_joints", "track_all", "detumble"]))
    return load_scenario(
        "tumbling_capture",
        [
            {
                "actuation": {"driven": DRIVEN[seed % 2], "thrusters": None, "wheels": None},
                "target_posture": PLACE,
                "duration": APPROACH + STOP,
                "reference.duration": STOP - 2.0,
                "capture": {
                    "rate": random.uniform(-0.05, 0.05, 3).tolist(),
                    "velocity": random.uniform(-0.01, 0.01, 3).tolist(),
                    "servicer": servicer,
                    "approach": {"duration": APPROACH, "posture": {**PLACE, "joints": joints}},
                },
                "controller": str(random.choice(["tdc", "aismc", "tde_aismc"])),
            },
            *more,
        ],
    )


def relative(momentum, size):
    return float(np.abs(momentum).max() / np.abs(size).max())


@pytest.mark.parametrize("seed", range(8))
def test_the_planned_start_leads_to_the_grasp_without_a_force_on_the_base(seed):
    mission = make_mission(drawn(seed))
    scenario, model = mission.scenario, mission.craft.nominal(EMPTY)
    motion, contact = planned_approach(mission), planned_contact(mission, mission.craft.nominal())
    times = np.linspace(0.0, APPROACH, 25)
    q, v, a = motion.evaluate(times)
    assert np.allclose(q[-1], contact.q, atol=1e-9)
    assert np.allclose(v[-1], contact.velocity, atol=1e-9)
    stack = free_floating(model, q)
    momentum, whole = stack.momentum(v), stack.momentum_map * v[:, None]
    linear = momentum[:, 3:] - momentum[-1, 3:]
    assert np.abs(linear).max() < 1e-9 * np.abs(whole[:, 3:]).max()
    if "base_rotation" in scenario.undriven:
        assert relative(momentum[:, :3] - momentum[-1, :3], whole[:, :3]) < 1e-9
    force = model.calc_tracking_force(q, v, a)
    undriven = ~model.coordinates.is_driven
    assert np.abs(force[:, undriven]).max() < 1e-8 * np.abs(force).max()
    joints = scenario.approach.posture.joints
    assert np.allclose(q[0, 7:], [joints[name] for name in model.coordinates.joints])
    assert np.abs(v[0, 6:]).max() < 1e-9


def check_run(record, beyond):
    """The momentum after the start, of what acts inside, and how the hand meets the target."""
    assert record.ending.is_settled, record.ending.sentence
    found, size = momentum_residual(record.dataset), record.dataset["linear_momentum"].values
    spin = record.dataset["angular_momentum"].values
    assert np.abs(found["linear"]).max() < beyond * max(1.0, np.abs(size).max())
    assert np.abs(found["angular"]).max() < beyond * max(1.0, np.abs(spin).max())
    miss, envelope = record.grasp["miss"], record.scenario.capture.envelope
    assert miss["position"] < 0.01 * envelope.position
    assert miss["angle"] < 0.05 * envelope.angle


@pytest.mark.parametrize("seed", [pytest.param(seed, marks=pytest.mark.slow) for seed in range(3)])
def test_a_run_conserves_momentum_and_meets_the_target(seed):
    record = simulate(drawn(seed, UNDISTURBED), check_stability=False)
    check_run(record, 1e-9)


@pytest.mark.parametrize("driven", DRIVEN)
def test_a_phase_before_the_approach_keeps_its_momentum(driven):
    """The base does not wait: it turns and drifts with the momentum of the approach."""
    waits = {"python_path": [str(Path(__file__).parent)], "duration": APPROACH + STOP + 2.0}
    waits |= {"blocks.phases.wait": {"duration": 2.0, "system": "own_phases:wait"}}
    moving = {"actuation.driven": driven, "capture.servicer": "track_all"}
    mission = make_mission(drawn(0, moving, waits))
    motion, alone = planned_approach(mission), planned_approach(make_mission(drawn(0, moving)))
    times = np.linspace(0.0, APPROACH, 5)
    assert np.allclose(motion.rows(2.0 + times), alone.rows(times), atol=1e-9)
    q, v, _ = motion.evaluate(np.linspace(0.0, 2.0, 5))
    linear = free_floating(mission.craft.nominal(EMPTY), q).momentum(v)[:, 3:]
    assert np.abs(linear[0]).max() > 0.0
    assert relative(linear - linear[-1], linear) < 1e-9
    assert np.ptp(q[:, 4:7], axis=0).max() > 1e-3
    assert np.ptp(q[:, 7:], axis=0).max() < 1e-12


@pytest.mark.parametrize(
    ("more", "key"),
    [
        ({"capture.closing": {}, "capture.retreat": {}}, "capture.retreat"),
        ({"phases": [{"hold": {"duration": 1.0}}, "approach", "stop"]}, "phases.hold"),
        ({"capture.approach.posture.base_position": [0.0, 0.0, 0.1]}, "approach.posture"),
    ],
)
def test_what_needs_a_force_on_the_base_is_refused(more, key):
    with pytest.raises(ScenarioError, match=key) as no:
        planned_approach(make_mission(drawn(0, {"duration": 20.0}, more)))
    assert "actuation.driven" in str(no.value)
    assert "\n" not in str(no.value)


def test_a_clear_start_moves_the_joints_alone():
    far = {"capture.approach.start": "clear", "capture.approach.margin": 5.0}
    with pytest.raises(ScenarioError, match="no start with the joints of posture or of the grasp"):
        approach_posture(make_mission(drawn(0, far)))


@pytest.mark.slow
def test_a_measured_target_is_met_with_the_joints():
    """The target moves otherwise than expected, by several centimetres at the grasp."""
    measured = {"replan": 2.0, "last": 1.0, "filter": {"rate_deviation": 0.01}}
    closing = {"capture": {"servicer": "track_joints", "closing": {}, "measured": measured}}
    record = simulate(drawn(0, UNDISTURBED, closing), check_stability=False)
    assert record.ending.is_settled, record.ending.sentence
    mission = make_mission(record.scenario)
    expected = planned_contact(mission, mission.craft.nominal())
    assert record.grasp["miss"]["position"] < 0.005
    at_grasp = (
        record.dataset["position"].sel(time=record.grasp["time"], method="nearest").values[7:]
    )
    assert np.abs(at_grasp - expected.q[7:]).max() > 0.005


@pytest.mark.slow
@needs("compiled")
@needs_llvm
@pytest.mark.parametrize("seed", [0, 1])
def test_both_engines_agree(seed):
    scenario = drawn(seed, {"disturbance.amplitude_scale": 0.0})
    one, other = (
        simulate(scenario, check_stability=False, engine=engine) for engine in ("drake", "compiled")
    )
    assert other.engine.startswith("compiled")
    for name in ("position", "velocity"):
        assert np.allclose(one.dataset[name], other.dataset[name], rtol=0.0, atol=1e-9)
