"""Stability of the sampled loop, read from its wiring; limits by axis from a law's own step."""

from ffsm_drake.plugins.design.stability.margins import (
    Margins,
    adaptation_remark,
    stability,
)

__all__ = ["Margins", "stability", "adaptation_remark"]
