"""Super-twisting, terminal and fixed-time laws keep what their theory says of e'' = d - u."""

import dataclasses

import numpy as np
import pytest

from ffsm_drake import BlockError, load_scenario, make_nominal_plant
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.baselines.fixed_time import FixedTime
from ffsm_drake.plugins.baselines.powers import signed_power, slope
from ffsm_drake.plugins.baselines.prescribed_performance import PrescribedPerformance
from ffsm_drake.plugins.baselines.super_twisting import SuperTwisting
from ffsm_drake.plugins.baselines.terminal_sliding_mode import TerminalSlidingMode
from ffsm_drake.systems.controllers import gain_vectors, make_law
from ffsm_drake.systems.controllers.laws.aismc import Aismc
from ffsm_drake.systems.controllers.laws.asmc import Asmc
from ffsm_drake.systems.controllers.laws.tde_aismc import TdeAismc
from ffsm_drake.systems.parts.signals import UNIT

STEP = 1e-4  # s


def dynamics(kind, **gains):
    """The law of one coordinate with its defaults, but for given gains."""
    scenario = load_scenario("postcapture", [f"controller={kind}"])
    own = gain_vectors(scenario, make_nominal_plant(scenario).coordinates)
    values = {key: value[:1] if np.ndim(value) else value for key, value in own.items()}
    values |= {key: np.array([value]) if key in own and np.ndim(own[key]) else value
               for key, value in gains.items()}  # fmt: skip
    law = {
        "super_twisting": SuperTwisting,
        "terminal_sliding_mode": TerminalSlidingMode,
        "fixed_time": FixedTime,
    }[kind]
    more = {} if kind == "fixed_time" else {"sample_time": STEP}
    return law(**values, **more)


def course(law, e, e_dot, duration, disturbance=lambda t: 0.0):
    """e, e' and s (n) of e'' = d - u, with u held over steps of 0.1 ms."""
    state, rows = law.initial_state(), []
    e, e_dot = np.array([e]), np.array([e_dot])
    for k in range(round(duration / STEP)):
        u, state = law.step(e, e_dot, np.zeros(1), state)
        acceleration = disturbance(k * STEP) - u
        rows.append([*e, *e_dot, *state["sliding_variable"]])
        e, e_dot = e + STEP * (e_dot + 0.5 * STEP * acceleration), e_dot + STEP * acceleration
    return np.array(rows).T


def entry(values, size):
    """The time (s) after which values stay below a size."""
    beyond = np.flatnonzero(np.abs(values) > size)
    return (beyond[-1] + 1) * STEP if beyond.size else 0.0


@pytest.mark.smoke
def test_a_regularised_power_and_its_slope():
    x = np.linspace(-3.0, 3.0, 61)
    for power in (0.0, 0.5, 1.5):
        far = np.abs(x) > 1.0
        expected = np.abs(x) ** power * np.sign(x)
        np.testing.assert_allclose(signed_power(x, power, 1e-3)[far], expected[far], rtol=1e-6)
        numeric = (signed_power(x + 1e-6, power, 0.1) - signed_power(x - 1e-6, power, 0.1)) / 2e-6
        np.testing.assert_allclose(slope(x, power, 0.1), numeric, atol=1e-7)
        assert slope(np.zeros(1), power, 0.1)[0] == pytest.approx(0.1 ** (power - 1.0))


@pytest.mark.long
def test_super_twisting_rejects_what_changes_within_its_bound():
    """A disturbance far larger than the law's other terms, whose rate is just below C."""
    bound = 20.0

    def disturbance(t):
        return 30.0 * np.sin(0.6 * t)  # rate 18 rad/s^3

    law = dynamics("super_twisting", width=1e-4)
    e, _, s = course(law, 0.0, 1.0, 6.0, disturbance)
    assert entry(s, 1e-3) < 1.0
    assert np.abs(s[-20000:]).max() < 2e-4
    assert np.abs(e[-10000:]).max() < 1e-4
    # a disturbance that changes faster than the bound drives the sliding variable out
    weak = dynamics("super_twisting", width=1e-4, rate_bound=bound / 4)
    assert np.abs(course(weak, 0.0, 1.0, 6.0, disturbance)[2][-20000:]).max() > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("start", [0.1, 1.0, 10.0])
def test_super_twisting_reaches_in_a_time_that_grows_with_the_root(start):
    law = dynamics("super_twisting", width=1e-5, k_d=0.0)
    time = entry(course(law, 0.0, start, 3.0)[2], 1e-3)
    assert 0.1 < time / np.sqrt(start) < 0.8


@pytest.mark.smoke
def test_terminal_mode_ends_at_the_time_that_its_surface_gives():
    """e(0) on the surface, whose time is |e|^(1 - 1/p) / (B^(1/p) (1 - 1/p))."""
    law = dynamics("terminal_sliding_mode", width_rate=1e-5, width_s=1e-5)
    p, slope_b, start = 1.5, 3.0, 0.5
    expected = start ** (1 - 1 / p) / (slope_b ** (1 / p) * (1 - 1 / p))
    e, _, s = course(law, start, -((slope_b * start) ** (1 / p)), 2 * expected)
    assert np.abs(s).max() < 1e-3
    assert entry(e, 1e-3) == pytest.approx(expected, rel=0.15)
    assert entry(e, 1e-3) < expected


