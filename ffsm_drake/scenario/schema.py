"""The scenario: everything that defines a run, as plain data with units. Loading, overriding, validating.

A scenario is resolved in three layers, later ones winning: the defaults written here, the YAML file, the overrides
(``key=value``). Values given per coordinate (gains, disturbances, joint angles) are mappings whose keys are ``all``, a
group (``base_rotation``, ``base_position``, ``joints``) or one coordinate's name; the more specific key wins, and a
bare number stands for ``{all: number}``.
"""

import dataclasses
import math
import re
import types
import typing
from collections.abc import Iterable, Mapping
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import yaml
from pydrake.systems.analysis import GetIntegrationSchemes, SimulatorConfig

from ffsm_drake.common.errors import ScenarioError, did_you_mean, one_line
from ffsm_drake.scenario.strict_yaml import StrictYamlError, read_yaml

_MODULE_AND_ATTRIBUTE = re.compile(r"[^\W\d]\w*(\.\w+)*:[^\W\d]\w*(\.\w+)*")
PerCoordinate = dict[str, float]
ESTIMATOR_KINDS = ("one_sample", "kalman")
CONTROLLER_NAMES = ("tdc", "asmc", "aismc", "tde_aismc")
ENTRY_POINT_GROUP = "ffsm_drake.controllers"  # where installed packages offer further controllers
FIXED_STEP_SCHEMES = ("explicit_euler", "runge_kutta2", "semi_explicit_euler")  # without an error estimate
MAX_FILE_SIZE = 1_000_000  # bytes
MAX_NUMBER = 1e20  # so that what is computed from a few values stays finite
MAX_SAMPLES = 10_000_000
MAX_STEPS = 1_000_000_000  # of the integrator; hours
_BYTES_PER_SAMPLE = 4000  # of a run's logs and record, for the estimate in an error


def _published(**values: float) -> PerCoordinate:
    return dataclasses.field(default_factory=lambda: dict(values))


@dataclasses.dataclass
class Model:
    """What flies: the models, and the frames that the reports speak of.

    Files are package:// addresses or paths; relative paths start at the scenario file's folder.
    """

    directives: str | None = "package://ffsm_drake/postcapture.dmd.yaml"  # model directives; or give servicer
    servicer: str | None = None  # instead of directives: URDF of base and arm, model instance "servicer"
    debris: str = "package://ffsm_drake/urdf/debris.urdf"  # with servicer: URDF of the target, instance "debris"
    end_effector: str = "servicer::end_effector"  # frame that holds the target; its origin is reported
    grasp: str = "debris::grasp"  # with servicer: the target's frame that is welded to end_effector
    packages: dict[str, str] = dataclasses.field(default_factory=dict)  # package:// name -> folder, for meshes


@dataclasses.dataclass
class MassProperties:
    """Mass properties of the payload body, in its own frame P."""

    mass: float = 100.0  # kg; mass
    # m; position p_PScm_P of the centre of mass
    center_of_mass: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    # kg m^2; about the centre of mass, axes of P: [Ixx, Iyy, Izz] or [Ixx, Iyy, Izz, Ixy, Ixz, Iyz]
    inertia: list[float] = dataclasses.field(default_factory=lambda: [16.7, 16.7, 16.7])


@dataclasses.dataclass
class Payload:
    """The captured body: as it is, and as the controller believes it to be."""

    body: str = "debris::debris"  # scoped name of the captured body in the model
    truth: MassProperties = dataclasses.field(default_factory=MassProperties)
    belief: MassProperties = dataclasses.field(
        default_factory=lambda: MassProperties(mass=80.0, inertia=[12.0, 12.0, 12.0])
    )


@dataclasses.dataclass
class Posture:
    """A configuration of base and arm."""

    base_position: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])  # m; position p_WB
    # rad; roll, pitch, yaw of R_WB: rotations about the world's x, y, z axes in that order
    base_rpy: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    joints: PerCoordinate = _published(all=0.0)  # rad or m; positions, by joint name


@dataclasses.dataclass
class Reference:
    """The planned motion: a fifth-order polynomial from the initial to the target posture."""

    duration: float = 20.0  # s; the target posture is held afterwards


