"""Plans for two arms that hold one target: the loops stay closed, and every limit is kept."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from scipy.spatial.transform import Rotation

from ffsm_drake import Scenario, load_scenario, make_nominal_plant, simulate
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.design.remarks import plan_limits
from ffsm_drake.plugins.planning.chain_dynamics import ChainDynamics
from ffsm_drake.plugins.planning.inverse_dynamics import complex_step
from ffsm_drake.plugins.planning.motion_limits import motion_limits
from ffsm_drake.plugins.planning.planner import PlanningError, _Planner, plan_motion
from ffsm_drake.plugins.two_arms.after_closing import from_last_closing
from ffsm_drake.plugins.two_arms.chain import ClosedChain
from ffsm_drake.scenario import Grip
from ffsm_drake.scenario.contacts import ALL_HANDS
from ffsm_drake.spacecraft.coordinates import position_errors
from ffsm_drake.spacecraft.limits import FORCE
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.plan import Plan
from ffsm_drake.systems.reference import make_motion, timed
from ffsm_drake.systems.start import velocity_at_start

LIMIT = {"actuation": {"limit": {"joints": 4.0}}}
HAND = {"contacts": {"right": {"force_limit": 6.0, "moment_limit": 3.0}}}


def limited(*overrides: str, name: str = "two_arms", **changes: Any) -> Scenario:
    scenario = load_scenario(name, ["planning.segments=16", "reference.duration=12", *overrides])
    return scenario.replace(**{**LIMIT, **HAND, **changes})


def dynamics_of(scenario: Scenario, first: np.ndarray) -> ChainDynamics:
    mission = Mission(scenario)
    model = mission.craft.nominal()
    return ChainDynamics(mission, model, RotationMatrix(Quaternion(first)), motion_limits(mission))


STILL = {"base_rpy": [0, 0, 0], "base_position": [0, 0, 0]}
DRIVEN = {"joints": ["joints"], "turning": ["base_rotation", "joints"], "all": ["all"]}


def driven_by(driven: str, scenario: Scenario) -> Scenario:
    """A mission with a base that does not move, turns or moves by actuators."""
    places = {f"{each}_posture": STILL for each in ("initial", "target")}
    base = {} if driven == "all" else places
    return scenario.replace(actuation={"driven": DRIVEN[driven]}, **base)


@pytest.mark.parametrize(
    ("name", "driven", "share"),
    [
        *itertools.product(("two_arms", "two_arms_capture"), ["all"], ("null", "0.4")),
        ("two_arms", "joints", "null"),
        ("two_arms_capture", "turning", "0.4"),
    ],
)
def test_the_dynamics_are_those_of_the_motion(name: str, driven: str, share: str) -> None:
    """Rotation vectors and followers against the joints and quaternions of the chain's motion."""
    scenario = driven_by(driven, limited(f"chain.force.share={share}", name=name))
    mission = Mission(scenario)
    motion, times = make_motion(mission), np.linspace(0.5, 11.0, 6)
    found = motion.demand(mission.craft.nominal(), times)
    planner, step = _Planner(scenario, lambda line: None, 10.0), 1e-3
    dynamics, chain, planned = planner._dynamics, planner._chain, planner._planned
    assert chain is not None
    first = planner._start

    def z(at: np.ndarray) -> np.ndarray:
        q = motion.evaluate(at)[0]
        turns = position_errors(q, np.concatenate([first[:4], q[0, 4:]])[None])[:, :3]
        return np.hstack([turns, q[:, 4:]]).T[planned]

    q, v, a = motion.evaluate(times)
    chain.chain.learn(q[:, 7:].T)
    rate = (z(times + step) - z(times - step)) / (2.0 * step)
    acceleration = (z(times + step) - 2.0 * z(times) + z(times - step)) / step**2
    rows = dynamics.calc(z(times), rate, acceleration)
    order = [*planned, *chain.chain.following]
    assert_allclose(rows[: len(order)], found[FORCE].T[order], atol=1e-5)
    assert dynamics.joints is not None
    assert_allclose(rows[dynamics.joints], q[:, 7:].T, atol=1e-9)
    wrench = rows[len(order) + 18 : dynamics.joints.start].T * motion_limits(mission).wrench
    assert_allclose(wrench, found["contact_wrench"], atol=1e-5)
    assert dynamics.turns == (driven == "joints")
    if dynamics.turns:
        R_WB = Rotation.from_quat(q[:, :4], scalar_first=True)
        turned = [R_WB.apply(each[:, :3], inverse=True) for each in (v, a)]
        assert_allclose(rows[-6:], np.hstack(turned).T, atol=1e-5)


