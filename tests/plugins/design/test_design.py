"""Gain design: what may get worse, its end by time and by signal, actuators in its score."""

import re
import signal
import sys
import time

import numpy as np
import pytest
from children import PIPE, STDOUT, child
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from ffsm_drake import load_scenario
from ffsm_drake.cli import main
from ffsm_drake.plugins.design.gains import INTERRUPT, design
from ffsm_drake.plugins.design.gains.requirement import Baseline, DesignPoint, Requirement
from ffsm_drake.plugins.design.stability.boundaries import Boundaries
from ffsm_drake.plugins.design.stability.outputs import groups_of
from ffsm_drake.plugins.design.stability.prediction import Prediction
from ffsm_drake.plugins.design.tables import design_table
from ffsm_drake.spacecraft.craft import make_nominal_plant

SHORT = ("duration=6", "reference.duration=6")
pytestmark = pytest.mark.usefixtures("few_delays")
HEAVY = ("controller=tdc", "duration=20", "reference.duration=20")


@pytest.fixture(scope="module")
def coordinates():
    return make_nominal_plant(load_scenario("postcapture")).coordinates


def point_of(coordinates, *, errors=1.0, isv=100.0, noise_force=0.0, lost_margin="", alarm=""):
    """A point with the same figures in all coordinates, but for errors, which go by group."""
    ones = np.ones(len(coordinates.names))
    rms = ones.copy()
    for part, error in zip(
        coordinates.driven_groups.values(), np.broadcast_to(errors, 3), strict=True
    ):
        rms[part] = error
    return DesignPoint(
        scenario=load_scenario("postcapture"),
        prediction=Prediction(
            coordinates=coordinates,
            groups=groups_of(coordinates),
            spectral_radius=0.99,
            rms_error=rms,
            noise_error=rms,
            noise_force=noise_force * ones,
            isv_by_coordinate=isv / len(ones) * ones,
            peak_effort=ones,
        ),
        radius_by_mass={50.0: 0.99},
        lost_margin=lost_margin,
        alarm=alarm,
    )


def requirement_of(coordinates, trade=(), budget=102.0, room=np.inf):
    boundaries = Boundaries(
        gains=3.0, nominal_payload=2.0, sample_time=1.5, flexible_mass={}, delay=2.0
    )
    none = np.full(len(coordinates.names), np.inf)
    baseline = Baseline(point=point_of(coordinates), boundaries=boundaries, time=0.0, trade=trade)
    return Requirement(budget=budget, limit=none, room=np.minimum(none, room), baseline=baseline)


def interrupted_after(count):
    """``progress`` that cuts a search at a number of candidates."""

    def progress(tried, _):
        if tried >= count:
            raise KeyboardInterrupt

    return progress


FACTORS = st.lists(st.floats(0.2, 5.0), min_size=3, max_size=3)
TRADES = st.sets(st.sampled_from(["accuracy", "margins"]))


@settings(max_examples=60, deadline=None)
@given(errors=FACTORS, isv=st.floats(50.0, 150.0), trade=TRADES, loses=st.booleans())
def test_only_what_is_traded_may_be_worse(coordinates, errors, isv, trade, loses):
    requirement = requirement_of(coordinates, trade)
    lost = "smaller margin" if loses and "margins" not in trade else ""
    point = point_of(coordinates, errors=errors, isv=isv, lost_margin=lost)
    is_worse = ("accuracy" not in trade and max(errors) > 1.02) or bool(lost)
    assert bool(requirement.worse(point)) == is_worse
    assert bool(requirement.violated(point)) == (is_worse or isv > 102.0)
    better_than_given = requirement.rank(point) < requirement.rank(requirement.baseline.point)
    assert better_than_given == (not requirement.violated(point) and np.mean(np.log(errors)) < 0.0)


@settings(max_examples=60, deadline=None)
@given(factor=st.floats(0.5, 2.0), which=st.sampled_from(["gains", "sample_time", "delay"]))
def test_margins_may_be_traded(coordinates, factor, which):
    kept, traded = (requirement_of(coordinates, trade).baseline for trade in ((), ("margins",)))
    values = vars(kept.boundaries)
    changed = Boundaries(**{**values, which: factor * values[which]})
    assert bool(kept.worse_margin(changed)) == (1.02 * factor < 1.0)
    assert not traded.worse_margin(changed)
    found = traded.margins(changed)
    assert sum(before != after for before, after in found.values()) == (factor != 1.0)


@settings(max_examples=60, deadline=None)
@given(noise=st.floats(0.0, 4.0), room=st.floats(0.5, 2.0))
def test_noise_that_the_actuators_have_no_room_for_counts_as_error(coordinates, noise, room):
    requirement = requirement_of(coordinates, room=room)
    point = point_of(coordinates, noise_force=noise)
    beyond = max(0.0, np.log(noise / room)) if noise else 0.0
    assert requirement.score(point) == pytest.approx(beyond, abs=1e-12)