@dataclasses.dataclass
class TdcGains:
    """Time-delay control, equation (17)."""

    k_d: PerCoordinate = _published(all=100.0)  # 1/s; gain K_D on the error's rate
    k_p: PerCoordinate = _published(all=100.0, base_position=200.0)  # 1/s^2; gain K_P on the error


@dataclasses.dataclass
class AsmcGains:
    """Adaptive sliding-mode control, equations (18) and (19)."""

    k_d: PerCoordinate = _published(all=100.0)  # 1/s; gain K_D on the error's rate
    k_s: PerCoordinate = _published(all=80.0)  # 1/s; reaching gain K_s, constant
    # rad/s^2 or m/s^2; switching gain G at the start; (19) has a branch of its own for zero
    g_initial: PerCoordinate = _published(all=0.0)
    epsilon: float = 1e-4  # rad/s or m/s; bound on the sliding variable that switches the adaptation's sign
    a: PerCoordinate = _published(all=1e-6, base_position=1e-7)  # rad/s^3 or m/s^3; adaptation rate, (19)'s phi
    b: PerCoordinate = _published(all=1e5)  # s/rad or s/m; adaptation scale, (19)'s 1/alpha
    g_max: PerCoordinate | None = None  # rad/s^2 or m/s^2; upper bound of G; null: unbounded


@dataclasses.dataclass
class AismcGains:
    """Adaptive integral sliding-mode control, equations (20) and (21)."""

    k_d: PerCoordinate = _published(all=100.0)  # 1/s; gain K_D on the error's rate
    k_p: PerCoordinate = _published(all=100.0, base_position=200.0)  # 1/s^2; gain K_P on the error
    # 1/s; reaching gain K_s at the start; the published 80 without bound adapts itself out of the sampled loop's
    # stability on an exact plant
    k_s_initial: PerCoordinate = _published(all=60.0)
    # 1/(rad s) or 1/(m s); rate of K_s
    alpha: PerCoordinate = _published(base_position=3e4, base_rotation=18e4, joints=9e4)
    # 1/(rad s) or 1/(m s); accuracy scale of K_s, which rests at |s| = K_s^2 / beta
    beta: PerCoordinate = _published(base_position=4e7, base_rotation=24e7, joints=12e7)
    k_s_max: PerCoordinate | None = _published(all=70.0)  # 1/s; upper bound of K_s; null: unbounded


@dataclasses.dataclass
class TdeAismcGains(AismcGains):
    """The proposed controller, equations (6), (9) and (10)."""

    # 1/rad or 1/m; accuracy scale of K_s, which rests at |s| = K_s / beta
    beta: PerCoordinate = _published(base_position=4e7, base_rotation=24e7, joints=12e7)
    g_initial: PerCoordinate = _published(all=2e-4)  # rad/s^2 or m/s^2; switching gain G at the start
    epsilon: float = 1e-4  # rad/s or m/s; bound on the sliding variable that switches the adaptation's sign
    phi: PerCoordinate = _published(all=1e-1, base_position=1e-2)  # 1/s^2; rate of G
    g_max: PerCoordinate | None = None  # rad/s^2 or m/s^2; upper bound of G; null: unbounded


@dataclasses.dataclass
class Controllers:
    """The settings of every controller; ``Scenario.controller`` names the one in use."""

    tdc: TdcGains = dataclasses.field(default_factory=TdcGains)
    asmc: AsmcGains = dataclasses.field(default_factory=AsmcGains)
    aismc: AismcGains = dataclasses.field(default_factory=AismcGains)
    tde_aismc: TdeAismcGains = dataclasses.field(default_factory=TdeAismcGains)
    # gains of controllers that come from elsewhere: name (its part after the colon) -> gain -> by coordinate
    own: dict[str, dict[str, PerCoordinate]] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass
class Estimator:
    """How the controller estimates the lumped uncertainty N of equation (2)."""

    kind: str = "one_sample"  # the paper's (5), or "kalman"
    # rad/s^2 or m/s^2 per sqrt(s); kalman only: N's random walk, its standard deviation after one second
    walk: PerCoordinate = _published(base_position=1e-3, base_rotation=1e-3, joints=1e-2)
    # rad or m; kalman only: standard deviation that it assumes of the positions; null: that of ``sensing``
    position_noise: PerCoordinate | None = None
    # rad/s or m/s; kalman only: standard deviation that it assumes of the velocities; null: that of ``sensing``
    velocity_noise: PerCoordinate | None = None


