"""Shipped scenarios, and drawn sensors, flexible parts, captures and bases, compiled."""

import os

import numpy as np
import pytest
from compared_runs import check, of_seeds
from law_lists import joint_laws, traced_laws

from ffsm_drake import simulate_many
from ffsm_drake.mission import make_mission
from ffsm_drake.runs.metrics import phases_of

DRAWS = int(os.environ.get("FFSM_DRAWS", "1"))
SHIPPED = {
    "flight_sensors": [],
    "slow_navigation": ["duration=1.3", "reference.duration=1.3"],  # past a late measurement
    "flexible_panels": [],
    "planar_detumble": [],
    "envisat": [],
    "seven_joint": [],
    "paper": [],
    "ets_vii": [],
    "reaction_null": [],
    "free_floating": ["controller=tdc"],
    "thrusters_only": [],
    "thrusters_and_wheels": [],
}
FAST = "environment={altitude: null, mean_motion: 0.01}"
LAWS = joint_laws("slotine_li")
IN_CHAIN = traced_laws("torque_against_momentum")


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_scenarios_have_the_runs_of_drake(name):
    check(of_seeds(name, ["duration=0.2", *SHIPPED[name]], 2 * [[]]))


def some(random, most, groups):
    """Whole numbers up to a largest one, for some groups of coordinates."""
    chosen = [group for group in groups if random.random() < 0.5]
    values = ", ".join(f"{group}: {random.integers(1, most + 1)}" for group in chosen)
    return f"{{{values}}}"


def late_sensors(random):
    """Periods and delays of each group, and of the force; noise by run."""
    kind = random.choice(["kalman", "one_sample", "coupled"])
    groups = ("base_rotation", "base_position", "joints")
    sensors = [
        f"sensing.{what}_{how}={some(random, 6, groups)}"
        for what in ("position", "velocity")
        for how in ("period", "delay")
    ]
    more = [
        f"actuation.delay={random.integers(3)}",
        f"sensing.delay={random.integers(3)}",
        f"estimator.kind={kind}",
        "estimator.force_walk=0.07",
        "estimator.velocity_bias_walk={base_rotation: 1.0e-6}" if random.random() < 0.5 else "",
    ]
    each = [[f"sensing.velocity_noise.joints={1e-4 * k}"] for k in (1, 2, 3)]
    return "flight_sensors", [*sensors, *filter(None, more)], each


def flexible_parts(random):
    """Up to three parts of any kind on the base; springs and dampers by run, where they may."""
    kinds = {
        "panel": "plates: {n}, frequency: {f}",
        "pendulum": "frequency: {f}, length: 0.3",
        "mass": "frequency: {f}",
        "beam": "frequencies: [{f}, 2.5]",
    }
    parts, each = list[str](), [list[str]() for _ in range(3)]
    for i in range(random.integers(1, 4)):
        kind = str(random.choice(list(kinds)))
        own = kinds[kind].format(n=random.integers(1, 3), f=round(random.uniform(0.2, 1.0), 3))
        place = np.round(random.uniform(-1.0, 1.0, size=3), 3).tolist()
        mass, damping = np.round(random.uniform((1.0, 0.0), (6.0, 0.1)), 3)
        parts.append(
            f"part_{i}: {{kind: {kind}, position: {place}, mass: {mass}, "
            f"damping_ratio: {damping}, {own}}}"
        )
        if kind in ("panel", "pendulum"):
            for k, changes in enumerate(each):
                changes += [f"model.flexible.part_{i}.frequency={0.3 + 0.1 * k}"]
    return "postcapture", [f"model.flexible={{{', '.join(parts)}}}"], each


def captures(random):
    """A grasp at the start; the target's rate and mass by run."""
    velocity, *rates = np.round(random.uniform(-0.1, 0.1, size=(4, 3)), 4).tolist()
    each = [
        [f"capture.rate={rate}", f"payload.truth.mass={90 + 10 * k}"]
        for k, rate in enumerate(rates)
    ]
    return (
        "postcapture",
        [
            "reference.base_rotation=eigenaxis",
            f"reference.goal={random.choice(['stop', 'target_posture'])}",
            f"capture.velocity={velocity}",
            f"capture.servicer={random.choice(['rest', 'track_joints', 'track_all', 'detumble'])}",
            f"capture.joints={random.choice(['free', 'braked'])}",
            *(["capture.compliance={}"] if random.random() < 0.5 else []),
        ],
        each,
    )


