"""Stability of the sampled loop, predicted from gains, period and mass matrices alone."""

from ffsm_drake.design.stability.margins import Margins, StabilityWarning, assess, stability_warning

__all__ = ["Margins", "StabilityWarning", "assess", "stability_warning"]
