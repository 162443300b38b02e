"""The linearised loop under its actuators' real pulses and limits: does it settle?

The controller and the plant are linear about the planned motion (``linearization``). In every
control sample the actuators get the loop's command, and their actual output acts on the loop. This
takes a tenth of a run's time, and shows, unlike a spectral radius, whether the loop tolerates
saturation.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, RandomSource, ZeroOrderHold

from ffsm_drake.common import products
from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.memo import memoized
from ffsm_drake.common.numbers import counted, percent, rounded_up, short
from ffsm_drake.common.so3 import in_body_axes
from ffsm_drake.common.steps import step
from ffsm_drake.plugins.actuators.attitude import attitude_ahead
from ffsm_drake.plugins.actuators.plume import allocated
from ffsm_drake.plugins.actuators.row import make_actuation, make_base_actuators
from ffsm_drake.plugins.design.stability.adaptation import expected_gains
from ffsm_drake.plugins.design.stability.linear_loop import LinearLoop, SampleMap
from ffsm_drake.plugins.design.stability.linearization import POSTURES, Linearizer
from ffsm_drake.plugins.design.stability.planned_dynamics import (
    PlannedDynamics,
    make_demand,
)
from ffsm_drake.runs.engine import find_engine
from ffsm_drake.runs.rollout import user_supplied
from ffsm_drake.scenario import Grip, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.plant import files_read
from ffsm_drake.systems.limits import actuation_limit, base_limits
from ffsm_drake.systems.part import Part
from ffsm_drake.systems.quantization import quantize
from ffsm_drake.systems.registry import section_parts
from ffsm_drake.systems.setup import BlockSetup

SEEDS, MANY = 16, 64  # noises, under actuators of the base; where they cost little
_FURTHER = 1.5  # standard deviations; excess of the largest of 64 runs over one run
_CONFIDENCE = 3.0  # none of n noises diverges: the chance is below 3 / n, at 95 %
_LIMIT = "actuation.limit"  # name among the saturated limits
_BLENDED = 50  # control samples for which the loop between two postures is kept
_LAST = 2.0  # s, at the end, over which the largest error is taken
_SETTLED_AFTER = 5.0  # s; start of the rms error
_CLOSEST = 1.0 / 64.0  # share of the motion between two postures
_PUSH = "push"  # the source of the actuators' deviation from the command
Maps = tuple[np.ndarray, np.ndarray]  # maps of one control sample, from x and from w


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Rehearsal:
    """Outcome of the linearised loop under its actuators, with several seeds of the noise."""

    scenario: Scenario
    coordinates: Coordinates
    noise_force: np.ndarray  # (nv,) standard deviation of the command by sensor noise, N m or N
    motion_force: np.ndarray  # (nv,) largest command without noise, N m or N
    diverged: np.ndarray  # (seeds,) s, when a rate passed ``divergence_speed``; NaN: it did not
    # by actuator: (seeds,) share of the samples with less than the wanted output
    saturated: Mapping[str, np.ndarray]
    largest_error: np.ndarray  # (nv,) in the last two seconds, rad or m; median over the seeds
    # (nv,) after the settling time, rad or m, about the mean; rms over the seeds
    rms_error: np.ndarray

    def __str__(self) -> str:
        """One line: the outcome, the actuators' limits, and the commanded forces."""
        times = self.diverged[np.isfinite(self.diverged)]
        when = f" at t = {np.median(times):.1f} s" if times.size else ""
        return f"{self.share}{when}; {self._asked}; {self._saturating}"

    @property
    def noises(self) -> int:
        """Number of noise sequences."""
        return self.diverged.size

    @property
    def sequences(self) -> str:
        """Number of noise sequences, in words."""
        return counted(self.noises, "noise sequence")

    @property
    def share(self) -> str:
        """Share of noise sequences with divergence; if none, the implied bound on its
        probability.
        """
        count = int(np.isfinite(self.diverged).sum())
        if self.noises == 1:
            return "diverges" if count else "does not diverge"
        if count:
            return f"diverges with {count} of {self.sequences}"
        return (
            f"diverges with none of {self.sequences} (chance below "
            f"{percent(rounded_up(_CONFIDENCE / self.noises, 3))}, at 95 % confidence)"
        )

    @property
    def _saturating(self) -> str:
        limited = [
            f"{name} in {percent(float(np.median(share)))}"
            for name, share in self.saturated.items()
            if share.any()
        ]
        return f"saturated: {', '.join(limited)} of the samples" if limited else "none saturates"

    @property
    def _asked(self) -> str:
        """The limits and the commanded forces: for the base's actuators or, without these, for the
        group nearest to its limit.
        """
        names = [name for name in self.saturated if name != _LIMIT]
        if not names:
            limit = actuation_limit(self.scenario, self.coordinates).upper
            i = int(np.argmax((self.motion_force + 3.0 * self.noise_force) / limit))
            unit = {"rad": "N m", "m": "N"}[self.coordinates.units[i]]
            return (
                f"{_LIMIT} allows {limit[i]:.3g} {unit} on {self.coordinates.names[i]}; the motion "
                f"takes up to {self.motion_force[i]:.2g}, sensor noise {self.noise_force[i]:.2g} "
                "(standard deviation)"
            )
        groups = self.coordinates.groups
        motion, noise = (
            f"{short(force[groups['base_rotation']].max(), 2)} N m and "
            f"{short(force[groups['base_position']].max(), 2)} N"
            for force in (self.motion_force, self.noise_force)
        )
        return (
            f"{' and '.join(names)} give {_largest_wrench(self.scenario)}; the motion takes up to "
            f"{motion}, sensor noise {noise} (standard deviation)"
        )

    @property
    def share_diverged(self) -> float:
        """Fraction of seeds that diverged."""
        return float(np.isfinite(self.diverged).mean())


