"""The scenario as a whole: every key as a setting (see ``common.settings``), its sections in the
files of their topics.

Values given per coordinate (gains, disturbances, joint angles) are mappings whose keys are ``all``,
a group (``base_rotation``, ``base_position``, ``joints``) or one coordinate's name; the more
specific key wins, and a bare number stands for ``{all: number}``.
"""

import math
import re
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any

from pydrake.systems.analysis import SimulatorConfig

from ffsm_drake.common.settings import Problems, setting
from ffsm_drake.scenario.actuation import DRIVEN, Actuation, Drives, Wheels
from ffsm_drake.scenario.blocks import Blocks
from ffsm_drake.scenario.capture import Approach, Capture, Closing
from ffsm_drake.scenario.contacts import Chain, Contact
from ffsm_drake.scenario.effects import Effects
from ffsm_drake.scenario.faults import Faults
from ffsm_drake.scenario.fields import (
    ZERO,
    PerCoordinate,
    controller_problems,
    policy_parts,
    unitless,
)
from ffsm_drake.scenario.forces import Disturbance, Environment
from ffsm_drake.scenario.layers import Layer, assembled, override_layers
from ffsm_drake.scenario.model import MassProperties, Model, Payload, Posture
from ffsm_drake.scenario.phases import own_phases, phase_problems
from ffsm_drake.scenario.reference import Planning, Reference
from ffsm_drake.scenario.resolving import as_dict
from ffsm_drake.scenario.sensing import CommandFilter, Estimator, Sensing
from ffsm_drake.scenario.supervisor import Supervisor
from ffsm_drake.scenario.target_sensing import Measured

FIXED_STEP_SCHEMES = ("explicit_euler", "runge_kutta2", "semi_explicit_euler")  # no error estimate
MAX_SAMPLES = 10_000_000
MAX_STEPS = 1_000_000_000  # integrator steps; hours
_BYTES_PER_SAMPLE = 4000  # size of a run's logs and record, for the estimate in an error


