"""Sampled-loop stability: closed forms, and the predictions against the simulated plant."""

import dataclasses

import numpy as np
import pytest
from click.testing import CliRunner
from ffsm_drake.control_design.stability.sampled_loop import (
    LawGains,
    LoopGains,
    Sampling,
    axis_loop,
    axis_poles,
    inertia_ratios,
    largest_sample_time,
    largest_stable_k_s,
    tolerated_eta,
)
from scipy.optimize import brentq

from ffsm_drake import load_scenario, make_nominal_plant, make_true_plant, simulate
from ffsm_drake.cli import main
from ffsm_drake.control_design.stability import (
    StabilityWarning,
    boundaries,
    stability,
    stability_warning,
)
from ffsm_drake.control_design.stability.boundaries import Boundaries
from ffsm_drake.control_design.stability.linearization import Linearizer
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.controllers.filter_gains import kalman_gain

L = 0.01
SAMPLED = Sampling(sample_time=L)
ONE = np.ones(1)
PUBLISHED = LawGains(k_d=100 * ONE, k_p=200 * ONE, integral=True, k_s=80 * ONE, k_s_max=80 * ONE)


@pytest.mark.parametrize(
    ("gains", "expected"),
    [
        (LoopGains(k_v=180.0, k_p=8200.0, k_i=16000.0), [0.97957, -0.73921, 0.54964]),
        (LoopGains(k_v=180.0, k_p=8100.0, k_i=8000.0), [0.98990, -0.73976, 0.54487]),
        (LoopGains(k_v=180.0, k_p=8000.0, k_i=0.0), [-0.74031, 0.54031]),
        (LoopGains(k_v=100.0, k_p=200.0, k_i=0.0), [0.97979, 0.01021]),
    ],
)
def test_poles_at_eta_1(gains, expected):
    poles = axis_poles(gains, eta=1.0, sampling=SAMPLED)
    assert poles[: len(expected)] == pytest.approx(expected, abs=1e-5)
    # the delayed acceleration, cancelled exactly
    assert poles[len(expected) :] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("estimator", ["one_sample", "kalman"])
def test_poles_of_many_axes_are_those_of_each(estimator):
    """Stacked gains, eta and sample times give what the loop of one axis gives for each."""
    sampling = SAMPLED
    if estimator == "kalman":
        gain = kalman_gain(position_noise=1e-5, velocity_noise=1e-4, walk=1e-2, sample_time=L)
        sampling = Sampling(sample_time=L, kalman_gain=gain[None])
    law = LawGains(k_d=20.0, k_p=100.0, integral=True, k_s=None, k_s_max=None)
    k_s, eta, steps = (
        np.linspace(0.5, 30, 6)[:, None, None],
        np.linspace(0.3, 2, 5)[:, None],
        np.array([0.004, 0.02]),
    )
    poles = axis_poles(law.at(k_s), eta=eta, sampling=sampling, sample_time=steps)
    assert poles.shape[:-1] == (6, 5, 2)
    assert (np.abs(poles) < 1).all(axis=-1).any()
    assert (np.abs(poles) > 1).any()
    for i, j, k in np.ndindex(6, 5, 2):
        each = dataclasses.replace(sampling, sample_time=steps[k])
        loop = axis_loop(law.at(k_s[i, 0, 0]), eta=float(eta[j, 0]), sampling=each)
        assert np.abs(poles[i, j, k, 0]) == pytest.approx(loop.spectral_radius, abs=1e-9)


@pytest.mark.parametrize(
    ("eta", "expected"),
    [
        (0.3, 51),
        (0.5, 197),
        (0.7, 271),
        (0.8, 199),
        (0.9, 144),
        (1.0, 99.5),
        (1.05, 80.5),
        (1.1, 63.5),
        (1.2, 33),
    ],
)
def test_largest_stable_k_s(eta, expected):
    limit = largest_stable_k_s(PUBLISHED, 0, eta=eta, sampling=SAMPLED)
    assert limit == pytest.approx(expected, rel=0.0102)
    if eta > 0.6:  # there the pole at z = -1 decides
        assert (100.0 + limit) * L == pytest.approx(2 * (2 - eta) / eta, rel=1e-6)


