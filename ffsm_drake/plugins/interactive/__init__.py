"""Live runs and an operator's panel in the browser."""