def undriven_bases(random):
    """Bases that only momentum moves; the payload's mass by run."""
    driven = str(random.choice(["[joints]", "[base_rotation, joints]"]))
    name = str(random.choice(["ets_vii", "free_floating", "reaction_null", "seven_joint"]))
    each = [[f"payload.truth.mass={mass}"] for mass in (70.0, 90.0, 110.0)]
    if name == "reaction_null":  # it holds the attitude by the joints
        return name, [], each
    posture = "{base_position: [0, 0, 0], base_rpy: [0, 0, 0]}"
    same = [f"initial_posture={posture}"] if name == "seven_joint" else []
    return name, [f"actuation.driven={driven}", *same], each


def wheels(random):
    """Wheels that saturate or hold momentum against each other; a stopped one in some runs."""
    units = "actuation.wheels.units"
    same = [
        "actuation.thrusters=null",
        f"actuation.delay={random.integers(2)}",
        *(f"{units}.wheel_{k}.initial_momentum={random.uniform(-2, 2):.3f}" for k in range(1, 5)),
        *(f"{units}.wheel_{k}.coulomb_friction={random.uniform(0, 0.02):.4f}" for k in range(1, 5)),
        f"{units}.wheel_2.torque_limit={random.uniform(0.01, 0.3):.3f}",
    ]
    kind = "faults.events={stop: {unit: wheels, kind: stops, time: %s, duration: 0.08}}"
    stops = [[kind % time] for time in (0.04, 0.11)] if random.random() < 0.5 else [[], []]
    return "thrusters_and_wheels", same, [*stops, *stops[:1]]


def drives(random):
    """Limits of rate, and friction; the payload's mass by run."""

    def some_joints(least, most):
        chosen = {f"joint_{k}": random.uniform(least, most) for k in range(1, 6)}
        return ", ".join(f"{name}: {value:.3f}" for name, value in chosen.items())

    drives = [
        f"rate_limit: {{{some_joints(0.001, 0.5)}}}",
        f"viscous_friction: {{{some_joints(0, 0.4)}}}",
        f"coulomb_friction: {{{some_joints(0, 0.1)}}}",
        f"static_friction: {{{some_joints(0.1, 0.2)}}}",
        "smoothing_rate: {joints: 0.2}",
    ]
    some = [each for each in drives if each.startswith("smooth") or random.random() < 0.7]
    if any(each.startswith("static") for each in some):
        some = [*(set(some) | {drives[2]})]
    given = ["actuation.limit={joints: 5}", f"actuation.drives={{{', '.join(some)}}}"]
    return "postcapture", given, [[f"payload.truth.mass={mass}"] for mass in (80.0, 100.0, 120.0)]


def environments(random):
    """Any of the orbit's forces, on flexible parts too, and a force of a user."""
    name = str(random.choice(["postcapture", "flexible_panels", "free_floating", "envisat"]))
    rpy, sun = np.round(random.normal(size=(2, 3)), 3).tolist()
    kinds = {
        kind: str(bool(random.random() < 0.6)).lower() for kind in ("gravity_gradient", "tidal")
    }
    kinds |= {"altitude": "null", "hill_rpy": rpy}
    if random.random() < 0.5:
        kinds["solar_pressure"] = f"{{sun: {sun}, area: 50, center_of_pressure: [0.1, 0.2, 1]}}"
    given = ", ".join(f"{key}: {value}" for key, value in kinds.items())
    own = ["blocks.forces.own.system=own_stage:Pull"] if random.random() < 0.5 else []
    rates = [[f"environment.mean_motion={random.uniform(1e-3, 1e-2):.5f}"] for _ in range(3)]
    return name, [f"environment={{{given}, mean_motion: 0.01}}", *own], rates


