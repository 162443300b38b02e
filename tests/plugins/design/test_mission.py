"""The linear verdict on every leg of a mission."""

import dataclasses
import math

import numpy as np
import pytest

from ffsm_drake import load_scenario, simulate
from ffsm_drake.plugins.design.stability import stability
from ffsm_drake.plugins.design.stability.linear_loop import NotLinear
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.mission import LinearVerdict, linear_verdict
from ffsm_drake.plugins.design.stability.moving import motion_stability

# An actuator's delay with the one-sample estimate; the loop is stable at the starting K_s.
LATE = ["actuation.delay=2", "estimator.kind=one_sample"]
EIGHTFOLD = "controllers.tde_aismc.k_s_max={base_position: 0.4, base_rotation: 48, joints: 192}"


def leg(scenario, name="motion"):
    (found,) = [each for each in linear_verdict(scenario).legs if each.leg == name]
    return found


def tracked(name, *overrides):
    return load_scenario(
        "flight_sensors", [f'blocks.sensing={{tracker: "{name}"}}', "controller=tdc", *overrides]
    )


@pytest.mark.smoke
def test_the_approach_is_looked_at_without_the_target():
    """The arm without the target is too light for these gains."""
    scenario = load_scenario("tumbling_capture", ["controller=pd_plus"])
    found = linear_verdict(scenario)
    approach, stop = found.legs
    assert (approach.leg, stop.leg) == ("approach", "stop")
    assert approach.status == "unstable"
    assert not approach.rests_stable
    assert approach.time < 0.1
    assert stop.status == "stable"
    assert stop.time >= scenario.grasp_time
    assert found.status == "unstable"
    assert found.is_alarm
    assert found.sentence.startswith("approach: unstable at rest")


@pytest.mark.parametrize(
    "name",
    [
        "postcapture",
        "flight_sensors",
        pytest.param("tumbling_capture", marks=pytest.mark.slow),
    ],
)
def test_shipped_missions_are_stable(name):
    scenario = load_scenario(name)
    found = linear_verdict(scenario)
    assert found.status == "stable"
    assert not found.is_alarm
    assert all(each.growth == 1.0 and each.instants < 12 for each in found.legs)
    assert len(found.legs) == (1 if scenario.capture is None else 2)


def test_a_capture_without_an_approach_has_one_leg():
    scenario = load_scenario("tumbling_capture", ["capture.approach=null", "controller=pd_plus"])
    (stop,) = linear_verdict(scenario).legs
    assert stop.leg == "stop"
    assert stop.time < scenario.reference.duration + 0.1


def passing(mass, *changes):
    """A motion past a posture at which time-delay control barely tolerates the payload."""
    changes = ["controller=tdc", f"payload.truth.mass={mass}", "reference.duration=12", *changes]
    return load_scenario("free_floating", changes)


@pytest.mark.long
def test_a_posture_that_is_passed_is_no_alarm():
    found = linear_verdict(passing(54.74))
    (motion,) = found.legs
    assert motion.status == "errors grow"
    assert motion.radius == pytest.approx(1.0024, abs=5e-4)
    assert motion.growth == pytest.approx(1.8, abs=0.3)
    assert motion.rests_stable
    assert motion.instants < 25
    assert not found.is_alarm
    assert "errors grow 1." in found.sentence


