"""Limits of the joints, as the URDF gives them, against the postures, the plan and the run. Nothing enforces them.

``actuation.limit`` is what saturates the force; ``saturation`` says how often it did.
"""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.limits import JointLimits, joint_limits
from ffsm_drake.spacecraft.nominal import make_true_plant
from ffsm_drake.spacecraft.plant import configuration, find_body, make_plant
from ffsm_drake.systems.reference import make_motion

if TYPE_CHECKING:
    from ffsm_drake.runs.record import RunRecord

_POSTURES = 201  # at which the plan is looked at
_SLACK = 1e-9  # relative; a plan may end at a limit
_SAME_MASS = 1e-3  # relative


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
    finite = np.isfinite([limits.lower, limits.upper, limits.velocity, limits.effort])
    if scenario.blocks.reference is not None or not finite.any():
        return remarks
    motion = make_motion(scenario, model.coordinates)
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
    shares = [f"{name} in {100.0 * share:.3g} %" for name, share in saturation(record).items()]
    if shares:
        remarks.append(f"saturated at actuation.limit: {', '.join(shares)} of the samples")
    return remarks


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
