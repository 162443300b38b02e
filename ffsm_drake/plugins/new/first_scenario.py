"""The first scenario for a URDF: a folder with a commented YAML file, the URDF as Drake loads it,
and its meshes.
"""

import copy
import dataclasses
import functools
import re
import shlex
import shutil
import tempfile
import textwrap
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ffsm_drake.common.errors import FfsmError, ModelError, RecordError, ScenarioError, one_line
from ffsm_drake.common.files import check_writable, published, write_text
from ffsm_drake.common.interrupts import unfinished
from ffsm_drake.common.numbers import counted, short
from ffsm_drake.common.steps import step
from ffsm_drake.plugins.design.rounding import rounded
from ffsm_drake.plugins.design.stability import Margins
from ffsm_drake.plugins.design.verdict import Verdict, verdict
from ffsm_drake.plugins.new.asked import Asked
from ffsm_drake.plugins.new.first_mission import Draft
from ffsm_drake.plugins.new.urdf.elements import Joint, listed
from ffsm_drake.plugins.new.urdf.mounting import make_bus
from ffsm_drake.plugins.new.urdf.servicer import Servicer, read_urdf
from ffsm_drake.plugins.new.urdf.target import SECOND, Target, cube, read_target
from ffsm_drake.plugins.new.urdf.writing import write_urdf
from ffsm_drake.scenario import Scenario, load_scenario, shipped_scenarios, write_yaml
from ffsm_drake.spacecraft.plant import check_pictures

_TEMPLATE = Path(__file__).with_suffix(".yaml")
_TARGET = "target"  # folder of a user's
_PAYLOAD_SHARE = 0.25  # share of the base's mass
_TRIES, _LIGHTER = 3, 0.4  # draws of postures; share of a target's mass
_OTHER_TIPS = 2  # number tried if a mission fails
_HALVED = 3  # times that the side of a target may be, until it touches nothing
_NOMINAL_SHARE = 0.8  # share of the payload's true mass and inertia


@dataclasses.dataclass(frozen=True, kw_only=True)
class NewScenario:
    """A scenario that was made from a URDF."""

    servicer: Servicer
    scenario_file: Path
    scenario: Scenario
    peak_force: Mapping[str, float]  # by coordinate, of perfect tracking of the motion, N m or N
    margins: Mapping[str, Margins]  # stability margins of the paper's mission, by controller
    side: float | None  # m, of a target that is a cube
    remarks: tuple[str, ...]
    mission: Verdict | None = None  # with ``rehearse``
    # Of a mission not expected to go as planned: the change of options that helps, or all tried.
    remedy: str = ""
    tried: tuple[str, ...] = ()

    def judged(self) -> "NewScenario":
        """Return the same scenario with the verdict on the mission in its file."""
        with step("predicting the mission"):
            mission = verdict(load_scenario(str(self.scenario_file)), advises=False)
        return dataclasses.replace(self, mission=mission)

    @property
    def is_as_planned(self) -> bool:
        """Whether no check speaks against the mission as planned."""
        return self.mission is None or self.mission.is_as_planned

    @property
    def payload_mass(self) -> float:
        """True mass of the target, kg."""
        return self.scenario.payload.truth.mass

    def data(self) -> dict[str, Any]:
        """All findings and choices as plain data in SI units; infinite: no limit."""
        found = self.servicer
        joint_keys = ("name", "kind", "unit", "lower", "upper", "effort", "velocity")
        files = sorted(path for path in self.scenario_file.parent.rglob("*") if path.is_file())
        return {
            "scenario": str(self.scenario_file),
            "files": list(map(str, files)),
            "base": {"link": found.base, "mass": found.base_mass},
            "total_mass": found.total_mass,
            "payload_mass": self.payload_mass,
            "payload_size": self.side,
            "joints": [{key: getattr(joint, key) for key in joint_keys} for joint in found.joints],
            "tip": found.tip.frame,
            "second_tip": None if found.second is None else found.second.frame,
            "other_frames": found.other_frames,
            "tips": [dataclasses.asdict(tip) for tip in (found.tip, *found.other_tips)],
            "duration": self.scenario.reference.duration,
            "peak_force": dict(self.peak_force),
            "margins": {
                name: {"verdict": each.verdict, "stable": each.is_stable}
                for name, each in self.margins.items()
            },
            "remarks": list(self.remarks),
            "remedy": self.remedy,
        }

    def summary(self) -> str:
        """Return the findings as text: base, joints, tip, masses, margins, next commands."""
        found, folder = self.servicer, _relative(self.scenario_file.parent)
        lines = [
            f"base        {found.base}, {short(found.base_mass, 4)} kg of "
            f"{short(found.total_mass, 4)} kg; holds a target of {short(self.payload_mass, 4)} kg"
            + (f", a cube of {self.side:g} m" if self.side else "")
        ]
        for tip in (found.tip, found.second, *found.other_tips):
            if tip is not None:
                length = f"{counted(len(tip.joints), 'joint')}, reach {tip.reach:.3g} m"
                other = f"            or {tip.frame}, {length}: --tip {tip.frame}"
                held = tip in (found.tip, found.second)
                lines.append(f"tip         {tip.frame}, {length}" if held else other)
        told = {tip.frame for tip in (found.second, *found.other_tips) if tip is not None}
        if others := [frame for frame in found.other_frames if frame not in told]:
            lines.append(f"            or {listed(others)}: --tip NAME")
        width = max(28, *(len(joint.name) + 2 for joint in found.joints))
        lines += ["", f"{'joint':<{width}}{'kind':<12}{'limits':>24}{'peak force':>14}"]
        for joint in found.joints:
            unit, peak = "N" if joint.unit == "m" else "N m", self.peak_force[joint.name]
            lines.append(
                f"{joint.name:<{width}}{joint.kind:<12}{_limits(joint):>24}{short(peak):>10} {unit}"
            )
        lines += ["", f"planned motion of {self.scenario.reference.duration:g} s"]
        if self.margins:
            verdicts = (f"{name} {each.verdict}" for name, each in self.margins.items())
            lines[-1] += f"; sampled loop: {', '.join(verdicts)}"
        entries = sorted(path.name for path in self.scenario_file.parent.iterdir())
        scenario = shlex.quote(str(folder / self.scenario_file.name))
        return "\n".join([
            *lines,
            *(["", *(f"- {remark}" for remark in self.remarks)] if self.remarks else []),
            "",
            f"Written to {folder}: {', '.join(entries)}",
            "Next:",
            *(f"  ffsm {verb} {scenario}" for verb in ("run", "compare", "stability", "design")),
        ])  # fmt: skip


