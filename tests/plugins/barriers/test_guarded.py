"""Barriers around laws: their equations at each sample, limits in drawn runs, records."""

import itertools

import numpy as np
import pytest
from compared_runs import check
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from ffsm_drake import ScenarioError, load_scenario, make_rollout, simulate, simulate_many
from ffsm_drake.mission import Mission
from ffsm_drake.spacecraft.coordinates import halves

LAWS = ("tdc", "asmc", "computed_torque", "super_twisting", "pd_plus")
MARGIN = 0.2
TIGHT = "{decay: 2, rate_decay: 8, margin: 0.2, rate: 0.08}"
ON = f"command_filter.barriers={TIGHT}"


def within(given, random):
    """Position limits around the start, so that the plan leaves them."""
    scenario = load_scenario("postcapture", given)
    start, end = (each.joints for each in (scenario.initial_posture, scenario.target_posture))
    upper, lower = {}, {}
    for name, first in start.items():
        way = end[name] - first
        kept = first + random.uniform(0.4, 0.8) * way
        (upper if way > 0.0 else lower)[name] = float(kept)
    return lower, upper


def shown(values):
    return "{" + ", ".join(f"{name}: {value!r}" for name, value in values.items()) + "}"


def drawn(seed, *, law):
    """A run whose plan leaves drawn limits of position and rate: starts, payload, noise, forces."""
    random = np.random.default_rng(seed)
    given = [
        f"controller={law}", f"random_seed={seed}",
        f"payload.truth.mass={random.uniform(80.0, 120.0)}",
        f"disturbance.amplitude_scale={random.uniform(0.0, 2.0)}",
        "sensing.velocity_noise={joints: 1.0e-5}", "sensing.position_noise={joints: 1.0e-5}",
        "reference.duration=8", "duration=10",
        *(f"target_posture.joints.joint_{k}={random.uniform(-0.6, 0.6)}" for k in range(1, 6)),
        *(f"initial_velocity.joint_{k}={random.uniform(-0.01, 0.01)}" for k in range(1, 6)),
    ]  # fmt: skip
    lower, upper = within(given, random)
    rate = float(random.uniform(0.04, 0.08))
    settings = f"{{margin: {MARGIN}, rate: {rate}, lower: {shown(lower)}, upper: {shown(upper)}}}"
    return given, settings, lower, upper, rate


def beyond(record, lower, upper, rate):
    """Largest distances beyond the limits of position (rad) and rate (rad/s); negative: within."""
    data = record.dataset
    names = data["coordinate"].values.tolist()
    q, v = data["position"].values[:, 7:], data["velocity"].values[:, 6:]
    places = [q[:, names.index(name) - 6] - most for name, most in upper.items()]
    places += [least - q[:, names.index(name) - 6] for name, least in lower.items()]
    return max(each.max() for each in places), np.abs(v).max() - rate


def _later(h, h_1, a, period):
    """psi = h' + a h after a period with h'' = 0, and its slope in h'', by two integrations."""
    ends = [(h_1 + period * h_2, h + period * h_1 + 0.5 * period**2 * h_2) for h_2 in (0.0, 1.0)]
    psi = [rate + a * value for rate, value in ends]
    return psi[0], psi[1] - psi[0]


def independent(row, settings, model):
    """The force by its definition: least change of the joints' forces in the metric of H^-1."""
    q, v, wanted, lower, upper, most = row
    H, b = model.calc_mass_matrix(q), model.calc_bias(q, v)
    inverse, period = np.linalg.inv(H), 0.01
    a, rate_decay, margin, rate = (settings[name] for name in ("a", "b", "m", "w"))
    program = MathematicalProgram()
    change = program.NewContinuousVariables(len(v))
    program.AddQuadraticCost(inverse, np.zeros(len(v)), change)
    program.AddBoundingBoxConstraint(0.0, 0.0, change[:6])
    at, joints = inverse @ (wanted - b), np.arange(6, len(v))
    # psi(t + L) >= (1 - a L) psi(t), psi = h' + a h, of both limits, from h and h' after a period
    for sign, limit in ((1.0, upper), (-1.0, lower)):
        h, h_1 = sign * (limit - q[7:]), -sign * v[6:]
        known = np.isfinite(limit)
        h = np.where(known, h, 1e6)
        psi, slope = _later(h, h_1, a, period)
        need = ((1.0 - a * period) * (h_1 + a * h) - psi) / slope + margin
        fast = -rate_decay * (rate - sign * v[6:]) + margin
        for i, least in zip(joints, np.maximum(need, fast), strict=True):
            if np.isfinite(least):
                row = -sign * inverse[i]
                program.AddLinearConstraint(row[None], [least + sign * at[i]], [np.inf], change)
    for i in joints:
        program.AddBoundingBoxConstraint(-most[i] - wanted[i], most[i] - wanted[i], change[i])
    result = ClarabelSolver().Solve(program)
    return wanted + result.GetSolution(change) if result.is_success() else None


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_forces_are_those_of_the_definition(seed):
    """From recorded measurements, solved by another method."""
    random = np.random.default_rng(seed)
    given, settings, lower, upper, rate = drawn(seed, law=LAWS[seed])
    limit = random.uniform(4.0, 10.0)
    given = [*given, f"actuation.limit.joints={limit}", "duration=6"]
    mission = Mission(load_scenario("postcapture", [*given, f"command_filter.barriers={settings}"]))
    log, model = make_rollout(mission).run(), mission.craft.nominal()
    names, bounds = model.coordinates.joints, {"a": 2.0, "b": 10.0, "m": MARGIN, "w": rate}
    low = np.array([lower.get(name, -np.inf) for name in names])
    high = np.array([upper.get(name, np.inf) for name in names])
    most, active = np.r_[np.full(6, np.inf), np.full(len(names), limit)], 0
    for k in range(0, len(log.time), 5):
        q, v = halves(log["measurement"][k])
        found, change = log["generalized_force"][k], log["barrier_force"][k]
        wanted = found - np.r_[np.zeros(6), change]
        expected = independent((q, v, wanted, low, high, most), bounds, model)
        if expected is None:
            assert log["barrier_slack"][k] > 0.0
            continue
        active += bool(np.abs(change).max() > 1e-3)
        np.testing.assert_allclose(found, expected, atol=2e-5 * max(1.0, np.abs(wanted).max()))
    assert active > 10


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS)
def test_drawn_runs_stay_within_their_limits(law):
    """Each with barriers and without: wrong payload, disturbance, noise."""
    draws = [drawn(seed, law=law) for seed in range(20)]
    free = [load_scenario("postcapture", given) for given, *_ in draws]
    kept = [
        load_scenario("postcapture", [*given, f"command_filter.barriers={settings}"])
        for given, settings, *_ in draws
    ]
    free, kept = (simulate_many(each, engine="compiled") for each in (free, kept))
    for (_, _, *limits), without, guarded in zip(draws, free, kept, strict=True):
        assert guarded.outcome.status == "completed"
        position, rate = beyond(guarded, *limits)
        assert position < 1e-4
        assert rate < 2e-4
        assert guarded.metrics["barriers"]["active"] > 0.0
        assert max(beyond(without, *limits)) > 1e-3


