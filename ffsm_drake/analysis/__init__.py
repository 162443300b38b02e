"""What the paper proves and claims, checked on a run: ``analyze(record)`` after any simulation, of any controller.

Nothing here runs during a simulation. A run that ended early is analysed up to there.
"""

from ffsm_drake.analysis.findings import Analysis, Finding, analyze

__all__ = ["Analysis", "Finding", "analyze"]