@dataclasses.dataclass
class Harmonic:
    """One coordinate's disturbance, ``amplitude * sin(frequency * t + phase) + bias``."""

    amplitude: float = 0.0  # N m or N; amplitude
    frequency: float = 0.0  # rad/s; angular frequency
    phase: float = 0.0  # rad; phase
    bias: float = 0.0  # N m or N; constant part


@dataclasses.dataclass
class Disturbance:
    """External generalized force tau_d on the plant (Table 1)."""

    amplitude_scale: float = 1.0  # multiplies amplitudes and biases
    frequency_scale: float = 1.0  # multiplies frequencies
    harmonics: dict[str, Harmonic] = dataclasses.field(default_factory=dict)  # harmonics, by coordinate or group


@dataclasses.dataclass
class Sensing:
    """What the sensors add to the true state: bias, white noise, quantisation, delay, in that order."""

    # rad/s or m/s; standard deviation of the velocities' noise, independent for each coordinate and control sample
    velocity_noise: PerCoordinate = _published(all=1e-6)
    # rad or m; standard deviation of the positions' noise, likewise; the same for the three base rotations
    position_noise: PerCoordinate = _published(all=0.0)
    velocity_bias: PerCoordinate = _published(all=0.0)  # rad/s or m/s; constant error of the velocities
    # rad or m; constant error of the positions; base rotations: a rotation vector in the world frame
    position_bias: PerCoordinate = _published(all=0.0)
    velocity_quantization: PerCoordinate = _published(all=0.0)  # rad/s or m/s; step of the velocities; 0: none
    # rad or m; step of the positions, not for base rotations; 0: none
    position_quantization: PerCoordinate = _published(all=0.0)
    delay: int = 0  # control samples; age of a measurement when the controller reads it


@dataclasses.dataclass
class Actuation:
    """What the actuators make of the commanded force: saturation, quantisation, delay, in that order."""

    limit: PerCoordinate | None = None  # N m or N; largest force either way; null: unlimited
    quantization: PerCoordinate = _published(all=0.0)  # N m or N; step of the force; 0: none
    delay: int = 0  # control samples; age of a command when it acts


def _default_simulator_config() -> SimulatorConfig:
    return SimulatorConfig(
        integration_scheme="runge_kutta3", max_step_size=0.01, accuracy=1e-10, use_error_control=False
    )


@dataclasses.dataclass
class Scenario:
    """One run of the closed loop, whole."""

    description: str = ""  # title of plots and records
    random_seed: int = 0  # seed of the measurement noise; the same seed gives the same bits
    duration: float = 20.0  # s; the run ends at the last control sample within it
    sample_time: float = 0.01  # s; L, the controller's period and delay
    # rad/s or m/s; the run is stopped as diverging when a generalized velocity exceeds this
    divergence_speed: float = 10.0
    simulator_config: SimulatorConfig = dataclasses.field(default_factory=_default_simulator_config)
    model: Model = dataclasses.field(default_factory=Model)
    payload: Payload = dataclasses.field(default_factory=Payload)
    initial_posture: Posture = dataclasses.field(default_factory=Posture)
    target_posture: Posture = dataclasses.field(default_factory=Posture)
    # At the start, rad/s or m/s; base_rotation is the angular velocity in world axes. The reference starts at rest.
    initial_velocity: PerCoordinate = _published(all=0.0)
    reference: Reference = dataclasses.field(default_factory=Reference)
    # tdc, asmc, aismc, tde_aismc, an installed one (such as pd_plus, computed_torque), or module:Class
    controller: str = "tde_aismc"
    controllers: Controllers = dataclasses.field(default_factory=Controllers)
    estimator: Estimator = dataclasses.field(default_factory=Estimator)
    disturbance: Disturbance = dataclasses.field(default_factory=Disturbance)
    sensing: Sensing = dataclasses.field(default_factory=Sensing)
    actuation: Actuation = dataclasses.field(default_factory=Actuation)

    @property
    def num_control_periods(self) -> int:
        """Number of whole control periods within the duration."""
        return math.floor(self.duration / self.sample_time + 1e-9)


