"""Jammed joints of arms that hold one target: one solve gives their force and the contacts'."""

import os

import numpy as np
import pytest
import two_arms_oracle as oracle
from compared_runs import check
from numpy.testing import assert_allclose
from scipy.linalg import null_space
from test_later import AWAY
from test_mechanics import NQ, NV, consistent_states

from ffsm_drake import Scenario, load_scenario, make_closed_loop, simulate
from ffsm_drake.plugins.two_arms.flow import ContactFlow
from ffsm_drake.plugins.two_arms.hand import closed
from ffsm_drake.runs.metrics import momentum_residual

DRAWS = int(os.environ.get("FFSM_DRAWS", "1"))
JOINTS = [f"{side}_{k}" for side in ("left", "right") for k in range(1, 7)]
LIMITS = "actuation.limit={joints: 20}"
FREE = ["sensing.velocity_noise=0", "disturbance.amplitude_scale=0"]


def jams(units, time=0.0, **more) -> dict:
    """An override."""
    events = {
        name: {"unit": f"joints.{name}", "kind": "jammed", "time": [time], **more} for name in units
    }
    return {"faults": {"events": events}}


def flow_of(names, *overrides) -> ContactFlow:
    given = load_scenario("two_arms", [jams(names), "contacts.right.stabilization=0", *overrides])
    return make_closed_loop(given).blocks["forces.contacts"].block


def acceleration(flow: ContactFlow, q, v, force) -> tuple[np.ndarray, dict]:
    """dv/dt (nv) with the forces of the contacts and jams, and these."""
    inputs = {"state": np.r_[q, v], "other_force": force, "time": np.ones(1)}
    outputs, _ = flow.flow(inputs | {"correction": np.zeros(6)}, {})
    acts = force + outputs["generalized_force"] + outputs["jam_force"]
    H = flow.model.calc_mass_matrix(q)
    return np.linalg.solve(H, acts - flow.model.calc_bias(q, v)), outputs


@pytest.mark.smoke
@pytest.mark.parametrize("count", [1, 2, 4, 6, 7, 9, 12])
def test_the_forces_agree_with_an_exact_elimination(count: int) -> None:
    """In the velocities that contacts and jams leave; also with more jams than the loop has
    freedoms, of joints that still move.
    """
    random = np.random.default_rng(count)
    for q, v, force in consistent_states(5):
        names = random.choice(JOINTS, count, replace=False)
        flow = flow_of(names)
        places = [6 + JOINTS.index(name) for name in names]
        J = np.eye(NV)[sorted(places)]
        if count > 6:  # they stop a loop that cannot move
            v = null_space(np.vstack([flow.jacobian(q), J])) @ random.normal(size=6)
        rows = np.vstack([flow.jacobian(q), J])
        wanted = np.r_[-flow.bias(q, v), -(J @ v) / 0.02]
        some = np.linalg.lstsq(rows, wanted, rcond=1e-10)[0]
        assert_allclose(rows @ some, wanted, atol=1e-9)
        left, H = null_space(rows, rcond=1e-10), flow.model.calc_mass_matrix(q)
        acts = force - flow.model.calc_bias(q, v) - H @ some
        expected = some + left @ np.linalg.solve(left.T @ H @ left, left.T @ acts)
        found, outputs = acceleration(flow, q, v, force)
        assert_allclose(found, expected, rtol=0, atol=1e-8 * max(1.0, np.abs(expected).max()))
        assert not np.delete(outputs["jam_force"], places).any()
        if count > 6:  # of a choice: the later ones carry nothing
            assert np.count_nonzero(outputs["jam_force"]) == 6


def test_a_jammed_chain_moves_as_in_pinocchio() -> None:
    """With jammed joints as rigid parts of their arms."""
    pin = pytest.importorskip("pinocchio", reason="needs the extra 'oracles'")
    random = np.random.default_rng(7)
    for q, _, force in consistent_states(10):
        names = random.choice(JOINTS, random.integers(1, 6), replace=False)
        places = [JOINTS.index(name) for name in names]
        flow = flow_of(names)
        rows = np.vstack([flow.jacobian(q), np.eye(NV)[[6 + each for each in places]]])
        v = 0.3 * null_space(rows) @ random.normal(size=NV - len(rows))
        theirs = oracle.pinocchio_acceleration(pin, {each: q[7 + each] for each in places})
        expected, (found, _) = theirs(q, v, force), acceleration(flow, q, v, force)
        assert_allclose(found, expected, rtol=0, atol=1e-10 * max(1.0, np.abs(expected).max()))


