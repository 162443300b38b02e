"""Limits of the joints, as the URDF gives them, against the postures, the plan and the run. Nothing enforces them.

``actuation.limit`` is what saturates the force; ``saturation`` says how often it did.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.common.errors import ModelError
from ffsm_drake.common.memo import memoized
from ffsm_drake.control_design.momentum import momentum_budget
from ffsm_drake.runs.capture import NOTHING, target_path
from ffsm_drake.scenario import Model, Scenario, planned_part
from ffsm_drake.spacecraft.capture import planned_contact, velocity_at_start
from ffsm_drake.spacecraft.clearance import ApproachClearance, Clearance
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES, position_error
from ffsm_drake.spacecraft.joint_limits import JointLimits, joint_limits, rate_limits
from ffsm_drake.spacecraft.mass_properties import set_payload
from ffsm_drake.spacecraft.nominal import PlantModel, make_flexible_plant, make_nominal_plant, make_true_plant
from ffsm_drake.spacecraft.plant import configuration, files_read, find_body, make_plant, model_files
from ffsm_drake.systems.actuation.drives import DriveSet
from ffsm_drake.systems.actuation.limits import base_limits, force_limits
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_motion

if TYPE_CHECKING:
    from ffsm_drake.runs.record import RunRecord
    from ffsm_drake.runs.rollout import RunLog

_POSTURES = 201  # at which the plan is looked at
_SLACK = 1e-9  # relative; a plan may end at a limit
_SAME_MASS = 1e-3  # relative
_SAME_START = 1e-6  # rad, m, and per second
CLEARANCE = "clearance"  # among the limits that a run leaves
# Of an integrator with fixed steps: the power of w h in the damping ratio that it adds or takes, and its divisor.
_STEP_ERRORS = {"explicit_euler": (1, 2.0), "runge_kutta2": (3, 8.0), "runge_kutta3": (3, 24.0)}
_LEAST_DAMPING = 1e-4
_INSTANTS = 51  # in which clearance is looked at along a plan; twice as many along a run


class LimitWarning(UserWarning):
    """A plan leaves the limits of the model."""


def plan_remarks(scenario: Scenario) -> list[str]:
    """What in a scenario leaves the limits of its model, or takes the place of its values; a line each.

    Looks at the postures and, unless a user-supplied block replaces it, at the planned motion: positions, rates, and
    the force that perfect tracking takes with the true payload, disturbances aside.

    Raises:
      ModelError, ScenarioError: the model or a posture cannot be used.
    """
    model = make_true_plant(scenario)
    limits = joint_limits(scenario.model, model.plant)
    remarks = [*_cut_short(scenario), *_overridden_mass(scenario, model.plant), *_coarse_steps(scenario)]
    for name, posture in scenario.postures.items():
        q = configuration(model.plant, posture, key=name)[NUM_BASE_POSITIONS:]
        remarks += _positions(limits, q[None], f"{name}.joints", _no_time)
    if scenario.blocks.reference is not None:
        return remarks
    motion = make_motion(scenario, model.coordinates)
    remarks += [*motion.remarks(), *_starts_elsewhere(scenario, motion, model.plant)]
    remarks += _clearance(lambda: plan_clearance(scenario), scenario.clearance, "the planned motion")
    remarks += _momentum(scenario)
    limit, limited_by = np.full(len(model.coordinates.names), np.inf), "actuation.limit"
    if scenario.blocks.actuation is None:
        limit = model.coordinates.vector(scenario.actuation.limit or {}, key="actuation.limit", default=np.inf)
        if scenario.actuation.thrusters is not None or scenario.actuation.wheels is not None:
            limited_by += " or what thrusters and wheels give"
        base = base_limits(scenario)
        limit[:NUM_BASE_VELOCITIES] = np.minimum(limit[:NUM_BASE_VELOCITIES], np.repeat([base.torque, base.force], 3))
    drives = None
    if scenario.drives is not None:
        drives = DriveSet(scenario.drives, scenario.actuation.limit, model.coordinates)
    part = functools.partial(_motion_remarks, model, motion, limits, limit, limited_by, drives)
    remarks += part(begin=motion.begin, end=min(motion.end, scenario.duration))
    if motion.begin > 0.0:
        set_payload(model.plant, model.context, body=scenario.payload.body, properties=NOTHING)
        remarks += part(begin=0.0, end=motion.begin - scenario.sample_time)
    return remarks


def _motion_remarks(
    model: PlantModel,
    motion: PlannedMotion,
    limits: JointLimits,
    limit: np.ndarray,
    limited_by: str,
    drives: DriveSet | None,
    *,
    begin: float,
    end: float,
) -> Iterator[str]:
    """Where a planned motion, or following it with the model's payload, is beyond the joints' limits or a force's."""
    times = np.linspace(begin, end, _POSTURES)
    q, v, a = np.split(motion.rows(times), np.cumsum([len(motion.coordinates.position_names), limit.size]), axis=1)

    def at(sample: int) -> str:
        return f" at t = {times[sample]:.3g} s"

    yield from _sizes(limits, v[:, NUM_BASE_VELOCITIES:], limits.velocity, "the planned motion", "/s", at)
    if not np.isfinite(np.r_[limits.effort, limit]).any():
        return
    force, tracking = model.calc_tracking_force(q, v, a), "tracking the planned motion perfectly takes"
    most, what = np.tile(limit, (len(times), 1)), limited_by
    if drives is not None:
        joints = slice(NUM_BASE_VELOCITIES, None)
        force[:, joints] -= drives.friction(v[:, joints])
        forward = force[:, joints] * v[:, joints] > 0.0
        most[:, joints] = np.where(forward, drives.available(v[:, joints]), most[:, joints])
        what += " or what drives give at their rate" if drives.has_rate_limit else ""
    yield from _sizes(limits, force[:, NUM_BASE_VELOCITIES:], limits.effort, tracking, " force", at)
    parts = []
    for i, name in enumerate(motion.coordinates.names):
        worst = int(np.argmax(np.abs(force[:, i]) / np.maximum(most[:, i], 1e-12)))
        if abs(force[worst, i]) > most[worst, i] * (1.0 + _SLACK):
            unit = {"rad": "N m", "m": "N"}[motion.coordinates.units[i]]
            parts.append(f"{name} {abs(force[worst, i]):.4g} {unit}{at(worst)} (limit {most[worst, i]:.4g})")
    if parts:
        yield f"{tracking}: beyond {what}: {', '.join(parts)}"


