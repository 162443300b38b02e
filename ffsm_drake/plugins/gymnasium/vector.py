"""A mission of several spacecraft as a VectorEnv: single environments, one after another."""

import functools
from typing import Any

import numpy as np
from gymnasium.vector import SyncVectorEnv

from ffsm_drake.plugins.gymnasium.environment import MissionEnv, clipped


class MissionVectorEnv(SyncVectorEnv[np.ndarray, np.ndarray]):
    """``num_envs`` copies of a mission, each with the results of a MissionEnv of the same seed.

    Seeds count up from the first copy's. At the step after the last one of its episode, a copy
    restarts and its action is ignored.
    """

    envs: list[MissionEnv]  # type: ignore[assignment]

    def __init__(self, num_envs: int, *args: Any, **settings: Any) -> None:
        """Args: the number of copies; then the arguments of ``MissionEnv``.

        Raises the errors of ``MissionEnv``.
        """
        super().__init__([functools.partial(MissionEnv, *args, **settings)] * num_envs)
        one = self.envs[0]
        self.action_names, self.observation_names = one.action_names, one.observation_names

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """As Gymnasium's. A NaN action ends its copy, as in MissionEnv."""
        return super().step(clipped(actions, self.action_space.shape))