@step("running the linear loop under limits and noise")
def rehearse(
    scenario: Scenario,
    *,
    seeds: int = SEEDS,
    held: Mapping[str, np.ndarray] | None = None,
    mean: tuple[np.ndarray, np.ndarray] | None = None,
) -> Rehearsal:
    """Run the linearised loop after the grasp with ``rehearsed`` parts, or with
    ``actuation.limit``.

    Args:
      scenario: the scenario.
      seeds: number of noise sequences; 64 cost about a second without actuators of the base.
      held: see ``Linearizer.at``.
      mean: error and force (n, nv) of the run without noise and limits, from
        ``Linearizer.follow`` (half the time of a run); default: those of perfect tracking.

    Raises: the errors of ``Linearizer`` and ``Linearizer.at``.
    """
    case = Rehearsed(scenario, held, mean)
    scenario, count = case.scenario, case.scenario.num_control_periods
    diverged, shares, largest, square = _Runs(case, seeds).go()
    return Rehearsal(
        scenario=scenario,
        coordinates=case.motion.coordinates,
        noise_force=np.max(
            [_without_push(loop).noise_response(count)["force"] for loop in case.loops.values()],
            axis=0,
        ),
        motion_force=np.abs(case.force).max(axis=0),
        diverged=diverged,
        saturated=dict(zip([*_actuators(scenario), _LIMIT], shares.T, strict=True)),
        largest_error=np.median(largest, axis=0),
        rms_error=np.sqrt(square.mean(axis=0)),
    )


def expected_rehearsal(linearizer: Linearizer) -> Rehearsal:
    """The rehearsal of a linearizer's scenario at the gains that adaptation is expected to reach,
    about the run without noise and limits. A run's check and its report share it.

    Raises: as ``rehearse``.
    """
    scenario = linearizer.given
    if user_supplied(scenario):  # whose code may change
        return _expected(linearizer)
    return _shared(scenario, linearizer.grip, files_read(scenario), linearizer=linearizer)


