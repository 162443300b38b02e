"""The fixed-time law with an observer has its equations, and settles in a bounded time."""

import types

import numpy as np
import pytest
from recorded import samples

from ffsm_drake import load_scenario, make_nominal_plant
from ffsm_drake.plugins.baselines.fixed_time_observer import FixedTimeObserver
from ffsm_drake.systems.controllers import gain_vectors
from ffsm_drake.systems.controllers.law import Sample


def drawn(seed):
    """Gains of all coordinates, and a run that starts off its plan, within limits."""
    random = np.random.default_rng(seed)
    gains = {
        "power": random.uniform(0.5, 0.9), "far_power": random.uniform(1.1, 1.6),
        "k_p": random.uniform(2.0, 10.0), "k_d": random.uniform(2.0, 5.0),
        "size": random.uniform(0.3, 2.0), "size_rate": random.uniform(0.3, 2.0),
        "width": random.uniform(0.005, 0.02), "width_rate": random.uniform(0.005, 0.02),
        "rate_bound": random.uniform(5.0, 50.0), "far_gain": random.uniform(0.0, 2.0),
        "width_x": random.uniform(0.04, 0.1),
    }  # fmt: skip
    given = [f"controllers.fixed_time_observer.{name}={x}" for name, x in gains.items()]
    given += [f"initial_velocity.joint_{k}={random.uniform(-0.1, 0.1)}" for k in range(1, 6)]
    limit = random.uniform(1.0, 5.0)
    return gains, ["controller=fixed_time_observer", *given, f"actuation.limit.all={limit}"]


def power(x, p, width):
    """x / (x^2 + width^2)^((1 - p) / 2): |x|^p sgn x beyond a layer."""
    return x / (x**2 + width**2) ** (0.5 * (1.0 - p))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_forces_are_those_of_the_equations(seed):
    """From the recorded inputs."""
    gains, given = drawn(seed)
    p, g, k_p, k_d, size, size_rate, width, width_rate, bound, mu, width_x = gains.values()
    _, rows = samples("postcapture", ["duration=1.5", "reference.duration=15", *given])
    period, d, z, last = 0.01, np.zeros(11), None, None
    saturated = 0
    for row in rows:
        if last is None:
            z = row.e_dot
        else:
            saturated += np.abs(row.applied - last.commanded).max() > 1e-6
            z = z + period * (last.a_d - np.linalg.inv(row.H) @ (row.applied - row.b) - d)
            x = row.e_dot - z
            rise = power(x, 0.5, width_x) + mu * power(x, 1.5, width_x)
            z = z + period * 2.1 * bound**0.5 * rise
            rise = 0.5 * power(x, 0.0, width_x) + 2.0 * mu * x
            rise = rise + 1.5 * mu**2 * power(x, 2.0, width_x)
            d = d - period * 2.1 * bound * rise
        on_e = power(row.e / size, p, width / size) + power(row.e / size, g, width / size)
        y, layer = row.e_dot / size_rate, width_rate / size_rate
        near, far = 2 * p / (1 + p), 2 * g / (1 + g)
        on_rate = power(y, near, layer) + power(y, far, layer)
        u = row.a_d + k_p * size * on_e + k_d * size_rate * on_rate - d
        expected = row.H @ u + row.b
        scale = np.abs(expected).max()
        np.testing.assert_allclose(row.commanded, expected, rtol=1e-9, atol=1e-9 * scale)
        last = row
    assert saturated > 10
    assert np.abs(d).max() > 0.01


def law_of(period, size=1, **gains):
    """The law of some coordinates of unit inertia without bias."""
    scenario = load_scenario("postcapture", ["controller=fixed_time_observer"])
    own = gain_vectors(scenario, make_nominal_plant(scenario).coordinates)
    values = {k: np.full(size, v[-1]) if np.ndim(v) else v for k, v in own.items()}
    values |= {key: np.full(size, float(value)) for key, value in gains.items()}
    model = types.SimpleNamespace(
        calc_mass_matrix=lambda q: np.eye(size), calc_bias=lambda q, v: np.zeros(size)
    )
    return FixedTimeObserver(model=model, sample_time=period, **values)


