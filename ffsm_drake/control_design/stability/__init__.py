"""Stability of the sampled loop, predicted from gains, period and mass matrices alone."""

from ffsm_drake.control_design.stability.margins import Margins, StabilityWarning, stability, stability_warning

__all__ = ["Margins", "StabilityWarning", "stability", "stability_warning"]
