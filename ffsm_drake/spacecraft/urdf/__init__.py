"""URDFs as users bring them: reading one, and writing a copy that Drake loads.

URDFs hold much that a free-flying spacecraft in Drake has no use for: settings of controllers and
simulators, collision shapes, friction, meshes that are not there. The copy leaves these out and
lists them. What only the author can decide, such as a missing mass, is an error whose message says
what to change.
"""

from ffsm_drake.spacecraft.urdf.elements import Joint
from ffsm_drake.spacecraft.urdf.mounting import Bus, make_bus
from ffsm_drake.spacecraft.urdf.servicer import Servicer, Tip, read_urdf
from ffsm_drake.spacecraft.urdf.target import Target, read_target
from ffsm_drake.spacecraft.urdf.writing import write_urdf

__all__ = [
    "Bus",
    "Joint",
    "Servicer",
    "Target",
    "Tip",
    "make_bus",
    "read_target",
    "read_urdf",
    "write_urdf",
]