def course(law, *, e=0.0, d=lambda t: 0.0, start=0.0, duration=4.0):
    """e and the observer's error d^ - d of e'' = a_d - tau - d, at each sample."""
    period, zeros = law.sample_time, np.zeros_like(law.k_p)
    state = {**law.initial_state(), "estimated_disturbance": zeros + start}
    e, e_dot, force, rows = zeros + e, zeros, zeros, []
    for k in range(round(duration / period)):
        sample = Sample(zeros, zeros, zeros, zeros, zeros, e, e_dot, force, is_first=k == 0)
        force, state = law.step(sample, state)
        now = d(k * period)
        rows.append((e, state["estimated_disturbance"] - now))
        acceleration = -force - now
        e = e + period * (e_dot + 0.5 * period * acceleration)
        e_dot = e_dot + period * acceleration
    return np.swapaxes(rows, 0, 1)


def settled(values, size, period):
    """The times (s) after which columns stay below a size."""
    beyond = np.abs(values) > size
    return period * (len(beyond) - np.argmax(beyond[::-1], axis=0)) * beyond.any(axis=0)


@pytest.mark.long
def test_the_observer_converges_in_a_time_that_starts_do_not_lengthen():
    """Estimates wrong by 10 to 1e4: with the powers of large errors, times have a bound."""
    period, starts = 1e-4, np.array([10.0, 1e2, 1e3, 1e4])

    def times(mu):
        law = law_of(period, 4, rate_bound=20.0, far_gain=mu, width_x=1e-5, k_p=0.0, k_d=0.0)
        return settled(course(law, start=starts, duration=2.0)[1], 0.2, period)

    uniform, plain = times(3.0), times(0.0)
    assert uniform[-1] < 1.5 * uniform[1]
    assert uniform[-1] < 1.5
    assert plain[1] > 3.0 * uniform[1]  # without them, a large error takes longer


@pytest.mark.long
def test_a_disturbance_within_its_bound_is_estimated_and_rejected():
    def disturbance(t):
        return 10.0 * np.sin(1.8 * t)  # rate 18

    period = 2e-4
    for bound, small in ((20.0, True), (2.0, False)):
        law = law_of(period, rate_bound=bound, width_x=1e-5)
        e, off = np.abs(course(law, d=disturbance, duration=5.0)[:, -round(2.0 / period) :])
        assert bool(off.max() < 0.1) == small
        assert bool(e.max() < 1e-3) == small


@pytest.mark.long
def test_the_law_settles_in_a_time_that_starts_do_not_lengthen():
    period = 2e-4
    law = law_of(period, 3, width=1e-4, width_rate=1e-4)
    errors = course(law, e=np.array([1.0, 10.0, 100.0]), duration=6.0)[0]
    near, far, farthest = settled(errors, 1e-3, period)
    assert near < far < farthest < 2.0 * near
    assert farthest - far < far - near


@pytest.mark.parametrize(("base", "factor"), [("s", 2.5), ("rad", 0.3)])
def test_units_that_the_law_declares(base, factor):
    """Numbers in other units of time or angle change as the units of u and d^ say."""
    exponents = {
        "": 0, "1/s^2": {"s": -2}, "1/s": {"s": -1}, "rad or m": {"rad": 1},
        "rad/s or m/s": {"rad": 1, "s": -1}, "rad/s^3 or m/s^3": {"rad": 1, "s": -3},
        "s/rad or s/m": {"rad": -1, "s": 1},
    }  # fmt: skip

    def last(factor):
        def of(value, unit):
            return np.asarray(value) * factor ** (exponents[unit] or {}).get(base, 0)

        default, declared = law_of(0.01), FixedTimeObserver.__dataclass_fields__
        gains = {
            name: of(getattr(default, name), field.metadata["setting"].unit)
            for name, field in declared.items()
            if "setting" in field.metadata
        }
        law = FixedTimeObserver(
            model=default.model, sample_time=0.01 * (factor if base == "s" else 1.0), **gains
        )
        state = law.initial_state()
        for k in range(3):
            acceleration = of([3.0], "rad or m") / (factor**2 if base == "s" else 1.0)
            zero = np.zeros(1)
            e, e_dot = of([0.02], "rad or m"), of([0.4 + k], "rad/s or m/s")
            u, state = law.step(
                Sample(zero, zero, zero, zero, acceleration, e, e_dot, zero, is_first=k == 0), state
            )
        return np.array([u[0], state["estimated_disturbance"][0]])

    expected = last(1.0) * factor ** {"s": -2, "rad": 1}[base]
    assert np.abs(expected).min() > 1e-3
    np.testing.assert_allclose(last(factor), expected, rtol=1e-9)
