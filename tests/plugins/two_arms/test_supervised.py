"""A supervisor with two hands on the target: what it keeps of the internal force, and its plans."""

import os

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ffsm_drake import ScenarioError, free_floating, load_scenario, simulate
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture import modes
from ffsm_drake.plugins.capture.modes import Cause, Mode
from ffsm_drake.plugins.capture.supervisor import SupervisorPart
from ffsm_drake.plugins.two_arms.chain import ClosedChain
from ffsm_drake.plugins.two_arms.chain_model import minimal_model
from ffsm_drake.plugins.two_arms.supervised import SupervisedChain
from ffsm_drake.scenario.contacts import ALL_HANDS
from ffsm_drake.spacecraft.coordinates import position_error
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.sampled import Now
from ffsm_drake.systems.setup import BlockSetup

DRAWS = int(os.environ.get("FFSM_DRAWS", "1"))
LIMITS = "actuation.limit={joints: 40, base_position: 20, base_rotation: 20}"
LATE = {
    "contacts": {"right": {"closes": 3}},
    "initial_posture": {"joints": {"right_1": 1.2, "right_2": 1.2, "right_5": -1.4}},
}
# 1 mrad and 1 mm
CALIBRATION = {
    "contacts": {"right": {"position_error": [6e-4, -6e-4, 5e-4],
                           "rotation_error": [-6e-4, 5e-4, 6e-4]}},
    "sensing": {"position_bias": {"right_1": 1e-3, "right_3": -1e-3}},
}  # fmt: skip


def setup_of(*overrides, name="two_arms"):
    mission = Mission(load_scenario(name, [LIMITS, "supervisor={}", *overrides]))
    nominal = mission.craft.nominal()
    return BlockSetup(name="", mission=mission, nominal=nominal, settings={})


def posture(setup, key="initial_posture"):
    return configuration(setup.coordinates, getattr(setup.scenario, key), key=key)


def limits(random):
    """Limits of the joints of both arms, drawn over a decade."""
    names = [f"{side}_{k}" for side in ("left", "right") for k in range(1, 7)]
    drawn = {name: float(10.0 ** random.uniform(0.3, 1.6)) for name in names}
    return {"actuation": {"limit": {"base_position": 20, "base_rotation": 20} | drawn}}


