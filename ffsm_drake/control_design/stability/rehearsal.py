"""The linearised loop under the thrusters and wheels as they are, with their pulses and limits:
does it settle?

The controller and the plant are linear about the planned motion (``linearization``); in every
control sample the actuators are given what the loop asks for, and what they do instead acts on it.
That takes a tenth of a run's time, and tells what no spectral radius does: whether the loop
tolerates saturation.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, RandomSource, ZeroOrderHold

from ffsm_drake.control_design.stability.demand import make_demand
from ffsm_drake.control_design.stability.linear_loop import LinearLoop, SampleMap
from ffsm_drake.control_design.stability.linearization import Linearizer
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.spacecraft.nominal import make_nominal_plant
from ffsm_drake.systems.actuation import make_actuation, make_base_actuators
from ffsm_drake.systems.actuation.base import attitude_ahead
from ffsm_drake.systems.controllers.law import ControlLaw
from ffsm_drake.systems.limits import base_limits
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.sensing import quantize
from ffsm_drake.systems.setup import BlockSetup

SEEDS = 4
# fractions of the planned motion at which the loop is linearised
_POSTURES = (0.0, 0.25, 0.5, 0.75, 1.0)
_BLENDED = 50  # control samples between which the loop is taken from the two nearest postures
_LAST = 2.0  # s, at the end; when errors are looked at
_PUSH = "push"  # the source of what actuators add to the command
_FULL = 1.0 - 1e-9  # of a limit, or of a wanted wrench


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Rehearsal:
    """Outcome of the linearised loop under its thrusters and wheels, with some seeds of the
    noise.
    """

    scenario: Scenario
    coordinates: Coordinates
    noise_force: np.ndarray  # (nv,) what sensor noise alone asks for, standard deviation, N m or N
    motion_force: np.ndarray  # (nv,) the most that the run without noise asks for, N m or N
    diverged: np.ndarray  # (seeds,) s, when a rate passed ``divergence_speed``; NaN where none did
    wheels_limited: np.ndarray  # (seeds,) share of the samples in which a motor is at its limit
    # (seeds,) share in which thrusters could not give all that was wanted of them
    thrusters_limited: np.ndarray
    largest_error: np.ndarray  # (nv,) of the last two seconds, rad or m; the median of the seeds

    def __str__(self) -> str:
        """One line: the actuators' limits, the forces asked of them, and the outcome."""
        parts = self.coordinates.groups["base_rotation"], self.coordinates.groups["base_position"]
        noise, motion = (
            " and ".join(
                f"{force[part].max():.2g} {unit}"
                for part, unit in zip(parts, ("N m", "N"), strict=True)
            )
            for force in (self.noise_force, self.motion_force)
        )
        limited = [
            f"{what} in {100.0 * float(np.median(share)):.2g} %"
            for what, share in (
                ("wheels", self.wheels_limited),
                ("thrusters", self.thrusters_limited),
            )
            if share.any()
        ]
        told = (
            f"{', '.join(_can_give(self.scenario))}; the motion takes up to {motion}, sensor "
            f"noise {noise}"
        )
        told += " (standard deviation)"
        told += (
            f"; saturated: {', '.join(limited)} of the samples"
            if limited
            else ("; nothing saturates")
        )
        gone = self.diverged[np.isfinite(self.diverged)]
        if not gone.size:
            return told
        of = f" with {gone.size} of {self.diverged.size} noises" if self.diverged.size > 1 else ""
        return f"{told}, and it diverges{of}, at t = {np.median(gone):.1f} s"

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
    """The linearised loop of a scenario with thrusters or wheels, under them as they are.

    Args:
      scenario: what would be run; from the grasp on.
      seeds: how many noises.
      held: as for ``Linearizer.at``.
      mean: error and force (n, nv) of the run without noise and limits, as ``Linearizer.follow``
        has them, which takes half a run; default: those of perfect tracking.

    Raises: as ``Linearizer`` and ``Linearizer.at``.
    """
    with Linearizer(scenario, blocks={"actuation": _pushed}) as linearizer:
        loops = [linearizer.at(linearizer.motion.part(share), held=held) for share in _POSTURES]
        scenario, motion, law = linearizer.given, linearizer.motion, linearizer.law
    if mean is None:
        ideal = make_demand(scenario).force
        mean = np.zeros_like(ideal), ideal
    times = np.arange(scenario.num_control_periods) * scenario.sample_time
    mean = np.nan_to_num(mean[0]), np.nan_to_num(mean[1])
    runs = [_Run(scenario, loops, motion, mean, law).go(times, seed) for seed in range(seeds)]
    diverged, wheels, thrusters, largest = (np.array(each) for each in zip(*runs, strict=True))
    return Rehearsal(
        scenario=scenario,
        coordinates=motion.coordinates,
        noise_force=np.max(
            [_without_push(loop).noise_response(times.size)["force"] for loop in loops], axis=0
        ),
        motion_force=np.abs(mean[1]).max(axis=0),
        diverged=diverged,
        wheels_limited=wheels,
        thrusters_limited=thrusters,
        largest_error=np.median(largest, axis=0),
    )


