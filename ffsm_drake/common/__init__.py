"""Shared by every room: errors, files written whole, the lifetime of diagrams."""
