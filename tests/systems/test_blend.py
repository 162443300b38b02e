"""Polynomials and input shapers against closed forms, and the vibration that they leave."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import simpson

from ffsm_drake import ScenarioError, load_scenario
from ffsm_drake.mission import make_mission
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import Reference, Shaper
from ffsm_drake.systems.blend import Blend, make_impulses, septic_blend, septic_stop
from ffsm_drake.systems.reference import make_motion

FREQUENCY, DURATION = 0.25, 9.0  # Hz, s
END = np.array([0.0, DURATION])


def blend(order="quintic", duration=DURATION, **shaper):
    return Blend(Reference(kind=order, shaper=Shaper(**shaper) if shaper else None), duration)


def residual(signal, frequency, damping, *, end=DURATION):
    """Amplitude of the vibration that an acceleration leaves at its end, of a unit oscillator at
    rest before.
    """
    w, times = 2.0 * np.pi * frequency, np.linspace(0.0, end, 40001)
    damped = w * np.sqrt(1 - damping**2)
    left = np.exp((-damping * w + 1j * damped) * (end - times))
    return float(abs(simpson(signal(times)[2] * left, x=times)) / damped)


def closed_form(impulses, frequency, damping):
    """The share of a vibration that a shaper leaves (Singer and Seering): of the last impulse's
    time on.
    """
    w, delays, shares = (
        2.0 * np.pi * frequency,
        np.array(impulses.delays),
        np.array(impulses.shares),
    )
    phases = 1j * w * np.sqrt(1 - damping**2) * delays
    return abs((shares * np.exp(damping * w * (delays - impulses.length) + phases)).sum())


@pytest.mark.smoke
def test_septic_starts_and_ends_without_jerk():
    h = 1e-5
    for of in (septic_blend, septic_stop):
        for end, inwards in ((0.0, h), (DURATION, -h)):
            acceleration = of(np.array([end, end + inwards]), DURATION)[2]
            assert acceleration[0] == 0.0
            assert abs(acceleration[1] / h) < 1e-4  # the quintic's jerk is 60/T^3, 0.08
    times = np.linspace(0.0, DURATION, 20001)
    s, rate, acceleration = septic_blend(times, DURATION)
    assert (s[0], s[-1]) == (0.0, pytest.approx(1.0, abs=1e-14))
    assert rate.max() == pytest.approx(2.1875 / DURATION, rel=1e-9)
    assert acceleration.max() == pytest.approx(420 * 0.04 / np.sqrt(5.0) / DURATION**2, rel=1e-6)
    g, rate, _ = septic_stop(END, DURATION)
    np.testing.assert_allclose(g, 0.0, atol=1e-15)
    np.testing.assert_allclose(rate, [1.0, 0.0], atol=1e-15)


SHAPERS = {
    "quintic": {},
    "zv": {"frequencies": [FREQUENCY], "damping_ratio": 0.02},
    "zvd": {"kind": "zvd", "frequencies": [FREQUENCY]},
    "two": {"frequencies": [FREQUENCY, 0.6], "damping_ratio": 0.1},
}


@pytest.mark.parametrize("shaper", SHAPERS.values(), ids=SHAPERS)
@pytest.mark.parametrize("kind", ["quintic", "septic"])
def test_rates_are_derivatives_and_the_ends_exact(kind, shaper):
    made, h = blend(kind, **shaper), 1e-4
    times = np.linspace(0.1, DURATION - 0.1, 57)
    for of in (made.blend, made.stop):
        before, now, after = of(times - h), of(times), of(times + h)
        np.testing.assert_allclose((after[0] - before[0]) / (2 * h), now[1], rtol=0, atol=1e-6)
        np.testing.assert_allclose((after[1] - before[1]) / (2 * h), now[2], rtol=0, atol=1e-5)
    for of, value, rate in (
        (made.blend, [0.0, 1.0], [0.0, 0.0]),
        (made.stop, [0.0, 0.0], [1.0, 0.0]),
    ):
        found = of(END)
        np.testing.assert_allclose(found[0], value, rtol=0, atol=1e-14)
        np.testing.assert_allclose(found[1], rate, rtol=0, atol=1e-14)
        np.testing.assert_allclose(found[2], 0.0, rtol=0, atol=1e-14)
        np.testing.assert_allclose(
            of(np.array([-1.0, DURATION + 1.0]))[0], value, rtol=0, atol=1e-14
        )


@pytest.mark.parametrize("damping", [0.0, 0.005, 0.1])
@pytest.mark.smoke
def test_zv_leaves_no_vibration_at_its_frequency(damping):
    """The oscillator hangs on what moves by the blend, or by the stop from a velocity."""
    shaped = blend(frequencies=[FREQUENCY], damping_ratio=damping)
    for with_, without in ((shaped.blend, blend().blend), (shaped.stop, blend().stop)):
        assert residual(with_, FREQUENCY, damping) < 1e-7
        assert residual(without, FREQUENCY, damping) > 1e-3


def test_two_frequencies_at_once():
    shaped = blend(frequencies=[FREQUENCY, 0.6], damping_ratio=0.01)
    for frequency in (FREQUENCY, 0.6):
        assert residual(shaped.blend, frequency, 0.01) < 1e-7


def test_zvd_is_good_near_its_frequency():
    """10 % off: ZV leaves |cos(0.55 pi)|, 15.6 %, ZVD its square, 2.4 %."""
    zv, zvd = (
        make_impulses(Shaper(kind=kind, frequencies=[1.0], damping_ratio=0.0))
        for kind in ("zv", "zvd")
    )
    for off in (0.9, 1.1):
        left = abs(np.cos(0.5 * np.pi * off))
        assert closed_form(zv, off, 0.0) == pytest.approx(left, abs=1e-9)
        assert closed_form(zvd, off, 0.0) == pytest.approx(left**2, abs=1e-9)
    assert zvd.shares == pytest.approx((0.25, 0.5, 0.25))
    assert zvd.delays == pytest.approx((0.0, 0.5, 1.0))


def test_the_residual_is_the_closed_forms_share_of_the_unshaped_one():
    shaper = {"kind": "zvd", "frequencies": [FREQUENCY], "damping_ratio": 0.0}
    impulses, off = make_impulses(Shaper(**shaper)), 1.1 * FREQUENCY
    own = blend(duration=DURATION - impulses.length)
    left = residual(own.blend, off, 0.0, end=own.duration)
    expected = closed_form(impulses, off, 0.0) * left
    assert residual(blend(**shaper).blend, off, 0.0) == pytest.approx(expected, rel=1e-6)


def test_a_backwards_motion_is_shaped_backwards():
    """What is run backwards leaves no vibration where it ends, which is where it was planned
    from.
    """
    reference = Reference(shaper=Shaper(frequencies=[FREQUENCY], damping_ratio=0.1))
    made = Blend(reference, DURATION, backwards=True)
    assert residual(lambda times: made.blend(DURATION - times), FREQUENCY, 0.1) < 1e-7
    assert (
        residual(
            lambda times: blend(**vars(reference.shaper)).blend(DURATION - times), FREQUENCY, 0.1
        )
        > 1e-5
    )


@pytest.mark.parametrize("kind", ["quintic", "septic"])
def test_stopping_anywhere_costs_least_there(kind):
    made, times = blend(kind), np.linspace(0.0, DURATION, 4001)
    s, g = made.blend(times)[2], made.stop(times)[2]
    best = -np.trapezoid(s * g, times) / np.trapezoid(s * s, times)
    assert made.stopping_time == pytest.approx(best, rel=1e-5)


LIMITED = ("actuation.limit={base_position: 5, base_rotation: 3, joints: 3}", "reference.reserve=0")


def test_the_shortest_duration_counts_the_shaper():
    scenario = load_scenario("postcapture", ["reference.duration=auto", *LIMITED])
    durations = {
        name: make_motion(make_mission(dataclasses.replace(scenario, reference=reference))).end
        for name, reference in {
            "quintic": scenario.reference,
            "septic": dataclasses.replace(scenario.reference, kind="septic"),
            "zv": dataclasses.replace(scenario.reference, shaper=Shaper(frequencies=[FREQUENCY])),
            "slow": dataclasses.replace(
                scenario.reference, shaper=Shaper(kind="zvd", frequencies=[0.02])
            ),
        }.items()
    }
    # Peak accelerations alone would give 1.14.
    assert 1.05 < durations["septic"] / durations["quintic"] < np.sqrt(7.5132 / 5.7735)
    assert durations["quintic"] < durations["zv"] < durations["quintic"] + 2.0 + 1e-9
    assert durations["slow"] > 50.0


def test_a_shaped_motion_goes_from_posture_to_posture():
    overrides = ["reference.kind=septic", "reference.shaper={kind: zvd, frequencies: [0.25]}"]
    scenario, plain = load_scenario("postcapture", overrides), load_scenario("postcapture")
    motion, usual = make_motion(make_mission(scenario)), make_motion(make_mission(plain))
    for time in (0.0, 20.0, 25.0):
        for mine, its in zip(motion.evaluate(time), usual.evaluate(time), strict=True):
            np.testing.assert_allclose(mine, its, rtol=0, atol=1e-12)
    assert np.abs(motion.evaluate(7.0)[1] - usual.evaluate(7.0)[1]).max() > 1e-3


def test_a_capture_is_shaped_on_both_sides_of_the_grasp():
    scenario = load_scenario("tumbling_capture", ["reference.shaper={frequencies: [0.25]}"])
    make_rollout(scenario).check()
    motion = make_motion(make_mission(scenario))
    plain = make_motion(make_mission(load_scenario("tumbling_capture")))
    # where it is, and how fast, at the ends of both parts
    for time in (0.0, scenario.grasp_time, motion.end):
        for mine, its in zip(motion.evaluate(time)[:2], plain.evaluate(time)[:2], strict=True):
            np.testing.assert_allclose(mine, its, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (
            ("reference.kind=sextic",),
            "reference.kind: 'sextic' is unknown; choose one of quintic, septic, optimal",
        ),
        (
            ("reference.shaper={}",),
            "reference.shaper.frequencies: must hold 1 to 4 values, not 0",
        ),
        (
            ("reference.shaper={frequencies: [0]}",),
            "reference.shaper.frequencies[0]: must be > 0, at most 1000 Hz, not 0",
        ),
        (
            ("reference.shaper={kind: zvx, frequencies: [1]}",),
            "shaper.kind: 'zvx' is unknown; choose one of zv, zvd",
        ),
        (
            ("reference.shaper={frequencies: [1], damping_ratio: 1}",),
            "damping_ratio: must be from 0 to below 1, not 1",
        ),
        (
            (
                "reference.shaper={frequencies: [1]}",
                "reference.kind=optimal",
                "reference.plan=x.yaml",
            ),
            "reference.shaper: has no effect on a plan",
        ),
        (
            ("reference.shaper={kind: zvd, frequencies: [0.05]}",),
            "reference.shaper: needs 20 s of a motion of 20 s; lengthen reference.duration",
        ),
    ],
)
def test_errors_are_one_clear_line(overrides, expected):
    with pytest.raises(ScenarioError) as error:
        make_motion(make_mission(load_scenario("postcapture", overrides)))
    assert expected in str(error.value)
    assert "\n" not in str(error.value)
