"""Sampled-loop stability: closed forms, and the predictions against the simulated plant."""

import dataclasses

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.optimize import brentq

from ffsm_drake import load_scenario, make_nominal_plant, make_true_plant, simulate
from ffsm_drake.cli import main
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.design.stability import (
    adaptation_remark,
    stability,
)
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.one_axis import (
    axis_loop,
    largest_sample_time,
    largest_stable_k_s,
    of_axes,
    tolerated_eta,
    with_sample_time,
)
from ffsm_drake.plugins.design.verdict import verdict
from ffsm_drake.plugins.estimators.filter_gains import kalman_gain
from ffsm_drake.plugins.estimators.kalman import KalmanEstimator
from ffsm_drake.runs.simulate import StabilityWarning
from ffsm_drake.spacecraft.inertia import inertia_ratios
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.controllers import make_law

L = 0.01


def one_axis(controller, **gains):
    """One axis of a law with the published gains (K_D 100, K_P 200, K_s 80) or others, one-sample
    estimate.
    """
    scenario = load_scenario("postcapture", [f"controller={controller}"])
    law = of_axes(make_law(make_mission(scenario), make_nominal_plant(scenario)).by_axis, [3])
    given = {"k_d": 100.0, "k_p": 200.0, "k_s": 80.0, "k_s_initial": 80.0, "k_s_max": 80.0, **gains}
    own = {
        name: np.array([value])
        for name, value in given.items()
        if name in {field.name for field in dataclasses.fields(law.dynamics)}
    }
    return dataclasses.replace(law, dynamics=dataclasses.replace(law.dynamics, **own))


PUBLISHED = one_axis("aismc")


@pytest.mark.parametrize(
    ("law", "expected"),
    [
        (PUBLISHED, [0.97957, -0.73921, 0.54964]),
        (one_axis("tde_aismc", k_p=100.0), [0.98990, -0.73976, 0.54487]),
        (one_axis("asmc"), [-0.74031, 0.54031]),
        (one_axis("tdc"), [0.97979, 0.01021]),
    ],
)
@pytest.mark.smoke
def test_poles_at_eta_1(law, expected):
    poles = axis_loop(law).poles[0]
    assert poles[: len(expected)] == pytest.approx(expected, abs=1e-5)
    # the delayed acceleration, cancelled exactly
    assert poles[len(expected) :] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("estimator", ["one_sample", "kalman"])
def test_poles_of_many_axes_are_those_of_each(estimator):
    """Stacked gains, eta and sample times give what the loop of one axis gives for each."""
    law = one_axis("aismc", k_d=20.0, k_p=100.0)
    if estimator == "kalman":
        gain = kalman_gain(position_noise=1e-5, velocity_noise=1e-4, walk=1e-2, sample_time=L)
        law = dataclasses.replace(law, estimator=KalmanEstimator(sample_time=L, gain=gain[None]))
    k_s, eta = np.linspace(0.5, 30, 6)[:, None, None, None], np.linspace(0.3, 2, 5)[:, None, None]
    steps = np.array([[0.004], [0.02]])
    many = with_sample_time(law.with_reaching_gain(k_s), steps)
    radius = axis_loop(many, eta=eta).spectral_radius
    assert radius.shape == (6, 5, 2, 1)
    assert (radius < 1).any()
    assert (radius > 1).any()
    for i, j, k in np.ndindex(6, 5, 2):
        each = with_sample_time(law.with_reaching_gain(k_s[i, 0, 0]), steps[k])
        found = axis_loop(each, eta=eta[j, 0]).spectral_radius
        assert radius[i, j, k] == pytest.approx(found, abs=1e-9)


@pytest.mark.smoke
def test_largest_stable_k_s():
    expected = {
        0.3: 51, 0.5: 197, 0.7: 271, 0.8: 199, 0.9: 144, 1.0: 99.5, 1.05: 80.5, 1.1: 63.5, 1.2: 33,
    }  # fmt: skip
    limits = largest_stable_k_s(PUBLISHED, 0, eta=np.array(list(expected)))
    assert limits == pytest.approx(list(expected.values()), rel=0.0102)
    for eta, limit in zip(expected, limits, strict=True):
        if eta > 0.6:  # there the pole at z = -1 decides
            assert (100.0 + limit) * L == pytest.approx(2 * (2 - eta) / eta, rel=1e-6)
    assert np.isnan(largest_stable_k_s(one_axis("tdc"), 0, eta=np.ones(2))).all()