def test_a_mission_that_will_not_go_as_planned_ranks_last(coordinates):
    requirement = requirement_of(coordinates)
    alarmed = point_of(coordinates, errors=0.1, alarm="it diverges")
    assert requirement.violated(alarmed) == "it diverges"
    assert requirement.rank(alarmed) > requirement.rank(point_of(coordinates, errors=9.0))


@pytest.mark.long
def test_what_is_predicted_of_the_given_gains_frees_the_choice():
    """Whatever goes as planned is better than what does not; nothing else is chosen."""
    free = ("controller=pd_plus", "actuation.limit={joints: 500}")
    scenario = load_scenario("flight_sensors", [*free, *SHORT])
    asked = []

    def predict_mission(candidate):
        asked.append(candidate)
        return "it misses" if len(asked) == 1 else ""

    few = interrupted_after(4)
    found = design(scenario, progress=few, predict_mission=predict_mission)
    assert asked[0] is found.given.scenario
    assert found.given.alarm == "it misses"
    assert found.requirement.baseline is None
    assert not found.kept
    assert asked[-1] is found.chosen.scenario
    never = design(scenario, progress=few, predict_mission=lambda candidate: "it misses")
    assert never.kept
    assert never.ended_by == INTERRUPT
    assert "it misses" in never.remarks[0]
    reason = "because the current gains are not expected to go as planned"
    assert f"margins: not compared, {reason}" in design_table(never)


@pytest.mark.parametrize(
    "after",
    [
        pytest.param(4, marks=pytest.mark.long),
        *(pytest.param(count, marks=pytest.mark.long) for count in (1, 12)),
    ],
)
def test_an_interrupt_at_any_candidate_gives_the_best_before_it(after):
    scenario = load_scenario("flight_sensors", ["controller=computed_torque", *SHORT])
    tried = []

    def interrupt(count, told):
        tried.append(count)
        interrupted_after(after)(count, told)

    found = design(scenario, progress=interrupt)
    assert (found.ended_by, tried[-1]) == (INTERRUPT, after)
    assert any("ended by an interrupt" in remark for remark in found.remarks)
    for name, (error, was) in found.requirement.baseline.errors(found.chosen).items():
        assert error <= 1.02 * was, name


@pytest.mark.long
@pytest.mark.parametrize(
    "limit",
    [0.0, 1.5, 6.0],
)
def test_the_limit_bounds_all_of_a_design(limit):
    """Within a candidate, too: each of a heavy mission takes seconds."""
    scenario = load_scenario("thrusters_and_wheels", HEAVY)
    begin = time.monotonic()
    found = design(scenario, time_limit=0.0)
    evaluation = time.monotonic() - begin  # of the given gains, and of what is said of the choice
    assert found.ended_by == "the time limit"
    assert "not evaluated before the time limit; give a larger --time" in design_table(found)
    begin = time.monotonic()
    found = design(scenario, time_limit=limit)
    assert time.monotonic() - begin < 1.1 * limit + 2.5 * evaluation
    assert any("ended by the time limit" in remark for remark in found.remarks)


@pytest.mark.long
@pytest.mark.usefixtures("rough_pictures")
def test_the_table_shows_margins_before_and_after(tmp_path):
    arguments = ["design", "flight_sensors", "-c", "computed_torque", "--time", "300"]
    arguments += ["--set", "duration=8"]
    result = CliRunner().invoke(main, [*arguments, "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert re.search(r"margin +chosen +current\nfactor on the gains +[\d.]+ +[\d.]+", result.output)
    assert "expected to" in result.output


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_design_gives_the_best_so_far(tmp_path, number):
    """The first signal ends the search: files are whole, the exit code is that of an interrupt."""
    command = [sys.executable, "-m", "ffsm_drake", "design", "flight_sensors", "-c", "tdc"]
    command += ["--set", "duration=6", "--time", "500", "--out", str(tmp_path)]
    with child(command, stdout=PIPE, stderr=STDOUT, text=True) as process:
        time.sleep(8.0)  # in the middle of the search, or before it
        process.send_signal(number)
        told, _ = process.communicate(timeout=120)
    assert process.returncode == 128 + number, told
    if "current gains" in told:
        assert "ended by an interrupt" in told
        assert load_scenario(tmp_path / "design.yaml").controller == "tdc"
        assert {path.name for path in tmp_path.iterdir()} == {"design.yaml", "design.png"}
    else:
        assert not list(tmp_path.iterdir())
