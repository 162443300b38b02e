"""Running a scenario: Rollout builds the closed loop once and logs its runs; simulate makes one run a RunRecord."""

import dataclasses
import functools
import time
import warnings
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus
from pydrake.systems.primitives import LogVectorOutput

from ffsm_drake.closed_loop import ClosedLoop, make_closed_loop
from ffsm_drake.coordinates import Coordinates, position_error
from ffsm_drake.errors import ScenarioError
from ffsm_drake.metrics import tracking_metrics
from ffsm_drake.plant import PlantModel, base_rpy, find_frame, make_true_plant
from ffsm_drake.record import Outcome, RunRecord, software_versions
from ffsm_drake.scenario import Scenario, scenario_to_dict

if TYPE_CHECKING:
    import xarray as xr

# A logger sees the state before the update of its instant. So at t_k these still show sample k - 1 ...
_HELD = ("measurement", "generalized_force", "applied_force", "sliding_variable")
# ... while these show what the update at t_k is about to use.
_CURRENT = ("state", "desired_state", "desired_acceleration", "disturbance_force", "reaching_gain", "switching_gain")


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
    wall_time: dict[str, float]  # s: build, advance_to, total

    @property
    def generalized_force(self) -> np.ndarray:
        """Control tau (n, nv), held from each sample to the next, N m or N."""
        return self.series["generalized_force"]

    @functools.cached_property
    def error(self) -> np.ndarray:
        """True tracking error e = q_d - q (n, nv), base rotation as a rotation vector in the world frame."""
        num_positions = len(self.coordinates.position_names)
        pairs = zip(self.series["desired_state"], self.series["state"], strict=True)
        return np.array([position_error(desired[:num_positions], state[:num_positions]) for desired, state in pairs])

    @functools.cached_property
    def metrics(self) -> dict[str, Any]:
        """Figures of merit; the keys are those of ``ffsm_drake.metrics.tracking_metrics``."""
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

    def __init__(self, scenario: Scenario, *, meshcat: Meshcat | None = None) -> None:
        start = time.perf_counter()
        self._loop = make_closed_loop(scenario, meshcat=meshcat)
        builder = DiagramBuilder()
        builder.AddSystem(self._loop.diagram)
        self._loggers = {
            name: LogVectorOutput(self._loop.diagram.GetOutputPort(name), builder, scenario.sample_time)
            for name in _HELD + _CURRENT
            if self._loop.diagram.HasOutputPort(name)
        }
        self._root = builder.Build()
        self._simulator = Simulator(self._root)
        ApplySimulatorConfig(scenario.simulator_config, self._simulator)
        self._built_for = _built_from(scenario)
        self._build_time = time.perf_counter() - start

    def accepts(self, scenario: Scenario) -> bool:
        """Whether ``run`` takes the scenario: it differs from the built one only in what a context can change.

        That is the description, the seed, the duration, the divergence speed and the payload's true mass properties.
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
        loop = self._loop
        if scenario is not None:
            if not self.accepts(scenario):
                raise ScenarioError(
                    "scenario", "differs from the built one in more than a run can change; build another"
                )
            loop = dataclasses.replace(loop, scenario=scenario)
        scenario = loop.scenario
        self._simulator.reset_context(self._root.CreateDefaultContext())
        context = self._simulator.get_mutable_context()
        loop.initialize(self._root, context)
        monitor = _Monitor(loop, progress)
        self._simulator.set_monitor(monitor)
        end = scenario.num_control_periods * scenario.sample_time

        initialized = time.perf_counter()
        interrupted = False
        try:
            self._simulator.Initialize()
            self._simulator.AdvanceTo(end)
            self._simulator.AdvancePendingEvents()  # the control update of the last sample
        except KeyboardInterrupt:
            interrupted = True
        except RuntimeError:
            # Drake refuses numbers that are no longer finite; any other refusal is a fault to be seen.
            if monitor.check(context) and monitor.check_force(context):
                raise
        advanced = time.perf_counter()

        times, series = self._read_logs(context)
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
                "build": self._build_time + initialized - start,
                "advance_to": advanced - initialized,
                "total": self._build_time + time.perf_counter() - start,
            },
        )

    def _read_logs(self, context: Context) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Sample times and the aligned series (copied)."""
        logs = {name: logger.FindLog(context) for name, logger in self._loggers.items()}
        series = {name: np.array(log.data().T) for name, log in logs.items()}
        # Sample k of a held signal is its log entry k + 1; that of the last sample stands in the context.
        diagram = self._loop.diagram
        diagram_context = diagram.GetMyContextFromRoot(context)
        for name in _HELD:
            if name in series:
                series[name] = np.vstack([series[name][1:], diagram.GetOutputPort(name).Eval(diagram_context)])
        return np.array(logs["state"].sample_times()), series


