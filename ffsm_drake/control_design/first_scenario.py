"""The starting scenario for a URDF: a folder with a commented YAML file, the URDF as Drake loads
it, and its meshes.
"""

import dataclasses
import re
import shlex
import shutil
import tempfile
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ffsm_drake.common.errors import FfsmError, ModelError, RecordError, ScenarioError, one_line
from ffsm_drake.common.files import check_writable, published, write_text
from ffsm_drake.common.interrupts import unfinished
from ffsm_drake.control_design.asked import Asked
from ffsm_drake.control_design.first_mission import Fitting
from ffsm_drake.control_design.first_motion import (
    OMEGA,
    Motion,
    plan_motion,
    scaled_disturbance,
    starting_gains,
)
from ffsm_drake.control_design.rounding import rounded
from ffsm_drake.control_design.stability import Margins, stability
from ffsm_drake.control_design.stability.planned_dynamics import PlannedDynamics
from ffsm_drake.scenario import (
    Disturbance,
    Scenario,
    from_grasp,
    scenario_from_dict,
    shipped_scenarios,
    write_yaml,
)
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import make_nominal_plant, make_true_plant
from ffsm_drake.spacecraft.plant import check_pictures
from ffsm_drake.spacecraft.urdf import (
    Joint,
    Servicer,
    Target,
    make_bus,
    read_target,
    read_urdf,
    write_urdf,
)
from ffsm_drake.systems.controllers import make_law
from ffsm_drake.systems.registry import SHIPPED

_BODY = "debris::debris"
_TARGET = "target"  # folder of a user's
_PAYLOAD_SHARE = 0.25  # of the base's mass
_NOMINAL_SHARE = 0.8  # of the payload's true mass and inertia
_SIDE = 1.0  # m, of the shipped target
_SAMPLE_TIME = 0.01  # s
_HOLD, _LONG_HOLD = 5.0, 20.0  # s, the target posture is held; with real sensors or actuators
_APPROACH = 20.0  # s
_INSTANTS = 201  # of the planned motion, at which its force is looked at
_SHRINK, _TRIES = 0.7, 6  # of the natural frequencies, until the margins are comfortable
_MARGIN = 1.5  # that the bound of K_s and the sample time keep to their limits

