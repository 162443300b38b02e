"""The four laws against hand-derived facts: poles, stability limits, time-delay estimation, signs,
degeneracies.
"""

import dataclasses
import math

import numpy as np
import pytest

from ffsm_drake import load_scenario, make_closed_loop, make_nominal_plant
from ffsm_drake.mission import make_mission
from ffsm_drake.spacecraft.coordinates import error_rate, position_error
from ffsm_drake.systems.controllers import PAPER_LAWS, make_controller, make_law
from ffsm_drake.systems.controllers.law import gains_of
from ffsm_drake.systems.controllers.laws import asmc, tde_aismc
from ffsm_drake.systems.controllers.laws.aismc import Aismc
from ffsm_drake.systems.controllers.laws.asmc import Asmc
from ffsm_drake.systems.controllers.laws.tdc import Tdc
from ffsm_drake.systems.controllers.time_delay import time_delay_force
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.registry import find_factory, shipped_names

PERIOD = 0.01
ONE = np.ones(1)


def tdc_law(k_d=100.0, k_p=200.0):
    return Tdc(k_d=k_d * ONE, k_p=k_p * ONE)


def asmc_law(k_s=80.0):
    zero = 0.0 * ONE
    return Asmc(
        sample_time=PERIOD,
        k_d=100 * ONE,
        k_s=k_s * ONE,
        g_initial=zero,
        epsilon=1e-4,
        a=zero,
        b=ONE,
        g_max=math.inf * ONE,
    )


def aismc_law(k_s=80.0, k_p=200.0):
    zero = 0.0 * ONE
    return Aismc(
        sample_time=PERIOD,
        k_d=100 * ONE,
        k_p=k_p * ONE,
        k_s_initial=k_s * ONE,
        alpha=zero,
        beta=ONE,
        k_s_max=math.inf * ONE,
    )


class AxisLoop:
    """One axis under a sampled law: plant H a = tau - n(t), estimate Hhat = eta H, zero-order hold,
    exact integration.

    ``euler`` integrates the plant as the paper does: position with the old velocity.
    """

    def __init__(self, law, *, eta=1.0, euler=False, lumped=lambda k: 0.0):
        self.law, self.eta, self.euler, self.lumped = law, eta, euler, lumped
        self.q = self.v = self.tau = 0.0
        self.delayed_velocity, self.k = None, 0
        self.state = dict(law.initial_state())
        self.tde_error = []

    def step(self):
        e, e_dot = np.array([-self.q]), np.array([-self.v])
        u, self.state = self.law.step(e, e_dot, np.zeros(1), self.state)
        delayed = (
            0.0 if self.delayed_velocity is None else (self.v - self.delayed_velocity) / PERIOD
        )
        self.delayed_velocity = self.v
        self.tau = time_delay_force(
            delayed_force=np.array([self.tau]),
            nominal_mass_matrix=np.array([[self.eta]]),
            delayed_acceleration=np.array([delayed]),
            u=u,
        )[0]
        a = self.tau - self.lumped(self.k)
        self.tde_error.append(a - u[0])  # N - Nhat, for eta = 1
        self.q += PERIOD * self.v + (0.0 if self.euler else 0.5 * PERIOD**2 * a)
        self.v += PERIOD * a
        self.k += 1


def poles(law):
    """Nonzero eigenvalues of the sampled loop at eta = 1, from its response: with H = Hhat the
    delayed terms cancel.
    """
    size = 2 + (1 if "integral_error" in law.initial_state() else 0)
    columns = []
    for i in range(size):
        loop = AxisLoop(law)
        state = np.zeros(size)
        state[i] = 1e-6
        loop.q, loop.v = -state[0], -state[1]
        if size == 3:
            loop.state["integral_error"] = state[2] * ONE
        loop.step()
        after = [-loop.q, -loop.v] + ([loop.state["integral_error"][0]] if size == 3 else [])
        columns.append(np.array(after) / 1e-6)
    return np.sort(np.linalg.eigvals(np.array(columns).T))


@pytest.mark.parametrize(
    ("law", "expected"),
    [
        (aismc_law(k_p=200.0), [-0.73921, 0.54964, 0.97957]),
        (aismc_law(k_p=100.0), [-0.73976, 0.54487, 0.98990]),
        (asmc_law(), [-0.74031, 0.54031]),
        (tdc_law(k_p=200.0), [0.01021, 0.97979]),
    ],
)
@pytest.mark.smoke
def test_poles_of_the_sampled_loop(law, expected):
    assert poles(law) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("eta", "limit"),
    [(0.3, 51), (0.5, 197), (0.7, 271), (0.9, 144), (1.0, 99.5), (1.2, 33)],
)
def test_largest_stable_reaching_gain(eta, limit):
    """Just inside the limit a disturbance dies out, just outside it grows."""
    for factor, stable in ((0.985, True), (1.015, False)):
        loop = AxisLoop(aismc_law(k_s=factor * limit), eta=eta)
        loop.q, loop.v = 1e-3, 1e-2
        peaks = []
        for _ in range(8):  # long, because just inside the limit the oscillation decays slowly
            speeds = []
            for _ in range(150):
                loop.step()
                speeds.append(abs(loop.v))
            peaks.append(max(speeds))
        assert (peaks[-1] < peaks[1]) == stable, (eta, factor * limit, peaks)