def flexible_joints(random):
    """A gear, or a joint without a drive, beside a pendulum; the seed by run."""
    tank = "tank: {kind: pendulum, mass: 4, length: 0.3, frequency: 0.4}"
    if random.random() < 0.5:
        name, joint = "postcapture", f"joint_{random.integers(1, 6)}"
        soft = f"kind: gear, joint: {joint}, stiffness: {random.uniform(1e3, 3e3):.0f}"
        gains = [f"controllers.pd_plus.{gain}={{all: 20}}" for gain in ("k_d", "k_p")]
        given = [f"actuation.drives.rotor_inertia.{joint}={random.uniform(10, 30):.1f}"]
        given += ["controller=pd_plus", "sample_time=0.0025", *gains]
    else:
        name, joint = "ets_vii", f"joint_{random.integers(1, 7)}"
        soft = f"kind: joint, joint: {joint}, frequency: {random.uniform(0.5, 3):.2f}"
        given = [f"{posture}_posture={{joints: {{all: 0}}}}" for posture in ("initial", "target")]
        given.append("controller=tdc")
    given.append(f"model.flexible={{soft: {{{soft}}}, {tank}}}")
    return name, given, [[f"random_seed={k}"] for k in range(3)]


def broken_parts(random):
    """Sensors, joints, wheels and thrusters with any fault, at a time that the seed draws: to the
    end, for a while, or again and again.
    """
    bases = {
        "flight_sensors": [], "slow_navigation": [], "flexible_panels": [FAST],
        "thrusters_and_wheels": [],
    }  # fmt: skip
    name = str(random.choice(list(bases)))
    units = ["sensing", "joints", *(["wheels", "thrusters"] if "wheels" in name else [])]
    chosen = [str(unit) for unit in random.choice(units, size=random.integers(1, 4))]
    spans = ["", ", duration: 0.05", ", duration: 0.025, period: 0.06"]
    events = [
        f"faults.events.event_{k}={{unit: {unit}, time: [0.0, 0.3]{random.choice(spans)}}}"
        for k, unit in enumerate(chosen)
    ]
    return name, [*bases[name], *events, "duration=0.4"], [[f"random_seed={k}"] for k in range(3)]


def approaches(random):
    """A grasp after a short approach, perhaps after station keeping, in an orbit, with faults, or
    missed; the target's rate and mass by run.
    """
    name = str(random.choice(["tumbling_capture", "capture_on_thrusters"]))
    joints = "{joint_1: 0.16, joint_2: 0.37, joint_3: 1.04, joint_4: 0.58, joint_5: -0.69}"
    given = ["capture.approach.duration=0.6", f"capture.approach.posture.joints={joints}"]
    some = [
        "phases=[{hold: {duration: 0.3, distance: 0}}, approach, stop]",
        FAST,
        f"faults.events={{event: {{unit: {random.choice(['sensing', 'joints'])}, time: [0, 1]}}}}",
        f"sensing.delay={random.integers(1, 3)}",
        "capture.envelope.position=1e-9",
    ]
    given += [each for each in some if random.random() < 0.3]
    if any(each.startswith("sensing.delay") for each in given):
        given.append("estimator.kind=kalman")
    rates = np.round(random.uniform(-0.05, 0.05, size=(3, 3)), 4).tolist()
    each = [
        [f"capture.rate={rate}", f"payload.truth.mass={90 + 10 * k}"]
        for k, rate in enumerate(rates)
    ]
    return name, [*given, "duration=1.3"], each


