"""Presentation: tables, figures, pages, recordings, block diagrams."""
