"""What plug-ins bring: objects by name, each imported on first use.

A plug-in of this package declares them in its file ``plugin.py``, another package by entry points.
A ``Registry`` has the objects of one kind. It stands in the room that uses them.
"""

import functools
import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Generic, TypeVar

from ffsm_drake.common.errors import BlockError, FfsmError, did_you_mean, one_line
from ffsm_drake.common.guard import passes, where

_PLUGINS = "ffsm_drake.plugins"
_FOLDER = Path(__file__).parents[1] / "plugins"

Kind = TypeVar("Kind")


@dataclass(frozen=True, kw_only=True)
class Plugin:
    """A plug-in of this package. Its file ``plugin.py`` imports only this class."""

    about: str
    page: str = ""  # of the documentation, without its ending
    extras: tuple[str, ...] = ()  # of the installation, for all that it does
    needs: tuple[str, ...] = ()  # plug-ins that it imports
    uses: tuple[str, ...] = ()  # plug-ins that it reaches by a registry, if they are there
    # group -> name -> module:attribute within ``ffsm_drake.plugins``
    brings: Mapping[str, Mapping[str, str]] = field(default_factory=dict)


@functools.cache
def own_plugins() -> Mapping[str, Plugin]:
    """Return the plug-ins of this package by the names of their folders.

    The package around a file ``plugin.py`` is not imported.
    """
    found = dict[str, Plugin]()
    for file in sorted(_FOLDER.glob("*/plugin.py")):
        name = file.parent.name
        spec: Any = importlib.util.spec_from_file_location(f"{_PLUGINS}.{name}.plugin", file)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        found[name] = module.PLUGIN
    return found


@functools.cache  # searches the installed packages once per process
def offered(group: str) -> Mapping[str, EntryPoint]:
    """Return what all plug-ins bring into a group, by name: first those of this package.

    One name twice: the first one found.
    """
    own = {
        name: EntryPoint(name, f"{_PLUGINS}.{address}", group)
        for plugin in own_plugins().values()
        for name, address in plugin.brings.get(group, {}).items()
    }
    others = dict[str, EntryPoint]()
    for each in entry_points(group=f"ffsm_drake.{group}"):
        if each.name not in own and not plugin_of(each.module):  # of an older installation
            others.setdefault(each.name, each)
    return dict(sorted(own.items())) | dict(sorted(others.items()))


def plugin_of(module: str) -> str:
    """Return the plug-in of this package that a module is part of; empty: none."""
    package, _, rest = module.partition(f"{_PLUGINS}.")
    return "" if package else rest.partition(".")[0]


def absent_need(plugin: str) -> str:
    """Return a plug-in that has been deleted: the given one, or one that it needs. Empty: none."""
    known = own_plugins()
    if plugin not in known:
        return plugin
    return next(filter(None, map(absent_need, known[plugin].needs)), "")


@dataclass
class Registry(Generic[Kind]):
    """The objects of one kind, by name: of the core, and of entry points ``ffsm_drake.GROUP``."""

    group: str
    core: dict[str, str] = field(default_factory=dict)  # name -> module:attribute

    def offers(self) -> Mapping[str, EntryPoint]:
        """Return where the objects are: first those of the core."""
        own = {name: EntryPoint(name, address, self.group) for name, address in self.core.items()}
        return own | {**offered(self.group), **own}

    def offer(self, name: str) -> EntryPoint | None:
        """Return where an object is; None: no plug-in offers the name."""
        if name in self.core:  # the installed packages need not be searched
            return EntryPoint(name, self.core[name], self.group)
        return offered(self.group).get(name)

    def load(self, name: str, place: str) -> Kind:
        """Return an object; ``place``: of the name, for errors.

        Raises:
          FfsmError: no installed plug-in offers the name.
          BlockError: the object cannot be imported.
        """
        offer = self.offer(name)
        if offer is None:
            raise FfsmError(
                f"{place}: no installed plug-in offers '{name}' (entry point group "
                f"ffsm_drake.{self.group}){did_you_mean(name, self.offers())}"
            )
        own = plugin_of(offer.module)
        if own and (absent := absent_need(own)):
            raise BlockError(
                f"{place}: plug-in '{own}' needs the plug-in '{absent}', which is not installed"
            )
        try:
            found: Kind = offer.load()
        except BaseException as error:  # a module may raise anything on import
            if passes(error):
                raise
            said = one_line(error)
            if not isinstance(error, ImportError):
                said = f"{type(error).__name__}: {said}{where(error)}"
            raise BlockError(f"{place}: plug-in {offer.value} cannot be loaded: {said}") from error
        return found

    def find(self, name: str) -> Kind | None:
        """As ``load``; None if no plug-in offers the name, or one that it needs is absent."""
        offer = self.offer(name)
        if offer is None or ((own := plugin_of(offer.module)) and absent_need(own)):
            return None
        return self.load(name, name)

    def first(self) -> Kind | None:
        """As ``find``, of a group that has one object."""
        return self.find(self._only())

    def only(self, place: str) -> Kind:
        """As ``load``, of a group that has one object."""
        return self.load(self._only(), place)

    def _only(self) -> str:
        return next(iter(self.offers()), self.group)


# Name -> function: an additional ``ffsm_drake.NAME``.
VERBS = Registry[Callable[..., Any]]("verbs")
