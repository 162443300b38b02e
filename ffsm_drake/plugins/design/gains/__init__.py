"""Choosing gains; see ``choosing``."""

from ffsm_drake.plugins.design.gains.choosing import INTERRUPT, design
from ffsm_drake.plugins.design.gains.requirement import DesignPoint, Requirement
from ffsm_drake.plugins.design.gains.result import Design

__all__ = ["INTERRUPT", "Design", "DesignPoint", "Requirement", "design"]
