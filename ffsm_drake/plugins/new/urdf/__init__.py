"""User-supplied models: reading a URDF (or another format as one), and writing a copy for Drake.

URDFs contain elements of no use for a free-flying spacecraft in Drake: settings of controllers and
simulators, collision shapes, friction, missing meshes. The copy omits these and lists them. A gap
to be filled by the author, such as a missing mass, is an error with its remedy.
"""

import importlib

TYPE_CHECKING = False
if TYPE_CHECKING:
    from ffsm_drake.plugins.new.urdf.elements import Joint
    from ffsm_drake.plugins.new.urdf.mounting import Bus, make_bus
    from ffsm_drake.plugins.new.urdf.servicer import Servicer, Tip, read_urdf
    from ffsm_drake.plugins.new.urdf.target import SECOND, Target, cube, read_target
    from ffsm_drake.plugins.new.urdf.writing import write_urdf

# Imported on first use: the process that reads other formats needs next to none of them.
_HOMES = {
    "elements": ("Joint",),
    "mounting": ("Bus", "make_bus"),
    "servicer": ("Servicer", "Tip", "read_urdf"),
    "target": ("SECOND", "Target", "cube", "read_target"),
    "writing": ("write_urdf",),
}
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


def __getattr__(name: str) -> object:
    for module, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
