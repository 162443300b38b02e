"""Free diagrams that contain Python systems, so that thousands can be built in one process.

Drake's bindings (1.51) never free such a diagram, for two reasons. A callback that is a bound method keeps its system
alive from the C++ side, which the garbage collector cannot see. And a Python system and its ports refer to each other
through an attribute that the collector visits twice, so that it counts the system as in use.
"""

import weakref
from collections.abc import Callable
from typing import Any

from pydrake.systems.framework import Diagram, System

_PEERS = "_pydrake_internal_ref_cycle_peers"


def weak_callback(method: Callable[..., None]) -> Callable[..., None]:
    """A callback for a system's own event or output that does not keep the system alive."""
    reference: Any = weakref.WeakMethod(method)

    def call(*arguments: Any) -> None:
        reference()(*arguments)

    return call


def untie(system: System) -> None:
    """Remove the references between a system (and all it contains) and its ports, so that the collector can free it.

    Accessing a port creates them again. A port that outlives its system must not be used.
    """
    if isinstance(system, Diagram):
        for part in system.GetSystems():
            untie(part)
    peers = _peers(system)
    for peer in list(peers):
        if not isinstance(peer, tuple):  # a tuple is a callback, to which the C++ side holds no reference
            _peers(peer).discard(system)
            peers.discard(peer)


def _peers(thing: Any) -> set[Any]:
    found: set[Any] = getattr(thing, "__dict__", {}).get(_PEERS, set())
    return found