def test_sliding_variable_on_the_euler_plant():
    """s_{k+1} = (1 - K_s L) s_k - L Ntilde_k, exactly."""
    law = aismc_law()
    loop = AxisLoop(law, euler=True, lumped=lambda k: math.sin(0.1 * k))
    loop.q, loop.v = 0.1, -0.2
    s = []
    for _ in range(50):
        loop.step()
        s.append(loop.state["sliding_variable"][0])
    for k in range(49):
        assert s[k + 1] == pytest.approx(
            (1 - 80 * PERIOD) * s[k] - PERIOD * loop.tde_error[k], abs=1e-13
        )


@pytest.mark.parametrize(
    ("lumped", "expected"), [(lambda k: 3.0, 0.0), (lambda k: 0.25 * k, -0.25)]
)
@pytest.mark.smoke
def test_time_delay_estimation_error(lumped, expected):
    """A constant lumped uncertainty is met exactly from the second step; a ramp leaves its
    increment per sample.
    """
    loop = AxisLoop(tdc_law(), lumped=lumped)
    for _ in range(40):
        loop.step()
    assert loop.tde_error[1:] == pytest.approx([expected] * 39, abs=1e-11)


def coordinates_and_laws(**changes):
    scenario = load_scenario(
        "paper", [f"controllers.{key}={value}" for key, value in changes.items()]
    )
    nominal = make_nominal_plant(scenario)
    return nominal.coordinates, {
        name: make_law(
            make_mission(dataclasses.replace(scenario, controller=name)), nominal
        ).dynamics
        for name in PAPER_LAWS
    }


def random_motion(steps=200, scale=1e-4):
    rng = np.random.default_rng(1)
    return rng.normal(size=(steps, 3, 11)) * scale * np.array([1.0, 10.0, 100.0])[:, None]


def run(law, motion, state=None):
    state = dict(law.initial_state()) if state is None else state
    u = []
    for e, e_dot, a_d in motion:
        command, state = law.step(e, e_dot, a_d, state)
        u.append(command)
    return np.array(u), state


def test_without_switching_and_with_law_21_the_proposed_is_aismc_bit_for_bit():
    """K_s held, as (9) and (21) differ; that they are what they are is tested below."""
    held = {f"{name}.alpha": 0 for name in ("aismc", "tde_aismc")}
    _, laws = coordinates_and_laws(**{"tde_aismc.g_initial": 0, "tde_aismc.phi": 0}, **held)
    proposed, _ = run(laws["tde_aismc"], random_motion())
    published, _ = run(laws["aismc"], random_motion())
    assert np.array_equal(proposed, published)


def test_without_reaching_and_switching_the_proposed_is_tdc_bit_for_bit():
    zeros = {f"tde_aismc.{key}": 0 for key in ("g_initial", "phi", "k_s_initial", "alpha")}
    _, laws = coordinates_and_laws(**zeros)
    proposed, _ = run(laws["tde_aismc"], random_motion())
    tdc, _ = run(laws["tdc"], random_motion())
    assert np.array_equal(proposed, tdc)


@pytest.mark.parametrize("name", PAPER_LAWS)
@pytest.mark.smoke
def test_the_force_opposes_the_error(name):
    """q > q_d at rest asks for negative acceleration, in every coordinate."""
    _, laws = coordinates_and_laws()
    u, _ = run(laws[name], [(np.full(11, -0.01), np.zeros(11), np.zeros(11))])
    assert (u < 0).all()


@pytest.mark.parametrize("name", PAPER_LAWS)
def test_permuting_the_coordinates_permutes_everything(name):
    _, laws = coordinates_and_laws()
    law, order = laws[name], np.random.default_rng(2).permutation(11)
    permuted = dataclasses.replace(
        law,
        **{
            field.name: getattr(law, field.name)[order]
            for field in dataclasses.fields(law)
            if isinstance(getattr(law, field.name), np.ndarray)
        },
    )
    u, state = run(law, random_motion())
    u_permuted, state_permuted = run(permuted, random_motion()[..., order])
    assert np.array_equal(u[:, order], u_permuted)
    for key, value in state.items():
        assert np.array_equal(value[order], state_permuted[key])


