"""Flexible parts for the core."""

from ffsm_drake.plugins.flexible import bodies
from ffsm_drake.plugins.flexible.drawing import draw_on_plates
from ffsm_drake.spacecraft.extensions import FlexibleParts


class Parts(FlexibleParts):
    """Panels, beams, slosh, passive joints and gears."""

    add_flexible = staticmethod(bodies.add_flexible)
    lock_joints = staticmethod(bodies.lock_joints)
    draw_on_plates = staticmethod(draw_on_plates)
    set_flexible = staticmethod(bodies.set_flexible)
    take_masses = staticmethod(bodies.take_masses)
    flexible_bodies = staticmethod(bodies.flexible_bodies)
    modes_of = staticmethod(bodies.modes_of)


PARTS = Parts()
