"""The one list of what this package brings to the closed loop, and how else a block's factory is
found: by installed entry point, or ``module:attribute``.
"""

import functools
import importlib
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from ffsm_drake.common.errors import (
    BlockError,
    FfsmError,
    ScenarioError,
    choices,
    did_you_mean,
    one_line,
)
from ffsm_drake.common.guard import calling, failure, is_installed, passes
from ffsm_drake.common.registrations import Registry, plugin_of
from ffsm_drake.scenario import Grip, Scenario, kind_of, policy_parts
from ffsm_drake.scenario.contacts import ALL_HANDS
from ffsm_drake.systems.parts.actuator import BaseActuator
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.setup import BlockSetup

Factory = Callable[[BlockSetup], Any]


class ControllerFile(Protocol):
    """Returns the factory of a law in a file, such as a policy.

    Args: the path of the file; the name of the law, empty: the file's only one.
    """

    def __call__(self, path: Path, *, law: str) -> Factory: ...


_LAWS = "ffsm_drake.systems.controllers.laws"
# A new law of the core is one line.
CORE_LAWS = {
    "tdc": f"{_LAWS}.tdc:Tdc",
    "asmc": f"{_LAWS}.asmc:Asmc",
    "aismc": f"{_LAWS}.aismc:Aismc",
    "tde_aismc": f"{_LAWS}.tde_aismc:TdeAismc",
    "computed_torque": f"{_LAWS}.computed_torque:ComputedTorque",
    "pd_plus": f"{_LAWS}.pd_plus:PdPlus",
}
CORE_PARTS = {
    "reference": "ffsm_drake.systems.reference:PlannedReference",
    "sensing": "ffsm_drake.systems.sensing.part:Sensors",
    "forces.disturbance": "ffsm_drake.systems.disturbance:HarmonicDisturbance",
}


def _effect(name: str) -> Any:
    return lambda scenario: getattr(scenario.effects, name, None)


def _has_actuators(scenario: Scenario) -> bool:
    """Ideal ones too, where they can be made."""
    return not scenario.actuation.is_ideal or PARTS.find("actuation") is not None


# Sections of the scenario that a part describes, in the order of the parts, with whether a scenario
# uses one: a block of the same name, or a part within a block or beside it. See also ``PARTS``.
SECTIONS: dict[str, Callable[[Scenario], Any]] = {
    "reference": lambda _: True,
    "sensing": lambda _: True,
    "actuation": _has_actuators,
    "sensing.link": _effect("sensor_link"),
    "actuation.link": _effect("link"),
    "actuation.thrusters": lambda scenario: scenario.actuation.thrusters,
    "actuation.wheels": lambda scenario: scenario.actuation.wheels,
    "actuation.drives": lambda scenario: scenario.actuation.drives,
    "flexible": lambda scenario: scenario.model.flexible,
    "geometry": _effect("geometry"),
    "supervisor": lambda scenario: scenario.supervisor,
    "sensing.faults": lambda scenario: scenario.faults,
    "sensing.detection": lambda scenario: scenario.faults,
    "forces.disturbance": lambda _: True,
    "forces.contacts": lambda scenario: len(scenario.contacts) > 1,
    "forces.environment": lambda scenario: scenario.environment,
    "forces.backlash": _effect("backlash"),
    "forces.gripper": lambda scenario: scenario.closing,
    "forces.jam": lambda scenario: scenario.faults,
    "forces.plume": lambda scenario: getattr(scenario.actuation.thrusters, "plume", None),
}


# A policy found so far -> the folder that its file's name is relative to, and the file.
_POLICIES: dict[str, tuple[Path, Path]] = {}
# Block -> the factories that can fill it.
FACTORIES = {
    "reference": Registry[Factory]("reference"),
    "sensing": Registry[Factory]("sensing"),
    "controller": Registry[Factory]("controllers", CORE_LAWS),
    "actuation": Registry[Factory]("actuation"),
    "forces": Registry[Factory]("forces"),
    "phases": Registry[Factory]("phases"),
}
# By the section of the scenario that a part describes.
PARTS = Registry[type[Part]]("sections", CORE_PARTS)
# By the beginning of ``KIND:FILE@LAW``.
CONTROLLER_FILES = Registry[ControllerFile]("controller_files")


