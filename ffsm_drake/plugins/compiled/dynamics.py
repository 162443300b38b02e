"""The engine ``compiled``: whole runs in machine code, compared with Drake before the first use."""

import collections
import dataclasses
import functools
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.common.plugins import service
from ffsm_drake.plugins.compiled.apart import reason_of
from ffsm_drake.plugins.compiled.compiling import llvm
from ffsm_drake.plugins.compiled.kernel import Kernel, Signals
from ffsm_drake.plugins.compiled.loop import SCHEMES, Blocks, steps_of
from ffsm_drake.plugins.compiled.measuring import phases
from ffsm_drake.plugins.compiled.noise import Noise, noise_of
from ffsm_drake.plugins.compiled.parameters import parameters_of, reader_of, rows_of
from ffsm_drake.plugins.equations.comparison import held_to_drake
from ffsm_drake.runs.batches import all_but_controller, group_of
from ffsm_drake.runs.ending import COMPLETED, Outcome
from ffsm_drake.runs.engine import Engine, NotCovered
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.rollout import make_rollout
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import make_flexible_plant, make_nominal_plant
from ffsm_drake.spacecraft.start import state_at_start
from ffsm_drake.systems.controllers import SampledController, make_controller
from ffsm_drake.systems.controllers.law import is_shipped
from ffsm_drake.systems.disturbance import sines_of
from ffsm_drake.systems.part import Parts
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_frame_motion, make_motion, prescribes_frame
from ffsm_drake.systems.sensing import SensorErrors, late_sensors

# From Drake's run, as a share of a signal's largest value. Rounding is amplified by high gains.
LARGEST_DIFFERENCE = 1e-7
_UNCLEAR = 1e-5  # less may be rounding in a loop that is nearly unstable for a while
_BLOCKS = {"reference", "sensing", "controller", "actuation", "forces.disturbance"}
_PARTS = {"flexible"}  # with signals
_KEPT = 16  # kernels
_TRIED = 3  # runs for a comparison with Drake; if all of them diverge, Drake runs all


class Diverges(NotCovered):
    """Nothing can be said of the code by this run."""


class Compiled(Engine):
    """Runs in machine code, as many at once as a register holds."""

    name = "compiled"

    def __init__(self) -> None:
        """Raises FfsmError: llvmlite is missing."""
        llvm()

    def check(self, scenario: Scenario) -> None:
        """See Engine."""
        config = scenario.simulator_config
        steps = steps_of(scenario.sample_time, config.max_step_size)
        own = set(scenario.blocks.choices()) | {name for name, is_there in (
            ("capture.approach", scenario.approach is not None),
            ("contacts", scenario.contacts),
            ("supervisor", scenario.supervisor is not None),
            ("faults", scenario.faults),
            ("actuation.thrusters", scenario.actuation.thrusters is not None),
            ("actuation.wheels", scenario.actuation.wheels is not None),
            ("actuation.drives", scenario.actuation.drives is not None),
            ("error control", config.use_error_control),
            ("a real-time clock", config.target_realtime_rate > 0.0),
            (f"integration_scheme {config.integration_scheme}",
             config.integration_scheme not in SCHEMES),
            ("steps that do not divide a sample", not steps),
        ) if is_there}  # fmt: skip
        if own:
            raise NotCovered(", ".join(sorted(own)))

    def run_all(self, scenarios: Sequence[Scenario]) -> list[RunLog | NotCovered | None]:
        """See Engine."""
        results: list[RunLog | NotCovered | None] = [None] * len(scenarios)
        groups: dict[Any, list[tuple[int, _Run]]] = {}
        cases = dict[Any, _Case]()
        for index, scenario in enumerate(scenarios):
            try:
                self.check(scenario)
                if (same := all_but_controller(scenario)) not in cases:
                    cases[same] = _Case(scenario)
                run = _Run(scenario, cases[same])
                groups.setdefault((run.key, run.samples), []).append((index, run))
            except NotCovered as error:
                results[index] = error
            except FfsmError:  # Drake's run shows it
                pass
        rows = dict[Any, np.ndarray]()
        for group in groups.values():
            found = _results([run for _, run in group], rows)
            for (index, _), result in zip(group, found, strict=True):
                results[index] = result
        return results


_kernels: collections.OrderedDict[Any, Kernel | NotCovered] = collections.OrderedDict()
_judged = set[Any]()  # keys of kernels that were compared with Drake


