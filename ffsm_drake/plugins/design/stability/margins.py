"""Stability of a scenario's sampled loop along its planned motion, and the expected course of its
adaptation.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ffsm_drake.common.guard import guarded
from ffsm_drake.common.numbers import number
from ffsm_drake.loop.blocks import is_rehearsed
from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.plugins.design.stability.adaptation import (
    axis_law,
    forecast_reaching_gain,
    is_euler,
)
from ffsm_drake.plugins.design.stability.linear_loop import (
    LinearLoop,
    NotLinear,
    at_rest,
    radius_told,
)
from ffsm_drake.plugins.design.stability.linearization import POSTURES, Linearizer
from ffsm_drake.plugins.design.stability.moving import (
    GROWN,
    MotionStability,
    motion_stability,
)
from ffsm_drake.plugins.design.stability.one_axis import (
    axis_loop,
    largest_sample_time,
    largest_stable_k_s,
    tolerated_eta,
)
from ffsm_drake.plugins.design.stability.planned_dynamics import PlannedDynamics, from_grasp
from ffsm_drake.plugins.design.stability.rehearsal import Rehearsal, rehearse
from ffsm_drake.plugins.flexible.bodies import VibrationMode
from ffsm_drake.scenario import Scenario, checked
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers.checked import reaching_gain_of
from ffsm_drake.systems.controllers.time_delay import TimeDelayControl


@dataclasses.dataclass(frozen=True, kw_only=True)
class AxisMargins:
    """Limits of each coordinate alone (``one_axis``), for the worst eta along the planned
    motion.
    """

    law: TimeDelayControl
    euler: bool  # whether the plant steps with explicit Euler at the control period
    k_s: np.ndarray  # (nv,) 1/s, at the start; zero for a law without K_s
    k_s_max: np.ndarray  # (nv,) 1/s, ``ReachingGain.largest``
    # (nv,) 1/s, 0 where no K_s is stable, NaN for a law without K_s and of undriven coordinates
    k_s_limit: np.ndarray
    # At the K_s that adaptation reaches: its bound, or the largest expected if that is unstable.
    sample_time_limit: np.ndarray  # (nv,) s, 0 where no sample time is stable
    eta_tolerated: np.ndarray  # (nv, 2)
    forecast_times: np.ndarray  # (p,) s
    forecast_k_s: np.ndarray  # (p, nv) 1/s, expected K_s under adaptation

    @property
    def has_k_s(self) -> bool:
        """Whether the law has a reaching gain K_s."""
        return self.law.reaching_gain is not None

    @property
    def forecast_leaves(self) -> np.ndarray:
        """(nv,) whether adaptation is expected to take K_s out of its stable range within the
        run.
        """
        return np.nanmax(self.forecast_k_s, axis=0) > np.nan_to_num(self.k_s_limit, nan=np.inf)

    @property
    def may_leave(self) -> np.ndarray:
        """(nv,) whether adaptation may pass the limit."""
        return self.k_s_max > np.nan_to_num(self.k_s_limit, nan=np.inf)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Margins:
    """Stability of a scenario's sampled loop along its planned motion, without a simulation."""

    scenario: Scenario
    coordinates: Coordinates
    times: np.ndarray  # (m,) s, instants of ``eta``
    # (m, na) eigenvalues of H^-1 Hhat of the driven coordinates there, H apparent
    # (calc_apparent_mass_matrix)
    eta: np.ndarray
    loops: tuple[LinearLoop, ...]  # the wired loop at POSTURES, at the starting gains
    loops_expected: tuple[LinearLoop, ...]  # the same with every K_s at its largest expected value
    motion: MotionStability | None  # motion of a tracked frame, at chosen instants
    # spectral radius at the worst of these with every K_s at its bound; NaN without bounds
    radius_at_bounds: float
    hidden_modes: tuple[VibrationMode, ...]  # at the start of the motion
    hidden: tuple[str, ...]  # names of the hidden coordinates
    # smallest and largest eta along the motion with hidden coordinates locked
    locked_eta: tuple[float, float]
    # None for a law that is not by axis, and with delays
    axes: AxisMargins | None
    # with rehearsed parts, for a loop that is stable without their limits; of compiled runs
    rehearsal: Rehearsal | None = None

    @property
    def worst(self) -> LinearLoop:
        """The loop of the posture with the largest spectral radius, at the starting gains.

        With a tracked frame, the start or the end of the motion: see ``growth``.
        """
        return max(at_rest(self.loops), key=lambda loop: loop.spectral_radius)

    @property
    def growth(self) -> float:
        """Growth of small errors while a tracked frame moves; 1 without a tracked frame.

        Near a singular posture the loop may be unstable during the motion of the frame, although it
        is stable at rest in every posture.
        """
        return 1.0 if self.motion is None else self.motion.growth

    @property
    def edge_time(self) -> float:
        """The time, s, of the posture nearest to instability: at the largest spectral radius, or,
        with hidden coordinates, at the largest eta (their slow poles are the same everywhere).
        """
        return self._overestimated if self.hidden else self.worst.time

    @property
    def edge_times(self) -> tuple[float, ...]:
        """``edge_time``, and the time, s, of the largest eta, where alternating modes are nearest
        to instability.
        """
        return tuple(dict.fromkeys((self.edge_time, self._overestimated)))

    @property
    def _overestimated(self) -> float:
        return float(self.times[int(np.argmax(self.eta.max(axis=1)))])

    @property
    def starts_stable(self) -> bool:
        """Whether the loop is stable at the starting gains at every posture."""
        return self.worst.spectral_radius < 1.0

    @property
    def verdict(self) -> str:
        """One line: "stable for small errors", or the cause of instability."""
        if not self.starts_stable:
            worst = self.worst
            return (
                f"unstable: the sampled loop of {self.scenario.controller} at the posture of t = "
                f"{worst.time:g} s has spectral radius {radius_told(worst.spectral_radius)}"
            )
        if self._bounds_unstable:
            return (
                "unstable with every K_s at its bound: the spectral radius of the sampled loop is "
                f"{radius_told(self.radius_at_bounds)}"
            )
        if self.axes is None:
            return self._with_actuators
        if self.axes.forecast_leaves.any():
            i = int(np.argmax(self.axes.forecast_leaves))
            limit = self.axes.k_s_limit[i]
            time = self.axes.forecast_times[int(np.argmax(self.axes.forecast_k_s[:, i] > limit))]
            return (
                f"unstable: K_s of {self.coordinates.names[i]} is expected to adapt beyond its "
                f"stability limit of {limit:.1f} 1/s at t = {time:.1f} s; lower k_s_max"
            )
        if self.axes.may_leave.any():
            i = int(np.argmax(self.axes.may_leave))
            return (
                "stable for small errors, but K_s may grow beyond its stability limit of "
                f"{self.axes.k_s_limit[i]:.1f} 1/s for {self.coordinates.names[i]}; set k_s_max"
            )
        return self._with_actuators

    @property
    def _bounds_unstable(self) -> bool:
        """Whether K_s may reach unstable bounds, without a forecast to the contrary."""
        return self.axes is None and self.radius_at_bounds >= 1.0

    @property
    def _with_actuators(self) -> str:
        """The verdict on a loop that is stable without saturation."""
        found = self.rehearsal
        if found is None and self.motion is not None and self.growth > GROWN:
            return f"stable at rest; while the frame moves, small errors {self.motion.growing}"
        if found is None:
            return "stable for small errors"
        if found.share_diverged > 0.0:
            unstable = "unstable" if found.share_diverged >= 0.5 else "at the edge of stability"
            return f"{unstable} with its actuators: {found}"
        stable, ending = "stable with its actuators", found.ending
        if not ending.excess > 1.0:
            return f"{stable}: {found}"
        end = f"{ending.coordinate} ends at {number(ending.excess, 3)} tolerances"
        return f"{stable}, but not expected to settle: {end}; {found}"

    @property
    def is_stable(self) -> bool:
        """Whether the linear loop is stable, and remains so as adaptation goes on."""
        return (
            self.starts_stable
            and not self._bounds_unstable
            and (self.axes is None or not bool(self.axes.forecast_leaves.any()))
            and (self.rehearsal is None or self.rehearsal.share_diverged < 0.5)
        )


