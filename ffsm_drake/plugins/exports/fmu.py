"""A scenario's plant as an FMU (FMI 3.0, co-simulation) for other simulators.

A step is one control sample. At each sample t_k a master takes the plant's outputs to the law,
steps the law, takes its force to the plant, and steps the plant: the force of a sample follows from
the measurement of the same sample. Needs ``pip install 'ffsm-drake[fmu]'``; the FMU runs in the
Python of its host, which must have this package.
"""

import abc
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from ffsm_drake.common.aside import Aside
from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.common.files import check_writable, written_whole
from ffsm_drake.common.plugins import service
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.rollout import Leg, Rollout
from ffsm_drake.scenario import Scenario, load_scenario, scenario_to_yaml
from ffsm_drake.scenario.contacts import closing_times
from ffsm_drake.spacecraft.nominal import make_nominal_plant
from ffsm_drake.systems.controllers import ControlLaw
from ffsm_drake.systems.controllers.law import Sample, State

try:
    from pythonfmu3 import (
        DefaultExperiment,
        Float64,
        Fmi3Causality,
        Fmi3Initial,
        Fmi3Slave,
        Fmi3Status,
        Fmi3StepResult,
        Fmi3Variability,
        FmuBuilder,
        Int64,
    )
except ImportError as _error:
    raise FfsmError("an FMU needs pythonfmu3: pip install 'ffsm-drake[fmu]'") from _error

_SCENARIO_FILE = "scenario.yaml"
_SCRIPT = """from pythonfmu3 import Fmi3Slave

from ffsm_drake.plugins.exports.fmu import PlantSlave


class FfsmPlant(PlantSlave, Fmi3Slave):
    pass
"""
# inputs of the law: name in a Sample -> name of the variables
_POSITIONS = {"q": "measured_position", "q_d": "desired_position"}
_VELOCITIES = {
    "v": "measured_velocity",
    "v_d": "desired_velocity",
    "a_d": "desired_acceleration",
    "e": "error",
    "e_dot": "error_rate",
    "applied_force": "applied_force",
}


def export(
    scenario: Scenario, path: Path, part: str = "plant", float32: bool = False, table: bool = False
) -> list[str]:
    """Write the FMU of a scenario's plant, or of its control law (``part="controller"``).

    Args: as of ``flight.fmu.write_fmu``.

    Raises: FfsmError, for the plant of a scenario with a capture or a late hand, or a law that
    cannot be exported as C.
    """
    if part == "controller":
        lines: list[str] = service("law_fmu", "--part controller")(
            scenario, path, float32=float32, table=table
        )
        return lines
    if float32 or table:
        raise FfsmError("--float32, --table: only for --part controller")
    if scenario.capture is not None:
        raise FfsmError("capture: a scenario with a capture cannot be an FMU; leave it out")
    if len(closing_times(scenario)) > 1:
        raise FfsmError("contacts: hands that close later cannot be in an FMU; leave closes out")
    check_writable(path.parent)
    with written_whole(path) as temporary, tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        script, text = folder / "ffsm_plant.py", folder / _SCENARIO_FILE
        script.write_text(_SCRIPT)
        text.write_text(scenario_to_yaml(scenario))
        options = {"canHandleVariableCommunicationStepSize": "false"}
        built = FmuBuilder.build_FMU(script, dest=folder / "built", project_files=[text], **options)
        temporary.write_bytes(built.read_bytes())
    return [str(path)]


