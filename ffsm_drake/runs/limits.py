"""Limits of the joints, as the URDF gives them, against the postures, the plan and the run. Nothing enforces them.

``actuation.limit`` is what saturates the force; ``saturation`` says how often it did.
"""

import dataclasses
import functools
import json
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.common.errors import ModelError
from ffsm_drake.scenario import Scenario, scenario_from_dict, scenario_to_dict
from ffsm_drake.spacecraft.capture import velocity_at_start
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES, position_error
from ffsm_drake.spacecraft.joint_limits import JointLimits, force_limits, joint_limits
from ffsm_drake.spacecraft.nominal import make_nominal_plant, make_true_plant
from ffsm_drake.spacecraft.plant import configuration, coordinates_of, find_body, make_plant, resolve_package, urdfs_of
from ffsm_drake.systems.reference import PlannedMotion, make_motion

if TYPE_CHECKING:
    from ffsm_drake.runs.record import RunRecord
    from ffsm_drake.runs.rollout import RunLog

_POSTURES = 201  # at which the plan is looked at
_SLACK = 1e-9  # relative; a plan may end at a limit
_SAME_MASS = 1e-3  # relative
_SAME_START = 1e-6  # rad, m, and per second
CLEARANCE = "clearance"  # among the limits that a run leaves
_INSTANTS = 51  # in which clearance is looked at along a plan; twice as many along a run


class LimitWarning(UserWarning):
    """A plan leaves the limits of the model."""


def plan_remarks(scenario: Scenario) -> list[str]:
    """What in a scenario leaves the limits of its model, or takes the place of its values; a line each.

    Looks at the postures and, unless a user-supplied block replaces it, at the planned motion: positions, rates, and
    the force that perfect tracking asks of the joints with the true payload, disturbances aside.

    Raises:
      ModelError, ScenarioError: the model or a posture cannot be used.
    """
    model = make_true_plant(scenario)
    limits = joint_limits(scenario.model, model.plant)
    remarks = [*_cut_short(scenario), *_overridden_mass(scenario, model.plant)]
    for name, posture in scenario.postures.items():
        q = configuration(model.plant, posture, key=name)[NUM_BASE_POSITIONS:]
        remarks += _positions(limits, q[None], f"{name}.joints", _no_time)
    if scenario.blocks.reference is not None:
        return remarks
    motion = make_motion(scenario, model.coordinates)
    remarks += _starts_elsewhere(scenario, motion, model.plant)
    remarks += _clearance(lambda: plan_clearance(scenario), scenario.clearance, "the planned motion")
    if not np.isfinite([limits.lower, limits.upper, limits.velocity, limits.effort]).any():
        return remarks
    times = np.linspace(motion.begin, min(motion.end, scenario.duration), _POSTURES)
    rows = motion.rows(times)
    nq, nv = len(model.coordinates.position_names), len(model.coordinates.names)
    q, v, a = rows[:, :nq], rows[:, nq : nq + nv], rows[:, nq + nv :]

    def at(sample: int) -> str:
        return f" at t = {times[sample]:.3g} s"

    if np.isfinite(limits.velocity).any():
        remarks += _sizes(limits, v[:, NUM_BASE_VELOCITIES:], limits.velocity, "the planned motion", "/s", at)
    if np.isfinite(limits.effort).any():
        tracking = "tracking the planned motion perfectly takes"
        forces = model.calc_inverse_dynamics(q, v, a)[:, NUM_BASE_VELOCITIES:]
        remarks += _sizes(limits, forces, limits.effort, tracking, " force", at)
    return remarks


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

    def __str__(self) -> str:
        return f"{self.first} and {self.second} {self.distance:.3g} m apart at t = {self.time:.3g} s"


