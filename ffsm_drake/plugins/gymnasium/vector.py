"""A mission of several spacecraft as a VectorEnv: one plant with a copy for each.

All copies share the clock of the mission. A run begins with all of them at the scenario's start.
After the end of its episode, a copy begins the next one at the current point of the planned motion,
with a law in its initial state. At the end of the mission's time all are truncated, and begin again
at its start.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Context

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.lifetime import untie
from ffsm_drake.loop.closed_loop import ClosedLoop, make_closed_loop
from ffsm_drake.plugins.gymnasium.environment import Exchange, MissionEnv, clipped
from ffsm_drake.plugins.policy.policy import observation
from ffsm_drake.runs.batches import batches_of
from ffsm_drake.runs.ending import COMPLETED, DIVERGED, Outcome
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.monitor import Monitor
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers.law import Sample


class _Flight:
    """A run of all copies, in a thread of its own."""

    def __init__(self, loop: ClosedLoop, exchange: Exchange, samples_per_step: int) -> None:
        self.loop, self.exchange, self._every = loop, exchange, samples_per_step
        number = len(loop.scenarios)
        self.exchange.lasts = np.ones(number, bool)
        self.anew = np.zeros(number, bool)  # copies that begin anew at the next step
        self._leaving = np.zeros(number, bool)  # beyond their bounds at the last sample
        self.began = np.zeros(number, int)  # the sample at which each copy's episode did
        self._names = [
            name for name in ("state", "hidden_state", "desired_state", "desired_frame")
            if name in loop.sources and (name != "desired_frame" or loop.tracks_frame)
        ]  # fmt: skip
        self._series = {name: list[np.ndarray]() for name in self._names}

    def log(self, copy: int) -> RunLog:
        """The episode of a copy up to now; it has diverged unless it lasts."""
        loop, began, scenario = self.loop, int(self.began[copy]), self.loop.scenarios[copy]
        assert self.exchange.lasts is not None
        series = {
            name: np.array([row[copy] for row in rows[began:]])
            for name, rows in self._series.items()
        }
        time = scenario.sample_time * np.arange(began, began + len(series["state"]))
        end = float(time[-1])
        outcome = Outcome(status=COMPLETED, time=end, message=f"completed {end:g} s")
        if not self.exchange.lasts[copy]:
            monitor = Monitor(dataclasses.replace(loop, scenario=scenario), None)
            if copy in self.exchange.lost:
                sample, coordinate = self.exchange.lost[copy]
                last = sample - began
                monitor.judge_force(float(time[last]), _but_one(loop.coordinates, coordinate))
            else:
                last = int(np.argmax(~monitor.bounded(series["state"])))
                monitor.judge(float(time[last]), series["state"][last])
            time, series = time[: last + 1], {key: each[: last + 1] for key, each in series.items()}
            outcome = Outcome(
                status=DIVERGED,
                time=float(time[-1]),
                coordinate=monitor.coordinate,
                message=monitor.message,
            )
        return RunLog(
            scenario=scenario,
            outcome=outcome,
            coordinates=loop.coordinates,
            split=loop.split,
            tracks_frame=loop.tracks_frame,
            time=time,
            series=series,
            wall_time={},
        )

    def fly(self) -> list[np.ndarray]:
        """Simulate to the end of the mission's time; ``Exchange.spent`` since the last step."""
        loop, exchange, scenario = self.loop, self.exchange, self.loop.scenario
        assert exchange.lasts is not None
        simulator = Simulator(loop.diagram)
        ApplySimulatorConfig(scenario.simulator_config, simulator)
        context = simulator.get_mutable_context()
        loop.initialize(loop.diagram, context)
        simulator.Initialize()
        for sample in range(scenario.num_control_periods):
            self._look(context, sample)
            simulator.AdvanceTo((sample + 1) * scenario.sample_time)
        self._look(context, scenario.num_control_periods)
        simulator.AdvancePendingEvents()
        exchange.lasts = exchange.lasts & ~self._leaving
        return exchange.spent()

    def _look(self, context: Context, sample: int) -> None:
        """Keep the series for the endings, and put diverging or restarting copies on the planned
        motion.
        """
        loop, exchange = self.loop, self.exchange
        assert loop.copies is not None
        assert exchange.lasts is not None
        rows = {
            name: loop.diagram.GetOutputPort(name).Eval(context).reshape(len(self.anew), -1)
            for name in self._names
        }
        speed = np.abs(rows["state"][:, len(loop.coordinates.position_names) :]).max(axis=1)
        bounds = np.array([each.divergence_speed for each in loop.scenarios])
        beyond = ~(speed <= bounds)  # true for NaN too
        for name, values in rows.items():
            self._series[name].append(values)
        placed = self._leaving | (beyond & ~(exchange.lasts & np.isfinite(speed)))
        exchange.lasts &= ~placed
        self._leaving = beyond & ~placed
        if sample % self._every == 0 and self.anew.any():
            placed |= self.anew
            exchange.lasts |= self.anew
            self.began[self.anew] = sample
            for copy in np.flatnonzero(self.anew).tolist():
                exchange.lost.pop(copy, None)
            self._leaving &= ~self.anew
            self.anew = np.zeros_like(self.anew)
        exchange.fresh = placed
        if not placed.any():
            return
        whole = loop.whole_states(context)
        whole[placed] = loop.split.whole(rows["desired_state"][placed])
        own = loop.plant.GetMyMutableContextFromRoot(context)
        loop.plant.SetPositionsAndVelocities(own, loop.copies.whole(whole))
        for name in self._names:
            if name in ("state", "hidden_state"):
                now = loop.diagram.GetOutputPort(name).Eval(context).reshape(len(placed), -1)
                # A diverging episode ends with its own last values.
                began = placed & (self.began == sample)
                self._series[name][-1] = np.where(began[:, None], now, rows[name])
        for name, block in loop.blocks.items():
            if name != "controller" and hasattr(block, "park"):
                for copy in np.flatnonzero(placed).tolist():
                    block.park(block.GetMyMutableContextFromRoot(context), copy)


