"""The scenario: everything that defines a run, as plain data with units. Loading, overriding, validating.

A scenario is resolved in three layers, later ones winning: the defaults written here, the YAML file, the overrides
(``key=value``). Values given per coordinate (gains, disturbances, joint angles) are mappings whose keys are ``all``, a
group (``base_rotation``, ``base_position``, ``joints``) or one coordinate's name; the more specific key wins, and a
bare number stands for ``{all: number}``.
"""

# Drake's typed YAML loader reads these annotations at run time, so they must stay real types.
import dataclasses
import math
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import yaml
from pydrake.common.yaml import yaml_load_data
from pydrake.systems.analysis import GetIntegrationSchemes, SimulatorConfig

from ffsm_drake.errors import ScenarioError, one_line

PerCoordinate = dict[str, float]
ESTIMATOR_KINDS = ("one_sample", "kalman")
CONTROLLER_NAMES = ("tdc", "asmc", "aismc", "tde_aismc")


def _published(**values: float) -> PerCoordinate:
    return dataclasses.field(default_factory=lambda: dict(values))


@dataclasses.dataclass
class Model:
    """What flies: the models, and the frames that the reports speak of."""

    # Model directives: a package:// address, or a path (relative paths start at the scenario file's folder).
    directives: str = "package://ffsm_drake/postcapture.dmd.yaml"
    # Frame whose origin is reported as the end effector's position.
    end_effector: str = "servicer::end_effector"


@dataclasses.dataclass
class MassProperties:
    """Mass properties of the payload body, in its own frame P."""

    mass: float = 100.0  # kg
    center_of_mass: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])  # p_PScm_P, m
    # About the centre of mass, axes of P: [Ixx, Iyy, Izz] or [Ixx, Iyy, Izz, Ixy, Ixz, Iyz], kg m^2.
    inertia: list[float] = dataclasses.field(default_factory=lambda: [16.7, 16.7, 16.7])


@dataclasses.dataclass
class Payload:
    """The captured body: as it is, and as the controller believes it to be."""

    body: str = "debris::debris"
    truth: MassProperties = dataclasses.field(default_factory=MassProperties)
    belief: MassProperties = dataclasses.field(
        default_factory=lambda: MassProperties(mass=80.0, inertia=[12.0, 12.0, 12.0])
    )


@dataclasses.dataclass
class Posture:
    """A configuration of base and arm."""

    base_position: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])  # p_WB, m
    # Roll, pitch, yaw of R_WB: rotations about the world's x, y, z axes in that order, rad.
    base_rpy: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    joints: PerCoordinate = _published(all=0.0)  # rad (revolute) or m (prismatic), by joint name


@dataclasses.dataclass
class Reference:
    """The planned motion: a fifth-order polynomial from the initial to the target posture."""

    duration: float = 20.0  # s; the target posture is held afterwards


@dataclasses.dataclass
class TdcGains:
    """Time-delay control, equation (17)."""

    k_d: PerCoordinate = _published(all=100.0)  # 1/s
    k_p: PerCoordinate = _published(all=100.0, base_position=200.0)  # 1/s^2


@dataclasses.dataclass
class AsmcGains:
    """Adaptive sliding-mode control, equations (18) and (19)."""

    k_d: PerCoordinate = _published(all=100.0)  # 1/s
    k_s: PerCoordinate = _published(all=80.0)  # 1/s, constant
    g_initial: PerCoordinate = _published(all=0.0)  # rad/s^2 or m/s^2; (19) has a branch of its own for zero
    epsilon: float = 1e-4  # bound on the sliding variable that switches the adaptation's sign
    a: PerCoordinate = _published(all=1e-6, base_position=1e-7)  # adaptation rate, (19)'s phi
    b: PerCoordinate = _published(all=1e5)  # adaptation scale, (19)'s 1/alpha
    g_max: PerCoordinate | None = None  # rad/s^2 or m/s^2; null: unbounded