@pytest.mark.smoke
def test_other_limits_follow_from_the_pole_at_minus_one():
    one = np.ones(1)
    assert largest_sample_time(PUBLISHED, 0, eta=one) == pytest.approx(2.0 / 180.0, rel=1e-5)
    low, high = tolerated_eta(PUBLISHED, 0)
    assert high == pytest.approx(4.0 / (2.0 + 180.0 * L), rel=1e-6)
    for eta, stable in (
        (low - 1e-4, False),
        (low + 1e-4, True),
        (high - 1e-4, True),
        (high + 1e-4, False),
    ):
        assert (axis_loop(PUBLISHED, eta=eta).spectral_radius < 1.0) == stable
    # Explicit Euler doubles the room: the limit of the paper's own simulation.
    assert largest_stable_k_s(PUBLISHED, 0, eta=one, euler=True) == pytest.approx(200.0, rel=1e-6)


SAME = ["payload.nominal.mass=100", "payload.nominal.inertia=[16.7, 16.7, 16.7]"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["postcapture", "flight_sensors"])
def test_the_limit_of_one_axis_is_that_of_the_wiring(name):
    """Every K_s held 1 % below and above the limit by axis, with the true payload."""
    scenario = load_scenario(name, ["controller=aismc", *SAME])
    law = make_law(make_mission(scenario), make_nominal_plant(scenario)).by_axis
    limit = min(largest_stable_k_s(law, axis, eta=np.ones(1))[0] for axis in (0, 3, 6))
    with Linearizer(scenario) as linearizer:
        inside, outside = (
            linearizer.at(10.0, held={"reaching_gain": np.full(11, factor * limit)}).spectral_radius
            for factor in (0.99, 1.01)
        )
    assert inside < 1.0 < outside


def at_start(*overrides):
    """Mass matrices of a scenario in its initial posture."""
    scenario = load_scenario("postcapture", overrides)
    nominal, true = make_nominal_plant(scenario), make_true_plant(scenario)
    q = configuration(nominal.coordinates, scenario.initial_posture, key="initial_posture")
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


@pytest.mark.smoke
def test_noise_figures_of_the_published_gains():
    """White velocity noise sigma costs an rms acceleration command of about 375 sigma (TDC), 1325
    sigma (AISMC).
    """
    for law, expected in ((one_axis("tdc", k_p=100.0), 375), (PUBLISHED, 1325)):
        loop = axis_loop(law)
        variance = np.diagonal(loop.covariance(position_noise=0.0, velocity_noise=1.0)[0])
        assert np.sqrt(variance[loop.part("force")]) == pytest.approx(expected, rel=0.1)


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
            "beyond its stability limit of 100.0 1/s",
        ),
        ("paper", (), True, "beyond its stability limit of 200.0 1/s"),
        (
            "postcapture",
            PUBLISHED_UNBOUNDED,
            False,
            "K_s of base_rotation_x is expected to adapt beyond",
        ),
        (
            "postcapture",
            ("payload.nominal.mass=125",),
            False,
            "the sampled loop of tde_aismc at the posture of t = 0.05 s has spectral radius 1.",
        ),
        ("postcapture", ("sample_time=0.02", "controller=asmc"), False, "spectral radius"),
    ],
)
def test_verdicts(name, overrides, stable, words):
    margins = stability(load_scenario(name, overrides))
    assert margins.is_stable == stable
    assert words in margins.verdict


@pytest.mark.long
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


