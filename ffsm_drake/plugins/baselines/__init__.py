"""Baselines: control laws of others, for comparison; each in a file with its source."""