def _but_one(coordinates: Coordinates, index: int) -> np.ndarray:
    """Forces (nv), zero except for one NaN."""
    return np.where(np.arange(len(coordinates.names)) == index, np.nan, 0.0)


class MissionVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """``num_envs`` copies of a mission in one diagram; spaces, rewards and ``info`` as MissionEnv.

    The first episode of each copy after a ``reset``, and each one from the mission's start, has the
    bits of a MissionEnv with the same seed (rewards to rounding). Seeds count up from the first
    copy's. At the step after its last, a copy restarts and its action is ignored.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as Gymnasium declares it)
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(self, num_envs: int, *args: Any, **settings: Any) -> None:
        """Args: the number of copies; then the arguments of ``MissionEnv``.

        Raises FfsmError if the mission's runs cannot go side by side, and the errors of
        ``MissionEnv``.
        """
        self._one = one = MissionEnv(*args, **settings)
        scenario = one.scenario
        if scenario.grasp_time > 0.0 or len(batches_of([scenario] * 2, 2)) > 1:
            problem = "runs of it cannot go side by side; vectorization_mode must be sync or async"
            raise FfsmError(f"scenario: {problem}")
        self.num_envs = num_envs
        if num_envs < 2:
            raise FfsmError(f"num_envs: must be 2 or more to go side by side, not {num_envs}")
        self.single_action_space = one.action_space
        self.single_observation_space = one.observation_space
        self.action_space = batch_space(one.action_space, num_envs)
        self.observation_space = batch_space(one.observation_space, num_envs)
        self.action_names, self.observation_names = one.action_names, one.observation_names
        self._exchange = one.new_exchange()
        self._loop: ClosedLoop | None = None
        self._flight: _Flight | None = None
        self._ended = np.zeros(num_envs, bool)  # copies that begin anew at the next step
        self._seen = np.zeros((num_envs, len(one.observation_names)), one.observation_space.dtype)
        self._draws = [seeding.np_random()[0] for _ in range(num_envs)]

    @property
    def sample(self) -> Sample | None:
        """As ``MissionEnv.sample``, a row for each copy."""
        return self._exchange.sample

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """New runs of all copies; a single seed counts up from copy to copy."""
        given = range(seed, seed + self.num_envs) if isinstance(seed, int) else seed
        if given is not None:
            self._draws = [seeding.np_random(each)[0] for each in given]
        self._begin(None if given is None else list(given))
        return self._seen.copy(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """As Gymnasium's. A NaN action ends its copy, as in MissionEnv."""
        given = clipped(actions, self.action_space.shape)
        anew, none = self._ended, np.zeros(self.num_envs, bool)
        if anew.all():  # the mission's time was over
            self._begin(None)
            return self._seen.copy(), np.zeros(self.num_envs), none, none.copy(), {}
        flight, exchange = self._flight, self._exchange
        if flight is None:
            raise FfsmError("no episode began: call reset")
        flight.anew = anew
        exchange.run.answer(np.where(anew[:, None], 0.0, given))
        before, (spent, over) = self._seen, self._take()
        assert exchange.lasts is not None
        terminated = ~exchange.lasts & ~anew
        self._seen[terminated] = before[terminated]  # the law's last input
        truncated = ~terminated & over
        found = self._one.reward_terms(spent)
        terms = {name: np.where(anew, 0.0, value) for name, value in found.items()}
        info: dict[str, Any] = {}
        ended = terminated | truncated
        if ended.any():
            terms |= {"settled": np.zeros(self.num_envs), "failure": np.zeros(self.num_envs)}
            for copy in np.flatnonzero(ended & ~anew).tolist():
                ending = flight.log(copy).ending
                terms["settled"][copy] = float(ending.is_settled)
                terms["failure"][copy] = -float(ending.is_failure)
                own = {"ending": ending.sentence, "is_success": ending.is_settled}
                info = self._add_info(info, own, copy)
        self._ended = ended
        if over:
            self._flight = None
        info["reward_terms"] = terms
        return self._seen.copy(), self._one.reward_of(terms), terminated, truncated, info

    def close_extras(self, **settings: Any) -> None:
        """End the run, and free its diagram."""
        self._exchange.run.stop()
        if self._loop is not None:
            untie(self._loop.diagram)
        self._flight = self._loop = None

    def _begin(self, seeds: list[int] | None) -> None:
        self._exchange.run.stop()
        drawn = seeds or [int(draw.integers(2**31)) for draw in self._draws]
        scenarios = [self._one.scenario.replace(random_seed=each) for each in drawn]
        self._exchange.begin()
        self._loop = self._looped(scenarios)
        self._flight = _Flight(self._loop, self._exchange, self._one.samples_per_step)
        self._exchange.run.start(self._flight.fly, owner=self)
        self._ended = np.zeros(self.num_envs, bool)
        self._take()

    def _looped(self, scenarios: Sequence[Any]) -> ClosedLoop:
        """The diagram, built once, for scenarios that differ in their seeds."""
        if self._loop is not None:
            return dataclasses.replace(
                self._loop, scenario=scenarios[0], scenarios=tuple(scenarios)
            )
        law = functools.partial(self._one.steering, exchange=self._exchange, alone=False)
        return make_closed_loop(scenarios, blocks={"controller": law})

    def _take(self) -> tuple[list[np.ndarray], bool]:
        """``Exchange.spent`` of a step, and whether the run is over; keep the observation."""
        run = self._exchange.run
        try:
            found = run.take()
        except BaseException:
            self._flight = None
            raise
        over = not run.goes_on
        seen, spent = (self._exchange.end, found) if over else found
        assert seen is not None
        self._seen = observation(seen, self._seen.dtype)
        return spent, over
