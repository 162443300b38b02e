"""User-supplied models: reading a URDF (or another format as one), and writing a copy for Drake.

URDFs contain elements of no use for a free-flying spacecraft in Drake: settings of controllers and
simulators, collision shapes, friction, missing meshes. The copy omits these and lists them. A gap
to be filled by the author, such as a missing mass, is an error with its remedy.
"""

from ffsm_drake.plugins.new.urdf.elements import Joint
from ffsm_drake.plugins.new.urdf.mounting import Bus, make_bus
from ffsm_drake.plugins.new.urdf.servicer import Servicer, Tip, read_urdf
from ffsm_drake.plugins.new.urdf.target import SECOND, Target, cube, read_target
from ffsm_drake.plugins.new.urdf.writing import write_urdf

__all__ = [
    "SECOND",
    "Bus",
    "Joint",
    "Servicer",
    "Target",
    "Tip",
    "cube",
    "make_bus",
    "read_target",
    "read_urdf",
    "write_urdf",
]