def run_remarks(record: "RunRecord") -> list[str]:
    """Where a run left the limits of its model, and where its force saturated; a line each.

    Raises:
      ModelError: the scenario's model does not load any more.
    """
    data, time = record.dataset, record.dataset["time"].values
    if time.size == 0:
        return []
    limits = joint_limits(record.scenario.model, make_plant(record.scenario.model))

    def at(sample: int) -> str:
        return f" at t = {time[sample]:.2f} s"

    q = data["position"].values[:, NUM_BASE_POSITIONS:]
    v, tau = (data[name].values[:, NUM_BASE_VELOCITIES:] for name in ("velocity", "applied_force"))
    remarks = list(_positions(limits, q, "the run", at))
    remarks += _sizes(limits, v, limits.velocity, "the run", "/s", at)
    remarks += _sizes(limits, tau, limits.effort, "the run applies", " force", at)
    remarks += _clearance(lambda: run_clearance(record), record.scenario.clearance, "the run")
    shares = [f"{name} in {100.0 * share:.3g} %" for name, share in saturation(record).items()]
    if shares:
        remarks.append(f"saturated at actuation.limit: {', '.join(shares)} of the samples")
    return remarks


@dataclasses.dataclass(frozen=True, kw_only=True)
class Closest:
    """Where a motion brings two parts of the spacecraft nearest to each other."""

    first: str  # names of the bodies
    second: str
    distance: float  # m; negative: they overlap by this
    time: float  # s
    before_grasp: bool = False  # while the target is a body of its own

    def __str__(self) -> str:
        before = ", before the grasp" if self.before_grasp else ""
        return f"{self.first} and {self.second} {self.distance:.3g} m apart at t = {self.time:.3g} s{before}"


def plan_clearance(scenario: Scenario) -> list[Closest]:
    """Where the planned motion brings parts nearest to each other, before a grasp and with the target held.

    Empty for a user-supplied motion, or if no parts can meet.

    Raises ModelError: the model does not load, or has shapes without a distance.
    """
    if scenario.blocks.reference is not None:
        return []
    return _plan_clearance_of(planned_part(scenario), files_read(scenario))