@pytest.mark.long
def test_simulate_warns_once_and_only_when_there_is_reason(recwarn):
    with pytest.warns(
        StabilityWarning,
        match="K_s is not bounded, but the sampled loop is stable only below about 100",
    ):
        simulate(load_scenario("postcapture", ["duration=0.1", *PUBLISHED_UNBOUNDED]))
    with pytest.warns(
        StabilityWarning, match="not expected to go as planned: .*unstable"
    ) as caught:
        simulate(load_scenario("postcapture", ["duration=0.1", "payload.nominal.mass=125"]))
    assert len([w for w in caught if w.category is StabilityWarning]) == 1
    for quiet in ([], ["controller=tdc"], ["controller=asmc"]):
        scenario = load_scenario("postcapture", quiet)
        assert verdict(scenario, rehearsal=False).warnings == []
    bounded = "controllers.tde_aismc.k_s_max="
    for bound, words in ((120, "may grow to 120 1/s"), (95, "")):
        with Linearizer(load_scenario("postcapture", [f"{bounded}{bound}"])) as linearizer:
            told = adaptation_remark(linearizer)
        assert words in told
        assert bool(told) is bool(words)


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["stability", "paper", "--controller", "tdc"], 0, "plant explicit Euler"),
        (
            ["stability", "--set", "payload.nominal.mass=125"],
            3,
            "unstable: the sampled loop of tde_aismc",
        ),
        (
            ["stability", "--set", "payload.nominal.mass=1e5"],
            3,
            "the loop diverges from the plan within 5 samples",
        ),
        (["stability", "nowhere"], 2, "error: nowhere: no such scenario; give a YAML file"),
    ],
)
def test_command_line(arguments, code, words):
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == code, result.output
    assert words in " ".join(result.output.split())
    assert "Traceback" not in result.output


@pytest.mark.long
def test_table_and_picture(tmp_path):
    from matplotlib import image

    result = CliRunner().invoke(main, ["stability", "--limits", "--out", str(tmp_path / "new")])
    assert result.exit_code == 0, result.output
    assert "further sensor delay" in result.output
    assert "base_rotation_x 60 70 70 100 1.43 11.76" in " ".join(result.output.split())
    pixels = image.imread(tmp_path / "new" / "stability.png")
    assert pixels.shape[1] > 1000
    assert pixels[..., :3].std() > 0.1


@pytest.mark.slow
def test_picture_of_a_controller_without_reaching_gain():
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from ffsm_drake.plugins.design.stability_figure import plot_margins

    figure = plot_margins(stability(load_scenario("postcapture", ["controller=tdc"])))
    assert figure.axes[0].get_ylabel() == "sample time L [ms]"
    figure.set_layout_engine("none")  # half the cost
    figure.set_dpi(30)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    assert np.asarray(canvas.buffer_rgba())[..., :3].std() > 10


# A payload taken for four times too heavy, or gains far beyond 2 / L
HOPELESS = {"payload": "payload.nominal.mass=400", "gains": "controllers.{law}.k_d.all=2000"}
SLOW = pytest.mark.slow


def hopeless(law, cause):
    changes = [f"controller={law}", "duration=1", HOPELESS[cause].format(law=law)]
    return load_scenario("postcapture", changes)


@pytest.mark.parametrize(
    ("law", "cause"),
    [
        ("asmc", "payload"),
        ("tdc", "gains"),
        pytest.param("tdc", "payload", marks=SLOW),
        pytest.param("tde_aismc", "payload", marks=SLOW),
        pytest.param("asmc", "gains", marks=SLOW),
        pytest.param("aismc", "gains", marks=SLOW),
    ],
)
def test_margins_where_nothing_is_stable(law, cause):
    """No K_s, no sample time, or no eta: limits of 0, in table and figure."""
    from ffsm_drake.plugins.design.stability_figure import plot_margins
    from ffsm_drake.plugins.design.tables import margins_table

    margins = stability(hopeless(law, cause), postures=3)
    assert not margins.is_stable
    axes = margins.axes
    assert axes.has_k_s == (law != "tdc")
    if cause == "payload":
        assert not axes.sample_time_limit.any()
    if axes.has_k_s:
        assert not axes.k_s_limit.any()
        assert axes.may_leave.all()
    table = margins_table(margins)
    assert "nan" not in table
    limits = table.partition("limits of each coordinate")[2].partition("spectral radius")[0]
    assert (" none" in limits) == np.isnan(axes.eta_tolerated).any()
    assert len(plot_margins(margins).axes) >= 4


@pytest.mark.slow
@pytest.mark.parametrize(("law", "cause"), [("tde_aismc", "payload"), ("tdc", "gains")])
def test_a_report_where_nothing_is_stable(law, cause):
    from ffsm_drake.plugins.design.panels import stability_section
    from ffsm_drake.show.results import results_of

    with pytest.warns(StabilityWarning):
        record = simulate(hopeless(law, cause))
    section = stability_section(results_of([record]))
    assert "unstable" in str(section.html)
    assert len(section.views[0].charts) == 3 + (law != "tdc")
