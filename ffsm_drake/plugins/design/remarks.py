"""Remarks on a scenario before it runs: limits exceeded by its postures and its plan.

The URDF's limits are not enforced; ``actuation.limit`` saturates the force.
"""

import dataclasses
import functools
from collections.abc import Iterator

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.common.numbers import number, short
from ffsm_drake.mission import Mission, make_mission, planned
from ffsm_drake.plugins.actuators.drives import DriveSet
from ffsm_drake.plugins.capture.grasping import Aim
from ffsm_drake.plugins.capture.momentum import momentum_budget, storage_remark
from ffsm_drake.runs.exceeded_limits import (
    INSTANTS,
    Closest,
    closest_of,
    not_measured,
    remarks_on,
    too_near,
)
from ffsm_drake.scenario import NOTHING, Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, position_error
from ffsm_drake.spacecraft.limits import FORCE, POSITION, RATE, SLACK, Limit, tightest
from ffsm_drake.spacecraft.mass_properties import set_payload
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import configuration, find_body
from ffsm_drake.systems.mission_limits import DIRECTIONS, actuation_limit, joint_limits
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.registry import base_actuators
from ffsm_drake.systems.start import velocity_at_start

_UNEVEN = 30.0  # ratio of the largest to the least torque, or force; shipped sets: below 10
_POSTURES = 201  # number of instants of the plan evaluated
_SAME_MASS = 1e-3  # relative
_SAME_START = 1e-6  # rad, m, and per second
# Integrator with fixed steps -> power of w h in its numerical damping ratio, and divisor.
_STEP_ERRORS = {"explicit_euler": (1, 2.0), "runge_kutta2": (3, 8.0), "runge_kutta3": (3, 24.0)}
_LEAST_DAMPING = 1e-4
# rad that a harmonic may turn in a step: a third-order scheme integrates it to 1e-4
_PHASE = 0.5


def plan_remarks(mission: Scenario | Mission) -> list[str]:
    """A line for each limit exceeded by a scenario, and for each overridden value of its model.

    Raises:
      ModelError, ScenarioError: the model or a posture cannot be used.
    """
    mission = make_mission(mission)
    scenario, plant = mission.scenario, mission.craft.rigid
    remarks = [
        *_cut_short(scenario),
        *_stops_nothing(scenario),
        *_unnamed_target(scenario),
        *_overridden_mass(scenario, plant),
        *_coarse_steps(mission),
        *_fast_disturbances(scenario),
        *(uneven_remarks(scenario) if scenario.blocks.actuation is None else ()),
    ]
    if scenario.blocks.reference is None:
        motion = make_motion(mission)
        remarks += [*motion.remarks(), *_starts_elsewhere(mission, motion)]
        remarks += _momentum(mission)
    return [*remarks, *plan_limits(mission)]


def uneven_remarks(scenario: Scenario) -> Iterator[str]:
    """Remarks on nearly degenerate base actuators: output along the weakest direction. Raises the
    errors of ``base_limits``.
    """
    for part in base_actuators(scenario).values():
        principal = [np.linalg.svd(each)[0].T for each in part.reach(scenario).values()]
        directions = np.vstack([DIRECTIONS, *(-each for each in principal), *principal])
        for what, most in part.most(scenario, directions).items():
            finite = np.isfinite(most)
            if not finite.any() or most[finite].max() <= _UNEVEN * most[finite].min():
                continue
            weak, strong = np.where(finite, most, np.inf).argmin(), most[finite].max()
            axis = ", ".join(f"{each:.2g}" for each in directions[weak].round(3) + 0.0)
            unit = "N m" if what == "torque" else "N"
            by_axis = (most[np.abs(directions[:, k]) == 1.0].min() for k in range(3))
            axes = "x, y, z: " + ", ".join(number(each, 3) for each in by_axis)
            yield (
                f"actuation: {part.title.lower()} nearly degenerate: {what} along [{axis}] is "
                f"{most[weak]:.3g} {unit}, elsewhere up to {strong:.3g} {unit} ({axes} {unit}); "
                "turn their axes apart"
            )


def plan_limits(mission: Mission) -> list[str]:
    """A line for each limit that a mission's postures and plan exceed.

    Evaluates the postures and, unless a user-supplied block replaces it, the planned motion:
    clearance, rates, and the force for perfect tracking with the true payload, without
    disturbances.

    Raises: as ``plan_remarks``.
    """
    scenario, model = mission.scenario, mission.craft.true()
    limits, found = joint_limits(mission), posture_limits(mission)
    if scenario.blocks.reference is not None:
        return found
    motion = make_motion(mission)
    found += not_measured(scenario)
    found += too_near(plan_clearance(mission), scenario.clearance, "the planned motion")
    drives = None
    if scenario.drives is not None:
        drives = DriveSet(scenario.drives, scenario.actuation.limit, model.coordinates)
    if scenario.blocks.actuation is None:
        limits.append(actuation_limit(scenario, model.coordinates))
    part = functools.partial(_motion_remarks, model, motion, limits, drives)
    found += part(begin=motion.begin, end=min(motion.end, scenario.duration))
    if motion.begin > 0.0:
        set_payload(model.plant, model.context, body=scenario.payload.body, properties=NOTHING)
        found += part(begin=0.0, end=motion.begin - scenario.sample_time)
    return found