@pytest.mark.parametrize("name", ["asmc", "aismc", "tde_aismc"])
@pytest.mark.parametrize("scale", [1e-9, 1e-5, 1e-2, 0.0])
def test_gains_never_become_negative_or_infinite(name, scale):
    _, laws = coordinates_and_laws()
    law = laws[name]
    state = dict(law.initial_state())
    for e, e_dot, a_d in random_motion(scale=scale):
        _, state = law.step(e, e_dot, a_d, state)
        for label, value in state.items():
            assert np.isfinite(value).all()
            if label.endswith("gain"):
                assert (value >= 0).all(), label


def test_upper_bounds_hold():
    _, laws = coordinates_and_laws(
        **{
            "tde_aismc.k_s_max": 81,
            "tde_aismc.g_max": 3e-4,
            "aismc.k_s_max.joint_2": 82,
            "asmc.g_max": 1e-9,
        }
    )
    bounded = (
        ("tde_aismc", "reaching_gain", 81),
        ("tde_aismc", "switching_gain", 3e-4),
        ("asmc", "switching_gain", 1e-9),
    )
    for name, label, bound in bounded:
        law = laws[name]
        _, state = run(law, random_motion(scale=1e-2))
        assert state[label] == pytest.approx(np.full(11, bound))
    _, state = run(laws["aismc"], random_motion(scale=1e-2))
    assert state["reaching_gain"][7] == 82.0
    assert state["reaching_gain"][6] > 82.0


@pytest.mark.parametrize("name", ["aismc", "tde_aismc"])
def test_reaching_gains_rest_at_their_threshold(name):
    law = coordinates_and_laws()[1][name]
    k_s, beta, alpha = 80.0, 4e7, 3e4
    threshold = {"tde_aismc": k_s / beta, "aismc": k_s**2 / beta}[name]
    all_of, none = np.ones(law.k_d.shape), np.zeros(law.k_d.shape)
    law = dataclasses.replace(law, alpha=alpha * all_of, beta=beta * all_of, k_s_max=1e3 * all_of)
    start = law.initial_state() | {"reaching_gain": k_s * all_of}
    for s, expected in ((1.0, 0.0), (-1.01, 1.01 * alpha), (0.99, -0.99 * alpha)):
        _, state = law.step(none, s * threshold * all_of, none, start)
        change = (state["reaching_gain"] - k_s) / law.sample_time
        assert change == pytest.approx(expected * threshold, abs=1e-9)


def test_switching_gain_law_10():
    phi, g = np.array([0.1, 0.1, 0.01]), np.array([1e-4, 0.0, 1e-4])
    above = tde_aismc.switching_gain_rate(np.array([-2e-4, 0, 1e-5]), g, phi=phi, epsilon=1e-4)
    assert above == pytest.approx([2e-5, 1e-5, 1e-7])
    below = tde_aismc.switching_gain_rate(np.array([-5e-5, 0, 1e-5]), g, phi=phi, epsilon=1e-4)
    assert below == pytest.approx([-5e-6, 1e-5, -1e-7])


def test_switching_gain_law_19():
    a, b, g = np.full(3, 1e-6), np.full(3, 1e5), np.array([1e-4, 0.0, 1e-4])
    above = asmc.switching_gain_rate(np.array([-2e-4, 1e-5, 0]), g, a=a, b=b, epsilon=1e-4)
    assert above == pytest.approx([2e-5, 1e-6, 0])
    below = asmc.switching_gain_rate(np.array([-5e-5, 1e-5, 0]), g, a=a, b=b, epsilon=1e-4)
    assert below[:2] == pytest.approx([-1e-6 / 5, 1e-6])
    assert below[2] < -1e3  # s = 0: finite, and enough to clip G at zero at once


@pytest.mark.smoke
def test_published_gains_are_those_of_section_4():
    coordinates, laws = coordinates_and_laws()
    position, rotation, joints = (
        coordinates.groups[name] for name in ("base_position", "base_rotation", "joints")
    )
    law = laws["tde_aismc"]
    expected = {
        "k_d": (100, 100, 100),
        "k_p": (200, 100, 100),
        "k_s_initial": (80, 80, 80),
        "g_initial": (2e-4, 2e-4, 2e-4),
        "alpha": (3e4, 18e4, 9e4),
        "beta": (4e7, 24e7, 12e7),
        "phi": (1e-2, 1e-1, 1e-1),
    }
    for name, values in expected.items():
        for group, value in zip((position, rotation, joints), values, strict=True):
            assert getattr(law, name)[group] == pytest.approx(value), name
    assert laws["asmc"].a[position] == pytest.approx(1e-7)
    assert laws["asmc"].a[rotation] == pytest.approx(1e-6)
    assert laws["asmc"].b == pytest.approx(1e5)
    assert (law.epsilon, laws["asmc"].epsilon) == (1e-4, 1e-4)


