"""Running a scenario: Rollout builds the closed loop once and logs its runs; simulate makes one run a RunRecord."""

import contextlib
import dataclasses
import functools
import time
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Context, EventStatus, LeafSystem, System

from ffsm_drake.common.errors import ControllerError, FfsmError, ScenarioError, one_line
from ffsm_drake.common.lifetime import untie
from ffsm_drake.loop.closed_loop import ClosedLoop, make_closed_loop
from ffsm_drake.runs.metrics import tracking_metrics
from ffsm_drake.runs.record import Outcome, RunRecord, software_versions
from ffsm_drake.scenario import CONTROLLER_NAMES, Scenario, scenario_to_dict
from ffsm_drake.spacecraft.coordinates import Coordinates, position_errors
from ffsm_drake.spacecraft.plant import PlantModel, find_frame, make_true_plant

if TYPE_CHECKING:
    import xarray as xr

# A logger sees the state before the update of its instant. So at t_k these still show sample k - 1 ...
_HELD = ("measurement", "generalized_force", "applied_force", "sliding_variable")
# ... while all others show what the update at t_k is about to use.


# Besides the payload's true mass properties, what a run takes from its scenario without a new build.
_OF_THE_CONTEXT = ("description", "random_seed", "duration", "divergence_speed", "initial_velocity")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RunLog:
    """A run as it came from the simulator: the aligned time series, nothing derived from them but the error.

    ``series`` holds, by name, ``closed_loop.SIGNALS`` without ``estimated_state``, and the controller's optional
    outputs, each (n, its width): a signal of sample k is the one that sample k used or produced.
    """

    scenario: Scenario
    outcome: Outcome
    coordinates: Coordinates
    time: np.ndarray  # (n,), control samples t_k, s
    series: Mapping[str, np.ndarray]
    wall_time: dict[str, float]  # s: build (once for all runs), advance_to, total (of this run)

    @property
    def generalized_force(self) -> np.ndarray:
        """Control tau (n, nv), held from each sample to the next, N m or N."""
        return self.series["generalized_force"]

    @functools.cached_property
    def error(self) -> np.ndarray:
        """True tracking error e = q_d - q (n, nv), base rotation as a rotation vector in the world frame."""
        num_positions = len(self.coordinates.position_names)
        return position_errors(self.series["desired_state"][:, :num_positions], self.series["state"][:, :num_positions])

    @functools.cached_property
    def metrics(self) -> dict[str, Any]:
        """Figures of merit; the keys are those of ``ffsm_drake.runs.metrics.tracking_metrics``."""
        return tracking_metrics(
            time=self.time,
            error=self.error,
            effort=self.generalized_force,
            period=self.scenario.sample_time,
            group=self.coordinates.group_of,
        )


