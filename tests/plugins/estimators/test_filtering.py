"""Filters of the commanded force: their response, what a law hears of them, and what the linear
loop makes of them.
"""

import dataclasses

import numpy as np
import pytest
from refusals import assert_refused

from ffsm_drake import load_scenario, make_closed_loop
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.estimators.filtering import make_filtered
from ffsm_drake.scenario import CommandFilter
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers.law import ControlLaw

PERIOD = 0.01
COORDINATES = Coordinates(("joint",), ("rad",))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tone(ControlLaw):
    """A sine of one frequency on every coordinate, Hz."""

    frequency: float

    def initial_state(self):
        return {"count": np.zeros(7)}

    def step(self, sample, state):
        return np.sin(2 * np.pi * self.frequency * PERIOD * state["count"]), {
            "count": state["count"] + 1.0
        }


def response(settings: CommandFilter, frequency: float) -> np.ndarray:
    """Steady gain and phase (complex, nv) at a frequency, Hz."""
    law = make_filtered(Tone(frequency=frequency), settings, COORDINATES, sample_time=PERIOD)
    state, rows = law.initial_state(), []
    samples = 40 * round(1.0 / (frequency * PERIOD))
    for _ in range(samples):
        force, state = law.step(None, state)
        rows.append(force)
    late = samples // 2
    wave = np.exp(-2j * np.pi * frequency * PERIOD * np.arange(late, samples))
    return 2j * (wave @ np.array(rows)[late:]) / (samples - late)


@pytest.mark.smoke
def test_a_notch_takes_its_frequency_out():
    settings = CommandFilter(notch={"base_rotation": 0.5, "joints": 2.0}, notch_width={"all": 0.5})
    at_half, at_two = response(settings, 0.5), response(settings, 2.0)
    assert np.abs(at_half[:3]).max() < 1e-6
    assert np.abs(at_two[6]) < 1e-6
    assert at_half[3:6] == pytest.approx(1.0)  # no notch
    assert np.abs(at_half[6]) > 0.98
    # At half power where f/f0 - f0/f is the width.
    edge = 0.5 * (0.5 + np.sqrt(0.5**2 + 4.0))
    assert np.abs(response(settings, 0.5 * edge)[0]) == pytest.approx(np.sqrt(0.5), rel=0.02)


@pytest.mark.smoke
def test_a_low_pass_is_a_first_order_lag():
    settings = CommandFilter(low_pass={"joints": 1.0})
    share = 1.0 - np.exp(-2 * np.pi * PERIOD)
    expected = share / (1.0 - (1.0 - share) * np.exp(-2j * np.pi * PERIOD))
    assert response(settings, 1.0)[6] == pytest.approx(expected, rel=1e-4)
    assert response(settings, 1.0)[:6] == pytest.approx(1.0)


def test_without_filters_the_law_is_itself():
    law = Tone(frequency=1.0)
    assert make_filtered(law, CommandFilter(), COORDINATES, sample_time=PERIOD) is law


def test_a_low_pass_is_a_smaller_nominal_inertia_to_time_delay_control(run):
    """tau_k = tau_{k-1} + a Hhat (u - q''): TDC with a Hhat, sample by sample."""
    short = (
        "controller=tdc",
        "duration=0.3",
        "sensing.velocity_noise=0",
        "disturbance.amplitude_scale=0",
    )
    filtered = (
        run("postcapture", *short, "command_filter.low_pass=5").dataset["generalized_force"].values
    )
    share = 1.0 - np.exp(-2 * np.pi * 5.0 * PERIOD)
    scenario = load_scenario("postcapture", [*short])
    loop = make_closed_loop(scenario)
    law = loop.blocks["controller"].law
    data = run("postcapture", *short, "command_filter.low_pass=5").dataset
    force = np.zeros(filtered.shape[1])
    for k in range(1, 20):
        acceleration = (
            data["measured_velocity"].values[k] - data["measured_velocity"].values[k - 1]
        ) / PERIOD
        e, e_dot = data["error"].values[k], data["error_rate"].values[k]
        u, _ = law.dynamics.step(e, e_dot, data["desired_acceleration"].values[k], {})
        inertia = law.model.calc_mass_matrix(data["measured_position"].values[k])
        force = filtered[k - 1] + share * inertia @ (u - acceleration)
        np.testing.assert_allclose(filtered[k], force, rtol=0, atol=1e-9 * np.abs(filtered).max())


def test_the_linear_loop_has_its_phase():
    """An unstable loop with a too large nominal inertia that a low-pass makes stable, and back."""
    heavy = ["controller=tdc", "payload.nominal={mass: 400, inertia: [60, 60, 60]}"]
    radius = {}
    for cut in (0.0, 2.0, 0.05):
        with Linearizer(
            load_scenario("postcapture", [*heavy, f"command_filter.low_pass={cut}"])
        ) as linearizer:
            radius[cut] = linearizer.at(0.0).spectral_radius
    print(radius)
    assert radius[0.0] > 1.0 > radius[2.0]
    assert radius[0.05] > 1.0  # too slow for the gains


def test_a_filter_goes_through_a_grasp(run):
    overrides = [
        "capture.approach=null",
        "controller=tdc",
        "duration=0.3",
        "command_filter.notch=5",
    ]
    record = run("tumbling_capture", *overrides)
    assert record.outcome.completed


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (
            ("command_filter.notch=50",),
            "command_filter.notch.base_rotation_x: must be below half the control rate, 50",
        ),
        (
            ("command_filter.low_pass=-1",),
            "command_filter.low_pass.all: must be >= 0 Hz, not -1",
        ),
        (("command_filter.notch_width=0",), "command_filter.notch_width.all: must be > 0, not 0"),
        (("command_filter.notch.panel=1",), "command_filter.notch.panel: unknown coordinate"),
    ],
)
def test_errors_are_one_clear_line(overrides, expected):
    assert_refused(expected, "postcapture", *overrides)


def test_every_attribute_of_a_law_is_that_of_the_wrapped_law():
    """Whatever attribute ControlLaw has or gets; but the filter is in no loop of separate axes."""
    names = [
        name for name, value in vars(ControlLaw).items()
        if not name.startswith("_") and not callable(value) and not isinstance(value, classmethod)
    ]  # fmt: skip
    kind = type("Own", (Tone,), {name: f"own {name}" for name in names})
    law = make_filtered(
        kind(frequency=1.0), CommandFilter(low_pass={"all": 5.0}), COORDINATES, sample_time=PERIOD
    )
    own = {name: f"own {name}" for name in names} | {"by_axis": None}
    assert {name: getattr(law, name) for name in names} == own
    assert len(names) > 5