def _built_from(scenario: Scenario) -> dict[str, Any]:
    """What of a scenario goes into the build, as plain data; the rest a run's context holds."""
    neutral = Scenario()
    return scenario_to_dict(
        dataclasses.replace(
            scenario,
            payload=dataclasses.replace(scenario.payload, truth=neutral.payload.truth),
            **{name: getattr(neutral, name) for name in ("description", "random_seed", "duration", "divergence_speed")},
        )
    )


def simulate(
    scenario: Scenario,
    *,
    meshcat: Meshcat | None = None,
    progress: Callable[[float, float], None] | None = None,
    check_stability: bool = True,
) -> RunRecord:
    """Run a scenario to its end and return the record. ``Rollout`` is cheaper for many runs.

    A run that diverges (a velocity beyond ``divergence_speed``, or not finite) or is interrupted from the keyboard ends
    early with the record up to then; ``record.outcome`` says so.

    Args:
      scenario: what to run.
      meshcat: shows the motion while it is computed (set ``simulator_config.target_realtime_rate`` to pace it).
      progress: called with (simulated time, duration) in s, once per simulated second.
      check_stability: warn (StabilityWarning) when the sampled loop starts unstable or its adaptation may become so.

    Raises:
      ModelError, ScenarioError: the scenario's model or a value in it cannot be used.
    """
    start = time.perf_counter()
    if check_stability:
        from ffsm_drake.stability import StabilityWarning, stability_warning  # SciPy is slow to import

        if remark := stability_warning(scenario):
            warnings.warn(remark, StabilityWarning, stacklevel=2)
    log = Rollout(scenario, meshcat=meshcat).run(progress=progress)
    dataset = make_dataset(log)
    return RunRecord(
        scenario=scenario,
        outcome=log.outcome,
        dataset=dataset,
        wall_time=log.wall_time | {"total": time.perf_counter() - start},
        software=software_versions(),
    )


@dataclasses.dataclass
class _Monitor:
    """Watches every step: stops a run that diverges, and reports progress."""

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
        if self.progress is not None and context.get_time() >= self.next_report - 1e-9:
            self.next_report += 1.0
            self.progress(context.get_time(), self.loop.scenario.duration)
        return EventStatus.DidNothing()

    def check(self, context: Context) -> bool:
        """Whether every velocity is within the bound; otherwise ``message`` and ``coordinate`` say which is not."""
        velocity = context.get_continuous_state_vector().CopyToVector()[self._first_velocity :]
        if np.abs(velocity).max() <= self._bound:  # false for NaN too
            return True
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
        force = diagram.GetOutputPort("generalized_force").Eval(diagram.GetMyContextFromRoot(context))
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
    derived = _derive(model, scenario, position, velocity)
    desired_derived = _derive(model, scenario, desired_position, desired_velocity)
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
        "end_effector_position": (by_axis, derived["end_effector"], "end effector in the world frame", "m"),
        "desired_end_effector_position": (by_axis, desired_derived["end_effector"], "its reference", "m"),
        "base_rpy": (by_axis, derived["rpy"], "roll, pitch, yaw of the base", "rad"),
        "desired_base_rpy": (by_axis, desired_derived["rpy"], "their reference", "rad"),
        "linear_momentum": (by_axis, derived["linear_momentum"], "total linear momentum", "N s"),
        "angular_momentum": (
            by_axis, derived["angular_momentum"], "total angular momentum about the world's origin", "N m s",
        ),
        "kinetic_energy": (("time",), derived["kinetic_energy"], "total kinetic energy", "J"),
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


def _derive(model: PlantModel, scenario: Scenario, position: np.ndarray, velocity: np.ndarray) -> dict[str, np.ndarray]:
    """What follows from the state at every sample: end effector, base angles, momentum, energy."""
    plant, context = model.plant, model.context
    frame = find_frame(plant, scenario.model.end_effector, key="model.end_effector")
    rows: dict[str, list[np.ndarray]] = {
        name: [] for name in ("end_effector", "rpy", "linear_momentum", "angular_momentum", "kinetic_energy")
    }
    for q, v in zip(position, velocity, strict=True):
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        momentum = plant.CalcSpatialMomentumInWorldAboutPoint(context, np.zeros(3))
        rows["end_effector"].append(frame.CalcPoseInWorld(context).translation())
        rows["rpy"].append(base_rpy(q))
        rows["linear_momentum"].append(momentum.translational())
        rows["angular_momentum"].append(momentum.rotational())
        rows["kinetic_energy"].append(plant.CalcKineticEnergy(context))
    return {name: np.array(values) for name, values in rows.items()}