def new_scenario(
    urdf: str | Path,
    directory: str | Path,
    *,
    tip: str | None = None,
    packages: Mapping[str, str | Path] | None = None,
    payload_mass: float | None = None,
    payload_size: float | None = None,
    target: str | Path | None = None,
    bus_mass: float | None = None,
    bus_size: tuple[float, ...] | None = None,
    asked: Asked | None = None,
    xacro_args: Mapping[str, str] | None = None,
    trust: bool = False,
    rehearse: bool = False,
) -> NewScenario:
    """Write a folder with a scenario for the servicer of a model file, its URDF for Drake, and its
    meshes.

    The folder is complete in itself, and can be moved or sent. Nothing is written if an argument is
    refused.

    Args:
      urdf: model of base and arm, with the base as its root link: URDF, xacro, MJCF or SDFormat.
      directory: new folder, missing or empty; the scenario has its name.
      tip: link or frame that holds the target; None: the end of the longest chain.
      packages: folders of the packages in mesh addresses.
      payload_mass: true mass of the target, a cube, kg; None: a quarter of the mass of the base.
      payload_size: side of the cube, m; None: from its mass and the reach of the arm.
      target: model file of the target, in place of a cube: one rigid body, and a frame where it is
        held (``grasp``, or the only one), with z into the target.
      bus_mass: mass of a box, kg, which becomes the base. The arm is mounted on its +z face, where
        a fixed joint to ``world`` is.
      bus_size: sides of the box, m: one or three; None: a cube of 50 kg/m^3.
      asked: sensors, actuators, panels and a grasp; None: the mission of the paper.
      xacro_args: values of the arguments of a xacro file.
      trust: allow xacro files ``load_yaml``, environment variables, and files outside the folder of
        the model and of packages.
      rehearse: run the mission. If its verdict is not good, try other options, which takes a
        multiple of the time.

    Raises:
      ModelError: the model is not a free base with an arm; the message names the change.
      ScenarioError: an argument cannot be used.
      RecordError: the folder cannot be written.
    """
    urdf, directory = Path(urdf), Path(directory).resolve()
    folders = {name: Path(folder) for name, folder in (packages or {}).items()}
    _check_arguments(directory, folders)
    for value, unit in ((payload_mass, "kg"), (payload_size, "m")):
        if value is not None and not (np.isfinite(value) and value > 0.0):
            raise ScenarioError("--target", f"must be > 0 {unit}, not {value:g}")
    if bus_size is not None and bus_mass is None:
        raise ScenarioError("--bus-size", "needs a bus; add --bus-mass KG")
    if target is not None and (payload_mass, payload_size) != (None, None):
        raise ScenarioError("--target", "is a mass or a file, not both")
    bus = None if bus_mass is None else make_bus(bus_mass, bus_size)
    with step("reading the target"):
        held = None if target is None else read_target(Path(target), folders, trust=trust)
    asked = asked or Asked()
    if asked.tips is not None and tip is not None:
        raise ScenarioError("--tip", "is one hand, and --tips are two; leave one of them out")
    first, second = asked.tips or (tip, None)

    def read(tip: str | None) -> Servicer:
        with step("reading the model"):
            return read_urdf(
                urdf, tip=tip, second=second, bus=bus, packages=folders, arguments=xacro_args,
                trust=trust,
            )  # fmt: skip

    servicer = read(first)
    try:
        with tempfile.TemporaryDirectory() as temporary, unfinished(Path(temporary)):

            def make(
                asked: Asked,
                mass: float | None = payload_mass,
                *,
                at: str | None = None,
                strict: bool = True,
            ) -> NewScenario:
                folder = Path(tempfile.mkdtemp(dir=temporary)) / directory.name
                folder.mkdir()
                return _make(
                    servicer if at is None else read(at), folder, asked, held, packages=folders,
                    mass=mass, side=payload_size, strict=strict,
                )  # fmt: skip

            made = make(asked, strict=False)
            if rehearse:
                others: dict[str, Callable[[], NewScenario]] = {
                    words: functools.partial(make, other) for words, other in asked.milder()
                }
                if held is None:
                    mass = rounded(_LIGHTER * made.payload_mass)
                    size = "" if payload_size is None else f",{payload_size:g}m"
                    others[f"give --target {mass:g}kg{size}"] = lambda: make(asked, mass)
                for frame in () if first else servicer.other_frames[:_OTHER_TIPS]:
                    words = f"give --tip {shlex.quote(frame)}"
                    others[words] = functools.partial(make, asked, at=frame)
                made = _rehearsed(made, others)
            with published(directory) as new:
                shutil.copytree(made.scenario_file.parent, new, dirs_exist_ok=True)
    except OSError as error:
        raise RecordError(f"{directory}: cannot be written: {one_line(error)}") from error
    return dataclasses.replace(made, scenario_file=directory / made.scenario_file.name)


