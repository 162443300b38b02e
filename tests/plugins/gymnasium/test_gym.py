"""Missions as environments: Gymnasium's own checks, the bits of a run, and how episodes end."""

import math
import os
import sys

import numpy as np
import pytest
from children import PIPE, child
from law_lists import frame_laws

from ffsm_drake import FfsmError, load_scenario, simulate
from ffsm_drake.systems.controllers import controller_names, make_controller

gymnasium = pytest.importorskip("gymnasium", reason="needs gymnasium, an extra")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from ffsm_drake.mission import make_mission  # noqa: E402
from ffsm_drake.plugins.gymnasium.environment import MissionEnv  # noqa: E402
from ffsm_drake.plugins.gymnasium.vector import MissionVectorEnv  # noqa: E402
from ffsm_drake.spacecraft.craft import make_nominal_plant  # noqa: E402


def flown(env, seed, action=None):
    """Rewards, the last info, and how an episode under one action ended."""
    env.reset(seed=seed)
    action = np.zeros(env.action_space.shape) if action is None else action
    rewards, over = [], False
    while not over:
        observation, reward, ended, cut, info = env.step(action)
        assert observation in env.observation_space
        rewards.append(reward)
        over = ended or cut
    return rewards, info, ended


@pytest.mark.smoke
@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        ("PostCapture", np.float32),
        ("PostCapture", np.float64),
        ("TumblingCapture", np.float32),
        ("FreeFloating", np.float32),
    ],
)
def test_gymnasium_finds_nothing_to_complain_of(name, dtype, recwarn):
    env = gymnasium.make(f"ffsm/{name}-v0", action="force", samples_per_step=5, dtype=dtype)
    check_env(env.unwrapped, skip_render_check=True)
    assert not [str(each.message) for each in recwarn if "gymnasium" in str(each.filename)]


LAWS = sorted({*controller_names()} - {*frame_laws()})


@pytest.mark.parametrize("law", LAWS)
def test_a_law_under_actions_of_zero_has_the_bits_of_a_run(law):
    name = "planar_detumble" if law == "torque_against_momentum" else "postcapture"
    scenario = load_scenario(name, ["duration=0.3", f"controller={law}"])
    env = MissionEnv(scenario, action="residual")
    flown(env, 7)
    data = simulate(scenario.replace(random_seed=7), check_stability=False).dataset
    state = np.hstack([data.position.values, data.velocity.values])
    np.testing.assert_array_equal(env.log.series["state"], state)


@pytest.mark.parametrize("law", LAWS)
def test_a_law_as_the_policy_of_forces_has_the_bits_of_a_run(law):
    """Its sample is the law's, and a power of two as the scale takes no bit from the force."""
    name = "planar_detumble" if law == "torque_against_momentum" else "postcapture"
    scenario = load_scenario(name, ["duration=0.3", f"controller={law}"])
    own = make_controller(make_mission(scenario), make_nominal_plant(scenario)).law
    env = MissionEnv(scenario, action="force", dtype=np.float64, scale=2.0**20)
    env.reset(seed=7)
    state, over = own.initial_state(), False
    while not over:
        force, state = own.step(env.sample, state)
        *_, ended, cut, _ = env.step(force[env.coordinates.is_driven] / 2.0**20)
        over = ended or cut
    data = simulate(scenario.replace(random_seed=7), check_stability=False).dataset
    whole = np.hstack([data.position.values, data.velocity.values])
    np.testing.assert_array_equal(env.log.series["state"], whole)


def drawn_steps(random):
    """Duration and period of a run, s, and samples per step, often dividing the run's."""
    period, every = float(random.choice([0.005, 0.01, 0.02])), int(random.integers(1, 12))
    steps, rest = int(random.integers(1, 6)), int(random.integers(0, every))
    samples = steps * every + rest * int(random.integers(2))
    return round(samples * period, 6), period, every, samples


def returned(data, samples, every, scenario):
    """The return of a run's own samples, without the terms of its end."""
    group = ["base_rotation"] * 3 + ["base_position"] * 3 + ["joints"] * 5
    names = data.coordinate.values
    size = [scenario.tolerance_of(*each) for each in zip(names, group, strict=True)]
    excess = np.abs(data["error"].values[:samples]) / size
    effort = (data["generalized_force"].values[:samples] / 50.0) ** 2
    each = -excess.mean(axis=1) - 0.01 * effort.mean(axis=1)
    return sum(each[k : k + every].mean() for k in range(0, samples, every))


NUMBER = int(os.environ.get("FFSM_DRAWN_STEPS", "3"))


