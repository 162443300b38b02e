"""A mission of several spacecraft as a VectorEnv: in machine code, or one by one on Drake."""

import copy
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import SyncVectorEnv

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.plugins.gymnasium.environment import TERMS, MissionEnv, clipped
from ffsm_drake.plugins.policy.policy import observation
from ffsm_drake.runs.engine import DRAKE, NotCovered, find_engine

_COMPILED = "compiled"


class MissionVectorEnv(SyncVectorEnv[np.ndarray, np.ndarray]):
    """``num_envs`` copies of a mission, each with the results of a MissionEnv of the same seed.

    Seeds count up from the first copy's. At the step after the last one of its episode, a copy
    restarts and its action is ignored. ``engine`` is what simulates the copies, and the reason:
    machine code (results equal Drake's to rounding, and do not depend on the number of copies), or
    Drake, bit for bit as MissionEnv.
    """

    envs: list[MissionEnv]  # type: ignore[assignment]

    def __init__(
        self, num_envs: int, *args: Any, engine: str | None = None, **settings: Any
    ) -> None:
        """Args:
          num_envs: the number of copies.
          args: the arguments of ``MissionEnv``.
          engine: "compiled" or "drake"; default: the first that can simulate the mission.
          settings: as ``args``.

        Raises the errors of ``MissionEnv``; FfsmError: the engine cannot simulate the mission.
        """
        if num_envs < 1:
            raise FfsmError(f"num_envs: must be 1 or more, not {num_envs}")
        one = MissionEnv(*args, **settings)
        super().__init__([functools.partial(copy.copy, one)] * num_envs)
        self.action_names, self.observation_names = one.action_names, one.observation_names
        self._every = min(one.samples_per_step, one.scenario.num_control_periods)
        self._left: np.ndarray | None = None  # samples to the end of each copy's run
        self._lanes: Any = None  # of the compiled engine
        self.engine = DRAKE
        if engine != DRAKE:
            try:
                self._lanes = self._compiled(engine or _COMPILED)
                self.engine = self._lanes.engine
            except FfsmError as error:
                if engine is not None:
                    raise
                why = error.what if isinstance(error, NotCovered) else one_line(error)
                self.engine = f"{DRAKE} (not covered: {why})"

    def _compiled(self, name: str) -> Any:
        one = self.envs[0]
        found = find_engine(name)
        assert found is not None
        return found.lanes(one.mission, one.steering, self.num_envs, self._every)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """New runs of all copies; a single seed counts up from copy to copy."""
        if self._lanes is None:
            return super().reset(seed=seed, options=options)
        seeds = range(seed, seed + self.num_envs) if isinstance(seed, int) else seed
        chosen = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        if self._left is None and not chosen.all():
            raise FfsmError("options: reset_mask leaves copies without an episode: leave it out")
        self._autoreset_envs = self._autoreset_envs & ~chosen
        self._begin(np.flatnonzero(chosen), seeds or [None] * self.num_envs)
        return self._observations.copy(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """As Gymnasium's. A NaN action ends its copy, as in MissionEnv."""
        given = clipped(actions, self.action_space.shape)
        lanes = self._lanes
        if lanes is None:
            return super().step(given)
        if (left := self._left) is None:
            raise FfsmError("the episode is over, or did not begin: call reset")
        self._left = None  # until the step is complete
        anew, going, most = self._autoreset_envs, ~self._autoreset_envs, self._every
        lanes.remember("action", given)
        lanes.advance(most, going)
        due, acted = np.minimum(left, most), lanes.cell("acted_on").astype(int)
        is_last, number = left <= most, lanes.periods - left + due
        # the run of a copy that leaves its bounds ends with the action at this sample
        edge, lost = number * self.envs[0].scenario.sample_time, lanes.lost & going
        seen_at = lanes.cell("seen_at")
        ended = lost & ((seen_at < edge) | (is_last & (seen_at == edge)))
        cut = is_last & ~ended & going
        terms = self._terms(np.where(going, np.minimum(acted, due), 0))
        now = np.flatnonzero(going & ~ended)
        self._see(now, due[now])
        info: dict[str, Any] = {}
        masks = dict.fromkeys(terms, going)
        if (over := ended | cut).any():
            more = "settled", "failure"
            terms |= {name: np.zeros(self.num_envs) for name in more}
            masks |= dict.fromkeys(more, over)
            for i in np.flatnonzero(over).tolist():
                ending = lanes.log(i, diverged=bool(ended[i])).ending
                terms["settled"][i] = float(ending.is_settled)
                terms["failure"][i] = -float(ending.is_failure)
                own = {"ending": ending.sentence, "is_success": ending.is_settled}
                info = self._add_info(info, own, i)
            lanes.restart(np.flatnonzero(over))
        if going.any():
            masked = {f"_{name}": mask for name, mask in masks.items()}
            info |= {"reward_terms": terms | masked, "_reward_terms": going}
        self._left = left - most
        self._autoreset_envs = over
        if anew.any():
            self._begin(np.flatnonzero(anew), [None] * self.num_envs)
        return self._observations.copy(), self.envs[0].reward_of(terms), ended, cut, info

    def close_extras(self, **settings: Any) -> None:
        """End the runs."""
        self._left = None
        super().close_extras(**settings)

    def _terms(self, samples: np.ndarray) -> dict[str, np.ndarray]:
        """The reward's terms of a step in which the copies acted at so many samples (num_envs)."""
        found = self._lanes.signals["terms"][:, : self._every]
        is_own = np.arange(self._every) < samples[:, None]
        # one after the other, whatever the number of copies
        sums = np.cumsum(np.where(is_own[..., None], found, 0.0), axis=1)[:, -1]
        means = sums / np.maximum(samples, 1)[:, None]
        return dict(zip(TERMS, means.T, strict=True))

    def _begin(self, copies: np.ndarray, seeds: Sequence[int | None]) -> None:
        """New runs of some copies."""
        lanes, chosen = self._lanes, np.zeros(self.num_envs, bool)
        for i in copies.tolist():
            lanes.begin(i, self.envs[i].drawn(seeds[i]))
        lanes.restart(copies)
        chosen[copies] = True
        lanes.advance(0, chosen)
        self._see(copies, np.zeros(copies.size, int))
        if self._left is None:
            self._left = np.zeros(self.num_envs, int)
        self._left[copies] = lanes.periods

    def _see(self, copies: np.ndarray, rows: np.ndarray) -> None:
        """Keep the observations of copies, at so many samples of the last step."""
        seen = self._lanes.signals["seen"][copies, rows]
        self._observations[copies] = observation(seen, self._observations.dtype)
