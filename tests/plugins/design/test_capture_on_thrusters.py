"""The shipped mission with a capture, thrusters, wheels and flexible panels at once: what is
predicted of it, and what it does.
"""

import re
import shlex

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ffsm_drake import load_scenario, simulate, simulate_many
from ffsm_drake.plugins.design.limits_left import CLEARANCE
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.load import advice, predicted_load
from ffsm_drake.plugins.design.verdict import helpful_remarks, verdict
from ffsm_drake.scenario import override_scenario
from ffsm_drake.systems.mission_limits import base_limits

AXIS = np.array([0.6, 0.48, 0.64])


def mission(rate, *overrides):
    """At a tumbling rate, deg/s."""
    return load_scenario(
        "capture_on_thrusters",
        [f"capture.rate={(np.radians(rate) * AXIS).tolist()}", *overrides],
    )


@pytest.mark.parametrize("assisted", [True, False])
def test_the_load_of_a_grasp_counts_the_thrusters_help(assisted):
    overrides = [] if assisted else ["actuation.wheels.assist_above=null"]
    with Linearizer(mission(5.0, "controller=tdc", "duration=22", *overrides)) as linearizer:
        assert (predicted_load(linearizer) < 1.0) is assisted


@pytest.mark.long
def test_it_settles_at_every_rate_with_either_law():
    """Each rate with each law, each of both with every seed."""
    cases = [
        (rate, f"controller={('tdc', 'tde_aismc')[(place + seed) % 2]}", f"random_seed={seed}")
        for place, rate in enumerate((3.0, 5.0, 8.0))
        for seed in range(3)
    ]
    records = simulate_many([mission(*case) for case in cases])
    assert all(record.ending.is_settled for record in records)


@pytest.mark.long
def test_no_false_alarm():
    found = verdict(mission(8.0), margins=True)
    assert found.run.ending.is_settled
    assert [*found.run.limits] == [CLEARANCE]  # base and target, rightly
    assert "rehearsed" in found.warnings[0]
    assert not any(word in found.warnings[0] for word in ("linear", "under its limits"))
    assert found.margins.verdict.startswith("stable with its actuators: ")


def craft(*, torque, rate, law, panel, layout, stop, noise, seed):
    """The mission with a craft's own numbers, and the gains of ``tumbling_capture`` on the base's
    rotation, which know nothing of wheels.
    """
    given = load_scenario("tumbling_capture").controllers[law]
    gains = [
        f"controllers.{law}.{name}.base_rotation={values['base_rotation']}"
        for name, values in given.items()
        if "base_rotation" in (values if isinstance(values, dict) else ())
    ]
    wheels = [f"actuation.wheels.units.wheel_{i}.torque_limit={torque}" for i in range(1, 5)]
    panels = [f"model.flexible.{name}.mass={panel}" for name in ("port", "starboard")]
    return mission(
        rate, *gains, *wheels, *panels, f"controller={law}", f"random_seed={seed}",
        f"actuation.thrusters.layout={layout}", "actuation.wheels.assist_above=null",
        f"reference.duration={stop}", f"duration={stop + 35.0}",
        f"sensing.position_noise.base_rotation={noise}",
    )  # fmt: skip


crafts = st.fixed_dictionaries(
    {
        "torque": st.floats(0.6, 2.5),
        "rate": st.floats(2.0, 8.0),
        "law": st.sampled_from(["tdc", "asmc", "aismc", "tde_aismc"]),
        "panel": st.floats(2.0, 8.0),
        "layout": st.sampled_from(["12x5N", "16x22N"]),
        "stop": st.integers(15, 40).map(float),
        "noise": st.sampled_from([5e-5, 1e-4]),
        "seed": st.integers(0, 99),
    }
)


def followed(scenario, found, *, other_law=False):
    """The scenario with what helps, the other law where that is asked for."""
    changes = {}
    for each in found:
        if "controller" not in each.changes or other_law:
            changes |= each.changes
    return override_scenario(scenario, [changes])


@pytest.mark.slow
@settings(max_examples=5, deadline=None)
@given(numbers=crafts)
def test_what_helps_comes_from_the_crafts_own_numbers(numbers):
    """Following it leaves nothing more to say but of another law."""
    scenario = craft(**numbers)
    found = advice(scenario, {"wheels": 0.6, "thrusters": 0.1}, settles=False)
    limit = base_limits(scenario).torque.min()
    assert any(f"beyond the wheels' {limit:.3g} N m" in str(each) for each in found)
    assert ({"controller": "tdc"} in [each.changes for each in found]) == (
        numbers["law"].endswith("aismc")
    )
    after = followed(scenario, found)
    again = advice(after, {"wheels": 0.6, "thrusters": 0.1}, settles=False)
    assert all("controller" in each.changes for each in again)
    for each in found:  # as the command line takes it
        options = shlex.split(re.sub(r" \(.*", "", str(each)))
        assert options[::2] == ["--set"] * len(each.changes)
        override_scenario(scenario, options[1::2])


def test_nothing_is_said_of_actuators_that_have_room():
    assert advice(mission(5.0), {"wheels": 0.03, "thrusters": 0.0}, settles=False) == ()
    assert advice(mission(5.0), {"wheels": 0.3, "thrusters": 0.01}, settles=True) == ()
    assert advice(load_scenario("flight_sensors"), {}, settles=False) == ()


@pytest.mark.long
@settings(max_examples=3, deadline=None, derandomize=True)
@given(numbers=crafts)
def test_following_what_helps_makes_a_craft_settle(numbers):
    record = simulate(scenario := craft(**numbers), check_stability=False)
    remarks = helpful_remarks(record)
    if record.ending.is_settled and not remarks:
        return
    assert "what may help: --set " in remarks[0]
    found = verdict(scenario, rehearsal=False).advice
    if not found:  # predicted to settle, with other noises
        found = advice(scenario, {"wheels": 1.0}, settles=False)
    assert simulate(followed(scenario, found), check_stability=False).ending.is_settled