@guarded
def stability(
    scenario: Scenario | Mission, *, postures: int = 21, linearizer: Linearizer | None = None
) -> Margins:
    """Compute the stability margins of the sampled loop, with any controller and blocks.

    It takes about a second.

    Args:
      scenario: the scenario, or its mission.
      postures: number of instants of the planned motion at which inertia ratios are computed.
      linearizer: linearizer of the scenario after the grasp; default: a new one.

    Returns: the margins, with a verdict in one line.

    Raises:
      ModelError, ScenarioError: the scenario's model or a value in it cannot be used.
      BlockError: a user-supplied block cannot be loaded, built, wired or run.

    Example:
      >>> from ffsm_drake import load_scenario, stability
      >>> margins = stability(load_scenario("postcapture", ["controller=tdc"]), postures=3)
      >>> margins.verdict, margins.is_stable
      ('stable for small errors', True)
    """
    if linearizer is None:
        mission = scenario if isinstance(scenario, Mission) else Mission(checked(scenario))
        with Linearizer(mission) as own:
            return stability(mission, postures=postures, linearizer=own)
    (mission, _), planned = from_grasp(make_mission(scenario)), linearizer.planned
    scenario = mission.scenario
    true, motion = planned.true, planned.motion
    times = np.linspace(motion.begin, motion.end, postures)
    eta = locked = np.array([planned.ratios(time) for time in times])
    if true.split.names:
        locked = np.array([planned.ratios(time, locked=True) for time in times])
    held, loops = dict[str, np.ndarray](), linearizer.along(POSTURES)
    linearizer.refuse_marginal(loops[-1])
    expected, law, at_bounds, rehearsal = loops, axis_law(linearizer), math.nan, None
    axes = None if law is None else _axis_margins(law, planned, eta, loops[0])
    if axes is not None and axes.forecast_k_s.max() > axes.k_s.max():
        held = {"reaching_gain": axes.forecast_k_s.max(axis=0)}
        expected = linearizer.along(POSTURES, held=held)
    gain = reaching_gain_of(linearizer.law)
    adaptation = linearizer.own_adaptation
    has_bounds = gain is not None and adaptation.keeps_bound and np.isfinite(gain.largest).all()
    if not (adaptation.is_as_stated or has_bounds):
        raise NotLinear(adaptation.uncovered)
    if gain is not None and gain.rate is not None and has_bounds:
        worst = int(np.argmax([loop.spectral_radius for loop in expected]))
        bounds = {"reaching_gain": gain.largest}
        at_bounds = linearizer.at(motion.part(POSTURES[worst]), held=bounds).spectral_radius
    radius = max(loop.spectral_radius for loop in (*loops, *expected))
    if is_rehearsed(scenario) and radius < 1.0:
        rehearsal = rehearse(mission, on_drake=False)
    return Margins(
        scenario=scenario,
        coordinates=planned.coordinates,
        times=times,
        eta=eta,
        loops=loops,
        loops_expected=expected,
        motion=motion_stability(linearizer) if loops[0].tracks_frame else None,
        radius_at_bounds=at_bounds,
        hidden_modes=tuple(true.modes(motion.evaluate(motion.begin)[0])),
        hidden=true.split.names,
        locked_eta=(float(locked.min()), float(locked.max())),
        axes=axes,
        rehearsal=rehearsal,
    )


