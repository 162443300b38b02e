"""The force required by a motion and an initial velocity error, compared with its limits, and
remedies for excess.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.plugins.design.rounding import rounded
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.planned_dynamics import PlannedDynamics, from_grasp
from ffsm_drake.scenario import Scenario, override_scenario
from ffsm_drake.scenario.contacts import closing_times
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.limits import FORCE, POSITION, RATE, tightest
from ffsm_drake.systems.controllers import complete_gains, controller_factory, gain_vectors
from ffsm_drake.systems.mission_limits import actuation_limit, limits_of
from ffsm_drake.systems.parts.advice import Advice, GroupLoad, Load
from ffsm_drake.systems.parts.signals import Signals
from ffsm_drake.systems.reference import timed
from ffsm_drake.systems.registry import base_actuators

_ANSWER = 1.0  # s; response of the loop to a wrong velocity at the start
_INSTANTS = 101  # number of instants of the plan after that
_TRANSIENT = 5.0  # s after a grasp with a torque independent of the motion's duration
# Largest share of the limit for a motion, and the target share of a longer one.
_MOST, _WANTED = 0.7, 0.65
_LEAST_STEP, _LONGEST = 1.03, 10.0  # ratios of durations: successive trials, longest to given
# Force required by noise: times K_P I sigma, fitted to two spacecraft. Amplitude, in standard
# deviations of the noise, from which a saturated integral may run away.
_NOISE_PEAK, _TOLERATED = 3.0, 50.0
_OF_JOINTS = (POSITION, RATE, FORCE)
_NOTABLE, _LARGE = 0.05, 0.5  # share of saturated samples; that is said though a run settles


def predicted_load(linearizer: Linearizer) -> float | None:
    """Largest force after a grasp, without noise, as a fraction of its limit; above 1 it saturates.
    None without a capture.

    In the first second the loop responds to the difference between true and planned velocity after
    the grasp. This is simulated without noise and limits. Afterwards the force is the force of
    perfect tracking with the true payload, minus the disturbance.
    """
    scenario, motion = linearizer.given, linearizer.motion
    if not scenario.grasps:
        return None
    answer = min(round(_ANSWER / scenario.sample_time), scenario.num_control_periods)
    force = _answer(linearizer, answer)
    begin = answer * scenario.sample_time
    times = np.linspace(begin, max(begin, min(motion.end, scenario.duration)), _INSTANTS)
    ideal = linearizer.planned.demand(times)
    limits = limits_of(linearizer.planned.mission, helped=True)
    ideal[FORCE] = np.concatenate([force, ideal[FORCE]])
    of = tightest(limits, FORCE), *(each for each in limits if each.quantity not in _OF_JOINTS)
    shares = [np.abs(ideal[each.quantity]) / each.upper for each in of if each.quantity in ideal]
    return max(float(np.nan_to_num(share, nan=np.inf).max()) for share in shares)


def _answer(linearizer: Linearizer, samples: int) -> np.ndarray:
    """Forces (samples, nv) of the loop just after the grasp, without later hands, N m or N."""
    if len(closing_times(linearizer.given)) == 1:
        return linearizer.follow(samples=samples)[1]
    with Linearizer(linearizer.planned.mission, closed=0.0) as first:
        return first.follow(samples=samples)[1]


def advice(
    given: Scenario | Mission, saturated: Mapping[str, float], *, settles: bool
) -> tuple[Advice, ...]:
    """Remedies for saturated actuators of the base, from the actuators' own advice.

    Args:
      given: the scenario, or its mission.
      saturated: the share of saturated samples, by an actuator's title in lower case.
      settles: whether the mission settles nonetheless; then only heavy saturation calls for a
        change.

    Raises: as ``PlannedDynamics``.
    """
    mission = make_mission(given)
    scenario, least = mission.scenario, _LARGE if settles else _NOTABLE
    parts = [
        part
        for part in base_actuators(scenario).values()
        if saturated.get(part.title.lower(), 0.0) >= least
    ]
    if not parts or scenario.blocks.reference is not None:
        return ()
    load = _base_load(timed(mission))
    found = {str(each): each for part in parts[::-1] for each in part.advice(scenario, load)}
    return tuple(sorted(found.values(), key=lambda each: "controller" in each.changes))


def saturated_shares(scenario: Scenario, signals: Signals) -> dict[str, float]:
    """The share of the samples in which each of the base's actuators saturated, by its title in
    lower case.
    """
    return {
        part.title.lower(): float(np.mean(part.saturated(signals)))
        for part in base_actuators(scenario).values()
    }


def _base_load(mission: Mission) -> Load:
    """The load of a mission on its base's actuators, and changes that reduce it."""
    scenario, planned = mission.scenario, PlannedDynamics(*from_grasp(mission))
    coordinates, peak = planned.coordinates, _motion_peak(planned)
    limit = actuation_limit(scenario, coordinates).upper
    noise = coordinates.vector(
        scenario.sensing.position_noise, key="sensing.position_noise", default=0.0
    )
    inverse = np.linalg.inv(planned.mass_matrices(planned.motion.begin)[1])
    groups = {
        group: GroupLoad(
            limit=float(limit[own].min()),
            inertia=1.0 / float(np.linalg.eigvalsh(inverse[own, own])[0]),
            noise=float(noise[own].max()),
            motion=float(peak[own].max()),
        )
        for group, own in coordinates.driven_groups.items()
        if group != "joints" and np.isfinite(limit[own]).all()
    }
    law, other = controller_factory(scenario), None
    if getattr(law, "chooses_k_s", False):
        other = Advice(changes={"controller": "tdc"}, reason="or this law, which has no integral")
    return Load(
        groups=groups,
        slower=_slower(mission, groups),
        softer=dict(_softer(scenario, coordinates, groups)),
        other_law=other,
    )


