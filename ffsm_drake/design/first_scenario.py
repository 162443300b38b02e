"""The starting scenario: gains inside the sampled-loop margin, the commented YAML, and what is told about it."""

import dataclasses
import json
import re
import shlex
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ffsm_drake.common.errors import FfsmError, ModelError, RecordError, ScenarioError, one_line
from ffsm_drake.common.files import write_text
from ffsm_drake.design.first_motion import Motion, plan_motion, scaled_disturbance
from ffsm_drake.design.stability import Margins, assess
from ffsm_drake.scenario import (
    Harmonic,
    MassProperties,
    Model,
    Payload,
    Scenario,
    load_scenario,
    override_scenario,
    shipped_scenarios,
)
from ffsm_drake.spacecraft.coordinates import GROUPS
from ffsm_drake.spacecraft.nominal import make_true_plant
from ffsm_drake.spacecraft.plant import check_pictures, configuration
from ffsm_drake.spacecraft.urdf import Joint, Servicer, read_urdf, write_flyable
from ffsm_drake.systems.controllers import PAPER_LAWS

_BODY = "debris::debris"
_PAYLOAD_SHARE = 0.25  # of the base's mass
_BELIEVED = 0.8  # of the payload's mass and inertia
_SIDE = 1.0  # m, of the shipped target
# Natural frequencies to start from, rad/s: K_P = w^2, K_D = 2 w; ASMC: K_D = w, K_s = 2 w.
_OMEGA = {"base_position": 10.0, "base_rotation": 15.0, "joints": 20.0}
_SHRINK, _TRIES = 0.7, 6
_MARGIN = 1.5  # that the bound of K_s and the sample time keep to their limits
_HOLD = 5.0  # s, the target posture is held