@dataclasses.dataclass
class AismcGains:
    """Adaptive integral sliding-mode control, equations (20) and (21)."""

    k_d: PerCoordinate = _published(all=100.0)  # 1/s
    k_p: PerCoordinate = _published(all=100.0, base_position=200.0)  # 1/s^2
    k_s_initial: PerCoordinate = _published(all=80.0)  # 1/s
    alpha: PerCoordinate = _published(base_position=3e4, base_rotation=18e4, joints=9e4)  # rate of K_s
    beta: PerCoordinate = _published(base_position=4e7, base_rotation=24e7, joints=12e7)  # accuracy scale of K_s
    k_s_max: PerCoordinate | None = None  # 1/s; null: unbounded


@dataclasses.dataclass
class TdeAismcGains(AismcGains):
    """The proposed controller, equations (6), (9) and (10)."""

    g_initial: PerCoordinate = _published(all=2e-4)  # rad/s^2 or m/s^2
    epsilon: float = 1e-4  # bound on the sliding variable that switches the adaptation's sign
    phi: PerCoordinate = _published(all=1e-1, base_position=1e-2)  # rate of G
    g_max: PerCoordinate | None = None  # rad/s^2 or m/s^2; null: unbounded


@dataclasses.dataclass
class Controllers:
    """The settings of every controller; ``Scenario.controller`` names the one in use."""

    tdc: TdcGains = dataclasses.field(default_factory=TdcGains)
    asmc: AsmcGains = dataclasses.field(default_factory=AsmcGains)
    aismc: AismcGains = dataclasses.field(default_factory=AismcGains)
    tde_aismc: TdeAismcGains = dataclasses.field(default_factory=TdeAismcGains)


@dataclasses.dataclass
class Estimator:
    """How the controller estimates the lumped uncertainty N of equation (2)."""

    kind: str = "one_sample"  # the paper's (5), or "kalman"
    # Kalman only: N's random walk, its standard deviation after one second, rad/s^2 or m/s^2 per sqrt(s).
    walk: PerCoordinate = _published(base_position=1e-3, base_rotation=1e-3, joints=1e-2)
    # Kalman only: standard deviations it assumes of the measurements; null: those of ``sensing``.
    position_noise: PerCoordinate | None = None  # rad or m
    velocity_noise: PerCoordinate | None = None  # rad/s or m/s


@dataclasses.dataclass
class Harmonic:
    """One coordinate's disturbance, ``amplitude * sin(frequency * t + phase) + bias``."""

    amplitude: float = 0.0  # N m or N
    frequency: float = 0.0  # rad/s
    phase: float = 0.0  # rad
    bias: float = 0.0  # N m or N


@dataclasses.dataclass
class Disturbance:
    """External generalized force tau_d on the plant (Table 1)."""

    amplitude_scale: float = 1.0  # multiplies amplitudes and biases
    frequency_scale: float = 1.0  # multiplies frequencies
    harmonics: dict[str, Harmonic] = dataclasses.field(default_factory=dict)  # by coordinate or group


@dataclasses.dataclass
class Sensing:
    """What the sensors add to the true state: bias, white noise, quantisation, delay, in that order."""

    # Standard deviation, one independent sample per coordinate and control sample.
    velocity_noise: PerCoordinate = _published(all=1e-6)  # rad/s or m/s
    position_noise: PerCoordinate = _published(all=0.0)  # rad or m; the same for the three base rotations
    velocity_bias: PerCoordinate = _published(all=0.0)  # rad/s or m/s
    position_bias: PerCoordinate = _published(all=0.0)  # rad or m; base rotations: a rotation vector in the world frame
    velocity_quantization: PerCoordinate = _published(all=0.0)  # rad/s or m/s; 0: none
    position_quantization: PerCoordinate = _published(all=0.0)  # rad or m, not for base rotations; 0: none
    delay: int = 0  # control samples


