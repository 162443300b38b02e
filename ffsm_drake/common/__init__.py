"""Shared by every room: errors, files written whole, workers, the lifetime of diagrams."""
