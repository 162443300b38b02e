"""The limits exceeded in a run.

The limits of the joints are not enforced. ``actuation.limit`` saturates the force, and
``saturation`` computes how often.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from ffsm_drake.common.numbers import percent, usable
from ffsm_drake.mission import Mission
from ffsm_drake.runs.integration import integration_remarks
from ffsm_drake.runs.metrics import phases_of
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.clearance import Nearest, in_words, shapes_of
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.spacecraft.limits import FORCE, POSITION, RATE, Limit
from ffsm_drake.systems.faults import settle_faults
from ffsm_drake.systems.mission_limits import joint_limits

if TYPE_CHECKING:
    from ffsm_drake.runs.table import Labelled

INSTANTS = 51  # at which the clearance of a plan is evaluated; twice as many for a run


def run_remarks(record: RunRecord) -> list[str]:
    """Return a line for each kind of exceeded limit, one for saturated forces, and one for each
    balance violated by the integrator.

    Raises:
      ModelError: the scenario's model does not load any more.
    """
    time = record.dataset["time"].values
    if time.size == 0:
        return []
    remarks = list[str]()
    faults = settle_faults(record.scenario, record.mission.craft.coordinates).faults
    noticed = dict(record.metrics.get("faults", {}).get("noticed") or {})
    for fault in () if faults is None else faults.events.values():
        if fault.time[0] <= time[-1] + 1e-9:  # the run may end early
            found = [name for name in noticed if name.partition(" ")[0] == fault.unit]
            told = "".join(f", detected at {noticed.pop(name):.2f} s" for name in found[:1])
            remarks.append(f"{fault.in_words(record.scenario.sample_time)}{told}")
    remarks += [
        f"{name}: reported as faulty at {at:.2f} s, but it has no fault (false alarm)"
        for name, at in noticed.items()
    ]
    remarks += broken_limits(record.mission, record.dataset)
    shares = [f"{name} in {percent(share)}" for name, share in saturation(record).items()]
    if shares:
        remarks.append(f"saturated at actuation.limit: {', '.join(shares)} of the samples")
    return [*remarks, *integration_remarks(record)]


def broken_limits(mission: Mission, data: "Labelled") -> list[str]:
    """Return a line for each kind of exceeded limit without enforcement: positions, rates and
    applied forces of the joints, limits of parts, clearance. Such a run does not go as planned,
    settled or not.

    Raises:
      ModelError: the scenario's model does not load any more.
    """
    time = data["time"].values
    if time.size == 0:
        return []
    scenario, limits = mission.scenario, joint_limits(mission)
    motion = {
        POSITION: data["position"].values[:, 1:],
        RATE: data["velocity"].values,
        FORCE: data["applied_force"].values,
    }
    own = {each.quantity for each in limits if each.quantity in data} - {*motion}
    motion |= {name: data[name].values.reshape(time.size, -1) for name in own}

    def at(sample: int) -> str:
        return f" at t = {time[sample]:.2f} s"

    found = list(remarks_on(limits, motion, at, who=("the run", "the run")))
    found += not_measured(scenario)
    return [*found, *too_near(_clearance_in(scenario, data), scenario.clearance, "the run")]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Closest(Nearest):
    """The smallest distance of two parts of the spacecraft in a motion."""

    time: float  # s
    before_grasp: bool = False  # while the target is a body of its own

    def __str__(self) -> str:
        before = ", target not held" if self.before_grasp else ""
        return f"{super().__str__()} at t = {self.time:.3g} s{before}"


def run_clearance(record: RunRecord) -> list[Closest]:
    """Return the smallest distance in each phase of a run, evaluated at a hundred samples of each.

    Raises ModelError: as ``plan_clearance``.
    """
    return _clearance_in(record.scenario, record.dataset)


def _clearance_in(scenario: Scenario, data: "Labelled") -> list[Closest]:
    """``run_clearance`` of a run's labelled time series."""
    found: list[Closest] = []
    for phase, samples in (phases_of(data) or {"stop": data}).items():
        count = len(samples["time"].values)
        chosen = np.unique(np.linspace(0, count - 1, 2 * INSTANTS - 1).round().astype(int))[:count]
        part, target = samples.isel(time=chosen), None
        hidden = part["hidden_position"].values if "hidden_position" in part else None
        if phase != "stop":
            target = np.hstack([part["target_quaternion"].values, part["target_position"].values])
        found += closest_of(
            scenario,
            part["time"].values,
            part["position"].values,
            target=target,
            hidden=hidden,
        )
    return found