@pytest.mark.parametrize("name", PAPER_LAWS)
def test_ports_and_state_of_the_leaf_system(name):
    scenario = load_scenario("postcapture", [f"controller={name}"])
    controller = make_controller(make_mission(scenario), make_nominal_plant(scenario))
    inputs = {
        controller.get_input_port(i).get_name(): controller.get_input_port(i).size()
        for i in range(3)
    }
    assert inputs == {"estimated_state": 23, "desired_state": 23, "desired_acceleration": 11}
    assert controller.GetOutputPort("generalized_force").size() == 11
    optional = {"tdc": set(), "asmc": {"sliding_variable", "switching_gain"}}
    optional["aismc"] = {"sliding_variable", "reaching_gain"}
    optional["tde_aismc"] = {"sliding_variable", "reaching_gain", "switching_gain"}
    found = {controller.get_output_port(i).get_name() for i in range(controller.num_output_ports())}
    assert found == {"generalized_force"} | optional[name]
    # The held output must not make the integrator's stages call Python.
    assert not controller.HasAnyDirectFeedthrough()
    assert controller.GetUniquePeriodicDiscreteUpdateAttribute().period_sec() == PERIOD


def test_first_update_takes_no_acceleration_and_no_previous_force():
    """tau_0 = Hhat u_0, although the base already moves."""
    scenario = load_scenario("postcapture", ["controller=tdc"])
    loop = make_closed_loop(scenario)
    controller, coordinates = loop.blocks["controller"], loop.coordinates
    motion = make_motion(make_mission(loop.scenario))
    context = controller.CreateDefaultContext()
    q, v, _ = motion.evaluate(5.0)
    q_d, v_d, a_d = motion.evaluate(6.0)
    controller.GetInputPort("estimated_state").FixValue(context, np.concatenate([q, v]))
    controller.GetInputPort("desired_state").FixValue(context, np.concatenate([q_d, v_d]))
    controller.GetInputPort("desired_acceleration").FixValue(context, a_d)
    updated = controller.EvalUniquePeriodicDiscreteUpdate(context)
    nominal = make_nominal_plant(scenario)
    k_p = coordinates.vector({"all": 100.0, "base_position": 200.0}, key="")
    e = position_error(q_d, q)
    u = a_d + 100.0 * error_rate(e, v_d, v) + k_p * e
    first = np.array(updated.value(0))
    assert first == pytest.approx(nominal.calc_mass_matrix(q) @ u)
    # The second update, everything unchanged, sees zero acceleration and adds the same again.
    context.SetDiscreteState(updated)
    assert controller.EvalUniquePeriodicDiscreteUpdate(context).value(0) == pytest.approx(2 * first)


@pytest.mark.parametrize("name", shipped_names("controller"))
def test_starting_gains_are_declared(name):
    kind = find_factory("controller", name)
    matrices = np.tile(np.diag(np.arange(1.0, 12.0)), (2, 1, 1))
    gains = kind.starting_gains(np.full(11, 10.0), matrices)
    assert set(gains) <= set(gains_of(kind))
    assert all(np.min(value) > 0.0 for value in gains.values())


def test_starting_gains_of_pd_plus_are_slow_for_every_mass_matrix():
    """No pole of H^-1 K_D is faster than 2 w, w being twice the natural frequency."""
    factors = np.random.default_rng(1).normal(size=(5, 11, 11))
    matrices = factors @ factors.swapaxes(1, 2) + np.eye(11)
    k_d = find_factory("controller", "pd_plus").starting_gains(np.full(11, 10.0), matrices)["k_d"]
    for mass_matrix in matrices:
        rates = np.linalg.eigvals(np.linalg.solve(mass_matrix, np.diag(k_d))).real
        assert rates.max() <= 40.0 * (1.0 + 1e-9)


@pytest.mark.parametrize(
    ("overrides", "walks"),
    [
        (["estimator.kind=kalman"], ("walk",)),
        (["estimator.kind=coupled"], ("walk", "force_walk")),
        (["estimator.kind=one_sample"], ()),
        (["controller=pd_plus"], ()),
    ],
)
def test_random_walks_that_are_designed(overrides, walks):
    scenario = load_scenario("flight_sensors", overrides)
    law = make_law(make_mission(scenario), make_nominal_plant(scenario))
    assert law.random_walks == walks
    assert all(hasattr(scenario.estimator, name) for name in walks)
