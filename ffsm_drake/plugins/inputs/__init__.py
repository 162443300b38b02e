"""Copies of the models, plans, policies and modules of a run in its folder, to repeat it."""
