"""Faults of sensors and actuators, and their detection."""