def _rehearsed(made: NewScenario, others: Mapping[str, Callable[[], NewScenario]]) -> NewScenario:
    """Return a mission with its verdict and, if it is not expected to go as planned, an option that
    helps.

    Args:
      others: words for a change of options -> function that makes the scenario with it.
    """
    made = made.judged()
    if made.is_as_planned:
        return made
    for k, (words, make) in enumerate(others.items()):
        with step(f"trying a change, {k + 1} of {len(others)}: {words}"), suppress(FfsmError):
            if make().judged().is_as_planned:
                return dataclasses.replace(made, remedy=words)
    return dataclasses.replace(made, tried=tuple(others))


def _check_arguments(directory: Path, packages: Mapping[str, Path]) -> None:
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


def _make(
    servicer: Servicer,
    folder: Path,
    asked: Asked,
    target: Target | None,
    *,
    packages: Mapping[str, Path],
    mass: float | None,
    side: float | None,
    strict: bool,
) -> NewScenario:
    """Write everything into a temporary folder.

    Args:
      target: the target; None: a cube of a mass (kg) and side (m).
      strict: raise ScenarioError if no drawn posture has a plan without faults.
    """
    file, text = folder / f"{folder.name}.yaml", _TEMPLATE.read_text(encoding="utf-8")
    data = yaml.safe_load(text)
    mission = "Post-capture stabilization" if asked.capture is None else "Capture, to rest,"
    data["description"] = f"{mission} with {servicer.source.stem}"
    if asked.is_paper:
        data["controller"] = Scenario.controller
    efforts = {joint.name: joint.effort for joint in servicer.joints if joint.effort < 1e20}
    data["actuation"] = {"limit": efforts} if efforts else {}
    if asked.friction and (drives := servicer.drives):
        data["actuation"]["drives"] = drives
    asked.fill(data)
    given = target or cube(mass, side, servicer, share=_PAYLOAD_SHARE)

    def placed(target: Target, place: Path, seed: int = 0) -> tuple[list[str], Draft]:
        own = copy.deepcopy(data)
        left_out = _write_models(own, servicer, place, target, packages=packages)
        draft = Draft(own, asked, servicer, source=str(place / file.name), seed=seed)
        draft.place(target)
        return left_out, draft

    sides = [rounded((given.side or 0.0) * 0.5**k) for k in range(1, _HALVED + 1)]

    def clear(place: Path) -> Target | None:
        """Return the largest cube, of half the side, a quarter, ..., that touches nothing."""
        for each in sides:
            smaller = cube(given.mass, each, servicer, share=_PAYLOAD_SHARE)
            with step(f"trying a target of {each:g} m"):
                is_clear = not placed(smaller, place)[1].touching
            if is_clear:
                return smaller
        return None

    try:
        left_out, draft = placed(given, folder)
        check_pictures(draft.scenario.model)
        if draft.touching and given.side:
            with tempfile.TemporaryDirectory() as place:
                other = clear(Path(place) / folder.name)
            if other is not None and side is None:
                remark = f"the target is made smaller: {draft.touching}"
                left_out, draft = placed(other, folder)
                given, draft.remarks = other, [remark]
            elif other is not None:
                draft.touching += f"; --target {other.mass:g}kg,{other.side:g}m keeps clear"
        if not draft.is_held:
            tried = ", ".join(f"{each:g}" for each in sides)
            raise ScenarioError(
                "--tips",
                f"{draft.touching}{f'; nor one of {tried} m' if given.side else ''}; what may "
                "help: wider limits of the joints, longer arms, other hands, or "
                + ("another --target KG,M" if given.side else f"another place of '{SECOND}'"),
            )
        draft.pace()
        again = range(1, _TRIES if asked.capture is not None and asked.tips is None else 1)
        for seed in again if draft.faults else ():
            with step(f"trying other postures, {seed} of {len(again)}"):
                _, drawn = placed(given, folder, seed)
                drawn.pace()
            if not drawn.faults:
                drawn.remarks, draft = draft.remarks, drawn
                break
        if strict and draft.faults:
            raise ScenarioError("mission", draft.faults[0])
        draft.fill()
        scenario, forces = draft.scenario, draft.motion_forces()
    except FfsmError as error:
        # Line numbers in Drake's messages refer to the copy, not to the user's file.
        told = re.sub(r"([^/ ]+\.urdf):\d+: ", r"\1: ", str(error).replace(f"{folder}/", ""))
        raise ModelError(told) from error
    data = draft.written
    if "drives" in data["actuation"]:
        left_out = [each for each in left_out if "--friction" not in each]
    limits = "; ".join(f"{joint.name} {_limits(joint)}" for joint in servicer.joints)
    named = text.replace("LIMITS", limits).replace("CONTROLLERS", ", ".join(data["controllers"]))
    write_text(file, _filled(named, data))
    return NewScenario(
        servicer=servicer,
        scenario_file=file,
        scenario=scenario,
        peak_force=draft.coordinates.by_name(forces),
        margins=draft.margins,
        side=given.side,
        remarks=(*servicer.remarks, *left_out, *draft.remarks),
    )