@dataclasses.dataclass(frozen=True, kw_only=True)
class ControllerMargins:
    """What the sampled-loop analysis says of one controller, the worst over coordinates and postures."""

    verdict: str
    stable: bool
    spectral_radius: float
    k_s_bound: float  # 1/s, NaN for a law without K_s
    k_s_limit: float  # 1/s
    sample_time_limit: float  # s
    eta: tuple[float, float]  # met along the motion
    eta_tolerated: tuple[float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Onboarding:
    """A servicer that has become a scenario."""

    servicer: Servicer
    scenario_file: Path
    files: tuple[Path, ...]
    motion: Motion
    coordinates: tuple[str, ...]
    units: tuple[str, ...]
    payload_mass: float  # kg, true
    margins: Mapping[str, ControllerMargins]
    remarks: tuple[str, ...]

    def data(self) -> dict[str, Any]:
        """Everything found and chosen, as plain data in SI units; numbers without limit are null."""

        def number(value: float) -> float | None:
            return value if np.isfinite(value) else None

        found = self.servicer
        tips = (found.tip, *found.other_tips)
        return {
            "scenario": str(self.scenario_file),
            "files": [str(path) for path in self.files],
            "base": {"link": found.base, "mass": found.base_mass},
            "total_mass": found.total_mass,
            "payload_mass": self.payload_mass,
            "joints": [
                {"name": j.name, "kind": j.kind, "unit": j.unit}
                | {key: number(getattr(j, key)) for key in ("lower", "upper", "effort", "velocity")}
                for j in found.joints
            ],
            "tip": tips[0].frame,
            "tips": [{"frame": tip.frame, "joints": list(tip.joints), "reach": tip.reach} for tip in tips],
            "duration": self.motion.duration,
            "peak_force": dict(zip(self.coordinates, self.motion.peak_force.tolist(), strict=True)),
            "margins": {
                name: {
                    key: number(value) if isinstance(value, float) else value
                    for key, value in dataclasses.asdict(margins).items()
                }
                for name, margins in self.margins.items()
            },
            "remarks": list(self.remarks),
        }


def onboard(
    urdf: str | Path,
    directory: str | Path,
    *,
    tip: str | None = None,
    packages: Mapping[str, str | Path] | None = None,
    payload_mass: float | None = None,
) -> Onboarding:
    """Write a folder with a scenario for the servicer of a URDF, the URDF as Drake takes it, and its meshes.

    The folder is complete in itself: it can be moved or sent. Nothing is left behind when something is refused.

    Args:
      urdf: the URDF of base and arm; the base is its root link.
      directory: the new folder, missing or empty; the scenario gets its name.
      tip: link or frame that holds the target; None for the end of the longest chain.
      packages: folders of the packages that mesh addresses name.
      payload_mass: true mass of the target, kg; None for a quarter of the base's.

    Raises:
      ModelError: the URDF is not that of a free base with an arm; the message says what to change.
      ScenarioError: an argument cannot be used.
      RecordError: the folder cannot be written.
    """
    urdf, directory = Path(urdf), Path(directory).resolve()
    folders = {name: Path(folder) for name, folder in (packages or {}).items()}
    _check_arguments(directory, folders, payload_mass)
    servicer = read_urdf(urdf, tip=tip)
    mass = float(f"{_PAYLOAD_SHARE * servicer.base_mass:.3g}") if payload_mass is None else payload_mass
    file_name = urdf.name if urdf.suffix == ".urdf" else f"{urdf.name}.urdf"
    try:
        missing = [folder for folder in (directory, *directory.parents) if not folder.exists()]
        directory.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{directory.name}.", dir=directory.parent) as temporary:
            built = _build(
                servicer, Path(temporary), name=directory.name, file_name=file_name, mass=mass, folders=folders
            )
            directory.mkdir(exist_ok=True)
            for path in sorted(Path(temporary).iterdir()):
                path.replace(directory / path.name)
            missing = []
    except OSError as error:
        raise RecordError(f"{directory}: cannot be written: {one_line(error)}") from error
    finally:
        for folder in missing:
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
    return dataclasses.replace(
        built,
        scenario_file=directory / built.scenario_file,
        files=tuple(sorted(path for path in directory.rglob("*") if path.is_file())),
    )


def _check_arguments(directory: Path, packages: Mapping[str, Path], payload_mass: float | None) -> None:
    if directory.exists() and not directory.is_dir():
        raise ScenarioError("DIR", f"{directory} is a file; name a new folder")
    if directory.is_dir() and any(directory.iterdir()):
        raise ScenarioError("DIR", f"{directory} is not empty; name a new folder")
    if directory.name in shipped_scenarios():
        raise ScenarioError("DIR", f"'{directory.name}' is the name of a scenario that ships; choose another")
    for name, folder in packages.items():
        if not folder.is_dir():
            raise ScenarioError(f"--package {name}", f"no such folder: {folder}")
    if payload_mass is not None and not (np.isfinite(payload_mass) and payload_mass > 0.0):
        raise ScenarioError("--payload-mass", f"must be > 0 kg, not {payload_mass:g}")


def _build(
    servicer: Servicer, folder: Path, *, name: str, file_name: str, mass: float, folders: Mapping[str, Path]
) -> Onboarding:
    """Everything, in a folder that is still temporary; ``scenario_file`` is relative to it."""
    left_out = write_flyable(servicer, folder, file_name=file_name, packages=folders)
    scenario_file = f"{name}.yaml"
    try:
        truth = _cube(mass)
        draft = Scenario(
            model=Model(
                directives=None, servicer=str(folder / file_name), end_effector=f"servicer::{servicer.tip.frame}"
            ),
            payload=Payload(body=_BODY, truth=truth, nominal=_cube(float(f"{_BELIEVED * mass:.3g}"))),
        )
        true = make_true_plant(draft)
        motion = plan_motion(true, servicer, body=_BODY)
        harmonics = scaled_disturbance(true, configuration(true.plant, motion.target, key="target_posture"))
        omega = dict(_OMEGA)
        for attempt in range(_TRIES):
            write_text(
                folder / scenario_file,
                _scenario_text(
                    servicer, motion, harmonics, omega, name=name, file_name=file_name, payload=draft.payload
                ),
            )
            scenario = load_scenario(folder / scenario_file)
            if attempt == 0:
                check_pictures(scenario.model)  # what this objects to is no matter of gains
            margins = {
                each: _worst(assess(override_scenario(scenario, [f"controller={each}"]), postures=9))
                for each in PAPER_LAWS
            }
            if all(_is_comfortable(each, scenario.sample_time) for each in margins.values()):
                break
            omega = {group: float(f"{_SHRINK * value:.2g}") for group, value in omega.items()}
    except FfsmError as error:
        # Drake counts the copy's lines, which nobody has seen.
        told = re.sub(rf"{re.escape(file_name)}:\d+: error: ", f"{file_name}: ", str(error).replace(f"{folder}/", ""))
        raise ModelError(told) from error
    remarks = [*servicer.remarks, *left_out]
    if not all(each.stable for each in margins.values()):
        remarks.append("no gains tried are stable for all controllers; see 'ffsm stability'")
    outside = _beyond_effort(servicer.joints, true.coordinates.joints, motion)
    if outside:
        remarks.append(
            f"the motion needs more than the effort limit of {', '.join(outside)}: move less, or more slowly"
        )
    return Onboarding(
        servicer=servicer,
        scenario_file=Path(scenario_file),
        files=(),
        motion=motion,
        coordinates=true.coordinates.names,
        units=true.coordinates.units,
        payload_mass=mass,
        margins=margins,
        remarks=tuple(remarks),
    )


def _cube(mass: float) -> MassProperties:
    """A solid cube of the shipped target's size."""
    return MassProperties(mass=mass, inertia=[float(f"{mass * _SIDE**2 / 6.0:.3g}")] * 3)


def _beyond_effort(joints: tuple[Joint, ...], order: tuple[str, ...], motion: Motion) -> list[str]:
    efforts = {joint.name: joint.effort for joint in joints}
    return [
        name for name, peak in zip(order, motion.peak_force[-len(order) :], strict=True) if peak > efforts[name]
    ]  # fmt: skip


def _worst(margins: Margins) -> ControllerMargins:
    has_k_s = margins.scenario.controller != "tdc"
    return ControllerMargins(
        verdict=margins.verdict,
        stable=margins.is_stable,
        spectral_radius=float(margins.spectral_radius.max()),
        k_s_bound=float(margins.law.k_s_max.max()) if has_k_s else float("nan"),
        k_s_limit=float(margins.k_s_limit.min()) if has_k_s else float("nan"),
        sample_time_limit=float(margins.sample_time_limit.min()),
        eta=(float(margins.eta.min()), float(margins.eta.max())),
        eta_tolerated=(float(margins.eta_tolerated[:, 0].max()), float(margins.eta_tolerated[:, 1].min())),
    )


def _is_comfortable(margins: ControllerMargins, sample_time: float) -> bool:
    enough_k_s = np.isnan(margins.k_s_bound) or margins.k_s_limit >= _MARGIN * margins.k_s_bound
    return margins.verdict == "stable" and bool(enough_k_s) and margins.sample_time_limit >= _MARGIN * sample_time


def _key(name: str) -> str:
    """A name as a YAML key."""
    plain = re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name) and name.lower() not in (
        "y", "n", "yes", "no", "on", "off", "true", "false", "null",
    )  # fmt: skip
    return name if plain else json.dumps(name)


