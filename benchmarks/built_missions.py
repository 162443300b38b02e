"""Missions of spacecraft that are built at random; what ``verdicts --built`` asks about.

Another generator than ``random_missions``: bus, arm and target are drawn link by link, and the URDF
is written beside the results. Sensors, laws with their bandwidth, delays, slow sensors, thrusters,
wheels, faults, nominal payloads and limits follow; limits are drawn about what the motion itself
asks for, so that many are within the reach of the noise. Missions are short.
"""

import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from random_missions import DrawnMission, Rng, Settings

from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.design.stability.planned_dynamics import make_demand
from ffsm_drake.scenario import load_scenario
from ffsm_drake.systems.controllers import complete_gains

FOLDER = Path("out/built")  # of the URDFs
LAWS = ("tdc", "aismc", "asmc", "tde_aismc", "computed_torque")
GROUPS = ("base_rotation", "base_position", "joints")


def draw(rng: Rng) -> DrawnMission:
    """A mission; ``load_scenario`` may refuse it."""
    text, names, bus_mass = _urdf(rng)
    path = FOLDER / f"{zlib.crc32(text.encode()):08x}.urdf"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    base = str(rng.choice(["postcapture", "flight_sensors"], p=[0.35, 0.65]))
    motion = _round(rng.uniform(6.0, 14.0))
    mass = bus_mass * _between(rng, 0.05, 0.6)
    nominal = mass * (1.0 if rng.random() < 0.3 else _between(rng, 0.6, 1.8))
    turn = 0.15 * rng.uniform(-1.0, 1.0, 3)
    settings: Settings = {
        "model.directives": None,
        "model.servicer": str(path.resolve()),
        "model.end_effector": "servicer::tool",
        "payload.truth": _cube(mass, rng),
        "payload.nominal": {"mass": _round(nominal), "inertia": [_round(nominal / 6.0)] * 3},
        "disturbance.harmonics": {},
        "initial_posture": _posture(rng, names, turn=turn, place=0.1 * rng.uniform(-1, 1, 3)),
        "target_posture": _posture(rng, names, turn=np.zeros(3), place=np.zeros(3)),
        "reference.duration": motion,
        "duration": _round(motion + rng.uniform(4.0, 7.0)),
        "random_seed": int(rng.integers(1000)),
    }
    settings |= _law(rng, base)
    settings |= _sensors(rng, base)
    settings |= _actuators(rng, base, settings)
    return DrawnMission(base=base, overrides=[f"{k}={json.dumps(v)}" for k, v in settings.items()])