@memoized(maxsize=64)  # a run, its report and the next run of the same plan ask for the same
def _plan_clearance_of(scenario: Scenario, files: tuple[Path, ...]) -> list[Closest]:
    """Of a scenario whose model and plan are made from ``files``."""
    model = make_nominal_plant(scenario)
    motion = make_motion(scenario, model.coordinates)
    found: list[Closest] = []
    if motion.begin > 0.0:
        _, path = target_path(scenario, model, planned_contact(scenario, model))
        chosen = np.unique(np.linspace(0, len(path) - 1, _INSTANTS).round().astype(int))
        times = scenario.sample_time * chosen
        found += _closest(scenario, times, _positions_of(motion, times), target=path[chosen, :7])
    times = np.linspace(motion.begin, min(motion.end, scenario.duration), _INSTANTS)
    return [*found, *_closest(scenario, times, _positions_of(motion, times))]


def _positions_of(motion: PlannedMotion, times: np.ndarray) -> np.ndarray:
    return motion.rows(times)[:, : len(motion.coordinates.position_names)]


def run_clearance(record: "RunRecord") -> list[Closest]:
    """As ``plan_clearance``, of a run, looked at in a hundred samples of each of its phases.

    Raises ModelError: as ``plan_clearance``.
    """
    data = record.dataset
    found: list[Closest] = []
    phases = data["phase"].values if "phase" in data.coords else np.full(data.sizes["time"], "stop")
    for phase in ("approach", "stop"):
        samples = np.flatnonzero(phases == phase)
        if samples.size == 0:
            continue
        chosen = samples[np.unique(np.linspace(0, samples.size - 1, 2 * _INSTANTS - 1).round().astype(int))]
        part, target = data.isel(time=chosen), None
        if phase == "approach":
            target = np.hstack([part["target_quaternion"].values, part["target_position"].values])
        found += _closest(record.scenario, part["time"].values, part["position"].values, target=target)
    return found


def _closest(
    scenario: Scenario, times: np.ndarray, q: np.ndarray, *, target: np.ndarray | None = None
) -> Iterator[Closest]:
    """Where configurations (n, nq) come nearest to themselves or, before a grasp, the target with poses (n, 7)."""
    clearance = _shapes(scenario, apart=None if target is None else scenario.payload.body)
    if target is not None:
        q = np.hstack([q, target])
    if clearance.pairs and np.isfinite(q).all(axis=1).any():
        approach = clearance.along(q)
        nearest, time = approach.nearest, float(times[approach.index])
        yield Closest(
            first=nearest.first, second=nearest.second, distance=nearest.distance, time=time,
            before_grasp=target is not None,
        )  # fmt: skip


def _shapes(scenario: Scenario, *, apart: str | None = None) -> Clearance:
    """The shapes of a scenario's model, where the target is held or, before a grasp, ``apart``."""
    return _loaded(scenario.model, model_files(scenario.model), apart)


@memoized(maxsize=4)  # a campaign asks after every run, and loading takes longer than looking
def _loaded(model: Model, files: tuple[Path, ...], apart: str | None) -> Clearance:
    """Of a model that is made from ``files``."""
    return Clearance(model) if apart is None else ApproachClearance(model, apart)


def _clearance(find: Callable[[], list[Closest]], threshold: float, what: str) -> Iterator[str]:
    """Says so when parts come nearer to each other than a threshold, m."""
    try:
        found = find()
    except ModelError as error:
        yield f"clearance is not looked at: {error}"
        return
    for closest in found:
        if closest.distance >= threshold:
            continue
        pair = f"{closest.first} and {closest.second}"
        size = f"{abs(closest.distance):.3g} m"
        state = f"overlap by {size}" if closest.distance < 0.0 else f"come within {size} of each other"
        yield f"{what}: {pair} {state} at t = {closest.time:.3g} s (clearance {threshold:g} m)"