class Rollout:
    """A closed loop that is built once and run many times; every run has the bits of a fresh build.

    Raises ModelError and ScenarioError as ``make_closed_loop`` does.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        meshcat: Meshcat | None = None,
        own_disturbance: Callable[[Coordinates], System] | None = None,
        make_operator: Callable[[Coordinates], LeafSystem] | None = None,
    ) -> None:
        start = time.perf_counter()
        self.loop = make_closed_loop(
            scenario, meshcat=meshcat, log=True, own_disturbance=own_disturbance, make_operator=make_operator
        )
        self._simulator = Simulator(self.loop.diagram)
        ApplySimulatorConfig(scenario.simulator_config, self._simulator)
        config = scenario.simulator_config
        logs_every_step = not config.use_error_control and config.max_step_size >= scenario.sample_time
        self._from_elsewhere = [
            *([] if scenario.controller in CONTROLLER_NAMES else [f"controller '{scenario.controller}'"]),
            *([] if own_disturbance is None else [f"disturbance '{self.loop.disturbance.get_name()}'"]),
        ]
        # Not so where somebody watches or takes part, or a system from elsewhere may do otherwise next time.
        repeatable = meshcat is None and make_operator is None and not self._from_elsewhere
        self._judged_by_log = logs_every_step and repeatable
        self._built_for = _built_from(scenario)
        self._build_time = time.perf_counter() - start

    def release(self) -> None:
        """Free the closed loop, which Drake would otherwise keep; nothing of it may be used any more."""
        untie(self.loop.diagram)

    def accepts(self, scenario: Scenario) -> bool:
        """Whether ``run`` takes the scenario: it differs from the built one only in what a context can change.

        That is the description, the seed, the duration, the divergence speed, the initial velocity and the payload's
        true mass properties.
        """
        return _built_from(scenario) == self._built_for

    def run(
        self, scenario: Scenario | None = None, *, progress: Callable[[float, float], None] | None = None
    ) -> RunLog:
        """Run from the start, with the built scenario or one that ``accepts`` takes.

        A run that diverges (a velocity beyond ``divergence_speed``, or not finite) or is interrupted from the keyboard
        ends early with the log up to then; its outcome says so.

        Args:
          scenario: what to run; None for the built one.
          progress: called with (simulated time, duration) in s, once per simulated second.

        Raises:
          ScenarioError: the scenario needs another build.
        """
        start = time.perf_counter()
        loop = self.loop
        if scenario is not None:
            if not self.accepts(scenario):
                raise ScenarioError(
                    "scenario", "differs from the built one in more than a run can change; build another"
                )
            loop = dataclasses.replace(loop, scenario=scenario)
        scenario = loop.scenario
        monitor = _Monitor(loop, progress)
        # A monitor calls Python in every step. Where all steps are in the log, that shows afterwards whether a monitor
        # would have stopped the run; if so, it is run again with the monitor.
        watched = not self._judged_by_log
        interrupted, advance_time = self._advance(monitor, watched=watched)
        times, series = self._read_log(interrupted=interrupted)
        if not (watched or interrupted) and (monitor.message or not monitor.bounds(series["state"])):
            monitor.forget()
            interrupted, more_time = self._advance(monitor, watched=True)
            advance_time += more_time
            times, series = self._read_log(interrupted=interrupted)
        last = float(times[-1])
        if monitor.coordinate:
            outcome = Outcome(status="diverged", time=last, coordinate=monitor.coordinate, message=monitor.message)
        elif interrupted:
            outcome = Outcome(status="interrupted", time=last, message=f"interrupted at t = {last:.2f} s")
        else:
            outcome = Outcome(status="completed", time=last, message=f"completed {last:g} s")
        return RunLog(
            scenario=scenario,
            outcome=outcome,
            coordinates=loop.coordinates,
            time=times,
            series=series,
            wall_time={
                "build": self._build_time,
                "advance_to": advance_time,
                "total": time.perf_counter() - start,
            },
        )

    def _advance(self, monitor: "_Monitor", *, watched: bool) -> tuple[bool, float]:
        """Run from the start to the end, or to where it cannot go on, which ``monitor`` then notes.

        Returns: whether it was interrupted from the keyboard, and the wall time spent advancing, s.
        """
        simulator, loop = self._simulator, monitor.loop
        simulator.reset_context(loop.diagram.CreateDefaultContext())
        context = simulator.get_mutable_context()
        loop.initialize(loop.diagram, context)
        if watched:
            simulator.set_monitor(monitor)
        else:
            simulator.clear_monitor()
        sample_time, num_periods = loop.scenario.sample_time, loop.scenario.num_control_periods
        # Stops at control samples do not change the steps.
        stop_periods = max(1, round(1.0 / sample_time))
        start = time.perf_counter()
        interrupted = False
        # What a run does beyond the point where it is to be stopped concerns nobody.
        unremarked = contextlib.nullcontext() if watched else np.errstate(over="ignore", invalid="ignore")
        try:
            with unremarked:
                simulator.Initialize()
                for period in (*range(0, num_periods, stop_periods), num_periods):
                    simulator.AdvanceTo(period * sample_time)
                    if monitor.message or not monitor.check(context):
                        break
                    monitor.report(context)
                simulator.AdvancePendingEvents()  # the control update of the last sample
        except KeyboardInterrupt:
            interrupted = True
        except FfsmError:
            raise
        except Exception as error:
            # Numbers that are no longer finite are refused; any other refusal is a fault to be seen.
            if monitor.check(context) and monitor.check_force(context):
                _raise_for(error, self._from_elsewhere, context.get_time())
        return interrupted, time.perf_counter() - start

    def _read_log(self, *, interrupted: bool) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Sample times and the aligned series (copied)."""
        loop, context = self.loop, self._simulator.get_context()
        assert loop.logger is not None
        log = loop.logger.FindLog(context)
        times, rows = log.sample_times().copy(), log.data()
        if interrupted and times.size == 0:
            raise KeyboardInterrupt
        if interrupted and times.size > 1:
            # Perhaps before the update of the last sample, which is therefore left out.
            parts = {name: rows[part, 1:] if name in _HELD else rows[part, :-1] for name, part in loop.logged.items()}
            return times[:-1], {name: part.T.copy() for name, part in parts.items()}
        series = {}
        for name, part in loop.logged.items():
            if name in _HELD:
                # Sample k is entry k + 1 of the log; that of the last sample stands in the context.
                last = loop.diagram.GetOutputPort(name).Eval(context)
                series[name] = np.vstack([rows[part, 1:].T, last])
            else:
                series[name] = rows[part].T.copy()
        return times, series


