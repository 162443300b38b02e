"""Missions drawn at random from what scenarios can say; what ``verdicts`` asks about.

A mission is a shipped scenario and overrides, so that ``ffsm run BASE --set ...`` repeats it. Each
``_draw_...`` gives the overrides of one section; a section that is not drawn stays as shipped.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.scenario import Scenario, load_scenario, shipped_scenarios
from ffsm_drake.systems.controllers import complete_gains, controller_names

PLAIN = ("controllers={}", "disturbance.harmonics={}")  # defaults, and nothing that disturbs
GROUPS = ("base_rotation", "base_position", "joints")
FLIGHT_NOISE = {
    "position_noise": {"base_position": 1e-3, "base_rotation": 5e-5, "joints": 1e-5},
    "velocity_noise": {"base_position": 1e-3, "base_rotation": 1.5e-5, "joints": 1e-4},
}
FLIGHT_WALK = {"base_position": 4.35e-4, "base_rotation": 8.71e-5, "joints": 1.96e-3}
FLIGHT_LIMIT = {"base_position": 22.0, "base_rotation": 10.0, "joints": 50.0}
TASK_LAWS = ("resolved_rate", "task_computed_torque", "task_time_delay")  # of a frame
_SIDE = 1.0  # m, of the cube that the target is
_LONGEST = 110.0  # s, of a mission

Rng = np.random.Generator
Settings = dict[str, Any]  # dotted key -> plain data


@dataclasses.dataclass(frozen=True, kw_only=True)
class DrawnMission:
    """A shipped scenario with overrides."""

    base: str
    overrides: list[str]


def draw(kind: str, rng: Rng) -> DrawnMission:
    """A mission of all that there is ("mission"), or a capture within flight limits ("capture").

    Not every mission can be built: the scenario's own checks tell.
    """
    return _draw_capture_set(rng) if kind == "capture" else _draw_mission(rng)


def _draw_capture_set(rng: Rng) -> DrawnMission:
    """A tumbling target, of wrong mass and off its centre, met with wrong navigation."""
    settings = {
        **_draw_target(rng, ratios=(0.5, 1.0, 2.0)),
        **_draw_capture(rng, load_scenario("tumbling_capture")),
        "sensing.position_bias": _vector_by_axis(0.05 * rng.random() * _direction(rng)),
        "reference.duration": 40.0,
        "duration": 90.0,
        "random_seed": int(rng.integers(1000)),
    }
    settings["capture.approach.duration"] = 20.0
    return DrawnMission(base="tumbling_capture", overrides=_overrides(settings))


def _draw_mission(rng: Rng) -> DrawnMission:
    names = (*shipped_scenarios(), "plain")
    base = str(rng.choice(names))
    fixed: Sequence[str] = ()
    if base == "plain":
        base, fixed = "postcapture", PLAIN
    scenario = load_scenario(base, fixed)
    settings: Settings = {"random_seed": int(rng.integers(1000))}
    settings |= _draw_legs(rng, scenario)
    for chance, section in (
        (0.5, _draw_postures),
        (0.8, _draw_law),
        (0.5, _draw_estimator),
        (0.5, _draw_sensors),
        (0.5, _draw_actuators),
        (0.2, _draw_flexible),
        (0.3, _draw_disturbance),
        (0.15, _draw_driven),
    ):
        if rng.random() < chance:
            settings |= section(rng, scenario)
    return DrawnMission(base=base, overrides=[*fixed, *_overrides(settings)])


def _draw_legs(rng: Rng, scenario: Scenario) -> Settings:
    """From the start with the target held, from the grasp, or with the approach; and how long."""
    leg = rng.choice(["held", "grasp", "approach"], p=[0.35, 0.25, 0.4])
    settings: Settings = {}
    if scenario.reference.kind == "optimal" or scenario.reference.frame is not None:
        leg = "own"
    if leg in ("held", "own"):
        settings |= _draw_target(rng) if rng.random() < 0.6 else {}
    if leg == "held":
        settings["capture"] = None
    if leg in ("grasp", "approach"):
        settings |= _draw_target(rng) | _draw_capture(rng, scenario)
        settings["reference.base_rotation"] = "eigenaxis"
    if leg == "grasp":
        settings = {key: value for key, value in settings.items() if "approach" not in key}
        settings["capture.approach"] = None
    approach = settings.get("capture.approach.duration", 0.0)
    motion = scenario.reference.duration or 20.0
    if leg != "own" and rng.random() < 0.7:
        motion = _between(rng, 6.0, 60.0)
        settings["reference.duration"] = "auto" if rng.random() < 0.1 else motion
    settings["duration"] = _round(min(approach + motion + _between(rng, 5.0, 20.0), _LONGEST))
    return settings


def _draw_target(rng: Rng, ratios: Sequence[float] = ()) -> Settings:
    mass = _between(rng, 17.0, 300.0)
    nominal = mass * (float(rng.choice(ratios)) if ratios else _between(rng, 0.5, 2.0))
    center = 0.1 * rng.random() * _direction(rng)
    return {
        "payload.truth": {
            "mass": _round(mass),
            "center_of_mass": _rounded(center),
            "inertia": [_round(mass * _SIDE**2 / 6.0)] * 3,
        },
        "payload.nominal": {
            "mass": _round(nominal),
            "inertia": [_round(nominal * _SIDE**2 / 6.0)] * 3,
        },
    }


def _draw_capture(rng: Rng, scenario: Scenario) -> Settings:
    """The grasp of a target that tumbles, and the way there from a posture nearby."""
    rate = np.deg2rad(_between(rng, 1.0, 30.0)) * _direction(rng)
    posture = scenario.initial_posture
    ways = ("track_joints", "track_all", "rest")
    reach = rng.choice([0.7, 1.5, 2.5])
    joints = {
        name: _round(angle + reach * rng.uniform(-1.0, 1.0))
        for name, angle in posture.joints.items()
        if name != "all"
    }
    away = {"base_position": posture.base_position, "base_rpy": posture.base_rpy, "joints": joints}
    return {
        "capture.rate": _rounded(rate),
        "capture.servicer": str(rng.choice(ways, p=[0.6, 0.2, 0.2])),
        "capture.tracking_length": 0.3,
        "capture.joints": str(rng.choice(["free", "braked"])),
        "capture.approach.duration": float(rng.integers(10, 31)),
        "capture.approach.posture": away,
    }


def _draw_postures(rng: Rng, scenario: Scenario) -> Settings:
    """Joints anywhere within a reach of where they are; of a plan nothing may move."""
    if scenario.reference.kind == "optimal":
        return {}
    reach = rng.choice([0.7, 1.5, 2.5])
    settings: Settings = {}
    for key in ("initial_posture", "target_posture"):
        given = getattr(scenario, key).joints
        names = [name for name in given if name != "all"]
        if names and (key == "target_posture" or rng.random() < 0.3):
            angles = {name: _round(given[name] + reach * rng.uniform(-1.0, 1.0)) for name in names}
            settings[f"{key}.joints"] = angles
    return settings


def _draw_law(rng: Rng, scenario: Scenario) -> Settings:
    """Any law that fits, with its gains as they are, softer or stiffer as a whole, or one by
    one.
    """
    tracks = scenario.reference.frame is not None
    fits = [
        name
        for name in controller_names()
        if tracks or name not in (*TASK_LAWS, "torque_against_momentum")
    ]
    law = str(rng.choice(fits))
    settings: Settings = {"controller": law}
    how = rng.choice(["kept", "together", "each"])
    if how == "kept":
        return settings
    gains = complete_gains(dataclasses.replace(scenario, controller=law)).controllers[law]
    bandwidth = _between(rng, 0.2, 5.0)
    drawn = {name: _between(rng, 0.2, 5.0) for name in gains}
    for name, values in gains.items():
        if values is None:
            continue
        own = bandwidth**2 if name.startswith("k_p") else bandwidth
        if name.startswith("k_s"):  # where it starts and its bound
            own, drawn[name] = bandwidth, drawn.get("k_s_initial", drawn[name])
        if not name.startswith("k_"):
            own = 1.0
        factor = own if how == "together" else drawn[name]
        settings[f"controllers.{law}.{name}"] = _scaled(values, factor)
    return settings


def _draw_estimator(rng: Rng, scenario: Scenario) -> Settings:
    kind = str(rng.choice(["one_sample", "kalman", "coupled"]))
    settings: Settings = {"estimator.kind": kind}
    if kind != "one_sample":
        settings["estimator.walk"] = _scaled(FLIGHT_WALK, _between(rng, 0.2, 5.0))
    if kind == "coupled":
        settings["estimator.force_walk"] = _between(rng, 0.01, 1.0)
    return settings


def _draw_sensors(rng: Rng, scenario: Scenario) -> Settings:
    settings: Settings = {}
    if rng.random() < 0.6:
        factor = _between(rng, 0.1, 5.0)
        settings |= {
            f"sensing.{name}": _scaled(values, factor) for name, values in FLIGHT_NOISE.items()
        }
    if rng.random() < 0.25:
        settings["sensing.delay"] = int(rng.integers(1, 5))
        settings["estimator.delay"] = None if rng.random() < 0.7 else 0
    if rng.random() < 0.25:
        group, period = str(rng.choice([*GROUPS, "all"])), int(rng.choice([2, 3, 5, 10, 50, 100]))
        which = rng.choice(["position", "velocity", "both"])
        for name in ("position", "velocity"):
            if which in (name, "both"):
                settings[f"sensing.{name}_period"] = {"all": 1, group: period}
    if rng.random() < 0.25:
        far = rng.random() < 0.15
        bias = (_between(rng, 0.1, 1.0) if far else 0.05 * rng.random()) * _direction(rng)
        settings["sensing.position_bias"] = _vector_by_axis(bias)
    if rng.random() < 0.15:
        settings["sensing.velocity_bias"] = {"base_rotation": _between(rng, 1e-6, 1e-4)}
    if rng.random() < 0.2:
        step = _between(rng, 1e-5, 1e-3)
        settings["sensing.position_quantization"] = {"all": 0.0, "joints": _round(step)}
        settings["sensing.velocity_quantization"] = _between(rng, 1e-6, 1e-3)
    return settings


def _draw_actuators(rng: Rng, scenario: Scenario) -> Settings:
    settings: Settings = {}
    drives_base = "base_position" in scenario.driven
    scale = _between(rng, 0.1, 2.0)
    if rng.random() < 0.6:
        groups = GROUPS if drives_base else ("joints",)
        limit = {name: FLIGHT_LIMIT[name] for name in groups}
        settings["actuation.limit"] = _scaled(limit, scale)
    if rng.random() < 0.2:
        settings["actuation.delay"] = int(rng.integers(1, 4))
    if rng.random() < 0.15:
        settings["actuation.quantization"] = _between(rng, 1e-3, 0.3)
    if rng.random() < 0.25 and drives_base:
        settings["actuation.thrusters"] = {
            "layout": str(rng.choice(["12x1N", "12x5N", "16x22N"])),
            "modulator": str(rng.choice(["sigma_delta", "pulse_width", "pwpf"])),
            "frame": int(rng.choice([2, 5, 10])),
        }
    if rng.random() < 0.25 and "base_rotation" in scenario.driven:
        settings["actuation.wheels"] = _draw_wheels(rng)
    if rng.random() < 0.2:
        drives = {"coulomb_friction": _between(rng, 0.01, 0.5), "smoothing_rate": 0.1}
        if "actuation.limit" in settings:
            drives["rate_limit"] = _between(rng, 0.03, 1.0)
        settings["actuation.drives"] = drives
    return settings


def _draw_wheels(rng: Rng) -> Settings:
    """Four wheels in a pyramid."""
    torque, speed = _between(rng, 0.1, 5.0), _between(rng, 100.0, 628.0)
    units = {
        f"wheel_{k}": {
            "axis": axis,
            "inertia": 0.08,
            "torque_limit": _round(torque),
            "speed_limit": _round(speed),
            "coulomb_friction": 5e-4,
        }
        for k, axis in enumerate(([1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]), start=1)
    }
    return {"units": units, "assist_above": 1.0 if rng.random() < 0.5 else None}


def _draw_flexible(rng: Rng, scenario: Scenario) -> Settings:
    """Two panels, or sloshing propellant."""
    if rng.random() < 0.7:
        mass, frequency = _between(rng, 0.5, 10.0), _between(rng, 0.1, 2.0)
        parts = {
            name: {
                "position": [0.0, side, 0.0],
                "direction": [0.0, side, 0.0],
                "mass": mass,
                "frequency": frequency,
            }
            for name, side in (("port", 1.0), ("starboard", -1.0))
        }
    else:
        mass, frequency = _between(rng, 2.0, 40.0), _between(rng, 0.1, 1.0)
        slosh = {"kind": "mass", "mass": mass, "frequency": frequency, "damping_ratio": 0.02}
        parts = {"tank": slosh}
    return {"model.flexible": parts}


def _draw_disturbance(rng: Rng, scenario: Scenario) -> Settings:
    fast = rng.random() < 0.2
    return {
        "disturbance.amplitude_scale": _between(rng, 0.3, 10.0),
        "disturbance.frequency_scale": _between(rng, 1.0, 600.0 if fast else 3.0),
    }


def _draw_driven(rng: Rng, scenario: Scenario) -> Settings:
    """The base's position, or all of the base, left alone."""
    groups = [["base_rotation", "joints"], ["joints"]]
    driven = groups[int(rng.integers(2))]
    settings: Settings = {"actuation.driven": driven}
    here = scenario.initial_posture
    settings["target_posture.base_position"] = here.base_position
    if len(driven) == 1:
        settings["target_posture.base_rpy"] = here.base_rpy
    return settings


def _between(rng: Rng, low: float, high: float) -> float:
    """Log-uniform."""
    return _round(float(np.exp(rng.uniform(np.log(low), np.log(high)))))


def _direction(rng: Rng) -> np.ndarray:
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


def _vector_by_axis(vector: np.ndarray) -> Settings:
    return {f"base_position_{axis}": _round(x) for axis, x in zip("xyz", vector, strict=True)}


def _scaled(values: Mapping[str, float] | float, factor: float) -> Any:
    if isinstance(values, Mapping):
        return {name: _round(value * factor) for name, value in values.items()}
    return _round(values * factor)


def _rounded(vector: np.ndarray) -> list[float]:
    return [_round(x) for x in vector]


def _round(x: float) -> float:
    """To four digits, which an override shows."""
    return float(f"{x:.4g}")


def _overrides(settings: Settings) -> list[str]:
    return [f"{key}={json.dumps(value)}" for key, value in settings.items()]