def _momentum(scenario: Scenario) -> Iterator[str]:
    """Says so when the wheels cannot hold what a grasp leaves, or an accepted drift does not last for the run."""
    budget = momentum_budget(scenario) if scenario.undriven else None
    if budget is None:
        return
    if budget.wheels is not None and budget.wheels.peak_share > 1.0:
        wheels = budget.wheels
        yield (
            f"actuation.wheels: {wheels.fullest} has to take {100.0 * wheels.peak_share:.3g} % of its most to hold the "
            f"attitude after the grasp; {np.linalg.norm(budget.angular):.3g} N m s are left in the stack, along which "
            f"the wheels hold {wheels.capacity:.3g}"
        )
    for group, time in budget.used_up.items():
        if time is not None and time < scenario.duration:
            yield f"capture.accepted_drift.{group}: is used up {time:.3g} s after the grasp, as planned"


def _starts_elsewhere(scenario: Scenario, motion: PlannedMotion, plant: MultibodyPlant) -> Iterator[str]:
    """Says so when a plan was made for another posture or velocity than the run starts with."""
    if scenario.reference.kind != "optimal":
        return
    q_d, v_d, _ = motion.evaluate(motion.begin)
    names = motion.coordinates.names
    q = configuration(plant, scenario.initial_posture, key="initial_posture")
    v = velocity_at_start(scenario, make_nominal_plant(scenario))
    for what, difference in (("initial_posture", position_error(q_d, q)), ("initial_velocity", v_d - v)):
        worst = int(np.argmax(np.abs(difference)))
        if abs(difference[worst]) > _SAME_START:
            yield (
                f"{what}: reference.plan starts {abs(difference[worst]):.3g} off in {names[worst]}; 'ffsm plan' makes "
                "one for this scenario"
            )


def saturation(record: "RunRecord") -> dict[str, float]:
    """Share of the samples in which what was commanded of a coordinate was beyond ``actuation.limit``, where any."""
    scenario, data = record.scenario, record.dataset
    if data.sizes["time"] == 0 or scenario.actuation.limit is None or scenario.blocks.actuation is not None:
        return {}
    names, groups = (data[name].values.astype(str).tolist() for name in ("coordinate", "group"))
    given = scenario.actuation.limit
    limit = np.array([given.get(n, given.get(g, given.get("all", np.inf))) for n, g in zip(names, groups, strict=True)])
    shares = (np.abs(data["generalized_force"].values) > limit).mean(axis=0)
    return {name: float(share) for name, share in zip(names, shares, strict=True) if share > 0.0}


def limits_left(log: "RunLog") -> dict[str, float]:
    """When a run first left each of its limits, s: forces commanded, velocities and positions of joints, clearance.

    Of a run with a capture clearance is looked at from the grasp on, as in ``run_clearance``.
    """
    scenario, coordinates = log.scenario, log.coordinates
    clearance = _shapes(scenario)
    plant = clearance.plant
    joints, state = joint_limits(scenario.model, plant), log.series["state"]
    nq = len(coordinates.position_names)
    q, v = state[:, NUM_BASE_POSITIONS:nq], state[:, nq + NUM_BASE_VELOCITIES :]
    reach = 1.0 + _SLACK
    with np.errstate(invalid="ignore"):
        beyond = {
            "force on": (coordinates.names, np.abs(log.generalized_force) > reach * force_limits(scenario, plant)),
            "velocity of": (joints.names, np.abs(v) > reach * rate_limits(scenario, plant)),
            "position of": (joints.names, (q > joints.upper + _SLACK) | (q < joints.lower - _SLACK)),
        }
    found = {
        f"{what} {name}": float(log.time[np.argmax(left)])
        for what, (names, columns) in beyond.items()
        for name, left in zip(names, columns.T, strict=True)
        if left.any()
    }
    first = 0 if log.grasp is None else log.grasp.sample
    if clearance.pairs and log.time.size > first:
        for sample in np.unique(np.linspace(first, log.time.size - 1, _INSTANTS).round().astype(int)):
            if np.isfinite(state[sample]).all() and (
                clearance.nearest(state[sample, :nq]).distance < scenario.clearance
            ):
                return found | {CLEARANCE: float(log.time[sample])}
    return found


def _no_time(sample: int) -> str:
    return ""


