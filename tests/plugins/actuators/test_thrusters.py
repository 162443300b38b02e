"""Thrusters: allocation against a linear program, pulses, what the plant gets of them, and
failures.
"""

import dataclasses
import functools
import itertools
import json
import re

import flight_settings
import numpy as np
import pytest
from balances import assert_momentum_follows
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.common.eigen_geometry import Quaternion
from refusals import assert_refused
from rigid_bus import stepped
from scipy.integrate import solve_ivp
from scipy.optimize import linprog
from scipy.signal import lsim
from scipy.spatial.transform import Rotation

from ffsm_drake import FfsmError, load_scenario, simulate
from ffsm_drake.common.numbers import NONE, number
from ffsm_drake.plugins.actuators.allocation import Allocation, lost_direction
from ffsm_drake.plugins.actuators.modulation import (
    SchmittTrigger,
    mean_level,
    pulse_widths,
    whole_frames,
)
from ffsm_drake.plugins.actuators.row import make_base_actuators
from ffsm_drake.plugins.actuators.thrusters import STANDARD_GRAVITY, ThrusterSet
from ffsm_drake.plugins.design.remarks import uneven_remarks
from ffsm_drake.plugins.report.comparison import rankings, table
from ffsm_drake.plugins.report.page import render_report
from ffsm_drake.plugins.report.part_panels import part_views
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.scenario import Thrusters, thruster_layouts, thrusters_of
from ffsm_drake.show.results import results_of
from ffsm_drake.show.tables import results_table
from ffsm_drake.spacecraft.plant import coordinates_of, make_plant
from ffsm_drake.systems.controllers import ControlLaw
from ffsm_drake.systems.parts.signals import pulses_of

LAYOUTS = tuple(thruster_layouts())
SHORT = (*flight_settings.FLIGHT, *flight_settings.NO_NOISE, "duration=2")
BASE = [f"base_{part}_{axis}" for part in ("rotation", "position") for axis in "xyz"]


def wrenches_of(layout):
    """Torque and force (6, n) of each thruster at 1 N, its largest force (n), and the propellant
    per impulse (n).
    """
    units = thrusters_of(Thrusters(layout=layout)).values()
    columns = []
    for unit in units:
        force = np.array(unit.direction) / np.linalg.norm(unit.direction)
        columns.append(np.r_[np.cross(unit.position, force), force])
    figures = np.array([(unit.force, 1 / unit.specific_impulse) for unit in units])
    return np.array(columns).T, *figures.T


def largest_part(wrenches, wanted, bounds):
    """The share of a wrench that thrusters within ``bounds`` can give, by a linear program."""
    columns, none = np.c_[wrenches, -wanted], np.zeros(len(bounds))
    best = linprog([*none, -1.0], A_eq=columns, b_eq=np.zeros(6), bounds=[*bounds, (0.0, 1.0)])
    return best.x[-1]


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.smoke
def test_allocation_takes_the_least_propellant(layout):
    wrenches, largest, cost = wrenches_of(layout)
    allocation = Allocation(wrenches, largest=largest, cost=cost)
    random = np.random.default_rng(0)
    parts = []
    for _ in range(40):
        wrench = random.normal(size=6) * largest[0] * random.choice([0.1, 1.0, 3.0])
        forces, part = allocation.solve(wrench)
        parts.append(part)
        assert wrenches @ forces == pytest.approx(part * wrench, abs=1e-7 * largest[0])
        assert (forces >= 0.0).all()
        assert (forces <= largest * (1 + 1e-9)).all()
        bounds = [(0, bound) for bound in largest]
        assert part == pytest.approx(largest_part(wrenches, wrench, bounds), rel=1e-6)
        least = linprog(cost, A_eq=wrenches, b_eq=part * (1 - 1e-9) * wrench, bounds=bounds)
        assert cost @ forces == pytest.approx(least.fun, rel=1e-5)
    assert min(parts) < 0.9
    assert max(parts) == 1.0