def alternating(mass, *, rest):
    """Size of what changes sign from sample to sample in the difference of two runs that differ by
    noise alone, (n) by quarters of a second.
    """
    noise = ["sensing.velocity_noise=1e-7", "sensing.position_noise=0", f"duration={12 + rest}"]
    first, second = (
        simulate(passing(mass, *noise, f"random_seed={seed}"), check_stability=False)
        .dataset["error"]
        .values[:, 6:]
        for seed in (1, 2)
    )
    rough = np.diff(first - second, 3, axis=0)
    return np.sqrt((rough[: len(rough) // 25 * 25].reshape(-1, 25 * 5) ** 2).mean(axis=1))


@pytest.mark.long
@pytest.mark.parametrize("mass", np.random.default_rng(51).uniform(54.48, 54.62, 3).round(2))
def test_errors_grow_at_rest_as_the_spectral_radius_says(mass):
    sizes = alternating(mass, rest=6)[-22:]
    grown = np.polyfit(0.25 * np.arange(len(sizes)), np.log(sizes), 1)[0]
    with Linearizer(passing(mass)) as linearizer:
        radius = linearizer.at(linearizer.end).spectral_radius
    assert np.exp(0.01 * grown) == pytest.approx(radius, abs=3e-4)
    assert leg(passing(mass)).status == "unstable"


@pytest.mark.long
@pytest.mark.parametrize("mass", [54.9, 56.37])
def test_a_stable_motion_past_the_posture_shows_no_growth(mass):
    sizes = alternating(mass, rest=1)
    assert leg(passing(mass)).status == "stable"
    assert sizes.max() < 2.0 * np.median(sizes)


@pytest.mark.long
def test_a_loop_that_is_unstable_where_it_rests():
    found = leg(load_scenario("free_floating", ["controller=tdc", "payload.truth.mass=54.5"]))
    assert found.status == "unstable"
    assert not found.rests_stable


@pytest.mark.slow
def test_the_bounds_of_adaptation_count():
    scenario = load_scenario("flight_sensors", [*LATE, EIGHTFOLD])
    with Linearizer(scenario) as linearizer:
        assert motion_stability(linearizer).worst.spectral_radius < 1.0
    found = leg(scenario)
    assert found.status == "unstable"
    assert "K_s at its bounds" in found.sentence
    margins = stability(scenario)
    assert not margins.is_stable
    assert margins.verdict.startswith("unstable with every K_s at its bound")
    assert leg(load_scenario("flight_sensors", LATE)).status == "stable"


@pytest.mark.slow
def test_adaptation_to_these_bounds_diverges():
    scenario = load_scenario("flight_sensors", [*LATE, EIGHTFOLD])
    assert simulate(scenario, check_stability=False).outcome.status == "diverged"


@pytest.mark.slow
def test_without_bounds_the_forecast_counts():
    assert leg(load_scenario("postcapture", ["controller=aismc"])).status == "stable"
    unbounded = "controllers.tde_aismc.k_s_max={}"
    unknown = leg(load_scenario("flight_sensors", [*LATE, unbounded]))
    assert unknown.status == "cannot say"
    assert "set k_s_max" in unknown.sentence


@pytest.mark.slow
@pytest.mark.parametrize(
    ("counting", "held"),
    [
        ("slow_tracker:Counting", "slow_tracker:Held"),
        ("slow_tracker:Third", "slow_tracker:HeldThird"),
    ],
)
def test_blocks_that_count_samples_are_periodic(counting, held):
    def loop(name):
        with Linearizer(tracked(name)) as linearizer:
            return linearizer.at(0.0)

    found, expected = loop(counting), loop(held)
    assert len(found.samples) == len(expected.samples) > 1
    # one that is held from another sample on has another fast pole
    slow = [np.sort(np.abs(each.poles))[-10:] for each in (found, expected)]
    assert slow[0] == pytest.approx(slow[1], abs=1e-4)
    assert leg(tracked(counting)).status == "stable"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "words"), [("Rare", "neither grow nor decay"), ("Irregular", "without a period")]
)
def test_blocks_whose_samples_are_not_seen_are_not_called_unstable(name, words):
    found = linear_verdict(tracked(f"slow_tracker:{name}"))
    assert found.status == "cannot say"
    assert not found.is_alarm
    assert words in found.sentence
    assert "tracker" in found.sentence


ROUNDING = """
import dataclasses
import numpy as np
import ffsm_drake

@dataclasses.dataclass(frozen=True, kw_only=True)
class Kept(ffsm_drake.ControlLaw):
    model: ffsm_drake.PlantModel

    def initial_state(self):
        return {"kept": np.ones(2)}

    def step(self, sample, state):
        wanted = sample.a_d + 6.0 * sample.e_dot + 9.0 * sample.e
        force = self.model.calc_mass_matrix(sample.q) @ wanted
        rounding = 1e-16 * np.sin(1e9 * sample.q.sum())
        return force, {"kept": np.array([1.0, rounding])}
"""


def test_rounding_in_memory_is_no_difference_between_samples(tmp_path):
    (tmp_path / "rounding.py").write_text(ROUNDING)
    law = ["controller=rounding:Kept", f"python_path=[{tmp_path}]"]
    assert leg(load_scenario("postcapture", law)).status == "stable"


def test_the_worst_leg_counts():
    stable = leg(load_scenario("postcapture", ["controller=tdc"]))
    others = [
        dataclasses.replace(stable, status=status)
        for status in ("errors grow", "cannot say", "unstable")
    ]
    for i, other in enumerate(others):
        found = LinearVerdict(legs=(other, stable, *others[:i]))
        assert found.status == other.status
        assert found.is_alarm is (other.status == "unstable")


def test_a_block_that_cannot_be_linearised(monkeypatch):
    def refused(self, *_, **__):
        raise NotLinear("reason")

    monkeypatch.setattr(Linearizer, "at", refused)
    (found,) = linear_verdict(load_scenario("postcapture")).legs
    assert found.status == "cannot say"
    assert found.sentence == "motion: cannot say; reason"
    assert math.isnan(found.radius)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("override", "leg", "left_out"),
    [
        ({"supervisor": {}}, "stop", "the supervisor"),
        ({"faults": {}}, "stop", "the faults"),
        ({"capture": {"closing": {}}}, "approach", "the gripper's closing"),
    ],
)
def test_what_the_linear_loop_leaves_out_is_said(override, leg, left_out):
    found = linear_verdict(load_scenario("tumbling_capture", [override]))
    sentences = {each.leg: each.sentence for each in found.legs}
    assert f"without limits, noise and {left_out}" in sentences[leg]