def block_names(block: str) -> tuple[str, ...]:
    """Return names of the systems that can fill a block: shipped, then installed."""
    return tuple(FACTORIES[block].offers())


def shipped_names(block: str) -> tuple[str, ...]:
    """Return names of the systems of this package, its plug-ins included, that can fill a block."""
    return tuple(name for name in block_names(block) if is_shipped_name(block, name))


def is_shipped_name(block: str, name: str) -> bool:
    """True if a name stands for a system of this package."""
    offer = FACTORIES[block].offer(name)
    return name in FACTORIES[block].core or (offer is not None and plugin_of(offer.module) != "")


def section_parts(
    scenario: Scenario, given: Iterable[str] = (), *, of: str = "", grip: Grip = ALL_HANDS
) -> dict[str, Part]:
    """Return the parts of a scenario's own sections, by block and section; none for a block with
    another factory, such as those ``given``.

    ``of``: only the parts within one block, such as the actuators of ``actuation``; ``grip``: those
    in a phase; default: in any.
    """
    filled = {*scenario.blocks.choices(), *given}
    found = {
        name: section_kind(name).of(scenario)
        for name, is_used in SECTIONS.items()
        if name.startswith(f"{of}." if of else "")
        and not filled & {name, kind_of(name)}
        and is_used(scenario)
    }
    held = {name: part.held_by(grip) for name, part in found.items() if part is not None}
    return {name: part for name, part in held.items() if part is not None}


def base_actuators(scenario: Scenario) -> dict[str, BaseActuator]:
    """Return the base's actuators of a scenario's section ``actuation``, by section; none where a
    block replaces it.
    """
    parts = section_parts(scenario, of="actuation")
    return {name: part for name, part in parts.items() if isinstance(part, BaseActuator)}


@functools.cache
def section_kind(name: str) -> type[Part]:
    """Return the part of a section of the scenario. Raises BlockError: its plug-in has been
    deleted.
    """
    return PARTS.load(name, f"the scenario's section '{name}'")


def section_kinds() -> Iterator[type[Part]]:
    """The parts of all sections, of those that are installed."""
    for name in SECTIONS:
        if (kind := PARTS.find(name)) is not None:
            yield kind


def find_factory(
    block: str, name: str, *, key: str = "", python_path: Sequence[str] = ()
) -> Factory:
    """Return the factory of a block.

    Args:
      block: "controller", "sensing", ... as in ``FACTORIES``.
      name: a shipped or installed name, ``module:attribute``, or for a controller ``policy:FILE``
        or ``policy:FILE@LAW``.
      key: the name's place in the scenario, for errors; default: the block.
      python_path: folders to search for the module before Python's own.

    Raises:
      ScenarioError: an unknown name.
      BlockError: it cannot be imported or called.
    """
    place = f"{key or block} '{name}'"
    try:
        if block == "controller" and (policy := policy_parts(name)):
            read = CONTROLLER_FILES.load("policy", place)
            factory = read(_policy_file(name, policy[0], place, python_path), law=policy[1])
        elif ":" in name:
            factory = _load(name, place, python_path)
        elif offer := FACTORIES[block].offer(name):
            factory = offer.load()
        else:
            names = block_names(block)
            choice = f", or choose one of {choices(name, names)}" if names else ""
            raise ScenarioError(key or block, f"'{name}' is unknown; give module:attribute{choice}")
    except FfsmError:
        raise
    except ModuleNotFoundError as error:
        if plugin := plugin_of(str(error.name)):
            missing = f"the plug-in '{plugin}' is not installed: {one_line(error)}"
            raise BlockError(f"{place}: {missing}") from error
        if (right := name.replace(".py:", ":")) != name:
            raise BlockError(
                f"{place}: must be module:attribute, without .py; write {right}"
            ) from error
        raise BlockError(
            f"{place} cannot be loaded: run from the folder of the module, or add that folder to "
            f"python_path or PYTHONPATH ({one_line(error)})"
        ) from error
    except BaseException as error:  # a user's module may raise anything on import
        if passes(error):
            raise
        raise failure(error, place, did="cannot be loaded") from error
    if not callable(factory):
        raise BlockError(f"{place} must be a class or function, not {type(factory).__name__}")
    return factory