def posture_limits(mission: Mission) -> list[str]:
    """A line for each posture outside the joints' limits, and for each angle seemingly in degrees.

    Raises: as ``plan_remarks``.
    """
    limits, found = joint_limits(mission), list[str]()
    bounds = tightest(limits, POSITION)
    for key, posture in mission.scenario.postures.items():
        values = configuration(mission.craft.coordinates, posture, key=key)[1:]
        found += remarks_on(
            limits, {POSITION: values[None]}, lambda _: "", who=(f"{key}.joints", "")
        )
        turned = np.radians(values)
        inside, inside_turned = (
            bounds.used(each[None])[0] <= 1.0 + SLACK for each in (values, turned)
        )
        for i in np.flatnonzero(~inside & inside_turned & (np.abs(values) > 2.0 * np.pi)):
            if bounds.units[i] == "rad":
                found.append(
                    f"{key}.joints.{bounds.names[i]}: {values[i]:.4g} rad looks like degrees: "
                    f"{turned[i]:.3g} rad"
                )
    return found


def _stops_nothing(scenario: Scenario) -> Iterator[str]:
    """A line if the reference is to stop a spacecraft that does not move."""
    if scenario.stops_from_start and not any(scenario.initial_velocity.values()):
        yield (
            "reference.goal: stop holds initial_posture, because nothing moves; set "
            "initial_velocity, or add a capture"
        )


def _motion_remarks(
    model: PlantModel,
    plan: PlannedMotion,
    limits: list[Limit],
    drives: DriveSet | None,
    *,
    begin: float,
    end: float,
) -> Iterator[str]:
    """The rates and forces beyond their limits in a planned motion, tracked perfectly with the
    model's payload; positions are those of the postures.
    """
    times = np.linspace(begin, end, _POSTURES)
    motion = plan.demand(model, times)
    v = motion[RATE]
    del motion[POSITION]
    if drives is not None and np.isfinite(tightest(limits, FORCE).upper).any():
        motion[FORCE][:, NUM_BASE_VELOCITIES:] -= drives.friction(v[:, NUM_BASE_VELOCITIES:])
        limits = [*limits[:-1], _at_rate(limits[-1], drives, v, motion[FORCE])]
    yield from remarks_on(
        limits,
        motion,
        lambda sample: f" at t = {times[sample]:.3g} s",
        who=("the planned motion", "perfect tracking of the planned motion"),
    )


def _at_rate(limit: Limit, drives: DriveSet, v: np.ndarray, force: np.ndarray) -> Limit:
    """The actuators' limit of force where drives give less at velocities v (n, nv), with the
    motion.
    """
    most, joints = np.tile(limit.upper, (len(v), 1)), slice(NUM_BASE_VELOCITIES, None)
    forward = force[:, joints] * v[:, joints] > 0.0
    most[:, joints] = np.where(forward, drives.available(v[:, joints]), most[:, joints])
    further = " or the force of drives at their rate" if drives.has_rate_limit else ""
    return dataclasses.replace(limit, source=limit.source + further, upper=most, lower=-most)


@planned
def plan_clearance(mission: Mission) -> list[Closest]:
    """The smallest distance of parts in the planned motion, before a grasp and with the target
    held.

    Empty for a user-supplied motion, or if no parts can meet.

    Raises ModelError: the model does not load, or has shapes without a distance.
    """
    scenario = mission.scenario
    if scenario.blocks.reference is not None:
        return []
    motion, found = make_motion(mission), list[Closest]()
    if motion.begin > 0.0:
        path = Aim(mission).path
        chosen = np.unique(np.linspace(0, len(path) - 1, INSTANTS).round().astype(int))
        times = scenario.sample_time * chosen
        found += closest_of(scenario, times, motion.evaluate(times)[0], target=path[chosen, :7])
    times = np.linspace(motion.begin, min(motion.end, scenario.duration), INSTANTS)
    return [*found, *closest_of(scenario, times, motion.evaluate(times)[0])]


def _momentum(mission: Mission) -> Iterator[str]:
    """A line if the momentum after a grasp cannot be stored, and for each accepted drift that is
    exceeded during the run.
    """
    budget = momentum_budget(mission) if mission.scenario.undriven else None
    if budget is None:
        return
    if remark := storage_remark(budget):
        yield remark
    for group, time in budget.used_up.items():
        if time is not None and time < mission.scenario.duration:
            yield (
                f"capture.accepted_drift.{group}: exceeded {time:.3g} s after the grasp, as planned"
            )