@dataclasses.dataclass
class Actuation:
    """What the actuators make of the commanded force: saturation, quantisation, delay, in that order."""

    limit: PerCoordinate | None = None  # N m or N, either way; null: unlimited
    quantization: PerCoordinate = _published(all=0.0)  # N m or N; 0: none
    delay: int = 0  # control samples


def _default_simulator_config() -> SimulatorConfig:
    return SimulatorConfig(
        integration_scheme="runge_kutta3", max_step_size=0.01, accuracy=1e-10, use_error_control=False
    )


@dataclasses.dataclass
class Scenario:
    """One run of the closed loop, whole."""

    description: str = ""
    random_seed: int = 0
    duration: float = 20.0  # s; the run ends at the last control sample within it
    sample_time: float = 0.01  # s; L, the controller's period and delay
    # The run is stopped as diverging when a generalized velocity exceeds this, rad/s or m/s.
    divergence_speed: float = 10.0
    simulator_config: SimulatorConfig = dataclasses.field(default_factory=_default_simulator_config)
    model: Model = dataclasses.field(default_factory=Model)
    payload: Payload = dataclasses.field(default_factory=Payload)
    initial_posture: Posture = dataclasses.field(default_factory=Posture)
    target_posture: Posture = dataclasses.field(default_factory=Posture)
    # At the start, rad/s or m/s; base_rotation is the angular velocity in world axes. The reference starts at rest.
    initial_velocity: PerCoordinate = _published(all=0.0)
    reference: Reference = dataclasses.field(default_factory=Reference)
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
    return {path.stem: path for path in sorted((Path(__file__).parent / "scenarios").glob("*.yaml"))}


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
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError("", f"cannot be read: {one_line(error)}", source=str(path)) from error
    return scenario_from_yaml(text, overrides, source=str(path))


def scenario_from_yaml(text: str, overrides: Iterable[str] = (), *, source: str = "") -> Scenario:
    """Build a scenario from YAML text; ``source`` is the file name used in errors and for relative model paths."""
    try:
        data = yaml_load_data(text)
    except yaml.YAMLError as error:
        raise ScenarioError("", f"is not valid YAML: {one_line(error)}", source=source) from error
    return scenario_from_dict({} if data is None else data, overrides, source=source)


def scenario_from_dict(data: Mapping[str, typing.Any], overrides: Iterable[str] = (), *, source: str = "") -> Scenario:
    """Build a scenario from plain data (as read from YAML or JSON)."""
    try:
        resolved = _resolve(Scenario, _as_dict(Scenario()), data, "")
    except ScenarioError as error:
        raise error.located(source) from None
    _anchor_relative_paths(resolved, source)
    overridden = []
    for override in overrides:
        try:
            overridden.append(_apply_override(resolved, override))
        except ScenarioError as error:
            raise error.located("override") from None
    scenario: Scenario = _typed(Scenario, resolved)
    try:
        validate(scenario)
    except ScenarioError as error:
        raise error.located("override" if error.key.startswith(tuple(overridden)) else source) from None
    return scenario


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
    _require(scenario.num_control_periods >= 1, "sample_time", f"must be at most duration ({scenario.duration} s)")
    _require(scenario.divergence_speed > 0, "divergence_speed", "must be > 0")
    _require(scenario.reference.duration > 0, "reference.duration", "must be > 0 s")
    _require(
        scenario.controller in CONTROLLER_NAMES,
        "controller",
        f"'{scenario.controller}' is unknown; choose one of {', '.join(CONTROLLER_NAMES)}",
    )
    _require(
        scenario.estimator.kind in ESTIMATOR_KINDS,
        "estimator.kind",
        f"'{scenario.estimator.kind}' is unknown; choose one of {', '.join(ESTIMATOR_KINDS)}",
    )
    for key, number in scenario.estimator.walk.items():
        _require(number > 0, f"estimator.walk.{key}", f"must be > 0, not {number}")
    for name in ("position_noise", "velocity_noise"):
        for key, number in (getattr(scenario.estimator, name) or {}).items():
            _require(number >= 0, f"estimator.{name}.{key}", f"a standard deviation must be >= 0, not {number}")
    _require(
        scenario.simulator_config.integration_scheme in GetIntegrationSchemes(),
        "simulator_config.integration_scheme",
        f"'{scenario.simulator_config.integration_scheme}' is unknown; "
        f"choose one of {', '.join(GetIntegrationSchemes())}",
    )
    _require(scenario.simulator_config.max_step_size > 0, "simulator_config.max_step_size", "must be > 0 s")
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