def test_derivatives_pass_through_the_closed_loops() -> None:
    scenario = limited()
    start = make_motion(Mission(scenario)).evaluate(3.0)[0]
    dynamics = dynamics_of(scenario, start[:4])
    dynamics.chain.learn(start[7:, None])
    generator = np.random.default_rng(0)
    motion = generator.normal(0.0, 0.05, (3, 12, 2))
    motion[0] += np.concatenate([np.zeros(3), start[4:]])[dynamics.chain.free, None]
    _, by = complex_step(dynamics.calc, motion)
    step = 1e-6
    for order, i in ((0, 1), (0, 8), (1, 2), (1, 9), (2, 7)):
        up, down = motion.copy(), motion.copy()
        up[order, i] += step
        down[order, i] -= step
        slope = (dynamics.calc(*up) - dynamics.calc(*down)) / (2.0 * step)
        rows = np.r_[:30, 36:48]  # without the gaps, which are rounding
        assert_allclose(by[order, rows, i], slope[rows], rtol=1e-5, atol=1e-5)


@pytest.mark.long
def test_a_plan_of_two_arms_keeps_every_limit_and_is_faster_than_a_polynomial(
    tmp_path: Path,
) -> None:
    scenario = limited()
    found = plan_motion(scenario, time_limit=150.0)
    assert not found.exceeded
    reserve = {"reserve": scenario.planning.reserve, "duration": None}
    polynomial = timed(Mission(scenario.replace(reference=reserve))).scenario.reference.duration
    assert polynomial is not None
    assert found.plan.duration < 0.95 * polynomial
    found.plan.save(tmp_path / "plan.yaml", title="")
    plan = {"kind": "optimal", "plan": str(tmp_path / "plan.yaml")}
    flown = scenario.replace(reference=plan, duration=15.0)
    mission, model = Mission(flown), make_nominal_plant(flown)
    motion, chain = make_motion(mission), ClosedChain(model, flown, true=False)
    times = np.linspace(0.0, found.plan.end, 200)
    demand = motion.demand(model, times)
    assert np.abs(demand[FORCE][:, 6:]).max() < 4.0 * (1.0 - flown.planning.reserve) * 1.001
    wrench = np.abs(demand["contact_wrench"]).max(axis=0) / (1.0 - flown.planning.reserve)
    assert (wrench < 1.001 * np.repeat([3.0, 6.0], 3)).all()
    for q, v, a in zip(*motion.evaluate(times), strict=True):
        assert_allclose(chain.gap(q), 0.0, atol=1e-9)
        assert_allclose(chain.jacobian(q) @ v, 0.0, atol=1e-9)
        assert_allclose(chain.jacobian(q) @ a + chain.bias(q, v), 0.0, atol=1e-9)
    run = simulate(flown, check_stability=False)
    assert run.ending.is_settled
    assert run.metrics["contacts"]["gap"] < 1e-6


@pytest.mark.long
def test_a_capture_by_two_arms_is_stopped_on_a_plan(tmp_path: Path) -> None:
    scenario = limited("planning.segments=8", name="two_arms_capture")
    found = plan_motion(scenario, time_limit=120.0)
    found.plan.save(tmp_path / "plan.yaml", title="")
    plan = {"kind": "optimal", "plan": str(tmp_path / "plan.yaml")}
    assert found.plan.end < 12.0
    run = simulate(scenario.replace(reference=plan, duration=15.0), check_stability=False)
    assert run.ending.is_settled
    assert run.metrics["contacts"]["gap"] < 1e-6


@pytest.mark.long
@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["reference.duration=2"], r"active limit: (left|right)_\d: force .* N m at t = "),
        (["contacts.right.force_limit=0.02", "reference.duration=6"],
         r"active limit: contacts.right force_\w: wrench .* N at t = "),
    ],
)  # fmt: skip
def test_an_infeasible_plan_names_the_limit(overrides: list[str], words: str) -> None:
    with pytest.raises(PlanningError, match=words):
        plan_motion(load_scenario("two_arms", [LIMIT, "planning.segments=6", *overrides]),
                    time_limit=20.0)  # fmt: skip


AWAY = {"right_1": 1.2, "right_2": 1.2, "right_3": -1.2, "right_4": 0.2, "right_6": -1.2}


