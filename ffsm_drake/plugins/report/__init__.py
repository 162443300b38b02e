"""The run report: one self-contained HTML page about one or several runs, to open from disk and to
send to others.
"""

from ffsm_drake.plugins.report.page import write_report

__all__ = ["write_report"]
