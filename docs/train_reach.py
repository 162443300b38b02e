"""PPO of Stable-Baselines3 learns the reach of ffsm/FreeFloating-v0, and flies it as a control law.

python docs/train_reach.py [--steps 100000] [--out FOLDER]

Needs pip install 'ffsm-drake[gymnasium,policy]' stable-baselines3 onnx. The agent commands the
torques of the joints, five times a second, in 16 copies of a reach of 5 s. Writes
reach.onnx, for ``controller: policy:reach.onnx``, and the curve of docs/gymnasium.md, reach.png.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium
import matplotlib as mpl
import numpy as np
import onnx
import torch
from matplotlib.figure import Figure
from onnx import helper, numpy_helper
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

import ffsm_drake.plugins.gymnasium  # noqa: F401 (registers the missions)
from ffsm_drake.show.figures.axes import STYLE
from ffsm_drake.show.style import BLUE

MISSION = "ffsm/FreeFloating-v0"
OVERRIDES = ("duration=6", "reference.duration=5")
SETTINGS = {"law": "tdc", "scale": 20.0, "samples_per_step": 20}  # tdc: errors are of the joints


class Copies(VecEnv):
    """Gymnasium's VectorEnv of this package as Stable-Baselines3's. ``returns`` are those of all
    episodes so far, each with the number of steps of all copies.
    """

    def __init__(self, envs: gymnasium.vector.VectorEnv) -> None:
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)
        self.envs, self.returns, self._steps = envs, list[tuple[int, float]](), 0
        self._sum = np.zeros(self.num_envs)

    def reset(self) -> np.ndarray:
        return self.envs.reset(seed=self._seeds[0])[0]

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        seen, reward, ended, cut, _ = self.envs.step(self._actions)
        over, last = ended | cut, seen
        self._steps, self._sum = self._steps + self.num_envs, self._sum + reward
        self.returns += [(self._steps, each) for each in self._sum[over]]
        self._sum[over] = 0.0
        if over.any():  # not in a step of its own
            seen = self.envs.reset(options={"reset_mask": over})[0]
        infos = [
            {"terminal_observation": last[i], "TimeLimit.truncated": bool(cut[i])}
            if over[i]
            else {}
            for i in range(self.num_envs)
        ]
        return seen, reward, over, infos

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError(attr_name)

    def env_method(self, method_name: str, *args: Any, **settings: Any) -> list[Any]:
        raise NotImplementedError(method_name)

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


def train(steps: int) -> tuple[PPO, VecNormalize, Copies]:
    """The agent after so many steps of all copies, its observations' scaling, and the copies."""
    torch.set_num_threads(1)
    envs = gymnasium.make_vec(
        MISSION,
        num_envs=16,
        vectorization_mode="vector_entry_point",
        overrides=OVERRIDES,
        **SETTINGS,
    )
    copies = Copies(envs)
    scaled = VecNormalize(copies, gamma=0.9)
    agent = PPO(
        "MlpPolicy",
        scaled,
        n_steps=31,
        batch_size=124,
        gamma=0.9,
        learning_rate=1e-3,
        policy_kwargs={"net_arch": [32, 32], "log_std_init": -1.0},
        seed=0,
        device="cpu",
    )
    agent.learn(steps)
    return agent, scaled, copies


def export(agent: PPO, scaled: VecNormalize, path: Path) -> None:
    """The agent's mean actions as an ONNX file, the scaling of observations in its first layer."""
    net, moments = agent.policy, scaled.obs_rms
    layers = [each for each in net.mlp_extractor.policy_net if hasattr(each, "weight")]
    pairs = [
        [each.weight.detach().numpy().astype(float), each.bias.detach().numpy().astype(float)]
        for each in (*layers, net.action_net)
    ]
    deviation = np.sqrt(moments.var + scaled.epsilon)
    nodes, given = list[Any](), list[Any]()
    name = "scaled"
    for key, values in {"mean": moments.mean, "deviation": deviation}.items():
        given.append(numpy_helper.from_array(np.asarray(values, np.float32), key))
    nodes += [
        helper.make_node("Sub", ["observation", "mean"], ["centred"]),
        helper.make_node("Div", ["centred", "deviation"], ["wide"]),
    ]
    for key, value in {"least": -scaled.clip_obs, "most": scaled.clip_obs}.items():
        given.append(numpy_helper.from_array(np.float32(value), key))
    nodes.append(helper.make_node("Clip", ["wide", "least", "most"], [name]))
    for i, (weight, bias) in enumerate(pairs):
        for key, values in {f"w{i}": weight.T, f"b{i}": bias}.items():
            given.append(numpy_helper.from_array(np.ascontiguousarray(values, np.float32), key))
        final = i == len(pairs) - 1
        out = "action" if final else f"linear{i}"
        nodes.append(helper.make_node("Gemm", [name, f"w{i}", f"b{i}"], [out]))
        if not final:
            name = f"layer{i}"
            nodes.append(helper.make_node("Tanh", [out], [name]))
    ports = [
        helper.make_tensor_value_info(port, onnx.TensorProto.FLOAT, [1, size])
        for port, size in (("observation", moments.mean.size), ("action", pairs[-1][1].size))
    ]
    graph = helper.make_graph(nodes, "reach", ports[:1], ports[1:], given)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 9
    env = gymnasium.make(MISSION, overrides=OVERRIDES, **SETTINGS).unwrapped
    helper.set_model_props(model, env.policy_metadata())
    onnx.save(model, path)


def draw(returns: list[tuple[int, float]], path: Path) -> None:
    """The returns of episodes over the steps so far."""
    steps, values = np.array(returns).T
    mpl.rcParams.update(STYLE)
    figure = Figure(figsize=(5.6, 2.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(steps, -values, ".", color=BLUE, alpha=0.25, markersize=3, label="an episode")
    width = 32
    means = np.convolve(-values, np.full(width, 1.0 / width), mode="valid")
    axes.plot(steps[width - 1 :], means, color=BLUE, label=f"mean of {width}")
    axes.set_yscale("log")
    axes.set_xlabel("steps of all copies")
    axes.set_ylabel("-return")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--out", type=Path, default=Path())
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    trained = train(arguments.steps)
    export(*trained[:2], arguments.out / "reach.onnx")
    draw(trained[2].returns, arguments.out / "reach.png")
    print(f"last returns: {np.mean([each for _, each in trained[2].returns[-32:]]):.0f}")
