"""Objects that installed packages offer by entry points, the plug-ins of this package among them.

Each is imported on first use.
"""

import functools
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from ffsm_drake.common.errors import BlockError, FfsmError, did_you_mean, one_line
from ffsm_drake.common.guard import passes, where

# Name of a command -> click command. Its module imports slow packages inside of the command.
COMMANDS = "ffsm_drake.commands"
# Name -> function: what ``ffsm_drake.NAME`` is beside the core's own names.
VERBS = "ffsm_drake.verbs"
# Ending of a file, without its dot -> function of a RunRecord and a Path, which writes the file.
EXPORTERS = "ffsm_drake.exporters"
# Live views of a run. "meshcat", "foxglove": function of a scenario, returns the RunRecord;
# "controls": of a scenario, with ``keep`` for the record of each run; "replay": of a RunRecord.
LIVE = "ffsm_drake.live"
# Beginning of ``KIND:FILE@LAW`` -> function of the file's Path and ``law``, gives a law's factory.
CONTROLLER_FILES = "ffsm_drake.controller_files"
# Name -> class derived from ``spacecraft.dynamics.Dynamics``, made without arguments.
DYNAMICS = "ffsm_drake.dynamics"


@functools.cache  # searches the installed packages once per process
def offered(group: str) -> dict[str, EntryPoint]:
    """Entry points of a group by name, in order of name. One name twice: the first one found."""
    found = dict[str, EntryPoint]()
    for each in entry_points(group=group):
        found.setdefault(each.name, each)
    return dict(sorted(found.items()))


def load(group: str, name: str, place: str) -> Any:
    """The object that a package offers under a name.

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
