"""Running a scenario: the closed loop, its loggers and its monitor -> RunRecord."""

import dataclasses
import time
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem
from pydrake.systems.primitives import LogVectorOutput, VectorLogSink

from ffsm_drake.closed_loop import ClosedLoop, make_closed_loop
from ffsm_drake.coordinates import Coordinates, position_error
from ffsm_drake.plant import PlantModel, base_rpy, find_frame, make_true_plant
from ffsm_drake.record import Outcome, RunRecord, software_versions
from ffsm_drake.scenario import Scenario

if TYPE_CHECKING:
    import xarray as xr

# A logger sees the state before the update of its instant. So at t_k these still show sample k - 1 ...
_HELD = ("measurement", "generalized_force", "applied_force", "sliding_variable")
# ... while these show what the update at t_k is about to use.
_CURRENT = ("state", "desired_state", "desired_acceleration", "disturbance_force", "reaching_gain", "switching_gain")


def simulate(
    scenario: Scenario,
    *,
    meshcat: Meshcat | None = None,
    progress: Callable[[float, float], None] | None = None,
    check_stability: bool = True,
    make_operator: Callable[[Coordinates], LeafSystem] | None = None,
) -> RunRecord:
    """Run a scenario to its end and return the record.

    A run that diverges (a velocity beyond ``divergence_speed``, or not finite) or is interrupted from the keyboard ends
    early with the record up to then; ``record.outcome`` says so.

    Args:
      scenario: what to run.
      meshcat: shows the motion while it is computed (set ``simulator_config.target_realtime_rate`` to pace it).
      progress: called with (simulated time, duration) in s, once per simulated second.
      check_stability: warn (StabilityWarning) when the sampled loop starts unstable or its adaptation may become so.
      make_operator: lets a system add to the disturbance, see ``make_closed_loop``.

    Raises:
      ModelError, ScenarioError: the scenario's model or a value in it cannot be used.
    """
    start = time.perf_counter()
    if check_stability:
        from ffsm_drake.stability import StabilityWarning, stability_warning  # SciPy is slow to import

        if remark := stability_warning(scenario):
            warnings.warn(remark, StabilityWarning, stacklevel=2)
    loop = make_closed_loop(scenario, meshcat=meshcat, make_operator=make_operator)
    builder = DiagramBuilder()
    builder.AddSystem(loop.diagram)
    loggers = {
        name: LogVectorOutput(loop.diagram.GetOutputPort(name), builder, scenario.sample_time)
        for name in _HELD + _CURRENT
        if loop.diagram.HasOutputPort(name)
    }
    root = builder.Build()
    simulator = Simulator(root)
    ApplySimulatorConfig(scenario.simulator_config, simulator)
    context = simulator.get_mutable_context()
    loop.initialize(root, context)
    monitor = _Monitor(loop, progress)
    simulator.set_monitor(monitor)
    end = scenario.num_control_periods * scenario.sample_time

    built = time.perf_counter()
    interrupted = False
    try:
        simulator.Initialize()
        simulator.AdvanceTo(end)
        simulator.AdvancePendingEvents()  # the control update of the last sample
    except KeyboardInterrupt:
        interrupted = True
    except RuntimeError:
        # Drake refuses numbers that are no longer finite; any other refusal is a fault to be seen.
        if monitor.check(context) and monitor.check_force(context):
            raise
    advanced = time.perf_counter()

    dataset = _make_dataset(loop, loggers, context)
    last = float(dataset["time"].values[-1])
    if monitor.coordinate:
        outcome = Outcome(status="diverged", time=last, coordinate=monitor.coordinate, message=monitor.message)
    elif interrupted:
        outcome = Outcome(status="interrupted", time=last, message=f"interrupted at t = {last:.2f} s")
    else:
        outcome = Outcome(status="completed", time=last, message=f"completed {last:g} s")
    return RunRecord(
        scenario=scenario,
        outcome=outcome,
        dataset=dataset,
        wall_time={
            "build": built - start,
            "advance_to": advanced - built,
            "total": time.perf_counter() - start,
        },
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


def _make_dataset(loop: ClosedLoop, loggers: dict[str, VectorLogSink], context: Context) -> "xr.Dataset":
    """The labelled time series of a run, from the logs (copied) and, for what follows from the state, the plant."""
    import xarray as xr

    scenario, coordinates = loop.scenario, loop.coordinates
    logs = {name: logger.FindLog(context) for name, logger in loggers.items()}
    series = {name: np.array(log.data().T) for name, log in logs.items()}
    times = np.array(logs["state"].sample_times())
    # Sample k of a held signal is its log entry k + 1; that of the last sample stands in the context.
    diagram_context = loop.diagram.GetMyContextFromRoot(context)
    for name in _HELD:
        if name in series:
            last = loop.diagram.GetOutputPort(name).Eval(diagram_context)
            series[name] = np.vstack([series[name][1:], last])
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
    error = np.array([position_error(q_d, q) for q_d, q in zip(desired_position, position, strict=True)])
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
        "error": (by_coordinate, error, "true tracking error e = q_d - q (rotation vector in world)", unit),
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
            "time": ("time", times, {"long_name": "control sample t_k", "units": "s"}),
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
