"""Finite differences of a law on arrays of changes are those of the law called for each change."""

import dataclasses

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ffsm_drake import load_scenario
from ffsm_drake.common.errors import FfsmError
from ffsm_drake.plugins.design.stability.linear_loop import NotLinear
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.scenario import shipped_scenarios
from ffsm_drake.systems.controllers import controller_names
from ffsm_drake.systems.registry import call_factory, find_factory


def loop(name, law, share, *settings, as_a_users=False):
    """The linear loop at a fraction of the motion; a user's law is called for each change alone."""
    scenario = load_scenario(name, [f"controller={law}", *settings])

    def factory(setup):
        own = dataclasses.replace(setup, name=law, settings=scenario.controllers.get(law, {}))
        made = call_factory(find_factory("controller", law), own, place=law)
        if not as_a_users:
            return made
        fields = {field.name: getattr(made, field.name) for field in dataclasses.fields(made)}
        return type("Own", (type(made),), {})(**fields)  # which does not say that it is wide

    with Linearizer(scenario, blocks={"controller": factory}) as linearizer:
        assert not linearizer.is_exact
        return linearizer.at(linearizer.part(share))


def check(name, law, share, *settings):
    """Equal to rounding, which the differences' steps of 1e-7 magnify."""
    together, alone = (
        loop(name, law, share, *settings, as_a_users=as_a_users) for as_a_users in (False, True)
    )
    assert together.memory == alone.memory
    assert len(together.samples) == len(alone.samples)
    for one, other in zip(together.samples, alone.samples, strict=True):
        for matrix, like in ((one.a, other.a), (one.b, other.b), (one.c, other.c)):
            scale = max(1.0, np.nanmax(np.abs(like), initial=0.0))
            np.testing.assert_allclose(matrix, like, rtol=0.0, atol=1e-7 * scale)


@pytest.mark.long
@settings(max_examples=12, deadline=None)
@given(
    name=st.sampled_from(sorted(shipped_scenarios())),
    law=st.sampled_from(controller_names()),
    share=st.floats(0.0, 1.0),
)
def test_any_law_in_any_scenario(name, law, share):
    try:
        loop(name, law, share)
    except FfsmError:
        assume(False)  # a law that the scenario cannot have
    try:
        check(name, law, share)
    except NotLinear:
        # A user's law may count samples; one that switches again and again cannot be told from it.
        assume(False)


@pytest.mark.parametrize(
    ("name", "law"),
    [("postcapture", "tde_aismc"), ("tumbling_capture", "tdc"), ("free_floating", "resolved_rate")],
)
def test_some(name, law):
    check(name, law, 0.3)


@pytest.mark.long
def test_a_frame_at_the_estimated_state():
    check("seven_joint", "task_time_delay", 0.1, "estimator.kind=coupled")


@pytest.mark.long
def test_a_measurement_within_the_samples_compared_is_no_counter():
    check("slow_navigation", "task_time_delay", 0.625)