def _raise_for(error: Exception, suspects: Sequence[str], time: float) -> NoReturn:
    """Say where a system from elsewhere failed; where none takes part, the fault is ours and passes as it is."""
    if not suspects:
        raise error
    place = traceback.extract_tb(error.__traceback__)[-1]
    raise ControllerError(
        f"{' or '.join(suspects)} failed at t = {time:.2f} s: {type(error).__name__}: {one_line(error)} "
        f"({place.filename}, line {place.lineno})"
    ) from error


def _built_from(scenario: Scenario) -> dict[str, Any]:
    """What of a scenario goes into the build, as plain data; the rest a run's context holds."""
    neutral = Scenario()
    return scenario_to_dict(
        dataclasses.replace(
            scenario,
            payload=dataclasses.replace(scenario.payload, truth=neutral.payload.truth),
            **{name: getattr(neutral, name) for name in _OF_THE_CONTEXT},
        )
    )


def simulate(
    scenario: Scenario,
    *,
    meshcat: Meshcat | None = None,
    progress: Callable[[float, float], None] | None = None,
    check_stability: bool = True,
    own_disturbance: Callable[[Coordinates], System] | None = None,
    make_operator: Callable[[Coordinates], LeafSystem] | None = None,
) -> RunRecord:
    """Run a scenario to its end and return the record. ``Rollout`` is cheaper for many runs.

    A run that diverges (a velocity beyond ``divergence_speed``, or not finite) or is interrupted from the keyboard ends
    early with the record up to then; ``record.outcome`` says so.

    Args:
      scenario: what to run.
      meshcat: shows the motion while it is computed (set ``simulator_config.target_realtime_rate`` to pace it).
      progress: called with (simulated time, duration) in s, once per simulated second.
      check_stability: warn (StabilityWarning) when the sampled loop starts unstable or its adaptation may become so.
      own_disturbance: a source in place of the scenario's harmonics, see ``make_closed_loop``; the dataset's attribute
        ``disturbance`` then holds its name.
      make_operator: lets a system add to the disturbance, see ``make_closed_loop``.

    Raises:
      ModelError, ScenarioError: the scenario's model or a value in it cannot be used.
    """
    start = time.perf_counter()
    if check_stability:
        from ffsm_drake.design.stability import StabilityWarning, stability_warning  # SciPy is slow to import

        if remark := stability_warning(scenario):
            warnings.warn(remark, StabilityWarning, stacklevel=2)
    rollout = Rollout(scenario, meshcat=meshcat, own_disturbance=own_disturbance, make_operator=make_operator)
    log = rollout.run(progress=progress)
    dataset = make_dataset(log)
    if own_disturbance is not None:
        dataset.attrs["disturbance"] = rollout.loop.disturbance.get_name()
    return RunRecord(
        scenario=scenario,
        outcome=log.outcome,
        dataset=dataset,
        wall_time=log.wall_time | {"total": time.perf_counter() - start},
        software=software_versions(),
    )