def shipped_scenarios() -> dict[str, Path]:
    """The scenarios that ship with the package: name -> file."""
    return {path.stem: path for path in sorted((Path(__file__).parent / "shipped").glob("*.yaml"))}


def load_scenario(name_or_path: str | Path, overrides: Iterable[str] = ()) -> Scenario:
    """Load a scenario by shipped name or file path, apply overrides, validate.

    Args:
      name_or_path: a name of ``shipped_scenarios()``, or the path of a YAML file.
      overrides: ``key=value`` strings; the key is dotted, the value is YAML (``controllers.tdc.k_d.joint_1=50``).

    Raises:
      ScenarioError: the file, a key or a value cannot be used; the message says where and what would be right.
    """
    path = _find(str(name_or_path))
    try:
        if path.stat().st_size > MAX_FILE_SIZE:
            raise ScenarioError(
                "", f"larger than {MAX_FILE_SIZE} bytes: not a scenario; give a YAML file", source=str(path)
            )
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ScenarioError("", f"is not UTF-8 text ({one_line(error)})", source=str(path)) from error
    except OSError as error:
        raise ScenarioError("", f"cannot be read: {one_line(error)}", source=str(path)) from error
    return scenario_from_yaml(text, overrides, source=str(path))


def scenario_from_yaml(text: str, overrides: Iterable[str] = (), *, source: str = "") -> Scenario:
    """Build a scenario from YAML text; ``source`` is the file name used in errors and for relative model paths."""
    try:
        data = read_yaml(text)
    except StrictYamlError as error:
        raise ScenarioError("", f"is not valid YAML: {one_line(error)}", source=source) from error
    if isinstance(data, dict):  # at the top, names with an underscore hold what aliases refer to
        data = {key: value for key, value in data.items() if not (isinstance(key, str) and key.startswith("_"))}
    return scenario_from_dict({} if data is None else data, overrides, source=source)


def scenario_from_dict(data: Mapping[str, typing.Any], overrides: Iterable[str] = (), *, source: str = "") -> Scenario:
    """Build a scenario from plain data (as read from YAML or JSON)."""
    try:
        resolved = _resolve(Scenario, _as_dict(Scenario()), data, "")
        _choose_model_source(resolved["model"], data.get("model") or {})
    except ScenarioError as error:
        raise error.located(source) from None
    _anchor_relative_paths(resolved["model"], Path(source).parent if source else None)
    overridden = []
    for override in overrides:
        try:
            overridden.append(_apply_override(resolved, override))
        except ScenarioError as error:
            raise error.located("override") from None
    scenario: Scenario = _build(Scenario, resolved)
    try:
        validate(scenario)
    except ScenarioError as error:
        raise error.located("override" if is_overridden(error.key, overridden) else source) from None
    return scenario


def is_overridden(key: str, overridden: Iterable[str]) -> bool:
    """Whether a key is one of the overridden ones, stands within one, or holds one."""

    def within(inner: str, outer: str) -> bool:
        return inner == outer or inner.startswith((f"{outer}.", f"{outer}["))

    return any(within(key, other) or within(other, key) for other in overridden)


def scenario_to_dict(scenario: Scenario) -> dict[str, typing.Any]:
    """The whole scenario as plain data: what ``scenario_from_dict`` takes back unchanged."""
    data: dict[str, typing.Any] = _as_dict(scenario)
    return data


def scenario_to_yaml(scenario: Scenario) -> str:
    """The whole scenario as YAML text: what ``load_scenario`` reads back from a file."""
    text: str = yaml.safe_dump(scenario_to_dict(scenario), sort_keys=False)
    return text


def override_scenario(scenario: Scenario, overrides: Iterable[str]) -> Scenario:
    """A new scenario with ``key=value`` overrides applied; the given one is left as it is."""
    return scenario_from_dict(scenario_to_dict(scenario), overrides)