def grippers(random):
    """A gripper that closes, with limp joints or not, on a target that it holds, misses, or lets
    slip; then a retreat, perhaps with a supervisor; the target's rate and mass by run.
    """
    joints = "{joint_1: 0.16, joint_2: 0.37, joint_3: 1.04, joint_4: 0.58, joint_5: -0.69}"
    friction, limp = random.uniform(0.05, 0.5), random.choice(["limp", "controlled"])
    given = [
        f"capture.closing={{time: 0.2, hold: 0.2, friction: {friction:.2f}, joints: {limp}}}",
        f"capture.closing.preload={10.0 ** random.uniform(-1, 3):.3f}",
        "capture.approach.duration=0.6",
        f"capture.approach.posture.joints={joints}",
    ]
    some = ["supervisor={}", "capture.envelope.position=0.005", FAST]
    given += [each for each in some if random.random() < 0.3]
    if random.random() < 0.7:
        given.append("capture.retreat={tries: 1, duration: 0.4, distance: 0.02}")
    rates = np.round(random.uniform(-0.03, 0.03, size=(3, 3)), 4).tolist()
    each = [
        [f"capture.rate={rate}", f"payload.truth.mass={90 + 10 * k}"]
        for k, rate in enumerate(rates)
    ]
    return "tumbling_capture", [*given, "duration=1.6"], each


def measured_targets(random):
    """As ``grippers``; the target's motion is estimated from images that are late, rare or lost."""
    name, given, each = grippers(random)
    sensor = f"dropouts: {random.uniform(0.0, 0.4):.2f}, latency: {random.integers(4)}"
    sensor += f", period: {random.integers(1, 8)}"
    given.append(f"capture.measured={{replan: 0.1, last: 0.1, sensor: {{{sensor}}}}}")
    return name, given, each


def supervisors(random):
    """Supervisors that act again and again, once or not, with plans of their own."""
    name = str(random.choice(["flight_sensors", "envisat", "slow_navigation"]))
    bounds = {kind: 10.0 ** random.uniform(-4, 0) for kind in ("error", "rate")}
    given = ", ".join(f"{kind}: {{joints: {bound:.2e}}}" for kind, bound in bounds.items())
    given += f", end_share: {random.uniform(0.05, 0.9):.2f}, saturated_time: 0.05, end_time: 0.05"
    each = [[f"actuation.limit={{joints: {limit}}}"] for limit in (1.0, 10.0, 100.0)]
    law = random.choice(["tdc", "tde_aismc", "tvlqr", "pd_plus"])
    return name, [f"supervisor={{{given}}}", "duration=0.8", f"controller={law}"], each


@pytest.mark.long
@pytest.mark.parametrize("name", ["free_floating", "seven_joint"])
@pytest.mark.parametrize(
    "law", ["task_time_delay", "task_computed_torque", "resolved_rate", "slotine_li"]
)
def test_laws_that_use_frames_have_the_runs_of_drake(name, law):
    each = [[f"payload.truth.mass={mass}"] for mass in (80.0, 100.0)]
    check(of_seeds(name, ["duration=0.2", f"controller={law}"], each))


@pytest.mark.parametrize(
    "draw",
    [
        *(
            pytest.param(draw, marks=pytest.mark.slow)
            for draw in (
                late_sensors, flexible_parts, captures, undriven_bases, wheels, drives,
                environments, flexible_joints,
            )
        ),
        *(
            pytest.param(draw, marks=pytest.mark.long)
            for draw in (broken_parts, approaches, grippers, measured_targets)
        ),
    ],
)  # fmt: skip
@pytest.mark.parametrize("seed", range(DRAWS))
def test_drawn_scenarios_have_the_runs_of_drake(draw, seed):
    random = np.random.default_rng(seed)
    name, given, each = draw(random)
    law = random.choice(LAWS)
    found = check(of_seeds(name, ["duration=0.2", f"controller={law}", *given], each))
    engines = {record.engine for record in found if record.outcome.status != "diverged"}
    assert draw is late_sensors or engines <= {"compiled"}


@pytest.mark.long
def test_a_second_try_has_the_run_of_drake():
    """The target slips out of the gripper twice; the servicer waits far from it in between."""
    given = ["duration=118", "capture.closing.preload=0.1", "capture.retreat={}", "supervisor={}"]
    (record,) = check(of_seeds("tumbling_capture", given, [[]]))
    assert {"closing", "retreat", "closing_2", "retreat_2"} <= phases_of(
        make_mission(record.dataset)
    ).keys()