@pytest.mark.parametrize("layout", LAYOUTS)
def test_rounding_does_not_choose_among_equally_cheap_thrusters(layout):
    """Within the limits and beyond them, along axes of symmetry too."""
    wrenches, largest, cost = wrenches_of(layout)
    allocation, random = Allocation(wrenches, largest=largest, cost=cost), np.random.default_rng(1)
    for _ in range(100):
        wrench = random.normal(size=6) * random.choice([0.0, 1.0], size=6)
        wrench *= largest[0] * random.choice([0.1, 1.0, 3.0, 30.0])
        rounded = wrench * (1.0 + 1e-12 * random.normal(size=6))
        once, again = allocation.solve(wrench)[0], allocation.solve(rounded)[0]
        assert again == pytest.approx(once, abs=1e-6 * largest[0]), wrench


@pytest.mark.slow
@settings(derandomize=True, database=None, deadline=None, max_examples=40)
@given(st.tuples(*[st.floats(-4.0, 0.0)] * 3), st.integers(0, 2**32 - 1))
def test_the_largest_wrench_is_found_however_short_the_arms(powers, number):
    """Against a linear program of its own; a wrench that is hard to give is no zero."""
    random, count = np.random.default_rng(number), 12
    arms = np.tile(random.normal(size=(6, 3)) * 10.0 ** np.array(powers), (2, 1))
    forces = random.normal(size=(6, 3))
    forces = np.vstack([forces, 1e-3 * random.normal(size=(6, 3)) - forces])  # nearly opposite
    forces /= np.linalg.norm(forces, axis=1)[:, None]
    wrenches, largest = np.vstack([np.cross(arms, forces).T, forces.T]), random.uniform(1, 5, count)
    try:
        allocation = Allocation(wrenches, largest=largest, cost=np.ones(count))
    except ValueError:  # some wrench cannot be given, or hardly
        return
    beyond = 10.0 * largest.sum()
    for wrench in beyond * np.vstack([np.eye(6), -np.eye(6)]):
        best = largest_part(wrenches, wrench, [(0, bound) for bound in largest])
        assert allocation.solve(wrench)[1] == pytest.approx(best, rel=0.02, abs=1e-9)


@pytest.mark.parametrize("layout", LAYOUTS)
@given(force=st.floats(0.1, 50.0), sides=st.lists(st.floats(0.1, 10.0), min_size=3, max_size=3))
def test_a_layout_is_scaled(layout, force, sides):
    scaled = thrusters_of(Thrusters(layout=layout, force=force, box=sides))
    for name, unit in thruster_layouts()[layout].items():
        assert scaled[name].force == force
        assert scaled[name].direction == unit.direction
        # shares of the sides of the shipped base
        shares = np.array(unit.position) / [1.2, 1.2, 1.9]
        np.testing.assert_allclose(scaled[name].position, shares * sides, rtol=1e-14)


@pytest.mark.parametrize("key", ["force=3", "box=[1,1,1]"])
def test_only_a_layout_is_scaled(key):
    given = ["actuation.thrusters.layout=null", f"actuation.thrusters.{key}"]
    unit = "actuation.thrusters.units={a: {force: 2.0}}"
    expected = f"thrusters.{key.partition('=')[0]}: has no effect without a layout"
    assert_refused(expected, "thrusters_only", *given, unit)


@pytest.mark.parametrize(("layout", "failures"), [("12x5N", 1), ("16x22N", 2)])
def test_layouts_tolerate_failures(layout, failures):
    wrenches, largest, _ = wrenches_of(layout)
    for failed in itertools.combinations(range(largest.size), failures):
        assert lost_direction(np.delete(wrenches, failed, axis=1)) is None


@pytest.mark.parametrize(
    ("layout", "failures"),
    [
        ("16x22N", {"top_1_x": "stuck_on"}),
        ("16x22N", {"top_1_x": "stuck_off", "bottom_2_y": "stuck_on"}),
    ],
)
def test_beside_a_thruster_that_is_stuck_on_a_wrench_keeps_its_direction(layout, failures):
    """With it the others give the largest multiple of what is wanted, not more than once."""
    settings = Thrusters(layout=layout, failures=failures)
    thrusters = ThrusterSet(settings, sample_time=0.01)
    wrenches, largest, _ = wrenches_of(layout)
    states = np.array([failures.get(name) for name in thrusters.names])
    stuck = largest * (states == "stuck_on")
    bounds = np.column_stack([stuck, largest * (states != "stuck_off")])
    rng, parts = np.random.default_rng(0), []
    for _ in range(40):
        wanted = rng.normal(size=6) * 10 ** rng.uniform(-1.0, 2.5)
        memory = thrusters.allocate(wanted, thrusters.initial_memory())
        firing, _ = thrusters.fire(memory)
        assert firing.given == memory["given"]
        parts.append(firing.given)
        total = wrenches @ (memory["wanted"] + stuck)
        assert total == pytest.approx(firing.given * wanted, abs=1e-6)
        assert firing.given == pytest.approx(largest_part(wrenches, wanted, bounds), abs=1e-6)
        if firing.given < 1.0:
            assert thrusters.most(wanted) == pytest.approx(firing.given, rel=1e-6)
    assert min(parts) < 0.2
    assert max(parts) == 1.0


