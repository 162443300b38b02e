"""A second hand that grasps while the stack moves."""

from pathlib import Path

import numpy as np
import pytest
from drawn_arms import ARMS, two_arms
from numpy.testing import assert_allclose
from scipy.linalg import null_space

from ffsm_drake import RunRecord, Scenario, ScenarioError, load_scenario, make_true_plant, simulate
from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.plugins.two_arms.chain import ClosedChain
from ffsm_drake.plugins.two_arms.contact import ContactForce
from ffsm_drake.plugins.two_arms.hand import beyond, closed
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import Grip
from ffsm_drake.scenario.capture import Envelope
from ffsm_drake.spacecraft.craft import make_nominal_plant
from ffsm_drake.systems.controllers import PAPER_LAWS
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.setup import BlockSetup

AWAY = {"right_1": 1.2, "right_2": 1.2, "right_3": -1.2, "right_4": 0.2, "right_6": -1.2}
SHORT = ("duration=5", "reference.duration=4")


def scenario(*overrides: str, closes: float = 2.0, name: str = "two_arms_capture") -> Scenario:
    away = {"initial_posture": {"joints": AWAY}}
    return load_scenario(name, [away, f"contacts.right.closes={closes}", *SHORT, *overrides])


def drawn(folder: Path, seed: int) -> Scenario:
    """Arms of 3, 6 or 7 joints, target at rest or tumbling, right arm elsewhere."""
    generator = np.random.default_rng(seed)
    kind = (3, 6, 7)[seed % 3]
    axes, lengths, joints, place = ARMS[kind]
    given = two_arms(folder, axes, lengths, joints, place=place, moved=0.05)
    posture = given.initial_posture.joints
    away = {
        name: angle + generator.uniform(-0.4, 0.4)
        for name, angle in posture.items()
        if name.startswith("right")
    }
    closes = round(generator.uniform(1.5, 6.0), 2)
    changes = {
        "initial_posture": {"joints": away},
        "contacts": {"right": {"closes": closes}},
        "duration": 9.0,
        "reference": {"duration": round(generator.uniform(3.0, 6.0), 2)},
        "controller": PAPER_LAWS[seed % len(PAPER_LAWS)],
        "controllers": {"aismc": {"k_s_initial": 60.0, "k_s_max": 70.0}},
        "random_seed": seed,
    }
    if seed % 2:
        rate = generator.uniform(-0.04, 0.04, 3) * ([0, 0, 1] if kind == 3 else [1, 1, 1])
        changes["capture"] = {"rate": rate.tolist()}
        changes["reference"]["goal"] = "stop"
    return given.replace(**changes)


def check_closing(run: RunRecord) -> int:
    """Check the closing of the second hand; its sample."""
    given, data = run.scenario, run.dataset
    k = round((given.grasp_time + given.contacts["right"].closes) / given.sample_time)
    names = data["contact_closing_component"].values.tolist()
    of_momentum = [name.endswith("momentum_change") for name in names]
    assert sum(of_momentum) == 2
    assert data["contact_closing"].values[k, of_momentum].max() < 1e-12
    assert run.metrics["contacts"]["closing"]["energy_lost"] >= 0.0
    assert run.metrics["contacts"]["gap"] < 1e-9
    for name in ("contact_wrench", "contact_gap", "contact_loss", "contact_closing"):
        assert not data[name].values[:k].any()
        assert data[name].values[k:].any()
    return k


@pytest.mark.smoke
def test_the_closing_keeps_the_momentum_and_the_chain_stays_closed() -> None:
    run = simulate(scenario(), check_stability=False)
    k = check_closing(run)
    model = make_true_plant(run.scenario)
    whole = run.scenario.replace(contacts={"right": {"closes": 0}})
    chain = ClosedChain(model, whole, true=True)
    q, v = (run.dataset[name].values for name in ("position", "velocity"))
    moving = []
    for at in (k, k + 1, -1):
        moving.append(np.abs(chain.jacobian(q[at]) @ v[at]).max())
    assert moving[0] < 1e-14
    assert max(moving) < 1e-9
    assert max(run.metrics["final_error"].values()) < 1e-5
    assert run.grasp is not None
    assert run.grasp["time"] == 0.0


