"""Laws that adapt, that have no derivative, or that diverge as they are looked at: one answer, with
the remedy.
"""

import numpy as np
import pytest
from adapting_laws import SlotineLi

from ffsm_drake import load_scenario
from ffsm_drake.common.errors import BlockError
from ffsm_drake.plugins.design.gains import design
from ffsm_drake.plugins.design.stability.boundaries import probed_radius, with_gains
from ffsm_drake.plugins.design.stability.linear_loop import NotLinear
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.verdict import verdict
from ffsm_drake.systems.controllers import complete_gains


def scenario(law, *overrides):
    return load_scenario("postcapture", [f"controller=adapting_laws:{law}", *overrides])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "words", "remedy"),
    [
        ("SlotineLi", "its state theta is constant at rest", '{"theta": None}'),
        ("TwoMemories", "its state theta is constant at rest", '{"theta": None}'),
        ("SuperTwisting", "has no derivative", "smooth it"),
    ],
)
def test_what_cannot_be_linearised_is_named_with_its_remedy_everywhere(law, words, remedy):
    found = verdict(scenario(law), rehearsal=False, margins=True)
    assert found.linear.status == "cannot say"
    assert found.margins is None
    assert not found.is_alarm
    for sentence in (found.linear.sentence, found.not_margins):
        assert law in sentence
        assert words in sentence
        assert remedy in sentence
    with pytest.raises(NotLinear, match=words):
        design(scenario(law), time_limit=1.0)


@pytest.mark.parametrize("law", ["SlotineLiHeld", "TwoMemoriesHeld", "SmoothTwisting"])
def test_the_remedy_helps(law):
    found = verdict(scenario(law), rehearsal=False, margins=True)
    assert found.linear.status == "stable"
    assert found.margins.is_stable


@pytest.mark.parametrize("k_d", np.geomspace(250.0, 1e6, 6).round(1).tolist())
def test_a_probe_that_is_not_finite_is_unstable(k_d):
    """The law asks its model for the mass matrix at a state that overflows."""
    given = scenario("SlotineLiHeld", f"controllers.SlotineLiHeld.k_d={k_d}")
    with Linearizer(given) as linearizer:
        assert not linearizer.at(0.0).spectral_radius < 1.0
        error, _ = linearizer.follow(samples=100)
    assert np.isnan(error[-1]).all()


@pytest.mark.parametrize("law", ["SlotineLiHeld", "SmoothTwisting"])
def test_limits_of_such_a_law_are_found(law):
    """A trial that leaves the plan, where the law is not smooth or asks for what is not finite."""
    given = complete_gains(scenario(law))
    radii = [
        probed_radius(with_gains(given, factor), [0.0], adapted=True) for factor in (1.0, 30.0, 1e5)
    ]
    assert radii[0] < 1.0
    assert min(radii[1:]) > 1.0


def test_a_law_that_fails_at_a_sound_state_is_still_an_error():
    with pytest.raises(BlockError, match="on purpose"), Linearizer(scenario("Fails")) as linearizer:
        linearizer.at(0.0)


def test_the_memory_that_is_kept_is_that_of_the_law():
    with Linearizer(scenario("TwoMemories")) as linearizer:
        loop = linearizer.at(linearizer.end)
    assert loop.is_marginal
    assert loop.kept_memory == ("theta",)
    assert SlotineLi.__name__ == "SlotineLi"


def test_a_hook_that_is_missing_is_named():
    found = verdict(scenario("WithoutWithReachingGain"), rehearsal=False, margins=True)
    assert "WithoutWithReachingGain defines reaching_gain; it also needs" in found.not_margins
