"""Choosing gains; see ``choosing``."""

from ffsm_drake.control_design.gains.choosing import Design, design
from ffsm_drake.control_design.gains.requirement import DesignPoint, Requirement

__all__ = ["Design", "DesignPoint", "Requirement", "design"]