@pytest.mark.parametrize("failures", [{}, {"top_1_x": "stuck_on"}])
def test_however_large_a_wrench_all_that_can_be_given_is(failures):
    thrusters = ThrusterSet(Thrusters(layout="16x22N", failures=failures), sample_time=0.01)
    direction = np.array([1.0, -2.0, 3.0, 2.0, -1.0, 1.0])
    sizes = (1e2, 1e4, 1e6, 1e9, 1e300)
    start = thrusters.initial_memory()
    memories = [thrusters.allocate(size * direction, start) for size in sizes]
    most = thrusters.most(direction)
    for size, memory in zip(sizes, memories, strict=True):
        assert size * memory["given"] == pytest.approx(most, rel=1e-6)
        assert memory["wanted"] == pytest.approx(memories[0]["wanted"], abs=1e-5)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Failing(ControlLaw):
    """No force, from a sample on one that is not a number, or infinite."""

    torque: float

    def initial_state(self):
        return {"samples": np.zeros(1)}

    def step(self, sample, state):
        force = np.zeros_like(sample.v)
        if state["samples"] >= 30:
            force[2] = self.torque
        return force, {"samples": state["samples"] + 1}


@pytest.mark.parametrize("modulator", ["sigma_delta", "pulse_width", "pwpf"])
@pytest.mark.parametrize("torque", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["thrusters_only", "thrusters_and_wheels"])
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_wrench_that_is_not_finite_is_a_run_that_diverged(name, torque, modulator):
    overrides = ["duration=1", f"actuation.thrusters.modulator={modulator}"]
    scenario = load_scenario(name, overrides)
    log = Rollout(scenario, blocks={"controller": lambda setup: Failing(torque=torque)}).run()
    assert log.outcome.status == "diverged"
    assert 0.29 < log.outcome.time < 0.35