def plan_clearance(scenario: Scenario) -> Closest | None:
    """Where the planned motion brings parts nearest to each other; None for a user-supplied one, or if none can meet.

    Raises ModelError: the model does not load, or has shapes without a distance.
    """
    if scenario.blocks.reference is not None:
        return None
    data = scenario_to_dict(scenario)
    # What it depends on: a run, its report and the next run of the same plan ask for the same.
    keys = ("model", "reference", "initial_posture", "target_posture", "duration", "sample_time", "capture")
    shortest = ("payload", "actuation") if scenario.capture or scenario.reference.duration is None else ()
    parts = {key: data[key] for key in (*keys, *shortest)}
    files = urdfs_of(scenario.model)
    if scenario.reference.kind == "optimal":
        files = (*files, resolve_package(scenario.reference.plan or ""))
    return _plan_clearance_of(json.dumps(parts), tuple(file.stat().st_mtime_ns for file in files if file.exists()))


@functools.lru_cache(maxsize=64)
def _plan_clearance_of(text: str, changed: tuple[int, ...]) -> Closest | None:
    """Of the parts of a scenario as text; ``changed`` is when its files were."""
    scenario = scenario_from_dict(json.loads(text))
    clearance = Clearance(scenario.model)
    motion = make_motion(scenario, coordinates_of(clearance.plant))
    times = np.linspace(motion.begin, min(motion.end, scenario.duration), _INSTANTS)
    return _closest(clearance, times, motion.rows(times)[:, : clearance.plant.num_positions()])


def run_clearance(record: "RunRecord") -> Closest | None:
    """Where a run brought parts nearest to each other, looked at in a hundred samples; None where none can meet.

    Of a run with a capture only what follows the grasp: before it the target is not where the model has it.

    Raises ModelError: as ``plan_clearance``.
    """
    count = record.dataset.sizes["time"]
    held = (
        np.flatnonzero(record.dataset["phase"].values == "stop") if "phase" in record.dataset.coords else range(count)
    )
    if len(held) == 0:
        return None
    chosen = np.unique(np.linspace(held[0], count - 1, 2 * _INSTANTS - 1).round().astype(int))
    time, q = (record.dataset[name].values[chosen] for name in ("time", "position"))
    return _closest(Clearance(record.scenario.model), time, q)


def _closest(clearance: Clearance, times: np.ndarray, q: np.ndarray) -> Closest | None:
    if not clearance.pairs or not np.isfinite(q).all(axis=1).any():
        return None
    approach = clearance.along(q)
    nearest, time = approach.nearest, float(times[approach.index])
    return Closest(first=nearest.first, second=nearest.second, distance=nearest.distance, time=time)


def _clearance(find: Callable[[], Closest | None], threshold: float, what: str) -> Iterator[str]:
    """Says so when parts come nearer to each other than a threshold, m."""
    try:
        closest = find()
    except ModelError as error:
        yield f"clearance is not looked at: {error}"
        return
    if closest is not None and closest.distance < threshold:
        pair = f"{closest.first} and {closest.second}"
        size = f"{abs(closest.distance):.3g} m"
        state = f"overlap by {size}" if closest.distance < 0.0 else f"come within {size} of each other"
        yield f"{what}: {pair} {state} at t = {closest.time:.3g} s (clearance {threshold:g} m)"


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
    clearance = _shapes_of(json.dumps(scenario_to_dict(scenario)["model"]))
    plant = clearance.plant
    joints, state = joint_limits(scenario.model, plant), log.series["state"]
    nq = len(coordinates.position_names)
    q, v = state[:, NUM_BASE_POSITIONS:nq], state[:, nq + NUM_BASE_VELOCITIES :]
    reach = 1.0 + _SLACK
    with np.errstate(invalid="ignore"):
        beyond = {
            "force on": (coordinates.names, np.abs(log.generalized_force) > reach * force_limits(scenario, plant)),
            "velocity of": (joints.names, np.abs(v) > reach * joints.velocity),
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


@functools.lru_cache(maxsize=1)  # a campaign asks after every run
def _shapes_of(text: str) -> Clearance:
    """Of the model of a scenario as text."""
    return Clearance(scenario_from_dict({"model": json.loads(text)}).model)


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
