"""Objects that installed packages offer by entry points, the plug-ins of this package among them.

Each is imported on first use.
"""

import functools
import importlib.util
import re
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from ffsm_drake.common.errors import BlockError, FfsmError, did_you_mean, one_line
from ffsm_drake.common.guard import passes, where

# Name of a command -> click command. Its module imports slow packages inside of the command.
COMMANDS = "ffsm_drake.commands"
# Name -> function: an additional ``ffsm_drake.NAME``.
VERBS = "ffsm_drake.verbs"
# Ending of a file, without its dot -> function of a RunRecord and a Path, which writes the file.
EXPORTERS = "ffsm_drake.exporters"
# The same, of a Scenario and a Path; returns lines for the user.
SCENARIO_EXPORTERS = "ffsm_drake.scenario_exporters"
# Live views of a run. "meshcat", "foxglove": function of a scenario, returns the RunRecord;
# "controls": of a scenario, with ``keep`` for the record of each run; "replay": of a RunRecord.
LIVE = "ffsm_drake.live"
# Beginning of ``KIND:FILE@LAW`` -> function of the file's Path and ``law``, gives a law's factory.
CONTROLLER_FILES = "ffsm_drake.controller_files"
# Section of the scenario (``systems.registry.SECTIONS``) -> the Part that it describes.
SECTIONS = "ffsm_drake.sections"
# Name -> function or class that the core uses where it is installed: see the callers.
SERVICES = "ffsm_drake.services"
# Name -> class derived from ``runs.engine.Engine``, made without arguments.
ENGINES = "ffsm_drake.engines"


@functools.cache  # searches the installed packages once per process
def offered(group: str) -> dict[str, EntryPoint]:
    """Entry points of a group by name, in order of name. One name twice: the first one found."""
    found = dict[str, EntryPoint]()
    for each in entry_points(group=group):
        found.setdefault(each.name, each)
    return dict(sorted(found.items()))


def load(group: str, name: str, place: str) -> Any:
    """Return the object that a package offers under a name.

    Args:
      group: an entry point group, such as ``COMMANDS``.
      name: the entry point's name.
      place: place of the name, for errors.

    Raises:
      FfsmError: no installed package offers the name.
      BlockError: the package cannot be imported.
    """
    known = offered(group)
    if name not in known:
        raise FfsmError(
            f"{place}: no installed plug-in offers '{name}' (entry point group {group})"
            f"{did_you_mean(name, known)}"
        )
    try:
        return known[name].load()
    except BaseException as error:  # a module may raise anything on import
        if passes(error):
            raise
        said = one_line(error)
        if not isinstance(error, ImportError):
            said = f"{type(error).__name__}: {said}{where(error)}"
        raise BlockError(
            f"{place}: plug-in {known[name].value} cannot be loaded: {said}"
        ) from error


def optional(group: str, name: str) -> Any:
    """As ``load``; None where no package offers the name, or a plug-in that it needs has been
    deleted.
    """
    if name not in offered(group):
        return None
    try:
        return load(group, name, name)
    except BlockError as error:
        if deleted_plugin(error.__cause__):
            return None
        raise


def deleted_plugin(error: BaseException | None) -> str:
    """Return the plug-in of this package whose folder an import did not find; empty: another
    failure.
    """
    found = re.fullmatch(r"ffsm_drake\.plugins\.(\w+)", str(getattr(error, "name", "")))
    return found[1] if found and isinstance(error, ModuleNotFoundError) else ""


def service(name: str, place: str) -> Any:
    """Return a service that a scenario or a command needs; errors as ``load``."""
    return load(SERVICES, name, place)


def is_ours(entry_point: EntryPoint) -> bool:
    """Whether an entry point leads into this package."""
    return entry_point.module.partition(".")[0] == __name__.partition(".")[0]


def is_deleted(entry_point: EntryPoint) -> bool:
    """Whether an entry point leads into a plug-in of this package whose folder has been deleted."""
    plugin = ".".join(entry_point.module.split(".")[:3])
    return is_ours(entry_point) and importlib.util.find_spec(plugin) is None
