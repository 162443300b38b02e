"""Audits of logs from other simulators: do they obey the equations of motion?

``verdict.audit`` is the entry."""