def validate(scenario: Scenario) -> None:
    """Check every value that can be judged without building the plant; raise ScenarioError naming the key."""
    _require(0 <= scenario.random_seed < 2**31, "random_seed", "must be from 0 to 2147483647")
    _require(scenario.duration > 0, "duration", "must be > 0 s")
    _require(scenario.sample_time > 0, "sample_time", "must be > 0 s")
    samples = scenario.duration / scenario.sample_time
    _require(
        samples <= MAX_SAMPLES,
        "sample_time" if scenario.duration < 1000.0 else "duration",
        f"{scenario.duration:g} s in samples of {scenario.sample_time:g} s are {samples:.3g}, about "
        f"{samples * _BYTES_PER_SAMPLE / 1e9:.3g} GB; at most {MAX_SAMPLES} are run: shorten duration or lengthen "
        "sample_time",
    )
    _require(scenario.num_control_periods >= 1, "sample_time", f"must be at most duration ({scenario.duration} s)")
    _require(scenario.divergence_speed > 0, "divergence_speed", "must be > 0")
    _require(scenario.reference.duration > 0, "reference.duration", "must be > 0 s")
    if scenario.controller not in CONTROLLER_NAMES and not _MODULE_AND_ATTRIBUTE.fullmatch(scenario.controller):
        known = CONTROLLER_NAMES + tuple(sorted(entry_points(group=ENTRY_POINT_GROUP).names))
        _require(
            scenario.controller in known,
            "controller",
            f"'{scenario.controller}' is unknown; choose one of {', '.join(known)}, or give module:Class"
            + did_you_mean(scenario.controller, known),
        )
    _require(
        scenario.estimator.kind in ESTIMATOR_KINDS,
        "estimator.kind",
        f"'{scenario.estimator.kind}' is unknown; choose one of {', '.join(ESTIMATOR_KINDS)}"
        + did_you_mean(scenario.estimator.kind, ESTIMATOR_KINDS),
    )
    for key, number in scenario.estimator.walk.items():
        _require(number > 0, f"estimator.walk.{key}", f"must be > 0, not {number}")
    for name in ("position_noise", "velocity_noise"):
        for key, number in (getattr(scenario.estimator, name) or {}).items():
            _require(number >= 0, f"estimator.{name}.{key}", f"a standard deviation must be >= 0, not {number}")
    _validate_simulator_config(scenario)
    for name in ("truth", "belief"):
        _validate_mass_properties(getattr(scenario.payload, name), f"payload.{name}")
    for name in ("initial_posture", "target_posture"):
        posture = getattr(scenario, name)
        for field in ("base_position", "base_rpy"):
            _require(len(getattr(posture, field)) == 3, f"{name}.{field}", "must hold three numbers [x, y, z]")
    for key, number in scenario.initial_velocity.items():
        _require(
            abs(number) <= scenario.divergence_speed,
            f"initial_velocity.{key}",
            f"must be within divergence_speed ({scenario.divergence_speed:g}), not {number}",
        )
    _require(scenario.disturbance.frequency_scale >= 0, "disturbance.frequency_scale", "must be >= 0")
    for name in CONTROLLER_NAMES:
        gains = getattr(scenario.controllers, name)
        for gain_field in dataclasses.fields(gains):
            value = getattr(gains, gain_field.name)
            for key, number in value.items() if isinstance(value, dict) else (("", value),):
                path = ".".join(part for part in (f"controllers.{name}.{gain_field.name}", key) if part)
                positive = gain_field.name in ("beta", "b", "epsilon")
                _require(number is None or number >= 0, path, f"must be >= 0, not {number}")
                _require(not positive or number > 0, path, "must be > 0")
    for name in ("velocity_noise", "position_noise"):
        for key, number in getattr(scenario.sensing, name).items():
            _require(number >= 0, f"sensing.{name}.{key}", f"a standard deviation must be >= 0, not {number}")
    for name in ("velocity_quantization", "position_quantization"):
        for key, number in getattr(scenario.sensing, name).items():
            _require(number >= 0, f"sensing.{name}.{key}", f"must be >= 0 (0: none), not {number}")
    for key, number in (scenario.actuation.limit or {}).items():
        _require(number > 0, f"actuation.limit.{key}", f"must be > 0, not {number}")
    for key, number in scenario.actuation.quantization.items():
        _require(number >= 0, f"actuation.quantization.{key}", f"must be >= 0 (0: none), not {number}")
    for place, delay in (("sensing", scenario.sensing.delay), ("actuation", scenario.actuation.delay)):
        _require(0 <= delay <= 1000, f"{place}.delay", f"must be from 0 to 1000 control samples, not {delay}")


