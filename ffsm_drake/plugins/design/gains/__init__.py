"""Choosing gains; see ``choosing``."""

from ffsm_drake.plugins.design.gains.choosing import INTERRUPT, Design, design
from ffsm_drake.plugins.design.gains.requirement import DesignPoint, Requirement

__all__ = ["INTERRUPT", "Design", "DesignPoint", "Requirement", "design"]
