"""Releasing diagrams that hold Python systems, so that thousands can be built in one process.

Drake's bindings (1.51) never free such a diagram, for two reasons. A callback that is a bound method holds its system
from the C++ side, where the garbage collector sees nothing: ``weak_callback``. And a Python system and its ports hold
each other through an attribute that the collector visits twice, which makes it take the system for one in use:
``untie``. Upstream: Drake's issue 22515; its pull requests 24117 (periodic updates) and 24852 (vector outputs) end the
first.
"""

import functools
import weakref
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

from pydrake.systems.framework import Diagram, System

_PEERS = "_pydrake_internal_ref_cycle_peers"  # private to the bindings, so touched only in releases that were checked
_CHECKED = ("1.51",)


def weak_callback(method: Callable[..., None]) -> Callable[..., None]:
    """A callback for a system's own event or output that does not keep the system alive."""
    reference: Any = weakref.WeakMethod(method)

    def call(*arguments: Any) -> None:
        reference()(*arguments)

    return call


def untie(system: System) -> None:
    """Remove the references between a system (and all it contains) and its ports, so that the collector can free it.

    Accessing a port creates them again. A port that outlives its system must not be used. With a Drake release that was
    not checked this does nothing; campaigns replace workers that grow.
    """
    if not _is_checked():
        return
    if isinstance(system, Diagram):
        for part in system.GetSystems():
            untie(part)
    for peer in tuple(_peers(system)):
        if not isinstance(peer, tuple):  # a tuple is a callback, to which the C++ side holds no reference
            _peers(peer).discard(system)
            _peers(system).discard(peer)


def _peers(thing: Any) -> Any:
    # A set. No variable may hold it, here or in what calls this or is called: a profiler in another thread (a Dask
    # worker has one) may keep the frame for a moment, and Drake ends the run when it meets a set with a second holder.
    return getattr(thing, "__dict__", {}).get(_PEERS, set())


@functools.cache  # reads a file
def _is_checked() -> bool:
    return version("drake").rpartition(".")[0] in _CHECKED