@pytest.mark.parametrize("force", [100.0, 1e6, 1e12])
def test_the_commanded_force_takes_what_of_it_is_given(force):
    """Far beyond the thrusters, too, a lower bound of their propellant."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Pushing(ControlLaw):
        def step(self, sample, state):
            wanted = np.zeros_like(sample.v)
            wanted[3:6] = force, -2.0 * force, 0.0
            return wanted, state

    scenario = load_scenario("thrusters_only", ["duration=0.6"])
    record = simulate(scenario, blocks={"controller": lambda setup: Pushing()})
    figures = record.metrics["thrusters"]
    assert figures["saturated"] > 0.5
    assert 0.3 * figures["propellant"] < figures["propellant_of_force"] <= figures["propellant"]


@functools.cache
def base_actuators(name, modulator):
    scenario = load_scenario(name, [f"actuation.thrusters.modulator={modulator}"])
    coordinates = coordinates_of(make_plant(scenario.model))
    return make_base_actuators(scenario.actuation, coordinates, sample_time=0.01)


@given(
    command=st.lists(st.floats(), min_size=11, max_size=11),
    name=st.sampled_from(["thrusters_only", "thrusters_and_wheels"]),
    modulator=st.sampled_from(["sigma_delta", "pulse_width", "pwpf"]),
)
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_any_command_gives_forces_or_none(command, name, modulator):
    """Of any size, infinite or no number: two samples of it overflow nowhere."""
    base = base_actuators(name, modulator)
    memory = base.start()
    for _ in range(2):
        sample, memory = stepped(base, np.array(command), memory)
    wrench_is_known = (np.abs(command[:6]) < 1e300).all()
    assert np.isfinite(sample["applied_force"][:6]).all() == wrench_is_known


def test_a_lost_direction_is_one_that_no_thruster_helps_along():
    wrenches, *_ = wrenches_of("12x5N")
    lost = lost_direction(np.delete(wrenches, [0, 3], axis=1))  # both that push along -x
    assert lost[3] < -0.5
    assert (np.delete(wrenches, [0, 3], axis=1).T @ lost <= 1e-9).all()


@pytest.mark.smoke
def test_open_times():
    share = np.array([0.0, 0.04, 0.06, 0.2, 0.5, 0.8, 1.0])
    assert whole_frames(share, frame=0.02, threshold=0.5).tolist() == [0, 0, 0, 0, 0.02, 0.02, 0.02]
    assert whole_frames(share, frame=0.02, threshold=0.8).tolist() == [0, 0, 0, 0, 0, 0.02, 0.02]
    assert pulse_widths(share, frame=0.2, minimum=0.02) == pytest.approx(
        [0, 0, 0.02, 0.04, 0.1, 0.16, 0.2]
    )


@pytest.mark.parametrize(("rise", "fall"), [(0.004, 0.009), (0.0, 0.0), (0.05, 0.0)])
def test_mean_level_is_the_exact_mean(rise, fall):
    level, opened, period = np.array([0.0, 0.3, 1.0]), np.array([0.006, 0.0, 0.01]), 0.01
    mean, end = mean_level(level, opened, sample_time=period, rise=rise, fall=fall)
    for i in range(3):
        parts = [(opened[i], 1.0, max(rise, 1e-6)), (period - opened[i], 0.0, max(fall, 1e-6))]
        y, total = level[i], 0.0
        for length, target, constant in parts:
            if length > 0.0:
                path = solve_ivp(
                    lambda _, x, target=target, rate=1 / constant: [rate * (target - x[0]), x[0]],
                    (0, length), [y, 0.0], method="Radau", rtol=1e-9, atol=1e-12,
                )  # fmt: skip
                y, total = path.y[0, -1], total + path.y[1, -1]
        assert mean[i] == pytest.approx(total / period, abs=2e-4)
        assert end[i] == pytest.approx(y, abs=1e-6)


def test_schmitt_trigger_is_its_filter_with_hysteresis():
    trigger = SchmittTrigger(gain=10.0, time_constant=0.2, on=0.25, off=0.15, sample_time=0.01)
    share, filtered, is_on, fired, heard = np.array([0.3]), np.zeros(1), np.zeros(1), [], []
    for _ in range(300):
        heard.append(share - is_on)
        filtered, is_on = trigger.step(share, filtered, is_on)
        fired.append([filtered, is_on])
    time, heard = np.arange(301) * 0.01, np.ravel([*heard, heard[-1]])
    _, output, _ = lsim(([10.0], [0.2, 1.0]), heard, time, interp=False)
    states, on = np.array(fired)[..., 0].T
    assert states == pytest.approx(output[1:], abs=1e-9)
    assert (states[on > 0] > 0.15).all()
    assert (states[on == 0] < 0.25).all()
    assert on.mean() == pytest.approx(0.3, abs=0.02)


def middle_rotation(data, k, period):
    q, w = data["position"].values[k, :4], data["velocity"].values[k, :3]
    return (
        Rotation.from_rotvec(0.5 * period * w).as_matrix()
        @ Quaternion(q / np.linalg.norm(q)).rotation()
    )


@pytest.mark.parametrize(
    ("layout", "overrides"),
    [
        ("12x5N", ()),
        ("16x22N", ("actuation.thrusters.modulator=pulse_width", "actuation.thrusters.frame=10")),
        ("16x22N", ("actuation.thrusters.modulator=pwpf", "actuation.thrusters.rise_time=0.003")),
        ("12x1N", ("actuation.thrusters.frame=3", "actuation.thrusters.fall_time=0.01")),
    ],
)
def test_the_plant_gets_what_fires(run, layout, overrides):
    """The applied wrench is that of the recorded firing, and momentum follows its impulse."""
    record = run(*SHORT, f"actuation.thrusters.layout={layout}", *overrides)
    data, period = record.dataset, 0.01
    wrenches, largest, _ = wrenches_of(layout)
    fired = data["thruster_force"].values
    applied = data["applied_force"].sel(coordinate=BASE).values
    for k in range(0, 200, 7):
        turned = (wrenches @ fired[k]).reshape(2, 3) @ middle_rotation(data, k, period).T
        assert applied[k] == pytest.approx(turned.ravel(), abs=1e-9)
    impulse = np.abs(fired).sum() * period
    assert impulse > 1.0
    assert_momentum_follows(data, 1e-9 * impulse)
    others = data["coordinate"].values[6:]
    commanded = data["generalized_force"].sel(coordinate=others)
    assert np.array_equal(commanded, data["applied_force"].sel(coordinate=others))
    figures = record.metrics["thrusters"]
    assert figures["shortest_pulse"] >= 0.02 * (1 - 1e-9)
    assert sum(figures["impulse"].values()) == pytest.approx(fired[:-1].sum() * period)
    isp = np.array([unit.specific_impulse for unit in thruster_layouts()[layout].values()])
    assert figures["propellant"] == pytest.approx(
        (fired[:-1].sum(axis=0) / isp).sum() * period / STANDARD_GRAVITY
    )
    assert figures["propellant"] > figures["propellant_of_force"] > 0.0
    assert largest.min() * (1 + 1e-9) >= fired.max()


def test_sigma_delta_owes_less_than_a_pulse(run):
    """The impulse that was commanded and not fired stays below a threshold of every pulse and a
    frame's command.
    """
    record = run(*SHORT, "actuation.thrusters.layout=16x22N")
    data = record.dataset
    missing = (data["generalized_force"] - data["applied_force"]).sel(coordinate=BASE)
    owed = 0.01 * missing.cumsum("time").values
    wrenches, largest, _ = wrenches_of("16x22N")
    pulse = 0.02 * largest[0] * np.abs(wrenches).sum(axis=1)
    assert record.metrics["thrusters"]["saturated"] == 0.0
    command = np.abs(data["generalized_force"].values[:, :6]).max(axis=0)
    assert (np.abs(owed) <= 0.8 * pulse + 0.02 * command).all()
    assert np.abs(owed).max() > 0.05


def test_pulses_of_a_valve():
    starts, lengths = pulses_of(np.array([0, 1, 1, 0.5, 1, 1, 0, 0.3, 0.4, 0]), 0.01)
    assert starts.tolist() == [1, 4, 7, 8]
    assert lengths == pytest.approx([0.025, 0.02, 0.003, 0.004])
    assert pulses_of(np.zeros(3), 0.01)[1].size == 0


def left_out(_):
    raise FfsmError("left out")


def test_failures_are_known(run):
    failures = "actuation.thrusters.failures={top_1_x: stuck_off, bottom_2_y: stuck_on}"
    record = run(*SHORT, "actuation.thrusters.layout=16x22N", failures)
    opened = record.dataset["thruster_open"]
    assert not opened.sel(thruster="top_1_x").any()
    assert (opened.sel(thruster="bottom_2_y") == 1.0).all()
    assert record.dataset["thruster_force"].sel(thruster="bottom_2_y").values == pytest.approx(22.0)
    assert record.metrics["peak_error"]["base_position"] < 5e-3


def test_the_report_draws_every_pulse(run, monkeypatch):
    for section in ("analysis.page.analyze", "design.panels.stability"):  # cost most of it
        monkeypatch.setattr(f"ffsm_drake.plugins.{section}", left_out)
    record = run(*SHORT, "actuation.thrusters.layout=12x5N")
    (view,) = part_views(results_of([record]), "Actuators")
    (panel,) = view.charts
    figures, drawn = record.metrics["thrusters"], {}
    for trace in panel.curves:
        boxes = np.reshape(trace.x, (-1, 6))
        drawn[trace.name] = (len(boxes), (boxes[:, 2] - boxes[:, 0]).sum())
        assert np.ptp(np.reshape(trace.y, (-1, 6))[:, :5], axis=1) == pytest.approx(
            0.4
        )  # seen where they are narrower than a pixel
    assert {name: number for name, (number, _) in drawn.items()} == pytest.approx(
        figures["pulses"], abs=1
    )
    assert {name: total for name, (_, total) in drawn.items()} == pytest.approx(
        figures["on_time"], abs=0.011
    )
    page = render_report([record])
    assert ">Actuators<" in page
    assert f"{1e3 * figures['propellant']:.3g} g of propellant" in page
    assert f'<td class="text">a_x</td><td>{number(figures["impulse"]["a_x"])}</td>' in page


def test_a_comparison_shows_and_ranks_propellant(run):
    few = run(*SHORT, "actuation.thrusters.layout=12x5N")
    many = run(*SHORT, "actuation.thrusters.layout=12x5N", "disturbance.amplitude_scale=4")
    without = run(*SHORT)
    taken = [1e3 * record.metrics["thrusters"]["propellant"] for record in (few, many)]
    assert taken[0] < taken[1]
    results = results_of([many, without, few])
    (ranking,) = (each for each in rankings(results) if each["title"] == "By propellant (g)")
    texts = [number(taken[0]), number(taken[1]), "not recorded"]
    assert [entry["text"] for entry in ranking["entries"]] == texts
    (row,) = (row for row in table(results) if row.label == "Propellant")
    cells = [(cell.text, cell.kind) for cell in row.cells]
    assert cells == [(texts[1], ""), (NONE, ""), (texts[0], "best")]
    lines = results_table([many, without, few]).splitlines()
    column = ["propellant", "g", f"{taken[1]:.4g}", NONE, f"{taken[0]:.4g}"]
    assert [line.split()[-1] for line in lines[:5]] == column
    assert not any(
        each["title"].startswith("By prop") for each in rankings(results_of([without, without]))
    )


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (
            "layout: 12x5N, failures: {a_x: stuck_off, b_x: stuck_off}",
            "failures: with a_x stuck_off, b_x stuck_off no thrusters give a force along [-1",
        ),
        ("layout: 13x5N", "layout: '13x5N' is unknown; choose one of 12x1N"),
        ("layout: null", "layout: choose one of 12x1N, 12x5N, 16x22N, or"),
        ("units: {a: {force: 1}}", "units: has no effect with a layout; set layout: null"),
        ("layout: null, units: {a: {force: 1}}", "units: no thrusters give a "),
        (
            "layout: null, units: {a: {direction: [0, 0, 0]}}",
            "units.a.direction: must not be zero",
        ),
        ("failures: {a_w: stuck_on}", "failures.a_w: 'a_w' is unknown"),
        ("failures: {a_x: broken}", "failures.a_x: 'broken' is unknown; choose one of stuck_off"),
        ("modulator: pwm", "modulator: 'pwm' is unknown; choose one of sigma_delta, pulse_width"),
        (
            "frame: 1",
            "frame: 1 control samples are 0.01 s, shorter than minimum_on_time, 0.02 s",
        ),
        ("threshold: 1", "threshold: must be from 0.5 to below 1, not 1"),
        ("rise_time: -1", "rise_time: must be from 0 to 1000 s, not -1"),
        ("pwpf: {off: 0.3}", "pwpf.off: must be from 0 to below on (0.25), not 0.3"),
    ],
)
def test_errors_are_one_clear_line(settings, expected):
    settings = f"actuation.thrusters={{{settings}}}"
    assert_refused(f"actuation.thrusters.{expected}", "postcapture", settings)


@pytest.mark.slow
@settings(derandomize=True, database=None, deadline=None, max_examples=15)
@given(
    st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    st.floats(-5.0, -1.7).map(lambda power: 10.0**power),
    st.sampled_from((0, 1, 2)),
)
def test_the_weak_axis_of_thrusters_is_found_wherever_it_points(rpy, arm, weak):
    """Couples about three axes; the short arm's gives the least torque, whatever the axes."""
    axes, arms = Rotation.from_euler("xyz", rpy).as_matrix().T, np.ones(3)
    arms[weak] = arm
    units = {
        f"t{k}{'np'[a > 0]}{'np'[b > 0]}": {
            "position": (a * arms[k] * axes[k - 2]).tolist(),
            "direction": (b * axes[k - 1]).tolist(),
            "force": 1.0,
        }
        for k, a, b in itertools.product(range(3), (-1, 1), (-1, 1))
    }
    overrides = [f"actuation.thrusters={json.dumps({'layout': None, 'units': units})}"]
    (remark,) = uneven_remarks(load_scenario("postcapture", overrides))
    found = re.search(r"torque along \[(.*)\] is (\S+) N m", remark)
    along = np.array([float(each) for each in found[1].split(",")])  # to two digits
    assert abs(along @ axes[weak]) == pytest.approx(np.linalg.norm(along), rel=1e-3)
    assert float(found[2]) == pytest.approx(2.0 * arm, rel=0.01)
