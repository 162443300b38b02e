"""Kalman and coupled estimators for time-delay laws, and filters of the commanded force."""