@dataclass(repr=False)
class Scenario:
    """The complete definition of one run, which ``load_scenario`` reads.

    Example:
      >>> from ffsm_drake import load_scenario
      >>> scenario = load_scenario("postcapture")
      >>> scenario.duration, scenario.controller, scenario.payload.truth.mass
      (20.0, 'tde_aismc', 100.0)
    """

    description: str = unitless("", "title of the scenario in plots, reports and records")
    random_seed: int = unitless(
        0,
        "seed of the measurement noise; the same seed gives the same bits",
        least=0,
        most=2**31 - 1,
    )
    duration: float = setting(
        20.0, "s", "duration of the run; the run ends at the last control sample within it", above=0
    )
    sample_time: float = setting(
        0.01, "s", "control period L, at which the controller runs", above=0
    )
    divergence_speed: float = setting(
        10.0,
        "rad/s or m/s",
        "generalized velocity above which the run is stopped as diverging",
        above=0,
    )
    tolerance: PerCoordinate = setting(
        {"all": 1e-3},
        "rad or m",
        "largest error in the last second of a run that counts as settled; 1e-3 for coordinates "
        "that are not given",
        above=0,
    )
    simulator_config: SimulatorConfig = setting(
        SimulatorConfig(
            integration_scheme="runge_kutta3",
            max_step_size=0.01,
            accuracy=1e-10,
            use_error_control=False,
        )
    )
    model: Model = setting(Model())
    payload: Payload = setting(Payload())
    initial_posture: Posture = setting(Posture())
    target_posture: Posture = setting(Posture())
    initial_velocity: PerCoordinate = setting(
        ZERO,
        "rad/s or m/s",
        "initial velocity; base_rotation is the angular velocity in world axes. The reference "
        "starts "
        "at rest, or with goal stop at this velocity. With a capture it starts at the velocity "
        "after "
        "a grasp of the nominal payload, and this is added to the true velocity.",
    )
    capture: Capture | None = unitless(
        None, "grasp of a moving target; null: the target is held and at rest at the start"
    )
    phases: list[Any] = unitless(
        [],
        "phases of a capture in their order, as names or {name: settings}: own phases, approach, "
        "close (with ``capture.closing``) and stop; empty: ``blocks.phases``, then these",
    )
    contacts: dict[str, Contact] = unitless(
        {}, "hands that hold the target, by any name; empty: only ``model.end_effector``"
    )
    chain: Chain = setting(Chain())
    reference: Reference = setting(Reference())
    planning: Planning = setting(Planning())
    clearance: float = setting(
        0.01,
        "m",
        "least distance between parts; plans keep it, and a run below it causes a warning",
        least=0,
    )
    controller: str = unitless(
        "tde_aismc",
        "control law: the name of a shipped one (`ffsm doctor` lists them) or of an installed one, "
        "module:attribute, or policy:FILE",
    )
    controllers: dict[str, dict[str, PerCoordinate | None]] = unitless(
        {},
        "gains by controller (its name, or the part after the colon), gain and coordinate; gains "
        "that are not given have their defaults; null removes an upper bound",
    )
    blocks: Blocks = setting(Blocks())
    python_path: list[str] = unitless(
        [],
        "folders in which modules of controllers and blocks are searched before Python's own; "
        "relative paths start at the folder of the scenario file",
    )
    estimator: Estimator = setting(Estimator())
    command_filter: CommandFilter = setting(CommandFilter())
    disturbance: Disturbance = setting(Disturbance())
    environment: Environment | None = unitless(
        None, "forces of an orbit, recorded as force_environment; null: none"
    )
    sensing: Sensing = setting(Sensing())
    actuation: Actuation = setting(Actuation())
    supervisor: Supervisor | None = unitless(
        None, "rate damping and a new plan if the plan cannot be followed; null: none"
    )
    effects: Effects = setting(Effects())
    faults: Faults | None = unitless(None, "faults of units, and their detection; null: none")

    def __post_init__(self) -> None:
        if self.sample_time > 0.0:
            self.sensing = self.sensing.at(self.sample_time)
        if self.phases:
            self.blocks = replace(self.blocks, phases=own_phases(self.phases))

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """Check for at least one sample, and not too many samples and steps."""
        samples, config = self.duration / self.sample_time, self.simulator_config
        if samples > MAX_SAMPLES:
            yield (
                "sample_time" if self.duration < 1000.0 else "duration",
                f"{self.duration:g} s in samples of {self.sample_time:g} s are {samples:.3g}, "
                f"about {samples * _BYTES_PER_SAMPLE / 1e9:.3g} GB; at most {MAX_SAMPLES} are run: "
                "shorten duration or lengthen sample_time",
            )
        elif self.num_control_periods < 1:
            yield (
                "sample_time",
                f"{self.sample_time:g} s is longer than duration, {self.duration:g} s; shorten "
                "sample_time or lengthen duration",
            )
        if (self.reference.duration or 0.0) > (most := 100 * MAX_SAMPLES * self.sample_time):
            yield "reference.duration", f"must be at most {most:g} s"
        if config.use_error_control and config.integration_scheme in FIXED_STEP_SCHEMES:
            yield (
                "simulator_config.use_error_control",
                f"{config.integration_scheme} has no error estimate; set false, or choose another "
                "integration_scheme",
            )
        if config.start_time != 0:
            yield (
                "simulator_config.start_time",
                "must be 0, because every run starts at 0; remove it",
            )
        steps = self.duration / config.max_step_size
        if steps > MAX_STEPS:
            yield (
                "simulator_config.max_step_size",
                f"{config.max_step_size:g} s gives {steps:.3g} steps in {self.duration:g} s; at "
                f"most {MAX_STEPS} are run",
            )
        for name, number in self.initial_velocity.items():
            if abs(number) > self.divergence_speed:
                yield (
                    f"initial_velocity.{name}",
                    f"must be within divergence_speed ({self.divergence_speed:g}), not {number}",
                )
        yield from controller_problems(self.controller, "controller")
        if self.phases:
            yield from phase_problems(self.phases, self)

    def __repr__(self) -> str:
        title = f"'{self.description}', " if self.description else ""
        return f"Scenario({title}{self.controller}, {self.duration:g} s, seed {self.random_seed})"

    def replace(self, **changes: Any) -> "Scenario":
        """Return a new scenario with some settings changed; this one is unchanged.

        Args:
          changes: by key, as in a file that extends this scenario: mappings merge
            (``payload={"truth": {"mass": 80}}``), lists replace.

        Raises:
          ScenarioError: a key or a value cannot be used.
        """
        layers = [Layer(as_dict(self), ""), *override_layers([changes])]
        return assembled(Scenario, layers)

    @property
    def num_control_periods(self) -> int:
        """Number of whole control periods within the duration."""
        return math.floor(self.duration / self.sample_time + 1e-9)

    @property
    def driven(self) -> tuple[str, ...]:
        """The groups of coordinates that actuators move."""
        given = self.actuation.driven
        return tuple(group for group in DRIVEN[0] if group in given or "all" in given)

    @property
    def undriven(self) -> tuple[str, ...]:
        """The groups of coordinates that only conservation of momentum moves."""
        return tuple(group for group in DRIVEN[0] if group not in self.driven)

    @property
    def postures(self) -> dict[str, Posture]:
        """Every posture that the scenario gives, by key."""
        found = {"initial_posture": self.initial_posture, "target_posture": self.target_posture}
        if self.approach is not None:
            found["capture.approach.posture"] = self.approach.posture
        return found

    @property
    def wheels(self) -> Wheels | None:
        """The wheels of the scenario's own actuators."""
        return None if self.blocks.actuation else self.actuation.wheels

    @property
    def drives(self) -> Drives | None:
        """The drives of the scenario's own actuators."""
        return None if self.blocks.actuation else self.actuation.drives

    @property
    def stops_from_start(self) -> bool:
        """Whether the reference begins at ``initial_velocity`` and brings it to rest."""
        reference = self.reference
        is_polynomial = reference.kind != "optimal"
        return not self.grasps and reference.goal == "stop" and is_polynomial

    @property
    def starts_moving(self) -> bool:
        """Whether the reference begins at a velocity: after a grasp, or ``stops_from_start``."""
        return self.grasps or self.stops_from_start

    @property
    def grasps(self) -> bool:
        """Whether a moving target is grasped, at ``grasp_time``."""
        return self.capture is not None

    @property
    def controller_key(self) -> str:
        """Key of the controller in ``controllers``."""
        return controller_key(self.controller)

    @property
    def gains(self) -> dict[str, Any]:
        """Settings of the controller, as given in ``controllers``."""
        return self.controllers.get(self.controller_key, {})

    def with_gains(self, gains: dict[str, Any]) -> "Scenario":
        """Return the scenario with other settings of its controller."""
        controllers = {**self.controllers, self.controller_key: gains}
        return replace(self, controllers=controllers)

    @property
    def grasp_time(self) -> float:
        """Time of the grasp, s; 0 for a target held from the start."""
        if self.approach is None:
            return 0.0
        before = (each.duration for each in self.blocks.phases.values())
        return sum(before, self.approach.duration)

    @property
    def approach(self) -> Approach | None:
        """The motion up to the grasp; None: the target is held from the start."""
        return None if self.capture is None else self.capture.approach

    @property
    def closing(self) -> Closing | None:
        """The closing of the gripper after an approach; None: it closes at once."""
        return None if self.capture is None or self.approach is None else self.capture.closing

    @property
    def measured(self) -> Measured | None:
        """The measurement of the target during the approach; None: its motion is known."""
        return None if self.capture is None or self.approach is None else self.capture.measured

    @property
    def planned_end(self) -> float | None:
        """End of the planned motion, s; None if not yet determined."""
        return (
            None if self.reference.duration is None else self.grasp_time + self.reference.duration
        )

    def tolerance_of(self, *names: str) -> float:
        """Return the tolerance under the first known of several names (a coordinate's own, its
        group's).
        """
        return next(
            (self.tolerance[name] for name in (*names, "all") if name in self.tolerance), 1e-3
        )