@dataclasses.dataclass
class _Monitor:
    """Judges whether a run diverges and reports its progress; as a simulator's monitor, it stops one that does."""

    loop: ClosedLoop
    progress: Callable[[float, float], None] | None
    message: str = ""
    coordinate: str = ""
    next_report: float = 0.0

    def __post_init__(self) -> None:
        self._bound = self.loop.scenario.divergence_speed
        self._first_velocity = self.loop.plant.num_positions()

    def __call__(self, context: Context) -> EventStatus:
        if not self.check(context):
            return EventStatus.ReachedTermination(self.loop.diagram, self.message)
        return EventStatus.DidNothing()

    def forget(self) -> None:
        """Take back the verdict; what was reported stays reported."""
        self.message = self.coordinate = ""

    def report(self, context: Context) -> None:
        """Report the progress, every whole second once."""
        if self.progress is not None and context.get_time() >= self.next_report - 1e-9:
            self.next_report += 1.0
            self.progress(context.get_time(), self.loop.scenario.duration)

    def bounds(self, states: np.ndarray) -> bool:
        """Whether every velocity in states (..., nq + nv) is within the bound."""
        return bool(np.abs(states[..., self._first_velocity :]).max() <= self._bound)  # false for NaN too

    def check(self, context: Context) -> bool:
        """Whether every velocity is within the bound; otherwise ``message`` and ``coordinate`` say which is not."""
        state = context.get_continuous_state_vector().CopyToVector()
        if self.bounds(state):
            return True
        velocity = state[self._first_velocity :]
        # The first that is not finite, else the fastest.
        worst = int(np.argmax(np.where(np.isfinite(velocity), np.abs(velocity), np.inf)))
        coordinates = self.loop.coordinates
        self._note(
            context,
            worst,
            f"{coordinates.names[worst]} moves at {velocity[worst]:.3g} {coordinates.units[worst]}/s, "
            f"beyond divergence_speed = {self._bound:g}",
        )
        return False

    def check_force(self, context: Context) -> bool:
        """Whether the controller's force is finite; otherwise as ``check``."""
        diagram = self.loop.diagram
        force = diagram.GetOutputPort("generalized_force").Eval(context)
        if np.isfinite(force).all():
            return True
        worst = int(np.argmin(np.isfinite(force)))
        self._note(context, worst, f"the force on {self.loop.coordinates.names[worst]} is {force[worst]:g}")
        return False

    def _note(self, context: Context, worst: int, what: str) -> None:
        self.coordinate = self.loop.coordinates.names[worst]
        self.message = f"{self.loop.scenario.controller} diverged at t = {context.get_time():.2f} s: {what}"