def _kernel(run: "_Run") -> Kernel:
    """The compiled code of a run, compared with Drake once in a process. Raises NotCovered."""
    found = _kernels.get(run.key)
    try:
        if found is None:
            found = _compiled(run)
        if isinstance(found, Kernel) and run.key not in _judged:
            _kernels[run.key] = found  # a run that diverges leaves it there
            _judge(run, found)
            _judged.add(run.key)
    except Diverges:
        raise
    except NotCovered as error:
        found = error
    except FfsmError as error:  # Drake's run, or llvmlite, refuses it
        found = NotCovered(one_line(error))
    _kernels[run.key] = found
    if len(_kernels) > _KEPT:
        key, _ = _kernels.popitem(last=False)
        _judged.discard(key)
    if isinstance(found, NotCovered):
        raise found
    return found


class _Case:
    """What runs share that differ in their controllers at most."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.true, self.nominal = make_flexible_plant(scenario), make_nominal_plant(scenario)
        self.coordinates: Coordinates = self.nominal.coordinates
        self.samples = scenario.num_control_periods + 1
        own = reader_of(self.true.plant)
        errors = SensorErrors(scenario.sensing, self.coordinates, scenario.sample_time)
        drift = errors.drift()
        late = tuple(
            each._replace(entries=tuple(each.entries.tolist()))
            for each in late_sensors(*errors.times())
        )
        disturbance, force = sines_of(scenario.disturbance, self.coordinates), scenario.actuation
        limit = self.coordinates.vector(force.limit or {}, key="actuation.limit", default=np.inf)
        resolution = self.coordinates.vector(
            force.quantization, key="actuation.quantization", default=0.0
        )
        config = scenario.simulator_config
        self.steps = steps_of(scenario.sample_time, config.max_step_size)
        self.parameters = {
            "own": own.parameters(self.true.context),
            "turn": errors.turn.ravel(),
            "bias": errors.bias,
            "deviation": errors.deviation,
            "resolution": errors.resolution,
            "limit": limit,
            "force_resolution": resolution,
            "sines": disturbance.ravel(),
            "share": drift.kept,
            "added": drift.added,
            "sample_time": np.array([scenario.sample_time]),
            "step": np.array([scenario.sample_time / self.steps]),
        }
        self._sizes_of_noise = {"size": errors.bias.size, "drifting": drift.kept.size}
        start = state_at_start(scenario, self.true)
        known = self.true.split.known_part(np.arange(start.size))
        before = [np.tile(start[known][list(each.entries)], each.kept) for each in late]
        self.states = {
            "x": start,
            "drift": drift.start * self.noise.start if drift.start.any() else drift.start,
            "past": np.concatenate([np.zeros(0), *before]),
        }
        self.fixed = {
            "nq": len(self.coordinates.position_names),
            "nv": len(self.coordinates.names),
            "tree": own.tree,
            "known": tuple(known.tolist()),
            "hidden": tuple(self.true.split.hidden_state.tolist()),
            "forced": tuple(
                self.true.split.known_velocities(np.arange(own.tree.num_velocities)).tolist()
            ),
            "undriven": tuple(np.flatnonzero(~self.coordinates.is_driven).tolist()),
            "turned": tuple(errors.axes_matter().tolist()),
            "drifting": tuple(drift.entries.tolist()),
            "biased": bool(errors.bias.any() or (errors.turn != np.eye(4)).any()),
            "noisy": bool(errors.deviation.any()),
            "rounded": bool(errors.resolution.any()),
            "late": late,
            "framed": prescribes_frame(scenario),
            "limited": bool(np.isfinite(limit).any()),
            "quantized": bool(resolution.any()),
            "waits": force.delay,
            "scheme": config.integration_scheme,
        }

    @functools.cached_property
    def group(self) -> str:
        """Equal for runs with the same diagram on Drake, but for the controller. Raises
        NotCovered.
        """
        group = group_of(dataclasses.replace(self.scenario, controller=""))
        if group is None:
            raise NotCovered("a run that cannot go side by side with others")
        return group

    @functools.cached_property
    def noise(self) -> Noise:
        """The samples of its sensors' noise."""
        return noise_of(self.scenario.random_seed, self.samples, **self._sizes_of_noise)

    @functools.cached_property
    def motion(self) -> PlannedMotion:
        """The reference."""
        return make_motion(self.scenario, self.coordinates)

    @functools.cached_property
    def times(self) -> np.ndarray:
        """The control samples (samples), s."""
        return self.scenario.sample_time * np.arange(self.samples)

    @functools.cached_property
    def reference(self) -> np.ndarray:
        """Rows of the motion (samples, nq + 2 nv)."""
        return self.motion.rows(self.times)

    @functools.cached_property
    def frame(self) -> list[np.ndarray]:
        """Rows of the path of a frame (samples, 19), if it is prescribed."""
        path = make_frame_motion(self.scenario, self.motion)
        return [] if path is None else [path.rows(self.times)]

    @property
    def rows(self) -> list[np.ndarray]:
        """What all of them read at each sample, side by side (samples, n)."""
        white = [self.noise.white] if self.fixed["noisy"] else []
        late = phases(self.fixed["late"], self.samples)
        return [self.reference, *white, self.noise.drift, late, *self.frame]


