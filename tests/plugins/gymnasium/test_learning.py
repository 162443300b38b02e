"""PPO of Stable-Baselines3 learns a mission, and what it learned flies as a control law."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from ffsm_drake import load_scenario, simulate

pytest.importorskip(
    "stable_baselines3", reason="needs stable-baselines3, whose PyTorch takes more than 500 MB"
)
pytest.importorskip("onnx", reason="needs onnx, of the extra test")
pytest.importorskip("onnxruntime", reason="needs onnxruntime, an extra")

from ffsm_drake.plugins.gymnasium.environment import MissionEnv
from ffsm_drake.systems.registry import find_factory

REACH = runpy.run_path(str(Path(__file__).parents[3] / "docs" / "train_reach.py"))


def flown(act):
    """The return of an episode, and the environment after it."""
    env = MissionEnv("free_floating", REACH["OVERRIDES"], **REACH["SETTINGS"])
    (seen, _), total, over = env.reset(seed=5), 0.0, False
    while not over:
        seen, reward, ended, cut, _ = env.step(act(seen))
        total, over = total + reward, ended or cut
    return total, env


@pytest.mark.slow
def test_ppo_learns_the_reach_and_flies_it_as_a_law(tmp_path):
    agent, scaled, copies = REACH["train"](25_000)
    returns = [each for _, each in copies.returns]
    idle, _ = flown(lambda seen: np.zeros(5))
    assert np.mean(returns[:64]) < idle < np.mean(returns[-64:]), "in spite of its exploration"
    REACH["export"](agent, scaled, tmp_path / "reach.onnx")
    policy = find_factory("controller", "policy:reach.onnx", python_path=[str(tmp_path)])
    learned, env = flown(lambda seen: policy.act(seen.astype(float)))
    assert learned > 0.5 * idle
    scenario = load_scenario(
        "free_floating",
        [*REACH["OVERRIDES"], "controller=policy:reach.onnx", f"python_path=[{tmp_path}]"],
    )
    run = simulate(scenario.replace(random_seed=5), check_stability=False)
    np.testing.assert_allclose(
        run.dataset.position.values, env.log.series["state"][:, :12], atol=1e-6
    )