def _validate_simulator_config(scenario: Scenario) -> None:
    # Drake's "cenic" wants the plant at the top of the diagram.
    config, schemes = scenario.simulator_config, [name for name in GetIntegrationSchemes() if name != "cenic"]
    _require(
        config.integration_scheme in schemes,
        "simulator_config.integration_scheme",
        f"'{config.integration_scheme}' is unknown; choose one of {', '.join(schemes)}"
        + did_you_mean(config.integration_scheme, schemes),
    )
    _require(
        not config.use_error_control or config.integration_scheme not in FIXED_STEP_SCHEMES,
        "simulator_config.use_error_control",
        f"{config.integration_scheme} has no error estimate; set false, or choose another integration_scheme",
    )
    _require(config.accuracy > 0, "simulator_config.accuracy", f"must be > 0, not {config.accuracy}")
    _require(config.target_realtime_rate >= 0, "simulator_config.target_realtime_rate", "must be >= 0 (0: no pacing)")
    _require(config.start_time == 0, "simulator_config.start_time", "must be 0: every run starts there; leave it out")
    _require(config.max_step_size > 0, "simulator_config.max_step_size", "must be > 0 s")
    steps = scenario.duration / config.max_step_size
    _require(
        steps <= MAX_STEPS,
        "simulator_config.max_step_size",
        f"{config.max_step_size:g} s gives {steps:.3g} steps in {scenario.duration:g} s; at most {MAX_STEPS} are run",
    )


def _validate_mass_properties(body: MassProperties, key: str) -> None:
    _require(body.mass > 0, f"{key}.mass", f"must be > 0 kg, not {body.mass}")
    _require(len(body.center_of_mass) == 3, f"{key}.center_of_mass", "must hold three numbers [x, y, z]")
    _require(
        len(body.inertia) in (3, 6),
        f"{key}.inertia",
        "must hold three moments [Ixx, Iyy, Izz], or those and three products [Ixy, Ixz, Iyz]",
    )
    try:
        with np.errstate(all="ignore"):
            principal = np.linalg.eigvalsh(inertia_matrix(body))
    except np.linalg.LinAlgError:
        principal = np.full(3, np.nan)
    _require(bool(np.isfinite(principal).all()), f"{key}.inertia", f"has no principal moments: {_shown(body.inertia)}")
    _require(bool(principal[0] > 0), f"{key}.inertia", "must be positive definite")
    _require(
        bool(principal[0] + principal[1] >= principal[2] * (1 - 1e-12)),
        f"{key}.inertia",
        f"principal moments {np.round(principal, 6).tolist()} violate the triangle inequality "
        "(the largest must not exceed the sum of the others)",
    )


def own_controller_name(controller: str) -> str:
    """The key in ``controllers.own`` of a controller: its name, or what follows the colon of ``module:Class``."""
    return controller.rpartition(":")[2]


def inertia_matrix(body: MassProperties) -> np.ndarray:
    """Inertia about the centre of mass as a symmetric (3, 3) matrix, kg m^2."""
    ixx, iyy, izz, ixy, ixz, iyz = (*body.inertia, 0.0, 0.0, 0.0)[:6]
    return np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])


def _require(condition: bool, key: str, problem: str) -> None:
    if not condition:
        raise ScenarioError(key, problem)


def _find(name: str) -> Path:
    shipped = shipped_scenarios()
    if name in shipped:
        return shipped[name]
    path = Path(name)
    try:
        if path.is_file():
            return path
        kind = "a folder" if path.is_dir() else "not a regular file" if path.exists() else ""
    except (OSError, ValueError) as error:  # too long, not allowed to look, ...
        raise ScenarioError("", f"cannot be read: {one_line(error)}", source=name) from error
    if kind and name:
        raise ScenarioError("", f"is {kind}; give a YAML file", source=name)
    if path.suffix in (".yaml", ".yml") or (name and path.name != name):
        raise ScenarioError("", f"no such scenario file; give a YAML file or one of {', '.join(shipped)}", source=name)
    raise ScenarioError(
        "",
        f"no such scenario; choose one of {', '.join(shipped)}, or give a YAML file{did_you_mean(name, shipped)}",
        source=name or "''",
    )