# Settings without influence on a planned motion with the nominal payload.
_OF_THE_RUN = (
    "description",
    "random_seed",
    "tolerance",
    "simulator_config",
    "initial_velocity",
    "controller",
    "controllers",
    "python_path",
    "estimator",
    "command_filter",
    "disturbance",
    "environment",
    "sensing",
    "supervisor",
    "faults",
    "effects",
)


def planned_part(scenario: Scenario, *, with_target: bool = False) -> Scenario:
    """Return the scenario with defaults for all settings without influence on its planned motion,
    or on the target's before a grasp (``with_target``), which a clear start depends on.

    Runs that differ in nothing else, such as those of several controllers, share the results
    computed from it.
    """
    plain, truth, approach = Scenario(), MassProperties(), scenario.approach
    with_target = approach is not None and (with_target or approach.start == "clear")
    if with_target:
        truth = scenario.payload.truth
    elif scenario.grasps:
        truth.center_of_mass = scenario.payload.truth.center_of_mass
    payload = replace(scenario.payload, truth=truth)
    changes = {name: getattr(plain, name) for name in _OF_THE_RUN}
    if scenario.stops_from_start:
        del changes["initial_velocity"]
    if with_target:
        del changes["environment"]
    return replace(scenario, payload=payload, **changes)


def controller_key(controller: str) -> str:
    """Return the key in ``controllers`` of a controller: its name, the part after the colon of
    ``module:attribute``, or the file name of ``policy:FILE`` without ending, with underscores for
    characters other than letters, digits and dashes.
    """
    policy = policy_parts(controller)
    if policy is None:
        return controller.rpartition(":")[2]
    return re.sub(r"[^\w-]", "_", PurePath(policy[0]).stem)