@pytest.mark.parametrize("copies", [1, 2])
def test_steps_cover_the_samples_of_a_run_and_no_other(copies):
    """Also where they divide the run; the return is that of the run's samples."""
    random = np.random.default_rng(copies)
    for _ in range(-(-NUMBER // copies)):
        duration, period, every, samples = drawn_steps(random)
        given = [f"duration={duration}", f"sample_time={period}", "actuation.limit=50"]
        given += ["sensing.velocity_noise=0", "controller=tdc"]
        scenario = load_scenario("postcapture", given)
        settings = {"scenario": scenario, "action": "residual", "samples_per_step": every}
        env = MissionEnv(**settings) if copies == 1 else MissionVectorEnv(copies, **settings)
        env.reset(seed=5)
        count, total, over, zero = 0, 0.0, False, np.zeros(env.action_space.shape)
        while not over:
            seen, reward, ended, cut, info = env.step(zero)
            assert not np.any(ended)
            count, total, over = count + 1, total + reward, bool(np.all(cut))
        env.close()
        assert count == math.ceil(samples / every), (duration, period, every)
        data = simulate(scenario.replace(random_seed=5), check_stability=False).dataset
        end = 10.0 * (info["reward_terms"]["settled"] + info["reward_terms"]["failure"])
        expected = returned(data, samples, every, scenario) + end
        np.testing.assert_allclose(total, expected, rtol=1e-9)
        velocity = np.atleast_2d(seen)[:, -11:]
        np.testing.assert_allclose(velocity[0], data["velocity"].values[-1], rtol=1e-5, atol=1e-9)


@pytest.mark.long
def test_a_capture_goes_through_its_legs():
    scenario = load_scenario("tumbling_capture", ["duration=20.5"])
    env = MissionEnv(scenario, action="residual", samples_per_step=50)
    rewards, info, ended = flown(env, 3)
    assert not ended
    assert len(rewards) == 41  # of 50 of the 2050 samples
    assert env.log.grasp is not None
    record = simulate(scenario.replace(random_seed=3), check_stability=False)
    np.testing.assert_array_equal(
        env.log.series["state"][-1, 7:12], record.dataset.position.values[-1, 7:12]
    )
    assert info["ending"] == record.ending.sentence


def test_an_action_acts_and_may_end_the_episode():
    env = MissionEnv("postcapture", ("duration=20", "divergence_speed=0.5"), samples_per_step=10)
    rewards, info, ended = flown(env, 0, np.ones(env.action_space.shape))
    assert ended
    assert "Diverged" in info["ending"]
    assert info["reward_terms"]["failure"] == -1.0
    assert rewards[-1] < -5.0


def test_set_points_move_a_law():
    last = []
    for offset in (0.0, 1.0):
        env = MissionEnv("postcapture", ("duration=2",), action="setpoint", law="tdc")
        flown(env, 1, np.full(env.action_space.shape, offset))
        last.append(env.log.series["state"][-1, 7:12])
    assert (last[1] - last[0] > 0.005).all()


def test_a_reset_within_an_episode_begins_anew():
    env = MissionEnv("postcapture", ("duration=1",))
    first, _ = env.reset(seed=4)
    env.step(np.ones(env.action_space.shape))
    again, _ = env.reset(seed=4)
    np.testing.assert_array_equal(first, again)
    env.close()
    with pytest.raises(FfsmError, match="call reset"):
        env.step(np.ones(env.action_space.shape))


def test_what_is_asked_wrongly_is_named():
    with pytest.raises(FfsmError, match="force, residual, setpoint"):
        MissionEnv("postcapture", action="torque")
    with pytest.raises(FfsmError, match="weights: knows tracking"):
        MissionEnv("postcapture", weights={"speed": 1.0})
    for wrong in (0, -2, 1.5):
        with pytest.raises(FfsmError, match="samples_per_step: must be a whole number from 1 on"):
            MissionEnv("postcapture", samples_per_step=wrong)


def test_they_are_registered():
    env = gymnasium.make("ffsm/PostCapture-v0", overrides=("duration=0.1",))
    env.reset(seed=1)
    assert env.step(env.action_space.sample())[2:4] == (False, False)
    env.close()


@pytest.mark.slow
def test_an_environment_needs_no_import():
    """Gymnasium imports the module before the colon; it has no other plug-ins since 1.0."""
    code = (
        "import gymnasium\n"
        "name = 'ffsm_drake.plugins.gymnasium:ffsm/PostCapture-v0'\n"
        "print(gymnasium.make(name, overrides=('duration=0.1',)).spec.id)\n"
    )
    with child([sys.executable, "-c", code], stdout=PIPE, text=True) as process:
        assert process.communicate(timeout=100)[0] == "ffsm/PostCapture-v0\n"


def test_a_law_of_a_frame_with_no_residual_has_the_bits_of_simulate():
    """The agent sees the frame's errors, and the ending is judged by the frame."""
    scenario = load_scenario("free_floating", ["duration=0.2"])
    env = gymnasium.make("ffsm/FreeFloating-v0", scenario=scenario, action="residual")
    env.reset(seed=3)
    ended = cut = False
    while not (ended or cut):
        *_, ended, cut, info = env.step(np.zeros(env.action_space.shape))
    alone = simulate(scenario.replace(random_seed=3), check_stability=False)
    log = env.unwrapped.log
    assert log.tracks_frame
    assert info["ending"] == alone.ending.sentence
    assert any(name.startswith("error.frame_") for name in env.unwrapped.observation_names)
    np.testing.assert_array_equal(
        log.series["state"][:, -5:], alone.dataset.velocity.values[:, -5:]
    )
    env.close()
