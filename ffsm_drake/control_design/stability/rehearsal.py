"""The linearised loop under its actuators' real pulses and limits: does it settle?

The controller and the plant are linear about the planned motion (``linearization``). In every
control sample the actuators get the force that the loop asks for, and what they give instead acts
on it. That takes a tenth of a run's time, and shows what no spectral radius does: whether the loop
tolerates saturation.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, RandomSource, ZeroOrderHold

from ffsm_drake.common.so3 import in_body_axes
from ffsm_drake.control_design.stability.linear_loop import LinearLoop, SampleMap
from ffsm_drake.control_design.stability.linearization import Linearizer
from ffsm_drake.control_design.stability.planned_dynamics import (
    PlannedDynamics,
    make_demand,
)
from ffsm_drake.loop.blocks import section_parts
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.actuation import make_actuation, make_base_actuators
from ffsm_drake.systems.actuation.base import attitude_ahead
from ffsm_drake.systems.controllers.law import ControlLaw
from ffsm_drake.systems.limits import base_limits
from ffsm_drake.systems.part import Part
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.sensing import quantize
from ffsm_drake.systems.setup import BlockSetup

SEEDS = 4
# Fractions of the motion whose loops are blended; fewer make a loop unstable that is not, where an
# arm passes near a singular posture.
_SHARES = tuple(k / 12 for k in range(13))
_BLENDED = 50  # control samples for which the loop between two postures is kept
_LAST = 2.0  # s, at the end, over which the largest error is taken
_SETTLED_AFTER = 5.0  # s, from which on the rms error counts
_PUSH = "push"  # the source of what actuators add to the command


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Rehearsal:
    """Outcome of the linearised loop under its actuators, with several seeds of the noise."""

    scenario: Scenario
    coordinates: Coordinates
    noise_force: np.ndarray  # (nv,) standard deviation of the command by sensor noise, N m or N
    motion_force: np.ndarray  # (nv,) largest command without noise, N m or N
    diverged: np.ndarray  # (seeds,) s, when a rate passed ``divergence_speed``; NaN: it did not
    # by actuator: (seeds,) share of the samples in which it gave less than was wanted of it
    saturated: Mapping[str, np.ndarray]
    largest_error: np.ndarray  # (nv,) in the last two seconds, rad or m; median over the seeds
    # (nv,) after the settling time, rad or m, about the mean; rms over the seeds
    rms_error: np.ndarray

    def __str__(self) -> str:
        """One line: the actuators' limits, the forces asked of them, and the outcome."""
        groups = self.coordinates.groups
        motion, noise = (
            f"{force[groups['base_rotation']].max():.2g} N m and "
            f"{force[groups['base_position']].max():.2g} N"
            for force in (self.motion_force, self.noise_force)
        )
        limited = [
            f"{name} in {100.0 * float(np.median(share)):.2g} %"
            for name, share in self.saturated.items()
            if share.any()
        ]
        told = (
            f"{' and '.join(self.saturated)} give {_largest_wrench(self.scenario)}; the motion "
            f"takes up to {motion}, sensor noise {noise} (standard deviation); "
        )
        told += f"saturated: {', '.join(limited)} of the samples" if limited else "none saturates"
        times = self.diverged[np.isfinite(self.diverged)]
        if not times.size:
            return told
        seeds = f" in {times.size} of {self.diverged.size} runs" if self.diverged.size > 1 else ""
        return f"{told}, and it diverges{seeds}, at t = {np.median(times):.1f} s"

    @property
    def share_diverged(self) -> float:
        """Fraction of seeds that diverged."""
        return float(np.isfinite(self.diverged).mean())