def test_other_limits_follow_from_the_pole_at_minus_one():
    assert largest_sample_time(PUBLISHED, 0, eta=1.0, sampling=SAMPLED) == pytest.approx(
        2.0 / 180.0, rel=1e-5
    )
    low, high = tolerated_eta(PUBLISHED, 0, sampling=SAMPLED)
    assert high == pytest.approx(4.0 / (2.0 + 180.0 * L), rel=1e-6)
    for eta, stable in (
        (low - 1e-4, False),
        (low + 1e-4, True),
        (high - 1e-4, True),
        (high + 1e-4, False),
    ):
        gains = LoopGains(k_v=180.0, k_p=8200.0, k_i=16000.0)
        assert (np.abs(axis_poles(gains, eta=eta, sampling=SAMPLED)).max() < 1.0) == stable
    # Explicit Euler doubles the room: the limit of the paper's own simulation.
    assert largest_stable_k_s(
        PUBLISHED, 0, eta=1.0, sampling=Sampling(sample_time=L, euler=True)
    ) == pytest.approx(200.0, rel=1e-6)


def at_start(*overrides):
    """Mass matrices of a scenario in its initial posture."""
    scenario = load_scenario("postcapture", overrides)
    nominal, true = make_nominal_plant(scenario), make_true_plant(scenario)
    q = configuration(nominal.plant, scenario.initial_posture, key="initial_posture")
    return true.calc_mass_matrix(q), nominal.calc_mass_matrix(q)


def test_inertia_ratios_are_free_of_units():
    h, h_hat = at_start()
    eta = inertia_ratios(h, h_hat)
    assert eta == pytest.approx(
        np.sort(np.linalg.eigvals(np.linalg.solve(h, h_hat)).real), abs=1e-9
    )
    millimetres = np.diag([1.0] * 3 + [1e3] * 3 + [1.0] * 5)
    assert inertia_ratios(
        millimetres @ h @ millimetres, millimetres @ h_hat @ millimetres
    ) == pytest.approx(eta)
    assert inertia_ratios(h, h) == pytest.approx(np.ones(11))
    # A payload changes ten numbers of a rigid body: at least five modes do not feel it.
    assert np.sum(np.abs(eta - 1.0) < 1e-9) >= 5


HOLD = (
    "target_posture.base_position=[0.1, 0.3, -0.2]",
    "target_posture.base_rpy=[0.11, 0.08, -0.1]",
    *(
        f"target_posture.joints.joint_{i}={np.deg2rad(angle)}"
        for i, angle in enumerate((10, 20, 60, 35, -40), start=1)
    ),
)


@pytest.mark.parametrize(
    "belief",
    [pytest.param(40.0, marks=pytest.mark.slow), 80.0, pytest.param(110.0, marks=pytest.mark.slow)],
)
def test_predicted_boundary_against_the_simulated_plant(belief):
    """3 % inside the predicted K_s the eleven-coordinate plant settles, 3 % outside it the
    oscillation grows.
    """
    payload = [f"payload.nominal.mass={belief}", f"payload.nominal.inertia={[0.167 * belief] * 3}"]
    frozen = [
        "controller=aismc",
        "controllers.aismc.alpha=0",
        "sensing.velocity_noise=0",
        "duration=8",
        *HOLD,
        *payload,
    ]
    with Linearizer(load_scenario("postcapture", frozen)) as linearizer:

        def excess(k_s):
            return (
                linearizer.at(0.0, held={"reaching_gain": np.full(11, k_s)}).spectral_radius - 1.0
            )

        boundary = brentq(excess, 30.0, 300.0, rtol=1e-4)
    growth = {}
    for factor in (0.97, 1.03):
        scenario = load_scenario(
            "postcapture", [*frozen, f"controllers.aismc.k_s_initial={factor * boundary}"]
        )
        record = simulate(scenario, check_stability=False)
        rate = np.abs(record.dataset["error_rate"].values).max(axis=1)
        early = rate[10:60].max()
        growth[factor] = (np.inf if not record.outcome.completed else rate[-100:].max()) / early
    assert growth[0.97] < 0.5, (boundary, growth)
    assert growth[1.03] > 2.0, (boundary, growth)