def name_of(factory: Factory) -> str:
    """Return the name of a factory; of an object that is called, the name of its class."""
    return getattr(factory, "__name__", type(factory).__name__)


def address_of(factory: Factory) -> str:
    """``module:attribute`` of a factory, for ``find_factory``; else its name."""
    name = str(getattr(factory, "__qualname__", type(factory).__name__))
    module = str(getattr(factory, "__module__", "__main__"))
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return (
        f"{module}:{name}"
        if found is factory and module != "__main__"
        else re.sub(r"\W", "_", name)
    )


def call_factory(factory: Factory, setup: BlockSetup, *, place: str) -> Any:
    """Return the result of a factory for a setup. Raises BlockError naming ``place`` if it
    fails.
    """
    return calling(
        place, lambda: getattr(factory, "from_setup", factory)(setup), did="cannot be built"
    )


def _policy_file(name: str, file: str, place: str, python_path: Sequence[str]) -> Path:
    """Return the file of a policy, from the current folder or one of ``python_path``."""
    for folder in (Path.cwd(), *map(Path, python_path)):
        if (found := folder / file).is_file():
            _POLICIES[name] = folder, found
            return found
    where = "next to the scenario, in the current folder or in python_path"
    raise BlockError(f"{place}: no such file {where}")


def module_file(address: str) -> Path | None:
    """Return the file of the imported module in ``module:attribute``, or of a policy; None for an
    installed package.
    """
    if address in _POLICIES:
        return _POLICIES[address][1]
    file = getattr(sys.modules.get(address.partition(":")[0]), "__file__", None)
    if ":" not in address or file is None:
        return None
    return None if is_installed(file) else Path(file)


def module_folder(address: str) -> Path | None:
    """Return the folder to add to Python's path for ``module:attribute``; None under the conditions
    of ``module_file``.
    """
    if address in _POLICIES:
        return _POLICIES[address][0]
    file = module_file(address)
    if file is None:
        return None
    depth = address.partition(":")[0].count(".") + (file.name == "__init__.py")
    return file.parents[depth]


def _load(address: str, place: str, python_path: Sequence[str]) -> Any:
    name, _, attribute = address.partition(":")
    top = name.partition(".")[0]
    folders = [
        folder
        for folder in python_path
        if any(Path(folder).glob(f"{top}.py")) or Path(folder, top).is_dir()
    ]
    with _first_on_path(folders):
        found: Any = importlib.import_module(name)
    folder = module_folder(address)
    if (
        folders
        and folder is not None
        and str(folder.resolve()) not in [str(Path(item).resolve()) for item in folders]
        and not _has_copy(folders[0], folder, address)
    ):
        raise BlockError(
            f"{place}: a module '{top}' from {folder} is loaded already; rename one of them"
        )
    for part in attribute.split("."):
        if not hasattr(found, part):
            near = [other for other in dir(found) if callable(getattr(found, other, None))]
            raise BlockError(f"{place}: {name} has no '{attribute}'{did_you_mean(part, near)}")
        found = getattr(found, part)
    return found


def _has_copy(place: str, folder: Path, address: str) -> bool:
    """Whether a folder holds a copy of a module's file from another folder."""
    file = module_file(address) or folder
    try:
        return Path(place, file.relative_to(folder)).read_bytes() == file.read_bytes()
    except OSError:
        return False


@contextmanager
def _first_on_path(folders: Sequence[str]) -> Iterator[None]:
    before = list(sys.path)
    sys.path[:0] = folders
    try:
        yield
    finally:
        sys.path[:] = before
