"""Kinds of phases of a capture."""