@pytest.mark.parametrize(
    ("controller", "noise", "duration"),
    [
        pytest.param("tdc", "velocity", 40, marks=pytest.mark.slow),  # the slowest pole
        ("aismc", "velocity", 20),
        pytest.param("aismc", "position", 20, marks=pytest.mark.slow),
    ],
)
def test_noise_amplification_against_the_simulated_plant(controller, noise, duration):
    quiet = {"velocity": "position", "position": "velocity"}[noise]
    sigma = {"velocity": 1e-6, "position": 1e-8}[noise]
    overrides = [
        f"controller={controller}",
        *HOLD,
        f"duration={duration}",
        "disturbance.amplitude_scale=0",
        "controllers.aismc.alpha=0",
        f"sensing.{noise}_noise={sigma}",
        f"sensing.{quiet}_noise=0",
    ]
    scenario = load_scenario("postcapture", overrides)
    with Linearizer(scenario) as linearizer:
        predicted = linearizer.at(0.0).noise_response(scenario.num_control_periods)
    data = simulate(scenario, check_stability=False).dataset.isel(time=slice(500, -1))
    for name in predicted:
        measured = np.sqrt(
            (data[{"force": "generalized_force"}.get(name, name)].values ** 2).mean(axis=0)
        )
        for group in (slice(0, 3), slice(3, 6), slice(6, 11)):
            ratio = np.sqrt(np.mean(measured[group] ** 2)) / np.sqrt(
                np.mean(predicted[name][group] ** 2)
            )
            assert ratio == pytest.approx(1.0, abs=0.1), (name, group)
    assert ("sliding_variable" in predicted) == (controller == "aismc")


def test_noise_figures_of_the_published_gains():
    """White velocity noise sigma costs an rms acceleration command of about 375 sigma (TDC), 1325
    sigma (AISMC).
    """
    published = LoopGains(k_v=180.0, k_p=8200.0, k_i=16000.0)
    for gains, expected in ((LoopGains(k_v=100.0, k_p=100.0, k_i=0.0), 375), (published, 1325)):
        loop = axis_loop(gains, sampling=SAMPLED)
        covariance = loop.covariance(position_noise=0.0, velocity_noise=1.0)
        assert np.sqrt(loop.force @ covariance @ loop.force) == pytest.approx(expected, rel=0.1)


PUBLISHED_UNBOUNDED = ("controllers.tde_aismc.k_s_initial=80", "controllers.tde_aismc.k_s_max=null")


@pytest.mark.parametrize(
    ("name", "overrides", "stable", "words"),
    [
        ("postcapture", (), True, "stable"),
        ("postcapture", ("controller=tdc",), True, "stable"),
        ("postcapture", ("controller=asmc",), True, "stable"),
        (
            "postcapture",
            ("controller=aismc",),
            True,
            "nothing stops K_s before its limit (100.0 1/s",
        ),
        ("paper", (), True, "nothing stops K_s before its limit (200.0 1/s"),
        (
            "postcapture",
            PUBLISHED_UNBOUNDED,
            False,
            "adaptation is expected to take K_s of base_rotation_x past",
        ),
        (
            "postcapture",
            ("payload.nominal.mass=125",),
            False,
            "the sampled loop of tde_aismc has spectral radius 1.",
        ),
        ("postcapture", ("sample_time=0.02", "controller=asmc"), False, "spectral radius"),
    ],
)
def test_verdicts(name, overrides, stable, words):
    margins = stability(load_scenario(name, overrides))
    assert margins.is_stable == stable
    assert words in margins.verdict


