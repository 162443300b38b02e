"""The samples of a law in a run: those of compiled runs are those that the law reads on Drake."""

import numpy as np
import pytest
from c_code import needs_llvm

from ffsm_drake import FfsmError, load_scenario
from ffsm_drake.plugins.flight.law import LawFiles
from ffsm_drake.plugins.flight.recorded import OPTIONAL, _tapped, recorded

pytestmark = needs_llvm


@pytest.mark.parametrize(
    ("name", "given", "reads"),
    [
        pytest.param("postcapture", ["duration=0.3"], (), marks=pytest.mark.smoke),
        pytest.param(
            "slow_navigation", ["duration=1.5"], ("measurement_is_new",), marks=pytest.mark.slow
        ),
        pytest.param("free_floating", ["duration=0.3"], ("desired_frame",), marks=pytest.mark.slow),
        pytest.param("tumbling_capture", ["duration=21"], (), marks=pytest.mark.long),
    ],
)
def test_the_samples_are_those_that_the_law_reads_on_drake(name, given, reads):
    scenario = load_scenario(name, given)
    assert {*LawFiles.of(scenario).reads} & {*OPTIONAL} == {*reads}
    found, expected = recorded(scenario, reads), _tapped(scenario, [*reads])
    assert found.exact == (name != "tumbling_capture")
    assert not expected.exact
    np.testing.assert_array_equal(found.wholes, expected.wholes)
    rates = np.abs(expected.inputs).max(axis=0) + 1.0
    # the force over the period before a grasp may be that of either law
    same = np.flatnonzero(found.wholes[:, 1] == 0)
    np.testing.assert_allclose(found.inputs[same] / rates, expected.inputs[same] / rates, atol=1e-8)
    np.testing.assert_allclose(found.commanded, expected.commanded, atol=1e-6)


def test_the_text_has_the_bits_of_every_number():
    run = recorded(load_scenario("postcapture", ["duration=0.05"]), ())
    rows = [line.split() for line in run.text().splitlines()]
    assert len(rows) == 6
    numbers = np.array([[float.fromhex(each) for each in row[3:]] for row in rows])
    np.testing.assert_array_equal(numbers, np.hstack([run.inputs, run.commanded]))
    assert [row[:3] for row in rows[:2]] == [["0", "1", "1"], ["1", "0", "1"]]


def test_a_run_with_faults_is_recorded_on_drake():
    event = "{unit: joints.joint_1, kind: jammed, time: [0.1]}"
    given = ["duration=0.3", f"faults={{events: {{jam: {event}}}}}"]
    run = recorded(load_scenario("flight_sensors", given), ())
    assert not run.exact
    assert len(run.wholes) == len(run.commanded) == 31


def test_a_run_that_diverges_is_no_record():
    scenario = load_scenario("postcapture", ["duration=2", "controllers.tde_aismc.k_d=500"])
    with pytest.raises(FfsmError, match="the run for the replay does not complete"):
        recorded(scenario, ())