@pytest.mark.slow
def test_compiled_runs_are_those_of_drake():
    """With barriers that act, and the changes that they record."""
    scenarios = [
        load_scenario(
            "postcapture", [f"controller={law}", "reference.duration=4", "duration=3", ON]
        )
        for law in ("tdc", "asmc")
    ]
    check(scenarios)
    record = simulate(scenarios[0], check_stability=False)
    assert np.abs(record.dataset["barrier_force"].values).max() > 0.1


def test_barriers_that_do_not_act_change_no_bit():
    given = ["controller=tdc", "duration=0.3"]
    plain = simulate(load_scenario("postcapture", given), check_stability=False)
    on = simulate(
        load_scenario("postcapture", [*given, "command_filter.barriers={}"]), check_stability=False
    )
    assert np.array_equal(
        plain.dataset["generalized_force"].values, on.dataset["generalized_force"].values
    )
    assert on.metrics["barriers"] == {"active": 0.0, "infeasible": 0.0}


@pytest.mark.slow
def test_what_forces_do_not_permit_is_recorded():
    """Too little force to brake: the record counts the samples, and the limit is broken."""
    given, settings, *limits = drawn(0, law="tdc")
    weak = ["actuation.limit.joints=0.5", "initial_velocity.joint_1=0.3"]
    own = [*given, *weak, f"command_filter.barriers={settings}", "duration=3"]
    record = simulate(load_scenario("postcapture", own), check_stability=False)
    assert record.metrics["barriers"]["infeasible"] > 0.1
    assert record.dataset["barrier_slack"].values.max() > 1e-3
    assert np.abs(record.dataset["generalized_force"].values[:, 6:]).max() <= 0.5
    assert max(beyond(record, *limits)) > 1e-3


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ("{decay: 200}", "decay: must be at most 1/sample_time"),
        ("{lower: {joint_1: 1}, upper: {joint_1: 0}}", "lower.joint_1: must be below 0, not 1"),
        ("{rate: {elbow: 1}}", "unknown coordinate"),
        ("{decay: 0}", "decay.all: must be > 0"),
    ],
)
def test_settings_that_cannot_be_used_are_refused(settings, said):
    def built():
        scenario = load_scenario("postcapture", [f"command_filter.barriers={settings}"])
        return make_rollout(Mission(scenario))

    with pytest.raises(ScenarioError, match=said):
        built()


@pytest.mark.slow
@pytest.mark.parametrize("base", [["joints"], ["base_rotation", "joints"]])
def test_a_floating_base_is_covered(base):
    driven = f"actuation.driven=[{', '.join(base)}]"
    same = ["target_posture.base_position=[0, 0, 0]", "initial_posture.base_position=[0, 0, 0]"]
    same += ["target_posture.base_rpy=[0, 0, 0]", "initial_posture.base_rpy=[0, 0, 0]"]
    given = ["controller=tdc", "reference.duration=4", "duration=4", driven, *same]
    free, kept = (
        simulate(load_scenario("postcapture", [*given, *own]), check_stability=False)
        for own in ([], [ON])
    )
    largest = [np.abs(each.dataset["velocity"].values[:, 6:]).max() for each in (free, kept)]
    assert largest[1] < 0.0802 < 0.1 < largest[0]
    assert list(itertools.chain(kept.metrics["barriers"])) == ["active", "infeasible"]
