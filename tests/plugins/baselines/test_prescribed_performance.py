"""Prescribed performance control has its equations, and keeps the error in its funnel."""

import math

import numpy as np
import pytest
from recorded import samples

from ffsm_drake import BlockError, load_scenario, make_nominal_plant, simulate
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.baselines.prescribed_performance import PrescribedPerformance
from ffsm_drake.systems.controllers import make_law
from ffsm_drake.systems.controllers.laws.tdc import Tdc

GAINS = ("rho_start", "rho_end", "decay", "slope", "k_s", "forgetting")


def drawn(seed):
    """Gains of all coordinates, an edge, and a run that starts off its plan, within limits."""
    random = np.random.default_rng(seed)
    gains = {
        "rho_start": random.uniform(0.02, 0.2), "rho_end": random.uniform(1e-3, 0.01),
        "decay": random.uniform(0.2, 3.0), "slope": random.uniform(3.0, 12.0),
        "k_s": random.uniform(5.0, 25.0), "forgetting": random.uniform(0.0, 5.0),
        "edge": random.uniform(0.3, 0.8),
    }  # fmt: skip
    given = [f"controllers.prescribed_performance.{name}={x}" for name, x in gains.items()]
    given += [f"initial_velocity.joint_{k}={random.uniform(-0.1, 0.1)}" for k in range(1, 6)]
    limit = random.uniform(1.0, 10.0)
    return gains, ["controller=prescribed_performance", *given, f"actuation.limit.all={limit}"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_forces_are_those_of_the_equations(seed):
    """From the recorded inputs, with rho, rho' and rho'' of the time."""
    gains, given = drawn(seed)
    log, rows = samples("postcapture", ["duration=1.5", "reference.duration=15", *given])
    start, end, c, slope, k_s, forgetting = (gains[name] for name in GAINS)
    period, xi, last = 0.01, np.zeros(11), None
    outside = saturated = 0
    for row in rows:
        difference = (start - end) * math.exp(-c * row.time)
        rho, rho_1, rho_2 = end + difference, -c * difference, c * c * difference
        epsilon, r = np.empty(11), np.empty(11)
        for i, share in enumerate(row.e / rho):
            at = math.copysign(min(abs(share), gains["edge"]), share)
            tilt = 1.0 / math.cos(0.5 * math.pi * at) ** 2
            epsilon[i] = 2.0 * end / math.pi * math.tan(0.5 * math.pi * at)
            epsilon[i] += end * tilt * (share - at)
            r[i] = end / rho * tilt
            outside += at != share
        w = row.e_dot - row.e * rho_1 / rho
        s = w + slope * epsilon
        acceleration = np.zeros(11)
        if last is not None:
            lost = np.linalg.inv(row.H) @ (row.applied - last.commanded)
            saturated += np.abs(lost).max() > 1e-6
            xi = (1.0 - forgetting * period) * xi + period * lost
            acceleration = (row.v - last.v) / period
        change = row.e_dot * rho_1 / rho + row.e * (rho_2 / rho - (rho_1 / rho) ** 2)
        u = row.a_d - change + slope * r * w + k_s * (s + xi) - forgetting * xi
        expected = row.applied + row.H @ (u - acceleration)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(row.commanded, expected, atol=1e-9 * scale, rtol=1e-9)
        last = row
    assert outside > 10
    assert saturated > 10
    np.testing.assert_allclose(log["sliding_variable"][-1], s, atol=1e-9)


def law_of(**gains):
    """The law of one coordinate, with a period of 0.2 ms."""
    values = {"rho_start": 0.1, "rho_end": 0.01, "decay": 0.5, "slope": 10.0, "k_s": 20.0}
    values |= {"forgetting": 2.0} | gains
    arrays = {name: np.array([values[name]]) for name in GAINS}
    return PrescribedPerformance(sample_time=2e-4, edge=0.95, **arrays)


def course(law, e, e_dot, disturbance, *, duration=4.0, period=2e-4):
    """t, e and s (n) of e'' = d - u, with u held over each period."""
    state, rows = law.initial_state(), []
    e, e_dot = np.array([e]), np.array([e_dot])
    for k in range(round(duration / period)):
        u, state = law.step(e, e_dot, np.zeros(1), state)
        rows.append((k * period, e[0], state.get("sliding_variable", e)[0]))
        acceleration = disturbance(k * period) - u
        e = e + period * (e_dot + 0.5 * period * acceleration)
        e_dot = e_dot + period * acceleration
    return np.array(rows).T


@pytest.mark.long
@pytest.mark.parametrize("seed", range(8))
def test_a_drawn_error_stays_in_its_funnel(seed):
    """With drawn gains, start and disturbance: |e| < rho always, by the bound on s and epsilon."""
    random = np.random.default_rng(seed)
    gains = {
        "rho_start": random.uniform(0.02, 0.5), "rho_end": random.uniform(1e-3, 0.02),
        "decay": random.uniform(0.1, 2.0), "slope": random.uniform(2.0, 15.0),
        "k_s": random.uniform(5.0, 40.0),
    }  # fmt: skip
    law = law_of(**gains)
    start, end, c, slope, k_s = gains.values()
    e, e_dot = random.uniform(-0.5, 0.5) * start, random.uniform(-0.2, 0.2) * slope * end
    size = random.uniform(0.6, 1.2) * k_s * slope * end
    omega, phase = random.uniform(0.0, 10.0), random.uniform(0.0, 6.0)
    t, error, s = course(law, e, e_dot, lambda t: size * math.sin(omega * t + phase))
    rho = end + (start - end) * np.exp(-c * t)
    largest = max(abs(s[0]), size / k_s)
    assert np.abs(s).max() <= 1.01 * largest
    first = 2.0 * end / math.pi * abs(math.tan(0.5 * math.pi * e / start))
    share = 2.0 / math.pi * math.atan(0.5 * math.pi / end * max(first, largest / slope))
    assert share < 0.95  # the edge
    assert np.abs(error / rho).max() <= share + 0.01


@pytest.mark.slow
def test_the_transformation_keeps_an_error_in_its_funnel_that_its_middle_does_not():
    """A constant disturbance moves the loop with the gains of the middle out of the funnel."""
    size = 1.2 * 20.0 * 10.0 * 0.01
    funnel = law_of(rho_start=0.01)
    middle = Tdc(k_d=np.array([30.0]), k_p=np.array([200.0]))
    inside, outside = (course(law, 0.0, 0.0, lambda t: size)[1] for law in (funnel, middle))
    assert 0.006 < np.abs(inside).max() < 0.0075
    assert np.abs(outside).max() > 0.0119


@pytest.mark.long
def test_the_compensator_bounds_the_speed_of_return():
    """A force that was missing for 0.5 s: with the compensator, less force is asked for."""

    def asked(forgetting, told):
        law = law_of(forgetting=forgetting)
        state, e, e_dot, largest = law.initial_state(), np.zeros(1), np.zeros(1), 0.0
        for k in range(10000):
            d = 1.0 if k < 2500 else 0.0  # also what the limit of the force takes
            u, state = law.step(e, e_dot, np.zeros(1), state)
            given = np.clip(u, -0.9, 0.9)
            state = {**state, "lost_acceleration": told * (given - u)}
            largest = max(largest, abs(u[0]))
            e_dot = e_dot + 2e-4 * (d - given)
            e = e + 2e-4 * e_dot
        assert abs(e[0]) < 0.01
        return largest

    assert asked(2.0, 1.0) < 0.9 * asked(2.0, 0.0)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_drawn_runs_stay_in_the_funnel(seed):
    """Drawn payloads and disturbances, with the default gains, on the whole motion."""
    random = np.random.default_rng(seed)
    given = [
        "controller=prescribed_performance", f"random_seed={seed}",
        f"payload.truth.mass={random.uniform(80.0, 120.0)}",
        f"disturbance.amplitude_scale={random.uniform(1.0, 5.0)}",
        f"disturbance.frequency_scale={random.uniform(0.5, 3.0)}",
        *(f"initial_velocity.joint_{k}={random.uniform(-0.05, 0.05)}" for k in range(1, 6)),
    ]  # fmt: skip
    record = simulate(load_scenario("postcapture", given), check_stability=False)
    time, error = record.dataset["time"].values, record.dataset["error"].values
    rho = 0.01 + 0.09 * np.exp(-0.5 * time)
    share = np.abs(error) / rho[:, None]
    assert record.outcome.status == "completed"
    assert 1e-3 < share.max() < 0.8


@pytest.mark.parametrize(
    ("override", "said"),
    [("edge=1.0", "edge must be below 1"), ("rho_end.joint_2=0.2", "rho_end must be at most")],
)
def test_gains_out_of_range_are_refused(override, said):
    own = f"controllers.prescribed_performance.{override}"
    scenario = load_scenario("postcapture", ["controller=prescribed_performance", own])
    with pytest.raises(BlockError, match=said):
        make_law(make_mission(scenario), make_nominal_plant(scenario))