def _flow(values: Mapping[str, float]) -> str:
    return "{" + ", ".join(f"{name}: {value:g}" for name, value in values.items()) + "}"


def _list(values: list[float]) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values) + "]"


def _joint_note(joint: Joint) -> str:
    limits = f"{joint.lower:.4g} to {joint.upper:.4g} {joint.unit}" if joint.is_limited else "no limits"
    return f"{joint.kind}, {limits}"


def _scenario_text(
    servicer: Servicer,
    motion: Motion,
    harmonics: Mapping[str, Harmonic],
    omega: Mapping[str, float],
    *,
    name: str,
    file_name: str,
    payload: Payload,
) -> str:
    joints = {joint.name: joint for joint in servicer.joints}

    def posture(joint_values: Mapping[str, float]) -> str:
        lines = [
            f"    {_key(each) + ':':<{width}} {value:<8.4g} # {_joint_note(joints[each])}"
            for each, value in joint_values.items()
        ]
        return "\n".join(lines)

    width = max(len(_key(each)) for each in joints) + 1
    w = {group: omega[group] for group in GROUPS}
    square, double = {g: x * x for g, x in w.items()}, {g: 2.0 * x for g, x in w.items()}
    disturbance = "\n".join(
        f"    {_key(each)}: {{amplitude: {h.amplitude:g}, frequency: {h.frequency:g}"
        + (f", phase: {h.phase:g}" if h.phase else "")
        + "}"
        for each, h in harmonics.items()
    )
    return f"""\
# Made by 'ffsm new' as a start: everything here is meant to be edited. What is not here keeps its default; all keys,
# with meaning and unit: 'ffsm schema'. Units: m, kg, s, rad, N. A value by coordinate takes the keys all,
# base_rotation, base_position, joints, or one coordinate's name (base_rotation_x, base_position_z, a joint's): the most
# specific one wins.
# Next: ffsm run {name}.yaml; ffsm stability {name}.yaml; ffsm compare {name}.yaml
description: {json.dumps(f"Post-capture stabilization with {servicer.source.stem}")}
random_seed: 0  # of the sensors' noise
duration: {motion.duration + _HOLD:g}  # s, of the run
sample_time: 0.01  # s; the controller's period

simulator_config:  # fixed steps of third order: exact enough, and the same bits every time
  integration_scheme: runge_kutta3
  max_step_size: 0.01  # s
  use_error_control: false

model:  # paths start at this file's folder
  servicer: {json.dumps(file_name)}  # base link '{servicer.base}'
  debris: package://ffsm_drake/urdf/debris.urdf  # the target that ships, a 1 m cube
  end_effector: {json.dumps(f"servicer::{servicer.tip.frame}")}  # holds the target ...
  grasp: debris::grasp  # ... by this frame

payload:  # the target; its inertia is about its centre of mass: [Ixx, Iyy, Izz] or those and [Ixy, Ixz, Iyz], kg m^2
  body: {payload.body}
  truth:  # as it is: a solid cube of {_SIDE:g} m
    mass: {payload.truth.mass:g}
    center_of_mass: {_list(payload.truth.center_of_mass)}
    inertia: {_list(payload.truth.inertia)}
  nominal:  # as the controller believes it to be; rather too light than too heavy
    mass: {payload.nominal.mass:g}
    center_of_mass: {_list(payload.nominal.center_of_mass)}
    inertia: {_list(payload.nominal.inertia)}

initial_posture:
  base_position: {_list(motion.initial.base_position)}
  base_rpy: {_list(motion.initial.base_rpy)}  # roll, pitch, yaw
  joints:
{posture(motion.initial.joints)}

target_posture:
  base_position: {_list(motion.target.base_position)}
  base_rpy: {_list(motion.target.base_rpy)}
  joints:
{posture(motion.target.joints)}

reference:
  duration: {motion.duration:g}  # s, of the planned motion; the target posture is held afterwards

# With w the natural frequency in rad/s, here w = {_flow(w)}:
# K_P = w^2, K_D = 2 w (TDC, AISMC, TDE-AISMC); K_D = w, K_s = 2 w (ASMC). Sampled every L seconds, a loop whose
# inertia is known bears (K_D + K_s) L < 2.
controller: tde_aismc  # or tdc, asmc, aismc
controllers:
  tdc:
    k_d: {_flow(double)}  # 1/s
    k_p: {_flow(square)}  # 1/s^2
  asmc:
    k_d: {_flow(w)}
    k_s: {_flow(double)}
  aismc:
    k_d: {_flow(double)}
    k_p: {_flow(square)}
    k_s_initial: {_flow(w)}  # 1/s
    k_s_max: {_flow(double)}  # 1/s; where adaptation must stop
  tde_aismc:
    k_d: {_flow(double)}
    k_p: {_flow(square)}
    k_s_initial: {_flow(w)}
    k_s_max: {_flow(double)}
    g_max: {_flow(dict.fromkeys(w, 2e-3))}  # rad/s^2 or m/s^2; bound of the switching gain

# Force on each coordinate, amplitude * sin(frequency * t + phase) + bias, scaled to this spacecraft: N m or N,
# rad/s, rad.
disturbance:
  amplitude_scale: 1.0
  harmonics:
{disturbance}

# Standard deviation per sample. Near perfect, as in the paper: for real sensors see the scenario flight_sensors, its
# Kalman estimate, and 'ffsm design {name}.yaml'.
sensing:
  velocity_noise: 1.0e-6  # rad/s or m/s
  position_noise: 0.0  # rad or m
"""


