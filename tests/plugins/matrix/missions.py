"""Missions put together from capabilities: one value of each factor, as overrides of a scenario."""

import math
from pathlib import Path

import numpy as np
import outside_urdfs
from outside_urdfs import BOX, joint, link, robot, rod

from ffsm_drake.plugins.new.first_scenario import new_scenario

ROOT = Path(__file__).parents[3]

# The first value of each factor is the plain one.
FACTORS = {
    "spacecraft": (
        "shipped",
        "own servicer",
        "own servicer and target",
        "generated servicer",
        "two arms",
        "later hand",
    ),
    "law": ("proposed", "tdc", "own law", "task-space law"),
    "estimator": ("kalman", "one_sample", "coupled"),
    "sensors": ("noisy", "flight", "late", "own sensor"),
    "base actuators": ("ideal", "thrusters", "wheels", "thrusters and wheels", "own actuator"),
    "joint actuators": ("ideal", "drives"),
    "flexible": ("none", "panels", "slosh"),
    "orbit": ("none", "orbit"),
    "start": ("held", "capture from the grasp", "capture with approach", "measured target"),
    "motion": ("polynomial", "shaped", "frame", "plan"),
    "driven": ("all", "base rotation and joints", "joints"),
    "command filter": ("none", "command filter"),
    "supervisor": ("none", "supervisor"),
    "faults": ("none", "detection"),
    "command": ("run", "stability", "design", "plan", "compare", "campaign", "replay"),
}
PLAIN = {factor: values[0] for factor, values in FACTORS.items()}

_TWO_ARMS = ("two arms", "later hand")
_UNDRIVEN = ("base rotation and joints", "joints")
_APPROACHES = ("capture with approach", "measured target")
# Combinations that are refused: what the one line names, beside the rows of docs/combinations.md.
REFUSED = {
    frozenset(combination.items()): names
    for combination, names in (
        *(
            ({"base actuators": actuators, "driven": driven}, ("driven", actuators.split()[0]))
            for actuators in ("thrusters", "wheels", "thrusters and wheels")
            for driven in _UNDRIVEN
            if (actuators, driven) != ("wheels", "base rotation and joints")
        ),
        *(
            (
                {"start": start, "driven": "joints", **planned},
                ("actuation.driven", "momentum"),
            )
            for start in ("capture from the grasp", *_APPROACHES)
            for planned in ({"motion": "plan"}, {"command": "plan"})
        ),
    )
}

# What runs, and is predicted as unstable: `one_sample` divides a step of a held measurement by one
# sample's time.
WARNED = [
    frozenset({("law", law), ("estimator", "one_sample"), ("sensors", "late")})
    for law in ("proposed", "tdc")
]

APPROACH = 6.0  # s
MOTION = 10.0
HOLD = 2.0
OMEGA = 3.0  # rad/s, of every law
_ERRORS = {"k_p": OMEGA**2, "k_d": 2.0 * OMEGA}
_FRAME = {
    f"k_{which}_{what}": _ERRORS[f"k_{which}"]
    for which in "pd"
    for what in ("rotation", "position")
}
_AXES = ([1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1])
_PANEL = {"mass": 2.0, "frequency": 0.5, "damping_ratio": 0.01}
_LAWS = {
    "proposed": "tde_aismc",
    "tdc": "tdc",
    "own law": "own_computed_torque:Mine",
    "task-space law": "task_time_delay",
}


_SHIPPED = {"shipped": "postcapture", "two arms": "two_arms", "later hand": "two_arms"}
# Joint angles, rad, at which each hand is 0.3 m from its place, along the z axis of the hand.
_OPEN = {
    side: {f"{side}_{k}": angle for k, angle in enumerate(angles, start=1)}
    for side, angles in (
        ("left", (2.061, 1.68, -1.756, 0.0, 1.647, 2.061)),
        ("right", (1.081, 1.647, -1.398, 0.0, -1.819, -1.081)),
    )
}
_LATER = {
    "contacts": {"right": {"closes": 3.0}},
    "initial_posture": {"joints": _OPEN["right"]},
}
# Joint angles, rad, from which and towards which own spacecraft move: free of contact, the base's
# wheels as strong as the motion asks.
_ARM = (1.135, 0.056, 1.888, -1.909, 1.502, -1.907)
_POSTURES = {
    "own servicer": ((1.731, 0.266, 1.668, -1.665, 1.987, -1.694), _ARM),
    "own servicer and target": ((1.362, 0.475, 1.611, -2.181, 1.731, -1.342), _ARM),
    "generated servicer": (
        (1.14, -0.081, -0.354, -2.11, -1.075, 1.658, -0.787),
        (0.658, 0.426, 0.033, -1.818, -1.641, 1.113, -1.141),
    ),
}


