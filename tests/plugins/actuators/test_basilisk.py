"""Wheels, thrusters, modulation, panels and slosh against Basilisk: its results in a table, and it
where installed.

Both sides integrate the bus to about 1e-12, so that what is compared is models.
"""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
import rigid_bus as bus

from ffsm_drake.plugins.actuators.modulation import SchmittTrigger, pulse_widths

SECOND = round(1.0 / bus.PERIOD)  # in samples


@pytest.fixture(scope="module", params=["table", "installed"])
def basilisk(request):
    if request.param == "table":
        return json.loads((Path(__file__).parent / "basilisk.json").read_text())
    if importlib.util.find_spec("Basilisk") is None:
        pytest.skip(
            "needs Basilisk (pip install bsk), which holds Matplotlib back; its results "
            "are in the table"
        )
    import basilisk_oracle

    return basilisk_oracle.results()


def largest_difference(found, expected, *names):
    return max(np.abs(found[name][::SECOND] - np.array(expected[name])).max() for name in names)


@pytest.mark.slow
def test_wheels_and_torque_mapping(basilisk):
    found, expected = bus.wheels(), basilisk["wheels"]
    assert np.array(expected["motor_torque"]) == pytest.approx(
        found["wheel_torque"][:-1][::SECOND], abs=1e-12
    )
    assert largest_difference(found, expected, "rate", "wheel_speed") < 1e-8
    assert np.ptp(found["rate"], axis=0).min() > 0.01
    assert np.abs(found["wheel_speed"][-1] - found["wheel_speed"][0]).min() > 5.0


@pytest.mark.long
def test_two_panels_a_sloshing_mass_and_wheels(basilisk):
    found, expected = bus.parts(), basilisk["parts"]
    names = ("rate", "attitude", "velocity", "wheel_speed", "deflection", "deflection_rate")
    assert largest_difference(found, expected, *names) < 2e-8
    # They swing far, and the bus turns otherwise than without them.
    assert np.all(np.ptp(found["deflection"], axis=0) > [0.5, 0.3, 0.08])
    assert np.abs(found["rate"] - bus.wheels()["rate"]).max() > 0.02


def test_coulomb_friction(basilisk):
    found = bus.coasting(coulomb=bus.COULOMB)
    assert largest_difference(found, basilisk["coulomb"], "rate", "wheel_speed") < 1e-8
    assert np.abs(found["wheel_speed"][-1] - found["wheel_speed"][0]).min() > 0.25


@pytest.mark.slow
def test_viscous_friction(basilisk):
    """Held over a sample it is right to first order: half the period halves the difference, and
    both together none.
    """
    expected = basilisk["viscous"]
    whole, half = (
        bus.coasting(viscous=bus.VISCOUS),
        bus.coasting(viscous=bus.VISCOUS, period=bus.PERIOD / 2),
    )
    half = {name: rows[::2] for name, rows in half.items()}
    for name, largest in (("rate", 1e-8), ("wheel_speed", 2e-5)):
        once, twice = (largest_difference(found, expected, name) for found in (half, whole))
        assert twice < largest
        assert twice / once == pytest.approx(2.0, abs=0.01)
    limit = {name: 2.0 * half[name] - whole[name] for name in ("rate", "wheel_speed")}
    assert largest_difference(limit, expected, "rate", "wheel_speed") < 1e-8


def test_thrusters(basilisk):
    found, expected = bus.thrusters(), basilisk["thrusters"]
    ours = [[list(pulse) for pulse in unit] for unit in bus.pulses()]
    assert ours == [[list(pulse) for pulse in unit] for unit in basilisk["pulses"]]
    assert sum(map(len, ours)) > 900
    assert largest_difference(found, expected, "rate", "velocity") < 1e-8


def test_pulse_widths_are_a_schmitt_trigger_of_equal_levels(basilisk):
    ours = pulse_widths(bus.shares(), frame=bus.FRAME, minimum=bus.MINIMUM)
    # For more than a whole frame Basilisk asks for 1.1 frames.
    assert np.minimum(basilisk["on_times"], bus.FRAME) == pytest.approx(ours, abs=1e-12)
    for length in (0.0, bus.MINIMUM, bus.FRAME):
        assert (np.abs(ours - length) < 1e-12).mean() > 0.02


def test_schmitt_trigger_with_hysteresis(basilisk):
    """PWPF's trigger without what is Basilisk's not: the filter, and the feedback of what fires."""
    trigger = SchmittTrigger(gain=1.0, time_constant=1e-6, on=0.75, off=0.25, sample_time=bus.FRAME)
    filtered, is_on, ours = np.zeros(12), np.zeros(12), []
    for share in bus.shares():
        filtered, is_on = trigger.step(share + is_on, filtered, is_on)
        ours.append(is_on)
    assert np.array_equal(ours, basilisk["hysteresis"])
    shares, ours = bus.shares(), np.array(ours)
    between = (shares > 0.25) & (shares < 0.75)
    assert 0.0 < ours[between].mean() < 1.0