_COMMENTS = {
    "description": "A start, written by 'ffsm new': everything here is meant to be edited. Keys "
    "that are not here keep "
    "their defaults; 'ffsm schema' lists all, with meaning and unit. Units: m, kg, s, rad, N. A "
    "value by coordinate "
    "takes the keys all, base_rotation, base_position, joints, or one coordinate's name "
    "(base_rotation_x, "
    "base_position_z, a joint's); the most specific one wins.",
    "duration": "Of the run, and of one period of the controller.",
    "simulator_config": "Fixed steps of third order: accurate, and repeatable bit for bit.",
    "model": "Paths start at this file's folder. The target's frame (grasp) is welded to that of "
    "the servicer "
    "(end_effector).",
    "payload": "The target: its true mass properties, and the nominal ones that the controller "
    "uses; rather too light "
    "than too heavy. Inertia about the centre of mass: [Ixx, Iyy, Izz] or [Ixx, Iyy, Izz, Ixy, "
    "Ixz, Iyz].",
    "reference": "Duration of the planned motion; the target posture is held afterwards.",
    "controller": f"One of {', '.join(SHIPPED['controller'])}.",
    "controllers": "By controller, for the same natural frequencies of the error; controllers that "
    "are not here have their defaults. With the sample time L and a known inertia, the sampled "
    "loop of a time-delay law is stable for (K_D + K_s) L < 2.",
    "disturbance": "Force on each coordinate: amplitude * sin(frequency * t + phase) + bias.",
    "sensing": "Standard deviation per sample; 1.0e-06 of velocities alone is near perfect, as in "
    "the paper. For real sensors see the scenario flight_sensors and 'ffsm design'.",
    "actuation": "Largest force of each joint: the effort limits of the URDF. Without thrusters or "
    "wheels the base's force is not limited.",
    "estimator": "Of the disturbance, for these sensors.",
    "tolerance": "A run has settled when over its last second every error stays within this, rad "
    "or m.",
    "capture": "The grasp, in the initial posture, of a target that tumbles at rate (rad/s, its "
    "own axes); before it the approach, from rest and along the grasp axis.",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class NewScenario:
    """A scenario that was made from a URDF."""

    servicer: Servicer
    scenario_file: Path
    motion: Motion
    payload_mass: float  # kg, true
    # of the laws by axis, the worst over coordinates and postures
    margins: Mapping[str, Mapping[str, Any]]
    remarks: tuple[str, ...]

    def data(self) -> dict[str, Any]:
        """All findings and choices as plain data in SI units; infinite: no limit."""
        found = self.servicer
        joint_keys = ("name", "kind", "unit", "lower", "upper", "effort", "velocity")
        return {
            "scenario": str(self.scenario_file),
            "files": [
                str(path) for path in sorted(self.scenario_file.parent.rglob("*")) if path.is_file()
            ],
            "base": {"link": found.base, "mass": found.base_mass},
            "total_mass": found.total_mass,
            "payload_mass": self.payload_mass,
            "joints": [{key: getattr(joint, key) for key in joint_keys} for joint in found.joints],
            "tip": found.tip.frame,
            "tips": [dataclasses.asdict(tip) for tip in (found.tip, *found.other_tips)],
            "duration": self.motion.duration,
            "peak_force": dict(self.motion.peak_force),
            "margins": dict(self.margins),
            "remarks": list(self.remarks),
        }

    def summary(self) -> str:
        """The findings as text: base, joints, tip, masses, margins, and the commands that
        come next.
        """
        found = self.servicer
        lines = [
            f"base        {found.base}, {found.base_mass:.4g} kg of {found.total_mass:.4g} kg; "
            "holds a target of "
            f"{self.payload_mass:.4g} kg",
            f"tip         {found.tip.frame}, {len(found.tip.joints)} joints, reach "
            f"{found.tip.reach:.3g} m",
        ]
        for tip in found.other_tips:
            tip_length = f"{len(tip.joints)} joints, reach {tip.reach:.3g} m"
            lines.append(f"            or {tip.frame}, {tip_length}: --tip {tip.frame}")
        lines += ["", f"{'joint':<28}{'kind':<12}{'limits':>24}{'peak force':>14}"]
        for joint in found.joints:
            unit, peak = "N" if joint.unit == "m" else "N m", self.motion.peak_force[joint.name]
            lines.append(
                f"{joint.name:<28}{joint.kind:<12}{_limits(joint):>24}{peak:>10.3g} {unit}"
            )
        lines += ["", f"planned motion of {self.motion.duration:g} s"]
        if self.margins:
            lines[-1] += "; sampled-loop margins, worst coordinate and posture:"
            lines.append(
                f"{'controller':<12}{'K_s bound':>10}{'limit, 1/s':>12}"
                f"{'largest L, ms':>15}{'eta met':>14}"
                f"{'tolerated':>14}  verdict"
            )
        for name, worst in self.margins.items():
            gains = f"{worst['k_s_bound']:>10.3g}{worst['k_s_limit']:>12.4g}".replace("nan", "  -")
            met, tolerated = (
                f"{low:.2f}..{high:.2f}" for low, high in (worst["eta"], worst["eta_tolerated"])
            )
            longest = f"{1e3 * worst['sample_time_limit']:>15.1f}"
            lines.append(f"{name:<12}{gains}{longest}{met:>14}{tolerated:>14}  {worst['verdict']}")
        lines += ["", *(f"- {remark}" for remark in self.remarks)] if self.remarks else []
        entries = sorted(path.name for path in self.scenario_file.parent.iterdir())
        scenario = shlex.quote(str(_relative(self.scenario_file)))
        lines += [
            "",
            f"Written to {_relative(self.scenario_file.parent)}: {', '.join(entries)}",
            "Next:",
        ]
        return "\n".join(
            [
                *lines,
                *(f"  ffsm {command} {scenario}" for command in ("run", "compare", "stability")),
            ]
        )


def new_scenario(
    urdf: str | Path,
    directory: str | Path,
    *,
    tip: str | None = None,
    packages: Mapping[str, str | Path] | None = None,
    payload_mass: float | None = None,
    target: str | Path | None = None,
    bus_mass: float | None = None,
    bus_size: tuple[float, ...] | None = None,
    asked: Asked | None = None,
) -> NewScenario:
    """Write a folder with a scenario for the servicer of a URDF, the URDF as Drake loads it, and
    its meshes.

    The folder is complete in itself: it can be moved or sent. Nothing is written if an argument is
    refused.

    Args:
      urdf: the URDF of base and arm; the base is its root link.
      directory: the new folder, missing or empty; the scenario gets its name.
      tip: link or frame that holds the target; None for the end of the longest chain.
      packages: folders of the packages that mesh addresses name.
      payload_mass: true mass of the target, a cube of 1 m, kg; None for a quarter of the base's.
      target: URDF of the target in place of that: one rigid body, and a frame where it is held
        (``grasp``, or the only one), with z into the target.
      bus_mass: of a box on whose +z face the URDF's arm is mounted, kg; a fixed joint to ``world``
        says where. The box is the base then.
      bus_size: of that box, m: one side or three; None for a cube of 50 kg/m^3.
      asked: sensors, actuators, panels and a grasp; None for the paper's mission.

    Raises:
      ModelError: the URDF is not that of a free base with an arm; the message says what to change.
      ScenarioError: an argument cannot be used.
      RecordError: the folder cannot be written.
    """
    urdf, directory = Path(urdf), Path(directory).resolve()
    folders = {name: Path(folder) for name, folder in (packages or {}).items()}
    _check_arguments(directory, folders, payload_mass)
    if bus_size is not None and bus_mass is None:
        raise ScenarioError("--bus-size", "is that of a bus; give --bus-mass too")
    if target is not None and payload_mass is not None:
        raise ScenarioError("--target", "is a mass or a file, not both")
    bus = None if bus_mass is None else make_bus(bus_mass, bus_size)
    held = None if target is None else read_target(Path(target))
    servicer = read_urdf(urdf, tip=tip, bus=bus)
    mass = rounded(_PAYLOAD_SHARE * servicer.base_mass) if payload_mass is None else payload_mass
    try:
        with tempfile.TemporaryDirectory() as temporary, unfinished(Path(temporary)):
            folder = Path(temporary) / directory.name
            folder.mkdir()
            made = _make(
                servicer, folder, asked or Asked(), target=held, mass=mass, packages=folders
            )
            with published(directory) as new:
                shutil.copytree(folder, new, dirs_exist_ok=True)
    except OSError as error:
        raise RecordError(f"{directory}: cannot be written: {one_line(error)}") from error
    return dataclasses.replace(made, scenario_file=directory / made.scenario_file.name)


def _check_arguments(
    directory: Path, packages: Mapping[str, Path], payload_mass: float | None
) -> None:
    if directory.exists() and not directory.is_dir():
        raise ScenarioError("DIR", f"{directory} is a file; name a new folder")
    if directory.is_dir() and any(directory.iterdir()):
        raise ScenarioError("DIR", f"{directory} is not empty; name a new folder")
    if directory.name in shipped_scenarios():
        raise ScenarioError(
            "DIR", f"'{directory.name}' is the name of a scenario that ships; choose another"
        )
    check_writable(directory)
    for name, folder in packages.items():
        if not folder.is_dir():
            raise ScenarioError(f"--package {name}", f"no such folder: {folder}")
    if payload_mass is not None and not (np.isfinite(payload_mass) and payload_mass > 0.0):
        raise ScenarioError("--target", f"must be > 0 kg, not {payload_mass:g}")


def _make(
    servicer: Servicer,
    folder: Path,
    asked: Asked,
    *,
    target: Target | None,
    mass: float,
    packages: Mapping[str, Path],
) -> NewScenario:
    """Make everything in a folder that is still temporary."""
    file, margins, remarks = folder / f"{folder.name}.yaml", {}, list(servicer.remarks)
    try:
        draft, left_out = _write_models(servicer, folder, target, mass=mass, packages=packages)
        scenario = scenario_from_dict(draft, source=str(file))
        check_pictures(scenario.model)
        true = make_true_plant(scenario)
        body = draft["payload"]["body"]
        motion = plan_motion(true, servicer, body=body, model=scenario.model)
        if flexible := asked.flexible(servicer, true.plant):
            draft["model"]["flexible"] = flexible
        data = _scenario_data(servicer, motion, true.coordinates, draft, asked)
        remarks += left_out
        if asked.is_paper:
            margins = _choose_gains(data, motion, true.coordinates, file)
        else:
            fitting = Fitting(data, asked, true.coordinates, str(file))
            fitting.fit(motion)
            remarks += fitting.remarks
        motion = dataclasses.replace(
            motion,
            duration=data["reference"]["duration"],
            peak_force=_peak_force(scenario_from_dict(data, source=str(file))),
        )
    except FfsmError as error:
        # The line numbers in Drake's messages are those of the copy, not of the user's file.
        told = re.sub(r"([^/ ]+\.urdf):\d+: error: ", r"\1: ", str(error).replace(f"{folder}/", ""))
        raise ModelError(told) from error
    write_text(file, _commented_yaml(data, servicer.joints))
    if motion.distance < 0.0:
        remarks.append(
            f"no posture free of contact was found: parts overlap by {-motion.distance:.3g} m in "
            "the best; a smaller target, or another --tip"
        )
    if not all(each["stable"] for each in margins.values()):
        remarks.append("no gains tried are stable for all controllers; see 'ffsm stability'")
    weak = [joint.name for joint in servicer.joints if motion.peak_force[joint.name] > joint.effort]
    if weak:
        remarks.append(
            f"the motion needs more than the effort limit of {', '.join(weak)}: move "
            "less, or more slowly"
        )
    return NewScenario(
        servicer=servicer,
        scenario_file=file,
        motion=motion,
        payload_mass=draft["payload"]["truth"]["mass"],
        margins=margins,
        remarks=tuple(remarks),
    )


def _peak_force(scenario: Scenario) -> dict[str, float]:
    """The largest force by coordinate for perfect tracking of the planned motion, of a capture from
    the grasp on, without disturbance; N m or N.
    """
    still = dataclasses.replace(scenario, disturbance=Disturbance())
    planned = PlannedDynamics(from_grasp(still))
    _, force = planned.perfect_tracking(np.linspace(0.0, planned.motion.end, _INSTANTS))
    peaks = np.abs(force).max(axis=0).tolist()
    return dict(zip(planned.coordinates.names, peaks, strict=True))


def _write_models(
    servicer: Servicer,
    folder: Path,
    target: Target | None,
    *,
    mass: float,
    packages: Mapping[str, Path],
) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Write the URDFs: the scenario's sections ``model`` and ``payload``, and remarks on what was
    left out.
    """
    copied = f"{servicer.source.name.removesuffix('.urdf')}.urdf"
    left_out = [*write_urdf(servicer, folder, file_name=copied, packages=packages)]
    draft = _cube_draft(mass)
    if target is not None:
        name = f"{target.source.name.removesuffix('.urdf')}.urdf"
        stripped = write_urdf(target, folder / _TARGET, file_name=name, packages=packages)
        left_out += [f"target: {remark}" for remark in stripped]
        draft = _target_draft(target, f"{_TARGET}/{name}")
    draft["model"] |= {"servicer": copied, "end_effector": f"servicer::{servicer.tip.frame}"}
    return draft, left_out


def _choose_gains(
    data: dict[str, Any], motion: Motion, coordinates: Coordinates, file: Path
) -> dict[str, dict[str, Any]]:
    """Put gains of comfortable margins into a scenario's data.

    Returns: the margins of the laws by axis, by controller.
    """
    for attempt in range(_TRIES):
        omega = {group: rounded(_SHRINK**attempt * w) for group, w in OMEGA.items()}
        data["controllers"] = starting_gains(
            omega, coordinates=coordinates, mass_matrices=motion.mass_matrices
        )
        scenarios = [
            scenario_from_dict(data | {"controller": name}, source=str(file))
            for name in data["controllers"]
        ]
        margins = {
            scenario.controller: _figures(stability(scenario, postures=9))
            for scenario in scenarios
            if make_law(scenario, make_nominal_plant(scenario)).by_axis is not None
        }
        if all(_is_comfortable(each) for each in margins.values()):
            break
    return margins


def _cube_draft(mass: float) -> dict[str, dict[str, Any]]:
    """The target that ships."""
    return {
        "model": {
            "servicer": "",
            "debris": "package://ffsm_drake/urdf/debris.urdf",
            "grasp": "debris::grasp",
        },
        "payload": {
            "body": _BODY,
            "truth": _cube(mass),
            "nominal": _cube(rounded(_NOMINAL_SHARE * mass)),
        },
    }


def _target_draft(target: Target, file: str) -> dict[str, dict[str, Any]]:
    """A target of the user's."""

    def share(part: float) -> dict[str, Any]:
        inertia = [float(f"{part * moment:.10g}") for moment in target.inertia]
        return {
            "mass": float(f"{part * target.mass:.10g}"),
            "center_of_mass": list(target.center_of_mass),
            "inertia": inertia,
        }

    return {
        "model": {"servicer": "", "debris": file, "grasp": f"debris::{target.grasp}"},
        "payload": {
            "body": f"debris::{target.body}",
            "truth": share(1.0),
            "nominal": share(_NOMINAL_SHARE),
        },
    }


def _cube(mass: float) -> dict[str, Any]:
    """Mass properties of a solid cube of the shipped target's size."""
    return {
        "mass": mass,
        "center_of_mass": [0.0] * 3,
        "inertia": [rounded(mass * _SIDE**2 / 6.0)] * 3,
    }


def _scenario_data(
    servicer: Servicer,
    motion: Motion,
    coordinates: Coordinates,
    draft: Mapping[str, Any],
    asked: Asked,
) -> dict[str, Any]:
    """The scenario as plain data, in the file's order; without gains."""
    efforts = {joint.name: joint.effort for joint in servicer.joints if joint.effort < 1e20}
    sections = asked.sections()
    actuation = {**({"limit": efforts} if efforts else {}), **sections.pop("actuation", {})}
    initial, target = (dataclasses.asdict(each) for each in (motion.initial, motion.target))
    for group, field in (("base_position", "base_position"), ("base_rotation", "base_rpy")):
        if not asked.drives(group):
            target[field] = initial[field]
    harmonics = {
        name: harmonic
        for (name, harmonic), group in zip(
            scaled_disturbance(motion, coordinates).items(), coordinates.group_of, strict=True
        )
        if asked.drives(group)
    }
    before = 0.0
    if asked.has_approach:
        before = _APPROACH
        sections["capture"]["approach"] = {
            "duration": before,
            "posture": dict(initial),
        }
    sensing = sections.pop("sensing", {"velocity_noise": 1e-6, "position_noise": 0.0})
    return {
        "description": f"{asked.mission} with {servicer.source.stem}",
        "random_seed": 0,
        "duration": before + motion.duration + (_HOLD if asked.is_paper else _LONG_HOLD),
        "sample_time": _SAMPLE_TIME,
        "simulator_config": {"integration_scheme": "runge_kutta3", "max_step_size": _SAMPLE_TIME},
        **draft,
        "initial_posture": initial,
        "target_posture": target,
        "reference": {"duration": motion.duration},
        "controller": Scenario.controller if asked.is_paper else "tdc",
        "controllers": {},
        "disturbance": {
            "amplitude_scale": 1.0,
            "harmonics": harmonics,
        },
        "sensing": sensing,
        **({"actuation": actuation} if actuation else {}),
        **sections,
    }


def _commented_yaml(data: Mapping[str, Any], joints: tuple[Joint, ...]) -> str:
    """YAML with a comment above the keys that have one, nested values on one line where they are
    short.
    """
    comments = {
        **_COMMENTS,
        "initial_posture": "Joint limits: " + "; ".join(f"{j.name} {_limits(j)}" for j in joints),
    }
    parts = []
    for key, value in data.items():
        is_nested = isinstance(value, Mapping) and any(
            isinstance(each, (Mapping, list)) for each in value.values()
        )
        style = None if is_nested else False
        text = write_yaml({key: value}, allow_unicode=True, width=100, default_flow_style=style)
        comment = "".join(f"# {line}\n" for line in textwrap.wrap(comments.get(key, ""), 116))
        parts.append(("\n" if comment or isinstance(value, Mapping) else "") + comment + text)
    return "".join(parts).lstrip()


def _limits(joint: Joint) -> str:
    return (
        f"{joint.lower:.4g} to {joint.upper:.4g} {joint.unit}"
        if joint.is_limited
        else ("no limits")
    )


def _figures(margins: Margins) -> dict[str, Any]:
    """The sampled-loop margins of a law by axis in SI units; NaN for the K_s of a law without."""
    eta, axes = margins.eta, margins.axes
    assert axes is not None
    return {
        "verdict": margins.verdict,
        "stable": margins.is_stable,
        "spectral_radius": margins.worst.spectral_radius,
        "k_s_bound": float("nan") if np.isnan(axes.k_s_limit).all() else float(axes.k_s_max.max()),
        "k_s_limit": float(axes.k_s_limit.min()),
        "sample_time_limit": float(axes.sample_time_limit.min()),
        "eta": (float(eta.min()), float(eta.max())),  # met along the motion
        "eta_tolerated": (
            float(axes.eta_tolerated[:, 0].max()),
            float(axes.eta_tolerated[:, 1].min()),
        ),
    }


def _is_comfortable(margins: Mapping[str, Any]) -> bool:
    enough_k_s = not margins["k_s_limit"] < _MARGIN * margins["k_s_bound"]
    return (
        margins["verdict"] == "stable"
        and enough_k_s
        and margins["sample_time_limit"] >= _MARGIN * _SAMPLE_TIME
    )


def _relative(path: Path) -> Path:
    """Relative to the working directory where that is shorter to type."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
