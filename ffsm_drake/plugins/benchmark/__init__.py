"""The benchmark: every law on published missions, beside lower bounds (``ffsm benchmark``)."""