def _validate_mass_properties(body: MassProperties, key: str) -> None:
    _require(body.mass > 0, f"{key}.mass", f"must be > 0 kg, not {body.mass}")
    _require(len(body.center_of_mass) == 3, f"{key}.center_of_mass", "must hold three numbers [x, y, z]")
    _require(
        len(body.inertia) in (3, 6),
        f"{key}.inertia",
        "must hold three moments [Ixx, Iyy, Izz], or those and three products [Ixy, Ixz, Iyz]",
    )
    principal = np.linalg.eigvalsh(inertia_matrix(body))
    _require(bool(principal[0] > 0), f"{key}.inertia", "must be positive definite")
    _require(
        bool(principal[0] + principal[1] >= principal[2] * (1 - 1e-12)),
        f"{key}.inertia",
        f"principal moments {np.round(principal, 6).tolist()} violate the triangle inequality "
        "(the largest must not exceed the sum of the others)",
    )


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
    if path.is_file():
        return path
    if path.suffix in (".yaml", ".yml") or path.name != name:
        raise ScenarioError("", "no such scenario file", source=name)
    raise ScenarioError("", f"no such scenario; choose one of {', '.join(shipped)}, or give a YAML file", source=name)


def _anchor_relative_paths(resolved: dict[str, typing.Any], source: str) -> None:
    directives = resolved["model"]["directives"]
    if source and "://" not in directives:
        resolved["model"]["directives"] = str((Path(source).parent / directives).resolve())


