"""Several spacecraft in one environment: the results of single ones, and how copies end."""

import numpy as np
import pytest

from ffsm_drake import FfsmError

gymnasium = pytest.importorskip("gymnasium", reason="needs gymnasium, an extra")

import ffsm_drake.plugins.gymnasium  # noqa: E402, F401

NUMBER = 3


def made(name="ffsm/PostCapture-v0", mode="vector_entry_point", **settings):
    return gymnasium.make_vec(name, num_envs=NUMBER, vectorization_mode=mode, **settings)


def pair(*args, **settings):
    """A wide environment, and single ones in a row, reset with the same seed."""
    both = made(*args, **settings), made(*args, mode="sync", **settings)
    first, second = (env.reset(seed=3)[0] for env in both)
    np.testing.assert_array_equal(first, second)
    return both


@pytest.mark.smoke
@pytest.mark.parametrize("name", ["ffsm/PostCapture-v0", "ffsm/FreeFloating-v0"])
@pytest.mark.parametrize("action", ["force", "residual"])
def test_every_copy_has_the_bits_of_a_single_one(name, action):
    """In the episode after the next begin, too."""
    wide, alone = pair(name, action=action, overrides=("duration=0.1",), samples_per_step=3)
    draw = np.random.default_rng(1)
    cuts = 0
    for _ in range(12):
        actions = draw.uniform(-0.05, 0.05, wide.action_space.shape).astype(np.float32)
        (seen, reward, *flags, info), (own, own_reward, *own_flags, own_info) = (
            env.step(actions) for env in (wide, alone)
        )
        assert seen in wide.observation_space
        np.testing.assert_array_equal(seen, own)
        np.testing.assert_array_equal(reward, own_reward)
        np.testing.assert_array_equal(flags, own_flags)
        if flags[1].any():
            cuts += 1
            np.testing.assert_array_equal(info["ending"], own_info["ending"])
    assert cuts == 2
    wide.close()


@pytest.mark.parametrize(
    ("action", "samples_per_step"),
    [
        ("force", 1),
        ("residual", 2),
        pytest.param("force", 2, marks=pytest.mark.long),
        pytest.param("residual", 1, marks=pytest.mark.long),
    ],
)
def test_a_copy_that_diverges_begins_anew_while_the_others_go_on(action, samples_per_step):
    settings = {"overrides": ("duration=1", "divergence_speed=0.5"), "action": action}
    wide, alone = pair(samples_per_step=samples_per_step, scale=1000.0, **settings)
    actions = np.zeros(wide.action_space.shape)
    actions[1] = 1.0
    ends = 0
    for _ in range(40):
        (seen, reward, ended, *_, info), (own, own_reward, own_ended, *_, own_info) = (
            env.step(actions) for env in (wide, alone)
        )
        np.testing.assert_array_equal(seen, own)
        np.testing.assert_array_equal(reward, own_reward)
        np.testing.assert_array_equal(ended, own_ended)
        if ended.any():
            ends += 1
            assert info["ending"][1] == own_info["ending"][1]
            assert "Diverged" in info["ending"][1]
            assert info["reward_terms"]["failure"].tolist() == [0.0, -1.0, 0.0]
    assert ends > 2
    wide.close()


def test_it_says_how_copies_begin():
    env = made(overrides=("duration=1",))
    assert env.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.NEXT_STEP
    with pytest.raises(FfsmError, match="call reset"):
        env.step(np.zeros(env.action_space.shape))
    env.close()