def _axis_margins(
    law: TimeDelayControl, planned: PlannedDynamics, eta: np.ndarray, loop: LinearLoop
) -> AxisMargins:
    euler, etas = is_euler(planned.scenario), np.linspace(eta.min(), eta.max(), 9)

    def by_axis(law: TimeDelayControl, limit: Callable[[int], Any]) -> np.ndarray:
        """A limit of every coordinate; those with the same loop have the same."""
        maps = [each.tobytes() for each in axis_loop(law, euler=euler).a]
        found = {each: limit(maps.index(each)) for each in set(maps)}
        return np.array([found[each] for each in maps])

    def k_s_limit(axis: int) -> float:
        return float(largest_stable_k_s(law, axis, eta=etas, euler=euler).min())

    def limits(axis: int) -> tuple[float, ...]:
        period = largest_sample_time(reached, axis, eta=etas, euler=euler).min()
        return float(period), *tolerated_eta(reached, axis, euler=euler)

    times, k_s = forecast_reaching_gain(law, planned, loop)
    gain, zero, has_gain = (
        reaching_gain_of(law),
        np.zeros(k_s.shape[1]),
        law.reaching_gain is not None,
    )
    limit = np.nan_to_num(by_axis(law, k_s_limit))
    reached = law
    if gain is not None and has_gain:
        within = np.isfinite(gain.largest) & (gain.largest <= limit)
        reached = law.with_reaching_gain(np.where(within, gain.largest, k_s.max(axis=0)))
    table = by_axis(reached, limits)
    return AxisMargins(
        law=law,
        euler=euler,
        k_s=zero if gain is None else gain.start,
        k_s_max=zero if gain is None else gain.largest,
        k_s_limit=np.where(planned.coordinates.is_driven & has_gain, limit, np.nan),
        sample_time_limit=np.nan_to_num(table[:, 0]),
        eta_tolerated=table[:, 1:],
        forecast_times=times,
        forecast_k_s=k_s,
    )


@guarded
def adaptation_remark(linearizer: Linearizer) -> str:
    """Return one line if K_s can exceed the limit of the sampled loop at the start of a motion.

    Otherwise it is empty.
    """
    scenario, law = linearizer.given, axis_law(linearizer)
    gain = reaching_gain_of(law)
    if law is None or gain is None or not gain.changes:
        return ""
    if linearizer.at(0.0).spectral_radius >= 1.0:
        return ""  # unstable as it starts, which is not adaptation's fault
    largest, held = float(gain.largest.max()), {"reaching_gain": gain.largest}
    if math.isfinite(largest) and linearizer.at(0.0, held=held).spectral_radius < 1.0:
        return ""
    eta = linearizer.planned.ratios(0.0)[-1:]
    axis, euler = int(np.argmax(gain.largest)), is_euler(scenario)
    limit = float(largest_stable_k_s(law, axis, eta=eta, euler=euler)[0])
    bound = f"may grow to {largest:g} 1/s" if math.isfinite(largest) else "is not bounded"
    return (
        f"K_s {bound}, but the sampled loop is stable only below about {limit:.0f} 1/s; set "
        f"controllers.{scenario.controller_key}.k_s_max below that"
    )
