"""What the verdict says about barriers, compared with runs."""

import re

import numpy as np
import pytest
from click.testing import CliRunner

from ffsm_drake import load_scenario, make_rollout
from ffsm_drake.cli import main
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.barriers.margin import barrier_remark, margins_along
from ffsm_drake.plugins.design.verdict import verdict
from ffsm_drake.systems.reference import make_motion

SHORT = ["duration=5", "reference.duration=5", "controller=computed_torque"]
CALM = [
    "sensing.position_noise=0", "sensing.velocity_noise=0", "disturbance.amplitude_scale=0",
    "payload.truth.mass=80", "payload.truth.center_of_mass=[0, 0, 0]",
    "payload.truth.inertia=[12, 12, 12]",
]  # fmt: skip


def drawn(seed, *, acts):
    """A mission that tracks its plan, with limits of rate and position near it."""
    rng = np.random.default_rng([67, seed])
    goal = [f"target_posture.joints.joint_{k}={rng.uniform(-0.5, 0.5)}" for k in range(1, 6)]
    bare = Mission(load_scenario("postcapture", [*SHORT, *CALM, *goal]))
    motion = make_motion(bare)
    q, v, _ = motion.evaluate(np.linspace(motion.begin, motion.end, 501))
    rate = np.abs(v[:, 6:]).max() * (rng.uniform(0.5, 0.9) if acts else rng.uniform(1.5, 3.0))
    joint = int(rng.integers(1, 6))
    upper = q[:, 6 + joint].max() + (1.0 if acts else rng.uniform(0.2, 0.5))
    given = f"command_filter.barriers={{rate: {rate}, upper: {{joint_{joint}: {upper}}}}}"
    return Mission(load_scenario("postcapture", [*SHORT, *CALM, *goal, given]))


@pytest.mark.slow
@pytest.mark.parametrize("acts", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_the_verdict_says_whether_barriers_act(seed, acts):
    mission = drawn(seed, acts=acts)
    remark, log = barrier_remark(mission), make_rollout(mission).run()
    changed = np.abs(log["barrier_force"]).max(axis=1) > 0.0
    assert changed.any() == acts
    assert ("they act" in remark) == acts
    if acts:
        at = float(re.search(r"at t = (\S+) s", remark)[1])
        assert at == pytest.approx(log.time[changed.argmax()], abs=0.1)
    else:
        assert "inactive" in remark


@pytest.mark.parametrize("seed", range(3))
def test_margins_are_distances_from_the_conditions(seed):
    """Of a barrier h >= 0 after a period, from the planned motion itself: nominal = true."""
    rng = np.random.default_rng([68, seed])
    a, b, m, w = rng.uniform([0.5, 2.0, 0.0, 0.2], [4.0, 9.0, 0.05, 0.5])
    upper = rng.uniform(2.0, 3.0)
    barriers = f"{{decay: {a}, rate_decay: {b}, margin: {m}, rate: {w}, upper: {upper}}}"
    given = [*SHORT, *CALM, f"command_filter.barriers={barriers}"]
    mission = Mission(load_scenario("postcapture", given))
    motion, period = make_motion(mission), mission.scenario.sample_time
    times = np.linspace(0.0, 5.0, 7)
    found, names = margins_along(mission, motion, times)
    q, v, acceleration = (each[:, -5:] for each in motion.evaluate(times))
    h, h_1 = upper - q, -v
    # largest acceleration with psi(t + L) >= (1 - a L) psi(t), by bisection in closed form
    psi = h_1 + a * h
    high = (a * period * psi + a * period * h_1) / (period + 0.5 * a * period**2)
    high = np.minimum(high, b * (w - v)) - m
    low = -b * (w + v) + m
    from_high, from_low = high - acceleration, acceleration - low
    limited = np.minimum(from_high, from_low)
    assert names[0] == "joint_1"
    assert (found <= limited + 1e-9).all()  # the URDF's limits come in addition
    is_own = found < limited - 1e-9
    assert not is_own.all()
    np.testing.assert_allclose(found[~is_own], limited[~is_own], atol=1e-7)


@pytest.mark.slow
def test_the_verdict_has_a_line_only_with_barriers():
    bare = verdict(load_scenario("postcapture", SHORT), rehearsal=False)
    assert not any(line.startswith("barriers") for line in bare.lines)
    given = [*SHORT, "command_filter.barriers={rate: 1.0}"]
    guarded = verdict(load_scenario("postcapture", given), rehearsal=False)
    assert any(line.startswith("barriers: not in the linear loop") for line in guarded.lines)
    assert "linear loop of every leg without barriers" in guarded.conclusion
    assert "without barriers" not in bare.conclusion


@pytest.mark.slow
@pytest.mark.parametrize("command", ["validate", "stability"])
def test_commands_print_the_line(command):
    given = ["--set", "command_filter.barriers={rate: 0.001}", "--set", "duration=3"]
    result = CliRunner().invoke(main, [command, "postcapture", *given, "--no-rehearsal"])
    assert "barriers: not in the linear loop; they act on the planned motion" in result.output
    (line,) = (line for line in result.output.splitlines() if "barriers: not" in line)
    assert len(line) <= 160


@pytest.mark.slow
def test_a_capture_is_judged_before_and_after_the_grasp():
    """A limit of rate that the approach exceeds is found there."""
    mission = Mission(load_scenario("tumbling_capture"))
    motion = make_motion(mission)
    before, after = (
        np.abs(motion.evaluate(np.linspace(begin, end, 301))[1][:, 6:]).max()
        for begin, end in ((0.0, motion.begin - 0.01), (motion.begin, motion.end))
    )
    rate = 0.9 * max(before, after)
    guarded = f"command_filter.barriers={{rate: {rate}, rate_decay: 50}}"
    remark = barrier_remark(Mission(load_scenario("tumbling_capture", [guarded])))
    at = float(re.search(r"at t = (\S+) s", remark)[1])
    assert (at < motion.begin) == (before > rate)
