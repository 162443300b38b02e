"""Stability of the sampled loop, read from its wiring; limits by axis from a law's own step."""

from ffsm_drake.plugins.design.stability.margins import (
    Margins,
    StabilityWarning,
    adaptation_remark,
    stability,
)

__all__ = ["Margins", "StabilityWarning", "stability", "adaptation_remark"]