def _motion_peak(planned: PlannedDynamics) -> np.ndarray:
    """The largest force (nv) of perfect tracking, of a capture after its first seconds."""
    end = min(planned.motion.end, planned.scenario.duration)
    begin = min(_TRANSIENT, 0.5 * end) if planned.scenario.grasps else 0.0
    _, force = planned.perfect_tracking(np.linspace(begin, end, _INSTANTS))
    return np.abs(force).max(axis=0)


def _slower(mission: Mission, groups: Mapping[str, GroupLoad]) -> Advice | None:
    """A longer motion, whose peak leaves a third of the limits, where the given one takes more and
    there is one.
    """
    scenario = mission.scenario
    given = scenario.reference.duration or 0.0
    used = max((each.motion / each.limit for each in groups.values()), default=0.0)
    if used <= _MOST or scenario.reference.kind == "optimal":
        return None
    reason, duration = f"the motion needs {used:.2g} of their limits, then ", given
    while used > _WANTED:
        duration = math.ceil(duration * max(_LEAST_STEP, math.sqrt(used / _WANTED)))
        if duration > _LONGEST * given:
            return None
        changes = {
            "reference.duration": float(duration),
            "duration": scenario.duration + duration - given,
        }
        planned = PlannedDynamics(*from_grasp(mission.of(override_scenario(scenario, [changes]))))
        peak, own = _motion_peak(planned), planned.coordinates.groups
        used = max(float(peak[own[name]].max()) / each.limit for name, each in groups.items())
    return Advice(changes=changes, reason=f"{reason}{used:.2g}")


def _softer(
    scenario: Scenario, coordinates: Coordinates, groups: Mapping[str, GroupLoad]
) -> Iterator[tuple[str, Advice]]:
    """Smaller gains by group, for a law designed by axis, if noise at their bandwidth, or a
    saturated integral, requires more than the available force.
    """
    law: Any = controller_factory(scenario)
    unit = law.gains_for(1.0, 1.0) if hasattr(law, "gains_for") else {}
    if "k_d" not in unit or (law.chooses_k_s and "k_s_max" not in unit):
        return
    given = gain_vectors(scenario, coordinates)
    for group, load in groups.items():
        own = coordinates.groups[group]
        acceleration = load.limit / load.inertia
        room = load.limit - min(load.motion, _WANTED * load.limit)
        was = float(given["k_d"][own].max()) / unit["k_d"]
        least = load.inertia * _NOISE_PEAK * max(load.noise, 1e-12)
        omega, reasons = rounded(min(was, math.sqrt(room / least))), list[str]()
        if omega < 0.95 * was:
            reasons.append(f"bandwidth of {group} {omega:g} instead of {was:.3g} rad/s")
        k_s = 0.0
        if law.chooses_k_s:
            gain = min(float(given["k_s_max"][own].max()), 2.0 / scenario.sample_time)
            tolerated = _TOLERATED * load.noise
            k_s = min(gain, _largest_k_s(omega, acceleration, tolerated))
            amplitude = _run_away(was, gain, acceleration)
            if k_s < 0.95 * gain:
                reasons.append(
                    f"K_s {rounded(k_s):g} instead of {gain:.3g} 1/s: saturation is unstable "
                    "beyond "
                    f"errors of {_run_away(omega, k_s, acceleration):.2g} instead of "
                    f"{amplitude:.2g} {coordinates.units[own][0]}"
                )
        if reasons:
            values = law.gains_for(omega, rounded(k_s))
            changes = [
                _changed_gain(scenario, name, group, value)
                for name, value in values.items()
                if not np.allclose(given[name][own], value, rtol=1e-3)
            ]
            yield group, Advice(changes=dict(changes), reason="; ".join(reasons))


def _changed_gain(
    scenario: Scenario, name: str, group: str, value: float
) -> tuple[str, float | dict[str, float]]:
    """The key and the value that give a gain of a group a value."""
    place, given = f"controllers.{scenario.controller_key}.{name}", scenario.gains.get(name, {})
    if isinstance(given, Mapping) and not any(each.startswith(f"{group}_") for each in given):
        return f"{place}.{group}", value
    complete = complete_gains(scenario).gains[name] or {}
    others = {each: x for each, x in complete.items() if not each.startswith(f"{group}_")}
    return place, {**others, group: value}


def _run_away(omega: float, k_s: float, acceleration: float) -> float:
    """The amplitude, rad or m, beyond which a loop with K_D = 2 w, K_P = w^2 and the integral
    K_s K_P runs away where it saturates at an acceleration, by its describing function.
    """
    return 4.0 / math.pi * acceleration * (2.0 * omega + k_s) / max(k_s * omega**2, 1e-12)


def _largest_k_s(omega: float, acceleration: float, amplitude: float) -> float:
    """The K_s, 1/s, with which ``_run_away`` is an amplitude; infinite: any."""
    most = 4.0 / math.pi * acceleration
    beyond = amplitude * omega**2 - most
    return most * 2.0 * omega / beyond if beyond > 0.0 else math.inf