def rehearse(
    scenario: Scenario,
    *,
    seeds: int = SEEDS,
    held: Mapping[str, np.ndarray] | None = None,
    mean: tuple[np.ndarray, np.ndarray] | None = None,
) -> Rehearsal:
    """Rehearse a scenario with parts that are ``rehearsed``, from the grasp on.

    Args:
      scenario: the scenario.
      seeds: number of noise sequences.
      held: as for ``Linearizer.at``.
      mean: error and force (n, nv) of the run without noise and limits, from
        ``Linearizer.follow``, which takes half a run; default: those of perfect tracking.

    Raises: as ``Linearizer`` and ``Linearizer.at``.
    """
    with Linearizer(scenario, blocks={"actuation": _pushed}) as linearizer:
        loops = linearizer.along(_SHARES, held=held)
        scenario, motion, law = linearizer.given, linearizer.motion, linearizer.law
    if mean is None:
        ideal = make_demand(scenario).force
        mean = np.zeros_like(ideal), ideal
    times = np.arange(scenario.num_control_periods) * scenario.sample_time
    mean = np.nan_to_num(mean[0]), np.nan_to_num(mean[1])
    runs = [_Run(scenario, loops, motion, mean, law).go(times, seed) for seed in range(seeds)]
    diverged, shares, largest, square = (np.array(each) for each in zip(*runs, strict=True))
    return Rehearsal(
        scenario=scenario,
        coordinates=motion.coordinates,
        noise_force=np.max(
            [_without_push(loop).noise_response(times.size)["force"] for loop in loops], axis=0
        ),
        motion_force=np.abs(mean[1]).max(axis=0),
        diverged=diverged,
        saturated=dict(zip(_actuators(scenario), shares.T, strict=True)),
        largest_error=np.median(largest, axis=0),
        rms_error=np.sqrt(square.mean(axis=0)),
    )


