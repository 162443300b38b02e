"""Sensors: from the true state to the controller's measurement."""