@step("copying the model")
def _write_models(
    data: dict[str, Any],
    servicer: Servicer,
    folder: Path,
    target: Target,
    *,
    packages: Mapping[str, Path],
) -> list[str]:
    """Write the URDFs, and set models and payload in the data of a scenario.

    Returns: remarks on omitted parts.
    """
    copied, name = (f"{each.source.name.split('.')[0]}.urdf" for each in (servicer, target))
    left_out = [*write_urdf(servicer, folder, file_name=copied, packages=packages)]
    stripped = write_urdf(target, folder / _TARGET, file_name=name, packages=packages)
    left_out += [f"target: {remark}" for remark in (*target.remarks, *stripped)]
    payload, mass, inertia = data["payload"], target.mass, target.inertia
    data["model"] |= {
        "servicer": copied,
        "debris": f"{_TARGET}/{name}",
        "end_effector": f"servicer::{servicer.tip.frame}",
        "grasp": f"debris::{target.grasp}",
    }
    payload["body"] = f"debris::{target.body}"
    for name, share in (("truth", 1.0), ("nominal", _NOMINAL_SHARE)):
        payload[name] = {
            "mass": float(f"{share * mass:.15g}"),
            "center_of_mass": list(target.center_of_mass),
            "inertia": [float(f"{share * moment:.15g}") for moment in inertia],
        }
    return left_out


def _filled(template: str, data: Mapping[str, Any]) -> str:
    """Return the template with the data of a scenario, block by block.

    Short nested values are on one line, and empty sections are left out.
    """
    parts = list[str]()
    for block in template.split("\n\n"):
        comment = " ".join(re.findall("^# (.*)", block, re.MULTILINE))
        wrapped = "".join(f"# {line}\n" for line in textwrap.wrap(comment, 116))
        kept = {key: data[key] for key in yaml.safe_load(block) if data[key] != {}}
        for key, value in kept.items():
            is_nested = isinstance(value, Mapping) and any(
                isinstance(each, (Mapping, list)) for each in value.values()
            )
            wrapped += write_yaml(
                {key: value},
                allow_unicode=True,
                width=100,
                default_flow_style=None if is_nested else False,
            )
        parts += [wrapped] if kept else []
    return "\n".join(parts)


def _limits(joint: Joint) -> str:
    if not joint.is_limited:
        return "no limits"
    return f"{joint.lower:.4g} to {joint.upper:.4g} {joint.unit}"


def _relative(path: Path) -> Path:
    """Return the path relative to the working directory if it is inside."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
