"""Remarks on a scenario before it runs, and the verbs ``simulate`` and ``compare``."""