def _choose_model_source(model: dict[str, typing.Any], given: Mapping[str, typing.Any]) -> None:
    """Of directives and servicer keep the one that was given."""
    if model["servicer"] is not None and given.get("directives") is None:
        model["directives"] = None
    _require(
        (model["servicer"] is None) != (model["directives"] is None),
        "model",
        "give either directives or servicer (a URDF), not both and not neither",
    )


def _anchor_relative_paths(model: dict[str, typing.Any], folder: Path | None) -> None:
    def anchored(path: str | None) -> str | None:
        return path if path is None or folder is None or "://" in path else str((folder / path).resolve())

    for key in ("directives", "servicer", "debris"):
        model[key] = anchored(model[key])
    model["packages"] = {name: anchored(path) for name, path in model["packages"].items()}


def _as_dict(value: typing.Any) -> typing.Any:
    """Plain data (mappings, lists, leaves) of a dataclass, one of Drake's parameter structs, or a container of them."""
    fields = schema_fields(type(value))
    if fields is not None:
        return {key: _as_dict(getattr(value, key)) for key in fields}
    if isinstance(value, Mapping):
        return {key: _as_dict(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_dict(item) for item in value]
    return value


def schema_fields(schema: typing.Any) -> dict[str, typing.Any] | None:
    """Field name -> type of a dataclass or of one of Drake's parameter structs; None for anything else."""
    if dataclasses.is_dataclass(schema):
        return {field.name: field.type for field in dataclasses.fields(schema)}
    fields = getattr(schema, "__fields__", None)
    return None if fields is None else {field.name: field.type for field in fields}


def _build(schema: typing.Any, data: typing.Any) -> typing.Any:
    """The typed object that plain data, complete and checked, stands for."""
    fields = schema_fields(schema)
    if fields is not None:
        return schema(**{key: _build(kind, data[key]) for key, kind in fields.items()})
    origin, args = typing.get_origin(schema), typing.get_args(schema)
    if origin in (typing.Union, types.UnionType):
        return None if data is None else _build(args[0], data)
    if origin is dict:
        return {key: _build(args[1], item) for key, item in data.items()}
    return list(data) if origin is list else data


def _resolve(schema: typing.Any, default: typing.Any, data: typing.Any, path: str) -> typing.Any:
    """Plain data for ``schema``: ``default`` (plain data, complete) overlaid with ``data``, each leaf checked."""
    fields = schema_fields(schema)
    if fields is not None:
        if not isinstance(data, Mapping):
            raise ScenarioError(path, f"must be a mapping with keys {', '.join(fields)}, not {_shown(data)}")
        for key in data:
            if key not in fields:
                raise _unknown_key(path, key, fields)
        return {
            key: _resolve(kind, default[key], data[key], _join(path, key)) if key in data else default[key]
            for key, kind in fields.items()
        }
    origin, args = typing.get_origin(schema), typing.get_args(schema)
    if origin in (typing.Union, types.UnionType):  # the only unions of the schema are optional values
        return None if data is None else _resolve(args[0], default, data, path)
    if origin is dict:
        if args[1] is float and isinstance(data, (list, tuple)):
            raise ScenarioError(
                _join(path, "all"),
                f"must be a number, not {_shown(data)}; several go by name, as in {{all: 1, joints: 2}}",
            )
        if args[1] is float and not isinstance(data, Mapping):
            data = {"all": data}
        if not isinstance(data, Mapping):
            raise ScenarioError(path, f"must be a mapping, not {_shown(data)}")
        blank = None if schema_fields(args[1]) is None else _as_dict(args[1]())
        for key in data:
            if not isinstance(key, str):
                raise ScenarioError(_join(path, _shown(key)), "a name must be text; put it in quotes")
            _convert_leaf(str, key, _join(path, key))
        return {key: _resolve(args[1], blank, item, _join(path, key)) for key, item in data.items()}
    if origin is list:
        if not isinstance(data, (list, tuple)):
            raise ScenarioError(path, f"must be a list, not {_shown(data)}")
        return [_resolve(args[0], None, item, f"{path}[{i}]") for i, item in enumerate(data)]
    return _convert_leaf(schema, data, path)


def _convert_leaf(schema: type, data: typing.Any, path: str) -> typing.Any:
    wanted = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}[schema]
    if schema is float and isinstance(data, (int, float, str)) and not isinstance(data, bool):
        try:
            number = float(data)
        except ValueError:
            raise ScenarioError(path, f"must be {wanted}, not {_shown(data)}") from None
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise ScenarioError(path, f"must be finite, not {_shown(data)}")
        if abs(number) > MAX_NUMBER:
            raise ScenarioError(path, f"must be at most {MAX_NUMBER:g} in size, not {_shown(data)}")
        return number
    if schema is int and isinstance(data, (int, float)) and not isinstance(data, bool):
        if isinstance(data, int) or data.is_integer():
            return int(data)
    elif schema is bool and isinstance(data, bool):
        return data
    elif schema is str and isinstance(data, str):
        if "\0" in data or any("\ud800" <= character <= "\udfff" for character in data):
            raise ScenarioError(path, f"must be text that a file can hold, not {_shown(data)}")
        return data
    raise ScenarioError(path, f"must be {wanted}, not {_shown(data)}")