class _Run:
    """One run: what its code depends on, and its numbers."""

    def __init__(self, scenario: Scenario, case: _Case | None = None) -> None:
        """Args: the scenario, and what it shares with other runs."""
        self.scenario, self.case = scenario, _Case(scenario) if case is None else case
        controller = make_controller(scenario, self.case.nominal)
        if not isinstance(controller, SampledController):
            raise NotCovered("a controller that is a Drake system")
        self.law: Any = controller.law
        if getattr(self.law, "contacts_read", 0):
            raise NotCovered("a law that reads contacts")
        self.coordinates, self.samples = self.case.coordinates, self.case.samples
        self.motion, self.steps = self.case.motion, self.case.steps
        law, constants = parameters_of(self.law)
        memory = self.law.initial_state()
        self.parameters = self.case.parameters | {"law": law}
        self.states = self.case.states | {
            "memory": np.concatenate([np.zeros(0), *(np.ravel(memory[each]) for each in memory)]),
        }
        known = self.case.states["x"][None, list(self.case.fixed["known"])]
        planned = rows_of(self.law, known[:, : self.case.fixed["nq"]])
        fixed = {"num_parameters": law.size, "num_planned": planned.size, **self.case.fixed}
        # of equal code; and, with the same diagram on Drake
        self.code = (*fixed.values(), constants, self.steps)
        self.key = (self.case.group, scenario.controller, *self.code)
        self.blocks = Blocks(law=self.law, **fixed)

    @property
    def rows(self) -> list[np.ndarray]:
        """What it reads at each sample, side by side (samples, n)."""
        if not self.blocks.num_planned:
            return self.case.rows
        return [*self.case.rows, rows_of(self.law, self.case.reference[:, : self.blocks.nq])]

    @property
    def key_on_disk(self) -> str | None:
        """What the code is made from, besides this package; None for a user's law."""
        return repr(self.code) if is_shipped(self.law) else None


def _results(runs: Sequence[_Run], rows: dict[Any, np.ndarray]) -> list[RunLog | NotCovered | None]:
    """The results of runs with the same code; ``rows``: see ``_logs``."""
    kernel = None
    for run in runs[:_TRIED]:
        try:
            kernel = _kernel(run)
            break
        except Diverges:  # the next one may tell more of the code
            continue
        except NotCovered as error:
            return [error] * len(runs)
    if kernel is None:
        return [None] * len(runs)
    parts = [runs[at : at + kernel.width] for at in range(0, len(runs), kernel.width)]
    return [log for part in parts for log in _logs(kernel, part, rows)]


def _logs(kernel: Kernel, runs: Sequence[_Run], rows: dict[Any, np.ndarray]) -> list[RunLog | None]:
    """The logs of at most as many runs as a register holds; None: a run diverges.

    ``rows`` keeps what some cases read, for their runs with other controllers.
    """
    start = time.perf_counter()
    lanes = [*runs, *[runs[-1]] * (kernel.width - len(runs))]
    given = {name: np.array([run.parameters[name] for run in lanes]) for name in runs[0].parameters}
    given |= {name: np.array([run.states[name] for run in lanes]) for name in runs[0].states}
    own = runs[0].key if runs[0].blocks.num_planned else None
    if (read := (own, *(id(run.case) for run in runs))) not in rows:
        rows[read] = _side_by_side([run.rows for run in lanes])
    began = time.perf_counter()
    signals = kernel.run(given, rows[read])
    ended = time.perf_counter()
    wall_time = {"build": began - start, "advance_to": ended - began, "total": ended - start}
    finite, state = signals.are_finite(), signals["state"]
    return [
        _log(run, _Series(signals, lane, run.case), parts=kernel.parts, wall_time=wall_time)
        if finite[lane] and _is_within(run, state[lane])
        else None
        for lane, run in enumerate(runs)
    ]