@pytest.mark.slow
def test_expected_adaptation_against_simulation(run):
    """The forecast ends within 3 % of the simulated K_s, and puts the published gains' end at about
    the right time.
    """
    for overrides in ((), ("controller=aismc",)):
        scenario = load_scenario("postcapture", overrides)
        simulated = run("postcapture", *overrides).dataset["reaching_gain"].values[-1]
        expected = stability(scenario).axes.forecast_k_s[-1]
        # the joints' errors follow from the motion, which the forecast treats more coarsely
        base = slice(0, 6)
        assert expected[base] == pytest.approx(simulated[base], rel=0.03)
        assert expected == pytest.approx(simulated, rel=0.2)
    axes = stability(load_scenario("postcapture", PUBLISHED_UNBOUNDED)).axes
    first = axes.forecast_times[np.argmax((axes.forecast_k_s > 100.0).any(axis=1))]
    assert first == pytest.approx(run("postcapture", *PUBLISHED_UNBOUNDED).outcome.time, abs=2.0)


def test_simulate_warns_once_and_only_when_there_is_reason(recwarn):
    with pytest.warns(
        StabilityWarning,
        match="K_s is not bounded, but the sampled loop is stable only below about 100",
    ):
        simulate(load_scenario("postcapture", ["duration=0.1", *PUBLISHED_UNBOUNDED]))
    with pytest.warns(StabilityWarning, match="unstable at the starting gains") as caught:
        simulate(load_scenario("postcapture", ["duration=0.1", "payload.nominal.mass=125"]))
    assert len([w for w in caught if w.category is StabilityWarning]) == 1
    for quiet in ([], ["controller=tdc"], ["controller=asmc"]):
        assert stability_warning(load_scenario("postcapture", quiet)) == ""
    bounded = "controllers.tde_aismc.k_s_max="
    assert "may grow to 120 1/s" in stability_warning(
        load_scenario("postcapture", [f"{bounded}120"])
    )
    assert stability_warning(load_scenario("postcapture", [f"{bounded}95"])) == ""


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["stability", "paper", "--controller", "tdc"], 0, "plant explicit Euler"),
        (
            ["stability", "--set", "payload.nominal.mass=125"],
            3,
            "unstable: the sampled loop of tde_aismc",
        ),
        (["stability", "--set", "payload.nominal.mass=1e5"], 3, "spectral radius inf"),
        (["stability", "nowhere"], 2, "error: nowhere: no such scenario; choose one of"),
        (
            ["stability", "--set", "controllers.tdc.kd=1"],
            2,
            "controllers.tdc.kd: unknown gain; tdc has k_d",
        ),
        (
            ["stability", "--set", "controllers.tde_aismc.k_d.joint_9=1"],
            2,
            "joint_9: unknown coordinate",
        ),
        (["stability", "--controller", "pid"], 2, "controller: 'pid' is unknown"),
    ],
)
def test_command_line(arguments, code, words, monkeypatch):
    """The boundaries of a stable loop: ``test_table_and_picture``."""
    if code == 0:
        found = Boundaries(
            gains=1.25, nominal_payload=float("inf"), sample_time=1.25, flexible_mass={}, delay=3.0
        )
        monkeypatch.setattr(boundaries, "find_boundaries", lambda scenario, *, time: found)
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == code, result.output
    assert words in " ".join(result.output.split())
    assert "Traceback" not in result.output


@pytest.mark.slow
def test_table_and_picture(tmp_path):
    from matplotlib import image

    result = CliRunner().invoke(main, ["stability", "--out", str(tmp_path / "new")])
    assert result.exit_code == 0, result.output
    assert "base_rotation_x 60 70 70 100 1.43 12.50" in " ".join(result.output.split())
    pixels = image.imread(tmp_path / "new" / "stability.png")
    assert pixels.shape[1] > 1000
    assert pixels[..., :3].std() > 0.1


def test_picture_of_a_controller_without_reaching_gain():
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from ffsm_drake.show.figures.stability import plot_margins

    figure = plot_margins(stability(load_scenario("postcapture", ["controller=tdc"])))
    assert figure.axes[0].get_ylabel() == "sample time L [ms]"
    figure.set_layout_engine("none")  # half the cost
    figure.set_dpi(30)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    assert np.asarray(canvas.buffer_rgba())[..., :3].std() > 10
