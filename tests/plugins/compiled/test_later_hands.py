"""Two hands on one target, compiled: after an approach, and one after the other."""

import os

import numpy as np
import pytest
from compared_runs import check

from ffsm_drake import load_scenario, simulate, simulate_many

DRAWS = int(os.environ.get("FFSM_DRAWS", "1"))
LANES = 3
# where the right arm is before it grasps
AWAY = {"right_1": 1.5, "right_2": 1.6, "right_3": -1.45, "right_4": 0.05, "right_5": -1.65}
APPROACH = """{duration: 0.6, start: given, posture: {base_position: [0.01, -0.01, -0.01],
  joints: {left_1: 1.58, left_2: 1.64, left_3: -1.82, left_4: 0.02, left_5: 1.73, left_6: 1.58,
           right_1: 1.52, right_2: 1.65, right_3: -1.5, right_4: 0.02, right_5: -1.69,
           right_6: -1.52}}}"""
FLIGHT = [
    "estimator={kind: kalman, walk: "
    "{base_position: 4.35e-4, base_rotation: 8.71e-5, joints: 1.96e-3}}",
    "sensing.position_noise={base_position: 1.0e-3, base_rotation: 5.0e-5, joints: 1.0e-5}",
    "sensing.velocity_noise={base_position: 1.0e-3, base_rotation: 1.5e-5, joints: 1.0e-4}",
    "controllers.tdc.k_d={base_position: 5.29, base_rotation: 35.9, joints: 36.7}",
    "controllers.tdc.k_p={base_position: 7.0, base_rotation: 322.0, joints: 337.0}",
    "controller=tdc",
]  # fmt: skip
WHEELS = ", ".join(
    f"w{k}: {{axis: {axis}, inertia: 0.08, torque_limit: 1.0, speed_limit: 628.0}}"
    for k, axis in enumerate(([1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]))
)
ACTUATORS = [
    "actuation.limit={joints: 50}",
    "actuation.thrusters.layout=12x5N",
    f"actuation.wheels.units={{{WHEELS}}}",
]


def drawn(kind, seed, lanes=LANES, also=()):
    """Targets with drawn motion and mass, laws and errors. The second hand of each run closes at a
    time of its own.
    """
    random = np.random.default_rng(seed)
    is_late = kind not in ("both", "supervised", "jaws")
    approaches = kind in ("both", "approach", "flight", "jaws", "late jaws")
    given = [
        "reference.duration=2",
        f"controller={random.choice(['tdc', 'asmc', 'tde_aismc', 'computed_torque'])}",
        f"chain.law={random.choice(['minimal', 'plain'])}",
    ]
    if approaches:
        servicer = random.choice(["rest", "track_joints", "track_all", "detumble"])
        given += [f"capture.servicer={servicer}", f"capture.approach={APPROACH}"]
    elif is_late:
        given.append({"initial_posture": {"joints": AWAY}})
    if kind in ("flight", "faulty"):
        given += [*FLIGHT, *ACTUATORS]
    if kind == "faulty":
        given.append("faults.events={one: {time: [0.1, 0.6], duration: 0.1}}")
    if kind in ("supervised", "supervised late"):  # with a plan beyond the limits of the base
        base, preload = random.uniform(0.05, 1.0), random.choice([0.0, 2.0])
        given += [
            f"actuation.limit={{joints: 40, base_position: {4 * base}, base_rotation: {base}}}",
            "supervisor={saturated_time: 0.05, end_share: 0.9, end_time: 0.1, plan_share: 1}",
            f"chain.force.preload=[0, 0, 0, 0, 0, {preload}]",
        ]
    if kind == "tries":  # the first one misses
        given += ["actuation.limit={joints: 40}", "supervisor={plan_share: 1, saturated_time: 9}"]
        given.append("capture.envelope.angle=0.01")
        lasts = round(random.uniform(1.0, 2.0), 2)
        jam = f"unit: joints.right_2, kind: jammed, time: 0.05, duration: {lasts}"
        given.append(f"faults.events={{one: {{{jam}}}}}")
    if "jaws" in kind:
        joints = random.choice(["limp", "controlled"])
        given.append(f"capture.closing={{time: 0.1, hold: 0.1, rest: 1, joints: {joints}}}")
    if kind == "missed":
        given.append("sensing.position_bias={right_1: 0.1}")
        width = "{position: 0.5, angle: 0.2, velocity: null}"
        given += [f"capture.envelope={width}"] if random.random() < 0.5 else []
    if approaches:
        braked = np.random.default_rng([seed, 1]).choice(["free", "braked"])
        given.append(f"capture.joints={braked}")
    found = []
    for k in range(lanes):
        closes = round(random.uniform(0.2, 0.7), 2) * is_late
        mass, rate = random.uniform(80.0, 125.0), random.uniform(-0.04, 0.04, 3).tolist()
        each = [f"random_seed={k}", f"payload.truth.mass={mass}", f"capture.rate={rate}"]
        ends_late = kind in ("tries", "supervised late")  # closes with a new plan
        each.append(f"duration={8.0 if ends_late else 1.6 if approaches else 1.0}")
        scenario = load_scenario("two_arms_capture", [*given, *each, *also])
        found.append(scenario.replace(contacts={"right": {"closes": closes}}))
    return found


@pytest.mark.slow
def test_a_second_hand_has_the_run_of_drake():
    (found,) = check(drawn("late", 0, 1, ["controller=tdc", "chain.law=minimal"]), called=None)
    k = round(found.scenario.contacts["right"].closes / found.scenario.sample_time)
    assert not found.dataset["contact_closing"].values[:k].any()
    assert found.dataset["contact_closing"].values[k, 0] > 0.0


@pytest.mark.long
@pytest.mark.parametrize(
    "kind",
    [
        "late",
        "both",
        "approach",
        "missed",
        "flight",
        "faulty",
        "supervised",
        "supervised late",
        "tries",
        "jaws",
        "late jaws",
    ],
)
@pytest.mark.parametrize("seed", range(DRAWS))
def test_drawn_hands_have_the_runs_of_drake(kind, seed):
    found = check(drawn(kind, seed), called=None)
    statuses = {record.outcome.status for record in found}
    assert statuses <= {"completed", "missed"}
    if kind == "missed":
        assert statuses == {
            "missed" if found[0].scenario.capture.envelope.velocity else "completed"
        }
    if kind == "tries":
        assert statuses == {"completed"}
        assert all(record.dataset["mode_cause"].values.max() == 5 for record in found)
    for record in found:
        assert record.engine.startswith("compiled")
        if record.outcome.status == "completed" and kind != "faulty":
            assert record.metrics["contacts"]["gap"] < 1e-9


@pytest.mark.long
@pytest.mark.parametrize("seed", range(DRAWS))
def test_bits_do_not_depend_on_the_batch(seed):
    """With hands of other runs that close at other samples, or miss."""
    runs = [*drawn("late", seed, 3), *drawn("missed", seed, 2), *drawn("late", seed + 100, 2)]
    together = simulate_many(runs, engine="compiled")
    random = np.random.default_rng(seed)
    order = random.permutation(len(runs))
    mixed = simulate_many([runs[index] for index in order], engine="compiled")
    assert len({run.contacts["right"].closes for run in runs}) > 1
    for index, record in enumerate(together):
        assert record.engine.startswith("compiled")
        others = [mixed[order.tolist().index(index)]]
        if index % 2 == seed % 2:
            others.append(simulate(runs[index], engine="compiled", check_stability=False))
        for other in others:
            assert other.dataset.identical(record.dataset)
            assert other.metrics == record.metrics
