"""Faults of units, and their detection."""