def closest_of(
    scenario: Scenario,
    times: np.ndarray,
    q: np.ndarray,
    *,
    target: np.ndarray | None = None,
    hidden: np.ndarray | None = None,
) -> Iterator[Closest]:
    """The smallest distance in configurations (n, nq), before a grasp with the target at poses
    (n, 7), with deflections (n, nh), by default none; nothing if no parts can meet.
    """
    clearance = shapes_of(scenario, apart=target is not None)
    q = np.hstack([q, *(part for part in (target, hidden) if part is not None)])
    if clearance.pairs and usable(q).any():
        approach = clearance.along(q)
        nearest, time = approach.nearest, float(times[approach.index])
        yield Closest(**dataclasses.asdict(nearest), time=time, before_grasp=target is not None)


def not_measured(scenario: Scenario) -> Iterator[str]:
    """A line if shapes of a scenario's model cannot be measured, so that clearance is not known."""
    if names := shapes_of(scenario).unmeasured:
        shown = f"{', '.join(names[:3])}{f' and {len(names) - 3} more' if names[3:] else ''}"
        yield (
            f"clearance cannot be computed: no shape of {shown} can be measured; give an existing "
            ".obj file, or add <collision> to the link"
        )


def too_near(found: Iterable[Closest], threshold: float, what: str) -> Iterator[str]:
    """A line for each distance below a threshold, m."""
    for closest in found:
        if closest.keeps(threshold):
            continue
        state = in_words(closest.distance, "come within {} of each other")
        when = f"at t = {closest.time:.3g} s (clearance {threshold:g} m)"
        yield f"{closest.first} and {closest.second} {state} in {what} {when}"


def saturation(record: RunRecord) -> dict[str, float]:
    """Share of the samples with a commanded force beyond ``actuation.limit``, by coordinate;
    coordinates without are left out.
    """
    scenario, data = record.scenario, record.dataset
    if (
        data.sizes["time"] == 0
        or scenario.actuation.limit is None
        or scenario.blocks.actuation is not None
    ):
        return {}
    names, units = (data[name].values.astype(str).tolist() for name in ("coordinate", "unit"))
    coordinates = Coordinates(
        joints=tuple(names[NUM_BASE_VELOCITIES:]), joint_units=tuple(units[NUM_BASE_VELOCITIES:])
    )
    limit = coordinates.vector(scenario.actuation.limit, key="actuation.limit", default=np.inf)
    shares = (np.abs(data["generalized_force"].values) > limit).mean(axis=0)
    return {name: float(share) for name, share in zip(names, shares, strict=True) if share > 0.0}


def remarks_on(
    limits: Iterable[Limit],
    motion: Mapping[str, np.ndarray],
    at: Callable[[int], str],
    *,
    who: tuple[str, str],
) -> Iterator[str]:
    """A line for each limit exceeded by a motion.

    Args:
      limits: the limits. A limit of a quantity that the motion lacks is skipped.
      motion: values (samples, nv) by quantity.
      at: sample -> words for its time.
      who: subjects of the lines, for positions and rates, and for forces.
    """
    for limit in limits:
        if limit.quantity in motion:
            yield from limit.remark(motion[limit.quantity], who[limit.quantity == FORCE], at)