def _side_by_side(rows: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """The rows of runs in parts (samples, n), as one array (samples, all n, runs)."""
    samples, width = len(rows[0][0]), sum(part.shape[1] for part in rows[0])
    made, first = np.empty((samples, width, len(rows))), 0
    for parts in zip(*rows, strict=True):
        made[:, first : first + parts[0].shape[1]] = np.stack(parts, axis=-1)
        first += parts[0].shape[1]
    return made


def _is_within(run: _Run, state: np.ndarray) -> bool:
    """Whether a run with states (samples, nq + nv) keeps its bound of velocity."""
    return bool(np.abs(state[:, run.blocks.nq :]).max() <= run.scenario.divergence_speed)


class _Series(Mapping[str, np.ndarray]):
    """The signals of a run, copied when they are read first."""

    def __init__(self, signals: Signals, lane: int, case: _Case) -> None:
        self._signals, self._lane, self._case = signals, lane, case
        self._names = [*signals.places, "desired_state", "desired_acceleration"]
        if case.fixed["framed"]:
            self._names.append("desired_frame")
        self._found = dict[str, np.ndarray]()

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._found:
            self._found[name] = self._copied(name)
        return self._found[name]

    def _copied(self, name: str) -> np.ndarray:
        if name in self._signals.places:
            return self._signals[name][self._lane].copy()
        if name not in self._names:
            raise KeyError(name)
        case, nv = self._case, self._case.fixed["nv"]
        if name == "desired_frame":
            return case.frame[0].copy()
        return np.split(case.reference, [-nv], axis=1)[name == "desired_acceleration"].copy()

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _log(
    run: _Run,
    series: Mapping[str, np.ndarray],
    *,
    parts: Parts,
    wall_time: dict[str, float],
) -> RunLog:
    scenario, duration = run.scenario, (run.samples - 1) * run.scenario.sample_time
    log = RunLog(
        scenario=scenario,
        outcome=Outcome(status=COMPLETED, time=duration, message=f"completed {duration:g} s"),
        coordinates=run.coordinates,
        split=run.case.true.split,
        tracks_frame=bool(getattr(run.law, "tracks_frame", False)),
        sliding_unit=str(run.law.sliding_unit),
        engine=Compiled.name,
        parts=parts,
        time=run.case.times.copy(),
        series=series,
        wall_time=wall_time,
    )
    if not scenario.grasps:
        return log
    grasped: RunLog = service("grasped_at_start", "capture")(log)
    return grasped


def _compiled(run: _Run) -> Kernel:
    """Trace and compile. Raises NotCovered."""
    held_to_drake(run.blocks.tree, plant=run.case.true.plant)
    try:
        kernel = Kernel(run.blocks, steps=run.steps, key=run.key_on_disk)
    except (FfsmError, MemoryError):
        raise
    except Exception as error:  # the law may raise anything on symbols
        raise NotCovered(f"{run.scenario.controller}: {reason_of(error)}") from error
    return kernel


def _judge(run: _Run, kernel: Kernel) -> None:
    """Compare a run with Drake's. Raises NotCovered: they differ, or Drake's cannot tell."""
    rollout = make_rollout(run.scenario)
    try:
        others = (set(rollout.loop.blocks) - _BLOCKS) | (set(rollout.loop.parts) - _PARTS)
        if others:
            raise NotCovered(", ".join(sorted(others)))
        kernel.parts = rollout.loop.parts
        expected = rollout.run(run.scenario)
    finally:
        rollout.release()
    (found,) = _logs(kernel, [run], {})
    if found is None or expected.outcome.status != COMPLETED:
        raise Diverges("the run diverges")
    if set(found.series) != set(expected.series):
        missing = set(expected.series) ^ set(found.series)
        raise NotCovered(f"the signals {', '.join(sorted(missing))}")
    for name, values in expected.series.items():
        scale = max(float(np.abs(values).max()), 1e-3)
        difference = float(np.abs(found.series[name] - values).max()) / scale
        if not difference <= LARGEST_DIFFERENCE:
            kind = Diverges if difference <= _UNCLEAR else NotCovered
            raise kind(
                f"{run.scenario.controller}: {name} differs from Drake's by {difference:.1e} of it"
            )
