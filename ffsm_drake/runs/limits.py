"""Limits of the joints, as the URDF gives them, against a run. Nothing enforces them.

``actuation.limit`` is what saturates the force; ``saturation`` says how often it did.
"""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ffsm_drake.common.errors import ModelError
from ffsm_drake.common.memo import memoized
from ffsm_drake.scenario import Model, Scenario
from ffsm_drake.spacecraft.clearance import ApproachClearance, Clearance
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.joint_limits import JointLimits, joint_limits, rate_limits
from ffsm_drake.spacecraft.plant import make_plant, model_files
from ffsm_drake.systems.actuation.limits import force_limits

if TYPE_CHECKING:
    from ffsm_drake.runs.log import RunLog
    from ffsm_drake.runs.record import RunRecord

SLACK = 1e-9  # relative; a plan may end at a limit
CLEARANCE = "clearance"  # among the limits that a run leaves
INSTANTS = 51  # in which clearance is looked at along a plan; twice as many along a run


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
    remarks = list(position_remarks(limits, q, "the run", at))
    remarks += size_remarks(limits, v, limits.velocity, "the run", "/s", at)
    remarks += size_remarks(limits, tau, limits.effort, "the run applies", " force", at)
    remarks += clearance_remarks(
        lambda: run_clearance(record), record.scenario.clearance, "the run"
    )
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
        return (
            f"{self.first} and {self.second} {self.distance:.3g} m apart at t = "
            f"{self.time:.3g} s{before}"
        )


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
        chosen = samples[
            np.unique(np.linspace(0, samples.size - 1, 2 * INSTANTS - 1).round().astype(int))
        ]
        part, target = data.isel(time=chosen), None
        if phase == "approach":
            target = np.hstack([part["target_quaternion"].values, part["target_position"].values])
        found += closest_of(
            record.scenario, part["time"].values, part["position"].values, target=target
        )
    return found


def closest_of(
    scenario: Scenario, times: np.ndarray, q: np.ndarray, *, target: np.ndarray | None = None
) -> Iterator[Closest]:
    """Where configurations (n, nq) come nearest to themselves or, before a grasp, the target with
    poses (n, 7).
    """
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


def clearance_remarks(
    find: Callable[[], list[Closest]], threshold: float, what: str
) -> Iterator[str]:
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
        state = (
            f"overlap by {size}"
            if closest.distance < 0.0
            else (f"come within {size} of each other")
        )
        yield f"{what}: {pair} {state} at t = {closest.time:.3g} s (clearance {threshold:g} m)"


def saturation(record: "RunRecord") -> dict[str, float]:
    """Share of the samples in which what was commanded of a coordinate was beyond
    ``actuation.limit``, where any.
    """
    scenario, data = record.scenario, record.dataset
    if (
        data.sizes["time"] == 0
        or scenario.actuation.limit is None
        or scenario.blocks.actuation is not None
    ):
        return {}
    names, groups = (data[name].values.astype(str).tolist() for name in ("coordinate", "group"))
    given = scenario.actuation.limit
    limit = np.array(
        [
            given.get(n, given.get(g, given.get("all", np.inf)))
            for n, g in zip(names, groups, strict=True)
        ]
    )
    shares = (np.abs(data["generalized_force"].values) > limit).mean(axis=0)
    return {name: float(share) for name, share in zip(names, shares, strict=True) if share > 0.0}


def limits_left(log: "RunLog") -> dict[str, float]:
    """When a run first left each of its limits, s: forces commanded, velocities and positions of
    joints, clearance.

    Of a run with a capture clearance is looked at from the grasp on, as in ``run_clearance``.
    """
    scenario, coordinates = log.scenario, log.coordinates
    clearance = _shapes(scenario)
    plant = clearance.plant
    joints, state = joint_limits(scenario.model, plant), log.series["state"]
    nq = len(coordinates.position_names)
    q, v = state[:, NUM_BASE_POSITIONS:nq], state[:, nq + NUM_BASE_VELOCITIES :]
    reach = 1.0 + SLACK
    with np.errstate(invalid="ignore"):
        beyond = {
            "force on": (
                coordinates.names,
                np.abs(log.generalized_force) > reach * force_limits(scenario, plant),
            ),
            "velocity of": (joints.names, np.abs(v) > reach * rate_limits(scenario, plant)),
            "position of": (joints.names, (q > joints.upper + SLACK) | (q < joints.lower - SLACK)),
        }
    found = {
        f"{what} {name}": float(log.time[np.argmax(left)])
        for what, (names, columns) in beyond.items()
        for name, left in zip(names, columns.T, strict=True)
        if left.any()
    }
    first = 0 if log.grasp is None else log.grasp.sample
    if clearance.pairs and log.time.size > first:
        for sample in np.unique(
            np.linspace(first, log.time.size - 1, INSTANTS).round().astype(int)
        ):
            if np.isfinite(state[sample]).all() and (
                clearance.nearest(state[sample, :nq]).distance < scenario.clearance
            ):
                return found | {CLEARANCE: float(log.time[sample])}
    return found


def position_remarks(
    limits: JointLimits, q: np.ndarray, what: str, at: Callable[[int], str]
) -> Iterator[str]:
    """A line with the joints whose positions (n, joints) leave their limits."""
    reach = np.where(np.isfinite(limits.upper - limits.lower), limits.upper - limits.lower, 1.0)
    with np.errstate(invalid="ignore"):
        excess = np.fmax(q - limits.upper, limits.lower - q)
    parts = []
    for i, name in enumerate(limits.names):
        worst = int(np.argmax(np.where(np.isfinite(excess[:, i]), excess[:, i], -np.inf)))
        if excess[worst, i] > SLACK * max(reach[i], 1.0):
            span = f"{limits.lower[i]:.4g} to {limits.upper[i]:.4g} {limits.units[i]}"
            parts.append(f"{name} {q[worst, i]:.4g}{at(worst)} (limits {span})")
    if parts:
        yield f"{what}: outside the URDF's position limits: {', '.join(parts)}"


def size_remarks(
    limits: JointLimits,
    values: np.ndarray,
    largest: np.ndarray,
    what: str,
    kind: str,
    at: Callable[[int], str],
) -> Iterator[str]:
    """A line with the joints whose values (n, joints) are larger than their limit."""
    parts = []
    for i, name in enumerate(limits.names):
        size = np.nan_to_num(np.abs(values[:, i]), nan=0.0)
        worst = int(np.argmax(size))
        if size[worst] > largest[i] * (1.0 + SLACK):
            unit = (
                {"rad": "N m", "m": "N"}[limits.units[i]]
                if kind == " force"
                else f"{limits.units[i]}{kind}"
            )
            parts.append(f"{name} {size[worst]:.4g} {unit}{at(worst)} (limit {largest[i]:.4g})")
    if parts:
        named = "effort" if kind == " force" else "velocity"
        yield f"{what}: beyond the URDF's {named} limits: {', '.join(parts)}"
