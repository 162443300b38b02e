"""The linearised sampled loop, as wired: the map from just before one control sample to just before
the next.

Its state is all state with feedback: the plant's (its attitude as a small rotation) with hidden
coordinates, the controller's and its estimator's, delays, actuators. ``ControlLaw.held`` (gains
under adaptation, sign terms) is constant. Noise is an input. The map is exact where the loop is
compiled, else it is made of finite differences (``sampled_loop``).
"""

import functools
import math
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, Self

import numpy as np

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.common.guard import guarded
from ffsm_drake.common.memo import content_of
from ffsm_drake.loop.blocks import is_rehearsed, parts_of
from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.plugins.actuators.mean import make_mean_actuation
from ffsm_drake.plugins.design.stability.drake_sample import DrakeSample
from ffsm_drake.plugins.design.stability.linear_loop import (
    WARM_UP,
    LinearLoop,
    NotLinear,
)
from ffsm_drake.plugins.design.stability.linear_settings import without_limits
from ffsm_drake.plugins.design.stability.outputs import Outputs
from ffsm_drake.plugins.design.stability.own_adaptation import OwnAdaptation, own_adaptation
from ffsm_drake.plugins.design.stability.planned_dynamics import PlannedDynamics, from_grasp
from ffsm_drake.plugins.design.stability.sampled_loop import (
    Held,
    SampledLoop,
    agrees,
    traced_sample,
)
from ffsm_drake.plugins.design.stability.separate_axes import law_of_axes
from ffsm_drake.scenario import EMPTY, Grip, MassProperties, Scenario
from ffsm_drake.systems.controllers.checked import has_user_code
from ffsm_drake.systems.controllers.time_delay import TimeDelayControl
from ffsm_drake.systems.faults import settle_faults
from ffsm_drake.systems.reference import make_motion, timed
from ffsm_drake.systems.registry import Factory

# Fractions of the planned motion at which a loop is linearised.
POSTURES = (0.0, 0.25, 0.5, 0.75, 1.0)
# The first samples, without an estimate, throw a light coordinate off the plan. Where it still
# accelerates so much beside the plan (rad/s^2, m/s^2), the warm-up is so many times as long; the
# whole motion, if it is then so many times as far off.
_OFF, _LONGER, _FARTHER = 0.5, 4, 2.0