def late(seed: int, **changes: Any) -> Scenario:
    """A target, at rest or tumbling, whose second hand closes at a drawn time."""
    random = np.random.default_rng(seed)
    name = ("two_arms", "two_arms_capture")[seed % 2]
    closes = f"contacts.right.closes={random.uniform(1.0, 3.0):.2f}"
    given = limited(closes, "planning.segments=6", "reference.duration=8", name=name)
    return given.replace(**{"initial_posture": {"joints": AWAY}, **changes})


def first_guess(scenario: Scenario) -> Plan:
    """The plan with which the search begins."""
    planner = _Planner(scenario, lambda line: None, 10.0)
    problem = planner._problem()
    return planner._plan_of(planner._first_guess(problem, 0.0))


@pytest.mark.parametrize("seed", range(2))
def test_the_mission_of_a_plan_begins_at_the_last_closing(seed: int) -> None:
    """Where the polynomial is then, at its rates, with every hand on the target and no impact."""
    mission = Mission(late(seed))
    begun = from_last_closing(mission)
    q, v, _ = make_motion(mission).evaluate(mission.scenario.contacts["right"].closes)
    model = begun.craft.nominal()
    start = configuration(model.coordinates, begun.scenario.initial_posture, key="")
    assert_allclose(start, q, atol=1e-12)
    assert_allclose(velocity_at_start(begun, model), v, atol=1e-6)
    assert np.abs(v).max() > 1e-3
    assert not any(each.closes for each in begun.scenario.contacts.values())
    assert np.abs(ClosedChain(model, begun.scenario, true=False).gap(start)).max() < 1e-9
    assert from_last_closing(begun) is begun


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_plan_begins_at_the_closing_of_a_late_hand(tmp_path: Path, seed: int) -> None:
    """Up to then, it is the polynomial with the load on the first hand; then both share it."""
    scenario = late(seed)
    plan = first_guess(scenario)
    plan.save(tmp_path / "plan.yaml", title="")
    flown = scenario.replace(reference={"kind": "optimal", "plan": str(tmp_path / "plan.yaml")})
    mission, closes = Mission(flown), flown.contacts["right"].closes
    motion, polynomial = make_motion(mission), make_motion(Mission(scenario))
    model, chain = mission.craft.nominal(), ClosedChain(mission.craft.nominal(), flown, ALL_HANDS,
                                                        true=False)  # fmt: skip
    assert motion.end == closes + plan.end
    assert motion.remarks() == []
    before = np.linspace(0.0, closes - 1e-3, 20)
    assert_allclose(motion.rows(before), polynomial.rows(before), atol=1e-12)
    found, expected = (each.demand(model, before) for each in (motion, polynomial))
    assert_allclose(found[FORCE], expected[FORCE], atol=1e-9)
    assert not found["contact_wrench"].any()
    nq, nv = len(model.coordinates.position_names), len(model.coordinates.names)
    jump = motion.row(closes) - polynomial.row(closes)
    assert_allclose(jump[: nq + nv], 0.0, atol=1e-4)
    times = np.linspace(closes, motion.end, 20)
    for q, v, a in zip(*motion.evaluate(times), strict=True):
        assert_allclose(chain.gap(q), 0.0, atol=1e-9)
        assert_allclose(chain.jacobian(q) @ v, 0.0, atol=1e-8)
        assert_allclose(chain.jacobian(q) @ a + chain.bias(q, v), 0.0, atol=1e-8)
    assert motion.demand(model, times)["contact_wrench"].any()
    assert closes in motion.instants(50)
    phases = [make_motion(mission, Grip(closed=each)) for each in (0.0, closes)]
    assert [(each.begin, each.end) for each in phases] == [(0.0, closes), (closes, motion.end)]
    longer = Mission(flown.replace(reference={"duration": 9.0}))
    assert "make a plan for this scenario with 'ffsm plan'" in make_motion(longer).remarks()[0]


@pytest.mark.long
def test_a_late_hand_is_planned_and_flown(tmp_path: Path) -> None:
    scenario = late(1, contacts={"right": {"closes": 4.0}})
    found = plan_motion(scenario, time_limit=60.0)
    found.plan.save(tmp_path / "plan.yaml", title="")
    plan = {"kind": "optimal", "plan": str(tmp_path / "plan.yaml")}
    flown = scenario.replace(reference=plan, duration=17.0)
    assert plan_limits(Mission(flown)) == []  # up to the closing, too
    run = simulate(flown, check_stability=False)
    assert run.ending.is_settled
    assert run.metrics["contacts"]["gap"] < 1e-6
    assert run.metrics["contacts"]["closing"]["distance"] < 1e-4
