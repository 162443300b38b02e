"""The first scenario for a URDF: a folder with a commented YAML file, the URDF as Drake loads it,
and its meshes.
"""

import dataclasses
import functools
import shlex
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from ffsm_drake.common.errors import FfsmError, RecordError, ScenarioError, one_line
from ffsm_drake.common.files import check_writable, published
from ffsm_drake.common.interrupts import unfinished
from ffsm_drake.common.steps import step
from ffsm_drake.plugins.design.rounding import rounded
from ffsm_drake.plugins.new.asked import Asked
from ffsm_drake.plugins.new.result import NewScenario
from ffsm_drake.plugins.new.scenario_folder import write_folder
from ffsm_drake.plugins.new.urdf.mounting import make_bus
from ffsm_drake.plugins.new.urdf.servicer import Servicer, read_urdf
from ffsm_drake.plugins.new.urdf.target import Target, read_target
from ffsm_drake.scenario import shipped_scenarios

_LIGHTER = 0.4  # share of a target's mass
_OTHER_TIPS = 2  # number tried if a mission fails


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
    _check_folders(directory, folders)
    _check_target(payload_mass, payload_size, target)
    if bus_size is not None and bus_mass is None:
        raise ScenarioError("--bus-size", "needs a bus; add --bus-mass KG")
    bus = None if bus_mass is None else make_bus(bus_mass, bus_size)
    with step("reading the target"):
        held = None if target is None else read_target(Path(target), folders, trust=trust)
    asked = asked or Asked()
    if asked.tips is not None and tip is not None:
        raise ScenarioError("--tip", "is one hand, and --tips are two; leave one of them out")
    first, second = asked.tips or (tip, None)
    read = functools.partial(
        read_urdf, urdf, second=second, bus=bus, packages=folders, arguments=xacro_args, trust=trust
    )
    with step("reading the model"):
        servicer = read(tip=first)
    try:
        with tempfile.TemporaryDirectory() as temporary, unfinished(Path(temporary)):
            maker = _Maker(
                read=read, servicer=servicer, target=held, packages=folders, mass=payload_mass,
                side=payload_size, place=Path(temporary), name=directory.name,
            )  # fmt: skip
            made = maker.make(asked, payload_mass, strict=False)
            if rehearse:
                tips = () if first else servicer.other_frames[:_OTHER_TIPS]
                made = _rehearsed(made, maker.others(asked, made.payload_mass, tips))
            with published(directory) as new:
                shutil.copytree(made.scenario_file.parent, new, dirs_exist_ok=True)
    except OSError as error:
        raise RecordError(f"{directory}: cannot be written: {one_line(error)}") from error
    return dataclasses.replace(made, scenario_file=directory / made.scenario_file.name)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Maker:
    """Makes a scenario with several options, each in a folder of its own."""

    read: Callable[..., Servicer]  # with another tip
    servicer: Servicer
    target: Target | None  # None: a cube of a mass (kg) and side (m)
    packages: Mapping[str, Path]
    mass: float | None
    side: float | None
    place: Path  # of the folders
    name: str

    def make(
        self, asked: Asked, mass: float | None, *, tip: str | None = None, strict: bool = True
    ) -> NewScenario:
        """Make it with other options, a mass (kg), and another tip."""
        servicer = self.servicer
        if tip is not None:
            with step("reading the model"):
                servicer = self.read(tip=tip)
        folder = Path(tempfile.mkdtemp(dir=self.place)) / self.name
        folder.mkdir()
        return write_folder(
            servicer, folder, asked, self.target, packages=self.packages, mass=mass,
            side=self.side, strict=strict,
        )  # fmt: skip

    def others(
        self, asked: Asked, mass: float, tips: Iterable[str]
    ) -> dict[str, Callable[[], NewScenario]]:
        """Functions that make it with other options, by the words for the change.

        Args: the options; the mass of the target, kg; other tips.
        """
        found: dict[str, Callable[[], NewScenario]] = {
            words: functools.partial(self.make, other, self.mass) for words, other in asked.milder()
        }
        if self.target is None:
            lighter = rounded(_LIGHTER * mass)
            size = "" if self.side is None else f",{self.side:g}m"
            found[f"give --target {lighter:g}kg{size}"] = functools.partial(
                self.make, asked, lighter
            )
        for tip in tips:
            words = f"give --tip {shlex.quote(tip)}"
            found[words] = functools.partial(self.make, asked, self.mass, tip=tip)
        return found


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


def _check_folders(directory: Path, packages: Mapping[str, Path]) -> None:
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


def _check_target(mass: float | None, size: float | None, target: str | Path | None) -> None:
    for value, unit in ((mass, "kg"), (size, "m")):
        if value is not None and not (np.isfinite(value) and value > 0.0):
            raise ScenarioError("--target", f"must be > 0 {unit}, not {value:g}")
    if target is not None and (mass, size) != (None, None):
        raise ScenarioError("--target", "is a mass or a file, not both")