_PANEL = {"position": [0, 1, 0], "direction": [0, 1, 0], "mass": 8.0, "frequency": 0.25}
# What bends: nothing, a panel, a contact; it needs the plain law.
SOFT = (
    [],
    [{"model": {"flexible": {"port": _PANEL}}}],
    ["contacts.right.kind=compliant", "simulator_config.max_step_size=0.001", "chain.law=plain"],
)


def closed_chains(random):
    """Two hands on one target, with errors of their calibration; the mass of the target by run."""
    name = str(random.choice(["two_arms", "two_arms_capture", "tohoku_arms"]))
    given = [f"contacts.right.stabilization={random.uniform(5, 40):.1f}"]
    if name != "tohoku_arms" and random.random() < 0.5:
        for kind in ("position", "rotation"):
            error = np.round(1e-3 * random.normal(size=3), 6).tolist()
            given.append(f"contacts.right.{kind}_error={error}")
    pressed = "chain.force={share: 0.5, gain: 20, preload: [0, 0, 0.5, 1, 0, 2]}"
    given += [str(random.choice(["chain.law=plain", "chain.force=null", pressed]))]
    given.append(f"controller={random.choice(IN_CHAIN)}")
    given.append(f"estimator.kind={random.choice(['one_sample', 'kalman', 'coupled'])}")
    if name != "tohoku_arms":
        given += SOFT[random.integers(len(SOFT))]
    return name, given, [[f"payload.truth.mass={mass}"] for mass in (80.0, 100.0, 120.0)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(DRAWS))
def test_drawn_closed_chains_have_the_runs_of_drake(seed):
    name, given, each = closed_chains(np.random.default_rng(seed))
    check(of_seeds(name, ["duration=0.2", *given], each))


@pytest.mark.long
@pytest.mark.parametrize("name", ["two_arms", "two_arms_capture"])
@pytest.mark.parametrize("law", IN_CHAIN)
def test_each_law_in_a_closed_chain_has_the_runs_of_drake(law, name):
    each = [
        [f"payload.truth.mass={mass}", f"initial_posture.joints.left_1={1.604 + angle}"]
        for mass, angle in ((80.0, -0.02), (100.0, 0.0), (120.0, 0.02))
    ]
    check(of_seeds(name, ["duration=1", f"controller={law}"], each))


def detected(random):
    """Faults that are looked for, perhaps in an approach; Drake computes a run in which a thruster
    or wheel is isolated, and other faults make a supervisor act.
    """
    draw = broken_parts if random.random() < 0.5 else approaches
    name, given, each = draw(random)
    supervisor = ["supervisor={}"] if random.random() < 0.5 else []
    if supervisor and name == "flexible_panels":  # it needs limits
        supervisor.append("actuation.limit={joints: 50}")
    return name, [*given, "faults.detection={}", *supervisor, "controller=tdc"], each


@pytest.mark.parametrize(
    "draw",
    [
        pytest.param(supervisors, marks=pytest.mark.slow),
        pytest.param(detected, marks=pytest.mark.long),
    ],
)
@pytest.mark.parametrize("seed", range(DRAWS))
def test_runs_in_which_a_part_acts_have_the_runs_of_drake(draw, seed):
    name, given, each = draw(np.random.default_rng(seed))
    runs = of_seeds(name, given, each)
    found, expected = simulate_many(runs, engine="compiled"), simulate_many(runs)
    for record, other in zip(found, expected, strict=True):
        data, codes, acts = other.dataset, other.dataset.get("fault_detected"), False
        if codes is not None:
            names = [str(name) for name in codes["fault_unit"].values]
            units = [name.startswith(("thrusters", "wheels")) for name in names]
            acts = bool(codes.values[:, units].any())
        diverges = other.outcome.status == "diverged"
        assert record.engine.startswith("drake" if acts or diverges else "compiled")
        assert record.outcome == other.outcome
        for signal in (
            "position", "velocity", "applied_force", "desired_position", "desired_acceleration",
            "sliding_variable", "mode", "mode_cause", "fault_detected",
        ):  # fmt: skip
            if signal in data:
                difference = np.abs(record.dataset[signal].values - data[signal].values).max()
                assert difference <= (0.0 if acts else 1e-9), signal
