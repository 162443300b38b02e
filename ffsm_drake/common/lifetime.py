"""Letting go of diagrams that hold Python systems, so that thousands can be built in one process.

Drake's bindings (1.51) keep such a diagram for ever, for two reasons. A callback that is a bound method holds its
system from the C++ side, where the garbage collector sees nothing. And a Python system and its ports hold each other
through an attribute that the collector visits twice, which makes it take the system for one in use.
"""

import weakref
from collections.abc import Callable
from typing import Any

from pydrake.systems.framework import Diagram, System

_PEERS = "_pydrake_internal_ref_cycle_peers"


def weak_callback(method: Callable[..., None]) -> Callable[..., None]:
    """A callback for a system's own event or output that does not hold the system."""
    reference: Any = weakref.WeakMethod(method)

    def call(*arguments: Any) -> None:
        reference()(*arguments)

    return call


def untie(system: System) -> None:
    """Undo the tie between a system, with all that it contains, and its ports, so that the collector can free it.

    A tie comes back with every look at a port. A port that is kept longer than its system must not be used.
    """
    if isinstance(system, Diagram):
        for part in system.GetSystems():
            untie(part)
    peers = _peers(system)
    for peer in list(peers):
        if not isinstance(peer, tuple):  # which would be a callback, that the C++ side only borrows
            _peers(peer).discard(system)
            peers.discard(peer)


def _peers(thing: Any) -> set[Any]:
    found: set[Any] = getattr(thing, "__dict__", {}).get(_PEERS, set())
    return found
