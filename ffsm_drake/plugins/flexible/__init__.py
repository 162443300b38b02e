"""Flexible parts of the spacecraft: panels, beams, slosh, passive joints and gears."""

from ffsm_drake.plugins.flexible.bodies import (
    add_flexible,
    flexible_bodies,
    lock_joints,
    modes_of,
    set_flexible,
    take_masses,
)
from ffsm_drake.plugins.flexible.drawing import draw_on_plates

__all__ = [
    "add_flexible",
    "draw_on_plates",
    "flexible_bodies",
    "lock_joints",
    "modes_of",
    "set_flexible",
    "take_masses",
]
