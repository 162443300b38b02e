"""Release of diagrams with Python systems, so that one process can build thousands.

Drake 1.51: a Python system and its ports hold each other through an attribute visited twice by the
garbage collector, so it takes the system for one in use. ``untie`` solves that. Drake 1.51 to
1.55: a bound method as a callback holds its system from the C++ side, invisible to the collector.
``weak_callback`` solves that. Without them memory grows by 2.3 MiB a run. Drake 1.56 to 1.58 frees
diagrams by itself. (Measured over 200 runs of ``postcapture`` with each.)

Upstream: Drake's issue 22515; its pull requests 24117 (periodic updates) and 24852 (vector
outputs).
"""

import functools
import weakref
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

from pydrake.systems.framework import Diagram, System

# private to the bindings, so used only with tested releases
_PEERS = "_pydrake_internal_ref_cycle_peers"
_HELD_BY_PORTS = ("1.51",)  # releases that need ``untie``


def weak_callback(method: Callable[..., None]) -> Callable[..., None]:
    """Return a callback for a system's event or output that does not keep the system alive."""
    bound: Any = method
    function, reference = bound.__func__, weakref.ref(bound.__self__)

    def call(*arguments: Any) -> None:
        function(reference(), *arguments)  # a WeakMethod takes a microsecond more

    return call


def untie(system: System) -> None:
    """Remove the references between a system (with its subsystems) and its ports.

    The garbage collector can then free it. Accessing a port creates the references again. Do not
    use a port after the end of its system. With Drake releases that free diagrams themselves this
    does nothing.
    """
    if not holds_diagrams():
        return
    if isinstance(system, Diagram):
        for part in system.GetSystems():
            untie(part)
    for peer in tuple(_peers(system)):
        # a tuple is a callback without a reference from the C++ side
        if not isinstance(peer, tuple):
            _peers(peer).discard(system)
            _peers(system).discard(peer)


def _peers(thing: Any) -> Any:
    # Returns a set. No variable may hold it, here, in a caller or a callee: a profiler in another
    # thread (as in a Dask worker) may keep the frame for a moment, and Drake ends the run when the
    # set has a second reference.
    return getattr(thing, "__dict__", {}).get(_PEERS, set())


@functools.cache  # reads a file
def holds_diagrams() -> bool:
    """True if the installed Drake leaks diagrams unless they are untied."""
    return version("drake").rpartition(".")[0] in _HELD_BY_PORTS