def _urdf(rng: Rng) -> tuple[str, list[str], float]:
    """A bus with an arm of three to seven joints: the text, its joints, the bus's mass, kg."""
    count, mass = int(rng.integers(3, 8)), _between(rng, 80.0, 1500.0)
    side = mass ** (1.0 / 3.0) / 6.0 * rng.uniform(0.8, 1.3, 3)
    reach = _between(rng, 0.8, 4.0) * float(side.mean())
    lengths = rng.dirichlet(4.0 * np.ones(count)) * reach
    box = mass / 12.0 * (side @ side - side**2)
    parts = [
        f'<link name="bus">{_inertial(mass, box, 0.0)}<visual><geometry><box size="'
        f'{" ".join(f"{x:.4g}" for x in side)}"/></geometry></visual></link>'
    ]
    axes = ["0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "0 0 1", "0 1 0"][:count]
    if rng.random() < 0.5:
        axes = [str(each) for each in rng.permutation(axes)]
    parent, place = "bus", f"{0.5 * side[0]:.4g} 0 {0.4 * side[2]:.4g}"
    names = [f"j{k}" for k in range(1, count + 1)]
    for k, (name, length, axis) in enumerate(zip(names, lengths.tolist(), axes, strict=True), 1):
        link = mass * _between(rng, 0.005, 0.03)
        radius = 0.03 + 0.02 * length
        across = link * (length**2 / 12.0 + radius**2 / 4.0)
        moments = np.array([across, across, 0.5 * link * radius**2])
        most = rng.uniform(1.2, 3.0)
        parts.append(
            f'<link name="l{k}">{_inertial(link, moments, 0.5 * length)}<visual>'
            f'<origin xyz="0 0 {0.5 * length:.4g}"/><geometry><cylinder radius="{radius:.3g}" '
            f'length="{max(length - 2.0 * radius, 0.02):.4g}"/></geometry></visual></link>'
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="l{k}"/>'
            f'<origin xyz="{place}"/><axis xyz="{axis}"/><limit lower="{-most:.3g}" '
            f'upper="{most:.3g}" effort="{_between(rng, 30.0, 1000.0):.3g}" '
            f'velocity="{_between(rng, 0.3, 2.0):.3g}"/></joint>'
        )
        parent, place = f"l{k}", f"0 0 {length:.4g}"
    tip = f'<link name="tool"/><joint name="tip" type="fixed"><parent link="{parent}"/><child '
    parts.append(f'{tip}link="tool"/><origin xyz="{place}"/></joint>')
    return (
        '<?xml version="1.0"?>\n<robot name="built">\n' + "\n".join(parts) + "\n</robot>\n",
        (names),
        mass,
    )


def _inertial(mass: float, moments: np.ndarray, height: float) -> str:
    x, y, z = (f"{each:.4g}" for each in moments.tolist())
    return (
        f'<inertial><origin xyz="0 0 {height:.4g}"/><mass value="{mass:.4g}"/><inertia ixx="{x}" '
        f'iyy="{y}" izz="{z}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def _cube(mass: float, rng: Rng) -> dict[str, Any]:
    center = 0.08 * rng.uniform(-1.0, 1.0, 3)
    return {
        "mass": _round(mass),
        "center_of_mass": [_round(x) for x in center],
        "inertia": [_round(mass / 6.0)] * 3,
    }


def _posture(rng: Rng, names: list[str], *, turn: np.ndarray, place: np.ndarray) -> dict[str, Any]:
    return {
        "base_position": [_round(x) for x in place],
        "base_rpy": [_round(x) for x in turn],
        "joints": {name: _round(rng.uniform(-1.1, 1.1)) for name in names},
    }


def _law(rng: Rng, base: str) -> Settings:
    """A law, its bandwidth and K_s as a whole changed by a factor."""
    law, factor = str(rng.choice(LAWS)), _between(rng, 0.3, 1.6)
    scenario = load_scenario(base, [f"controller={law}"])
    settings: Settings = {"controller": law}
    for name, values in complete_gains(scenario).controllers.get(law, {}).items():
        if name.startswith("k_") and values is not None:
            own = factor**2 if name.startswith("k_p") else factor
            settings[f"controllers.{law}.{name}"] = _scaled(values, own)
    return settings


def _sensors(rng: Rng, base: str) -> Settings:
    settings: Settings = {}
    if base == "flight_sensors":
        factor = _between(rng, 0.3, 3.0)
        noise = load_scenario(base).sensing
        settings["sensing.position_noise"] = _scaled(noise.position_noise, factor)
        settings["sensing.velocity_noise"] = _scaled(noise.velocity_noise, factor)
        if rng.random() < 0.2:
            group = str(rng.choice(GROUPS))
            settings["sensing.position_period"] = {"all": 1, group: int(rng.choice([2, 5, 10]))}
    if rng.random() < 0.2:
        settings["sensing.delay"] = int(rng.integers(1, 4))
        settings["estimator.delay"] = None if rng.random() < 0.6 else 0
    if rng.random() < 0.15:
        settings["sample_time"] = float(rng.choice([0.005, 0.02]))
    if rng.random() < 0.06:
        broken = {"unit": "sensing", "kind": "any", "time": [2.0, 5.0]}
        settings["faults"] = {"events": {"one": broken}}
    return settings


def _actuators(rng: Rng, base: str, given: Settings) -> Settings:
    """Limits from a little less to several times of what the motion asks for; base actuators."""
    settings: Settings = {"actuation.limit": None}
    overrides = [f"{k}={json.dumps(v)}" for k, v in given.items() if k != "faults"]
    scenario = load_scenario(base, [*overrides, "actuation.limit=null"])
    demand = make_demand(make_mission(scenario))
    peak = {
        group: float(np.abs(demand.force[:, own]).max())
        for group, own in demand.coordinates.groups.items()
    }
    if rng.random() < 0.7:
        settings["actuation.limit"] = {
            group: _round(force * _between(rng, 0.9, 6.0)) for group, force in peak.items()
        }
    if rng.random() < 0.15:
        settings["actuation.delay"] = int(rng.integers(1, 3))
    if base == "flight_sensors" and rng.random() < 0.12:
        settings["actuation.thrusters"] = {"layout": str(rng.choice(["12x1N", "12x5N", "16x22N"]))}
    elif base == "flight_sensors" and rng.random() < 0.15:
        torque = _round(peak["base_rotation"] * _between(rng, 0.8, 4.0))
        axes = ([1, 0, 0], [0, 1, 0], [0, 0, 1])
        settings["actuation.wheels"] = {
            "units": {
                f"wheel_{name}": {
                    "axis": axis, "inertia": 0.1, "torque_limit": torque, "speed_limit": 600.0,
                }
                for name, axis in zip("xyz", axes, strict=True)
            }
        }  # fmt: skip
    return settings


def _between(rng: Rng, low: float, high: float) -> float:
    """Log-uniform."""
    return _round(float(np.exp(rng.uniform(np.log(low), np.log(high)))))


def _scaled(values: Any, factor: float) -> Any:
    if isinstance(values, dict):
        return {name: _round(value * factor) for name, value in values.items()}
    return _round(values * factor)


def _round(x: float) -> float:
    return float(f"{x:.4g}")
