"""Scenarios that a closed loop refuses in one line."""

import pytest

from ffsm_drake import ScenarioError, load_scenario, make_closed_loop


def assert_refused(expected, name, *overrides):
    """The loop of a scenario is refused in one line with the expected text."""
    with pytest.raises(ScenarioError) as error:
        make_closed_loop(load_scenario(name, overrides))
    assert expected in str(error.value)
    assert "\n" not in str(error.value)