def test_a_hand_that_closes_leaves_jammed_joints_at_their_rates() -> None:
    """And the momentum: the impulses act between links."""
    flow = flow_of(["left_2", "right_4"])
    random = np.random.default_rng(3)
    for q, _, _ in consistent_states(5):
        v = random.normal(size=NV)
        _, after = closed(flow, np.r_[q, v], work=0.0, time=1.0)
        H, left = flow.model.calc_mass_matrix(q), after[NQ:]
        assert_allclose(flow.jacobian(q) @ left, 0.0, atol=1e-12)
        assert_allclose(left[[7, 15]], v[[7, 15]], atol=1e-12)
        assert_allclose((H @ left)[:6], (H @ v)[:6], atol=1e-10)
        # least energy of all motions with these constraints and momenta
        rows = np.vstack([flow.jacobian(q), np.eye(NV)[[7, 15]]])
        assert_allclose(null_space(rows).T @ H @ (left - v), 0.0, atol=1e-10)


def drawn(seed: int, lanes: int = 1) -> list[Scenario]:
    """One to three jams of joints of both arms at any time, some of which end; both hands from the
    start, or the second one later.
    """
    random = np.random.default_rng(seed)
    is_late, names = seed % 3 == 2, random.choice(JOINTS, seed % 3 + 1, replace=False).tolist()
    events = {}
    for name in names:
        event = {
            "unit": f"joints.{name}",
            "kind": "jammed",
            "time": [round(random.uniform(0, 1), 2)],
        }
        if random.random() < 0.3:
            event["duration"] = 0.25
        events[name] = event
    given = [
        "duration=2", "reference.duration=2", "simulator_config.max_step_size=0.0025", LIMITS,
        {"faults": {"events": events}},
        f"controller={'computed_torque' if is_late else random.choice(['tdc', 'computed_torque'])}",
    ]  # fmt: skip
    name = str(random.choice(["two_arms", "two_arms_capture"]))
    if is_late:
        name, away = "two_arms_capture", {"initial_posture": {"joints": AWAY}}
        width = "{position: 2.0, angle: 3.0, velocity: null, angular_velocity: null}"
        given += [away, f"capture.envelope={width}", "contacts.right.closes=0.7"]
    return [load_scenario(name, [*given, f"random_seed={k}"]) for k in range(lanes)]


def check_jams(run) -> None:
    """The chain stays closed, jammed joints stop, and nothing pushes the whole."""
    data, step = run.dataset, run.scenario.sample_time
    assert run.outcome.status == "completed"
    gap = np.nan_to_num(np.abs(data["contact_gap"].values)).max(axis=1)
    assert gap.max() < 2e-8
    for each in momentum_residual(data).values():
        assert np.linalg.norm(each, axis=1).max() < 1e-2
    begin = round(getattr(run.scenario, "grasp_time", 0.0) / step)
    names = data["coordinate"].values.tolist()
    jam = np.nan_to_num(data["force_jam"].values)
    for event in run.scenario.faults.events.values():
        at, name = round(event.time[0] / step), event.unit.partition(".")[2]
        last = len(data["time"]) if event.duration is None else at + round(event.duration / step)
        rates = np.abs(data["velocity"].values[at:last, names.index(name)])
        assert np.abs(jam[at + 1 : last, names.index(name)]).max() > 0.0
        first = rates[max(begin - at, 0) :]
        later = np.exp(-50.0 * step * np.arange(len(first)))
        assert (first <= 1.2 * first[0] * later + 1e-10).all()
    assert not jam[:, :6].any()


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3 * DRAWS))
def test_drawn_jams_keep_the_chain_closed(seed: int) -> None:
    (given,) = drawn(seed)
    check_jams(simulate(given, check_stability=False))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3 * DRAWS))
def test_drawn_jams_have_the_runs_of_drake(seed: int) -> None:
    for run in check(drawn(seed, 2), called=None):
        assert run.engine.startswith("compiled")
        check_jams(run)


@pytest.mark.slow
def test_the_energy_of_a_jam() -> None:
    """The work of drives and jams is all that changes the energy; a jam takes some of it."""
    given = load_scenario(
        "two_arms", [*FREE, LIMITS, "controller=tdc", "duration=2", jams(["left_2"], 1.0)]
    )
    data = simulate(given, check_stability=False).dataset
    v, energy = data["velocity"].values, data["kinetic_energy"].values
    assert np.abs((data["force_contacts"].values * v).sum(axis=1)).max() < 1e-9
    moved = 0.005 * (v[1:] + v[:-1])
    change = np.diff(energy) - (data["applied_force"].values[:-1] * moved).sum(axis=1)
    before, stops, after = change[:100], change[100:110], change[130:]
    scale = energy.max()
    assert np.abs(before.sum()) < 1e-3 * scale
    assert np.abs(after).max() < 1e-3 * scale
    assert stops.sum() < -1e-4 * scale
