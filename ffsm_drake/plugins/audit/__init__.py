"""Audits of other simulators' logs: is a log physics? ``verdict.audit`` answers."""