class _Run:
    """One scenario's loops and actuators."""

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
        self._times = [motion.part(share) for share in _POSTURES]
        self._samples = [_from_start(loop) for loop in loops]
        nominal = driven_model(make_nominal_plant(scenario))
        self._mass = [nominal.calc_mass_matrix(motion.evaluate(time)[0]) for time in self._times]
        self._base = make_base_actuators(settings, coordinates, sample_time=scenario.sample_time)
        ends = np.cumsum([0, *self._base.sizes.values()]).tolist()
        self._part = {
            name: slice(*pair)
            for name, pair in zip(self._base.sizes, itertools.pairwise(ends), strict=True)
        }
        motors = [] if settings.wheels is None else settings.wheels.units.values()
        self._motors = np.array([unit.torque_limit for unit in motors])
        self._limit = coordinates.vector(
            settings.limit or {}, key="actuation.limit", default=np.inf
        )
        self._resolution = coordinates.vector(
            settings.quantization, key="actuation.quantization", default=0.0
        )

    def go(self, times: np.ndarray, seed: int) -> tuple[float, float, float, np.ndarray]:
        """When it diverged, the limited shares of wheels and thrusters, and the largest errors (nv)
        at the end.
        """
        scenario, settings, loop = self._scenario, self._scenario.actuation, self._loops[0]
        nv, noise, push = self._force.shape[1], np.random.default_rng(seed), loop.noise[_PUSH]
        frame = 1 if settings.thrusters is None else settings.thrusters.frame
        x, memory, limited = np.zeros(len(loop.a)), self._base.initial_memory, np.zeros(2)
        switching = self._switching_at_start
        late = [np.zeros(nv)] * settings.delay  # total, then the linear loop's own part of it
        own, errors = list(late), [np.zeros(nv)]
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
            sample = self._base.give(
                late.pop(0), memory, rotation=rotation, turning=turning, begins=k % frame == 0
            )
            memory = sample[self._part["memory"]]
            limited += self._limited(sample)
            x = after + step.b[:, push] @ (sample[self._part["applied_force"]] - own.pop(0))
            if not np.abs(x[nv : 2 * nv]).max() < scenario.divergence_speed:
                wheels, thrusters = (limited / (k + 1)).tolist()
                return time, wheels, thrusters, np.full(nv, np.inf)
            if time >= times[-1] - _LAST:
                errors.append(np.abs(self._error[k] + x[:nv]))
        wheels, thrusters = (limited / times.size).tolist()
        return math.nan, wheels, thrusters, np.max(errors, axis=0)

    @property
    def _switching_at_start(self) -> np.ndarray:
        """G (nv), which the linear loop leaves out; empty where the law has none."""
        start = {} if self._law is None else self._law.initial_state()
        known = {"sliding_variable", "switching_gain"} <= set(start)
        return np.array(start["switching_gain"]) if known else np.zeros(0)

    def _limited(self, sample: np.ndarray) -> tuple[bool, bool]:
        """Whether a motor is at its limit, and whether thrusters give less than the wanted
        wrench.
        """
        torque = np.abs(sample[self._part.get("wheel_torque", slice(0))])
        given = sample[self._part.get("thruster_given", slice(0))]
        return bool((torque >= _FULL * self._motors).any()), bool((given[:1] < _FULL).any())

    def _near(self, time: float) -> tuple[list[SampleMap], np.ndarray]:
        """The loop's maps of one common period near a time, and the nominal mass matrix: of the
        postures beside it.
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
        """As planned: R_WB (n, 3, 3), and w_WB in the base's axes with what the wheels' momentum
        misses (n, 6).
        """
        rows, nq = self._motion.rows(times), self._force.shape[1] + 1
        rotation = np.array(
            [attitude_ahead(q, np.zeros(3), 0.0).reshape(3, 3) for q in rows[:, :4]]
        )
        turning = np.einsum("ni,nij->nj", rows[:, nq : nq + 3], rotation)
        return rotation, np.hstack([turning, np.zeros_like(turning)])


def _can_give(scenario: Scenario) -> Iterator[str]:
    """What the base's actuators give, a phrase each."""

    def span(given: np.ndarray) -> str:
        least, most = given.min(), given.max()
        return f"{least:.2g}" if most < 1.01 * least else f"{least:.2g} to {most:.2g}"

    limits, settings = base_limits(scenario), scenario.actuation
    torque = f"{span(limits.torque)} N m"
    if settings.wheels is not None:
        yield f"the wheels give {torque}, depending on the axis"
        torque = ""
    if settings.thrusters is not None:
        given = [each for each in (torque, f"{span(limits.force)} N") if each]
        yield f"the thrusters {' and '.join(given)}"


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