def _starts_elsewhere(mission: Mission, motion: PlannedMotion) -> Iterator[str]:
    """A line if a plan starts at another posture or velocity than the run."""
    scenario = mission.scenario
    if scenario.reference.kind != "optimal":
        return
    q_d, v_d, _ = motion.evaluate(motion.begin)
    names = motion.coordinates.names
    q = configuration(motion.coordinates, scenario.initial_posture, key="initial_posture")
    v = velocity_at_start(mission, mission.craft.nominal())
    for what, difference in (
        ("initial_posture", position_error(q_d, q)),
        ("initial_velocity", v_d - v),
    ):
        worst = int(np.argmax(np.abs(difference)))
        if abs(difference[worst]) > _SAME_START:
            yield (
                f"{what}: {names[worst]} differs by {abs(difference[worst]):.3g} from the start of "
                "reference.plan; make a plan for this scenario with 'ffsm plan'"
            )


def _cut_short(scenario: Scenario) -> Iterator[str]:
    """A line if the duration is not a whole number of control samples: the run ends before it."""
    end = scenario.num_control_periods * scenario.sample_time
    if end < scenario.duration * (1.0 - SLACK):
        yield (
            f"duration: the run ends at {end:g} s, because {scenario.duration:g} s is not a whole "
            f"number of samples of {scenario.sample_time:g} s"
        )


def _coarse_steps(mission: Mission) -> Iterator[str]:
    """A line if the integrator's steps change the damping of a flexible mode by more than a fifth.

    A fixed step h changes the amplitude of w by a factor 1 -+ (w h)^n / m: it adds the damping
    ratio (w h)^(n-1) / m.
    """
    scenario, config = mission.scenario, mission.scenario.simulator_config
    if (
        not scenario.model.flexible
        or config.use_error_control
        or config.integration_scheme not in _STEP_ERRORS
    ):
        return
    model = mission.craft.flexible()
    mode = model.modes(
        configuration(model.coordinates, scenario.initial_posture, key="initial_posture")
    )[-1]
    power, divisor = _STEP_ERRORS[config.integration_scheme]
    w, step = 2.0 * np.pi * mode.frequency, min(config.max_step_size, scenario.sample_time)
    added, own = (w * step) ** power / divisor, max(mode.damping_ratio, _LEAST_DAMPING)
    if added > 0.2 * own:
        finer = float(f"{(0.1 * own * divisor) ** (1.0 / power) / w:.1g}")
        yield (
            f"simulator_config.max_step_size: steps of {step:g} s change the damping ratio of the "
            f"mode at {mode.frequency:.3g} Hz by {added:.2g} (own {mode.damping_ratio:.2g}); set "
            f"{finer:g} s or less"
        )


def _fast_disturbances(scenario: Scenario) -> Iterator[str]:
    """Harmonics that the integrator's fixed steps sample too coarsely.

    Near a whole number of periods a step, aliasing adds a spurious mean force.
    """
    config = scenario.simulator_config
    if config.use_error_control or "disturbance" in scenario.blocks.forces:
        return
    given, step = scenario.disturbance, min(config.max_step_size, scenario.sample_time)
    rates = {
        name: given.frequency_scale * abs(each.frequency)
        for name, each in given.harmonics.items()
        if given.amplitude_scale * each.amplitude
    }
    fast = {name: rate for name, rate in rates.items() if rate * step > _PHASE}
    if fast:
        name = max(fast, key=lambda each: fast[each])
        yield (
            f"disturbance.harmonics.{name}.frequency: {short(fast[name])} rad/s is aliased by "
            f"steps of {step:g} s; set simulator_config.max_step_size to "
            f"{_PHASE / fast[name]:.1g} or less"
        )


def _unnamed_target(scenario: Scenario) -> Iterator[str]:
    """A line if a servicer holds the shipped target because the scenario names no other."""
    model, usual = scenario.model, Scenario()
    given = model.debris, scenario.payload.truth
    if model.servicer is not None and given == (usual.model.debris, usual.payload.truth):
        yield (
            f"model.debris: not given, so {model.end_effector} holds the shipped target of "
            f"{usual.payload.truth.mass:g} kg; give its URDF, or payload.truth"
        )


def _overridden_mass(scenario: Scenario, plant: MultibodyPlant) -> Iterator[str]:
    """A line if the mass in the scenario differs from that of the target's URDF, unless this is
    the shipped one.
    """
    model = scenario.model
    source = model.debris if model.servicer is not None else model.directives or ""
    own, given = (
        find_body(plant, scenario.payload.body, key="payload.body").default_mass(),
        scenario.payload.truth.mass,
    )
    shipped = source.startswith("package://ffsm_drake/")
    if not shipped and own > 0.0 and abs(own - given) > _SAME_MASS * given:
        yield (
            f"payload.truth.mass: {short(given, 4)} kg replaces the {short(own, 4)} kg of "
            f"{scenario.payload.body} in the URDF"
        )