def _as_dict(value: typing.Any) -> typing.Any:
    """Plain data (mappings, lists, leaves) of a dataclass, one of Drake's parameter structs, or a container of them."""
    fields = _schema_fields(type(value))
    if fields is not None:
        return {key: _as_dict(getattr(value, key)) for key in fields}
    if isinstance(value, Mapping):
        return {key: _as_dict(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_dict(item) for item in value]
    return value


def _schema_fields(schema: typing.Any) -> dict[str, typing.Any] | None:
    """Field name -> type of a dataclass or of one of Drake's parameter structs; None for anything else."""
    if dataclasses.is_dataclass(schema):
        return {field.name: field.type for field in dataclasses.fields(schema)}
    fields = getattr(schema, "__fields__", None)
    return None if fields is None else {field.name: field.type for field in fields}


def _resolve(schema: typing.Any, default: typing.Any, data: typing.Any, path: str) -> typing.Any:
    """Plain data for ``schema``: ``default`` (plain data, complete) overlaid with ``data``, each leaf checked."""
    fields = _schema_fields(schema)
    if fields is not None:
        if not isinstance(data, Mapping):
            raise ScenarioError(path, f"must be a mapping with keys {', '.join(fields)}, not {_shown(data)}")
        for key in data:
            if key not in fields:
                raise ScenarioError(_join(path, key), f"unknown key; valid here: {', '.join(fields)}")
        return {
            key: _resolve(kind, default[key], data[key], _join(path, key)) if key in data else default[key]
            for key, kind in fields.items()
        }
    origin, args = typing.get_origin(schema), typing.get_args(schema)
    if origin in (typing.Union, types.UnionType):  # the only unions of the schema are optional values
        return None if data is None else _resolve(args[0], default, data, path)
    if origin is dict:
        if args[1] is float and not isinstance(data, Mapping):
            data = {"all": data}
        if not isinstance(data, Mapping):
            raise ScenarioError(path, f"must be a mapping by coordinate or group, not {_shown(data)}")
        blank = None if _schema_fields(args[1]) is None else _as_dict(args[1]())
        return {str(key): _resolve(args[1], blank, item, _join(path, key)) for key, item in data.items()}
    if origin is list:
        if not isinstance(data, (list, tuple)):
            raise ScenarioError(path, f"must be a list, not {_shown(data)}")
        return [_resolve(args[0], None, item, f"{path}[{i}]") for i, item in enumerate(data)]
    return _convert_leaf(schema, data, path)


def _typed(schema: typing.Any, resolved: typing.Any) -> typing.Any:
    """The object that resolved plain data describes; what Drake's loader makes of it too, by way of slow YAML text."""
    fields = _schema_fields(schema)
    if fields is not None:
        return schema(**{key: _typed(kind, resolved[key]) for key, kind in fields.items()})
    origin, args = typing.get_origin(schema), typing.get_args(schema)
    if origin in (typing.Union, types.UnionType):
        return None if resolved is None else _typed(args[0], resolved)
    if origin is dict:
        return {key: _typed(args[1], item) for key, item in resolved.items()}
    if origin is list:
        return [_typed(args[0], item) for item in resolved]
    return resolved


def _convert_leaf(schema: type, data: typing.Any, path: str) -> typing.Any:
    wanted = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}[schema]
    if schema is float and isinstance(data, (int, float, str)) and not isinstance(data, bool):
        try:
            number = float(data)
        except ValueError:
            raise ScenarioError(path, f"must be {wanted}, not {_shown(data)}") from None
        if not math.isfinite(number):
            raise ScenarioError(path, f"must be finite, not {_shown(data)}")
        return number
    if schema is int and isinstance(data, (int, float)) and not isinstance(data, bool) and float(data).is_integer():
        return int(data)
    if (schema is bool and isinstance(data, bool)) or (schema is str and isinstance(data, str)):
        return data
    raise ScenarioError(path, f"must be {wanted}, not {_shown(data)}")


def _apply_override(resolved: dict[str, typing.Any], override: str) -> str:
    """Write one ``key=value`` into plain data; returns the key."""
    key, equals, text = override.partition("=")
    key = key.strip()
    if not equals or not key:
        raise ScenarioError(f"'{override}'", "must have the form key=value")
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ScenarioError(key, f"value is not valid YAML: {one_line(error)}") from error
    schema: typing.Any = Scenario
    target: typing.Any = resolved
    *parents, last = key.split(".")
    for depth, part in enumerate(parents):
        schema = _child_schema(schema, part, ".".join(parents[:depth]))
        if typing.get_origin(schema) in (typing.Union, types.UnionType):
            schema = typing.get_args(schema)[0]
        if target.get(part) is None:
            target[part] = {} if _schema_fields(schema) is None else _as_dict(schema())
        target = target[part]
    schema = _child_schema(schema, last, ".".join(parents))
    fields = _schema_fields(schema)
    if fields is not None and not isinstance(value, Mapping):
        raise ScenarioError(key, f"is a group of settings; set one of them: {', '.join(fields)}")
    default = target.get(last) or _as_dict(schema()) if fields is not None else None
    target[last] = _resolve(schema, default, value, key)
    return key


def _child_schema(schema: typing.Any, part: str, path: str) -> typing.Any:
    """The type of one step down a dotted key."""
    fields = _schema_fields(schema)
    if fields is not None:
        if part not in fields:
            raise ScenarioError(_join(path, part), f"unknown key; valid here: {', '.join(fields)}")
        return fields[part]
    if typing.get_origin(schema) is dict:
        return typing.get_args(schema)[1]
    raise ScenarioError(_join(path, part), f"unknown key; {path} holds a single value")


def _join(path: str, key: typing.Any) -> str:
    return f"{path}.{key}" if path else str(key)


def _shown(data: typing.Any) -> str:
    text = repr(data)
    return text if len(text) <= 60 else text[:57] + "..."