@pytest.mark.parametrize("seed", range(10))
def test_any_closing_is_plastic(seed: int) -> None:
    """From drawn states: momentum kept, least energy among motions of the chain with it."""
    generator = np.random.default_rng(seed)
    kind = ("rigid", "compliant")[seed % 5 == 4]
    given = scenario(f"contacts.right.kind={kind}", "simulator_config.max_step_size=0.001")
    grip = Grip(closed=given.contacts["right"].closes)
    nominal = make_nominal_plant(given, grip)
    block = ContactForce(BlockSetup(name="", mission=Mission(given), nominal=nominal, settings={}))
    context, model = block.CreateDefaultContext(), make_true_plant(given)
    q = np.concatenate([generator.normal(size=4), generator.uniform(-1.5, 1.5, 15)])
    q[:4] /= np.linalg.norm(q[:4])
    v = generator.uniform(-0.3, 0.3, 18)
    flow, after = closed(block.block, np.concatenate([q, v]), work=-0.25)
    block.exchange(flow)
    block.GetInputPort("state").FixValue(context, after)
    block.GetInputPort("other_force").FixValue(context, np.zeros(18))
    assert np.array_equal(after[:19], q)
    model.plant.SetPositions(model.context, q)
    A = ClosedChain(model, given, grip, true=True).jacobian(q)
    H, S = model.plant.CalcMassMatrix(model.context), null_space(A)
    wanted = S @ np.linalg.solve(S.T @ H @ S, S.T @ H @ v) if kind == "rigid" else v
    assert_allclose(after[19:], wanted, atol=1e-11)
    assert_allclose((H @ after[19:])[:6], (H @ v)[:6], atol=1e-11)
    lost = 0.5 * (v @ H @ v - wanted @ H @ wanted)
    told = {
        name: block.GetOutputPort(name).Eval(context)
        for name in ("contact_loss", "contact_closing")
    }
    assert_allclose(told["contact_loss"], -0.25 - lost, atol=1e-11)
    assert lost > 0.01 or kind == "compliant"
    closing = told["contact_closing"]
    assert closing[2:4].max() < 1e-12
    assert np.abs(block.GetOutputPort("contact_gap").Eval(context)).max() < 1e-13
    tight = Envelope(position=1e-3, angle=1e-3)
    assert "position" in beyond(
        Mission(given), after, grip, tight
    )  # from its place, wherever it has closed


@pytest.mark.parametrize("kind", ARMS)
@pytest.mark.parametrize("tumbles", [False, True])
def test_the_hand_comes_to_its_place_with_the_targets_motion(
    tmp_path: Path, kind: int, tumbles: bool
) -> None:
    seed = {3: 0, 6: 4, 7: 2}[kind] + 3 * tumbles
    given = drawn(tmp_path, seed)
    assert (given.capture is not None) == tumbles
    model = make_nominal_plant(given)
    motion, closes = make_motion(make_mission(given)), given.contacts["right"].closes
    chain = ClosedChain(model, given, Grip(closed=closes), true=False)
    nq, nv, step = len(model.coordinates.position_names), len(model.coordinates.names), 1e-4
    for time in np.linspace(closes, given.duration, 9):
        q, v, _ = motion.evaluate(time)
        assert_allclose(chain.gap(q), 0.0, atol=1e-9)
        assert_allclose(chain.jacobian(q) @ v, 0.0, atol=1e-8)
    assert_allclose(
        motion.evaluate(0.0)[0][7:], list(given.initial_posture.joints.values())[-nq + 7 :]
    )
    assert_allclose(motion.rows(np.array([closes - 1e-9]))[0], motion.row(closes), atol=1e-6)
    times = np.array([0.3 * closes, closes - 1e-3, closes + 1e-3])
    before, rows, after = (motion.rows(times + d) for d in (-step, 0.0, step))
    for low, high in ((7, nq + 6), (nq + 6, nq + nv + 6)):
        slope = (after[:, low : low + nv - 6] - before[:, low : low + nv - 6]) / (2 * step)
        assert_allclose(slope, rows[:, high : high + nv - 6], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    "seed",
    [
        *(pytest.param(k, marks=pytest.mark.slow) for k in range(2)),
        *(pytest.param(k, marks=pytest.mark.long) for k in range(2, 10)),
    ],
)
def test_no_drawn_run_is_lost(tmp_path: Path, seed: int) -> None:
    run = simulate(drawn(tmp_path, seed), check_stability=False)
    assert run.outcome.status == "completed", run.outcome
    check_closing(run)
    assert max(run.metrics["final_error"].values()) < 1e-3


