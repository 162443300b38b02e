"""From a plain URDF of base and arm to a starting scenario that converges."""

from ffsm_drake.onboarding.start import ControllerMargins, Onboarding, onboard, onboarding_text
from ffsm_drake.onboarding.urdf import Joint, Servicer, Tip, read_urdf

__all__ = [
    "ControllerMargins",
    "Joint",
    "Onboarding",
    "Servicer",
    "Tip",
    "onboard",
    "onboarding_text",
    "read_urdf",
]