def _positions(limits: JointLimits, q: np.ndarray, what: str, at: Callable[[int], str]) -> Iterator[str]:
    """A line with the joints whose positions (n, joints) leave their limits."""
    reach = np.where(np.isfinite(limits.upper - limits.lower), limits.upper - limits.lower, 1.0)
    with np.errstate(invalid="ignore"):
        excess = np.fmax(q - limits.upper, limits.lower - q)
    parts = []
    for i, name in enumerate(limits.names):
        worst = int(np.argmax(np.where(np.isfinite(excess[:, i]), excess[:, i], -np.inf)))
        if excess[worst, i] > _SLACK * max(reach[i], 1.0):
            span = f"{limits.lower[i]:.4g} to {limits.upper[i]:.4g} {limits.units[i]}"
            parts.append(f"{name} {q[worst, i]:.4g}{at(worst)} (limits {span})")
    if parts:
        yield f"{what}: outside the URDF's position limits: {', '.join(parts)}"


def _sizes(
    limits: JointLimits, values: np.ndarray, largest: np.ndarray, what: str, kind: str, at: Callable[[int], str]
) -> Iterator[str]:
    """A line with the joints whose values (n, joints) are larger than their limit."""
    parts = []
    for i, name in enumerate(limits.names):
        size = np.nan_to_num(np.abs(values[:, i]), nan=0.0)
        worst = int(np.argmax(size))
        if size[worst] > largest[i] * (1.0 + _SLACK):
            unit = {"rad": "N m", "m": "N"}[limits.units[i]] if kind == " force" else f"{limits.units[i]}{kind}"
            parts.append(f"{name} {size[worst]:.4g} {unit}{at(worst)} (limit {largest[i]:.4g})")
    if parts:
        named = "effort" if kind == " force" else "velocity"
        yield f"{what}: beyond the URDF's {named} limits: {', '.join(parts)}"


def _cut_short(scenario: Scenario) -> Iterator[str]:
    """Says so when a run ends before its duration, which is not a whole number of control samples."""
    end = scenario.num_control_periods * scenario.sample_time
    if end < scenario.duration * (1.0 - _SLACK):
        yield (
            f"duration: {scenario.duration:g} s are not a whole number of samples of {scenario.sample_time:g} s; the "
            f"run ends at {end:g} s"
        )


def _coarse_steps(scenario: Scenario) -> Iterator[str]:
    """Whether the integrator's steps damp or excite a hidden mode by more than a fifth of its own damping.

    A fixed step h changes the amplitude of w by a factor 1 -+ (w h)^n / m: it adds the damping ratio (w h)^(n-1) / m.
    """
    config = scenario.simulator_config
    if not scenario.model.flexible or config.use_error_control or config.integration_scheme not in _STEP_ERRORS:
        return
    model = make_flexible_plant(scenario)
    mode = model.hidden_modes(configuration(model.plant, scenario.initial_posture, key="initial_posture"))[-1]
    power, divisor = _STEP_ERRORS[config.integration_scheme]
    w, step = 2.0 * np.pi * mode.frequency, min(config.max_step_size, scenario.sample_time)
    added, own = (w * step) ** power / divisor, max(mode.damping_ratio, _LEAST_DAMPING)
    if added > 0.2 * own:
        finer = float(f"{(0.1 * own * divisor) ** (1.0 / power) / w:.1g}")
        yield (
            f"simulator_config.max_step_size: steps of {step:g} s change the damping of the hidden mode at "
            f"{mode.frequency:.3g} Hz by {added:.2g}, its own is {mode.damping_ratio:.2g}; take {finer:g} s or less"
        )


def _overridden_mass(scenario: Scenario, plant: MultibodyPlant) -> Iterator[str]:
    """Says so when the target's URDF, if it is not the shipped one, has another mass than the scenario gives it."""
    model = scenario.model
    source = model.debris if model.servicer is not None else model.directives or ""
    own, given = find_body(plant, scenario.payload.body, key="payload.body").default_mass(), scenario.payload.truth.mass
    shipped = source.startswith("package://ffsm_drake/")
    if not shipped and own > 0.0 and abs(own - given) > _SAME_MASS * given:
        yield (
            f"payload.truth.mass: {given:.4g} kg takes the place of the {own:.4g} kg that the URDF gives "
            f"{scenario.payload.body}"
        )
