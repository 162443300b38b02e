"""The shipped mission with a capture, thrusters, wheels and flexible panels at once: what is
foreseen of it, and what it does.
"""

import numpy as np
import pytest

from ffsm_drake import load_scenario, simulate_many
from ffsm_drake.control_design.stability.linearization import Linearizer
from ffsm_drake.control_design.stability.load import predicted_load
from ffsm_drake.control_design.stability.rehearsal import rehearse
from ffsm_drake.preflight.verdict import verdict

AXIS = np.array([0.6, 0.48, 0.64])


def mission(rate, *overrides):
    """At a tumbling rate, deg/s."""
    return load_scenario(
        "capture_on_thrusters",
        [f"capture.rate={(np.radians(rate) * AXIS).tolist()}", *overrides],
    )


def test_a_fast_stop_is_rehearsed_with_postures_close_enough():
    """Between postures 10 s apart the stable loops of an 8 deg/s stop have an unstable mean."""
    found = rehearse(mission(8.0, "controller=tdc", "duration=26"), seeds=1)
    assert found.share_diverged == 0.0


@pytest.mark.parametrize("assisted", [True, False])
def test_the_load_of_a_grasp_counts_the_thrusters_help(assisted):
    overrides = [] if assisted else ["actuation.wheels.assist_above=null"]
    with Linearizer(mission(5.0, "controller=tdc", "duration=22", *overrides)) as linearizer:
        assert (predicted_load(linearizer) < 1.0) is assisted


@pytest.mark.slow
def test_it_settles_at_every_rate_with_either_law():
    cases = [
        (rate, f"controller={law}", f"random_seed={seed}")
        for rate in (3.0, 5.0, 8.0)
        for law in ("tdc", "tde_aismc")
        for seed in range(3)
    ]
    records = simulate_many([mission(*case) for case in cases])
    assert all(record.ending.is_settled for record in records)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [3.0, 8.0])
def test_no_false_alarm(rate):
    found = verdict(mission(rate), margins=True)
    assert found.conclusion.startswith("expected to go as planned")
    assert found.margins.verdict.startswith("stable with its actuators: ")
