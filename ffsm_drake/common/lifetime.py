"""Releasing diagrams that hold Python systems, so that thousands can be built in one process.

Drake 1.51: a Python system and its ports hold each other through an attribute that the collector
visits twice, so that it takes the system for one in use. ``untie`` ends that. Drake 1.51 to 1.55: a
callback that is a bound method holds its system from the C++ side, where the collector sees
nothing. ``weak_callback`` ends that. Without them memory grows by 2.3 MiB a run. Drake 1.56 to 1.58
frees diagrams by itself. (Measured over 200 runs of ``postcapture`` with each.)

Upstream: Drake's issue 22515; its pull requests 24117 (periodic updates) and 24852 (vector
outputs).
"""

import functools
import weakref
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

from pydrake.systems.framework import Diagram, System

# private to the bindings, so touched only in releases that were checked
_PEERS = "_pydrake_internal_ref_cycle_peers"
_HELD_BY_PORTS = ("1.51",)  # releases that need ``untie``


def weak_callback(method: Callable[..., None]) -> Callable[..., None]:
    """A callback for a system's own event or output that does not keep the system alive."""
    reference: Any = weakref.WeakMethod(method)

    def call(*arguments: Any) -> None:
        reference()(*arguments)

    return call


def untie(system: System) -> None:
    """Remove the references between a system (and all it contains) and its ports, so that the
    collector can free it.

    Accessing a port creates them again. A port that outlives its system must not be used. With a
    Drake release that frees diagrams by itself this does nothing.
    """
    if not holds_diagrams():
        return
    if isinstance(system, Diagram):
        for part in system.GetSystems():
            untie(part)
    for peer in tuple(_peers(system)):
        # a tuple is a callback, to which the C++ side holds no reference
        if not isinstance(peer, tuple):
            _peers(peer).discard(system)
            _peers(system).discard(peer)


def _peers(thing: Any) -> Any:
    # A set. No variable may hold it, here or in what calls this or is called: a profiler in another
    # thread (a Dask worker has one) may keep the frame for a moment, and Drake ends the run when it
    # meets a set with a second holder.
    return getattr(thing, "__dict__", {}).get(_PEERS, set())


@functools.cache  # reads a file
def holds_diagrams() -> bool:
    """Whether the installed Drake keeps a diagram that was let go, unless it is untied."""
    return version("drake").rpartition(".")[0] in _HELD_BY_PORTS