class Linearizer:
    """A closed loop that is built once and linearised at many instants, within a ``with`` block."""

    @guarded
    def __init__(
        self,
        scenario: Scenario | Mission,
        *,
        blocks: Mapping[str, Factory] | None = None,
        approach: bool = False,
        closed: float | None = None,
    ) -> None:
        """Args:
          scenario: the scenario, or its mission.
          blocks: factories in place of its blocks.
          approach: use its approach, the servicer alone before the grasp, in place of the motion
            from the grasp on.
          closed: s after the grasp; the hands that closed up to then hold the target; default: all.

        Raises the errors of ``add_closed_loop``; NotLinear for a block with continuous or abstract
        state.
        """
        # with limits
        mission = make_mission(scenario)
        given, self.grip = from_grasp(mission)
        if approach:  # up to the grasp, with an empty gripper
            given = mission.flown_by(duration=mission.scenario.grasp_time)
            self.grip = EMPTY
        if closed is not None:
            self.grip = Grip(closed=closed)
        self._before = timed(given, self.grip)
        self.mission = self._before.of(without_limits(self._before))
        self.given, self.scenario = self._before.scenario, self.mission.scenario
        factories = dict(blocks or {})
        others = {*factories, *parts_of(self.scenario, factories)}
        if is_rehearsed(self.given):
            factories = {"actuation": make_mean_actuation, **factories}
        for name, part in parts_of(self.scenario, factories).items():
            factories[name] = part.linear()
        self._choices = self.given.blocks.choices()
        sample = None if others else traced_sample(self.mission, self._before, self.grip)
        if sample is None:
            self.coordinates = self.mission.craft.coordinates
            self.motion = make_motion(self.mission, self.grip)
        else:
            self.coordinates, self.motion = sample.coordinates, sample.motion
        self._loop = self._made(sample, factories)
        self.tracks_frame, self.law = self._loop.tracks_frame, self._loop.law
        settle_faults(self.given, self.coordinates)  # the loop has none; names are checked
        self.begin, self.end = self.motion.begin, self.motion.end  # s
        if approach:  # its last instant is before the grasp
            self.end = max(0.0, self.end - WARM_UP * self.scenario.sample_time)
        # held memory -> control sample -> instant after a warm-up
        self._warm = dict[Hashable, dict[int, np.ndarray]]()
        # held memory, and first control sample of a warm-up -> sample at which it has diverged
        self._lost = dict[Hashable, int]()
        self._loops = dict[Hashable, LinearLoop]()

    def _made(self, sample: Any, blocks: Mapping[str, Factory]) -> SampledLoop:
        """The loop as code if there is a traced sample, else as Drake's diagram."""

        def on_drake() -> SampledLoop:
            own = DrakeSample(self.mission, self.motion, self.grip, blocks=blocks)
            return SampledLoop(own, self.mission, self.grip)

        if sample is not None:
            loop = SampledLoop(sample, self.mission, self.grip)
            if agrees(loop, on_drake):
                return loop
        return on_drake()

    @property
    def is_exact(self) -> bool:
        """Whether the maps are exact derivatives; else finite differences."""
        return self._loop.is_exact

    @property
    def user_supplied(self) -> Sequence[Any]:
        """The user-supplied systems with memory, and the controller with a user-supplied law."""
        return self._loop.user_supplied

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._loop.release()

    def at(
        self,
        time: float,
        *,
        held: Mapping[str, np.ndarray] | None = None,
        truth: MassProperties | None = None,
    ) -> LinearLoop:
        """The loop near an instant of the planned motion, with the plant on it.

        The result is cached: the same arguments give the same object. The update at the sample is
        cached too: the same instant with another true payload costs only its motion, from the state
        of the scenario's own payload. At rest this changes a spectral radius by about 1e-5.

        Args:
          time: s; a control sample is taken.
          held: values of held memory (``ControlLaw.held``) by name, in place of its own.
          truth: true mass properties of the payload, in place of the scenario's.

        Raises NotLinear: a block fails, or changes between two control samples.
        """
        first = round(time / self.scenario.sample_time)
        if truth is not None:
            return self._linearized(first, held or {}, truth)
        key = content_of((first, held or {}))
        if key not in self._loops:
            self._loops[key] = self._linearized(first, held or {}, None)
        return self._loops[key]

    def _linearized(
        self, first: int, held: Mapping[str, np.ndarray], truth: MassProperties | None
    ) -> LinearLoop:
        """The loop after a warm-up that begins on the plan at a control sample."""
        index = first + WARM_UP
        try:
            with guarded, np.errstate(over="ignore", invalid="ignore"):
                samples = self._loop.maps(index, self._warmed_up(index, held), held, truth)
        except FfsmError:
            raise
        except (Exception, SystemExit) as error:
            reason = f"{type(error).__name__}: {one_line(error)}"
            named = [f"blocks.{name} '{each.system}'" for name, each in self._choices.items()]
            suspects = " or ".join([*named, self.scenario.controller])
            raise NotLinear(f"{suspects}: the loop cannot be linearised: {reason}") from error
        return LinearLoop(
            coordinates=self.coordinates,
            time=index * self.scenario.sample_time,
            sample_time=self.scenario.sample_time,
            samples=samples,
            hidden=self._loop.hidden,
            tracks_frame=self.tracks_frame,
            memory=self._loop.parts_of_memory,
            noise=self._loop.noise,
        )

    def refuse_marginal(self, loop: LinearLoop) -> None:
        """Raise NotLinear where small errors near a loop of this linearizer, at rest, neither grow
        nor decay, and a user-supplied system may be the cause.
        """
        if not (self.user_supplied and loop.is_marginal):
            return
        systems = ", ".join(system.get_name() for system in self.user_supplied)
        if names := loop.kept_memory:
            held = ", ".join(f'"{name}": None' for name in names)
            raise NotLinear(
                f"{systems}: its state {', '.join(names)} is constant at rest, like an adapted "
                f"gain or estimate; return {{{held}}} from held() to hold it in the analysis"
            )
        raise NotLinear(
            f"{systems}: errors neither grow nor decay at rest, as if the block acted at few "
            "samples; declare its period"
        )

    def along(
        self,
        shares: Sequence[float] = POSTURES,
        *,
        held: Mapping[str, np.ndarray] | None = None,
    ) -> tuple[LinearLoop, ...]:
        """The loops at fractions of the planned motion. Arguments and errors: see ``at``."""
        return tuple(self.at(self.part(share), held=held) for share in shares)

    def part(self, share: float) -> float:
        """The time at which a fraction (0 to 1) of the motion has passed, s."""
        return self.begin + share * (self.end - self.begin)

    def follow(
        self, *, held: Mapping[str, np.ndarray] | None = None, samples: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The run without noise: true errors of the outputs at the samples (n, size), and the force
        from each to the next (n, nv), NaN after a failure or divergence, as in a run.

        Args:
          held: see ``at``.
          samples: number from the start; None: all.
        """
        count = self.scenario.num_control_periods if samples is None else samples
        nv, period = self.coordinates.num_velocities, self.scenario.sample_time
        states, force = np.full((count, nv + 1), np.nan), np.full((count, nv), np.nan)
        loop, held = self._loop, held or {}
        try:
            with guarded, np.errstate(all="ignore"):
                state = loop.first(held)
                for index in range(count):
                    if loop.has_diverged(state):
                        break
                    states[index] = loop.known(state)[: nv + 1]
                    state, force[index] = loop.after(index, state, held)
        except FfsmError:
            raise
        except (Exception, SystemExit):
            pass
        return self.outputs.errors(np.arange(count) * period, states), force

    @functools.cached_property
    def outputs(self) -> Outputs:
        """What the law controls."""
        return Outputs(self.mission, self.motion, self.grip, self.coordinates, self.tracks_frame)

    def _warmed_up(self, index: int, held: Held) -> np.ndarray:
        """The state just before the update at a control sample, after the shortest warm-up with
        the plant on the plan at its end, or the longest without leading it away.

        A warm-up begins on the plan or, if a former one ended there on the way, goes on from it.
        One from where the motion begins comes last: at rest the first samples do little harm.
        """
        start, count, least = round(self.begin / self.scenario.sample_time), WARM_UP, math.inf
        former, found = self._warm.setdefault(content_of(held), {}), self._loop.sample.start
        while True:
            first = max(min(start, index - WARM_UP), index - count)
            known = max((each for each in former if first <= each < index), default=None)
            is_short = count == WARM_UP
            if known is None or is_short:
                state = self._loop.placed(first, held)
            else:
                state = former[known]
                first = start = known
            way = content_of((held, first))
            if not is_short and index >= self._lost.get(way, index + 1):
                if first <= start:
                    return found
                count = index - start
                continue
            for earlier in range(first, index):
                before = self._off_plan(earlier, state)
                state, _ = self._loop.after(earlier, state, held)
            off = np.abs(self._off_plan(index, state) - before) / self.scenario.sample_time
            largest = float(off[self.coordinates.is_driven].max(initial=0.0))
            diverged = self._loop.has_diverged(state)
            if diverged:
                self._lost[way] = index
            stays = largest <= _FARTHER * least and not diverged
            if stays or is_short:
                found, least = state, min(least, largest)
            if stays and (largest <= _OFF or self.tracks_frame):
                former[index] = found
                return found
            if first <= start or self.tracks_frame:
                return found
            count = count * _LONGER if stays else index - start

    @functools.cached_property
    def axes(self) -> TimeDelayControl | None:
        """The control law, if it consists of axes (``law_of_axes``)."""
        return law_of_axes(self.law)

    @functools.cached_property
    def own_adaptation(self) -> OwnAdaptation:
        """How a user-supplied law's step adapts K_s, against its hook ``reaching_gain``."""
        if not has_user_code(self.law):  # the tests hold the others to it
            return OwnAdaptation()
        return own_adaptation(self.law, self.given, self.planned.nominal, self.motion)

    def _off_plan(self, index: int, state: np.ndarray) -> np.ndarray:
        """The velocity of a state beside the plan's at a control sample (nv)."""
        known, nq = self._loop.known(state), self.coordinates.num_positions
        planned = self.motion.row(index * self.scenario.sample_time)[: known.size]
        return known[nq:] - planned[nq:]

    @functools.cached_property
    def planned(self) -> PlannedDynamics:
        """The scenario's dynamics along its planned motion. Raises the errors of
        PlannedDynamics.
        """
        return PlannedDynamics(self._before, self.grip)

    @functools.cached_property
    def lightest(self) -> list[float]:
        """The times, s, of its motion at which a driven coordinate is lightest."""
        return self.planned.lightest(self.begin, self.end)
