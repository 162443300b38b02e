"""Stability of the sampled loop, read from its wiring, and its closed forms for the paper's
laws.
"""

from ffsm_drake.control_design.stability.margins import (
    Margins,
    StabilityWarning,
    stability,
    stability_warning,
)

__all__ = ["Margins", "StabilityWarning", "stability", "stability_warning"]