@pytest.mark.long
def test_the_terminal_laws_gain_adapts_to_an_unknown_disturbance():
    def last(**gains):
        law = dynamics("terminal_sliding_mode", width_s=1e-5, k_s=50.0, **gains)
        return np.abs(course(law, 0.0, 0.0, 10.0, lambda t: 0.05 * np.sin(t))[2][-30000:]).max()

    assert last(alpha=0.0) > 8e-4
    assert last() < 0.4 * last(alpha=0.0)


@pytest.mark.long
@pytest.mark.parametrize("start", [0.1, 10.0, 1e4, 1e8])
def test_the_fixed_time_law_settles_within_its_bound_from_anywhere(start):
    law = dynamics("fixed_time")
    near = 2 ** (0.5 * (1 - law.power)) / (1 - law.power)
    reaching, sliding = (
        near / a[0] + 1 / (b[0] * (law.far_power - 1))
        for a, b in ((law.a_2, law.b_2), (law.a_1, law.b_1))
    )
    bound = reaching + sliding
    # on the surface first: e' = -f(e) is followed at steps that suit the start
    e, time, a, b = start, 0.0, law.a_1[0], law.b_1[0]
    while e > law.width[0]:
        rate = a * signed_power(np.array(e), law.power, law.width[0]) + b * e**law.far_power
        step = 1e-3 * e / rate
        e, time = e - step * rate, time + step
    assert time < sliding
    if start <= 10.0:  # the whole law, sampled
        error, _, s = course(law, start, 0.0, bound)
        assert entry(s, law.width_s[0]) < bound
        assert entry(error, 2 * law.width[0]) < bound


def test_the_bound_is_reached_but_for_a_factor():
    """Without boundary layers the largest time is near the sum of both terms."""
    law = dynamics("fixed_time")
    e, time, a, b = 1e12, 0.0, law.a_1[0], law.b_1[0]
    while e > 1e-12:
        rate = a * e**law.power + b * e**law.far_power
        e, time = e - 1e-3 * e, time + 1e-3 * e / rate
    bound = 1 / (a * (1 - law.power)) + 1 / (b * (law.far_power - 1))
    assert 0.5 * bound < time < bound


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("terminal_sliding_mode.power=2.5", "power must be between 1 and 2"),
        ("fixed_time.far_power=0.5", "far_power above"),
    ],
)
def test_powers_out_of_range_are_refused(override, said):
    controller = override.partition(".")[0]
    scenario = load_scenario("postcapture", [f"controller={controller}", f"controllers.{override}"])
    with pytest.raises(BlockError, match=said):
        make_law(make_mission(scenario), make_nominal_plant(scenario))


def exponent(unit, base, law):
    """The power of s or rad in a unit such as "rad^(1-p)/s^(2-p) or m^..."."""
    p, g = (float(np.mean(getattr(law, name, 0.0))) for name in ("power", "far_power"))
    powers = {"": 1.0, "p": p, "g": g, "(p-1)": p - 1.0}
    powers |= {f"({n}-{name})": n - x for n in (1, 2) for name, x in (("p", p), ("g", g))}
    found = 0.0
    for sign, part in zip((1.0, -1.0), unit.partition(" or ")[0].split("/"), strict=False):
        whole = part[1:-1] if part.startswith("(") else part
        for name, _, power in (token.partition("^") for token in whole.split()):
            if name == base:
                found += sign * (powers[power] if power in powers else float(power))
    return found


@pytest.mark.parametrize(
    "law",
    [Asmc, Aismc, TdeAismc, SuperTwisting, TerminalSlidingMode, FixedTime, PrescribedPerformance],
)
@pytest.mark.parametrize(("base", "factor"), [("s", 2.5), ("rad", 0.3)])
def test_units_that_a_law_declares(law, base, factor):
    """Numbers in other units of time or angle change as the units of s, G, K_s and u say."""
    units = {"sample_time": "s", "sliding_variable": law.sliding_unit}
    units |= {"switching_gain": "rad/s^2", "reaching_gain": "1/s", "u": "rad/s^2"}
    units["sliding_variable"] = {UNIT: "rad", f"{UNIT} per s": "rad/s"}[law.sliding_unit]
    gains = {"sample_time": 0.01}
    for field in dataclasses.fields(law):
        if (declared := field.metadata.get("setting")) is not None:
            default = 0.3 if declared.default is None else declared.default
            value = min(default.values()) if isinstance(default, dict) else default
            units[field.name] = declared.unit
            gains[field.name] = value if declared.scalar else np.array([1.0, 2.0]) * value
    gains = {field.name: gains[field.name] for field in dataclasses.fields(law)}

    def last(factor):
        own = law(**gains)

        def of(value, unit):
            return np.asarray(value) * factor ** exponent(unit, base, own)

        own = law(**{name: of(value, units[name]) for name, value in gains.items()})
        state = own.initial_state()
        for _ in range(3):
            signals = of([0.02, -0.03], "rad"), of([0.5, 0.4], "rad/s"), of([0.1, 0.2], "rad/s^2")
            u, state = own.step(*signals, state)
        return {name: state[name] for name in units if name in state} | {"u": u}

    before, after = last(1.0), last(factor)
    assert before["sliding_variable"].all()
    for name, value in before.items():
        unit = factor ** exponent(units[name], base, law(**gains))
        assert after[name] == pytest.approx(unit * value, rel=1e-9), name