@memoized(maxsize=4, besides="linearizer")
def _shared(
    scenario: Scenario, grip: Grip, files: tuple[Path, ...], *, linearizer: Linearizer
) -> Rehearsal:
    """``expected_rehearsal``; ``grip`` and ``files`` are part of the key."""
    return _expected(linearizer)


def _expected(linearizer: Linearizer) -> Rehearsal:
    held = expected_gains(linearizer)
    return rehearse(linearizer.given, held=held, mean=linearizer.follow(held=held))


def is_near_limits(scenario: Scenario, coordinates: Coordinates, force: np.ndarray) -> bool:
    """Whether another noise sequence may take commands beyond ``actuation.limit``, from the
    commands of one run (n, nv; N m or N); their changes from sample to sample give the noise.
    """
    if scenario.actuation.limit is None or scenario.blocks.actuation is not None or len(force) < 2:
        return False
    limit = coordinates.vector(scenario.actuation.limit, key=_LIMIT, default=np.inf)
    noise = np.diff(force, axis=0).std(axis=0) / math.sqrt(2.0)
    return bool((np.abs(force).max(axis=0) + _FURTHER * noise > limit).any())


class Rehearsed:
    """The linear loops of a scenario, by time, about its planned motion."""

    def __init__(
        self,
        scenario: Scenario,
        held: Mapping[str, np.ndarray] | None = None,
        mean: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        """Args and errors: see ``rehearse``."""
        with Linearizer(scenario, blocks={"actuation": _pushed}) as linearizer:
            self.loops = _close_loops(linearizer, held)
            self.motion, self.law = linearizer.motion, linearizer.law
            self.scenario = scenario = linearizer.given
            planned = PlannedDynamics(scenario, linearizer.grip)
        if mean is None:
            ideal = make_demand(scenario).force
            mean = np.zeros_like(ideal), ideal
        self.error, self.force = (np.nan_to_num(each) for each in mean)
        self.settings, self._times = allocated(scenario), list(self.loops)
        first = self.loops[self._times[0]]
        self.push, self._noise = first.noise[_PUSH], first.noise
        # by posture, of each sample of a common period: from x and from w to [u; x+]
        self._maps = [
            [
                (np.vstack([each.c, each.a]), np.vstack([each.d, each.b]))
                for each in _from_start(loop)
            ]
            for loop in self.loops.values()
        ]
        self.states = self._maps[0][0][0].shape[1]
        self._mass = [planned.mass_matrices(time)[1] for time in self._times]
        start = {} if self.law is None else self.law.initial_state()
        known = {"sliding_variable", "switching_gain"} <= set(start)
        # G (nv), which the linear loop leaves out; empty if the law has none
        self.switching = np.array(start["switching_gain"]) if known else np.zeros(0)
        self.sliding = first.memory["sliding_variable"] if known else slice(0)

    def near(self, time: float) -> tuple[list[Maps], np.ndarray]:
        """The loop's maps of one common period and the nominal mass matrix at a time, interpolated
        between postures.
        """
        i = min(max(int(np.searchsorted(self._times, time)) - 1, 0), len(self._times) - 2)
        begin, end = self._times[i : i + 2]
        share = min(max((time - begin) / (end - begin), 0.0), 1.0)

        def blend(first: np.ndarray, second: np.ndarray) -> np.ndarray:
            return (1.0 - share) * first + share * second

        pairs = zip(self._maps[i], self._maps[i + 1], strict=True)
        maps = [(blend(a, b), blend(c, d)) for (a, c), (b, d) in pairs]
        return maps, blend(self._mass[i], self._mass[i + 1])

    def base_motion(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The planned R_WB (n, 3, 3), and w_WB in the base's axes (n, 3)."""
        rows, nq = self.motion.rows(times), self.force.shape[1] + 1
        rotation = np.array(
            [attitude_ahead(q, np.zeros(3), 0.0).reshape(3, 3) for q in rows[:, :4]]
        )
        return rotation, in_body_axes(rows[:, :4], rows[:, nq : nq + 3])


class _Runs:
    """Runs of a case with its actuators, side by side; arrays have a row for each."""

    def __init__(self, case: Rehearsed, seeds: int) -> None:
        self._case, self._seeds, settings = case, seeds, case.settings
        self._scenario, coordinates = case.scenario, case.motion.coordinates
        self._push, self._nv = case.push, case.force.shape[1]
        self._base = make_base_actuators(
            settings, coordinates, sample_time=case.scenario.sample_time
        )
        self._actuators = _actuators(case.scenario).values()
        self._limit = coordinates.vector(
            settings.limit or {}, key="actuation.limit", default=np.inf
        )
        self._resolution = coordinates.vector(
            settings.quantization, key="actuation.quantization", default=0.0
        )

    def go(self) -> tuple[np.ndarray, ...]:
        """For each seed: the time of divergence or NaN (seeds,), the share of saturated samples by
        actuator (seeds, k), the largest errors at the end and the mean square deviations once
        settled (seeds, nv).
        """
        nv, base, case, runs = self._nv, self._base, self._case, self._seeds
        times = np.arange(self._scenario.num_control_periods) * self._scenario.sample_time
        generators = [np.random.default_rng(seed) for seed in range(runs)]
        x, start = np.zeros((runs, case.states)), base.start()
        memory = {name: np.tile(value, (runs, 1)) for name, value in start.items()}
        switching = np.tile(case.switching, (runs, 1))
        # delayed commands, and the linear loop's part of them
        late = [np.zeros((runs, nv))] * self._scenario.actuation.delay
        own = list(late)
        diverged, samples = np.full(runs, np.nan), np.full((runs, 1), times.size)
        saturated = np.zeros((runs, len(self._actuators) + 1))  # and by actuation.limit
        square, largest = np.zeros((2, runs, nv))
        settled, at_end = times > _SETTLED_AFTER, times >= times[-1] - _LAST
        rotations, turnings = case.base_motion(times)
        for k, time in enumerate(times.tolist()):
            if k % _BLENDED == 0:
                maps, mass = case.near(time)
                noise = self._noise(generators, maps, k)
            of_x, of_w = maps[k % len(maps)]
            linear = products.times(of_x[None], x)
            force, after = np.split(linear + noise[:, k % _BLENDED], [nv], axis=1)
            force = case.force[k] + force
            own.append(force)
            if case.law is not None and case.switching.size:
                sliding = after[:, case.sliding]
                force = force + products.times(mass, switching * np.sign(sliding))
                switching = case.law.switching_gain_after(sliding, switching)
            bounded = np.clip(force, -self._limit, self._limit)
            saturated[:, -1] += np.isnan(diverged) & (bounded != force).any(axis=1)
            late.append(quantize(bounded, self._resolution))
            rotation, turning = (np.repeat(of[k][None], runs, 0) for of in (rotations, turnings))
            sample, after_sample = base.give(
                late.pop(0), memory, rotation=rotation, turning=turning, missing=np.zeros(3),
                begins=k % base.frame == 0,
            )  # fmt: skip
            memory, going = dict(after_sample), np.isnan(diverged)
            for index, part in enumerate(self._actuators):
                saturated[:, index] += going & part.saturated(sample)
            pushed = sample["applied_force"] - own.pop(0)
            x = after + products.applied(of_w[nv:, self._push], pushed)
            within = np.abs(x[:, nv : 2 * nv]).max(axis=1) < case.scenario.divergence_speed
            if not within.all():
                beyond = ~within  # they stay where they started
                diverged[beyond & going], samples[beyond & going] = time, k + 1
                x[beyond] = 0.0
                for name, value in start.items():
                    memory[name][beyond] = value
                square[beyond] = largest[beyond] = np.inf
                if not np.isnan(diverged).any():
                    break
            square += settled[k] * x[:, :nv] ** 2
            if at_end[k]:
                largest = np.maximum(largest, np.abs(case.error[k] + x[:, :nv]))
        return diverged, saturated / samples, largest, square / max(1, int(settled.sum()))

    def _noise(
        self, generators: Sequence[np.random.Generator], maps: Sequence[Maps], first: int
    ) -> np.ndarray:
        """Effect of noise on [u; x+] (seeds, _BLENDED, rows) from a control sample on."""
        width = maps[0][1].shape[1]
        w = np.stack([each.standard_normal((_BLENDED, width)) for each in generators])
        w[..., self._push] = 0.0
        found = np.empty((*w.shape[:2], len(maps[0][1])))
        for kind, (_, of_w) in enumerate(maps):
            own = np.arange(first, first + _BLENDED) % len(maps) == kind
            found[:, own] = w[:, own] @ of_w.T
        return found


def shares_diverged(scenarios: Sequence[Scenario], *, seeds: int) -> list[float | Exception]:
    """Return the share of noise sequences with divergence, for each scenario: of compiled runs
    without faults and supervisor, or of ``rehearse`` where they are not covered, or its error.
    """
    runs = [
        dataclasses.replace(scenario, random_seed=seed, faults=None, supervisor=None)
        for scenario in scenarios
        for seed in range(seeds)
    ]
    try:
        engine = find_engine("compiled")
        assert engine is not None
        found = list(engine.run_all(runs, ["state"]))
    except FfsmError as error:  # it is not installed
        found = [error] * len(runs)
    shares = list[float | Exception]()
    for index, scenario in enumerate(scenarios):
        logs = found[index * seeds : (index + 1) * seeds]
        try:
            if any(isinstance(log, FfsmError) for log in logs):
                shares.append(rehearse(scenario, seeds=seeds).share_diverged)
            else:
                shares.append(sum(log is None for log in logs) / seeds)
        except Exception as error:
            shares.append(error)
    return shares


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


def _close_loops(
    linearizer: Linearizer, held: Mapping[str, np.ndarray] | None
) -> dict[float, LinearLoop]:
    """The loops along the planned motion by their times, s, so close that halfway between two
    stable ones the mean of both is stable, as the loop there is; or a 64th of the motion apart.
    """
    shares, i = list(POSTURES), 0
    while i + 1 < len(shares):
        near = shares[i : i + 2]
        first, second = (linearizer.at(linearizer.part(share), held=held) for share in near)
        if near[1] - near[0] > _CLOSEST and _has_unstable_mean(first, second):
            shares.insert(i + 1, 0.5 * sum(near))
        else:
            i += 1
    times = [linearizer.part(share) for share in shares]
    return dict(zip(times, (linearizer.at(time, held=held) for time in times), strict=True))


def _has_unstable_mean(first: LinearLoop, second: LinearLoop) -> bool:
    """Whether the mean of two stable loops is unstable."""
    if max(first.spectral_radius, second.spectral_radius) >= 1.0:
        return False
    samples = tuple(_between(first.samples, second.samples, 0.5))
    return dataclasses.replace(first, samples=samples).spectral_radius >= 1.0


def _between(
    first: Sequence[SampleMap], second: Sequence[SampleMap], share: float
) -> list[SampleMap]:
    """The maps at a share of the way from those of one posture to those of the next."""

    def blend(name: str, a: SampleMap, b: SampleMap) -> np.ndarray:
        mean: np.ndarray = (1.0 - share) * getattr(a, name) + share * getattr(b, name)
        return mean

    pairs = zip(first, second, strict=True)
    return [SampleMap(**{name: blend(name, a, b) for name in "abcd"}) for a, b in pairs]


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
    """Actuators for the base with output equal to the command plus a source's value at each
    sample.
    """
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