def test_a_hand_beyond_the_envelope_misses() -> None:
    biased = "sensing.position_bias={right_1: 0.1}"
    run = simulate(scenario(biased), check_stability=False)
    assert run.outcome.status == "missed"
    assert "the hand of contacts.right misses its place at t = 2 s: angle" in run.outcome.message
    assert run.dataset.sizes["time"] == 200
    wide = {"capture": {"envelope": {"position": 0.5, "angle": 0.2, "velocity": None}}}
    run = simulate(scenario(biased, wide), check_stability=False)
    assert run.outcome.status == "completed"
    assert check_closing(run) == 200
    assert run.metrics["contacts"]["closing"]["angle"] > 0.09


@pytest.mark.parametrize("closes", [0, 1.5])
def test_a_flexible_panel_moves_on_through_the_closing(closes: float) -> None:
    panel = {"position": [0, 1, 0], "direction": [0, 1, 0], "mass": 8.0, "frequency": 0.25}
    changes = {"model": {"flexible": {"port": panel}}}
    if not closes:
        joints = load_scenario("two_arms_capture").initial_posture.joints
        changes["initial_posture"] = {"joints": joints}
    run = simulate(
        scenario(changes, "controller=computed_torque", "duration=2.5", closes=closes),
        check_stability=False,
    )
    hidden = run.dataset["hidden_position"].values
    assert np.abs(hidden).max() > 1e-7
    assert np.abs(np.diff(hidden, axis=0)).max() < 0.1 * np.abs(hidden).max()
    assert run.metrics["contacts"]["gap"] < 1e-9
    if closes:
        check_closing(run)


@pytest.mark.parametrize("kind", ["kalman", "coupled"])
def test_an_estimator_keeps_the_force_small_after_a_closing(kind: str) -> None:
    given = scenario(f"estimator.kind={kind}", "duration=3", "reference.duration=2.5", closes=1.5)
    run = simulate(given, check_stability=False)
    check_closing(run)
    assert run.metrics["contacts"]["force"] < 1.0
    assert run.metrics["contacts"]["moment"] < 2.0


@pytest.mark.slow
def test_a_compliant_hand_begins_with_its_spring_at_rest() -> None:
    soft = ("contacts.right.kind=compliant", "chain.law=plain")
    fine = "simulator_config.max_step_size=0.001"
    run = simulate(scenario(*soft, fine, "duration=1.5", closes=1), check_stability=False)
    assert run.outcome.status == "completed"
    data, k = run.dataset, 100
    assert np.abs(data["contact_gap"].values[k]).max() < 1e-12
    assert 0.0 < np.abs(data["contact_gap"].values[k:]).max() < 1e-3
    assert run.metrics["contacts"]["force"] < 1.0
    assert run.metrics["contacts"]["closing"]["energy_lost"] == 0.0


@pytest.mark.slow
def test_a_rollout_that_is_kept_gives_the_same_bits_again() -> None:
    seeds = [scenario("duration=3", "reference.duration=2.5", f"random_seed={k}") for k in (1, 2)]
    kept = make_rollout(seeds[0])
    assert kept.accepts(seeds[1])
    logs = [kept.run(seed).series for seed in (seeds[0], seeds[1], seeds[0])]
    alone = make_rollout(seeds[0]).run().series
    for name, values in alone.items():
        assert np.array_equal(logs[2][name], values)
        assert np.array_equal(logs[0][name], values)
    assert not np.array_equal(logs[1]["state"], alone["state"])


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["contacts.left.closes=1"], "contacts.left.closes: must be 0, because the model welds"),
        (["contacts.right.closes=1.005"], "whole number of control samples"),
        (["contacts.right.closes=5"], "must leave time to grasp before the run ends"),
        (["contacts.right.position_error=[1e-3, 0, 0]"], "has no effect on a hand that grasps"),
        (["initial_posture.joints.left_1=3.0"], "its hand does not reach"),
        (["contacts.right.closes=-1"], "contacts.right.closes"),
    ],
)
def test_refusals_are_one_line(overrides: list[str], words: str) -> None:
    with pytest.raises(ScenarioError, match=words) as caught:
        simulate(scenario(*overrides), check_stability=False)
    assert "\n" not in str(caught.value)