def _apply_override(resolved: dict[str, typing.Any], override: str) -> str:
    """Write one ``key=value`` into plain data; returns the key."""
    key, equals, text = override.partition("=")
    key = key.strip()
    if not equals or not key:
        raise ScenarioError(f"'{override}'", "must have the form key=value")
    try:
        value = read_yaml(text)
    except StrictYamlError as error:
        raise ScenarioError(key, f"value is not valid YAML: {one_line(error)}") from error
    schema: typing.Any = Scenario
    target: typing.Any = resolved
    *parents, last = key.split(".")
    for depth, part in enumerate(parents):
        schema = _child_schema(schema, part, ".".join(parents[:depth]))
        if typing.get_origin(schema) in (typing.Union, types.UnionType):
            schema = typing.get_args(schema)[0]
        if target.get(part) is None:
            target[part] = {} if schema_fields(schema) is None else _as_dict(schema())
        target = target[part]
    schema = _child_schema(schema, last, ".".join(parents))
    fields = schema_fields(schema)
    if fields is not None and not isinstance(value, Mapping):
        raise ScenarioError(key, f"is a group of settings; set one of them: {', '.join(fields)}")
    default = target.get(last) or _as_dict(schema()) if fields is not None else None
    target[last] = _resolve(schema, default, value, key)
    if key in ("model.directives", "model.servicer") and value is not None:
        target["servicer" if last == "directives" else "directives"] = None
    return key


def _child_schema(schema: typing.Any, part: str, path: str) -> typing.Any:
    """The type of one step down a dotted key."""
    fields = schema_fields(schema)
    if fields is not None:
        if part not in fields:
            raise _unknown_key(path, part, fields)
        return fields[part]
    if typing.get_origin(schema) is dict:
        return typing.get_args(schema)[1]
    holds = "a list; give it whole" if typing.get_origin(schema) is list else "a single value"
    raise ScenarioError(_join(path, part), f"unknown key; {path} holds {holds}")


def _unknown_key(path: str, key: typing.Any, fields: Iterable[str]) -> ScenarioError:
    valid = list(fields)
    return ScenarioError(
        _join(path, key if isinstance(key, str) else _shown(key)),
        f"unknown key; valid here: {', '.join(valid)}{did_you_mean(key, valid)}",
    )


def _join(path: str, key: typing.Any) -> str:
    return f"{path}.{key}" if path else str(key)


def _shown(data: typing.Any) -> str:
    if data is None:
        return "null (no value)"
    try:
        text = repr(data)
    except ValueError:  # Python does not print integers of thousands of digits
        text = "a number of thousands of digits"
    return text if len(text) <= 60 else text[:57] + "..."
