"""The report of one or several runs, as one HTML page to open from disk or to send."""

from ffsm_drake.plugins.report.page import write_report

__all__ = ["write_report"]
