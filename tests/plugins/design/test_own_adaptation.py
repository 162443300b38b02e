"""What the analyses assume of a law (how K_s adapts, that it consists of axes) against its step."""

import functools
from types import SimpleNamespace

import adapting_laws
import numpy as np
import pytest

from ffsm_drake import InjectedDynamics, load_scenario
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.design.stability.adaptation import adapts, expected_gains, reached_gains
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.own_adaptation import own_adaptation
from ffsm_drake.plugins.design.stability.separate_axes import consists_of_axes, law_of_axes
from ffsm_drake.plugins.design.verdict import verdict
from ffsm_drake.plugins.estimators.filtering import make_filtered
from ffsm_drake.scenario import CommandFilter
from ffsm_drake.systems.controllers import make_law
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.registry import shipped_names
from ffsm_drake.testing import check_controller

AS_STATED = ("OwnRule", "Late")
BOUNDED = ("Leaky", "Quadratic", "Smooth", "Faster", "OtherThreshold", "Coupled")
DEFAULTS = ("controllers.aismc.k_s_initial=60", "controllers.aismc.k_s_max=70")
UNBOUNDED = ("BeyondItsBound", "SaidConstant", "Nameless")


def scenario(law, *overrides):
    return load_scenario("postcapture", [f"controller=adapting_laws:{law}", *overrides])


@functools.cache
def mission(name="postcapture"):
    return Mission(load_scenario(name))


@pytest.mark.parametrize("law", ["asmc", "aismc", "tde_aismc", "adapting_laws:Quadratic"])
def test_the_field_that_is_k_s_is_found(law):
    own = mission().flown_by(controller=law)
    made = make_law(own, own.craft.nominal())
    k_s = np.arange(11.0)
    changed = made.with_reaching_gain(k_s)
    assert changed.reaching_gain.start.tolist() == k_s.tolist()
    assert made.reaching_gain.start.tolist() != k_s.tolist()


@functools.cache
def found(law):
    own = mission().flown_by(controller=f"adapting_laws:{law}")
    nominal = own.craft.nominal()
    return own_adaptation(make_law(own, nominal), own.scenario, nominal, make_motion(own))


@pytest.mark.parametrize("law", [*AS_STATED, *BOUNDED, *UNBOUNDED])
def test_a_rule_that_is_not_the_hooks_is_found(law):
    own = found(law)
    assert own.is_as_stated == (law in AS_STATED)
    assert own.keeps_bound == (law not in UNBOUNDED)
    assert bool(own.uncovered) is not own.is_as_stated
    assert len(own.uncovered) < 200
    assert "\n" not in own.uncovered


@pytest.mark.parametrize("law", shipped_names("controller"))
def test_included_laws_adapt_as_their_hooks_say(law):
    name = "free_floating" if "resolved" in law or "task" in law else "postcapture"
    own = mission(name).flown_by(controller=law)
    nominal = own.craft.nominal()
    made = make_law(own, nominal)
    if getattr(made, "reaching_gain", None) is not None:
        assert own_adaptation(made, own.scenario, nominal, make_motion(own)).is_as_stated
    axes = law_of_axes(made)
    assert (axes is not None) == (law in ("tdc", "asmc", "aismc", "tde_aismc"))


@pytest.mark.parametrize("law", [*BOUNDED, *UNBOUNDED])
def test_such_a_law_is_judged_at_its_bound_if_it_has_one(law):
    own = mission().flown_by(controller=f"adapting_laws:{law}")
    made = make_law(own, own.craft.nominal())
    linearizer = SimpleNamespace(law=made, given=own.scenario, own_adaptation=found(law))
    assert adapts(linearizer)
    reached = list(reached_gains(linearizer))
    assert len(reached) == (law in BOUNDED)
    for held, words in reached:
        assert held["reaching_gain"].tolist() == made.dynamics.k_s_max.tolist()
        assert words == " with K_s at its bounds (its course cannot be predicted)"


@pytest.mark.long
def test_the_verdict_says_what_it_does_not_cover():
    told = verdict(scenario("Quadratic"), rehearsal=False, margins=True)
    assert told.linear.status == "stable"
    assert told.margins.axes is None
    assert any(
        "Quadratic changes K_s" in each and "the course of K_s is not predicted" in each
        for each in told.warnings
    )
    high = verdict(scenario("Quadratic", "controllers.Quadratic.k_s_max=150"), rehearsal=False)
    assert high.is_alarm
    assert "with K_s at its bounds (its course cannot be predicted)" in high.linear.sentence


@pytest.mark.long
def test_without_a_bound_it_cannot_say():
    told = verdict(scenario("BeyondItsBound"), rehearsal=False, margins=True)
    assert told.linear.status == "cannot say"
    assert "BeyondItsBound" in told.linear.sentence
    assert "has no bound" in told.linear.sentence
    assert "has no bound" in told.not_margins


@pytest.mark.long
def test_with_the_rule_of_its_hook_it_is_forecast():
    with (
        Linearizer(scenario("OwnRule")) as own,
        Linearizer(load_scenario("postcapture", ["controller=aismc", *DEFAULTS])) as included,
    ):
        found, expected = (expected_gains(each)["reaching_gain"] for each in (own, included))
    assert found == pytest.approx(expected, rel=1e-6)


@pytest.mark.long
def test_without_the_hook_the_verdict_leaves_the_adaptation_out():
    told = verdict(scenario("Forgotten"), rehearsal=False).linear
    assert "changes of reaching_gain" in told.sentence


@pytest.mark.slow
def test_check_controller_reports_it():
    assert "not covered by the stability analysis: at |s| =" in str(
        check_controller(adapting_laws.Quadratic)
    )
    assert "stability" not in str(check_controller(adapting_laws.Late))


def test_a_filter_of_commands_is_in_no_limit_by_axis():
    """It would be left out of the limits."""
    nominal = mission().craft.nominal()
    law, filtered = make_law(mission(), nominal), CommandFilter(low_pass={"all": 20.0})
    assert law_of_axes(law) is not None
    assert law_of_axes(make_filtered(law, filtered, nominal.coordinates, sample_time=0.01)) is None


class Axes(InjectedDynamics):
    """u = K e' + K e, of a given form."""

    def __init__(self, form):
        self.form, self.k = form, np.linspace(1.0, 2.0, 4)

    def initial_state(self):
        return {"integral": np.zeros(4)}

    def step(self, e, e_dot, a_d, state):
        return a_d + self.form(self.k, e, e_dot), {"integral": state["integral"] + e}


@pytest.mark.parametrize(
    ("is_by_axis", "form"),
    [
        (True, lambda k, e, e_dot: k * e + k * e_dot),
        (True, lambda k, e, e_dot: k * (e_dot + 2.0 * e)),
        (False, lambda k, e, e_dot: k * e[..., ::-1] + e_dot),  # other coordinates
        (False, lambda k, e, e_dot: k * e.sum(axis=-1, keepdims=True)),
        (False, lambda k, e, e_dot: k * e * np.abs(e)),  # not linear
        (False, lambda k, e, e_dot: k * np.hypot(e, e_dot)),
        (False, lambda k, e, e_dot: k * np.clip(e, -0.1, 0.1)),
        (False, lambda k, e, e_dot: k * e + 1.0),
        (False, lambda k, e, e_dot: np.diag(k) @ e),  # one sample at a time
    ],
)
def test_axes_are_found_by_trial(is_by_axis, form):
    assert consists_of_axes(Axes(form)) == is_by_axis
