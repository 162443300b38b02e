"""Audits of other simulators' logs: is a log physics?"""

from ffsm_drake.plugins.audit.checks import Audit, Check
from ffsm_drake.plugins.audit.verdict import audit

__all__ = ["Audit", "Check", "audit"]