class _Run:
    """The loops and the actuators of a scenario."""

    def __init__(
        self,
        scenario: Scenario,
        loops: Sequence[LinearLoop],
        motion: PlannedMotion,
        mean: tuple[np.ndarray, np.ndarray],
        law: ControlLaw | None,
    ) -> None:
        settings, coordinates = scenario.actuation, motion.coordinates
        self._scenario, self._loops, self._motion, self._law = scenario, loops, motion, law
        self._error, self._force = mean
        self._times = [motion.part(share) for share in _SHARES]
        self._samples = [_from_start(loop) for loop in loops]
        planned = PlannedDynamics(scenario)
        self._mass = [planned.mass_matrices(time)[1] for time in self._times]
        self._base = make_base_actuators(settings, coordinates, sample_time=scenario.sample_time)
        self._ends = np.cumsum([*self._base.sizes.values()])[:-1]
        self._actuators = _actuators(scenario).values()
        self._limit = coordinates.vector(
            settings.limit or {}, key="actuation.limit", default=np.inf
        )
        self._resolution = coordinates.vector(
            settings.quantization, key="actuation.quantization", default=0.0
        )

    def go(self, times: np.ndarray, seed: int) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """The time of divergence or NaN, the share of saturated samples by actuator, the largest
        errors (nv) at the end, and the mean square deviations (nv) once settled.
        """
        scenario, loop = self._scenario, self._loops[0]
        nv, noise, push = self._force.shape[1], np.random.default_rng(seed), loop.noise[_PUSH]
        x, memory = np.zeros(len(loop.a)), self._base.initial_memory
        saturated = np.zeros(len(self._actuators))
        switching = self._switching_at_start
        # delayed commands, and the linear loop's part of them
        late = [np.zeros(nv)] * scenario.actuation.delay
        own, errors = list(late), [np.zeros(nv)]
        square, settled = np.zeros(nv), times > _SETTLED_AFTER
        for k, (time, rotation, turning) in enumerate(
            zip(times.tolist(), *self._base_motion(times), strict=True)
        ):
            if k % _BLENDED == 0:
                samples, mass = self._near(time)
            step = samples[k % len(samples)]
            w = noise.standard_normal((1, step.b.shape[1]))[0]
            w[push] = 0.0
            force, after = self._force[k] + step.c @ x + step.d @ w, step.a @ x + step.b @ w
            own.append(force)
            if self._law is not None and switching.size:
                s = after[loop.memory["sliding_variable"]]
                force = force + mass @ (switching * np.sign(s))
                switching = self._law.switching_gain_after(s, switching)
            late.append(quantize(np.clip(force, -self._limit, self._limit), self._resolution))
            begins = k % self._base.frame == 0
            stacked = self._base.give(
                late.pop(0), memory, rotation=rotation, turning=turning, begins=begins
            )
            sample = dict(zip(self._base.sizes, np.split(stacked, self._ends), strict=True))
            memory = sample["memory"]
            saturated += [bool(part.saturated(sample)) for part in self._actuators]
            x = after + step.b[:, push] @ (sample["applied_force"] - own.pop(0))
            if not np.abs(x[nv : 2 * nv]).max() < scenario.divergence_speed:
                return time, saturated / (k + 1), np.full(nv, np.inf), np.full(nv, np.inf)
            square += settled[k] * x[:nv] ** 2
            if time >= times[-1] - _LAST:
                errors.append(np.abs(self._error[k] + x[:nv]))
        share, largest = saturated / times.size, np.max(errors, axis=0)
        return math.nan, share, largest, square / max(1, int(settled.sum()))

    @property
    def _switching_at_start(self) -> np.ndarray:
        """G (nv), which the linear loop leaves out; empty where the law has none."""
        start = {} if self._law is None else self._law.initial_state()
        known = {"sliding_variable", "switching_gain"} <= set(start)
        return np.array(start["switching_gain"]) if known else np.zeros(0)

    def _near(self, time: float) -> tuple[list[SampleMap], np.ndarray]:
        """The loop's maps of one common period and the nominal mass matrix at a time, interpolated
        between postures.
        """
        i = min(max(int(np.searchsorted(self._times, time)) - 1, 0), len(self._times) - 2)
        share = min(max((time - self._times[i]) / (self._times[i + 1] - self._times[i]), 0.0), 1.0)

        def blend(first: np.ndarray, second: np.ndarray) -> np.ndarray:
            return (1.0 - share) * first + share * second

        pairs = zip(self._samples[i], self._samples[i + 1], strict=True)
        maps = [
            SampleMap(**{name: blend(getattr(a, name), getattr(b, name)) for name in "abcd"})
            for a, b in pairs
        ]
        return maps, blend(self._mass[i], self._mass[i + 1])

    def _base_motion(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The planned R_WB (n, 3, 3), and ``turning`` (n, 6) of ``BaseActuators.give``."""
        rows, nq = self._motion.rows(times), self._force.shape[1] + 1
        rotation = np.array(
            [attitude_ahead(q, np.zeros(3), 0.0).reshape(3, 3) for q in rows[:, :4]]
        )
        turning = in_body_axes(rows[:, :4], rows[:, nq : nq + 3])
        return rotation, np.hstack([turning, np.zeros_like(turning)])


def _actuators(scenario: Scenario) -> dict[str, Part]:
    """The parts whose limits are rehearsed, by title."""
    parts = section_parts(scenario).values()
    return {part.title.lower(): part for part in parts if part.rehearsed}


def _largest_wrench(scenario: Scenario) -> str:
    """The largest torque and force of the base's actuators, in the worst and the best direction."""
    limits = base_limits(scenario)
    spans = []
    for given, unit in ((limits.torque, "N m"), (limits.force, "N")):
        least, most = given.min(), given.max()
        if most < 1.01 * least:
            spans.append(f"{least:.2g} {unit}")
        elif math.isfinite(most):
            spans.append(f"{least:.2g} to {most:.2g} {unit}")
    return " and ".join(spans)


def _from_start(loop: LinearLoop) -> list[SampleMap]:
    """The maps of a common period, the first that of control sample 0."""
    first = round(loop.time / loop.sample_time)
    return [loop.samples[(k - first) % len(loop.samples)] for k in range(len(loop.samples))]


def _without_push(loop: LinearLoop) -> LinearLoop:
    def heard(columns: np.ndarray) -> np.ndarray:
        return np.delete(columns, loop.noise[_PUSH], axis=1)

    samples = tuple(
        dataclasses.replace(each, b=heard(each.b), d=heard(each.d)) for each in loop.samples
    )
    return dataclasses.replace(loop, samples=samples)


def _pushed(setup: BlockSetup) -> Diagram | None:
    """Actuators whose base gives what is asked of it and a source's value of each sample."""
    builder, size, period = DiagramBuilder(), len(setup.coordinates.names), setup.sample_time
    source = builder.AddNamedSystem(_PUSH, RandomSource(RandomDistribution.kGaussian, size, period))
    held = builder.AddNamedSystem("held", ZeroOrderHold(period, size))
    total = builder.AddNamedSystem("total", Adder(2, size))
    builder.Connect(source.get_output_port(), held.get_input_port())
    builder.Connect(held.get_output_port(), total.get_input_port(1))
    builder.ExportInput(total.get_input_port(0), "force")
    builder.ExportOutput(total.get_output_port(), "given")
    return make_actuation(
        setup.scenario.actuation, setup.coordinates, sample_time=period, base=builder.Build()
    )