class _Slave(Fmi3Slave):
    """Variables of both parts; ``values`` (n) by group, such as ``measured_position``."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.file = Path(str(self.resources).removeprefix("file://")) / _SCENARIO_FILE
        self.scenario = load_scenario(self.file)
        self.coordinates = make_nominal_plant(self.scenario).coordinates
        self.description = self.scenario.description
        self.default_experiment = DefaultExperiment(
            start_time=0.0, stop_time=self.scenario.duration, step_size=self.scenario.sample_time
        )
        self.time, self._steps = 0.0, 0
        self.register_variable(
            Float64(
                "time",
                causality=Fmi3Causality.independent,
                variability=Fmi3Variability.continuous,
            )
        )
        self.values = dict[str, np.ndarray]()
        positions, velocities = self.coordinates.position_names, self.coordinates.names
        self.groups = dict.fromkeys(_POSITIONS.values(), tuple(positions))
        self.groups |= dict.fromkeys(_VELOCITIES.values(), tuple(velocities))
        self.groups["is_new_position"] = self.groups["is_new_velocity"] = tuple(velocities)

    def add(self, group: str, names: tuple[str, ...], causality: Any, start: float = 0.0) -> None:
        """Register the variables of a group."""
        values = self.values[group] = np.full(len(names), start)
        for index, name in enumerate(names):
            self.register_variable(
                Float64(
                    f"{group}.{name}",
                    causality=causality,
                    variability=Fmi3Variability.discrete,
                    getter=lambda i=index: float(values[i]),
                    setter=lambda value, i=index: values.__setitem__(i, value),
                ),
                nested=False,
            )

    @abc.abstractmethod
    def advance(self) -> bool:
        """Advance by one control sample; False if the run ended."""

    def do_step(self, current_time: float, step_size: float) -> Any:
        """Advance by one control sample from the end of the last; any other step is an error
        without effect.
        """
        try:
            self._check_step(current_time, step_size)
            goes_on = self.advance()
        except Exception as error:  # raised, it would end the host when it calls again
            self.log(one_line(error), Fmi3Status.error)
            return Fmi3StepResult(status=Fmi3Status.error)
        self._steps += 1
        return Fmi3StepResult(status=Fmi3Status.ok, terminateSimulation=not goes_on)

    def _check_step(self, current_time: float, step_size: float) -> None:
        period = self.scenario.sample_time
        if not abs(step_size - period) <= 1e-9:  # also for NaN
            problem = f"must be one control sample, {period:g} s, not {step_size:g}"
            raise FfsmError(f"a step {problem}")
        begin = self._steps * period
        if not abs(current_time - begin) <= 1e-3 * period:
            raise FfsmError(f"this step must begin at t = {begin:g} s, not {current_time:g}")


class _Course(ControlLaw):
    """The run of a plant, and its law, whose force the master gives; it outlives no slave, and
    refers to none.
    """

    def __init__(self) -> None:
        self.aside = Aside()
        self.loop: tuple[ClosedLoop, Context] | None = None

    def begin(self, loop: ClosedLoop, context: Context) -> None:
        """Keep the diagram of a run that begins."""
        self.loop = loop, context

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        """Ask for the force at a sample; within the run's thread."""
        assert self.loop is not None
        loop, context = self.loop
        return self.aside.ask((sample, loop.whole_state(context).copy())), state


class PlantSlave(_Slave):
    """All but the law: spacecraft, actuators, sensors, forces, reference."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.payload_mass = self.scenario.payload.truth.mass
        self.seed = self.scenario.random_seed
        fixed = {
            "causality": Fmi3Causality.parameter,
            "variability": Fmi3Variability.fixed,
            "initial": Fmi3Initial.exact,
        }
        self.register_variable(Float64("payload_mass", **fixed))
        self.register_variable(Int64("seed", **fixed))
        velocities = tuple(self.coordinates.names)
        self.add("force", velocities, Fmi3Causality.input)
        self.add("position", tuple(self.coordinates.position_names), Fmi3Causality.output)
        self.add("velocity", velocities, Fmi3Causality.output)
        for group, names in self.groups.items():
            self.add(group, names, Fmi3Causality.output)
        self._course = _Course()

    def exit_initialization_mode(self) -> None:
        """Begin the run; outputs are those of the first sample."""
        changed = (f"payload.truth.mass={self.payload_mass!r}", f"random_seed={self.seed}")
        scenario = load_scenario(self.file, changed)
        course = self._course
        rollout = Rollout(scenario, blocks={"controller": lambda setup: course})

        def run() -> RunLog:
            return rollout.run(leg=Leg(begin=course.begin))

        course.aside.start(run, rollout.release, owner=self)
        self._take()

    def _take(self) -> bool:
        """Wait for the run's next sample, or its end; false there."""
        found = self._course.aside.take()
        if isinstance(found, RunLog):
            self._show(found.whole_states[-1])
            return False
        sample, state = found
        self._show(state)
        for name, group in (_POSITIONS | _VELOCITIES).items():
            self.values[group][:] = getattr(sample, name)
        new = np.ones(2 * len(self.coordinates.names)) if sample.is_new is None else sample.is_new
        self.values["is_new_position"][:], self.values["is_new_velocity"][:] = np.split(new, 2)
        return True

    def _show(self, state: np.ndarray) -> None:
        """Output the true state, without flexible coordinates."""
        assert self._course.loop is not None
        shown = self._course.loop[0].split.known_part(state)
        size = self.values["position"].size
        self.values["position"][:] = shown[:size]
        self.values["velocity"][:] = shown[size:]

    def advance(self) -> bool:
        if not self._course.aside.goes_on:
            raise FfsmError("the run has ended")
        self._course.aside.answer(self.values["force"].copy())
        return self._take()

    def terminate(self) -> None:
        self._course.aside.stop()
