"""Choosing gains; see ``choosing``."""

from ffsm_drake.control_design.gains.choosing import INTERRUPT, Design, design
from ffsm_drake.control_design.gains.requirement import DesignPoint, Requirement

__all__ = ["INTERRUPT", "Design", "DesignPoint", "Requirement", "design"]