def onboarding_text(made: Onboarding) -> str:
    """What was found, for people: base, joints, tip, masses, margins, and the commands that come next."""
    found = made.servicer
    lines = [
        f"base        {found.base}, {found.base_mass:.4g} kg of {found.total_mass:.4g} kg; holds a target of "
        f"{made.payload_mass:.4g} kg",
        f"tip         {found.tip.frame}, {len(found.tip.joints)} joints, reach {found.tip.reach:.3g} m",
    ]
    for other in found.other_tips:
        lines.append(
            f"            or {other.frame}, {len(other.joints)} joints, reach {other.reach:.3g} m: --tip {other.frame}"
        )
    lines += ["", f"{'joint':<28}{'kind':<12}{'limits':>24}{'peak force':>14}"]
    peaks = dict(zip(made.coordinates, made.motion.peak_force, strict=True))
    for joint in found.joints:
        limits = _joint_note(joint).partition(", ")[2]
        unit = "N" if joint.unit == "m" else "N m"
        lines.append(f"{joint.name:<28}{joint.kind:<12}{limits:>24}{peaks[joint.name]:>10.3g} {unit}")
    lines += ["", f"planned motion of {made.motion.duration:g} s; sampled-loop margins, worst coordinate and posture:"]
    lines.append(
        f"{'controller':<12}{'K_s bound':>10}{'limit, 1/s':>12}{'largest L, ms':>15}{'eta met':>14}"
        f"{'tolerated':>14}  verdict"
    )
    for name, each in made.margins.items():
        has_k_s = np.isfinite(each.k_s_limit)
        gains = f"{each.k_s_bound:>10.3g}{each.k_s_limit:>12.4g}" if has_k_s else f"{'-':>10}{'-':>12}"
        met, tolerated = (f"{low:.2f}..{high:.2f}" for low, high in (each.eta, each.eta_tolerated))
        lines.append(f"{name:<12}{gains}{1e3 * each.sample_time_limit:>15.1f}{met:>14}{tolerated:>14}  {each.verdict}")
    lines += ["", *(f"- {remark}" for remark in made.remarks)] if made.remarks else []
    shown = shlex.quote(str(_shown(made.scenario_file)))
    entries = sorted({path.relative_to(made.scenario_file.parent).parts[0] for path in made.files})
    lines += [
        "",
        f"Written to {_shown(made.scenario_file.parent)}: {', '.join(entries)}",
        "Next:",
        f"  ffsm run {shown}",
        f"  ffsm compare {shown}",
        f"  ffsm stability {shown}",
    ]
    return "\n".join(lines)


def _shown(path: Path) -> Path:
    """Relative to the working directory where that is shorter to type."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