def make_dataset(log: RunLog) -> "xr.Dataset":
    """The labelled time series of a run: its log and, for what follows from the state, the true plant."""
    import xarray as xr

    scenario, coordinates, series = log.scenario, log.coordinates, log.series
    num_positions = len(coordinates.position_names)
    position, velocity = np.split(series["state"], [num_positions], axis=1)
    desired_position, desired_velocity = np.split(series["desired_state"], [num_positions], axis=1)
    measured_position, measured_velocity = np.split(series["measurement"], [num_positions], axis=1)
    model = make_true_plant(scenario)
    momentum, energy = _momentum_and_energy(model, series["state"])
    end_effector, desired_end_effector = (_end_effector(model, scenario, q) for q in (position, desired_position))
    unit = "rad (rotations) or m (translations)"
    force = "N m (rotations) or N (translations)"
    by_coordinate, by_position, by_axis = ("time", "coordinate"), ("time", "position_name"), ("time", "axis")
    variables = {
        "position": (by_position, position, "generalized positions q", f"1 (quaternion), {unit}"),
        "velocity": (by_coordinate, velocity, "generalized velocities v", f"{unit} per s"),
        "measured_position": (by_position, measured_position, "q as the controller reads it", f"1, {unit}"),
        "measured_velocity": (by_coordinate, measured_velocity, "v as the controller reads it", f"{unit} per s"),
        "desired_position": (by_position, desired_position, "reference q_d", f"1 (quaternion), {unit}"),
        "desired_velocity": (by_coordinate, desired_velocity, "reference v_d", f"{unit} per s"),
        "desired_acceleration": (
            by_coordinate, series["desired_acceleration"], "reference acceleration", f"{unit} per s^2",
        ),
        "error": (by_coordinate, log.error, "true tracking error e = q_d - q (rotation vector in world)", unit),
        "error_rate": (by_coordinate, desired_velocity - velocity, "true error rate v_d - v", f"{unit} per s"),
        "generalized_force": (
            by_coordinate, series["generalized_force"], "control tau, held from this sample to the next", force,
        ),
        "applied_force": (
            by_coordinate, series["applied_force"], "what the actuators make of tau, held likewise", force,
        ),
        "disturbance_force": (
            by_coordinate, series["disturbance_force"], "external disturbance tau_d at this instant", force,
        ),
        "end_effector_position": (by_axis, end_effector, "end effector in the world frame", "m"),
        "desired_end_effector_position": (by_axis, desired_end_effector, "its reference", "m"),
        "base_rpy": (by_axis, _base_rpy(position), "roll, pitch, yaw of the base", "rad"),
        "desired_base_rpy": (by_axis, _base_rpy(desired_position), "their reference", "rad"),
        "linear_momentum": (by_axis, momentum[:, 3:], "total linear momentum", "N s"),
        "angular_momentum": (
            by_axis, momentum[:, :3], "total angular momentum about the world's origin", "N m s",
        ),
        "kinetic_energy": (("time",), energy, "total kinetic energy", "J"),
    }  # fmt: skip
    for name, meaning in (
        ("sliding_variable", "sliding variable s of this sample"),
        ("reaching_gain", "K_s used by this sample, 1/s"),
        ("switching_gain", "G used by this sample"),
    ):
        if name in series:
            variables[name] = (by_coordinate, series[name], meaning, "1/s" if name == "reaching_gain" else unit)
    return xr.Dataset(
        {
            name: (dims, values, {"long_name": meaning, "units": units})
            for name, (dims, values, meaning, units) in variables.items()
        },
        coords={
            "time": ("time", log.time, {"long_name": "control sample t_k", "units": "s"}),
            "coordinate": list(coordinates.names),
            "position_name": list(coordinates.position_names),
            "axis": ["x", "y", "z"],
            "group": ("coordinate", list(coordinates.group_of)),
            "unit": ("coordinate", list(coordinates.units)),
        },
        attrs={
            "title": scenario.description,
            "controller": scenario.controller,
            "sample_time": scenario.sample_time,
            "random_seed": scenario.random_seed,
        },
    )


def _momentum_and_energy(model: PlantModel, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Momentum about the world's origin (n, 6; angular, then linear) and kinetic energy (n) of states (n, nq + nv)."""
    plant, context = model.plant, model.context
    origin = np.zeros(3)
    momentum, energy = np.empty((len(states), 6)), np.empty(len(states))
    for i, state in enumerate(states):
        if not np.isfinite(state).all():  # a diverged run's last; Drake ends the process on it
            momentum[i] = energy[i] = np.nan
            continue
        plant.SetPositionsAndVelocities(context, state)
        momentum[i] = plant.CalcSpatialMomentumInWorldAboutPoint(context, origin).get_coeffs()
        energy[i] = plant.CalcKineticEnergy(context)
    return momentum, energy


def _end_effector(model: PlantModel, scenario: Scenario, positions: np.ndarray) -> np.ndarray:
    """The end effector's place in the world (n, 3) in configurations q (n, nq)."""
    plant, context = model.plant, model.context
    frame = find_frame(plant, scenario.model.end_effector, key="model.end_effector")
    places = np.empty((len(positions), 3))
    for i, q in enumerate(positions):
        if not np.isfinite(q).all():  # as above
            places[i] = np.nan
            continue
        plant.SetPositions(context, q)
        places[i] = frame.CalcPoseInWorld(context).translation()
    return places


def _base_rpy(positions: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw (n, 3) of the base in configurations q (n, nq), rad; as ``plant.base_rpy``."""
    w, x, y, z = positions[:, :4].T / np.linalg.norm(positions[:, :4], axis=1)
    cosines = np.hypot(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z))  # of the pitch
    return np.stack(
        [
            np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
            np.arctan2(2.0 * (w * y - x * z), cosines),
            np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z)),
        ],
        axis=1,
    )