def _always(row, scenario):
    """What every mission has: a short motion nearby, gains that suit all sensors."""
    at_origin = {"base_position": [0.0, 0.0, 0.0], "base_rpy": [0.0, 0.0, 0.0]}
    return {
        "duration": MOTION + HOLD,
        "tolerance": {"all": 0.03},
        "initial_posture": {**at_origin, "joints": _on_the_way(row, scenario, 0.0)},
        "target_posture": {**at_origin, "joints": _on_the_way(row, scenario, 0.15)},
        "reference": {"duration": MOTION, "base_rotation": "eigenaxis"},
        "disturbance": {"amplitude_scale": 0.2},
        "python_path": [str(ROOT / "examples"), str(ROOT / "tests"), str(Path(__file__).parent)],
        "controllers": {
            "tde_aismc": {**_ERRORS, "k_s_initial": 0.5, "k_s_max": 0.5, "g_initial": 0.0},
            "tdc": _ERRORS,
            "Mine": {"k_p": {"all": 9.0, "joints": 64.0}, "k_d": {"all": 6.0, "joints": 16.0}},
            "task_time_delay": {**_FRAME, "k_p_plan": OMEGA**2, "k_d_plan": 2.0 * OMEGA},
        },
        "planning": {"segments": 4, "time_weight": 0.0, "effort_weight": 1.0},
    }  # fmt: skip


def _on_the_way(row, scenario, furthest):
    """Joint angles on a motion that is free of contact, of a shipped scenario its own."""
    start, end = scenario.initial_posture.joints, scenario.target_posture.joints
    if postures := _POSTURES.get(row["spacecraft"]):
        start, end = (dict(zip(start, each, strict=True)) for each in postures)
    share = furthest / max(abs(end[name] - start[name]) for name in start)
    return {name: angle + share * (end[name] - angle) for name, angle in start.items()}


_NOISY = {"position_noise": 1e-6, "velocity_noise": 1e-6}
_FLIGHT = {
    "position_noise": {"base_position": 1e-3, "base_rotation": 5e-5, "joints": 1e-5},
    "velocity_noise": {"base_position": 1e-3, "base_rotation": 1.5e-5, "joints": 1e-4},
}
_SENSORS = {
    "noisy": {"sensing": _NOISY},
    "flight": {"sensing": _FLIGHT},
    "late": {
        "sensing": {
            **_FLIGHT,
            "velocity_noise": {**_FLIGHT["velocity_noise"], "base_position": 2e-4},
            **{f"{of}_period": {"base_position": 5} for of in ("position", "velocity")},
            **{f"{of}_delay": {"base_position": 3} for of in ("position", "velocity")},
        }
    },
    "own sensor": {"sensing": _NOISY, "blocks": {"sensing": {"tracker": "slow_tracker:Held"}}},
}  # fmt: skip
_WHEELS = {
    f"wheel_{k}": {"axis": axis, "inertia": 0.08, "torque_limit": 60.0, "speed_limit": 628.0}
    for k, axis in enumerate(_AXES, start=1)
}
_BASE_ACTUATORS = {
    "thrusters": {"actuation": {"thrusters": {"layout": "16x22N"}}},
    "wheels": {"actuation": {"wheels": {"units": _WHEELS}}},
    "thrusters and wheels": {
        "actuation": {"thrusters": {"layout": "12x5N"}, "wheels": {"units": _WHEELS}}
    },
    "own actuator": {
        "blocks": {
            "actuation": {
                "system": "own_actuator:Magnetorquers", "settings": {"largest_dipole": 1e5}
            }
        }
    },
}  # fmt: skip
_DRIVEN = {"base rotation and joints": ["base_rotation", "joints"], "joints": ["joints"]}


