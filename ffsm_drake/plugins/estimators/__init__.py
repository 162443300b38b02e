"""Estimators of time-delay laws, and filters of the commanded force."""
