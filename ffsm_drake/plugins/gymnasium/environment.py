"""A mission as an environment of Gymnasium: one step is one control sample, or several.

The run is that of ``simulate``: a thread runs it, and its control law requests an action at each
step.
"""

import dataclasses
import functools
import json
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.gymnasium.aside import Aside
from ffsm_drake.plugins.policy.policy import (
    ACTIONS,
    FURTHEST,
    ActingLaw,
    error_names,
    inner_law,
    observation,
    observation_names,
)
from ffsm_drake.plugins.task_space.tasks import TaskSpace
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import Scenario, load_scenario
from ffsm_drake.systems.controllers import ControlLaw
from ffsm_drake.systems.controllers.law import Sample, State
from ffsm_drake.systems.mission_limits import actuation_limit
from ffsm_drake.systems.registry import find_factory
from ffsm_drake.systems.setup import BlockSetup

TERMS = ("tracking", "effort")  # of the reward at each sample
WEIGHTS = {"tracking": 1.0, "effort": 0.01, "settled": 10.0, "failure": 10.0}
_UNLIMITED = 100.0  # N m or N; replaces a missing force limit
_MOST = 1e3  # an error in tolerances, and a force in limits


class Exchange:
    """Exchange between the run's law and the environment, in two threads, at every step."""

    def __init__(self, samples_per_step: int, periods: int) -> None:
        """``periods`` is the number of control periods of a run."""
        self._every, self._periods = samples_per_step, periods
        self.run = Aside()
        self.sample: Sample | None = None  # input of the law
        self.end: np.ndarray | None = None  # the law's view at the end of the run's time
        self._count, self._action = 0, np.zeros(0)
        self._since = list[np.ndarray]()

    def ask(self, seen: np.ndarray, sample: Sample) -> np.ndarray:
        """The action at a sample, given the law's view ``seen``. No step begins at the end of the
        run's time, from which no force acts. Raises StoppedError.
        """
        if self._count == self._periods:
            self.sample, self.end = sample, seen
        elif self._count % self._every == 0:
            self.sample = sample
            self._action = self.run.ask((seen, self.spent()))
        self._count += 1
        return self._action

    def told(self, terms: np.ndarray) -> None:
        """Keep the reward's terms at a sample."""
        if self._count <= self._periods:
            self._since.append(terms)

    def spent(self) -> np.ndarray:
        """Means of the reward's terms over the samples since the last step (2)."""
        since, self._since = self._since, []
        return np.mean(since or [np.zeros(2)], axis=0)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Reward:
    """The terms of a reward at a sample."""

    tolerance: np.ndarray  # (n) of the errors
    limit: np.ndarray  # (nv) of the force
    counts: np.ndarray  # (n) which of the errors count

    def terms(self, error: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Tracking and effort (..., 2), of errors (..., n) and forces (..., nv)."""
        excess, effort = (
            np.where(size < _MOST, size, _MOST)  # also for NaN
            for size in (np.abs(error) / self.tolerance, np.abs(force) / self.limit)
        )
        excess = excess[..., self.counts]
        sums = excess.sum(axis=-1), (effort**2).sum(axis=-1)
        return np.stack([-sums[0] / excess.shape[-1], -sums[1] / effort.shape[-1]], axis=-1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Steered(ActingLaw):
    """The law of an environment's actions. They come from an exchange, or are set in its memory,
    where it leaves the observation and the reward's terms.
    """

    logged: ClassVar[tuple[str, ...]] = ("seen", "terms")
    reward: Reward
    num_seen: int
    exchange: Exchange | None

    def initial_state(self) -> State:
        own = {"action": self.acts.size, "seen": self.num_seen, "terms": 2}
        return {**super().initial_state(), **{name: np.zeros(n) for name, n in own.items()}}

    def action(self, seen: np.ndarray, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        action = state["action"] if self.exchange is None else self.exchange.ask(seen, sample)
        return action, {"action": action, "seen": seen, "terms": state["terms"]}

    def told(self, error: np.ndarray, force: np.ndarray) -> State:
        terms = self.reward.terms(error, force)
        if self.exchange is not None:
            self.exchange.told(terms)
        return {"terms": terms}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Steering:
    """Maker of a run's law from actions; holds no environment, which may end before the run."""

    kind: str  # one of ACTIONS
    law: str  # the law modified by the actions
    acts: np.ndarray  # (na) indices in v
    scale: np.ndarray  # (na)
    tracks_frame: bool
    reward: Reward
    num_seen: int  # how many numbers are observed

    def __call__(self, setup: BlockSetup, exchange: Exchange | None = None) -> ControlLaw:
        """The law of a run, with actions from ``exchange``, or from its memory."""
        return _Steered(
            kind=self.kind,
            acts=self.acts,
            scale=self.scale,
            inner=None if self.kind == "force" else inner_law(self.law, setup),
            task=TaskSpace.from_setup(setup) if self.tracks_frame else None,
            reward=self.reward,
            num_seen=self.num_seen,
            exchange=exchange,
        )


def _check(action: str, weights: Mapping[str, float], samples_per_step: int) -> None:
    """Raise FfsmError: an action or a weight is unknown, or a number of samples is wrong."""
    if action not in ACTIONS:
        raise FfsmError(f"action: must be one of {', '.join(ACTIONS)}, not {action!r}")
    if unknown := set(weights) - set(WEIGHTS):
        raise FfsmError(f"weights: knows {', '.join(WEIGHTS)}, not {', '.join(unknown)}")
    if samples_per_step != int(samples_per_step) or samples_per_step < 1:
        problem = f"must be a whole number from 1 on, not {samples_per_step}"
        raise FfsmError(f"samples_per_step: {problem}")


class MissionEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A scenario controlled by the agent, or by a law with the agent's corrections.

    Observations are, by ``observation_names``: errors e and their rates (nv each; rad, m; as seen
    by the law; a tracked frame adds its own), measured positions q (nq) and velocities v (nv).
    Actions lie between -1 and 1, one for each driven coordinate (``action_names``). ``sample`` is
    the complete input of a law at the step.

    ``info`` has ``reward_terms``; at the end ``ending`` (the last line of a run's summary) and
    ``is_success`` (settled). An episode is terminated when the run diverges or misses its target,
    and truncated at the end of the run's time. A step covers ``samples_per_step`` control samples,
    the last one of a run those that are left: N samples make ceil(N / samples_per_step) steps.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as Gymnasium declares it)

    def __init__(
        self,
        scenario: str | Scenario = "postcapture",
        overrides: tuple[Any, ...] = (),
        *,
        action: str = "force",
        law: str | None = None,
        samples_per_step: int = 1,
        scale: Mapping[str, float] | float | None = None,
        weights: Mapping[str, float] | None = None,
        dtype: type = np.float32,
    ) -> None:
        """Args:
          scenario: a shipped name, a file, or a Scenario.
          overrides: see ``load_scenario``.
          action: "force", the generalized force; "residual", a force on top of a law's;
            "setpoint", an offset of the desired positions of a law.
          law: the law of "residual" and "setpoint"; default: the scenario's.
          samples_per_step: number of control samples for which an action is held.
          scale: scale of actions by coordinate or group; default: the force limits (100 N m or N
            where there is none), a tenth of them for residuals, 0.1 rad or m for set-points.
          weights: weights of the reward's terms, see ``WEIGHTS``.
          dtype: type of observations and actions. In float64, with a ``scale`` of a power of two,
            a force keeps its bits on its way through an action.

        Raises ScenarioError, BlockError, ModelError as ``simulate``; FfsmError for an unknown
        action or weight, or a wrong ``samples_per_step``.
        """
        _check(action, weights or {}, samples_per_step)
        if not isinstance(scenario, Scenario):
            scenario = load_scenario(scenario, overrides)
        law = law or scenario.controller
        self.mission = Mission(scenario.replace(controller=law))
        self.scenario = self.mission.scenario
        self.samples_per_step, self._weights = samples_per_step, {**WEIGHTS, **(weights or {})}
        self.coordinates = coordinates = self.mission.craft.coordinates
        self._limit = limit = _finite(actuation_limit(self.scenario, coordinates).upper)
        self.action_names = tuple(coordinates.names[i] for i in coordinates.driven)
        factory = find_factory("controller", law, python_path=scenario.python_path)
        tracks_frame = bool(getattr(factory, "tracks_frame", False))
        errors = error_names(self.scenario, coordinates, tracks_frame=tracks_frame)
        self.observation_names = observation_names(
            self.scenario, coordinates, tracks_frame=tracks_frame
        )
        counts = coordinates.is_driven.copy()
        if tracks_frame:  # its pose counts in place of the joints
            if action == "setpoint":
                raise FfsmError(f"action: {law} tracks a frame; must be force or residual")
            counts &= np.array([group != "joints" for group in coordinates.group_of])
        counts = np.append(counts, np.ones(len(errors) - counts.size, dtype=bool))
        tolerance = np.array([self.scenario.tolerance_of(*each) for each in errors])
        self.steering = Steering(
            kind=action,
            law=law,
            acts=coordinates.driven,
            scale=self._scales(scale, action)[coordinates.driven],
            tracks_frame=tracks_frame,
            reward=Reward(tolerance=tolerance, limit=limit, counts=counts),
            num_seen=len(self.observation_names),
        )
        self.action_space = _box(len(self.action_names), 1.0, dtype)
        self.observation_space = _box(len(self.observation_names), FURTHEST, dtype)
        self._exchange: Exchange | None = None
        self._seen: np.ndarray = np.zeros(len(self.observation_names), dtype)
        self.log: RunLog | None = None  # log of the last complete episode

    def _scales(self, given: Mapping[str, float] | float | None, action: str) -> np.ndarray:
        if given is not None:
            by_name = given if isinstance(given, Mapping) else {"all": given}
            return self.coordinates.vector(by_name, key="scale", default=0.0)
        if action == "setpoint":
            return np.full(len(self.coordinates.names), 0.1)
        return self._limit * (0.1 if action == "residual" else 1.0)

    @property
    def sample(self) -> Sample | None:
        """Input of a law at this step; None before the first."""
        return None if self._exchange is None else self._exchange.sample

    def policy_metadata(self) -> dict[str, str]:
        """Metadata that an ONNX file of a policy for this environment needs to be used as a control
        law (``controller: policy:FILE``).
        """
        return {
            "observation_names": json.dumps(self.observation_names),
            "action_names": json.dumps(self.action_names),
            "scale": json.dumps(self.steering.scale.tolist()),
            "action": self.steering.kind,
            "law": "" if self.steering.kind == "force" else self.steering.law,
            "samples_per_step": str(self.samples_per_step),
        }

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A new run; ``seed`` is its ``random_seed``, by default drawn."""
        self.close()
        scenario = self.scenario.replace(random_seed=self.drawn(seed))
        exchange = Exchange(self.samples_per_step, scenario.num_control_periods)
        self._exchange = exchange
        law = functools.partial(self.steering, exchange=exchange)
        rollout = make_rollout(scenario, blocks={"controller": law})
        exchange.run.start(rollout.run, rollout.release, owner=self)
        self._take()
        return self._seen.copy(), {}

    def drawn(self, seed: int | None) -> int:
        """The ``random_seed`` of a new run."""
        super().reset(seed=seed)
        return int(self.np_random.integers(2**31)) if seed is None else seed

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """As Gymnasium's."""
        if self._exchange is None:
            raise FfsmError("the episode is over, or did not begin: call reset")
        self._exchange.run.answer(clipped(action, self.action_space.shape))
        log, spent = self._take()
        terms = dict(zip(TERMS, spent.tolist(), strict=True))
        info: dict[str, Any] = {"reward_terms": terms}
        if log is not None:
            self.log = log
            terms["settled"] = float(log.ending.is_settled)
            terms["failure"] = -float(log.ending.is_failure)
            info |= {"ending": log.ending.sentence, "is_success": log.ending.is_settled}
        reward = self.reward_of(terms)
        ended = log is not None
        completed = log is not None and log.outcome.completed
        return self._seen.copy(), reward, ended and not completed, completed, info

    def reward_of(self, terms: Mapping[str, Any]) -> Any:
        """Weighted sum of reward terms."""
        return sum(self._weights[name] * value for name, value in terms.items())

    def close(self) -> None:
        """End the run, if there is one."""
        if self._exchange is not None:
            self._exchange.run.stop()
        self._exchange = None

    def _take(self) -> tuple[RunLog | None, np.ndarray]:
        """Wait for the run's next step, or its end; keep the observation. Return the log at the
        end, and ``Exchange.spent``.
        """
        assert self._exchange is not None
        exchange = self._exchange
        try:
            found = exchange.run.take()
        finally:
            if not exchange.run.goes_on:
                self._exchange = None
        if not isinstance(found, RunLog):
            seen, spent = found
            self._seen = observation(seen, self.observation_space.dtype)
            return None, spent
        if found.outcome.completed and exchange.end is not None:
            self._seen = observation(exchange.end, self.observation_space.dtype)
        return found, exchange.spent()


def _finite(limit: np.ndarray) -> np.ndarray:
    """Limits (nv); 100 N m or N where there is none."""
    return np.where(np.isfinite(limit) & (limit > 0.0), limit, _UNLIMITED)


def clipped(action: Any, shape: tuple[int, ...] | None) -> np.ndarray:
    """An action within its bounds, float64. Raises FfsmError: it is no array of that shape."""
    try:
        given = np.asarray(action, dtype=float)
    except (TypeError, ValueError) as error:
        raise FfsmError(f"action: must be numbers: {one_line(error)}") from error
    if given.shape != shape:
        raise FfsmError(f"action: must have the shape {shape}, not {given.shape}")
    return np.clip(given, -1.0, 1.0)


def _box(size: int, most: float, dtype: type) -> gymnasium.spaces.Box:
    """Vectors of entries from -most to most."""
    bound: np.ndarray = np.full(size, most, dtype)
    return gymnasium.spaces.Box(-bound, bound, dtype=dtype)
