"""A run with the check before it: what is said of a scenario, and the verbs simulate and compare."""