def overrides_of(row, scenario, plan):
    """The mission of a row, as overrides of its spacecraft's scenario and a plan's file."""
    parts = [_always(row, scenario), {"controller": _LAWS[row["law"]]}, _SENSORS[row["sensors"]]]
    parts += [{"estimator": _estimator(row)}, _BASE_ACTUATORS.get(row["base actuators"], {})]
    parts += [_start(row, scenario), _motion(row, scenario, plan)]
    is_hard = row["start"] == "measured target" and row["motion"] == "frame"
    if "thrusters" in row["base actuators"] and (row["spacecraft"] in _TWO_ARMS or is_hard):
        # these missions need more force than 12x5N has
        parts.append(_BASE_ACTUATORS["thrusters"])
    if row["spacecraft"] == "later hand":
        parts.append(_LATER)
    if row["joint actuators"] == "drives":
        parts.append(
            {
                "actuation": {
                    "drives": {"rotor_inertia": {"joints": 1e-4}, "gear_ratio": {"joints": 100.0}}
                }
            }
        )
    bus = "servicer::base" if row["spacecraft"] in _SHIPPED else "servicer::bus"
    if row["flexible"] == "panels":
        sides = {"port": [0, 1, 0], "starboard": [0, -1, 0]}
        panels = {
            name: {"body": bus, "position": at, "direction": at, **_PANEL}
            for name, at in sides.items()
        }
        parts.append({"model": {"flexible": panels}})
    if row["flexible"] == "slosh":
        tank = {
            "kind": "pendulum",
            "body": bus,
            "mass": 3.0,
            "length": 0.3,
            "stiffness": 0.5,
            "damping_ratio": 0.02,
        }
        parts.append({"model": {"flexible": {"tank": tank}}})
    if row["orbit"] == "orbit":
        parts.append({"environment": {"altitude": 500e3}})
    if row["driven"] != "all":
        parts.append({"actuation": {"driven": _DRIVEN[row["driven"]]}})
    if row["command filter"] != "none":
        parts.append({"command_filter": {"low_pass": {"all": 20.0}}})
    if row["supervisor"] != "none":
        limits = {"base_position": 100.0, "base_rotation": 100.0, "joints": 200.0}
        ideal = row["base actuators"] in ("ideal", "own actuator")
        parts.append({"supervisor": {}})
        parts.append({"actuation": {"limit": limits if ideal else {"joints": 200.0}}})
    if row["faults"] != "none":
        parts.append({"faults": {"detection": {}}})
    return parts


def _estimator(row):
    kind = row["estimator"]
    if kind == "one_sample":
        return {"kind": kind}
    walk = {"base_position": 5e-4, "base_rotation": 5e-4, "joints": 2e-3}
    noises = {name: {**_FLIGHT[name]} for name in ("position_noise", "velocity_noise")}
    return {"kind": kind, "walk": walk, **noises}


def _start(row, scenario):
    if row["start"] == "held":
        return {}
    rate = [math.radians(each) for each in (0.6, 0.48, 0.64)]
    capture = {"rate": rate, "axes": "target", "servicer": "rest"}
    if row["start"] == "capture from the grasp":
        return {"capture": capture}
    joints = _on_the_way(row, scenario, 0.25)
    if row["spacecraft"] in _TWO_ARMS:
        joints = {**_OPEN["left"], **_OPEN["right"]}
    capture["approach"] = {"duration": APPROACH, "posture": {"joints": joints}}
    capture["envelope"] = dict.fromkeys(("position", "angle", "velocity", "angular_velocity"))
    if row["start"] == "measured target":
        capture |= {"closing": {"joints": "controlled"}, "measured": {"last": 2.0}}
        capture["envelope"] |= {"position": 0.1, "angle": 0.2}
    return {"capture": capture, "duration": APPROACH + MOTION + HOLD}


def _motion(row, scenario, plan):
    if row["motion"] == "shaped":
        return {"reference": {"shaper": {"frequencies": [0.5]}}}
    if row["motion"] == "frame":
        return {"reference": {"frame": {"task": "position"}}}
    if row["motion"] == "plan":
        return {"reference": {"kind": "optimal", "plan": str(plan)}}
    return {}


def generated_servicer(seed=0):
    """A random arm of seven joints on a box, of links of random lengths along random axes."""
    random = np.random.default_rng(seed)
    turn = 'lower="-2.9" upper="2.9" effort="80" velocity="1.5"'
    parts, parent, height = [link("bus", **BOX)], "bus", 0.6
    axes = ("0 0 1", "0 1 0", "1 0 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
    for k, axis in enumerate(axes, start=1):
        length = float(random.uniform(0.15, 0.5))
        parts.append(rod(f"part_{k}", length, 10.0 * length + 2.0))
        parts.append(
            joint(f"turn_{k}", parent, f"part_{k}", axis=axis, xyz=f"0 0 {height}", limit=turn)
        )
        parent, height = f"part_{k}", length
    return robot(*parts, name="generated")


def spacecraft_of(value, folder):
    """The scenario, a shipped name or a file, of a value of the factor ``spacecraft``."""
    if value in _SHIPPED:
        return _SHIPPED[value]
    target = value == "own servicer and target"
    text = generated_servicer() if value == "generated servicer" else outside_urdfs.six_joints()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.urdf").write_text(text)
    (folder / "target.urdf").write_text(outside_urdfs.stage())
    # at the postures above a target of this side touches nothing
    options = {"target": folder / "target.urdf"} if target else {"payload_size": 0.8}
    return new_scenario(folder / "arm.urdf", folder / "made", **options).scenario_file