@pytest.mark.parametrize("seed", range(4))
def test_the_force_of_the_law_is_the_least(seed):
    """Sum of (tau / limit)^2, among the forces with the same effect on the chain."""
    random = np.random.default_rng(seed)
    setup = setup_of(limits(random))
    chain = ClosedChain(setup.nominal, setup.scenario, true=False)
    model = minimal_model(setup.mission, chain)
    q = chain.closed(posture(setup))
    constraints, whole, _ = model.calc_map(q)
    w = random.normal(size=whole.shape[1])
    force = model.calc_force(q, w)
    assert_allclose(whole.T @ force, w, atol=1e-9)
    other = force + random.normal(size=len(constraints)) @ constraints
    assert_allclose(whole.T @ other, w, atol=1e-9)
    assert (force**2 / model.share).sum() < (other**2 / model.share).sum()
    assert_allclose(constraints @ (force / model.share), 0.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_what_the_supervisor_keeps(seed):
    """It finds the internal force in that of the law, and the wrench that a force brings about,
    beyond the force with which the law starts, a part of the preload.
    """
    random = np.random.default_rng(seed)
    preload = random.normal(size=6)
    setup = setup_of(limits(random), {"chain": {"force": {"preload": preload.tolist()}}})
    kept, start = SupervisedChain(setup).kept(), 0.95 * preload
    chain = ClosedChain(setup.nominal, setup.scenario, true=False)
    model = minimal_model(setup.mission, chain)
    q = chain.closed(posture(setup))
    H, A = setup.nominal.calc_mass_matrix(q), chain.jacobian(q)
    internal, before = random.normal(size=(2, 6))
    law = model.calc_force(q, random.normal(size=A.shape[1] - 6)) + internal @ A
    acted = random.normal(size=A.shape[1])
    yes, no = np.array([True]), np.array([False])
    after, force = kept.step(q, H, (acted, law), before, no, yes, no)
    assert_allclose(after, before + internal - start, atol=1e-9)
    assert_allclose(force, after @ A, atol=1e-9)
    after, force = kept.step(q, H, (acted, law), before, yes, no, yes)
    assert_allclose(force, (after + start) @ A, atol=1e-9)
    # at rest: H a = tau + A' lambda, A a = 0; the target feels -lambda
    size = len(A)
    whole = np.block([[H, -A.T], [A, np.zeros((size, size))]])
    _, multipliers = np.split(np.linalg.solve(whole, np.append(acted, np.zeros(size))), [-size])
    assert_allclose(after, before - multipliers - start, atol=1e-9)
    assert_allclose(kept.step(q, H, (acted, law), before, no, no, no)[0], before, atol=0.0)
    # damping adds none
    S = model.calc_map(q)[1]
    damping = -H @ S @ random.normal(size=S.shape[1])
    after, _ = kept.step(q, H, (damping, law), before, yes, no, yes)
    assert_allclose(after, before - start, atol=1e-9)


@pytest.mark.parametrize("seed", range(3 * DRAWS))
@pytest.mark.parametrize("late", ["", "open", "closed"])
def test_a_new_plan_closes_the_chain_at_every_sample(seed, late):
    """From a measured state with noise and calibration errors, to the target posture and rest. A
    hand that is open closes where the plan ends, but not before its time.
    """
    random = np.random.default_rng(seed)
    setup = setup_of(*([LATE] if late else []))
    supervisor = SupervisorPart().supervisor(setup)
    period = setup.sample_time
    whole = ClosedChain(setup.nominal, setup.scenario, ALL_HANDS, true=False)
    q = posture(setup)
    q = q if late == "open" else whole.closed(q)
    q[7:] += random.uniform(-0.02, 0.02, q.size - 7)
    q[4:7] += random.uniform(-0.1, 0.1, 3)
    v = random.uniform(-0.02, 0.02, q.size - 1)
    begin = {"closed": random.uniform(3.0, 6.0)}.get(late, random.uniform(0.0, 6.0))
    duration = random.uniform(1.0, 12.0)
    begin = round(begin / period) * period
    plan = np.concatenate([[begin, duration, 0.0, 3.0 * (late == "closed")], q, v])
    motion = supervisor.motion(plan)
    times = np.arange(0.0, duration + 2.0, period)
    rows = motion.rows(times)
    places, rates, _ = np.split(rows, [q.size, 2 * q.size - 1], axis=1)
    closes = max(3.0 - begin, duration) if late == "open" else 0.0
    for time, place, rate in list(zip(times, places, rates, strict=True))[:: 1 + 4 * bool(late)]:
        if time >= closes + period:
            assert np.abs(whole.gap(place)).max() < 1e-9
            assert np.abs(whole.jacobian(place) @ rate).max() < 1e-7
    free = np.setdiff1d(np.arange(q.size - 1), whole.loops[0].joints)
    assert_allclose(position_error(q, places[0])[free], 0.0, atol=1e-9)
    assert_allclose(rates[0][free], v[free], atol=1e-9)
    if late == "open":  # from where the arm is, without a step
        joints = whole.loops[0].joints
        assert_allclose(places[0][joints + 1], q[joints + 1], atol=1e-12)
        assert_allclose(rates[0][joints], v[joints], atol=1e-12)
    assert not rates[-1].any()
    goal = posture(setup, "target_posture")
    assert_allclose(position_error(goal, places[-1])[free], 0.0, atol=1e-9)
    # rates and accelerations are those of the motion
    step = 1e-4
    ahead, back = motion.rows(times[5:-250:40] + step), motion.rows(times[5:-250:40] - step)
    nq, nv = q.size, v.size
    for now, after, before in zip(rows[5:-250:40], ahead, back, strict=True):
        change = position_error(after[:nq], before[:nq]) / (2.0 * step)
        assert_allclose(change, now[nq : nq + nv], atol=1e-6)
        change = (after[nq : nq + nv] - before[nq : nq + nv]) / (2.0 * step)
        assert_allclose(change, now[nq + nv :], atol=1e-5)


@pytest.mark.parametrize("driven", [["joints"], ["base_rotation", "joints"]])
@pytest.mark.parametrize("late", ["", "open", "closed"])
def test_a_new_plan_moves_a_base_that_is_not_driven_by_its_momentum(driven, late):
    """From the measured velocities on, so that the motion needs no force on the base."""
    random = np.random.default_rng(len(driven) + 2 * len(late))
    given = {"actuation": {"driven": driven, "limit": dict.fromkeys(driven, 40)}, "supervisor": {}}
    still = {"base_position": [0, 0, 0], "base_rpy": [0, 0, 0]}
    given |= {"initial_posture": still, "target_posture": still}
    mission = Mission(load_scenario("two_arms_capture", [given, *([LATE] if late else [])]))
    model = mission.craft.nominal()
    setup = BlockSetup(name="", mission=mission, nominal=model, settings={})
    whole = ClosedChain(model, setup.scenario, ALL_HANDS, true=False)
    q = posture(setup)
    q = q if late == "open" else whole.closed(q)
    v, joints = random.uniform(-0.02, 0.02, q.size - 1), whole.loops[0].joints
    if late != "open":  # the arm that follows has its velocity from the loop
        A = whole.jacobian(q)
        v[joints] = -np.linalg.solve(A[:, joints], np.delete(A, joints, 1) @ np.delete(v, joints))
    plan = np.concatenate([[0.0, 5.0, 0.0, 3.0 * (late == "closed")], q, v])
    motion = SupervisorPart().supervisor(setup).motion(plan)
    places, rates, changes = motion.evaluate(np.linspace(0.0, 7.0, 36))
    rows = slice(3 * ("base_rotation" in driven), 6)
    momentum = free_floating(model, places, driven).momentum(rates)[:, rows]
    before = free_floating(model, q, driven).momentum(v)[rows]
    assert_allclose(momentum - before, 0.0, atol=1e-9)
    undriven = ~model.coordinates.is_driven
    for one in zip(places, rates, changes, strict=True):
        assert_allclose(model.calc_inverse_dynamics(*one)[undriven], 0.0, atol=1e-8)


def test_a_plan_out_of_reach_is_none():
    setup = setup_of()
    supervisor = SupervisorPart().supervisor(setup)
    q = posture(setup)
    q[7:] = 0.0
    plan = np.concatenate([[0.0, 10.0, 0.0, 0.0], q, np.zeros(q.size - 1)])
    with pytest.raises(ScenarioError, match="no motion of the closed chain"):
        supervisor.motion(plan)
    assert supervisor.share(plan, supervisor.block.limit) == np.inf


@pytest.mark.parametrize("seed", range(2 * DRAWS))
@pytest.mark.parametrize("is_weak", [False, True])
def test_after_a_miss_it_plans_at_once_or_damps(seed, is_weak, monkeypatch):
    """In the sample after the miss, from what is measured; it damps if no plan is within limits."""
    random = np.random.default_rng(seed)
    if is_weak:  # one plan is tried
        monkeypatch.setattr(modes, "_LONGEST", 5.0)
    setup = setup_of(LATE, *(["actuation.limit={all: 1.0e-6}"] * is_weak))
    supervisor = SupervisorPart().supervisor(setup)
    q = posture(setup)
    q[7:] += random.uniform(-0.02, 0.02, q.size - 7)
    state = np.concatenate([q, random.uniform(-0.02, 0.02, q.size - 1)])
    inputs = {"estimated_state": state, "desired_state": state, "abort_request": np.zeros(1),
              "generalized_force": np.zeros(q.size - 1)}  # fmt: skip
    now = Now(round(random.uniform(0.0, 9.0), 2), supervisor.block.phase(0))
    before = supervisor.start()
    _, waits = supervisor.step(inputs, before, now)
    assert waits["mode_cause"] == Cause.NONE
    assert supervisor.end(waits) == 0.0
    found, after = supervisor.step(inputs, supervisor.missed(before), now)
    assert found["mode"] == (Mode.RATE_DAMPING if is_weak else Mode.STOP)
    assert found["mode_cause"] == Cause.MISSED
    assert found["restart"] == 1.0
    assert after["missed"] == 0.0
    assert np.isinf(supervisor.end(after)) == is_weak
    if not is_weak:
        assert supervisor.end(after) >= now.time + supervisor.shortest
        assert_allclose(after["plan"][4:], state)


HARD = ("supervisor={saturated_time: 0.05}", "reference.duration=4")


def supervised(*overrides):
    return load_scenario("two_arms", [*HARD, LIMITS, *overrides])


@pytest.mark.slow
@pytest.mark.parametrize("preload", [0.0, 20.0])
def test_damping_and_a_new_plan_settle_both_arms(preload):
    """The motion takes more than the limits of the base. With calibration errors, the force between
    the hands differs by less than 1 N from that without them.
    """
    given = ["duration=30", f"chain.force.preload=[0, 0, 0, 0, 0, {preload}]"]
    limit = "actuation.limit={joints: 40, base_position: 12, base_rotation: 20}"
    runs = [
        simulate(supervised(*given, limit, *also), check_stability=False)
        for also in ([], [CALIBRATION])
    ]
    wanted = np.array([0.0, 0.0, preload])
    forces = [run.dataset["contact_wrench"].values[:, 3:] for run in runs]
    for run, force in zip(runs, forces, strict=True):
        modes = run.dataset["mode"].values.ravel()
        assert run.metrics["supervisor"]["dampings"] == 1
        assert run.metrics["contacts"]["gap"] < 1e-9
        damped = np.flatnonzero(modes == Mode.RATE_DAMPING)
        assert damped.size * run.scenario.sample_time > 0.3
        late = force[damped[0] + 40 :]
        assert np.abs(late - wanted).max() < (2.0 if preload else 1.0)
    # the joints of the right arm take the errors of the calibration
    exact, off = (run.metrics["final_error"] for run in runs)
    size = min(map(len, forces))
    assert runs[0].ending.is_settled
    assert max(exact.values()) < 1e-5
    assert max(off.values()) < 5e-3
    assert np.abs(forces[1][:size] - forces[0][:size]).max() < 1.0
